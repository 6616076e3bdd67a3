"""Learning of joint limits from motion capture.

Reproduce the shipped limits from CMU clips in DATA/cmu_single and DATA/cmu_salsa_pairs with

    python -m probmotion.models.pose_pairs.joint_limits_learning --data DATA --out joint_limits.npz
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.files import read_arrays
from probmotion.io.files import load
from probmotion.models.pose_pairs.joint_limits import JointLimits, sphere_rings
from probmotion.models.pose_pairs.joint_limits_frames import closeness_of
from probmotion.models.pose_pairs.joint_limits_kernels import (
    HIP,
    PARTS,
    LimitArrays,
    local_directions,
)  # fmt: skip
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["HELD_OUT", "clips_of_people", "learn_limits", "main"]

HELD_OUT = (
    "cmu_01_07", "cmu_02_05", "cmu_02_09", "cmu_131_02",
    "cmu_60_61_03", "cmu_60_61_07", "cmu_60_61_11",
)  # fmt: skip
"""Clips excluded from the data of the shipped limits, for evaluation."""

_PERSON = Skeleton.preset("person17")
# Minimum left component of the left hip's direction: swapped hips would flip the pelvis frame.
_MIN_LEFT_OF_HIP = 0.1
# Quantile of the spine's tilt that sets its limit; below 1 for robustness to outlier frames.
_TILT_QUANTILE = 0.999


def learn_limits(
    motions: Sequence[Motion | np.ndarray],
    *,
    dilation: float = np.deg2rad(10.0),
    bin_dilation: float = np.deg2rad(20.0),
    bin_rings: int = 6,
    cell_rings: int = 22,
) -> JointLimits:
    """Learn limits that allow the bone directions in ``motions`` and directions close to them.

    Parameters
    ----------
    motions : sequence of Motion or ndarray (L, 17, 3)
        Motions of one person, metres, with the joints of ``person17`` or retargetable to it.
        Their mirror images are added.
    dilation : float
        Maximum angle from an allowed direction to an observed one, radians, in [0, π/2).
    bin_dilation : float
        Maximum angle between parent directions that share observations, radians, in [0, π/2).
    bin_rings, cell_rings : int
        Resolution of the table; see :func:`sphere_rings`.
    """
    for name, angle in (("dilation", dilation), ("bin_dilation", bin_dilation)):
        if not 0 <= angle < np.pi / 2:
            raise ValueError(f"{name} must be at least 0 and below π/2 radians, got {angle!r}")
    poses = _poses(motions)
    rest = _mean_directions(poses, bin_rings, cell_rings)
    local = _local(poses, rest, bin_rings, cell_rings)
    bins, bin_centres = sphere_rings(bin_rings)
    cells, centres = sphere_rings(cell_rings)
    allowed = np.zeros((len(PARTS), len(bin_centres), len(centres)), dtype=bool)
    for part in range(len(PARTS)):
        closeness = closeness_of(
            *_samples(local, part), bins, bin_centres, cells, centres, np.cos(bin_dilation)
        )
        allowed[part] = closeness >= np.cos(dilation)
    allowed[HIP] &= centres[:, 0] > _MIN_LEFT_OF_HIP
    tilts = np.arcsin(np.clip(np.abs(local[:, _PERSON.index("spine"), 1, 0]), 0.0, 1.0))
    tilt = np.quantile(tilts, _TILT_QUANTILE) + dilation
    return JointLimits(
        allowed=_without_empty_rows(allowed, bin_centres),
        rest=rest,
        tilt=round(float(np.clip(tilt, 1e-3, np.pi / 2 - 1e-3)), 4),
        bin_rings=bin_rings,
        cell_rings=cell_rings,
    )


def clips_of_people(path: Path) -> list[np.ndarray]:
    """Return the positions of each person in a clip, (L, 17, 3), without suspect frames."""
    motion = load(path)
    suspect = read_arrays(path).get("suspect")
    usable = np.ones(motion.frames, bool) if suspect is None else ~suspect
    skeleton, people = motion.skeleton, []
    for root in skeleton.roots:
        joints = [j for j in range(skeleton.n_joints) if root in (j, *skeleton.ancestors(j))]
        tree = skeleton.subset(joints)
        names = [name.rpartition(":")[2] for name in tree.joint_names]
        person = Motion(motion.positions[:, joints], Skeleton(names, tree.parents), motion.fps)
        people.append(person.retarget(_PERSON).positions[usable])
    return people


def main(data: Path, out: Path, dilation: float = 10.0, bin_dilation: float = 20.0) -> None:
    """Learn the shipped joint limits and print their rejection rates on held-out clips.

    Parameters
    ----------
    data
        Folder with cmu_single and cmu_salsa_pairs.
    out
        Output file.
    dilation
        Maximum angle between an allowed and an observed direction, degrees.
    bin_dilation
        Maximum angle between parent directions that share observations, degrees.
    """
    singles = sorted((data / "cmu_single").glob("*.npz"))
    pairs = sorted((data / "cmu_salsa_pairs").glob("*.npz"))
    missing = set(HELD_OUT) - {path.stem for path in [*singles, *pairs]}
    if missing:
        raise ValueError(f"data must contain {', '.join(sorted(missing))}, got {data} without them")
    learnt = [path for path in [*singles, *pairs] if path.stem not in HELD_OUT]
    motions = [person for path in learnt for person in clips_of_people(path)]
    provenance: dict[str, Any] = {
        "command": "python -m probmotion.models.pose_pairs.joint_limits_learning",
        "source": "CMU Graphics Lab Motion Capture Database, mocap.cs.cmu.edu",
        "clips": [path.stem for path in learnt],
        "held_out": list(HELD_OUT),
        "poses": sum(map(len, motions)),
        "dilation_degrees": dilation,
        "bin_dilation_degrees": bin_dilation,
    }
    limits = learn_limits(
        motions, dilation=np.deg2rad(dilation), bin_dilation=np.deg2rad(bin_dilation)
    )
    rejected = {}
    for name, paths in (("singles", singles), ("salsa", pairs)):
        held_out = [path for path in paths if path.stem in HELD_OUT]
        poses = np.concatenate([person for path in held_out for person in clips_of_people(path)])
        overall = 1.0 - limits.is_valid(poses).mean()
        rejected[name] = round(float(overall), 5)
        print(f"{name}: {len(poses)} held-out poses, {overall:.2%} of bones rejected")
    provenance["rejected_of_held_out"] = rejected
    replace(limits, provenance=provenance).save(out)
    print(f"{out}: {out.stat().st_size} bytes")


def _poses(motions: Iterable[Motion | np.ndarray]) -> np.ndarray:
    poses = []
    for number, motion in enumerate(motions):
        if isinstance(motion, Motion):
            positions = motion.retarget(_PERSON).positions
        else:
            positions = np.asarray(motion, dtype=np.float64)
            check_shape(f"motions[{number}]", positions, ("L", _PERSON.n_joints, 3))
            check_finite(f"motions[{number}]", positions)
        poses.append(positions)
    if not sum(map(len, poses)):
        raise ValueError("motions must contain at least one frame, got none")
    return np.concatenate(poses)


def _samples(local: np.ndarray, part: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parent and bone directions of a part, (n, 3), on both sides or with mirror images."""
    if PARTS[part] in _PERSON.joint_names:
        middle = local[:, _PERSON.index(PARTS[part])]
        sides = [middle, middle * np.array([-1.0, 1.0, 1.0])]
    else:
        sides = [local[:, _PERSON.index(f"{side}_{PARTS[part]}")] for side in ("left", "right")]
    parents, directions = np.concatenate(sides).swapaxes(0, 1).copy()
    return parents, directions


