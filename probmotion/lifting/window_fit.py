"""Fit of the posterior of a window of motion given the keypoints of one or several cameras.

The prior is a mixture of Gaussians, the camera a pinhole camera, and the noise Student-t. For each
probable component and heading, the projection is linearised at the current mean (Gauss-Newton) and
outliers have smaller weights, the expected precisions of the scale mixture. Bones have constant
lengths: |X_j − X_parent| = l_j (1 + δ_j) ± 1 cm with one unknown δ_j for the window. With one
camera, depths of joints that a regression estimates
(:mod:`~probmotion.models.unseen_depth.pose_depth`) are further observations.

Distances to the camera are hardly observed, and the density of all coefficients is largest at a
motion that is too close and too small: closer motions need smaller deviations from the mean. The
mode of the marginal density has no such bias. By Laplace's approximation its logarithm has the
additional term −½ log det H, with the precision H of the coefficients. As a keypoint's information
is proportional to 1/depth², the gradient of this term is its leverage over depth: a force on each
joint away from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.ndimage import median_filter

from probmotion.lifting.camera import LevelCamera, LevelCameras
from probmotion.lifting.keypoints import HIPS, LIMBS
from probmotion.lifting.window_posterior import (
    FLOOR_SPREAD,
    TEMPER,
    WindowGaussian,
    WindowMode,
    WindowPosterior,
)
from probmotion.lifting.window_prior import WindowPrior

__all__ = [
    "AGREED", "PROPORTIONS", "EstimatedDepths", "Observed", "lift_window", "lift_window_views",
]  # fmt: skip

AGREED = 0.006
"""Disagreement on depths of an image and its mirror image above which intervals widen, metres."""
PROPORTIONS = 0.03
"""Relative standard deviation of a bone's length between people."""
_FREEDOM = 4.0  # degrees of freedom of the keypoints' noise
_BONE_NOISE = 0.01  # standard deviation of a bone's length between frames, metres
_ROUNDS = 6  # of the linearisation
_SCREENED = 40.0  # nats below the best component at which others are left out
_FACTORS = (0.72, 0.85, 1.0, 1.18, 1.39)  # of the first estimate of the distance
_NEAR = 2  # headings of one component that are this close are one candidate
_WIDE = 3.0  # factor of the noise in the first round
_SMALL = 1e-4  # probability of modes that are left out
_INFLATION = (1.7, 2.0)  # of standard deviations, with one camera and with several
_WIDEST = 3.0  # largest further factor where depths disagree: draws should still be people


class EstimatedDepths(NamedTuple):
    """Depths of the joints of arms and legs behind the middle of the hips, as a regression says.

    ``values`` and the standard deviations ``sd`` of their errors, infinite where unknown, are
    (L, 12), metres. ``rays`` are the directions of depth, unit vectors (L, 3). ``disagreement`` is
    that of an image and its mirror image, metres.
    """

    values: np.ndarray
    sd: np.ndarray
    rays: np.ndarray
    disagreement: float


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
    """

    points: np.ndarray
    weight: np.ndarray
    noise: float
    depths: EstimatedDepths | None = None


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
    return WindowPosterior(prior, origin, tuple(kept))


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
    depths = _depth_rows(unit, seen.depths)
    # Densities of depths under different assumptions of sides have different scales.
    known = np.ones(0) if seen.depths is None else seen.depths.sd[np.isfinite(seen.depths.sd)]
    scale_of_depths = np.log(known).sum()
    best: _Solution | None = None
    for number in range(_ROUNDS):
        matrix, target = camera.linearised(at, seen.points)
        target = target - matrix @ origin
        weight = seen.weight * outliers * (camera.focal / (seen.noise * camera.depth(at))) ** 2
        keypoints = _Linear(matrix[visible], target[visible], weight[visible], places)
        system = _system(prior, unit, keypoints, depths, pose, force)
        best = None
        for scale in prior.scales.tolist() if number == 1 else scales:
            gaussian = WindowGaussian(prior, k, yaw, scale)
            tried = system.solution(gaussian.deviation / unit.deviation)
            positions = gaussian.positions(prior, k, tried.mean[None], np.arange(len(at)))[0]
            positions = positions + origin
            square = seen.weight * _squares(camera, seen, positions)
            fit = -0.5 * (_FREEDOM + 2) * np.log1p(square[visible] / _FREEDOM).sum()
            score = float(tried.score + fit + prior.log_weights[k] - scale_of_depths)
            if best is None or score > best.score:
                best = tried._replace(score=score)
                scales, at, pose, standardised = [scale], positions, positions, square
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
    unusual = min(max(1.0, disagreement / AGREED) ** 2, _WIDEST)
    return _INFLATION[several] * max(1.0, posture) ** 0.5 * unusual


class _Linear(NamedTuple):
    """Keypoints A X = t of n positions X about the origin, and precisions of the two sides.

    ``matrix`` is (n, 2, 3), ``target`` (n, 2), ``weight`` (n,), ``places`` their frames and joints.
    """

    matrix: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    places: tuple[np.ndarray, ...]


class _Solution(NamedTuple):
    """Gaussian posterior of the coefficients, its log mass, and the design of the keypoints."""

    mean: np.ndarray
    lower: np.ndarray
    score: float
    design: np.ndarray

    @property
    def leverage(self) -> np.ndarray:
        """Leverages of the keypoints, (n,)."""
        half = solve_triangular(self.lower, self.design.T, lower=True)
        total: np.ndarray = (half**2).sum(axis=0).reshape(-1, 2).sum(axis=1)
        return total


class _System(NamedTuple):
    """Linear observations of a Gaussian's standard normal coefficients, in units of their noise.

    The first ``rows`` are those of keypoints. ``gram`` is Dᵀ D of the design D, ``pull`` is Dᵀ y
    for the residual y, plus the force.
    """

    design: np.ndarray
    residual: np.ndarray
    gram: np.ndarray
    pull: np.ndarray
    rows: int

    def solution(self, factor: np.ndarray) -> _Solution:
        """Return the posterior with the component's deviations multiplied by a factor, (r,)."""
        n = self.rows
        factors = np.ones(len(self.pull))
        factors[: len(factor)] = factor
        precision = factors[:, None] * self.gram * factors
        precision[np.diag_indices(len(factors))] += 1.0
        lower = np.linalg.cholesky(precision)
        z = solve_triangular(lower, factors * self.pull, lower=True)
        z = solve_triangular(lower, z, lower=True, trans=1)
        off = self.residual[n:] - self.design[n:] @ (factors * z)
        score = -0.5 * (z @ z + off @ off) - np.log(np.diag(lower)).sum()
        return _Solution(z, lower, score, self.design[:n] * factors)


