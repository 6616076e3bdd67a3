"""BVH reading: kinematics against pybvh and by hand, every defect named by its line."""

from __future__ import annotations

import itertools
import re
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import read_motion

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="no ../shared/data beside the checkout")

MINIMAL = """HIERARCHY
ROOT Hips
{
    OFFSET 0 0 0
    CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
    JOINT Knee
    {
        OFFSET 0 -1 0
        CHANNELS 3 Zrotation Yrotation Xrotation
        End Site
        {
            OFFSET 0 -0.5 0
        }
    }
}
MOTION
Frames: 2
Frame Time: 0.0333333
0 1 0 0 0 0 0 0 0
0 1 0 90 0 0 0 0 90
"""


def written(folder: Path, text: str | bytes, name: str = "clip.bvh") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def chain(order: str, rng: np.random.Generator, frames: int = 5) -> str:
    """A root and two joints with one rotation order, random offsets and angles."""
    channels = " ".join(f"{axis}rotation" for axis in order)
    offsets = rng.normal(size=(3, 3))
    lines = ["HIERARCHY"]
    for depth, keyword in enumerate(("ROOT a", "JOINT b", "JOINT c")):
        offset = offsets[depth] if depth else np.zeros(3)
        position = "" if depth else "Xposition Yposition Zposition "
        lines += [keyword, "{", "OFFSET " + " ".join(map(repr, offset.tolist()))]
        lines += [f"CHANNELS {3 if depth else 6} {position}{channels}"]
    lines += ["End Site", "{", "OFFSET 0 0.1 0", "}", "}", "}", "}", "MOTION"]
    lines += [f"Frames: {frames}", "Frame Time: 0.04"]
    for row in rng.uniform(-180, 180, size=(frames, 12)):
        lines.append(" ".join(map(repr, row.tolist())))
    return "\n".join(lines) + "\n"


def pybvh_positions(path: Path) -> np.ndarray:
    import pybvh

    return pybvh.read_bvh_file(path, world_up="+y").node_positions()


# --- kinematics --------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["".join(axes) for axes in itertools.permutations("XYZ")])
def test_positions_agree_with_pybvh_in_every_rotation_order(tmp_path: Path, order: str) -> None:
    path = written(tmp_path, chain(order, np.random.default_rng(7)))
    positions = read_bvh(path, scale=1.0, end_sites=True).positions
    np.testing.assert_allclose(positions, pybvh_positions(path), atol=1e-9)


@needs_data
@pytest.mark.parametrize("name", ["60_10_scaled", "61_10_scaled", "131_01"])
def test_positions_of_real_files_agree_with_pybvh(name: str) -> None:
    path = DATA / "originals" / f"{name}.bvh"
    positions = read_bvh(path, scale=1.0, end_sites=True).positions
    np.testing.assert_allclose(positions, pybvh_positions(path), atol=1e-8)


@needs_data
def test_cmu_clip_agrees_with_its_independent_conversion_in_metres() -> None:
    archive = np.load(DATA / "cmu_single" / "cmu_131_01.npz")
    with pytest.warns(MotionFileWarning, match=r"1/0\.45 inch"):
        motion = read_bvh(DATA / "originals" / "131_01.bvh", end_sites=True)
    assert motion.skeleton.joint_names == tuple(archive["joint_names"])
    assert motion.skeleton.parents == tuple(archive["parents"])
    assert motion.fps == 120
    np.testing.assert_allclose(motion.positions[1::4], archive["positions"], atol=1e-6)


def test_a_quarter_turn_by_hand(tmp_path: Path) -> None:
    motion = read_bvh(written(tmp_path, MINIMAL), scale=1.0, end_sites=True)
    assert motion.skeleton.joint_names == ("Hips", "Knee", "Knee_end")
    # Frame 1: the hip turns (0, -1, 0) about z by 90° to (1, 0, 0); the shank, first turned
    # about the knee's x axis from -y to -z, stays along -z.
    expected = [[0, 1, 0], [1, 1, 0], [1, 1, -0.5]]
    np.testing.assert_allclose(motion.positions[1], expected, atol=1e-12)


def test_rotations_and_rest_offsets_reproduce_the_positions(tmp_path: Path) -> None:
    motion = read_bvh(written(tmp_path, chain("YXZ", np.random.default_rng(2))), scale=0.01)
    world = motion.rotations[:, 0]
    knee = motion.positions[:, 0] + world @ motion.rest_offsets[1]
    foot = knee + world @ motion.rotations[:, 1] @ motion.rest_offsets[2]
    np.testing.assert_allclose(motion.positions[:, 1], knee, atol=1e-12)
    np.testing.assert_allclose(motion.positions[:, 2], foot, atol=1e-12)


