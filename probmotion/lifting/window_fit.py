"""Fit of the posterior of a window of motion given the keypoints of one or several cameras.

The prior is a mixture of Gaussians, the camera a pinhole camera, and the noise Student-t. For each
probable component and heading, the projection is linearised at the current mean (Gauss-Newton) and
outliers have smaller weights, the expected precisions of the scale mixture. Bones have constant
lengths: |X_j − X_parent| = l_j (1 + δ_j) ± 1 cm with one unknown δ_j for the window. Feet stand or
move (:mod:`~probmotion.lifting.linear_system`). With one camera, depths of joints that a regression
estimates (:mod:`~probmotion.models.unseen_depth.pose_depth`) are further observations, and so is
the height of the floor, estimated in several windows.

Distances to the camera are hardly observed, and the density of all coefficients is largest at a
motion that is too close and too small: closer motions need smaller deviations from the mean. The
mode of the marginal density has no such bias. By Laplace's approximation its logarithm has the
additional term −½ log det H, with the precision H of the coefficients. As a keypoint's information
is proportional to 1/depth², the gradient of this term is its leverage over depth: a force on each
joint away from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from probmotion.lifting.camera import LevelCamera, LevelCameras
from probmotion.lifting.linear_system import (
    Ankles,
    EstimatedDepths,
    LinearKeypoints,
    Solution,
    depth_rows,
    floor_rows,
    linear_system,
)
from probmotion.lifting.window_posterior import (
    TEMPER,
    Height,
    WindowGaussian,
    WindowMode,
    WindowPosterior,
)
from probmotion.lifting.window_prior import WindowPrior

__all__ = ["Observed", "lift_window", "lift_window_views"]

_AGREED = 0.006  # metres; intervals widen where an image and its mirror image disagree more
_FREEDOM = 4.0  # degrees of freedom of the keypoints' noise
_ROUNDS = 6  # of the linearisation
_SCREENED = 40.0  # nats below the best component at which others are left out
_FACTORS = (0.72, 0.85, 1.0, 1.18, 1.39)  # of the first estimate of the distance
_NEAR = 2  # headings of one component that are this close are one candidate
_WIDE = 3.0  # factor of the noise in the first round
_SMALL = 1e-4  # probability of modes that are left out
_INFLATION = (1.7, 2.0)  # of standard deviations, with one camera and with several
_WIDEST = 3.0  # largest further factor where depths disagree: draws should still be people


@dataclass(frozen=True, eq=False)
class Observed:
    """Keypoints of a window in one view, or in V views as a first axis.

    Parameters
    ----------
    points : ndarray, (L, J, 2) or (V, L, J, 2)
        Normalised image coordinates (right, up); 0 where missing.
    weight : ndarray, (L, J) or (V, L, J)
        Multiplier of the precision; 0 where missing.
    noise : float
        Scale of the noise of a keypoint of weight 1, pixels.
    depths : EstimatedDepths, optional
        Of one view.
    floor : Height, optional
        Of the floor in the world of the camera.
    """

    points: np.ndarray
    weight: np.ndarray
    noise: float
    depths: EstimatedDepths | None = None
    floor: Height | None = None


def lift_window(
    prior: WindowPrior,
    camera: LevelCamera,
    seen: Observed,
    middle: np.ndarray,
    depth: np.ndarray,
    *,
    candidates: int = 3,
) -> WindowPosterior:
    """Return the posterior of a window.

    Parameters
    ----------
    prior : WindowPrior
    camera : LevelCamera
    seen : Observed
    middle : ndarray, (L, 2)
        Middle of the body, normalised image coordinates.
    depth : ndarray, (L,)
        First estimate of the body's distance, metres.
    candidates : int
        Number of components and headings that are refined.
    """
    factor, chosen = _screened(prior, camera, seen, middle, depth, candidates)
    path = camera.points(middle, factor * depth)
    return _posterior(prior, camera, seen, path, chosen)


def lift_window_views(
    prior: WindowPrior,
    cameras: LevelCameras,
    seen: Observed,
    path: np.ndarray,
    *,
    candidates: int = 3,
) -> WindowPosterior:
    """Return the posterior of a window given several cameras.

    Parameters
    ----------
    prior : WindowPrior
    cameras : LevelCameras
    seen : Observed
        Keypoints of V views.
    path : ndarray, (L, 3)
        First estimate of the path of the body's middle, metres.
    candidates : int
        Number of components and headings that are refined.
    """
    A = len(prior.yaws)
    scores = []
    for camera, points, weight in zip(cameras.views, seen.points, seen.weight, strict=True):
        middle = camera.project(path)
        filled, joints = _without_gaps(Observed(points, weight, seen.noise), middle)
        if joints:
            metres = filled * camera.depth(path)[:, None, None]
            origin = camera.axes[:2] @ (_below(path) - camera.position)
            turn = np.arctan(middle[:, 0].mean()) - camera.heading
            values = prior.screen(metres - origin, joints, camera.pitch)
            scores.append(np.roll(values, -round(turn / (2 * np.pi / A)), axis=1))
    # The mean: errors of the views due to what the screening neglects are not independent.
    chosen = _distinct(np.mean(scores, axis=0), candidates) if scores else _usual(prior, candidates)
    return _posterior(prior, cameras, seen, path, chosen)


def _posterior(
    prior: WindowPrior,
    camera: LevelCamera | LevelCameras,
    seen: Observed,
    path: np.ndarray,
    chosen: list[tuple[int, int]],
) -> WindowPosterior:
    """Return the posterior with the modes of chosen components and headings."""
    origin = _below(path)
    modes = [_refined(prior, camera, seen, path, origin, k, yaw) for k, yaw in chosen]
    best = max(mode.score for mode in modes)
    kept = [mode for mode in modes if TEMPER * (mode.score - best) > np.log(_SMALL)]
    visible = seen.weight.reshape(-1, *seen.weight.shape[-2:]).max(axis=0) > 0
    return WindowPosterior(prior, origin, tuple(kept), visible)


def _below(path: np.ndarray) -> np.ndarray:
    """Return the point a metre below the mean of a body's middle: about the floor, (3,)."""
    below: np.ndarray = path.mean(axis=0) - [0.0, 1.0, 0.0]
    return below


