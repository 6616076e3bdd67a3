"""A motion in the world from a person's poses in one camera and their 2D detections (SPIN-t).

A single-image estimator gives each frame's pose in the camera's axes but not where it is, and its
orientation roughly. Both are found from the detections and from the motion's smoothness (source:
paper 001, appendix F, equation 12; the robust function: Geman and McClure 1987).
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
"""Metres before the camera: nearer, 1/z goes on as its tangent, so that no step divides by 0."""
_WIDER = (8.0, 4.0, 2.0, 1.0)
"""Scales of the robust function one after the other, over the one that is asked for: with the last
alone, outliers that lie to one side hold the motion where the linear equations put it."""
_SMALL = 1e-3
"""Squared angle below which series replace quotients: the terms left out are below 3e-14."""


@dataclass(frozen=True, eq=False)
class CameraTrajectory:
    """What :func:`fit_trajectory` found.

    Attributes
    ----------
    positions : ndarray, (L, J, 3)
        Joints in the world, metres.
    translations : ndarray, (L, 3)
        r: where the local origin is in the camera's axes, metres.
    orientations : ndarray, (L, 3)
        φ: rotation vectors that turn the local poses, in the camera's axes, radians.
    cost : float
        Equation 12 at the end.
    iterations : int
        Of L-BFGS, all scales together.
    converged : bool
        Whether it stopped because nothing changed any more, not because it ran out of iterations.
    """

    positions: np.ndarray
    translations: np.ndarray
    orientations: np.ndarray
    cost: float
    iterations: int
    converged: bool


def geman_mcclure(square: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return ρ = c² e²/(c² + e²) and its derivative by e², given e²; c is ``scale``.

    Near e² for small errors, never above c².
    """
    share = scale**2 / (scale**2 + square)
    return share * square, share**2


def fit_trajectory(
    local: np.ndarray,
    track: KeypointTrack,
    camera: Cameras,
    *,
    scale: float | None = None,
    data_weight: float = 1.0,
    smoothness_weight: float | None = None,
    max_iterations: int = 1000,
) -> CameraTrajectory:
    """Return the translations r and orientations φ that explain the detections smoothly.

    With v_tj = R(φ_t) local_tj + r_t, Π the camera and σ the confidences, L-BFGS minimises

        λ_data Σ_tj σ_tj ρ(‖Π(v_tj) − y_tj‖) + λ_smooth Σ_t ‖v_t − v_{t−1}‖².

    It starts from φ = 0 and the translations that solve the detections' linear equations frame by
    frame (similar triangles); where a frame does not determine them, from those of its neighbours.
    ρ is first as much as 8 times wider than asked for, so that far outliers do not decide which
    minimum is found.

    Parameters
    ----------
    local : ndarray, (L, J, 3)
        Poses relative to the root, metres, in the camera's axes: x right, y down, z forward.
    track : KeypointTrack
        y and σ: the detections of these joints in the camera's image units. Entries of confidence
        0 are not read.
    camera : Cameras
        One perspective camera, still.
    scale : float, optional
        c of Geman and McClure's ρ, image units: errors well above it count as outliers. A
        fortieth of the focal length by default: 12.5 cm at 5 m.
    data_weight : float
        λ_data, per image unit².
    smoothness_weight : float, optional
        λ_smooth, per m². Only λ_smooth/λ_data matters to the result, image units² per m²: about
        (error of a detection / movement of a joint from one frame to the next)². By default
        λ_data (focal/30 m)²: a movement of 15 cm costs what a detection does that is 0.5 % of
        the focal length off. More smooths the depth, which one camera shows poorly, and holds
        back the motion's ends.
    max_iterations : int
        Of L-BFGS, at each scale.

    Returns
    -------
    CameraTrajectory
        World positions and how they were found.

    Raises
    ------
    ValueError
        If shapes disagree, the camera is orthographic or not one, the detections determine no
        place in front of it in any frame, a joint ends behind it, or a number is out of range.
    """
    local = np.asarray(local, dtype=np.float64)
    check_shape("local", local, (track.frames, track.skeleton.n_joints, 3))
    check_finite("local", local)
    _refuse_camera(camera)
    focal = float(camera.focal[0])
    scale = focal / 40 if scale is None else scale
    check_positive("scale", scale)
    check_positive("data_weight", data_weight)
    if smoothness_weight is None:
        smoothness_weight = data_weight * (focal / 30) ** 2
    check_positive("smoothness_weight", smoothness_weight)
    check_count("max_iterations", max_iterations)
    objective = _Objective(
        local, *_detections(track, camera), focal, float(data_weight), float(smoothness_weight)
    )
    found, cost, iterations, converged = _minimum(objective, scale, max_iterations)
    translations, orientations = np.split(found.reshape(-1, 6), 2, axis=1)
    points = objective.points(translations, orientations)
    if points[..., 2].min() <= _NEAR:
        frame, joint = np.argwhere(points[..., 2] <= _NEAR)[0]
        raise ValueError(
            f"track puts joint {joint} of frame {frame} {points[frame, joint, 2]:.3g} m in front "
            f"of the camera, expected more than {_NEAR:g} m; look at its focal length and axes"
        )
    return CameraTrajectory(
        positions=(points - camera.translation[0]) @ camera.rotation[0],
        translations=translations,
        orientations=orientations,
        cost=cost,
        iterations=iterations,
        converged=converged,
    )