def test_position_channels_replace_offsets_axis_by_axis(tmp_path: Path) -> None:
    text = MINIMAL.replace(
        "CHANNELS 3 Zrotation Yrotation Xrotation", "CHANNELS 3 Zposition Xrotation Xposition"
    ).replace("0 0 0\n0 1 0 90 0 0 0 0 90", "3 0 2\n0 1 0 90 0 0 0 0 0")
    motion = read_bvh(written(tmp_path, text), scale=1.0)
    np.testing.assert_allclose(motion.positions[0], [[0, 1, 0], [2, 0, 3]], atol=1e-12)
    np.testing.assert_allclose(motion.positions[1], [[0, 1, 0], [1, 1, 0]], atol=1e-12)
    assert motion.rotations is None, "rotations alone would not reproduce these positions"


def test_joints_may_have_any_channels_or_none(tmp_path: Path) -> None:
    text = (
        MINIMAL.replace("CHANNELS 6 X", "CHANNELS 5 X")
        .replace("Zrotation Yrotation Xrotation\n    JOINT", "Yrotation Zrotation\n    JOINT")
        .replace("CHANNELS 3 Zrotation Yrotation Xrotation", "CHANNELS 0")
        .replace("0 1 0 0 0 0 0 0 0\n0 1 0 90 0 0 0 0 90", "0 1 0 0 0\n0 1 0 90 90")
    )
    motion = read_bvh(written(tmp_path, text), scale=1.0, end_sites=True)
    # R_y(90°) R_z(90°) takes -y to x and then to -z.
    np.testing.assert_allclose(motion.positions[1, 2], [0, 1, -1.5], atol=1e-12)


def test_several_roots_make_one_skeleton(tmp_path: Path) -> None:
    ball = "ROOT Ball\n{\nOFFSET 5 0 0\nCHANNELS 1 Yposition\n}\nMOTION"
    text = MINIMAL.replace("MOTION", ball).replace("0 0 90\n", "0 0 90 4\n")
    text = text.replace("0 1 0 0 0 0 0 0 0\n", "0 1 0 0 0 0 0 0 0 3\n")
    motion = read_bvh(written(tmp_path, text), scale=1.0)
    assert motion.skeleton.roots == (0, 2)
    np.testing.assert_allclose(motion.positions[:, 2], [[5, 3, 0], [5, 4, 0]])
    assert motion.rotations is not None, "a root may move without losing the rotations"


def test_end_sites_are_left_out_unless_asked_for(tmp_path: Path) -> None:
    two = MINIMAL.replace(
        "        End Site", "        End Site\n{\nOFFSET 0 0 2\n}\n        End Site named", 1
    )
    path = written(tmp_path, two)
    assert read_bvh(path, scale=1.0).skeleton.joint_names == ("Hips", "Knee")
    named = read_bvh(path, scale=1.0, end_sites=True).skeleton
    assert named.joint_names == ("Hips", "Knee", "Knee_end", "Knee_end2")
    assert named.parents == (-1, 0, 1, 1)


# --- text --------------------------------------------------------------------------------------


def test_line_ends_blanks_case_and_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    expected = read_bvh(written(tmp_path, MINIMAL)).positions
    lines = MINIMAL.split("\n")
    ends = itertools.cycle(["\r\n", "\n", "\r", "\n\n\t \r\n"])
    mixed = "".join(line + end for line, end in zip(lines, ends, strict=False))
    variants = [
        mixed.encode(),
        MINIMAL.replace("\n", "\r").encode(),
        MINIMAL.replace("    ", "\t").replace(" 0", "\t\t0").encode(),
        b"\xef\xbb\xbf" + MINIMAL.encode(),
        MINIMAL.replace("\n{", " {").encode(),
        MINIMAL.rstrip().encode(),
        re.sub("HIERARCHY|ROOT|OFFSET|Xposition|Frame Time", lambda m: m[0].lower(), MINIMAL)
        .replace("End Site", "End site")
        .encode(),
    ]
    for variant in variants:
        motion = read_bvh(written(tmp_path, variant))
        np.testing.assert_array_equal(motion.positions, expected)


def test_names_keep_blanks_and_letters_of_any_script(tmp_path: Path) -> None:
    for name, encoding in (("Bip01 L Thigh", "utf-8"), ("膝", "utf-8"), ("Hüfte", "latin-1")):
        text = MINIMAL.replace("Knee", name).encode(encoding)
        assert read_bvh(written(tmp_path, text)).skeleton.joint_names[1] == name


