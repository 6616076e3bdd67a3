"""Lifting of one camera's keypoints to 3D motion, window by window."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.checks import MEDIAN, Check, Evidence, checked
from probmotion.lifting.keypoints import (
    PERSON,
    BodyPath,
    PersonKeypoints,
    averaged,
    body_path,
    smooth_size,
)
from probmotion.lifting.window_fit import Observed, lift_window
from probmotion.lifting.window_posterior import TEMPER, WindowMode, WindowPosterior
from probmotion.lifting.window_prior import WindowPrior
from probmotion.lifting.windows import cut, stitched
from probmotion.posteriors.sampling import progress_bar
from probmotion.threads import one_thread

__all__ = ["TrackLift", "lift_track"]

_SAME = np.radians(3.0)  # largest difference of estimates that are one
_PITCHES = np.radians([-20.0, 0.0, 20.0])  # first estimates
_PITCH, _PITCH_SPREAD = np.radians([-5.0, 12.0])  # of cameras: mean and standard deviation
_PITCH_ERROR = np.radians(3.0)  # standard deviation about the probable values
_CANDIDATES = 5  # of a window whose noise and score are estimated
_TILT = 0.15  # standard deviation of the pitch about these, radians
_TRIED = 3  # windows on which camera and noise are estimated
_FITTED = 0.8  # share of the residuals that the fit leaves


class _Windows(NamedTuple):
    """Averaged keypoints and the windows into which they are cut."""

    keypoints: PersonKeypoints
    path: BodyPath
    prior: WindowPrior
    starts: list[int]
    step: int

    def posterior(
        self,
        start: int,
        camera: LevelCamera,
        noise: float,
        *,
        candidates: int = 3,
        tilt: float = 0.0,
    ) -> WindowPosterior:
        """Return the posterior of the window from a frame on."""
        rows = slice(start, start + self.prior.frames)
        points, weight = self.keypoints.points[rows], self.keypoints.weight[rows]
        seen = np.where(weight[..., None] > 0, camera.normalised(points), 0.0)
        depth = camera.focal / smooth_size(self.path.size[rows])
        middle = camera.normalised(self.path.middle[rows])
        observed = Observed(seen, weight, noise)
        return lift_window(
            self.prior, camera, observed, middle, depth, candidates=candidates, tilt=tilt
        )

    def mirrored(self) -> _Windows:
        """Return the windows with left and right exchanged."""
        order = list(PERSON.mirrored_order)
        points, weight, swapped = self.keypoints
        exchanged = PersonKeypoints(points[:, order], weight[:, order], swapped)
        return self._replace(keypoints=exchanged)


class TrackLift(NamedTuple):
    """Mean and draws relative to the camera for a person of 1.7 m, and what was estimated.

    ``floor`` is the height of the floor relative to the camera.
    """

    mean: np.ndarray
    draws: np.ndarray
    floor: float
    camera: LevelCamera
    noise: float
    checks: tuple[Check, ...]


def lift_track(
    keypoints: PersonKeypoints,
    fps: float,
    camera: LevelCamera,
    pitch: float | None,
    noise: float | None,
    guess: float,
    *,
    draws: int,
    seed: int,
    progress: bool,
) -> TrackLift:
    """Return what one camera tells about a motion.

    The ``pitch``, radians, and the ``noise``, pixels, are estimated if they are None, the noise
    from a first ``guess``.
    """
    windows = _windows(keypoints, fps)
    with one_thread(), progress_bar(len(windows.starts), "lift", progress) as bar:
        with ThreadPoolExecutor(2) as pool:
            estimate, other = pool.map(
                lambda each: _estimated(each, camera, noise or guess, pitch),
                (windows, windows.mirrored()),
            )
        level, found = noise or estimate.noise, replace(camera, pitch=estimate.pitch)
        mean, chains, summaries = stitched(
            lambda start: windows.posterior(start, found, level),
            windows.starts,
            windows.step,
            len(keypoints.points),
            draws,
            seed,
            bar.update,
        )
    floor = float(np.median([summary.floor for summary in summaries]))
    mirrored = other.score - estimate.score
    evidence = Evidence(keypoints, fps, found, level, mean, summaries, mirrored)
    if pitch is None:
        _tilt(chains, estimate, seed)
    return TrackLift(mean, chains, floor, found, level, checked(evidence))


def _windows(keypoints: PersonKeypoints, fps: float) -> _Windows:
    """Cut keypoints into windows."""
    prior, starts, step = cut(len(keypoints.points), fps, 1)
    coarse = averaged(keypoints, step)
    return _Windows(coarse, body_path(coarse), prior, starts, step)


class _Estimate(NamedTuple):
    """Score, noise, and the pitch's probable values, radians, with their probabilities."""

    score: float
    noise: float
    pitches: np.ndarray
    probabilities: np.ndarray

    @property
    def pitch(self) -> float:
        """Mean of the pitch, radians."""
        return float(self.probabilities @ self.pitches)


