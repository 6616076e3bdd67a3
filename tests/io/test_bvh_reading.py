"""BVH reading: kinematics against pybvh and by hand, and defects by line."""

import itertools
import re
from contextlib import nullcontext

import numpy as np
import pybvh
import pytest

from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError, MotionFileWarning
from probmotion.io.files import load
from probmotion.motion.skeleton import Skeleton

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


def written(folder, text, name="clip.bvh"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def chain(order, rng):
    """Root and two joints of one rotation order with random offsets and angles, five frames."""
    channels = " ".join(f"{axis}rotation" for axis in order)
    lines = ["HIERARCHY"]
    for joint in ("ROOT a", "JOINT b", "JOINT c"):
        offset = " ".join(map(repr, rng.normal(size=3).tolist()))
        count = "6 Xposition Yposition Zposition" if joint == "ROOT a" else "3"
        lines += [joint, "{", f"OFFSET {offset}", f"CHANNELS {count} {channels}"]
    lines += ["End Site", "{", "OFFSET 0 0.1 0", *"}}}}", "MOTION", "Frames: 5", "Frame Time: 0.04"]
    lines += [" ".join(map(repr, row)) for row in rng.uniform(-180, 180, size=(5, 12)).tolist()]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("order", ["".join(axes) for axes in itertools.permutations("XYZ")])
def test_positions_agree_with_pybvh(tmp_path, order):
    path = written(tmp_path, chain(order, np.random.default_rng(7)))
    positions = read_bvh(path, scale=1.0, end_sites=True).positions
    expected = pybvh.read_bvh_file(path, world_up="+y").node_positions()
    np.testing.assert_allclose(positions, expected, atol=1e-9)


def test_cmu_clip_agrees_with_its_conversion(real_data):
    archive = np.load(real_data / "cmu_single" / "cmu_131_01.npz")
    with pytest.warns(MotionFileWarning, match=r"1/0\.45 inch"):
        motion = read_bvh(real_data / "originals" / "131_01.bvh", end_sites=True)
    assert motion.skeleton == Skeleton(archive["joint_names"].tolist(), archive["parents"].tolist())
    assert motion.fps == 120
    np.testing.assert_allclose(motion.positions[1::4], archive["positions"], atol=1e-6)


def test_position_channels_replace_offsets_axis_by_axis(tmp_path):
    text = MINIMAL.replace(
        "CHANNELS 3 Zrotation Yrotation Xrotation", "CHANNELS 3 Zposition Xrotation Xposition"
    ).replace("0 0 0\n0 1 0 90 0 0 0 0 90", "3 0 2\n0 1 0 90 0 0 0 0 0")
    motion = read_bvh(written(tmp_path, text), scale=1.0)
    np.testing.assert_allclose(motion.positions[0], [[0, 1, 0], [2, 0, 3]], atol=1e-12)
    np.testing.assert_allclose(motion.positions[1], [[0, 1, 0], [1, 1, 0]], atol=1e-12)
    assert motion.rotations is None


def test_joints_with_arbitrary_channels(tmp_path):
    text = (
        MINIMAL.replace("CHANNELS 6 X", "CHANNELS 5 X")
        .replace("Zrotation Yrotation Xrotation\n    JOINT", "Yrotation Zrotation\n    JOINT")
        .replace("CHANNELS 3 Zrotation Yrotation Xrotation", "CHANNELS 0")
        .replace("0 1 0 0 0 0 0 0 0\n0 1 0 90 0 0 0 0 90", "0 1 0 0 0\n0 1 0 90 90")
    )
    motion = read_bvh(written(tmp_path, text), scale=1.0, end_sites=True)
    # R_y(90°) R_z(90°) takes -y to x and then to -z.
    np.testing.assert_allclose(motion.positions[1, 2], [0, 1, -1.5], atol=1e-12)


def test_roots_may_translate(tmp_path):
    ball = "ROOT Ball\n{\nOFFSET 5 0 0\nCHANNELS 1 Yposition\n}\nMOTION"
    text = MINIMAL.replace("MOTION", ball).replace("0 0 90\n", "0 0 90 4\n")
    text = text.replace("0 1 0 0 0 0 0 0 0\n", "0 1 0 0 0 0 0 0 0 3\n")
    motion = read_bvh(written(tmp_path, text), scale=1.0)
    assert motion.skeleton.roots == (0, 2)
    np.testing.assert_allclose(motion.positions[:, 2], [[5, 3, 0], [5, 4, 0]])
    assert motion.rotations is not None


def test_end_sites_are_optional(tmp_path):
    two = MINIMAL.replace(
        "        End Site", "        End Site\n{\nOFFSET 0 0 2\n}\n        End Site named", 1
    )
    path = written(tmp_path, two)
    assert read_bvh(path, scale=1.0).skeleton.joint_names == ("Hips", "Knee")
    named = read_bvh(path, scale=1.0, end_sites=True).skeleton
    assert named == Skeleton(["Hips", "Knee", "Knee_end", "Knee_end2"], [-1, 0, 1, 1])


def test_line_ends_blanks_case_and_encodings(tmp_path):
    expected = read_bvh(written(tmp_path, MINIMAL)).positions
    lines = MINIMAL.split("\n")
    ends = itertools.cycle(["\r\n", "\n", "\r", "\n\n\t \r\n"])
    mixed = "".join(line + end for line, end in zip(lines, ends, strict=False))
    variants = [
        mixed,
        MINIMAL.replace("\n", "\r"),
        MINIMAL.replace("    ", "\t").replace(" 0", "\t\t0").replace("\n{", " {").rstrip(),
        "\ufeff" + MINIMAL,
        re.sub("HIER|ROOT|OFFSET|Xpos|Frame Time|Site", lambda match: match[0].lower(), MINIMAL),
    ]
    for variant in variants:
        np.testing.assert_array_equal(read_bvh(written(tmp_path, variant)).positions, expected)
    for name, encoding in (("Bip01 L 膝", "utf-8"), ("Hüfte", "latin-1")):
        text = MINIMAL.replace("Knee", name).encode(encoding)
        assert read_bvh(written(tmp_path, text)).skeleton.joint_names[1] == name


@pytest.mark.parametrize(
    ("frame_time", "fps"),
    [
        ("0.0333333", 30),
        ("0.00833", 120),
        ("0.041708", 1 / 0.041708),  # 23.976 frames per second, not 24
        ("0.0333667", 1 / 0.0333667),  # 29.97, not 30
        (repr(1 / 59.998), 59.998),
        ("0.0001", 10_000),
    ],
)
def test_rounded_frame_times_become_integer_rates(tmp_path, frame_time, fps):
    text = MINIMAL.replace("0.0333333", frame_time)
    assert read_bvh(written(tmp_path, text)).fps == pytest.approx(fps, rel=1e-14)


@pytest.mark.parametrize(
    ("reach", "unit", "factor"),
    [
        *((reach, "", 1.0) for reach in (0.0, 0.3, 2.4, 5.0)),
        (240.0, "centimetres", 0.01),
        (130.0, "centimetres", 0.01),
        (2400.0, "millimetres", 0.001),
        (42.0, "1/0.45 inch", 0.0254 / 0.45),
    ],
)
def test_unit_is_inferred_with_a_warning_unless_metres(tmp_path, reach, unit, factor):
    path = written(tmp_path, MINIMAL.replace("OFFSET 0 -1 0", f"OFFSET 0 -{reach} 0"))
    warns = pytest.warns(MotionFileWarning, match=rf"clip\.bvh: assuming {unit}")
    with warns if unit else nullcontext():
        motion = load(path)
    np.testing.assert_allclose(motion.positions[0, 0], [0, factor, 0])
    np.testing.assert_allclose(motion.rest_offsets[1], [0, -reach * factor, 0])


def test_scale_overrides_the_inferred_unit(tmp_path):
    path = written(tmp_path, MINIMAL.replace("OFFSET 0 -1 0", "OFFSET 0 -240 0"))
    assert read_bvh(path, scale=0.5).positions[0, 1, 1] == -119.5
    with pytest.raises(ValueError, match="scale must be a finite number above 0, got 0"):
        read_bvh(path, scale=0)


NUMBER, ROW = "expected a number between", "0 1 0 90 0 0 0 0 90"
DEFECTS = [
    ("Frames: 2", "Frames: 3", "expected 3 lines of values, as declared in line 17, got 2", 20),
    ("Frames: 2", "Frames: 1", "expected 1 lines of values, as declared in line 17, got 2", 20),
    ("Frames: 2", "Frames: 0", "Frames must be an integer of at least 1, got '0'", 17),
    ("Frames: 2\n", "", "expected 'Frames: …', got", 17),
    ("Frame Time: 0.0333333\n", "", "expected 'Frame Time: …', got", 18),
    ("0.0333333", "0", "Frame Time must be 0.0001 to 1 seconds, got 0", 18),
    ("0.0333333", "33.3", "seconds, got 33.3", 18),
    (ROW, ROW[:-3], "expected 9 values, one per channel, got 8", 20),
    ("0 1 0 90", "0 nan 0 90", f"{NUMBER} -1e9 and 1e9, got 'nan'", 20),
    ("0 1 0 90", "0 1e300 0 90", NUMBER, 20),
    ("0 1 0 90", "0 1_0 0 90", NUMBER, 20),
    ("0 1 0 90", "0 ١ 0 90", NUMBER, 20),
    ("OFFSET 0 -1 0", "OFFSET 0 -1", "expected 3 values of OFFSET, got 2", 8),
    ("        OFFSET 0 -1 0\n", "", "expected OFFSET in 'Knee', got '}'", 13),
    ("OFFSET 0 -1 0", "OFFSET 0 -1 0\nOFFSET 0 -1 0", "one OFFSET of 'Knee', got a", 9),
    ("CHANNELS 3 Z", "CHANNELS 2 Z", "expected '2' channels as declared, got 3", 9),
    ("CHANNELS 3 Zrotation", "CHANNELS 3 Wrotation", "at most once, got 'Wrotation'", 9),
    ("CHANNELS 3 Zrotation", "CHANNELS 3 Xrotation", "at most once, got 'Xrotation'", 9),
    ("            OFFSET 0 -0.5 0\n", "", "expected OFFSET in 'Knee_end'", 12),
    ("OFFSET 0 -0.5 0", "CHANNELS 0", "inside an End Site, got CHANNELS", 12),
    ("OFFSET 0 -0.5 0", "JOINT x", "inside an End Site, got JOINT", 12),
    ("End Site", "End", "expected End Site, got 'End'", 10),
    ("JOINT Knee", "ROOT Knee", "expected ROOT outside braces, got one inside 'Hips'", 6),
    ("JOINT Knee", "JOINT", "expected a name after JOINT", 6),
    ("JOINT Knee", "JOINT Hips", "expected unique names, got 'Hips' again, as in line 2", 6),
    ("JOINT Knee", "LIMB Knee", "a brace or MOTION, got 'LIMB'", 6),
    ("ROOT Hips", "JOINT Hips", "expected ROOT, got JOINT Hips outside a joint", 2),
    ("ROOT Hips\n{", "ROOT Hips", "expected '{', got 'OFFSET'", 3),
    ("}\nMOTION", "MOTION", "expected the closing brace of 'Hips' of line 2", 15),
    ("}\nMOTION", "}\n}\nMOTION", "got '}' without an open brace", 16),
    ("HIERARCHY\n", "", "expected HIERARCHY, got 'ROOT Hips'", 1),
    ("MOTION\n", "", "a brace or MOTION, got 'Frames:'", 16),
]


@pytest.mark.parametrize(("old", "new", "message", "line"), DEFECTS)
def test_defects_are_reported_with_their_line(tmp_path, old, new, message, line):
    path = written(tmp_path, MINIMAL.replace(old, new, 1))
    with pytest.raises(MotionFileError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}, line {line}: ")
    assert message in str(caught.value)


def test_truncated_files_are_refused(tmp_path):
    for length in range(0, len(MINIMAL) - len(" 90\n") + 1, 3):
        with pytest.raises(MotionFileError, match=r"line \d+"):
            read_bvh(written(tmp_path, MINIMAL[:length]))


def test_foreign_files_are_refused(tmp_path):
    (tmp_path / "folder.bvh").mkdir()
    hierarchy, motion = MINIMAL.split("MOTION\n")
    for path, error, message in (
        (written(tmp_path, "", "empty.bvh"), MotionFileError, "expected HIERARCHY"),
        (written(tmp_path, f"MOTION\n{motion}{hierarchy}"), MotionFileError, "line 1: expected H"),
        (tmp_path / "none.bvh", FileNotFoundError, "none.bvh"),
        (tmp_path / "none.txt", FileNotFoundError, "none.txt"),
        (written(tmp_path, MINIMAL, "clip.txt"), MotionFileError, r"got '\.txt'"),
        (tmp_path / "folder.bvh", MotionFileError, "expected a readable motion file"),
    ):
        with pytest.raises(error, match=message):
            load(path)
