"""Learning joint limits from motion, and the command that learns those of the package.

    python -m probmotion.models.pose_pairs.joint_limits_learning --data DATA --out joint_limits.npz

DATA holds CMU's clips of one person in ``cmu_single`` and its salsa pairs in ``cmu_salsa_pairs``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.files import load_motion
from probmotion.models.pose_pairs.joint_limits import JointLimits, sphere_rings
from probmotion.models.pose_pairs.joint_limits_frames import cell_of, closeness_of
from probmotion.models.pose_pairs.joint_limits_kernels import (
    HIP,
    PARTS,
    LimitArrays,
    local_directions,
)
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["HELD_OUT", "clips_of_people", "learn_limits", "main", "rejected_fractions"]

HELD_OUT = (
    "cmu_01_07", "cmu_02_05", "cmu_02_09", "cmu_131_02",
    "cmu_60_61_03", "cmu_60_61_07", "cmu_60_61_11",
)  # fmt: skip
"""Clips that the package's limits are never learnt from: rates and experiments are of these."""

_PERSON = Skeleton.preset("person17")
# The line of the hips must keep its side, or a correction would turn the frame about.
_LEAST_LEFT_OF_HIP = 0.1
# The spine's tilt is one number, which one wrong frame in thousands must not set.
_TILTS_KEPT = 0.999


def learn_limits(
    motions: Sequence[Motion | np.ndarray],
    *,
    dilation: float = np.deg2rad(10.0),
    bin_dilation: float = np.deg2rad(20.0),
    bin_rings: int = 6,
    cell_rings: int = 22,
) -> JointLimits:
    """Return limits that allow what ``motions`` show and what is near it.

    Parameters
    ----------
    motions : sequence of Motion or ndarray (L, 17, 3)
        Motion of one person, metres; joints in the order of ``person17``, or a motion that
        can be retargeted to it. Each counts as its mirror image too.
    dilation : float
        A bone may point up to this angle from where it was seen, radians.
    bin_dilation : float
        A bone's direction also counts for parents up to this angle from the parent it was
        seen with, radians.
    bin_rings, cell_rings : int
        Fineness of the table; see :func:`sphere_rings`.

    Raises
    ------
    ValueError
        If there is no motion or no frame, or an angle is not between 0 and π/2.
    """
    for name, angle in (("dilation", dilation), ("bin_dilation", bin_dilation)):
        if not 0 <= angle < np.pi / 2:
            raise ValueError(f"{name} must be an angle from 0 to below π/2 radians, got {angle!r}")
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
    allowed[HIP] &= centres[:, 0] > _LEAST_LEFT_OF_HIP
    tilts = np.arcsin(np.clip(np.abs(local[:, _PERSON.index("spine"), 1, 0]), 0.0, 1.0))
    tilt = np.quantile(tilts, _TILTS_KEPT) + dilation
    return JointLimits(
        allowed=_without_empty_rows(allowed, bin_centres),
        rest=rest,
        tilt=round(float(np.clip(tilt, 1e-3, np.pi / 2 - 1e-3)), 4),
        bin_rings=bin_rings,
        cell_rings=cell_rings,
    )


def clips_of_people(path: Path) -> list[np.ndarray]:
    """Return the positions of each person in a clip, (L, 17, 3) each, without suspect frames."""
    motion = load_motion(path)
    with np.load(path) as archive:
        kept = ~archive["suspect"] if "suspect" in archive else np.ones(motion.frames, bool)
    skeleton, people = motion.skeleton, []
    for root in skeleton.roots:
        joints = [j for j in range(skeleton.n_joints) if root in (j, *skeleton.ancestors(j))]
        tree = skeleton.subset(joints)
        names = [name.rpartition(":")[2] for name in tree.joint_names]
        person = Motion(motion.positions[:, joints], Skeleton(names, tree.parents), motion.fps)
        people.append(person.retarget(_PERSON).positions[kept])
    return people


def rejected_fractions(limits: JointLimits, poses: np.ndarray) -> dict[str, dict[str, float]]:
    """Return how much of what is real, of what is random and of what is bent backwards is invalid.

    Parameters
    ----------
    limits : JointLimits
        Of ``person17``.
    poses : ndarray, (n, 17, 3)
        Real poses, metres.

    Returns
    -------
    dict
        By bone, the two sides together: ``real`` is the share of these bones that is rejected,
        ``random`` that of directions uniform on the sphere, given these parents; for ankle and
        wrist ``backwards`` is that of bones that bend by over 40° and are turned half about their
        parent.
    """
    valid = limits.is_valid(poses)
    local = _local(poses, limits.rest, limits.bin_rings, limits.cell_rings)
    arrays = limits.arrays
    names = [name.removeprefix("left_") for name in _PERSON.joint_names]
    tilted = float(np.sin(limits.tilt))
    # A direction uniform on the sphere has |left| uniform; turned into the plane it keeps its tilt.
    shares = {"spine": {"real": 1.0 - valid[:, 0].mean(), "random": 1.0 - tilted}}
    for part, name in enumerate(PARTS):
        bones = [j - 1 for j, other in enumerate(names) if other.removeprefix("right_") == name]
        parents, directions = _samples(local, part)
        rows = arrays.allowed[part, [cell_of(parent, arrays.bin_rings) for parent in parents]]
        shares[name] = {
            "real": 1.0 - valid[:, bones].mean(),
            "random": 1.0 - rows.mean(),
        }
        if name in ("ankle", "wrist"):
            parent = limits.rest[part - 1]
            along = directions @ parent
            bent = along < np.cos(np.deg2rad(40.0))
            turned = 2.0 * along[bent, None] * parent - directions[bent]
            cells = [cell_of(direction, arrays.cell_rings) for direction in turned]
            shares[name]["backwards"] = 1.0 - rows[bent][np.arange(len(cells)), cells].mean()
    return {
        name: {kind: float(share) for kind, share in row.items()} for name, row in shares.items()
    }


