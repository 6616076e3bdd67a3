"""Lifting of one camera's keypoints to 3D motion, window by window."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.checks import (
    MEDIAN,
    Check,
    Evidence,
    check_upright,
    checked,
    proportions,
    uncertain,
)
from probmotion.lifting.keypoints import (
    LIMBS,
    BodyPath,
    PersonKeypoints,
    averaged,
    body_path,
    smooth_size,
)
from probmotion.lifting.linear_system import EstimatedDepths
from probmotion.lifting.window_fit import Observed, lift_window
from probmotion.lifting.window_posterior import Height, WindowPosterior
from probmotion.lifting.window_prior import WindowPrior
from probmotion.lifting.windows import cut, stitched
from probmotion.models.unseen_depth.pose_depth import DepthEstimate, PoseDepth
from probmotion.posteriors.sampling import progress_bar
from probmotion.threads import one_thread

__all__ = ["TrackLift", "lift_track"]

_PITCH_ERROR = np.radians(3.5)  # standard deviation of the network's pitch
_DEPENDENT = 1.4  # factor of the estimated depths' sd: frames' errors are correlated
_CANDIDATES = 5  # of a window whose noise, score and floor are estimated
_TRIED = 3  # windows on which they are estimated
_FITTED = 0.8  # share of the residuals that the fit leaves
_UNEVEN = 0.02  # smallest standard deviation of the floor, metres
_STEEP = 2.5  # standard deviations; floors that rise more are steps or a slope


class _Windows(NamedTuple):
    """Averaged keypoints with their estimated depths, and the windows into which they are cut."""

    keypoints: PersonKeypoints
    path: BodyPath
    depths: DepthEstimate
    prior: WindowPrior
    starts: list[int]
    step: int

    def posterior(
        self,
        start: int,
        camera: LevelCamera,
        noise: float,
        *,
        floor: Height | None = None,
        candidates: int = 3,
    ) -> WindowPosterior:
        """Return the posterior of the window from a frame on."""
        rows = slice(start, start + self.prior.frames)
        points, weight = self.keypoints.points[rows], self.keypoints.weight[rows]
        seen = np.where(weight[..., None] > 0, camera.normalised(points), 0.0)
        depth = camera.focal / smooth_size(self.path.size[rows])
        middle = camera.normalised(self.path.middle[rows])
        # Where a joint is not seen, its depth would be an estimate from the prior's clips alone.
        shown = weight[:, LIMBS] > 0
        spread = np.where(shown, _DEPENDENT * self.depths.spread[rows], np.inf)
        rays = camera.points(middle, np.ones(len(middle))) - camera.position
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        depths = EstimatedDepths(self.depths.depth[rows], spread, rays, self.disagreement(rows))
        observed = Observed(seen, weight, noise, depths, floor)
        return lift_window(self.prior, camera, observed, middle, depth, candidates=candidates)

    def disagreement(self, rows: slice) -> float:
        """Return how far an image and its mirror image disagree on depths, median, metres."""
        shown = self.keypoints.weight[rows][:, LIMBS] > 0
        differences = self.depths.disagreement[rows][shown]
        return float(np.median(differences)) if differences.size else 0.0

    def mirrored(self) -> _Windows:
        """Return the windows with left and right exchanged."""
        exchanged = self.keypoints.mirrored()
        depths = _depths(exchanged, self.path, self.prior.fps)
        return self._replace(keypoints=exchanged, depths=depths)


class TrackLift(NamedTuple):
    """Mean and draws relative to the camera for a person of 1.7 m, and what was estimated.

    ``floor`` is the height of the floor relative to the camera, ``focal_error`` the standard
    deviation of the logarithm of the camera's focal length.
    """

    mean: np.ndarray
    draws: np.ndarray
    floor: float
    camera: LevelCamera
    focal_error: float
    noise: float
    checks: tuple[Check, ...]


def lift_track(
    keypoints: PersonKeypoints,
    fps: float,
    camera: LevelCamera,
    pitch: float | None,
    focal_error: float,
    noise: float | None,
    guess: float,
    *,
    draws: int,
    seed: int,
    progress: bool,
) -> TrackLift:
    """Return what one camera tells about a motion.

    The ``pitch``, radians, and the ``noise``, pixels, are estimated if they are None: the pitch by
    the regression of depths, the noise from a first ``guess``. The floor is level: what windows
    tell about it corrects that pitch, and the focal length, whose logarithm has the standard
    deviation ``focal_error``.
    """
    with one_thread():
        windows = _windows(keypoints, fps)
        check_upright(windows.keypoints, windows.path)
    with one_thread(), progress_bar(len(windows.starts), "lift", progress) as bar:
        with ThreadPoolExecutor(2) as pool:
            estimate, other = pool.map(
                lambda each: _estimated(each, camera, noise or guess, pitch, focal_error),
                (windows, windows.mirrored()),
            )
        level, found = noise or estimate.noise, estimate.camera
        mean, chains, summaries = stitched(
            lambda start: windows.posterior(start, found, level, floor=estimate.floor),
            windows.starts,
            windows.step,
            len(keypoints.points),
            draws,
            seed,
            bar.update,
        )
    floor = float(np.median([summary.floor.mean for summary in summaries]))
    mirrored = other.score - estimate.score
    evidence = Evidence(keypoints, fps, found, level, mean, mirrored)
    checks = (*checked(evidence), proportions(summaries, 1), uncertain(summaries))
    if pitch is None:
        _tilt(chains, estimate.error.pitch, seed)
    return TrackLift(mean, chains, floor, found, estimate.error.focal, level, checks)


def _windows(keypoints: PersonKeypoints, fps: float) -> _Windows:
    """Cut keypoints into windows."""
    prior, starts, step = cut(len(keypoints.points), fps, 1)
    coarse = averaged(keypoints, step)
    path = body_path(coarse)
    return _Windows(coarse, path, _depths(coarse, path, prior.fps), prior, starts, step)


@cache
def _regression() -> PoseDepth:
    """Return the shipped regression of depths; cached per process."""
    return PoseDepth.load()


def _depths(keypoints: PersonKeypoints, path: BodyPath, fps: float) -> DepthEstimate:
    """Return the estimated depths of the joints of arms and legs, and pitches."""
    points, visible = keypoints.points[:, LIMBS], keypoints.weight[:, LIMBS] > 0
    return _regression().estimate(points, visible, path.middle, path.size, fps)


class _CameraError(NamedTuple):
    """Standard deviations of the pitch, radians, and of the logarithm of the focal length."""

    pitch: float
    focal: float


class _Estimate(NamedTuple):
    """Mean score of windows, noise (pixels), camera, its errors, and the floor's height."""

    score: float
    noise: float
    camera: LevelCamera
    error: _CameraError
    floor: Height


