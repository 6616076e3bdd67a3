"""World motion from camera-space poses and 2D detections (SPIN-t).

A single-image estimator provides the pose of each frame in the camera's axes, without translation
and with an approximate orientation. Translations and orientations are fitted to detections and
smooth motion (paper 001, appendix F, equation 12; robust function: Geman and McClure 1987).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.motion.motion import KeypointTrack
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["CameraTrajectory", "fit_trajectory", "geman_mcclure"]

_NEAR = 0.1
"""Depth in metres below which 1/z is replaced by its tangent."""
_SCHEDULE = (8.0, 4.0, 2.0, 1.0)
"""Successive multiples of the robust scale. With 1 alone, one-sided outliers trap the optimiser in
the minimum closest to the linear solution."""
_SMALL = 1e-3
"""Squared angle below which Jacobians use series; omitted terms are below 3e-14."""


@dataclass(frozen=True, eq=False)
class CameraTrajectory:
    """Result of :func:`fit_trajectory`.

    Attributes
    ----------
    positions : ndarray, (L, J, 3)
        Joints in the world, metres.
    translations : ndarray, (L, 3)
        Positions r of the local origin in the camera's axes, metres.
    orientations : ndarray, (L, 3)
        Rotation vectors φ applied to the local poses, in the camera's axes, radians.
    cost : float
        Final value of equation 12.
    iterations : int
        Total number of L-BFGS iterations at all scales of ρ.
    converged : bool
        Whether the optimisation at the last scale converged.
    """

    positions: np.ndarray
    translations: np.ndarray
    orientations: np.ndarray
    cost: float
    iterations: int
    converged: bool


def geman_mcclure(square: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ρ = c² e²/(c² + e²) and dρ/d(e²), given e² = ``square`` and c = ``scale``."""
    ratio = scale**2 / (scale**2 + square)
    return ratio * square, ratio**2


def fit_trajectory(
    local: np.ndarray,
    track: KeypointTrack,
    camera: Cameras,
    *,
    scale: float | None = None,
    smoothness_weight: float | None = None,
    max_iterations: int = 1000,
) -> CameraTrajectory:
    """Return the smooth translations r and orientations φ that best explain the detections.

    With v_tj = R(φ_t) local_tj + r_t, camera projection Π and confidences σ, L-BFGS minimises

        Σ_tj σ_tj ρ(‖Π(v_tj) − y_tj‖) + λ Σ_t ‖v_t − v_{t−1}‖².

    The initial values are φ = 0 and the linear solution for r in each frame, interpolated in frames
    where detections do not determine it. The scale of ρ decreases from 8 ``scale`` to ``scale``, so
    that distant outliers do not determine the minimum.

    Parameters
    ----------
    local : ndarray, (L, J, 3)
        Poses relative to the root, metres, in the camera's axes: x right, y down, z forward.
    track : KeypointTrack
        Detections y of these joints in the camera's image units, and their confidences σ. Entries
        with confidence 0 are ignored.
    camera : Cameras
        One static perspective camera.
    scale : float, optional
        Scale c of the Geman-McClure ρ, image units; much larger errors are treated as outliers. The
        default is focal/40, which is 12.5 cm at 5 m.
    smoothness_weight : float, optional
        Weight λ, (image unit)²/m², about (detection error / movement of a joint between frames)².
        The default is (focal/30 m)².
    max_iterations : int
        Maximum L-BFGS iterations at each scale.

    Returns
    -------
    CameraTrajectory
        World positions and the fitted parameters.

    Raises
    ------
    ValueError
        If shapes disagree, the camera is not a single perspective one, no frame determines a
        translation in front of the camera, a fitted joint is behind it, or a number is invalid.
    """
    local = np.asarray(local, dtype=np.float64)
    check_shape("local", local, (track.frames, track.skeleton.n_joints, 3))
    check_finite("local", local)
    if camera.n_views != 1:
        raise ValueError(f"camera must have one view, got {camera.n_views}")
    if camera.orthographic:
        raise ValueError("camera must be perspective, got an orthographic one without depth")
    focal = float(camera.focal[0])
    scale = focal / 40 if scale is None else scale
    check_positive("scale", scale)
    if smoothness_weight is None:
        smoothness_weight = (focal / 30) ** 2
    check_positive("smoothness_weight", smoothness_weight)
    check_count("max_iterations", max_iterations)
    assert camera.centre is not None
    centred = track.keypoints - camera.centre[0]
    detections = np.where(track.confidence[..., None] > 0, centred, 0.0)
    objective = _Objective(local, detections, track.confidence, focal, float(smoothness_weight))
    parameters, cost, iterations, converged = _minimum(objective, scale, max_iterations)
    translations, orientations = np.split(parameters.reshape(-1, 6), 2, axis=1)
    points = objective.points(translations, orientations)
    if points[..., 2].min() <= _NEAR:
        frame, joint = np.argwhere(points[..., 2] <= _NEAR)[0]
        raise ValueError(
            f"track must place joints more than {_NEAR:g} m in front of the camera, got "
            f"{points[frame, joint, 2]:.3g} m for joint {joint} of frame {frame}; check the "
            "camera's focal length and axes"
        )
    positions = (points - camera.translation[0]) @ camera.rotation[0]
    return CameraTrajectory(positions, translations, orientations, cost, iterations, converged)


