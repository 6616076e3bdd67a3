"""Writer of binary glTF 2.0 files (GLB): an animated, skinned body.

Source: The Khronos Group, *glTF 2.0 specification* (2021).
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from probmotion.files import written_whole
from probmotion.geometry.rotations import matrix_to_quaternion
from probmotion.io.body_mesh import BodyMesh, Texture, body_mesh
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.motion import Motion
from probmotion.motion.rest_poses import joint_positions
from probmotion.validation import check_finite, check_shape

__all__ = ["write_glb"]

_FLOAT, _SHORT, _INT = 5126, 5123, 5125  # component types
_VERTICES, _INDICES = 34962, 34963  # buffer view targets
_LINEAR, _CLAMP = 9729, 33071  # filter and wrapping of textures
_COMPONENTS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COLOUR = [0.42, 0.53, 0.68, 1.0]


def write_glb(
    motion: Motion,
    path: str | Path,
    mesh: BodyMesh | None = None,
    others: Sequence[Motion] = (),
) -> None:
    """Write a motion to a GLB file, in metres and atomically.

    The file contains a skeleton of rigid bones, an animation with a rotation of every joint and a
    translation of every root, and a body that moves with the skeleton. The bind pose is the rest
    pose, with its feet at height 0. ``extras`` of the animation contain ``fps``. A motion without
    rotations is converted as by :func:`~probmotion.io.bvh_writing.write_bvh`.

    Parameters
    ----------
    motion : Motion
        Motion with J joints.
    path : str or Path
        Name of the file.
    mesh : BodyMesh, optional
        Body in the rest pose of ``motion``, relative to its only root, with joints of ``motion``
        that move each vertex and perhaps a texture; capsules by default.
    others : sequence of Motion
        Further animations of the same body, with rotations, skeleton and rest offsets of
        ``motion``.

    Raises
    ------
    OSError
        If the folder is missing or not writable.
    ValueError
        If a mesh is given for a motion of several roots or without rotations of rigid bones, or an
        array of the mesh has a wrong shape or range, or another motion is not of the same body.

    Warns
    -----
    UserWarning
        If the positions cannot be reproduced by rigid bones.
    """
    given, motion = motion, rigid_motion(motion)
    for number, other in enumerate(others):
        if not _same_body(motion, other):
            raise ValueError(
                "others must have rotations, skeleton and rest offsets of motion, got others for "
                f"others[{number}]"
            )
    skeleton, roots = motion.skeleton, list(motion.skeleton.roots)
    offsets = np.array(motion.rest_offsets)
    offsets[roots] = motion.positions[0, roots] * [1.0, 0.0, 1.0]
    if mesh is None:
        offsets[roots, 1] -= body_mesh(skeleton, _rest(motion, offsets)).vertices[:, 1].min()
        rest = _rest(motion, offsets)
        mesh = body_mesh(skeleton, rest)
    else:
        _check_mesh(mesh, motion)
        if motion is not given:
            raise ValueError(
                "motion must have rotations and rest offsets that reproduce its positions if a "
                "mesh is given, got others; pass rigid_motion(motion) and a mesh of its rest pose"
            )
        offsets[roots, 1] = -mesh.vertices[:, 1].min()
        rest = _rest(motion, offsets)
        mesh = mesh._replace(vertices=mesh.vertices + offsets[roots])
    buffer = _Buffer()
    bind = np.tile(np.eye(4), (skeleton.n_joints, 1, 1))
    bind[:, 3, :3] = -rest  # transposed: glTF stores matrices column by column
    primitive = _primitive(buffer, mesh)
    binds = buffer.add(bind.reshape(-1, 16), _FLOAT)
    animations = [_animation(buffer, each) for each in (motion, *others)]
    nodes: list[dict[str, Any]] = []
    for joint, name in enumerate(skeleton.joint_names):
        node = {"name": name, "translation": offsets[joint].tolist()}
        children = [child for child, parent in skeleton.bones if parent == joint]
        nodes.append({**node, "children": children} if children else node)
    top = len(nodes)
    nodes += [{"name": "skeleton", "children": roots}, {"name": "body", "mesh": 0, "skin": 0}]
    content = {
        "asset": {"version": "2.0", "generator": "probmotion"},
        "scene": 0,
        "scenes": [{"nodes": [top, top + 1]}],
        "nodes": nodes,
        "meshes": [{"name": "body", "primitives": [primitive]}],
        **_materials(buffer, mesh.texture),
        "skins": [{"inverseBindMatrices": binds, "skeleton": top, "joints": list(range(top))}],
        "animations": animations,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    chunks = b"".join(
        struct.pack("<I4s", len(chunk), kind) + chunk
        for kind, chunk in (
            (b"JSON", text + b" " * (-len(text) % 4)),
            (b"BIN\0", bytes(buffer.data)),
        )
    )
    with written_whole(Path(path)) as unfinished:
        unfinished.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


class _Buffer:
    """Binary data with its accessors and views."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add_bytes(self, content: bytes) -> int:
        """Append bytes and return the index of their view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        self.data += content
        self.data += bytes(-len(self.data) % 4)
        return len(self.views) - 1

    def add(
        self, values: np.ndarray, kind: int, target: int | None = None, bounds: bool = False
    ) -> int:
        """Append an array (n, components) and return the index of its accessor."""
        dtype = {_FLOAT: "<f4", _SHORT: "<u2", _INT: "<u4"}[kind]
        array = np.ascontiguousarray(values, dtype=dtype)
        view = self.add_bytes(array.tobytes())
        if target is not None:
            self.views[view]["target"] = target
        accessor = {
            "bufferView": view,
            "componentType": kind,
            "count": len(array),
            "type": _COMPONENTS[array.shape[1]],
        }
        if bounds:
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _rest(motion: Motion, offsets: np.ndarray) -> np.ndarray:
    """Return the joint positions (J, 3) of the rest pose with the roots at their offsets."""
    rest = joint_positions(motion.skeleton, offsets)
    for root in motion.skeleton.roots:
        below = [j for j in range(len(rest)) if j == root or root in motion.skeleton.ancestors(j)]
        rest[below] += offsets[root]
    return rest


def _check_mesh(mesh: BodyMesh, motion: Motion) -> None:
    if len(motion.skeleton.roots) != 1:
        raise ValueError(
            f"motion must have one root if a mesh is given, got {len(motion.skeleton.roots)}"
        )
    n = len(mesh.vertices)
    for name, width in (("vertices", 3), ("normals", 3), ("joints", 4), ("weights", 4)):
        check_shape(name, getattr(mesh, name), (n, width))
        check_finite(name, getattr(mesh, name))
    check_shape("triangles", mesh.triangles, ("T", 3))
    for name, limit in (("triangles", n), ("joints", motion.skeleton.n_joints)):
        low, high = getattr(mesh, name).min(), getattr(mesh, name).max()
        if low < 0 or high >= limit:
            raise ValueError(f"{name} must be between 0 and {limit - 1}, got {low} to {high}")
    if mesh.texture is None:
        return
    image, coordinates = mesh.texture
    check_shape("image", image, ("H", "W", 3))
    if image.dtype != np.uint8:
        raise ValueError(f"image must be of uint8, got {image.dtype}")
    check_shape("coordinates", coordinates, (n, 2))
    if not ((coordinates >= 0) & (coordinates <= 1)).all():
        raise ValueError(
            f"coordinates must be between 0 and 1, got {coordinates.min():.4g} to "
            f"{coordinates.max():.4g}"
        )


def _primitive(buffer: _Buffer, mesh: BodyMesh) -> dict[str, Any]:
    weights = mesh.weights.astype(np.float32)
    weights[:, 0] = 1 - weights[:, 1:].sum(axis=1)
    attributes = {
        "POSITION": buffer.add(mesh.vertices, _FLOAT, _VERTICES, bounds=True),
        "NORMAL": buffer.add(mesh.normals, _FLOAT, _VERTICES),
        "JOINTS_0": buffer.add(mesh.joints, _SHORT, _VERTICES),
        "WEIGHTS_0": buffer.add(weights, _FLOAT, _VERTICES),
    }
    if mesh.texture is not None:
        attributes["TEXCOORD_0"] = buffer.add(mesh.texture.coordinates, _FLOAT, _VERTICES)
    indices = buffer.add(mesh.triangles.reshape(-1, 1), _INT, _INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _materials(buffer: _Buffer, texture: Texture | None) -> dict[str, Any]:
    """Return the body's material and, with a texture, its image, which is stored as PNG."""
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.7}
    materials = [{"name": "body", "pbrMetallicRoughness": surface}]
    if texture is None:
        surface["baseColorFactor"] = _COLOUR
        return {"materials": materials}
    surface["baseColorTexture"] = {"index": 0}
    encoded = io.BytesIO()
    Image.fromarray(texture.image).save(encoded, "png")
    view = buffer.add_bytes(encoded.getvalue())
    # Smaller copies of the image, which viewers use by default, would mix its triangles.
    filters = {"magFilter": _LINEAR, "minFilter": _LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}
    return {
        "materials": materials,
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [filters],
        "images": [{"name": "body", "bufferView": view, "mimeType": "image/png"}],
    }


