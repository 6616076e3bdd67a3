"""GLB files, read back by the specification without the writer's code."""

import io
import json
import shutil
import struct
import subprocess

import numpy as np
import pytest
from PIL import Image

from probmotion import Motion, Skeleton, load, save
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.body_mesh import BodyMesh, Texture, body_mesh
from probmotion.io.glb import write_glb
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.rest_poses import joint_positions

DTYPES = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)));
"""


def walk(skeleton="person14", frames=40):
    motion = make_gait("walk", frames=frames, fps=30.0)
    return motion.retarget(Skeleton.preset(skeleton))


def noisy_walk():
    motion = walk()
    noise = np.random.default_rng(0).normal(scale=0.004, size=motion.positions.shape)
    return Motion(motion.positions + noise, motion.skeleton, motion.fps, name="noisy")


def spinning_walk():
    """A walk that turns by one and a half turns, so that quaternions pass w = 0."""
    motion = walk()
    c, s = np.cos(0.24 * np.arange(40)), np.sin(0.24 * np.arange(40))
    zero, one = np.zeros(40), np.ones(40)
    turns = np.array([[c, zero, s], [zero, one, zero], [-s, zero, c]]).transpose(2, 1, 0)
    return Motion(motion.positions @ turns, motion.skeleton, motion.fps)


def ball_and_person():
    """Two roots; the ball has no bones."""
    motion = walk(frames=5)
    ball = np.random.default_rng(1).normal(size=(5, 1, 3))
    skeleton = Skeleton([*motion.skeleton.joint_names, "ball"], [*motion.skeleton.parents, -1])
    return Motion(np.concatenate([motion.positions, ball], axis=1), skeleton, 60.0)


MOTIONS = {
    "noisy": noisy_walk,
    "spinning": spinning_walk,
    "ball": ball_and_person,
    "one frame": lambda: walk(frames=1),
    "one joint": lambda: Motion(np.ones((3, 1, 3)), Skeleton(["ä"], [-1]), 30.0),
}


class Scene:
    """Content of a GLB file."""

    def __init__(self, path):
        content = path.read_bytes()
        magic, version, length = struct.unpack("<4sII", content[:12])
        assert (magic, version, length) == (b"glTF", 2, len(content))
        chunks, start = {}, 12
        while start < length:
            size, kind = struct.unpack("<I4s", content[start : start + 8])
            assert size % 4 == 0
            chunks[kind] = content[start + 8 : start + 8 + size]
            start += 8 + size
        self.json, self.data = json.loads(chunks[b"JSON"]), chunks[b"BIN\0"]
        assert self.json["buffers"] == [{"byteLength": len(self.data)}]

    def array(self, index):
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        width, dtype = WIDTHS[accessor["type"]], np.dtype(DTYPES[accessor["componentType"]])
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
        end = view["byteOffset"] + view["byteLength"]
        values = np.frombuffer(self.data[view["byteOffset"] : end], dtype).reshape(-1, width)
        if "min" in accessor:
            np.testing.assert_array_equal(values.min(axis=0), np.float32(accessor["min"]))
            np.testing.assert_array_equal(values.max(axis=0), np.float32(accessor["max"]))
        return values

    def image(self, index):
        image = self.json["images"][index]
        assert image["mimeType"] == "image/png"
        view = self.json["bufferViews"][image["bufferView"]]
        end = view["byteOffset"] + view["byteLength"]
        return np.array(Image.open(io.BytesIO(self.data[view["byteOffset"] : end])))

    def mesh(self):
        (primitive,) = self.json["meshes"][0]["primitives"]
        arrays = {name: self.array(at) for name, at in primitive["attributes"].items()}
        return arrays, self.array(primitive["indices"]).reshape(-1, 3)

    def transforms(self):
        """Return the world matrices of all nodes in all frames, (L, nodes, 4, 4)."""
        nodes, (animation,) = self.json["nodes"], self.json["animations"]
        samplers = animation["samplers"]
        (times,) = {sampler["input"] for sampler in samplers}
        local = np.tile(np.eye(4), (len(self.array(times)), len(nodes), 1, 1))
        for at, node in enumerate(nodes):
            local[:, at, :3, 3] = node.get("translation", [0.0, 0.0, 0.0])
        for channel in animation["channels"]:
            values = self.array(samplers[channel["sampler"]]["output"]).astype(float)
            node, path = channel["target"]["node"], channel["target"]["path"]
            if path == "translation":
                local[:, node, :3, 3] = values
            else:
                local[:, node, :3, :3] = matrices(values)
        world, waiting = local.copy(), [(node, None) for node in self.json["scenes"][0]["nodes"]]
        while waiting:
            node, parent = waiting.pop()
            if parent is not None:
                world[:, node] = world[:, parent] @ local[:, node]
            waiting += [(child, node) for child in nodes[node].get("children", [])]
        return world, self.array(times)[:, 0]


def matrices(quaternions):
    """Return rotation matrices of quaternions (x, y, z, w)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


