"""ASF and AMC files: positions worked out by hand, a real recording, damaged files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from probmotion.io.amc import read_amc
from probmotion.io.asf import read_asf
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load_motion, read_motion

ASF = """# a leg and a head
:version 1.10
:name made
:units
  mass 1.0
  length 0.254
  angle deg
:documentation
   begin with nothing that means something here
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name thigh
     direction 0 -1 0
     length 4
     axis 0 0 0  XYZ
     dof rx rz
     limits (-160.0 20.0)
            (-70.0 70.0)
  end
  begin
     id 2
     name toe
     direction 0 0 1
     length 1   # a tenth of a metre
     axis 90 0 90 XYZ
     dof rz ry
  end
  begin
     id 3
     name shin
     direction 0 -1 0
     length 3.0e0
     axis 0 0 90 XYZ
     dof RX
  end
  begin
     id 4
     name head
     direction 0 1 0
     length 2
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root thigh head
    thigh shin
    shin toe
  end
"""

# The values of root, thigh, shin and toe, and where the ends of the bones are (decimetres): thigh,
# head, shin, toe. The root is at (10, 20, 30).
FRAMES: dict[tuple[float, ...], list[tuple[int, ...]]] = {
    # The rest pose: down, down, forwards; up.
    (0, 0, 0, 0, 0, 0, 0, 0): [(10, 16, 30), (10, 22, 30), (10, 13, 30), (10, 13, 31)],
    # The shin's own x axis is the world's y axis: z turns to x.
    (0, 0, 0, 0, 0, 90, 0, 0): [(10, 16, 30), (10, 22, 30), (10, 13, 30), (11, 13, 30)],
    # The toe's own z axis is x and its y axis is z: first z turns to -y, and then that to x.
    (0, 0, 0, 0, 0, 0, 90, 90): [(10, 16, 30), (10, 22, 30), (10, 13, 30), (11, 13, 30)],
    # The root turns about x (y to z, z to -y), then about y (z to x).
    (90, 90, 0, 0, 0, 0, 0, 0): [(6, 20, 30), (12, 20, 30), (3, 20, 30), (3, 19, 30)],
    # The thigh turns -y to -z, and with it the shin's axis y to z; the head stays.
    (0, 0, 0, 90, 0, 90, 0, 0): [(10, 20, 26), (10, 22, 30), (10, 20, 23), (11, 20, 23)],
    # The thigh turns about x, -y to -z, then about z, which leaves that; the toe's -y turns to x.
    (0, 0, 0, 90, 90, 0, 0, 0): [(10, 20, 26), (10, 22, 30), (10, 20, 23), (11, 20, 23)],
}


def amc(frames: list[tuple[float, ...]], first: int = 1) -> str:
    lines = ["#!OML:ASF made.asf", ":FULLY-SPECIFIED", ":DEGREES"]
    for number, (x, y, z, *thigh, shin, z_toe, y_toe) in enumerate(frames, start=first):
        lines += [
            f"{number}",
            f"root 10 20 3.0e+001 {x} {y} {z}",
            f"shin {shin}",
            f"thigh {thigh[0]} {thigh[1]}",
            f"toe {z_toe} {y_toe}",
        ]
    return "\n".join(lines) + "\n"


AMC = amc(list(FRAMES))


def put(folder: Path, asf: str = ASF, motion: str = AMC, name: str = "made") -> Path:
    """Write both files; return the path of the motion."""
    (folder / "made.asf").write_bytes(asf.encode())
    (folder / f"{name}.amc").write_bytes(motion.encode())
    return folder / f"{name}.amc"


def test_positions_worked_out_by_hand(tmp_path: Path) -> None:
    motion = read_amc(put(tmp_path))
    assert motion.skeleton.joint_names == ("root", "thigh", "head", "shin", "toe")
    assert motion.skeleton.parents == (-1, 0, 0, 1, 3)
    assert (motion.name, motion.fps) == ("made", 120.0)
    np.testing.assert_allclose(motion.positions[:, 0], [[1.0, 2.0, 3.0]] * len(FRAMES))
    np.testing.assert_allclose(motion.positions[:, 1:], np.array([*FRAMES.values()]) / 10)
    assert motion.rotations is None


def test_a_skeleton_alone_is_its_rest_pose(tmp_path: Path) -> None:
    put(tmp_path)
    body = read_asf(tmp_path / "made.asf")
    assert body.channels[1:] == (("RX", "RZ"), (), ("RX",), ("RZ", "RY"))
    assert body.unit == pytest.approx(0.1)
    np.testing.assert_allclose(
        body.offsets[1:], [[0.0, -0.4, 0], [0, 0.2, 0], [0, -0.3, 0], [0, 0, 0.1]], atol=1e-15
    )
    # The toe's axes: its x is y, its y is z, its z is x.
    np.testing.assert_allclose(body.axes[4], np.eye(3)[[2, 0, 1]], atol=1e-15)


def test_the_unit_of_length_is_an_inch_over_what_the_file_says(tmp_path: Path) -> None:
    whole = read_amc(put(tmp_path)).positions
    cmu = read_amc(put(tmp_path, ASF.replace("length 0.254", "length 0.45"))).positions
    np.testing.assert_allclose(cmu, whole * 0.254 / 0.45, rtol=1e-15)


def test_line_ends_comments_cases_and_first_numbers_do_not_matter(tmp_path: Path) -> None:
    wanted = read_amc(put(tmp_path)).positions
    other = AMC.replace("shin", "# nothing\n\nshin").replace("DEGREES", "degrees")
    for end in ("\n", "\r\n", "\r"):
        asf = ASF.replace(":units", ":UNITS").replace("XYZ", "xyz").replace("\n", end)
        path = put(tmp_path, "\ufeff" + asf, other.replace("\n", end))
        np.testing.assert_array_equal(read_amc(path).positions, wanted)
    path = put(tmp_path, motion=amc(list(FRAMES), first=97))
    np.testing.assert_array_equal(read_amc(path).positions, wanted)


def test_the_order_of_a_root_is_the_file_s(tmp_path: Path) -> None:
    turned = AMC.replace("root 10 20 3.0e+001 90 90 0", "root 0 90 90 10 20 30")
    turned = turned.replace("root 10 20 3.0e+001 0 0 0", "root 0 0 0 10 20 30")
    path = put(tmp_path, ASF.replace("TX TY TZ RX RY RZ", "RZ RX RY TX TY TZ"), turned)
    np.testing.assert_allclose(
        read_amc(path).positions[:, 1:], np.array([*FRAMES.values()]) / 10, atol=1e-12
    )


def test_the_skeleton_is_beside_the_motion_or_given(tmp_path: Path) -> None:
    subject = put(tmp_path, name="made_01")
    assert read_amc(subject).name == "made_01"
    (tmp_path / "other").mkdir()
    away = (tmp_path / "other" / "run_01.amc").resolve()
    subject.rename(away)
    with pytest.raises(FileNotFoundError, match=r"no .*run_01\.asf or .*run\.asf with the skelet"):
        read_amc(away)
    assert read_amc(away, tmp_path / "made.asf").frames == len(FRAMES)
    with pytest.raises(FileNotFoundError):
        read_amc(away, tmp_path / "none.asf")
    with pytest.raises(FileNotFoundError):
        read_amc(tmp_path / "none.amc")


def test_the_rate_is_given_or_assumed_aloud(tmp_path: Path) -> None:
    path = put(tmp_path)
    assert read_amc(path, fps=60.0).fps == 60.0
    with pytest.raises(ValueError, match="fps must be a finite number above 0, got 0"):
        read_amc(path, fps=0)
    for read in (read_motion, load_motion):
        with pytest.warns(MotionFileWarning, match=r"made\.amc is taken to have 120 frames per"):
            assert read(path).fps == 120.0
    path = put(tmp_path, motion=":SAMPLES-PER-SECOND 60\n" + AMC)
    assert read_amc(path, fps=60.0).fps == 60.0
    with pytest.raises(MotionFileError, match="line 1: :SAMPLES-PER-SECOND must be 120 as, got 60"):
        read_amc(path)


WRONG_SKELETONS = {
    "": "nothing came, expected a line that begins with ':'",
    "HIERARCHY\nROOT Hips": "line 1: 'HIERARCHY' came, expected :version, :name or :units",
    ASF.partition(":hierarchy")[0]: "line 48: the file ends without :hierarchy, expected all",
    ASF.partition("name shin")[0]: "the file ends without :hierarchy",
    ASF.rpartition("end")[0]: "line 53: end did not come, expected it around the hierarchy",
    ASF + ":root\n": "line 55: ':root' came again, expected it once",
    ASF.replace("angle deg", "angle rad"): "line 7: angle must be deg, got 'rad'",
    ASF.replace("length 0.254", ""): "line 7: :units has no length, expected one",
    ASF.replace("length 0.254", "length 0"): "line 6: length must be between 0.001 and 1000, got 0",
    ASF.replace("length 0.254", "length 1 2"): "line 6: length has 2 values, expected 1",
    ASF.replace("order", "other"): ":root has no order, expected one",
    ASF.replace("TX TY", "TX L"): "line 11: channel 'L' came, expected each of TX, TY, TZ, RX, RY",
    ASF.replace("position 0 0", "position 0 1"): "line 13: position is 0 1 0, expected 0 0 0",
    ASF.replace("rx rz", "rx rx"): "line 22: channel 'rx' came, expected each of RX, RY, RZ once",
    ASF.replace("dof RX", "dof TX"): "channel 'TX' came, expected each of RX, RY, RZ once at most",
    ASF.replace("name toe", "name thigh"): "line 28: name must be a new one, got 'thigh'",
    ASF.replace("name toe", "name root"): "line 28: name must be a new one, got 'root'",
    ASF.replace("name toe\n", "\n"): "line 33: the bone of line 26 has no name, expected one",
    ASF.replace("direction 0 0 1", "direction 0 0 2"): "direction is 0 0 2, expected a vector of",
    ASF.replace("direction 0 0 1", "direction 0 0"): "line 29: direction has 2 values, expected 3",
    ASF.replace("length 4", "length -4"): "line 20: length must be 0 or more, got -4",
    ASF.replace("length 4", "length nan"): "line 20: length has 'nan', expected a number between",
    ASF.replace("length 4", "length 4_0"): "line 20: length has '4_0', expected a number between",
    ASF.replace("90 0 90 XYZ", "90 0 90 ZYX"): "axis is '90 0 90 ZYX', expected three angles and",
    ASF.replace("90 0 90 XYZ", "90 0 90"): "axis is '90 0 90', expected three angles and XYZ",
    ASF.replace("id 2", "length 3"): "length came again in the bone of line 26, expected it once",
    ASF.replace("id 2", "eggs 2"): "line 27: 'eggs' came, expected id, name, direction",
    ASF.replace("  end\n:hier", "\n:hier"): "ends inside the bone of line 42, expected its end",
    ASF.replace("shin toe\n", "shin\n"): "line 26: bone 'toe' has no parent in the hierarchy",
    ASF.replace("shin toe", "shin nose"): "line 53: 'nose' came, expected a bone of :bonedata",
    ASF.replace("shin toe", "shin toe head"): "line 53: 'head' has a second parent, expected one",
    ASF.replace("root thigh head", "root head\nshin thigh"): "parents form a cycle",
}


@pytest.mark.parametrize("asf", WRONG_SKELETONS, ids=list(WRONG_SKELETONS.values()))
def test_what_is_wrong_with_a_skeleton_is_one_sentence(asf: str, tmp_path: Path) -> None:
    path = put(tmp_path, asf)
    with pytest.raises(MotionFileError) as error:
        read_amc(path)
    assert f"{tmp_path / 'made.asf'}" in str(error.value)
    assert WRONG_SKELETONS[asf] in str(error.value)


WRONG_MOTIONS = {
    "": "nothing came, expected a line that begins with ':'",
    "HIERARCHY\nROOT Hips": "line 1: 'HIERARCHY' came, expected :FULLY-SPECIFIED before it",
    AMC.replace(":DEGREES", ":RADIANS"): "line 4: '1' came, expected :DEGREES before it",
    AMC.partition("1\n")[0]: "line 3: the file ends before its first frame, expected one at least",
    AMC.replace("\n1\n", "\n"): "line 4: 'root' came, expected the number of a frame",
    AMC.replace("\n3\n", "\n4\n"): "line 14: frame 4 came after 2, expected 3",
    AMC.replace("\n3\n", "\n"): "line 14: 'root' came, expected a bone that moves, once in a frame",
    AMC.replace("shin 90\n", "\n", 1): "line 14: frame 2 ends without 'shin', expected all bones",
    AMC.rpartition("toe")[0]: "line 32: frame 6 ends without 'toe', expected all bones that move",
    AMC.replace("shin 90", "head 90"): "line 11: 'head' came, expected a bone that moves, once in",
    AMC.replace("shin 90", "shin"): "line 11: 'shin' has 0 values, expected 1",
    AMC.replace("shin 90", "shin 90 1"): "line 11: 'shin' has 2 values, expected 1",
    AMC.replace("shin 90", "shin inf"): "line 11: 'shin' has 'inf', expected a number between -1e9",
    AMC.replace("shin 90", "shin 1e10"): "line 11: 'shin' has '1e10', expected a number between",
}


@pytest.mark.parametrize("motion", WRONG_MOTIONS, ids=list(WRONG_MOTIONS.values()))
def test_what_is_wrong_with_a_motion_is_one_sentence(motion: str, tmp_path: Path) -> None:
    path = put(tmp_path, motion=motion)
    with pytest.raises(MotionFileError) as error:
        read_amc(path)
    assert str(path) in str(error.value)
    assert WRONG_MOTIONS[motion] in str(error.value)


def outcomes(path: Path, damaged: list[str], put_one: Callable[[str], object]) -> list[bool]:
    """Return which of the damaged texts were read; the others are refused in one sentence."""
    read = []
    for text in damaged:
        put_one(text)
        try:
            read.append(bool(np.isfinite(read_amc(path).positions).all()))
        except MotionFileError as error:
            refused = str(error)
            read.append(False)
        else:
            refused = "as expected"
        assert "expected" in refused, text
        assert refused.isprintable()
    return read


def test_a_file_that_is_cut_or_garbled_anywhere_is_read_or_refused(tmp_path: Path) -> None:
    short = amc(list(FRAMES)[-2:])
    path = put(tmp_path, ASF, short)
    garbled = ["", "1", "1e300", "-9" * 30, "begin", "end", ":units", "root", "é\x00", "("]

    def damages(text: str) -> list[str]:
        words = text.split(" ")
        swaps = [(place, other) for place in range(0, len(words), 3) for other in garbled[::2]]
        return [text[:stop] for stop in range(0, len(text), 3)] + [
            " ".join([*words[:place], other, *words[place + 1 :]]) for place, other in swaps
        ]

    cut = outcomes(path, damages(short), path.write_text)
    assert True in cut
    assert False in cut
    # A motion that is cut is whole only after a frame, or within its last number.
    assert sum(outcomes(path, [short[:stop] for stop in range(len(short))], path.write_text)) <= 4
    path.write_text(short)
    assert False in outcomes(path, damages(ASF), (tmp_path / "made.asf").write_text)
    whole = ASF.rstrip()
    parts = [whole[:stop] for stop in range(0, len(whole), 5)]
    assert not any(outcomes(path, parts, (tmp_path / "made.asf").write_text))


def test_a_real_recording_agrees_with_its_conversion(real_data: Path) -> None:
    path = real_data / "originals" / "02_01.amc"
    motion = read_amc(path)
    with np.load(real_data / "cmu_single" / "cmu_02_01.npz") as known:
        assert motion.skeleton.joint_names == tuple(known["joint_names"])
        assert motion.skeleton.parents == tuple(known["parents"])
        np.testing.assert_allclose(motion.positions[::4], known["positions"], rtol=0, atol=1e-6)
    assert (motion.frames, motion.fps, motion.name) == (343, 120.0, "02_01")
