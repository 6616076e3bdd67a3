"""Reader of BVH motion files.

The world transform of a joint is the matrix product of its parent's world transform, its
translation and its channels' rotations, from left to right in the order listed. Position channels
replace the joint's offset along their axes, as in Blender's importer. BVH specifies no unit or
axes: files are read as Y up, right-handed, and the unit is inferred.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from probmotion.geometry.rotations import euler_to_matrix
from probmotion.io.bvh_parsing import BVHJoint, parse_bvh
from probmotion.io.errors import MotionFileWarning, read_bytes
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["read_bvh"]

_UNITS = {  # metres per unit
    "metres": 1.0,
    "1/0.45 inch, as in conversions of the CMU database": 0.0254 / 0.45,
    "centimetres": 0.01,
    "millimetres": 0.001,
}
# Length of the chain of bones from a foot to a hand of an adult, metres.
_REACH = 2.4


def read_bvh(path: str | Path, scale: float | None = None, end_sites: bool = False) -> Motion:
    """Read a motion from a BVH file.

    Parameters
    ----------
    path : str or Path
        BVH file.
    scale : float, optional
        Metres per unit of the file. Default: the one of metres, centimetres, millimetres and the
        CMU database's 1/0.45 inch for which the longest chain of bones is closest to 2.4 m (foot to
        hand of an adult). A :class:`MotionFileWarning` is issued if it is not metres.
    end_sites : bool
        Whether to include End Sites as joints, named after their parent plus ``_end``.

    Returns
    -------
    motion : Motion
        Motion in metres, joints in the file's order. A frame time rounded from an integer rate is
        read as that rate. Rotations are dropped if a joint other than a root translates relative to
        its parent, and if the file has joints that
        :func:`~probmotion.motion.inverse_kinematics.rigid_motion` added, which are left out.

    Raises
    ------
    MotionFileError
        If the file is truncated, damaged or of another format.
    ValueError
        If ``scale`` is not above 0.
    """
    path = Path(path)
    if scale is not None:
        check_positive("scale", scale)
    content = parse_bvh(read_bytes(path), str(path))
    joints = [joint for joint in content.joints if end_sites or not joint.end_site]
    skeleton = _skeleton(content.joints, joints)
    rotations, translations = _local_transforms(joints, content.values)
    positions = _world_positions(rotations, translations, skeleton)
    if scale is None:
        scale = _inferred_scale(positions, skeleton, path)
    # Rotations and constant offsets reproduce the motion only if no bone translates.
    bones = [joint for joint, _ in skeleton.bones]
    rigid = not np.ptp(translations[:, bones], axis=0).any()
    rest_offsets = translations[0].copy()
    for root in skeleton.roots:
        rest_offsets[root] = joints[root].offset
    kept = [
        joint
        for joint in range(skeleton.n_joints)
        if not _is_part_of_parent(joint, skeleton, translations)
    ]
    if len(kept) < skeleton.n_joints:
        positions, skeleton, rigid = positions[:, kept], skeleton.subset(kept), False
    return Motion(
        positions * scale,
        skeleton,
        content.fps,
        rotations=rotations if rigid else None,
        rest_offsets=rest_offsets * scale if rigid else None,
        name=path.stem,
    )


def _is_part_of_parent(joint: int, skeleton: Skeleton, translations: np.ndarray) -> bool:
    """Return whether a joint was added by ``rigid_motion``, in its parent's place."""
    parent = skeleton.parents[joint]
    if parent < 0 or translations[:, joint].any():
        return False
    return skeleton.joint_names[joint].startswith(f"{skeleton.joint_names[parent]}_to_")


def _skeleton(every: list[BVHJoint], joints: list[BVHJoint]) -> Skeleton:
    """Return the skeleton of ``joints``, whose parents are indices into ``every``."""
    index = {id(joint): i for i, joint in enumerate(joints)}
    parents = [-1 if joint.parent < 0 else index[id(every[joint.parent])] for joint in joints]
    used = {joint.name for joint in joints if not joint.end_site}
    names = []
    for joint in joints:
        name, count = joint.name, 1
        while joint.end_site and name in used:  # second End Site of a joint
            count += 1
            name = f"{joint.name}{count}"
        used.add(name)
        names.append(name)
    return Skeleton(names, parents)


def _local_transforms(joints: list[BVHJoint], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (L, J, 3, 3) and translations (L, J, 3) relative to the parents."""
    rotations = np.tile(np.eye(3), (len(values), len(joints), 1, 1))
    translations = np.tile(np.array([joint.offset for joint in joints]), (len(values), 1, 1))
    column = 0
    for index, joint in enumerate(joints):
        angles = np.zeros((len(values), 3))
        order = ""
        for axis, kind in joint.channels or ():
            if kind == "POSITION":
                translations[:, index, "XYZ".index(axis)] = values[:, column]
            else:
                angles[:, len(order)] = np.deg2rad(values[:, column])
                order += axis
            column += 1
        if order:  # axes without a channel have angle 0
            order += "".join(axis for axis in "XYZ" if axis not in order)
            rotations[:, index] = euler_to_matrix(angles, order)
    return rotations, translations


def _world_positions(
    rotations: np.ndarray, translations: np.ndarray, skeleton: Skeleton
) -> np.ndarray:
    """Return positions (L, J, 3); unlike ``forward_kinematics``, offsets vary over time."""
    world = np.array(rotations)
    positions = np.array(translations)
    for joint in skeleton.topological_order:
        parent = skeleton.parents[joint]
        if parent >= 0:
            offset = world[:, parent] @ translations[:, joint, :, np.newaxis]
            positions[:, joint] = positions[:, parent] + offset[..., 0]
            world[:, joint] = world[:, parent] @ rotations[:, joint]
    return positions


def _inferred_scale(positions: np.ndarray, skeleton: Skeleton, path: Path) -> float:
    """Infer metres per unit from the longest chain of bones; warn unless the result is 1."""
    reach = np.zeros(skeleton.n_joints)  # distance along bones to the farthest descendant
    longest = 0.0
    for joint in reversed(skeleton.topological_order):
        parent = skeleton.parents[joint]
        if parent >= 0:
            bone = np.linalg.norm(positions[:, joint] - positions[:, parent], axis=-1).mean()
            longest = max(longest, reach[parent] + reach[joint] + bone)
            reach[parent] = max(reach[parent], reach[joint] + bone)
    if longest == 0:
        return 1.0
    unit = min(_UNITS, key=lambda name: abs(np.log(longest * _UNITS[name] / _REACH)))
    if _UNITS[unit] != 1:
        warnings.warn(
            f"{path}: assuming {unit} ({_UNITS[unit]:.4g} m per unit) from the longest chain of "
            f"bones, {longest:.3g} units; set it with read_bvh(path, scale=…)",
            MotionFileWarning,
            stacklevel=4,
        )
    return _UNITS[unit]