def _same_body(motion: Motion, other: Motion) -> bool:
    return (
        other.skeleton == motion.skeleton
        and other.rotations is not None
        and other.rest_offsets is not None
        and np.allclose(other.rest_offsets, np.array(motion.rest_offsets), atol=1e-6)
    )


def _animation(buffer: _Buffer, motion: Motion) -> dict[str, Any]:
    quaternions = np.roll(matrix_to_quaternion(motion.rotations), -1, axis=-1)  # x, y, z, w
    # Viewers interpolate between successive quaternions, which must have the same sign.
    agree = (quaternions[1:] * quaternions[:-1]).sum(axis=-1) >= 0
    quaternions[1:] *= np.cumprod(np.where(agree, 1.0, -1.0), axis=0)[..., None]
    times = buffer.add(np.arange(motion.frames)[:, None] / motion.fps, _FLOAT, bounds=True)
    outputs = [
        (joint, "rotation", quaternions[:, joint]) for joint in range(motion.skeleton.n_joints)
    ]
    outputs += [(root, "translation", motion.positions[:, root]) for root in motion.skeleton.roots]
    return {
        "name": motion.name or "motion",
        "extras": {"fps": motion.fps},
        "samplers": [
            {"input": times, "output": buffer.add(values, _FLOAT)} for _, _, values in outputs
        ],
        "channels": [
            {"sampler": index, "target": {"node": node, "path": path}}
            for index, (node, path, _) in enumerate(outputs)
        ],
    }
