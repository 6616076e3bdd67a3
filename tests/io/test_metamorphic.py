"""Rewritten files with the same content give the same motion, or are refused in a sentence."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import motion_files as files
import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.bvh import read_bvh
from probmotion.io.errors import MotionFileError
from probmotion.io.files import load, read_joints, save
from probmotion.io.keypoints.files import read_keypoints
from probmotion.motion.motion import Motion

WALK = make_gait("walk", frames=12)
pytestmark = pytest.mark.filterwarnings("ignore::probmotion.io.errors.MotionFileWarning")
TEXTS = {
    ".bvh": (files.BVH, lambda path: read_bvh(path, scale=1.0, end_sites=True)),
    ".amc": (files.AMC, load),
    ".trc": (files.TRC, read_joints),
    ".json": (files.JSONS[0], lambda path: read_keypoints(path, fps=30)),
    ".csv": (files.TABLE, lambda path: read_keypoints(path, fps=30)),
}


def values_of(result):
    """Return the arrays of a motion, joint track or list of keypoint tracks."""
    if isinstance(result, Motion):
        return [result.positions, np.array(result.fps)]
    if isinstance(result, list):
        return [array for track in result for array in (track.keypoints, track.confidence)]
    return [result.joints, np.array(result.fps)]


def read(folder, ending, content, reader):
    path = folder / f"clip{ending}"
    path.write_bytes(content)
    path.with_suffix(".asf").write_bytes(files.ASF)
    return values_of(reader(path))


def assert_same(one, other):
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("ending", TEXTS)
@pytest.mark.parametrize("end", [b"\r\n", b"\r"])
def test_line_ends_and_marks_do_not_change_content(ending, end, tmp_path):
    content, reader = TEXTS[ending]
    expected = read(tmp_path, ending, content, reader)
    assert_same(read(tmp_path, ending, content.replace(b"\n", end), reader), expected)
    marked = b"\xef\xbb\xbf" + content.replace(b"\n", end)
    assert_same(read(tmp_path, ending, marked, reader), expected)


def test_the_locale_does_not_change_content(tmp_path):
    """Names that are not ASCII are read in a locale without them, with no default encoding."""
    (tmp_path / "clip.bvh").write_bytes(files.BVH.replace(b"Knee", "Genoù".encode()))
    (tmp_path / "clip.csv").write_bytes(files.TABLE.replace(b"snout", "hocico_ñ".encode()))
    program = f"""