@pytest.mark.parametrize("kind", MOTIONS)
def test_skinned_joints_follow_the_rigid_motion(tmp_path, kind):
    motion = MOTIONS[kind]()
    save(motion, tmp_path / "clip.glb")
    scene, rigid = Scene(tmp_path / "clip.glb"), rigid_motion(motion)
    world, times = scene.transforms()
    (skin,) = scene.json["skins"]
    names = [scene.json["nodes"][joint]["name"] for joint in skin["joints"]]
    assert names == list(rigid.skeleton.joint_names)
    np.testing.assert_allclose(times, np.arange(motion.frames) / motion.fps, rtol=1e-6)
    assert scene.json["animations"][0]["extras"] == {"fps": motion.fps}
    joints = world[:, skin["joints"]]
    np.testing.assert_allclose(joints[..., :3, 3], rigid.positions, atol=1e-5)
    # A skin matrix moves the bind position of its joint to the animated one.
    binds = scene.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    places = np.linalg.inv(binds)[:, :, 3]
    moved = np.einsum("ljab,jbc,jc->lja", joints, binds, places)
    np.testing.assert_allclose(moved[..., :3], rigid.positions, atol=1e-5)


def textured_walk():
    """A rigid motion and a mesh relative to its root: textured capsules above the pelvis."""
    motion = rigid_motion(walk())
    rest = joint_positions(motion.skeleton, motion.rest_offsets)
    mesh = body_mesh(motion.skeleton, rest)
    n = len(mesh.vertices) // 2
    mesh = BodyMesh(*(array[:n] for array in mesh[:2]), mesh.triangles, *(a[:n] for a in mesh[3:5]))
    mesh = mesh._replace(triangles=mesh.triangles[(mesh.triangles < n).all(axis=1)])
    rng = np.random.default_rng(0)
    image = rng.integers(256, size=(16, 8, 3), dtype=np.uint8)
    return motion, mesh._replace(texture=Texture(image, rng.uniform(size=(n, 2))))


def write(kind, path):
    if kind == "textured":
        motion, mesh = textured_walk()
        write_glb(motion, path, mesh)
    else:
        save(MOTIONS[kind](), path)


def test_given_meshes_are_written_with_their_texture(tmp_path):
    motion, mesh = textured_walk()
    write_glb(motion, tmp_path / "clip.glb", mesh)
    scene = Scene(tmp_path / "clip.glb")
    arrays, triangles = scene.mesh()
    np.testing.assert_array_equal(triangles, mesh.triangles)
    for name, values in (
        ("NORMAL", mesh.normals),
        ("JOINTS_0", mesh.joints),
        ("WEIGHTS_0", mesh.weights),
        ("TEXCOORD_0", mesh.texture.coordinates),
    ):
        np.testing.assert_allclose(arrays[name], values, atol=1e-6)
    (material,) = scene.json["materials"]
    surface = material["pbrMetallicRoughness"]
    assert surface.get("baseColorFactor", [1, 1, 1, 1]) == [1, 1, 1, 1]
    texture = scene.json["textures"][surface["baseColorTexture"]["index"]]
    np.testing.assert_array_equal(scene.image(texture["source"]), mesh.texture.image)
    # Without smaller copies of the image, since neighbours in it are not neighbours on the body.
    assert scene.json["samplers"][texture["sampler"]]["minFilter"] in (9728, 9729)
    # The mesh keeps its place relative to the root, below which it stands on the floor.
    binds = scene.array(scene.json["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4)
    root = -binds[motion.skeleton.roots[0], 3, :3]
    np.testing.assert_allclose(arrays["POSITION"], mesh.vertices + root, atol=1e-6)
    assert arrays["POSITION"][:, 1].min() == pytest.approx(0.0, abs=1e-6)
    world, _ = scene.transforms()
    joints = world[:, : motion.skeleton.n_joints, :3, 3]
    np.testing.assert_allclose(joints, motion.positions, atol=1e-5)


def test_capsules_have_the_default_colour(tmp_path):
    save(walk(), tmp_path / "clip.glb")
    scene = Scene(tmp_path / "clip.glb")
    assert "TEXCOORD_0" not in scene.mesh()[0]
    assert "images" not in scene.json
    assert scene.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][0] < 1


def test_meshes_that_do_not_fit_are_errors(tmp_path):
    def with_texture(image, coordinates):
        return mesh._replace(texture=Texture(image, coordinates))

    motion, mesh = textured_walk()
    high, (image, coordinates) = mesh.joints + motion.skeleton.n_joints, mesh.texture
    for one, other, message in (
        (noisy_walk(), mesh, "motion must have rotations"),
        (rigid_motion(ball_and_person()), mesh, "motion must have one root .* got 2"),
        (motion, mesh._replace(joints=high), "joints must be between 0 and"),
        (motion, with_texture(image, 2 + coordinates), "coordinates must be between 0 and 1"),
        (motion, with_texture(image, coordinates[:5]), "coordinates must have shape"),
        (motion, with_texture(image / 255, coordinates), "image must be of uint8, got float64"),
        (motion, with_texture(image[..., 0], coordinates), "image must have shape"),
    ):
        with pytest.raises(ValueError, match=message):
            write_glb(one, tmp_path / "clip.glb", other)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [*MOTIONS, "textured"])