@pytest.mark.parametrize(
    ("frame_time", "fps"),
    [
        ("0.0333333", 30),
        (".0083333", 120),
        ("0.00833", 120),
        ("0.016667", 60),
        ("0.041708", 1 / 0.041708),  # 23.976 frames per second, not 24
        ("0.0333667", 1 / 0.0333667),  # 29.97, not 30
        ("0.03", 1 / 0.03),
        (repr(1 / 59.998), 59.998),
        ("1", 1),
        ("0.0001", 10_000),
    ],
)
def test_frame_time_becomes_the_integer_rate_it_rounds(
    tmp_path: Path, frame_time: str, fps: float
) -> None:
    text = MINIMAL.replace("0.0333333", frame_time)
    assert read_bvh(written(tmp_path, text)).fps == pytest.approx(fps, rel=1e-14)


# --- units -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reach", "unit", "factor"),
    [
        (240.0, "centimetres", 0.01),
        (2400.0, "millimetres", 0.001),
        (42.0, "CMU", 0.0254 / 0.45),
        (130.0, "centimetres", 0.01),
    ],
)
def test_unit_is_inferred_from_the_longest_chain_and_announced(
    tmp_path: Path, reach: float, unit: str, factor: float
) -> None:
    text = MINIMAL.replace("OFFSET 0 -1 0", f"OFFSET 0 -{reach} 0")
    with pytest.warns(MotionFileWarning, match=unit) as caught:
        motion = read_motion(written(tmp_path, text))
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    assert "clip.bvh" in str(caught[0].message)
    np.testing.assert_allclose(motion.positions[0, 0], [0, factor, 0])
    np.testing.assert_allclose(motion.rest_offsets[1], [0, -reach * factor, 0])


