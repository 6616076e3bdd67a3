"""Writer of BVH motion files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probmotion.files import written_whole
from probmotion.geometry.rotations import matrix_to_euler
from probmotion.io.bvh_parsing import FRAME_TIMES
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["write_bvh"]

_ORDER = "ZYX"  # order of the rotation channels
_DECIMALS = 8  # of offsets and channel values


def write_bvh(motion: Motion, path: str | Path) -> None:
    """Write a motion to a BVH file, in metres and atomically.

    Roots have position channels, and all joints have rotation channels in degrees. A motion whose
    rotations do not reproduce its positions to 1e-6 m, or that has none, is written as the result
    of :func:`~probmotion.motion.inverse_kinematics.rigid_motion`, which warns if rigid bones
    do not fit. Joints are written depth first, with a ``ROOT`` block for each root.

    Raises
    ------
    ValueError
        If a joint's name contains a blank or a brace, or the rate is not 1 to 10 000 frames per
        second.
    OSError
        If the folder is missing or not writable.

    Warns
    -----
    UserWarning
        If the positions cannot be reproduced by rigid bones.
    """
    for name in motion.skeleton.joint_names:
        if not name or len(name.split()) != 1 or set(name) & set("{}"):
            raise ValueError(
                f"joint_names must not contain blanks or braces in BVH files, got {name!r}"
            )
    least, most = FRAME_TIMES
    if not least <= 1 / motion.fps <= most:
        raise ValueError(
            f"fps must be {1 / most:g} to {1 / least:g} in BVH files, got {motion.fps:g}"
        )
    motion = rigid_motion(motion)
    skeleton, offsets = motion.skeleton, np.array(motion.rest_offsets)
    # Root offsets are 0, since programs disagree on whether channels replace or add to them.
    offsets[list(skeleton.roots)] = 0.0
    angles = np.unwrap(np.rad2deg(matrix_to_euler(motion.rotations, _ORDER)), period=360.0, axis=0)
    columns = []
    order = _file_order(skeleton)
    for joint in order:
        if skeleton.parents[joint] < 0:
            columns.append(motion.positions[:, joint])
        columns.append(angles[:, joint])
    values = np.round(np.concatenate(columns, axis=-1), _DECIMALS) + 0.0  # avoids -0.00000000
    row = " ".join([f"%.{_DECIMALS}f"] * values.shape[1])
    lines = ["HIERARCHY", *_hierarchy(skeleton, order, np.round(offsets, _DECIMALS)), "MOTION"]
    lines += [f"Frames: {motion.frames}", f"Frame Time: {1 / motion.fps!r}"]
    lines += [row % tuple(frame) for frame in values.tolist()]
    with written_whole(Path(path)) as unfinished:
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")


def _file_order(skeleton: Skeleton) -> list[int]:
    """Return the joints depth first, children by the smallest index below them.

    Joints that ``rigid_motion`` adds come last in a skeleton, but do not change the others' order.
    """
    smallest = list(range(skeleton.n_joints))
    for joint in reversed(skeleton.topological_order):
        parent = skeleton.parents[joint]
        if parent >= 0:
            smallest[parent] = min(smallest[parent], smallest[joint])
    order: list[int] = []
    waiting = sorted(skeleton.roots, key=smallest.__getitem__, reverse=True)
    while waiting:
        order.append(waiting.pop())
        children = [joint for joint, parent in skeleton.bones if parent == order[-1]]
        waiting += sorted(children, key=smallest.__getitem__, reverse=True)
    return order


def _hierarchy(skeleton: Skeleton, order: list[int], offsets: np.ndarray) -> list[str]:
    """Return the lines of the hierarchy."""
    depths: dict[int, int] = {}
    lines: list[str] = []
    open_blocks = 0
    for joint in order:
        parent = skeleton.parents[joint]
        depth = depths[joint] = depths[parent] + 1 if parent >= 0 else 0
        lines += ["\t" * level + "}" for level in reversed(range(depth, open_blocks))]
        open_blocks = depth + 1
        outer, inner = "\t" * depth, "\t" * (depth + 1)
        offset = " ".join(f"{value:.{_DECIMALS}f}" for value in offsets[joint] + 0.0)
        channels = "6 Xposition Yposition Zposition" if parent < 0 else "3"
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
