"""ASF and AMC reading: positions by hand, a real recording and damaged files."""

import re

import numpy as np
import pytest

from probmotion.io.amc import read_amc
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load
from probmotion.motion.skeleton import Skeleton

ASF = """# a leg and a head
:version 1.10
:name made
:units
  mass 1.0
  length 0.254
  angle deg
:documentation
   begin of ignored text
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

# Channel values of root, thigh, shin and toe, and positions of thigh, head, shin and toe in
# decimetres. The root is at (10, 20, 30).
FRAMES: dict[tuple[float, ...], list[tuple[int, ...]]] = {
    # Rest pose.
    (0, 0, 0, 0, 0, 0, 0, 0): [(10, 16, 30), (10, 22, 30), (10, 13, 30), (10, 13, 31)],
    # The shin's own x axis is the world's y axis: z turns to x.
    (0, 0, 0, 0, 0, 90, 0, 0): [(10, 16, 30), (10, 22, 30), (10, 13, 30), (11, 13, 30)],
    # The toe's z axis is x and its y axis is z: z turns to -y, then to x.
    (0, 0, 0, 0, 0, 0, 90, 90): [(10, 16, 30), (10, 22, 30), (10, 13, 30), (11, 13, 30)],
    # The root turns about x (y to z, z to -y), then about y (z to x).
    (90, 90, 0, 0, 0, 0, 0, 0): [(6, 20, 30), (12, 20, 30), (3, 20, 30), (3, 19, 30)],
    # The thigh turns -y to -z, and the shin's axis from y to z.
    (0, 0, 0, 90, 0, 90, 0, 0): [(10, 20, 26), (10, 22, 30), (10, 20, 23), (11, 20, 23)],
    # The thigh turns about x, -y to -z, then about z; the toe's -y turns to x.
    (0, 0, 0, 90, 90, 0, 0, 0): [(10, 20, 26), (10, 22, 30), (10, 20, 23), (11, 20, 23)],
}


def amc(frames, first=1):
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


def put(folder, asf=ASF, motion=AMC, name="made"):
    """Write both files and return the path of the motion."""
    (folder / "made.asf").write_bytes(asf.encode())
    (folder / f"{name}.amc").write_bytes(motion.encode())
    return folder / f"{name}.amc"


def test_positions_by_hand(tmp_path):
    motion = read_amc(put(tmp_path))
    assert motion.skeleton == Skeleton(["root", "thigh", "head", "shin", "toe"], [-1, 0, 0, 1, 3])
    assert (motion.name, motion.fps) == ("made", 120.0)
    np.testing.assert_allclose(motion.positions[:, 0], [[1.0, 2.0, 3.0]] * len(FRAMES))
    np.testing.assert_allclose(motion.positions[:, 1:], np.array([*FRAMES.values()]) / 10)
    assert motion.rotations is None


def test_line_ends_comments_case_and_first_frame_number(tmp_path):
    wanted = read_amc(put(tmp_path)).positions
    other = AMC.replace("shin", "# nothing\n\nshin").replace("DEGREES", "degrees")
    for end in ("\n", "\r\n", "\r"):
        asf = ASF.replace(":units", ":UNITS").replace("XYZ", "xyz").replace("\n", end)
        path = put(tmp_path, "\ufeff" + asf, other.replace("\n", end))
        np.testing.assert_array_equal(read_amc(path).positions, wanted)
    path = put(tmp_path, motion=amc(list(FRAMES), first=97))
    np.testing.assert_array_equal(read_amc(path).positions, wanted)


def test_root_channels_follow_the_declared_order(tmp_path):
    reordered = re.sub(r"root 10 20 3.0e\+001 (\d+) (\d+) 0", r"root 0 \1 \2 10 20 30", AMC)
    path = put(tmp_path, ASF.replace("TX TY TZ RX RY RZ", "RZ RX RY TX TY TZ"), reordered)
    positions = read_amc(path).positions[:, 1:]
    np.testing.assert_allclose(positions, np.array([*FRAMES.values()]) / 10, atol=1e-12)


def test_skeleton_file_is_found_or_given(tmp_path):
    subject = put(tmp_path, name="made_01")
    assert read_amc(subject).name == "made_01"
    (tmp_path / "other").mkdir()
    away = (tmp_path / "other" / "run_01.amc").resolve()
    subject.rename(away)
    with pytest.raises(
        FileNotFoundError, match=r"expected the skeleton .*run_01\.asf or .*run\.asf, got"
    ):
        read_amc(away)
    assert read_amc(away, tmp_path / "made.asf").frames == len(FRAMES)
    for files in ((away, tmp_path / "none.asf"), (tmp_path / "none.amc",)):
        with pytest.raises(FileNotFoundError):
            read_amc(*files)


def test_frame_rate_is_given_or_assumed_with_a_warning(tmp_path):
    path = put(tmp_path)
    with pytest.raises(ValueError, match="fps must be a finite number above 0, got 0"):
        read_amc(path, fps=0)
    with pytest.warns(MotionFileWarning, match=r"made\.amc: assuming 120 frames per second"):
        assert load(path).fps == 120.0
    path = put(tmp_path, motion=":SAMPLES-PER-SECOND 60\n" + AMC)
    assert read_amc(path, fps=60.0).fps == 60.0
    with pytest.raises(MotionFileError, match="line 1: :SAMPLES-PER-SECOND: expected fps=120, got"):
        read_amc(path)


SKELETON_DEFECTS = [
    (ASF, "", "expected a line starting with ':', got an empty file"),
    (ASF, "HIERARCHY", "line 1: expected :version, :name or :units, got 'HIERARCHY'"),
    (ASF[ASF.index(":hier") :], "", "line 48: expected :hierarchy, got the end of the file"),
    ("toe\n  end\n", "toe\n", "line 53: expected begin and end around the hierarchy, got no"),
    ("toe\n  end\n", "toe\n  end\n:root\n", "line 55: expected one ':root', got a second"),
    ("angle deg", "angle rad", "line 7: angle must be deg, got 'rad'"),
    ("length 0.254", "", "line 7: expected length in :units"),
    ("length 0.254", "length 0", "line 6: length must be between 0.001 and 1000, got 0"),
    ("order", "other", "expected order in :root"),
    ("TX TY", "TX L", "line 11: expected channels TX, TY, TZ, RX, RY, RZ, each at most"),
    ("position 0 0", "position 0 1", "line 13: position must be 0 0 0, got 0 1 0"),
    ("rx rz", "rx rx", "line 22: expected channels RX, RY, RZ, each at most once, got"),
    ("dof RX", "dof TX", "each at most once, got 'TX'"),
    ("name toe", "name thigh", "line 28: name must be nonempty and unique, got"),
    ("name toe\n", "\n", "line 33: expected name in the bone of line 26"),
    ("0 0 1\n", "0 0 2\n", "line 29: direction must be a unit vector, got 0 0 2"),
    ("length 4", "length -4", "line 20: length must be at least 0, got -4"),
    ("axis 90 0 90 XYZ", "axis 90 0 90", "line 31: axis must be three angles and XYZ"),
    ("id 2", "length 3", "expected one length in the bone of line 26, got a second"),
    ("id 2", "eggs 2", "line 27: expected id, name, direction"),
    ("  end\n:hier", "\n:hier", "expected end of the bone of line 42"),
    ("shin toe\n", "shin\n", "line 26: expected 'toe' in the hierarchy, got no parent"),
    ("shin toe", "shin nose", "line 53: expected a bone of :bonedata, got 'nose'"),
    ("shin toe", "shin toe head", "line 53: expected one parent of 'head', got a second"),
    ("root thigh head", "root head\nshin thigh", "parents must form trees, got a cycle"),
]
MOTION_DEFECTS = [
    (AMC, "", "expected a line starting with ':', got an empty file"),
    (AMC[AMC.index("1\n") :], "", "line 3: expected at least one frame, got the end of the file"),
    ("90 90\ntoe 0 0\n", "90 90\n", "line 32: expected all moving bones in frame 6, got none"),
    (":DEGREES", ":RADIANS", "line 4: expected :DEGREES before the first frame, got '1'"),
    ("\n1\n", "\n", "line 4: expected a frame number, got 'root'"),
    ("\n3\n", "\n4\n", "line 14: expected frame 3, got 4"),
    ("\n3\n", "\n", "line 14: expected each moving bone once per frame, got 'root'"),
    ("shin 90\n", "\n", "line 14: expected all moving bones in frame 2, got none of 'shin'"),
    ("shin 90", "head 90", "line 11: expected each moving bone once per frame, got"),
    ("shin 90", "shin 90 1", "line 11: 'shin': expected 1 values, got 2"),
    ("shin 90", "shin inf", "line 11: 'shin': expected a number between -1e9 and 1e9, g"),
]


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        *(("made.asf", *defect) for defect in SKELETON_DEFECTS),
        *(("made.amc", *defect) for defect in MOTION_DEFECTS),
    ],
)
def test_defects_are_reported(tmp_path, name, old, new, message):
    path = put(tmp_path)
    damaged = tmp_path / name
    damaged.write_text(damaged.read_text().replace(old, new, 1))
    with pytest.raises(MotionFileError, match=re.escape(message)) as error:
        read_amc(path)
    assert str(damaged) in str(error.value)


def test_truncated_files_are_refused(tmp_path):
    last = amc(list(FRAMES)[-1:])
    for stop in range(len(last) - 1):
        with pytest.raises(MotionFileError, match="expected"):
            read_amc(put(tmp_path, motion=last[:stop]))
    for stop in range(0, len(ASF) - 1, 9):
        with pytest.raises(MotionFileError, match=r"expected|must"):
            read_amc(put(tmp_path, ASF[:stop]))


def test_real_recording_agrees_with_its_conversion(real_data):
    path = real_data / "originals" / "02_01.amc"
    motion = read_amc(path)
    with np.load(real_data / "cmu_single" / "cmu_02_01.npz") as known:
        assert motion.skeleton == Skeleton(known["joint_names"].tolist(), known["parents"].tolist())
        np.testing.assert_allclose(motion.positions[::4], known["positions"], rtol=0, atol=1e-6)
    assert (motion.frames, motion.fps, motion.name) == (343, 120.0, "02_01")