@dataclass(frozen=True, eq=False)
class _Objective:
    """Equation 12 as a function of (r_t, φ_t), concatenated over frames."""

    local: np.ndarray  # (L, J, 3)
    detections: np.ndarray  # (L, J, 2) relative to the principal point, 0 where missing
    confidence: np.ndarray  # (L, J)
    focal: float
    smoothness_weight: float

    def points(self, translations: np.ndarray, orientations: np.ndarray) -> np.ndarray:
        """Return the joints v in the camera's axes: ``(L, 3), (L, 3) → (L, J, 3)``."""
        rotated = self.local @ np.swapaxes(vector_to_matrix(orientations), -1, -2)
        return rotated + translations[:, None]

    def cost_and_gradient(self, parameters: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
        """Return the value of equation 12 and its gradient, ``(6 L,) → (), (6 L,)``."""
        translations, orientations = np.split(parameters.reshape(-1, 6), 2, axis=1)
        points = self.points(translations, orientations)
        inverse, slope = _inverse_depth(points[..., 2])
        residual = self.focal * points[..., :2] * inverse[..., None] - self.detections
        robust, weight = geman_mcclure((residual**2).sum(axis=-1), scale)
        cost = float((self.confidence * robust).sum())
        pull = (2 * self.focal) * (self.confidence * weight)[..., None] * residual
        by_point = np.empty_like(points)
        by_point[..., :2] = pull * inverse[..., None]
        by_point[..., 2] = (pull * points[..., :2]).sum(axis=-1) * slope
        steps = np.diff(points, axis=0)
        cost += self.smoothness_weight * float((steps**2).sum())
        by_point[1:] += 2 * self.smoothness_weight * steps
        by_point[:-1] -= 2 * self.smoothness_weight * steps
        # A change dφ changes R x by (J dφ) × R x, with the left Jacobian J of the rotation vector.
        torque = np.cross(points - translations[:, None], by_point).sum(axis=1)
        by_orientation = (torque[:, None] @ _left_jacobian(orientations))[:, 0]
        return cost, np.concatenate([by_point.sum(axis=1), by_orientation], axis=1).ravel()


def _inverse_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 1/z, continued linearly below ``_NEAR``, and its derivative by z."""
    safe = np.maximum(depth, _NEAR)
    slope = -1 / safe**2
    return 1 / safe + slope * (depth - safe), slope


def _left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return J = I + (1 − cos θ)/θ² K + (θ − sin θ)/θ³ K² for K x = φ × x and θ = ‖φ‖."""
    square = (vector**2).sum(axis=-1)[:, None, None]
    small = square < _SMALL
    angle = np.sqrt(np.where(small, 1.0, square))
    first = np.where(
        small, 1 / 2 - square / 24 + square**2 / 720, 2 * (np.sin(angle / 2) / angle) ** 2
    )
    second = np.where(
        small, 1 / 6 - square / 120 + square**2 / 5040, (angle - np.sin(angle)) / angle**3
    )
    cross = np.swapaxes(np.cross(vector[:, None], np.eye(3)), -1, -2)
    return np.eye(3) + first * cross + second * (cross @ cross)


def _minimum(
    objective: _Objective, scale: float, max_iterations: int
) -> tuple[np.ndarray, float, int, bool]:
    """Return (r_t, φ_t), cost, iteration count and whether the last optimisation converged."""
    start = _initial_translations(objective)
    parameters = np.concatenate([start, np.zeros_like(start)], axis=1).ravel()
    iterations = 0
    # L-BFGS tolerances are absolute below 1. Division by this unit makes the cost scale-free.
    unit = (objective.focal / 1000) ** 2

    def scaled(parameters: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
        cost, gradient = objective.cost_and_gradient(parameters, scale)
        return cost / unit, gradient / unit

    limits = {"maxiter": max_iterations, "maxfun": 10 * max_iterations}
    for multiple in _SCHEDULE:
        result = minimize(
            scaled,
            parameters,
            args=(multiple * scale,),
            jac=True,
            method="L-BFGS-B",
            options=limits | {"maxcor": 30, "ftol": 1e-10, "gtol": 1e-6},
        )
        parameters, iterations = result.x, iterations + int(result.nit)
    return parameters, unit * float(result.fun), iterations, bool(result.success)


def _initial_translations(objective: _Objective) -> np.ndarray:
    """Return r (L, 3) for φ = 0 by confidence-weighted linear least squares in each frame.

    A detection (u, v) of local joint (X, Y, Z) requires f (X + r_x) = u (Z + r_z) and likewise for
    v. Frames with fewer than two detections or a solution behind the camera are interpolated.
    """
    local, image, focal = objective.local, objective.detections, objective.focal
    L, J, _ = local.shape
    rows = np.zeros((L, J, 2, 3))
    rows[..., 0, 0] = rows[..., 1, 1] = focal
    rows[..., 2] = -image
    right = image * local[..., 2:] - focal * local[..., :2]
    weighted = objective.confidence[..., None, None] * rows
    normal = np.einsum("ljka,ljkb->lab", weighted, rows)
    moment = np.einsum("ljka,ljk->la", weighted, right)
    translations = np.zeros((L, 3))
    usable = (objective.confidence > 0).sum(axis=1) >= 2
    usable[usable] = np.linalg.cond(normal[usable]) < 1e12
    translations[usable] = np.linalg.solve(normal[usable], moment[usable][..., None])[..., 0]
    valid = usable & ((translations[:, None] + local)[..., 2].min(axis=1) > _NEAR)
    if not valid.any():
        raise ValueError(
            f"track must determine a position in front of the camera in at least one of its {L} "
            "frames, from at least two joints of confidence above 0 in the camera's image units"
        )
    known = np.flatnonzero(valid)
    frames = np.arange(L)
    return np.stack([np.interp(frames, known, column) for column in translations[known].T], -1)