from pathlib import Path
from probmotion.io.bvh import read_bvh
from probmotion.io.keypoints.files import read_keypoints
folder = Path({str(tmp_path)!r})
motion = read_bvh(folder / "clip.bvh", scale=1.0)
(first, *_) = read_keypoints(folder / "clip.csv", fps=30)
print(ascii([motion.skeleton.joint_names, motion.positions.sum(), first.skeleton.joint_names]))
"""
    strict = ["-X", "utf8=0", "-X", "warn_default_encoding"]
    strict += ["-W", "error::EncodingWarning:probmotion"]
    variables = os.environ | {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, *strict, "-c", program], env=variables, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "Geno\\xf9" in done.stdout
    assert "hocico_\\xf1" in done.stdout


@pytest.mark.parametrize("ending", [".bvh", ".trc"])
def test_decimal_commas_are_refused(ending, tmp_path):
    content, reader = TEXTS[ending]
    head, end, numbers = content.rpartition(b"MOTION" if ending == ".bvh" else b"Z14")
    with pytest.raises(MotionFileError, match="expected"):
        read(tmp_path, ending, head + end + numbers.replace(b".", b","), reader)


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_joints_in_archives_does_not_matter(seed, tmp_path):
    save(WALK, tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as archive:
        arrays = dict(archive)
    order = np.random.default_rng(seed).permutation(WALK.skeleton.n_joints)
    place = np.argsort(order)
    parents = arrays["parents"][order]
    shuffled = {
        "positions": arrays["positions"][:, order], "fps": arrays["fps"],
        "joint_names": arrays["joint_names"][order],
        "parents": np.where(parents < 0, -1, place[parents]),
    }  # fmt: skip
    np.savez(tmp_path / "shuffled.npz", **shuffled)
    motion = load(tmp_path / "shuffled.npz")
    names = motion.skeleton.joint_names
    for joint, name in enumerate(WALK.skeleton.joint_names):
        np.testing.assert_array_equal(
            motion.positions[:, names.index(name)], WALK.positions[:, joint]
        )
    same = motion.retarget(WALK.skeleton)
    np.testing.assert_allclose(same.positions, WALK.positions, atol=1e-12)


def test_the_order_of_markers_does_not_matter(tmp_path):
    expected = read(tmp_path, ".trc", files.TRC, read_joints)
    rows = [row.split("\t") for row in files.TRC.decode().split("\n")]
    order = np.random.default_rng(0).permutation(len(files.JOINTS))
    for row in range(3, 7):
        first, cells = 2, rows[row][2:]
        cells += [""] * (3 * len(files.JOINTS) - len(cells))
        moved = [cells[3 * joint + axis] for joint in order for axis in range(3)]
        rows[row] = rows[row][:first] + moved
    content = "\n".join("\t".join(row) for row in rows).encode()
    assert_same(read(tmp_path, ".trc", content, read_joints), expected)


def test_the_order_of_annotations_and_keys_does_not_matter(tmp_path):
    reader = TEXTS[".json"][1]
    expected = read(tmp_path, ".json", files.JSONS[0], reader)
    shuffled = {
        key: value[::-1] if key in ("annotations", "images") else value
        for key, value in reversed(files.COCO.items())
    }
    assert_same(read(tmp_path, ".json", json.dumps(shuffled).encode(), reader), expected)


def test_duplicated_frames_are_kept_or_refused(tmp_path):
    lines = files.BVH.split(b"\n")
    twice = files.BVH.replace(b"Frames: 2", b"Frames: 3") + lines[-2] + b"\n"
    motion = TEXTS[".bvh"][1]
    (tmp_path / "clip.bvh").write_bytes(twice)
    positions = motion(tmp_path / "clip.bvh").positions
    np.testing.assert_array_equal(positions[1], positions[2])
    for ending, content in (
        (".bvh", files.BVH + lines[-2] + b"\n"),
        (".amc", files.AMC + files.AMC[files.AMC.index(b"2\nroot") :]),
        (".trc", files.TRC + b"\n" + files.TRC.split(b"\n")[-1]),
        (".csv", files.TABLE + files.TABLE.split(b"\n")[-2] + b"\n"),
        (".json", json.dumps(files.COCO | {"annotations": files.COCO["annotations"] * 2}).encode()),
    ):
        with pytest.raises(MotionFileError):
            read(tmp_path, ending, content, TEXTS[ending][1])


@pytest.mark.parametrize(("unit", "factor"), [("cm", 100), ("mm", 1000), ("in", 1 / 0.0254)])
def test_units_and_axes_give_the_same_motion_or_a_sentence(unit, factor, tmp_path):
    def write(positions, **more):
        arrays = {"joint_names": WALK.skeleton.joint_names, "parents": WALK.skeleton.parents}
        np.savez(tmp_path / "walk.npz", positions=positions, fps=WALK.fps, **arrays, **more)
        return tmp_path / "walk.npz"

    other = write(factor * WALK.positions)
    np.testing.assert_allclose(load(other, unit=unit).positions, WALK.positions, atol=1e-12)
    with pytest.raises(MotionFileError, match=f"pass unit='{unit}'"):
        load(other)
    z_up = WALK.positions[..., [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(load(write(z_up), up="z").positions, WALK.positions, atol=1e-12)
    np.testing.assert_allclose(load(write(z_up, up_axis="z")).positions, WALK.positions, atol=1e-12)
    with pytest.raises(MotionFileError, match="Y must be up"):
        load(write(z_up))


@pytest.mark.parametrize(
    ("ending", "read_one"),
    [(".npz", lambda p: load(p).positions), (".trc", lambda p: read_joints(p).joints)],
)
def test_split_clips_are_the_parts_of_the_clip(ending, read_one, tmp_path):
    save(WALK, tmp_path / f"whole{ending}")
    parts = []
    for start, frames in ((0, 5), (5, 7)):
        save(WALK.window(start, frames), tmp_path / f"part{ending}")
        parts.append(read_one(tmp_path / f"part{ending}"))
    np.testing.assert_array_equal(np.concatenate(parts), read_one(tmp_path / f"whole{ending}"))