@dataclass(frozen=True, eq=False)
class _Objective:
    """Equation 12 as a function of (r_t, φ_t), all frames one after the other."""

    local: np.ndarray  # (L, J, 3)
    detections: np.ndarray  # (L, J, 2) less the principal point, 0 where not seen
    confidence: np.ndarray  # (L, J)
    focal: float
    data_weight: float
    smoothness_weight: float

    def points(self, translations: np.ndarray, orientations: np.ndarray) -> np.ndarray:
        """Return v in the camera's axes: ``(L, 3), (L, 3) → (L, J, 3)``."""
        turned = self.local @ np.swapaxes(vector_to_matrix(orientations), -1, -2)
        return turned + translations[:, None]

    def cost_and_gradient(self, parameters: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
        """Return equation 12 and its gradient, ``(6 L,) → (), (6 L,)``."""
        translations, orientations = np.split(parameters.reshape(-1, 6), 2, axis=1)
        points = self.points(translations, orientations)
        inverse, slope = _inverse_depth(points[..., 2])
        apart = self.focal * points[..., :2] * inverse[..., None] - self.detections
        robust, weight = geman_mcclure((apart**2).sum(axis=-1), scale)
        cost = self.data_weight * float((self.confidence * robust).sum())
        pull = (2 * self.data_weight * self.focal) * (self.confidence * weight)[..., None] * apart
        by_point = np.empty_like(points)
        by_point[..., :2] = pull * inverse[..., None]
        by_point[..., 2] = (pull * points[..., :2]).sum(axis=-1) * slope
        steps = np.diff(points, axis=0)
        cost += self.smoothness_weight * float((steps**2).sum())
        by_point[1:] += 2 * self.smoothness_weight * steps
        by_point[:-1] -= 2 * self.smoothness_weight * steps
        # A turn by dφ moves R x by (J dφ) × R x, J the left Jacobian of the rotation vector.
        torque = np.cross(points - translations[:, None], by_point).sum(axis=1)
        by_orientation = (torque[:, None] @ _left_jacobian(orientations))[:, 0]
        return cost, np.concatenate([by_point.sum(axis=1), by_orientation], axis=1).ravel()


def _inverse_depth(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 1/z and its derivative; nearer than ``_NEAR`` its tangent there."""
    safe = np.maximum(depth, _NEAR)
    slope = -1 / safe**2
    return 1 / safe + slope * (depth - safe), slope


def _left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return J = I + (1 − cos θ)/θ² K + (θ − sin θ)/θ³ K², ``(L, 3) → (L, 3, 3)``."""
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
    """Return (r_t, φ_t), their cost, iterations at all scales, and whether the last converged."""
    start = _initial_translations(objective)
    found = np.concatenate([start, np.zeros_like(start)], axis=1).ravel()
    iterations = 0
    # L-BFGS's tolerances are absolute below 1: the same stop whatever the image unit and weights.
    unit = objective.data_weight * (objective.focal / 1000) ** 2

    def scaled(parameters: np.ndarray, scale: float) -> tuple[float, np.ndarray]:
        cost, gradient = objective.cost_and_gradient(parameters, scale)
        return cost / unit, gradient / unit

    for wider in _WIDER:
        result = minimize(
            scaled,
            found,
            args=(wider * scale,),
            jac=True,
            method="L-BFGS-B",
            options={
                "maxiter": max_iterations,
                "maxfun": 10 * max_iterations,
                "maxcor": 30,
                "ftol": 1e-10,
                "gtol": 1e-6,
            },
        )
        found, iterations = result.x, iterations + int(result.nit)
    return result.x, unit * float(result.fun), iterations, bool(result.success)


def _refuse_camera(camera: Cameras) -> None:
    if camera.n_views != 1:
        raise ValueError(f"camera has {camera.n_views} views, expected one")
    if camera.orthographic:
        raise ValueError(
            "camera is orthographic, which shows the same picture at every depth; expected a "
            "perspective camera"
        )


def _detections(track: KeypointTrack, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return the detections less the principal point, 0 where not seen, and the confidences."""
    assert camera.centre is not None
    centred = track.keypoints - camera.centre[0]
    return np.where(track.confidence[..., None] > 0, centred, 0.0), track.confidence


def _initial_translations(objective: _Objective) -> np.ndarray:
    """Return r of each frame with φ = 0 by linear least squares, weighed by confidence, (L, 3).

    f (X + r_x) = u (Z + r_z), and so with y: two equations in r for each detection. A frame with
    fewer than two seen joints, or whose solution is not in front of the camera, gets a translation
    between its neighbours'.

    Raises
    ------
    ValueError
        If no frame determines its translation.
    """
    local, image, focal = objective.local, objective.detections, objective.focal
    L, J, _ = local.shape
    rows = np.zeros((L, J, 2, 3))
    rows[..., 0, 0] = rows[..., 1, 1] = focal
    rows[..., 2] = -image
    right = image * local[..., 2:] - focal * local[..., :2]
    weighed = objective.confidence[..., None, None] * rows
    normal = np.einsum("ljka,ljkb->lab", weighed, rows)
    pull = np.einsum("ljka,ljk->la", weighed, right)
    found = np.zeros((L, 3))
    enough = (objective.confidence > 0).sum(axis=1) >= 2
    enough[enough] = np.linalg.cond(normal[enough]) < 1e12
    found[enough] = np.linalg.solve(normal[enough], pull[enough][..., None])[..., 0]
    good = enough & ((found[:, None] + local)[..., 2].min(axis=1) > _NEAR)
    if not good.any():
        raise ValueError(
            f"track determines a place in front of the camera in none of its {L} frames, expected "
            "one with at least two joints of confidence above 0, in the camera's image units"
        )
    known = np.flatnonzero(good)
    return np.stack([np.interp(np.arange(L), known, found[known, axis]) for axis in range(3)], -1)
