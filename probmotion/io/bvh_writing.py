"""Writer of BVH motion files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probmotion.files import written_whole
from probmotion.geometry.rotations import euler_to_matrix, matrix_to_euler
from probmotion.io.bvh_parsing import FRAME_TIMES
from probmotion.motion.kinematics import fit_rotations, forward_kinematics
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["write_bvh"]

_ORDER = "ZYX"  # order of the rotation channels
_DECIMALS = 8  # of offsets and channel values
_TOLERANCE = 1e-6  # metres; larger than the rounding of bone lengths in float32 files, 1e-7 m


def write_bvh(motion: Motion, path: str | Path) -> None:
    """Write a motion to a BVH file, in metres and atomically.

    A motion without rotations is written with rotations fitted to its positions. If rotations and
    constant offsets reproduce all positions to 1e-6 m, joints have rotation channels only.
    Otherwise every joint also has position channels, which replace its offset, as in Blender. Both
    kinds reproduce positions to 1e-6 m when read with ``scale=1``. Joints are written depth first,
    with a ``ROOT`` block for each root.

    Raises
    ------
    ValueError
        If a joint's name contains a blank or a brace, or the rate is not 1 to 10 000 frames per
        second.
    OSError
        If the folder is missing or not writable.
    """
    skeleton = motion.skeleton
    for name in skeleton.joint_names:
        if not name or len(name.split()) != 1 or set(name) & set("{}"):
            raise ValueError(
                f"joint_names must not contain blanks or braces in BVH files, got {name!r}"
            )
    least, most = FRAME_TIMES
    if not least <= 1 / motion.fps <= most:
        raise ValueError(
            f"fps must be {1 / most:g} to {1 / least:g} in BVH files, got {motion.fps:g}"
        )
    angles, offsets, translations = _channels(motion)
    columns = []
    for joint in skeleton.topological_order:
        if joint in translations:
            columns.append(translations[joint])
        columns.append(angles[:, joint])
    values = np.round(np.concatenate(columns, axis=-1), _DECIMALS) + 0.0  # avoids -0.00000000
    row = " ".join([f"%.{_DECIMALS}f"] * values.shape[1])
    lines = ["HIERARCHY", *_hierarchy(skeleton, offsets, set(translations)), "MOTION"]
    lines += [f"Frames: {motion.frames}", f"Frame Time: {1 / motion.fps!r}"]
    lines += [row % tuple(frame) for frame in values.tolist()]
    with written_whole(Path(path)) as unfinished:
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _channels(motion: Motion) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """Return angles (L, J, 3) in degrees, offsets (J, 3) and position channels by joint."""
    skeleton = motion.skeleton
    rotations, offsets = motion.rotations, motion.rest_offsets
    if rotations is None or offsets is None:
        rotations, offsets = fit_rotations(skeleton, motion.positions)
    angles = np.rad2deg(matrix_to_euler(rotations, _ORDER)).round(_DECIMALS)
    # Root offsets are 0, since programs disagree on whether channels replace or add to them.
    offsets = np.round(offsets, _DECIMALS)
    offsets[list(skeleton.roots)] = 0.0
    # Compare with the positions that a reader reconstructs from the rounded angles.
    roots = motion.positions[:, list(skeleton.roots)]
    rounded = euler_to_matrix(np.deg2rad(angles), _ORDER)
    positions, world = forward_kinematics(skeleton, rounded, roots, offsets)
    translations = {root: motion.positions[:, root] for root in skeleton.roots}
    if np.abs(positions - motion.positions).max() > _TOLERANCE:
        for joint, parent in skeleton.bones:
            bone = motion.positions[:, joint] - motion.positions[:, parent]
            translations[joint] = np.einsum("lji,lj->li", world[:, parent], bone)
    return angles, offsets, translations


def _hierarchy(skeleton: Skeleton, offsets: np.ndarray, moving: set[int]) -> list[str]:
    """Return the lines of the hierarchy; ``moving`` joints have position channels."""
    depths: dict[int, int] = {}
    lines: list[str] = []
    open_blocks = 0
    for joint in skeleton.topological_order:
        parent = skeleton.parents[joint]
        depth = depths[joint] = depths[parent] + 1 if parent >= 0 else 0
        lines += ["\t" * level + "}" for level in reversed(range(depth, open_blocks))]
        open_blocks = depth + 1
        outer, inner = "\t" * depth, "\t" * (depth + 1)
        offset = " ".join(f"{value:.{_DECIMALS}f}" for value in offsets[joint] + 0.0)
        channels = "6 Xposition Yposition Zposition" if joint in moving else "3"
        channels += "".join(f" {axis}rotation" for axis in _ORDER)
        lines += [
            f"{outer}{'ROOT' if parent < 0 else 'JOINT'} {skeleton.joint_names[joint]}",
            f"{outer}{{",
            f"{inner}OFFSET {offset}",
            f"{inner}CHANNELS {channels}",
        ]
        if joint not in skeleton.parents:
            lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET 0 0 0", f"{inner}}}"]
    return lines + ["\t" * level + "}" for level in reversed(range(open_blocks))]