def test_files_satisfy_the_specification(tmp_path, kind):
    write(kind, tmp_path / "clip.glb")
    scene = Scene(tmp_path / "clip.glb")
    arrays, triangles = scene.mesh()
    vertices, normals = arrays["POSITION"].astype(float), arrays["NORMAL"].astype(float)
    joints, weights = arrays["JOINTS_0"], arrays["WEIGHTS_0"]
    (primitive,) = scene.json["meshes"][0]["primitives"]
    assert {"min", "max"} <= set(scene.json["accessors"][primitive["attributes"]["POSITION"]])
    assert vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)  # the bind pose stands on the floor
    assert triangles.max() == len(vertices) - 1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-6)
    assert (weights >= 0).all()
    assert (joints[weights == 0] == 0).all()
    assert joints.max() < len(scene.json["skins"][0]["joints"])
    for used, weight in zip(joints, weights, strict=True):
        assert len({*used[weight > 0]}) == (weight > 0).sum()
    # Triangles are counterclockwise from outside, and normals point outwards.
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    facing = (np.cross(b - a, c - a) * normals[triangles].sum(axis=1)).sum(axis=-1)
    assert (facing > 0).all()
    assert np.einsum("ti,ti->t", a, np.cross(b, c)).sum() > 0  # six times the volume
    samplers = scene.json["animations"][0]["samplers"]
    times = scene.array(samplers[0]["input"])[:, 0]
    assert {"min", "max"} <= set(scene.json["accessors"][samplers[0]["input"]])
    assert (np.diff(times) > 0).all()
    for sampler in samplers:
        values = scene.array(sampler["output"])
        assert len(values) == len(times)
        if values.shape[1] == 4:
            np.testing.assert_allclose(np.linalg.norm(values, axis=-1), 1, atol=1e-6)
            assert ((values[1:] * values[:-1]).sum(axis=-1) > 0).all()


def test_the_body_moves_with_its_bones(tmp_path):
    """Skinned vertices stay within the size of a limb of the bones that move them."""
    motion = walk()
    save(motion, tmp_path / "clip.glb")
    scene = Scene(tmp_path / "clip.glb")
    arrays, _ = scene.mesh()
    world, _ = scene.transforms()
    skin = scene.json["skins"][0]
    binds = scene.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    points = np.concatenate([arrays["POSITION"], np.ones((len(arrays["POSITION"]), 1))], axis=1)
    moves = (world[:, skin["joints"]] @ binds)[:, arrays["JOINTS_0"]]
    moved = np.einsum("lnkab,nk,nb->lna", moves, arrays["WEIGHTS_0"], points)[..., :3]
    joints = world[:, skin["joints"]][..., :3, 3]
    for pose, body in zip(joints, moved, strict=True):
        assert (np.ptp(body, axis=0) < np.ptp(pose, axis=0) + 0.6).all()
        assert body[:, 1].max() > pose[:, 1].max() + 0.15  # the head


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*MOTIONS, "textured"])
def test_khronos_validator_finds_no_issue(tmp_path, kind):
    node = shutil.which("node")
    found = node and subprocess.run(
        [node, "-e", "require.resolve('gltf-validator')"], capture_output=True, check=False
    )
    if not found or found.returncode:
        pytest.skip("node with the package gltf-validator (in NODE_PATH) is not installed")
    write(kind, tmp_path / "clip.glb")
    command = [node, "-e", VALIDATE, str(tmp_path / "clip.glb")]
    issues = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert (issues["numErrors"], issues["numWarnings"], issues["messages"]) == (0, 0, [])


def test_real_clips_are_written(tmp_path, real_data):
    for clip in ("cmu_actions/soccer_1.npz", "cmu_salsa_pairs/cmu_60_61_10.npz"):
        motion = load(real_data / clip)
        motion = motion.window(0, 50)
        save(motion, tmp_path / "clip.glb")
        scene = Scene(tmp_path / "clip.glb")
        world, _ = scene.transforms()
        joints = world[:, : motion.skeleton.n_joints, :3, 3]
        np.testing.assert_allclose(joints, motion.positions, atol=1e-5)