def _estimated(
    windows: _Windows,
    camera: LevelCamera,
    noise: float,
    pitch: float | None,
    focal_error: float,
) -> _Estimate:
    """Return the estimates of some windows; the first pitch is the network's if it is None."""
    weight, length = windows.keypoints.weight, windows.prior.frames
    seen = [weight[start : start + length].sum() for start in windows.starts]
    order = np.argsort(seen)[::-1]
    chosen = [windows.starts[i] for i in np.sort(order[: max(_TRIED, len(order) // 2)])]
    chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, _TRIED).round().astype(int)]
    error = _CameraError(_PITCH_ERROR if pitch is None else 0.0, focal_error)
    tilted = replace(camera, pitch=_pitch(windows, camera) if pitch is None else pitch)
    found = [
        windows.posterior(start, tilted, noise, candidates=_CANDIDATES)
        for start in sorted(set(chosen))
    ]
    modes = [posterior.best for posterior in found]
    squares = np.concatenate([mode.standardised[mode.standardised > 0] for mode in modes])
    noise = float(noise * np.sqrt(np.median(squares) / (MEDIAN * _FITTED)))
    heights, spreads = np.array([posterior.floor for posterior in found]).T
    score = float(np.mean([mode.score for mode in modes]))
    distances = np.array([-mode.positions[..., 2].mean() for mode in modes])
    return _Estimate(score, noise, *_levelled(tilted, error, heights, spreads, distances))


def _levelled(
    camera: LevelCamera,
    error: _CameraError,
    heights: np.ndarray,
    spreads: np.ndarray,
    distances: np.ndarray,
) -> tuple[LevelCamera, _CameraError, Height]:
    """Return the camera before which the floors of windows are level, its errors, and the floor.

    If the pitch p is too large by δ, and the logarithm of the focal length too small by ρ, a level
    floor seems to rise with the distance by δ − ρ tan p. Before, both are 0 ± ``error``. Floors
    that rise by more than these explain are not level, and tell nothing.
    """
    scales = np.array(error)
    effects = scales * [1.0, -np.tan(camera.pitch)]
    weights = 1 / (spreads**2 + _UNEVEN**2)
    beyond = distances - np.average(distances, weights=weights)
    covariance = np.linalg.inv(np.eye(2) + (weights @ beyond**2) * np.outer(effects, effects))
    mean = covariance @ effects * ((weights * beyond) @ heights)
    if abs(effects @ mean) > _STEEP * np.linalg.norm(effects):
        mean, covariance = np.zeros(2), np.eye(2)
    level = _shared(heights - (effects @ mean) * distances, spreads)
    pitch, focal = scales * mean
    found = replace(
        camera, pitch=float(camera.pitch - pitch), focal=float(camera.focal * np.exp(focal))
    )
    left = scales * np.sqrt(np.diag(covariance))
    return found, _CameraError(float(left[0]), float(left[1])), level


def _shared(heights: np.ndarray, spreads: np.ndarray) -> Height:
    """Return the weighted mean of the floor's height in windows, unknown from one alone.

    Their variance counts too: heights still depend on the distance if the pitch is wrong.
    """
    weights = spreads**-2 / (spreads**-2).sum()
    mean = float(weights @ heights)
    variance = weights @ (heights - mean) ** 2 + 1 / (spreads**-2).sum()
    return Height(mean, max(_UNEVEN, float(variance**0.5)) if len(heights) > 1 else np.inf)


def _pitch(windows: _Windows, camera: LevelCamera) -> float:
    """Return the pitch of the optical axis, radians, from those of the rays to the body.

    With pitch p, the ray (x, y, 1) to the right, up and forward has the elevation e if
    y cos p + sin p = sin e √(1 + x² + y²).
    """
    x, y = camera.normalised(windows.path.middle).T
    ray, spread = windows.depths.pitch, windows.depths.pitch_spread
    sine = np.sin(ray) * np.sqrt((1 + x**2 + y**2) / (1 + y**2))
    pitches = np.arcsin(np.clip(sine, -1, 1)) - np.arctan(y)
    return float(np.average(pitches, weights=spread**-2))


def _tilt(draws: np.ndarray, spread: float, seed: int) -> None:
    """Turn the draws about the camera, each to a pitch of its own.

    The pelvis keeps its height, as the floor is level.
    """
    turn = spread * seeds.generator(seed, "lift: pitch").standard_normal(len(draws))
    matrices = vector_to_matrix(turn[:, None] * [1.0, 0.0, 0.0])
    for draw, matrix in zip(draws, matrices, strict=True):
        height = draw[:, :1, 1].copy()
        draw[:] = draw @ matrix.T
        draw[..., 1] -= draw[:, :1, 1] - height