def _without_gaps(seen: Observed, middle: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Return the keypoints of the window's visible joints without gaps, (L, n, 2), and joints."""
    visible = seen.weight > 0
    joints = np.flatnonzero(visible.any(axis=0)).tolist()
    times = np.arange(len(visible))
    filled = np.repeat(middle[:, None], len(joints), axis=1)
    for column, joint in enumerate(joints):
        rows = np.flatnonzero(visible[:, joint])
        for i in range(2):
            offset = np.interp(times, rows, seen.points[rows, joint, i] - middle[rows, i])
            filled[:, column, i] += median_filter(offset, 5, mode="nearest")
    return filled, joints


def _screened(
    prior: WindowPrior,
    camera: LevelCamera,
    seen: Observed,
    middle: np.ndarray,
    depth: np.ndarray,
    candidates: int,
) -> tuple[float, list[tuple[int, int]]]:
    """Return the best factor of the depth, and probable components with their headings."""
    A = len(prior.yaws)
    filled, joints = _without_gaps(seen, middle)
    if not joints:
        return 1.0, _usual(prior, candidates)
    turn = round(np.arctan(middle[:, 0].mean()) / (2 * np.pi / A))  # heading relative to the ray
    best, factor, scores = -np.inf, 1.0, np.zeros((0, 0))
    for tried in _FACTORS:
        metres = filled * (tried * depth)[:, None, None]
        origin = _below(camera.points(middle, tried * depth))
        # Closer bodies are smaller: the density of pixels needs the Jacobian of metres.
        values = prior.screen(metres - camera.axes[:2] @ origin, joints, camera.pitch)
        values = values + 2 * prior.low * len(joints) * np.log(tried)
        if values.max() > best:
            best, factor, scores = values.max(), tried, values
    return factor, _distinct(np.roll(scores, -turn, axis=1), candidates)


def _usual(prior: WindowPrior, candidates: int) -> list[tuple[int, int]]:
    """Return candidates where nobody is visible: draws continue those of the window before."""
    return [(k, 0) for k in np.argsort(-prior.log_weights)[:candidates].tolist()]


def _distinct(scores: np.ndarray, candidates: int) -> list[tuple[int, int]]:
    """Return the components and headings of the largest scores, (K, A), that are distinct."""
    best, A = scores.max(), scores.shape[1]
    chosen: list[tuple[int, int]] = []
    for index in np.argsort(-scores, axis=None).tolist():
        k, yaw = divmod(index, A)
        if len(chosen) == candidates or scores[k, yaw] < best - _SCREENED:
            break
        gaps = [(yaw - other) % A for part, other in chosen if part == k]
        if all(_NEAR < gap < A - _NEAR for gap in gaps):
            chosen.append((k, yaw))
    return chosen


def _refined(
    prior: WindowPrior,
    camera: LevelCamera | LevelCameras,
    seen: Observed,
    path: np.ndarray,
    origin: np.ndarray,
    k: int,
    yaw: int,
) -> WindowMode:
    """Return the mode of one component and heading."""
    unit = WindowGaussian(prior, k, yaw, 1.0)
    mean = unit.part.mean @ unit.rotation.T
    pose = mean - mean.mean(axis=1, keepdims=True) + path[:, None]
    at = np.repeat(path[:, None], mean.shape[1], axis=1)  # weak perspective at first
    outliers, force = np.full(seen.weight.shape, _WIDE**-2), np.zeros(at.shape)
    scales = [1.0]
    visible = seen.weight > 0
    places = np.nonzero(visible)[-2:]
    ankles, held = Ankles(unit, prior.fps), np.zeros((len(path) - 1, 2))
    rows = depth_rows(unit, seen.depths), floor_rows(unit, seen.floor, float(origin[1]))
    others = np.concatenate([row[0] for row in rows]), np.concatenate([row[1] for row in rows])
    # Densities of depths under different assumptions of sides have different scales.
    known = np.ones(0) if seen.depths is None else seen.depths.sd[np.isfinite(seen.depths.sd)]
    scale_of_depths = np.log(known).sum()
    best: Solution | None = None
    for number in range(_ROUNDS):
        matrix, target = camera.linearised(at, seen.points)
        target = target - matrix @ origin
        weight = seen.weight * outliers * (camera.focal / (seen.noise * camera.depth(at))) ** 2
        keypoints = LinearKeypoints(matrix[visible], target[visible], weight[visible], places)
        system = linear_system(prior, unit, keypoints, (ankles, held), others, pose, force)
        best = None
        for scale in prior.scales.tolist() if number == 1 else scales:
            gaussian = WindowGaussian(prior, k, yaw, scale)
            factor = gaussian.deviation / unit.deviation
            tried = system.solution(factor)
            positions = gaussian.positions(prior, k, tried.mean[None], np.arange(len(at)))[0]
            positions = positions + origin
            square = seen.weight * _squares(camera, seen, positions)
            fit = -0.5 * (_FREEDOM + 2) * np.log1p(square[visible] / _FREEDOM).sum()
            moved = ankles.squares(factor * tried.mean[: len(factor)])
            fit += ankles.log_factor(moved)
            score = float(tried.score + fit + prior.log_weights[k] - scale_of_depths)
            if best is None or score > best.score:
                best = tried._replace(score=score)
                scales, at, pose, standardised = [scale], positions, positions, square
                held = ankles.standing(moved)
        assert best is not None
        outliers = (_FREEDOM + 2) / (_FREEDOM + standardised)
        leverage = np.zeros(visible.shape)
        leverage[visible] = best.leverage
        force = camera.along_depth(leverage / camera.depth(at))
    assert best is not None
    mean_posture = np.flatnonzero((unit.part.frequency == 0) & ~unit.part.ground)
    posture = float(scales[0] * (best.mean[mean_posture] ** 2).mean())
    disagreement = 0.0 if seen.depths is None else seen.depths.disagreement
    inflation = _inflation(seen.points.ndim > 3, posture, disagreement)
    return WindowMode(
        best.score, k, yaw, scales[0], best.mean, best.lower, at, standardised, inflation
    )


def _inflation(several: bool, posture: float, disagreement: float) -> float:
    """Return the factor of the posterior's standard deviations.

    Motion unlike the clips makes them too small: where the mean square ``posture`` of the mean
    posture's standardised coefficients is above 1, and where the regression of depths disagrees
    with itself. Factors and powers were chosen on clips that prior and regression had not seen.
    """
    unusual = min(max(1.0, disagreement / _AGREED) ** 2, _WIDEST)
    return _INFLATION[several] * max(1.0, posture) ** 0.5 * unusual


def _squares(
    camera: LevelCamera | LevelCameras, seen: Observed, positions: np.ndarray
) -> np.ndarray:
    """Return squared residuals in units of the noise, (L, J) or (V, L, J)."""
    focal = np.asarray(camera.focal)[..., None]
    residual = (seen.points - camera.project(positions)) * focal / seen.noise
    square: np.ndarray = (residual**2).sum(axis=-1)
    return square