def _local(poses: np.ndarray, rest: np.ndarray, bin_rings: int, cell_rings: int) -> np.ndarray:
    """Return parent and bone directions of all joints, (n, 17, 2, 3)."""
    bins, bin_centres = sphere_rings(bin_rings)
    cells, centres = sphere_rings(cell_rings)
    all_allowed = np.ones((len(PARTS), len(bin_centres), len(centres)), dtype=bool)
    limits = LimitArrays(all_allowed, bins, cells, centres, rest, 1.0)
    return local_directions(np.ascontiguousarray(poses), limits)


def _mean_directions(poses: np.ndarray, bin_rings: int, cell_rings: int) -> np.ndarray:
    """Return each part's mean direction, in two passes because frames depend on other means."""
    rest = np.tile([0.0, 1.0, 0.0], (len(PARTS), 1))
    for _ in range(2):
        local = _local(poses, rest, bin_rings, cell_rings)
        for part in range(len(PARTS)):
            # Rounding makes the table reproducible across platforms.
            mean = np.round(_samples(local, part)[1].mean(axis=0), 4)
            # NumPy's norm differs in the last bits between processors.
            rest[part] = mean / math.sqrt(math.fsum(value * value for value in mean.tolist()))
    return rest


def _without_empty_rows(allowed: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Return the table with empty bins filled from the nearest non-empty bins."""
    filled = allowed.copy()
    for part, rows in enumerate(allowed):
        known = np.flatnonzero(rows.any(axis=-1))
        for row in np.flatnonzero(~rows.any(axis=-1)):
            closeness = bins[known] @ bins[row]
            # A bin and its mirror image are often equally close.
            nearest = known[closeness > closeness.max() - 1e-9]
            filled[part, row] = rows[nearest].any(axis=0)
    return filled


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