def _depth_rows(
    gaussian: WindowGaussian, depths: EstimatedDepths | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return design (m, r) and residuals (m,) of estimated depths, in units of their noise."""
    part, sd = gaussian.part, gaussian.deviation
    if depths is None:
        return np.zeros((0, len(sd))), np.zeros(0)
    frames, limbs = np.nonzero(np.isfinite(depths.sd))
    rays, spread = (depths.rays @ gaussian.rotation)[frames], depths.sd[frames, limbs]
    joints = np.array(LIMBS)[limbs]
    basis, mean = (
        values[frames, joints] - values[:, HIPS].mean(axis=1)[frames]
        for values in (part.basis, part.mean)
    )
    design = (rays[:, None] @ basis)[:, 0] * sd / spread[:, None]
    residual = (depths.values[frames, limbs] - (mean * rays).sum(axis=-1)) / spread
    return design, residual


def _squares(
    camera: LevelCamera | LevelCameras, seen: Observed, positions: np.ndarray
) -> np.ndarray:
    """Return squared residuals in units of the noise, (L, J) or (V, L, J)."""
    focal = np.asarray(camera.focal)[..., None]
    residual = (seen.points - camera.project(positions)) * focal / seen.noise
    square: np.ndarray = (residual**2).sum(axis=-1)
    return square


def _system(
    prior: WindowPrior,
    gaussian: WindowGaussian,
    keypoints: _Linear,
    depths: tuple[np.ndarray, np.ndarray],
    pose: np.ndarray,
    force: np.ndarray,
) -> _System:
    """Return the system of linear observations, bones about a pose and a force."""
    part, R, sd = gaussian.part, gaussian.rotation, gaussian.deviation
    matrix, target, weight, places = keypoints
    L, J = pose.shape[:2]
    r, bones = len(sd), J - 1
    q, n = r + 1 + bones, 2 * len(weight)
    m = n + L * bones
    root = np.sqrt(weight)[..., None]
    turned = (matrix * root[..., None]) @ R
    design, residual = np.zeros((m + len(depths[1]), q)), np.empty(m + len(depths[1]))
    design[:n, :r] = ((turned @ part.basis[places]) * sd).reshape(n, r)
    design[:n, r] = (matrix[..., 1] * root).ravel() * FLOOR_SPREAD
    residual[:n] = (target * root - (turned @ part.mean[places][..., None])[..., 0]).ravel()
    # Bones, linearised along their current directions.
    along = pose[:, prior.children] - pose[:, prior.parents]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), _BONE_NOISE) @ R
    spread = (part.directions[prior.children] - part.directions[prior.parents]) * sd
    cosines = prior.cosines(np.arange(L))[:, part.frequency] / _BONE_NOISE
    rows = (along.swapaxes(0, 1) @ spread).swapaxes(0, 1) * cosines[:, None]
    design[n:m, :r] = rows.reshape(L * bones, r)
    own = np.arange(L * bones)
    design[n + own, r + 1 + own % bones] = -np.tile(part.bones, L) * PROPORTIONS / _BONE_NOISE
    average = part.mean[:, prior.children] - part.mean[:, prior.parents]
    residual[n:m] = (part.bones - (along * average).sum(axis=-1)).ravel() / _BONE_NOISE
    design[m:, :r], residual[m:] = depths
    pull = design.T @ residual
    pull[:r] += np.tensordot(force @ R, part.basis, axes=3) * sd
    pull[r] += force[..., 1].sum() * FLOOR_SPREAD
    return _System(design, residual, design.T @ design, pull, n)