def _estimated(
    windows: _Windows, camera: LevelCamera, noise: float, pitch: float | None
) -> _Estimate:
    """Return the score, pitch and noise of some windows.

    With an unknown pitch, modes are found about several first estimates, and each is as probable as
    its windows' tempered scores and a prior of the pitch say.
    """
    weight, length = windows.keypoints.weight, windows.prior.frames
    seen = [weight[start : start + length].sum() for start in windows.starts]
    order = np.argsort(seen)[::-1]
    chosen = [windows.starts[i] for i in np.sort(order[: max(_TRIED, len(order) // 2)])]
    chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, _TRIED).round().astype(int)]
    chosen = sorted(set(chosen))

    def found(pitch: float, tilt: float, candidates: int) -> list[WindowMode]:
        tilted = replace(camera, pitch=pitch)
        return [
            windows.posterior(start, tilted, noise, candidates=candidates, tilt=tilt).best
            for start in chosen
        ]

    pitches, logs = np.array([pitch]), np.zeros(1)
    if pitch is None:
        tried = [found(first, _TILT, 2) for first in _PITCHES.tolist()]
        pitches = np.array([np.median([mode.pitch for mode in modes]) for modes in tried])
        scores = np.array([sum(mode.score for mode in modes) for modes in tried])
        logs = TEMPER * scores + _log_pitch(pitches)
        kept = _distinct(pitches, logs)
        pitches, logs = pitches[kept], logs[kept]
    probabilities = np.exp(logs - logs.max())
    probabilities /= probabilities.sum()
    estimate = probabilities @ pitches
    modes = found(float(estimate), 0.0, _CANDIDATES)
    squares = np.concatenate([mode.standardised[mode.standardised > 0] for mode in modes])
    noise = float(noise * np.sqrt(np.median(squares) / (MEDIAN * _FITTED)))
    score = sum(mode.score for mode in modes) + float(_log_pitch(estimate)) / TEMPER
    return _Estimate(score / len(chosen), noise, pitches, probabilities)


def _distinct(pitches: np.ndarray, logs: np.ndarray) -> list[int]:
    """Return the indices of pitches that differ, the most probable of those that do not."""
    kept: list[int] = []
    for index in np.argsort(-logs).tolist():
        if (np.abs(pitches[kept] - pitches[index]) > _SAME).all():
            kept.append(index)
    return kept


def _log_pitch(pitch: np.ndarray) -> np.ndarray:
    """Return the log density of the camera's pitch up to a constant."""
    density: np.ndarray = -0.5 * ((pitch - _PITCH) / _PITCH_SPREAD) ** 2
    return density


def _tilt(draws: np.ndarray, estimate: _Estimate, seed: int) -> None:
    """Turn the draws about the camera, each to a pitch of its own.

    The pelvis keeps its height, as the floor is level.
    """
    rng = seeds.generator(seed, "lift: pitch")
    count = len(draws)
    chosen = rng.choice(len(estimate.pitches), count, p=estimate.probabilities)
    turn = estimate.pitches[chosen] - estimate.pitch + _PITCH_ERROR * rng.standard_normal(count)
    matrices = vector_to_matrix(turn[:, None] * [1.0, 0.0, 0.0])
    for draw, matrix in zip(draws, matrices, strict=True):
        height = draw[:, :1, 1].copy()
        draw[:] = draw @ matrix.T
        draw[..., 1] -= draw[:, :1, 1] - height