def main(data: Path, out: Path, dilation: float = 10.0, bin_dilation: float = 20.0) -> None:
    """Learn the package's joint limits and print how often they reject clips they have not seen.

    Parameters
    ----------
    data
        Folder with cmu_single and cmu_salsa_pairs.
    out
        The file to write.
    dilation
        Degrees from what was seen that a bone may point.
    bin_dilation
        Degrees from a parent's direction for which what was seen with it counts.
    """
    singles = sorted((data / "cmu_single").glob("*.npz"))
    pairs = sorted((data / "cmu_salsa_pairs").glob("*.npz"))
    missing = set(HELD_OUT) - {path.stem for path in [*singles, *pairs]}
    if missing:
        raise ValueError(f"data is {data}, which has no {', '.join(sorted(missing))}")
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
        unseen = [path for path in paths if path.stem in HELD_OUT]
        poses = np.concatenate([person for path in unseen for person in clips_of_people(path)])
        overall = 1.0 - limits.is_valid(poses).mean()
        rejected[name] = round(float(overall), 5)
        print(f"{name}: {len(poses)} unseen poses, {overall:.2%} of their bones rejected")
        _print_table(rejected_fractions(limits, poses))
    provenance["rejected_of_held_out"] = rejected
    replace(limits, provenance=provenance).save(out)
    print(f"{out}: {out.stat().st_size} bytes")


def _print_table(shares: Mapping[str, Mapping[str, float]]) -> None:
    columns = ("real", "random", "backwards")
    print("  " + "bone".ljust(10) + "".join(column.rjust(11) for column in columns))
    for name, row in shares.items():
        cells = [f"{row[column]:.1%}" if column in row else "" for column in columns]
        print("  " + name.ljust(10) + "".join(cell.rjust(11) for cell in cells))


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
        raise ValueError("motions has no frame, expected at least one")
    return np.concatenate(poses)


def _samples(local: np.ndarray, part: int) -> tuple[np.ndarray, np.ndarray]:
    """Return parent and bone directions of a part, of both sides or also as in a mirror, (n, 3)."""
    if PARTS[part] in _PERSON.joint_names:
        seen = local[:, _PERSON.index(PARTS[part])]
        both = np.concatenate([seen, seen * np.array([-1.0, 1.0, 1.0])])
    else:
        both = np.concatenate(
            [local[:, _PERSON.index(f"{side}_{PARTS[part]}")] for side in ("left", "right")]
        )
    return np.ascontiguousarray(both[:, 0]), np.ascontiguousarray(both[:, 1])


def _local(poses: np.ndarray, rest: np.ndarray, bin_rings: int, cell_rings: int) -> np.ndarray:
    """Return parent and bone directions of all joints, (n, 17, 2, 3)."""
    bins, bin_centres = sphere_rings(bin_rings)
    cells, centres = sphere_rings(cell_rings)
    anything = np.ones((len(PARTS), len(bin_centres), len(centres)), dtype=bool)
    limits = LimitArrays(anything, bins, cells, centres, rest, 1.0)
    return local_directions(np.ascontiguousarray(poses), limits)


def _mean_directions(poses: np.ndarray, bin_rings: int, cell_rings: int) -> np.ndarray:
    """Return each part's mean direction; first of the bones whose frame needs no other's mean."""
    rest = np.tile([0.0, 1.0, 0.0], (len(PARTS), 1))
    for _ in range(2):
        local = _local(poses, rest, bin_rings, cell_rings)
        for part in range(len(PARTS)):
            # Rounded, so that the last bits of a sum do not reach the table.
            mean = np.round(_samples(local, part)[1].mean(axis=0), 4)
            # Three squares, summed exactly: NumPy's norm ends in other bits on other processors.
            rest[part] = mean / math.sqrt(math.fsum(value * value for value in mean.tolist()))
    return rest


def _without_empty_rows(allowed: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Let a bin in which no parent was seen allow what the bins nearest to it do."""
    filled = allowed.copy()
    for part, rows in enumerate(allowed):
        known = np.flatnonzero(rows.any(axis=-1))
        for row in np.flatnonzero(~rows.any(axis=-1)):
            closeness = bins[known] @ bins[row]
            # Several may be equally near, as a bin and its mirror image are.
            nearest = known[closeness > closeness.max() - 1e-9]
            filled[part, row] = rows[nearest].any(axis=0)
    return filled


if __name__ == "__main__":
    import tyro

    tyro.cli(main)