def test_metres_are_read_as_they_are_without_a_word(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for reach in (0.0, 0.3, 1.0, 2.4, 5.0):
            text = MINIMAL.replace("OFFSET 0 -1 0", f"OFFSET 0 -{reach} 0")
            assert read_motion(written(tmp_path, text)).positions[0, 0, 1] == 1


def test_a_given_scale_is_used_silently(tmp_path: Path) -> None:
    text = MINIMAL.replace("OFFSET 0 -1 0", "OFFSET 0 -240 0")
    assert read_bvh(written(tmp_path, text), scale=0.5).positions[0, 1, 1] == -119.5
    with pytest.raises(ValueError, match="scale is 0"):
        read_bvh(written(tmp_path, text), scale=0)


# --- defects -----------------------------------------------------------------------------------


def defect(old: str, new: str, message: str, line: int) -> Any:
    assert old in MINIMAL
    return pytest.param(MINIMAL.replace(old, new, 1), message, line, id=message[:40])


DEFECTS = [
    defect("Frames: 2", "Frames: 3", "after 2 lines of values, expected 3, the Frames of line", 20),
    defect("Frames: 2", "Frames: 1", "after 2 lines of values, expected 1", 20),
    defect("Frames: 2", "Frames: 0", "Frames must be an integer of at least 1, got '0'", 17),
    defect("Frames: 2", "Frames: -2", "Frames is '-2'", 17),
    defect("Frames: 2\n", "", "came, expected 'Frames: …'", 17),
    defect("Frame Time: 0.0333333\n", "", "came, expected 'Frame Time: …'", 18),
    defect("0.0333333", "0", "Frame Time is 0 s, expected between 0.0001 and 1 seconds", 18),
    defect("0.0333333", "-0.03", "Frame Time is -0.03 s", 18),
    defect("0.0333333", "33.3", "Frame Time is 33.3 s", 18),
    defect("0.0333333", "nan", "'nan' came, expected a number", 18),
    defect("0 1 0 90 0 0 0 0 90", "0 1 0 90 0 0 0 0", "8 values came, expected 9", 20),
    defect("0 1 0 90 0 0 0 0 90", "0 1 0 90 0 0 0 0 90 1", "10 values came, expected 9", 20),
    defect("0 1 0 90", "0 nan 0 90", "'nan' came, expected a number", 20),
    defect("0 1 0 90", "0 inf 0 90", "'inf' came, expected a number", 20),
    defect("0 1 0 90", "0 1e300 0 90", "'1e300' came, expected a number between", 20),
    defect("0 1 0 90", "0 1_0 0 90", "'1_0' came", 20),
    defect("0 1 0 90", "0 ١ 0 90", "'١' came", 20),
    defect("0 1 0 90", "0 1,5 0 90", "'1,5' came", 20),
    defect("OFFSET 0 -1 0", "OFFSET 0 -1", "OFFSET has 2 values, expected 3", 8),
    defect("OFFSET 0 -1 0", "OFFSET 0 -1 zero", "'zero' came, expected a number", 8),
    defect("OFFSET 0 -1 0", "OFFSET 0 -1 nan", "'nan' came, expected a number", 8),
    defect("        OFFSET 0 -1 0\n", "", "'Knee' closes without OFFSET", 13),
    defect("OFFSET 0 -1 0", "OFFSET 0 -1 0\nOFFSET 0 -1 0", "has a second OFFSET", 9),
    defect("CHANNELS 3 Z", "CHANNELS 2 Z", "announces '2' channels and names 3", 9),
    defect("CHANNELS 3 Z", "CHANNELS Z", "CHANNELS announces 'Zrotation'", 9),
    defect("CHANNELS 3 Zrotation", "CHANNELS 3 Wrotation", "channel 'Wrotation' came", 9),
    defect("CHANNELS 3 Zrotation", "CHANNELS 3 Xrotation", "channel 'Xrotation' came", 9),
    defect("            OFFSET 0 -0.5 0\n", "", "'Knee_end' closes without OFFSET", 12),
    defect("OFFSET 0 -0.5 0", "CHANNELS 0", "CHANNELS came inside an End Site", 12),
    defect("OFFSET 0 -0.5 0", "JOINT x", "JOINT came inside an End Site", 12),
    defect("End Site", "End", "'End' came, expected End Site", 10),
    defect("JOINT Knee", "ROOT Knee", "ROOT came inside 'Hips'", 6),
    defect("JOINT Knee", "JOINT", "JOINT has no name", 6),
    defect("JOINT Knee", "JOINT Hips", "joint 'Hips' came before at line 2", 6),
    defect("JOINT Knee", "LIMB Knee", "'LIMB' came, expected ROOT", 6),
    defect("ROOT Hips", "JOINT Hips", "JOINT Hips came outside a joint", 2),
    defect("ROOT Hips\n{", "ROOT Hips", "'OFFSET' came, expected '{'", 3),
    defect("}\nMOTION", "MOTION", "the hierarchy ends inside 'Hips' of line 2", 15),
    defect("}\nMOTION", "}\n}\nMOTION", "'}' came without an open brace", 16),
    defect("HIERARCHY\n", "", "'ROOT Hips' came, expected HIERARCHY", 1),
    defect("MOTION\n", "", "'Frames:' came, expected ROOT", 16),
]


@pytest.mark.parametrize(("text", "message", "line"), DEFECTS)
def test_a_defect_is_one_sentence_with_its_line(
    tmp_path: Path, text: str, message: str, line: int
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(MotionFileError) as caught:
        read_motion(path)
    said = str(caught.value)
    assert message in said
    assert said.startswith(f"{path}, line {line}: ")
    assert "expected" in said
    assert "\n" not in said


def test_motion_before_hierarchy_is_an_error(tmp_path: Path) -> None:
    hierarchy, motion = MINIMAL.split("MOTION\n")
    with pytest.raises(MotionFileError, match="line 1: MOTION came, expected HIERARCHY"):
        read_bvh(written(tmp_path, "MOTION\n" + motion + hierarchy))


def test_every_truncation_is_an_error_until_the_last_number(tmp_path: Path) -> None:
    for length in range(len(MINIMAL) - len(" 90\n") + 1):
        with pytest.raises(MotionFileError, match=r"line \d+"):
            read_bvh(written(tmp_path, MINIMAL[:length]))


def test_empty_missing_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(MotionFileError, match="nothing came, expected HIERARCHY"):
        read_motion(written(tmp_path, ""))
    with pytest.raises(FileNotFoundError):
        read_motion(tmp_path / "none.bvh")
    with pytest.raises(FileNotFoundError):
        read_motion(tmp_path / "none.txt")
    with pytest.raises(MotionFileError, match=r"ends in '\.txt'"):
        read_motion(written(tmp_path, MINIMAL, "clip.txt"))
    (tmp_path / "folder.bvh").mkdir()
    with pytest.raises(MotionFileError, match="cannot be read"):
        read_motion(tmp_path / "folder.bvh")


def test_ten_thousand_frames_read_in_seconds(tmp_path: Path) -> None:
    rows = "0 1 0 12.345678 -98.765432 1 0 0 90\n" * 10_000
    head = MINIMAL[: MINIMAL.index("0 1 0 0 0")].replace("Frames: 2", "Frames: 10000")
    path = written(tmp_path, head + rows)
    begun = time.perf_counter()
    assert read_bvh(path).frames == 10_000
    assert time.perf_counter() - begun < 5
