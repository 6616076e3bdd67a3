"""Single-person lifting with joint limits, a baseline (Yin et al. 2018, figure 10).

The energy is minimised for each person of a 2D pair separately, with the seed's bone lengths:

    E = Σ_visible ‖x_j − p_j‖² + w_v ‖X − X̂‖² + w_s Σ ‖α‖²

with the orthographic projection x of the pose X, keypoints p, the nearest valid pose X̂, and joint
angles α relative to the seed. Minimisations over X and updates of X̂ alternate.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from probmotion.interaction.annotations.views import image_axes, pair_frames
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.pose_chart import PoseChart
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["lift_people", "lift_person"]

_STEP = 1e-5  # step of central differences, radians or metres


def lift_people(
    keypoints: np.ndarray,
    visible: np.ndarray,
    seed: np.ndarray,
    skeleton: Skeleton,
    view: np.ndarray,
    *,
    limits: JointLimits | None = None,
    validity_weight: float = 0.01,
    seed_weight: float = 1e-3,
    rounds: int = 4,
) -> np.ndarray:
    """Lift a 2D pair to a 3D pose-pair, each person separately.

    Parameters
    ----------
    keypoints : ndarray, (J, 2)
        2D pair, metres, x right, y up; occluded joints are ignored.
    visible : ndarray of bool, (J,)
        Mask of annotated joints; at least two.
    seed : ndarray, (J, 3)
        Initial pose-pair, metres; determines the bone lengths.
    skeleton : Skeleton
        Skeleton of the J joints; each tree has the joints of ``person17``.
    view : ndarray, (2,)
        View (φ, θ) of the annotation in the local frame, known or estimated.
    limits : JointLimits, optional
        Joint limits; the shipped ones by default.
    validity_weight : float
        Weight w_v of the squared distance to the nearest valid pose.
    seed_weight : float
        Weight w_s of the squared joint angles, m²/rad².
    rounds : int
        Number of minimisations over X, each after an update of X̂.

    Returns
    -------
    positions : ndarray, (J, 3)
        Lifted pose-pair, metres, in the annotation's axes: right, up, towards the viewer. Root
        depths are those of the seed.
    """
    n_joints = skeleton.n_joints
    check_shape("keypoints", keypoints, (n_joints, 2))
    check_shape("visible", visible, (n_joints,))
    check_shape("seed", seed, (n_joints, 3))
    check_shape("view", view, (2,))
    for name, weight in (("validity_weight", validity_weight), ("seed_weight", seed_weight)):
        check_positive(name, weight)
    check_count("rounds", rounds)
    visible = np.asarray(visible, dtype=bool)
    if visible.sum() < 2:
        raise ValueError(f"visible must mark at least 2 joints, got {visible.sum()}")
    keypoints = np.where(visible[:, None], keypoints, 0.0)
    check_finite("keypoints", keypoints)
    limits = JointLimits.shipped() if limits is None else limits
    seed = np.asarray(seed, dtype=np.float64)
    # Express the seed in image axes and align it in the image plane to the visible joints.
    right, up = image_axes(pair_frames(seed[None], skeleton), np.asarray(view)[None])[0, :, 0].T
    rotated = seed @ np.stack([right, up, np.cross(right, up)], axis=-1)
    aligned = align_rigidly(rotated[:, :2], keypoints, visible)
    positions = np.concatenate([aligned, rotated[:, 2:]], axis=-1)
    for root in skeleton.roots:
        joints = [j for j in range(n_joints) if root in (j, *skeleton.ancestors(j))]
        person = skeleton.subset(joints)
        positions[joints], _ = lift_person(
            keypoints[joints],
            visible[joints],
            positions[joints],
            limits.on(person),
            validity_weight=validity_weight,
            seed_weight=seed_weight,
            rounds=rounds,
        )
    return positions


def lift_person(
    keypoints: np.ndarray,
    visible: np.ndarray,
    start: np.ndarray,
    limits: JointLimits,
    *,
    validity_weight: float = 0.01,
    seed_weight: float = 1e-3,
    rounds: int = 4,
    evaluations: int | None = None,
) -> tuple[np.ndarray, float]:
    """Lift the 2D pose of one person from an initial pose.

    Parameters
    ----------
    keypoints : ndarray, (J, 2)
        Metres, x right, y up; finite, also where occluded.
    visible : ndarray of bool, (J,)
        Mask of annotated joints.
    start : ndarray, (J, 3)
        Initial pose in the annotation's axes, metres; determines bone lengths and root depth.
    limits : JointLimits
        Joint limits on the person's skeleton.
    validity_weight, seed_weight, rounds
        As for :func:`lift_people`.
    evaluations : int, optional
        Maximum number of evaluations of the energy per minimisation; unlimited by default, which
        takes thousands if a keypoint is farther away than the limb is long.

    Returns
    -------
    positions : ndarray, (J, 3)
        Pose in the annotation's axes, metres.
    energy : float
        Energy E of the pose, m².
    """
    chart = PoseChart(start, limits.skeleton)
    weights = (validity_weight**0.5, seed_weight**0.5)
    # θ: root rotation (3) and position (3), then two angles and a log length per bone.
    # The root depth and the bone lengths are fixed.
    free = np.delete(np.arange(chart.dim), [5, *range(6 + 2, chart.dim, 3)])

    def pose_at(point: np.ndarray) -> np.ndarray:
        theta = np.zeros((*point.shape[:-1], chart.dim))
        theta[..., free] = point
        return chart.positions(theta)

    def residuals(point: np.ndarray, valid: np.ndarray) -> np.ndarray:
        pose = pose_at(point)
        difference = (pose[..., :2] - keypoints)[..., visible, :]
        parts = (difference, weights[0] * (pose - valid), weights[1] * point[..., 5:])
        return np.concatenate([p.reshape(*point.shape[:-1], -1) for p in parts], axis=-1)

    def slopes(point: np.ndarray, valid: np.ndarray) -> np.ndarray:
        steps = _STEP * np.eye(len(point))
        return ((residuals(point + steps, valid) - residuals(point - steps, valid)) / (2 * _STEP)).T

    point = np.zeros(len(free))
    for _ in range(rounds):
        valid = limits.nearest_valid(pose_at(point))
        solution = least_squares(
            residuals,
            point,
            slopes,
            method="lm",
            xtol=1e-9,
            ftol=1e-9,
            max_nfev=evaluations,
            args=(valid,),
        )
        point = solution.x
    return pose_at(point), 2 * float(solution.cost)
