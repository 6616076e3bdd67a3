"""What a reconstruction says, and that its files show the body of its prior."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("numba", reason="numba is not installed")
pytest.importorskip("skimage", reason="scikit-image is not installed")
from probmotion.extras import torch
from probmotion.io.files import load
from probmotion.io.glb import write_glb
from probmotion.lifting.checks import Check
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction.moving_surface import rig_motion, skinned_mesh, surface_frames

FLIP = np.array([1.0, -1.0, -1.0])  # from the axes of the camera to those of motions


def shown_vertices(path, number=0):
    """Return the vertices of a GLB file in all frames of an animation as shown, (L, N, 3)."""
    content = path.read_bytes()
    (size,) = struct.unpack("<I", content[12:16])
    scene, data = json.loads(content[20 : 20 + size]), content[28 + size :]

    def array(index):
        accessor = scene["accessors"][index]
        start = scene["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
        values = np.frombuffer(data, dtype, accessor["count"] * width, start)
        return values.reshape(-1, width).astype(float)

    animation, (skin,) = scene["animations"][number], scene["skins"]
    frames = len(array(animation["samplers"][0]["output"]))
    local = np.tile(np.eye(4), (frames, len(scene["nodes"]), 1, 1))
    for at, node in enumerate(scene["nodes"]):
        local[:, at, :3, 3] = node.get("translation", [0, 0, 0])
    for channel in animation["channels"]:
        values = array(animation["samplers"][channel["sampler"]]["output"])
        node, path = channel["target"]["node"], channel["target"]["path"]
        if path == "translation":
            local[:, node, :3, 3] = values
        else:
            vector, w = values[:, None, :3], values[:, 3, None, None]
            cross = np.cross(np.eye(3), vector)
            # Rows are images of the unit vectors.
            turned = np.eye(3) - 2 * w * cross + 2 * np.cross(cross, vector)
            local[:, node, :3, :3] = turned.swapaxes(1, 2)
    world, waiting = {}, [(node, np.eye(4)) for node in scene["scenes"][0]["nodes"]]
    while waiting:
        node, above = waiting.pop()
        world[node] = above @ local[:, node]
        waiting += [(child, world[node]) for child in scene["nodes"][node].get("children", [])]
    binds = array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    moves = np.stack([world[node] @ bind for node, bind in zip(skin["joints"], binds, strict=True)])
    attributes = scene["meshes"][0]["primitives"][0]["attributes"]
    joints = array(attributes["JOINTS_0"]).astype(int)
    blended = np.einsum("vk,vklij->lvij", array(attributes["WEIGHTS_0"]), moves[joints])
    points = array(attributes["POSITION"])
    return np.einsum("lvij,vj->lvi", blended[..., :3, :3], points) + blended[..., :3, 3]


def test_the_file_shows_the_surface_of_the_prior(category, tmp_path):
    rng = np.random.default_rng(1)
    prior = SurfacePrior(category, np.full(category.code.frames, 0.15))
    theta = rng.normal(size=prior.dim)
    motion = rig_motion(prior, theta)
    mesh = skinned_mesh(prior, theta)
    write_glb(motion, tmp_path / "body.glb", mesh)
    shown = shown_vertices(tmp_path / "body.glb")
    vertices = prior.vertices(torch.as_tensor(theta[None]))[0].numpy() * FLIP
    errors = np.linalg.norm(shown - vertices, axis=-1)
    assert errors.max() < 1e-5
    assert np.ptp(vertices, axis=0).max() > 0.03  # it moves
    other, code = theta.copy(), prior.layout.code
    other[code] = rng.normal(size=prior.category.code.dim)
    write_glb(motion, tmp_path / "body.glb", mesh, [rig_motion(prior, other)])
    moved = prior.vertices(torch.as_tensor(other[None]))[0].numpy() * FLIP
    errors = np.linalg.norm(shown_vertices(tmp_path / "body.glb", 1) - moved, axis=-1)
    assert errors.max() < 1e-5
    other[prior.layout.lengths] += 1.0
    with pytest.raises(ValueError, match=r"rest offsets of motion, got others for others\[0\]"):
        write_glb(motion, tmp_path / "body.glb", mesh, [rig_motion(prior, other)])
    for joints, weights in zip(mesh.joints, mesh.weights, strict=True):
        assert len({*joints[weights > 0]}) == (weights > 0).sum()
    np.testing.assert_allclose(surface_frames(prior, theta[None])[0], vertices, atol=1e-12)
    joints = motion.positions[:, : prior.skeleton.n_joints]
    np.testing.assert_allclose(joints, prior.motion(theta), atol=1e-9)


def test_bones_of_a_draw_are_rigid(result):
    motion, names = result.motion(2), result.prior.skeleton.joint_names
    assert motion.skeleton.joint_names[: len(names)] == names
    np.testing.assert_allclose(motion.positions[0, : len(names)], result.joints[2])
    bones = [motion.positions[:, j] - motion.positions[:, p] for j, p in motion.skeleton.bones]
    lengths = np.linalg.norm(bones, axis=-1)
    assert np.ptp(lengths, axis=1).max() < 1e-12
    assert motion.rotations is not None


def test_the_summary_says_what_the_silhouette_leaves_open(result):
    yaw = result.prior.layout.view.start
    draws = np.array(result.draws)
    draws[:, yaw : yaw + 2] = 1.0  # right and towards the camera
    draws[:3, yaw] = -1.0
    changed = replace(result, draws=draws)
    np.testing.assert_allclose(changed.facing, [-45] * 3 + [45] * 9)
    assert changed.summary()[2] == (
        "The draws face right (75 %) or left (25 %), towards the camera."
    )
    draws[0, yaw + 1] = -1.0
    text = replace(result, draws=draws).summary()[2]
    assert text.endswith("towards the camera (92 %) or away from the camera (8 %).")
    assert result.trusted
    assert "explains the image." in result.summary()[0]
    bad = (*result.checks, Check("size", 3.0, 2.0, "the body is too large"))
    distrusted = replace(result, checks=bad)
    assert not distrusted.trusted
    assert distrusted.summary()[0].startswith("Do not trust this reconstruction: the body is too")


def test_the_spread_is_relative_to_the_middle_of_the_body(result):
    draws = np.tile(result.theta, (4, 1))
    assert replace(result, draws=draws).sd.max() < 1e-9
    view = result.prior.layout.view
    draws[:, view.start + 4] += np.arange(4)  # moves the body to the right
    assert replace(result, draws=draws).sd.max() < 1e-9
    relative = result.joints - result.joints.mean(axis=1, keepdims=True)
    squares = ((relative - relative.mean(axis=0)) ** 2).sum(axis=(0, 2))
    np.testing.assert_allclose(result.sd, np.sqrt(squares / (len(relative) - 1)))


def test_the_overlap_counts_known_pixels_only(result):
    observed, size = result.observation, result.observation.size
    with torch.no_grad():
        rows = torch.as_tensor(result.theta[None], dtype=torch.float32)
        covered = result.prior.render(rows, size)[0, ..., 3].numpy() >= 0.5
    left = np.arange(size) < size / 2

    def iou(mask):
        return replace(result, observation=replace(observed, mask=mask)).mask_iou

    assert iou(np.where(covered, 1.0, 0.0)) == 1.0
    half = np.where(covered & ~left, 1.0, 0.0)
    assert iou(half) == pytest.approx(half.sum() / covered.sum())
    assert iou(np.where(left, np.nan, half)) == 1.0


def test_all_files_are_saved(result, tmp_path):
    result.save(tmp_path)
    names = ["body.glb", "reconstruct.html", "reconstruction.npz", "summary.json"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert (tmp_path / "reconstruct.html").stat().st_size < 3e6
    content = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert content["summary"] == result.summary()
    with np.load(tmp_path / "reconstruction.npz", allow_pickle=False) as archive:
        for name in ("theta", "draws", "joints"):
            np.testing.assert_array_equal(archive[name], getattr(result, name))
    motion = load(tmp_path / "reconstruction.npz")
    joints = motion.positions[:, : result.joints.shape[1]]
    # The mode moves as a draw that faces the same side.
    assert np.abs(joints[0] - result.joints).mean(axis=(1, 2)).argmin() >= 3
    # Each animation is of another draw; the first one is the motion in the other file.
    shown, *others = (shown_vertices(tmp_path / "body.glb", number) for number in range(4))
    assert all(np.abs(other - shown).max() > 0.01 for other in others)
    assert np.linalg.norm(shown.mean(axis=1) - joints.mean(axis=1), axis=-1).max() < 0.2
    corners = result.prior.category.surface.triangles.size
    assert shown.shape[1] == corners  # triangles have vertices of their own, for the texture


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"draws": np.zeros((4, 3))}, "draws must have shape"),
        ({"theta": np.zeros(3)}, "theta must have shape"),
        ({"observation": 0.3}, "the prior's tangent"),
    ],
)
def test_disagreeing_parts_are_refused(result, change, message):
    if "observation" in change:
        change = {"observation": replace(result.observation, tangent=np.array([0.3]))}
    with pytest.raises(ValueError, match=message):
        replace(result, **change)


def test_other_suffixes_are_refused(result, tmp_path):
    with pytest.raises(ValueError, match="end in"):
        result.report(tmp_path / "page.txt")
