"""Lifting of the keypoints of calibrated cameras to motion in the calibration's world.

Windows have the posterior of :mod:`~probmotion.lifting.window_fit` with the keypoints of all views.
Since the prior is of people of 1.7 m, the fit is in units in which the person has this height: the
cameras' positions are divided by the person's size, which is estimated from the bones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from probmotion.io.keypoints.calibration import Calibration
from probmotion.lifting.camera import LevelCamera, LevelCameras
from probmotion.lifting.checks import MEDIAN, Check, Evidence, checked, proportions
from probmotion.lifting.keypoints import (
    PERSON,
    BodyPath,
    PersonKeypoints,
    averaged,
    body_path,
    person_keypoints,
    smooth_size,
)
from probmotion.lifting.linear_system import PROPORTIONS
from probmotion.lifting.sides import consistent_sides
from probmotion.lifting.window_fit import Observed, lift_window_views
from probmotion.lifting.window_posterior import WindowPosterior
from probmotion.lifting.window_prior import WindowPrior
from probmotion.lifting.windows import cut, stitched
from probmotion.motion.motion import KeypointTrack
from probmotion.posteriors.sampling import progress_bar
from probmotion.threads import one_thread

__all__ = ["CalibratedView", "LiftedViews", "calibrated_views", "check_size", "lift_views"]

_STEEPEST = 60.0  # roll of a camera, degrees
_ACROSS, _ALONG = 0.1, 1.0  # of a body's middle: metres across a ray, and depths along it
_UNSEEN = 1e-3  # weight of interpolated frames
_SIZES = (0.4, 1.5)  # of people, relative to the prior's
_MOST = 8  # views: the repair of sides compares all sets of views
_ROUNDS = 2  # of the estimation of the size
_TRIED = 3  # windows on which size and noise are estimated
_FITTED = 0.9  # share of the residuals that the fit leaves
# Largest ratio of a joint's residuals to the noise in two, and in three or more views.
_CONTRADICTIONS = (1.6, 2.4)
_NOISE = 0.04  # largest noise of one view at the person's distance, metres
_FEWEST, _SHARE = 10, 0.1  # frames in which a view shows the person


class CalibratedView(NamedTuple):
    """Keypoints of a calibrated camera.

    ``keypoints`` are in pixels about the principal point ``centre`` of the level ``camera``, turned
    by ``roll``, (2, 2), from those of the undistorted image.
    """

    name: str
    keypoints: PersonKeypoints
    camera: LevelCamera
    roll: np.ndarray
    centre: np.ndarray

    def pixels(self, keypoints: PersonKeypoints) -> np.ndarray:
        """Return pixels of the undistorted image, (L, 14, 2); 0 where missing."""
        shown = keypoints.points @ self.roll + self.centre
        pixels: np.ndarray = np.where(keypoints.weight[..., None] > 0, shown, 0.0)
        return pixels


class LiftedViews(NamedTuple):
    """Mean (L, J, 3) and draws (n, L, J, 3) in the calibration's world, and what led to them."""

    mean: np.ndarray
    draws: np.ndarray
    noise: float
    keypoints: Sequence[PersonKeypoints]
    checks: tuple[Check, ...]


def calibrated_views(
    tracks: Sequence[KeypointTrack], calibration: Calibration
) -> tuple[list[int], list[CalibratedView]]:
    """Return the cameras of tracks of one person, and their views without distortion and roll.

    Raises
    ------
    ValueError
        If tracks do not match the cameras or each other.
    """
    if len(tracks) > _MOST:
        raise ValueError(f"tracks must be of at most {_MOST} cameras, got {len(tracks)}")
    found = calibration.matched([track.name for track in tracks])
    _check_same("frame rate", [track.fps for track in tracks])
    tracks = _in_step(tracks)
    _check_same("number of frames", [track.frames for track in tracks])
    return found, [_view(track, calibration, v) for track, v in zip(tracks, found, strict=True)]


def _check_same(what: str, values: Sequence[float]) -> None:
    """Refuse tracks that differ."""
    if len(set(values)) > 1:
        raise ValueError(
            f"tracks of all cameras must have the same {what}, got "
            f"{', '.join(f'{value:g}' for value in values)}; synchronise the videos"
        )


def _in_step(tracks: Sequence[KeypointTrack]) -> Sequence[KeypointTrack]:
    """Return tracks with the frames of all, if they have frame numbers."""
    starts = [track.start for track in tracks if track.start is not None]
    if len(starts) < len(tracks):
        return tracks
    stops = [start + track.frames for start, track in zip(starts, tracks, strict=True)]
    if max(starts) >= min(stops):
        raise ValueError(
            "tracks of all cameras must have frames in common, got first frames "
            f"{', '.join(map(str, starts))}; synchronise the videos"
        )
    first, padded = min(starts), []
    for start, stop, track in zip(starts, stops, tracks, strict=True):
        rows = slice(start - first, stop - first)
        keypoints = np.full((max(stops) - first, *track.keypoints.shape[1:]), np.nan)
        confidence = np.zeros(keypoints.shape[:2])
        keypoints[rows], confidence[rows] = track.keypoints, track.confidence
        padded.append(replace(track, keypoints=keypoints, confidence=confidence, start=first))
    return padded


def _view(track: KeypointTrack, calibration: Calibration, index: int) -> CalibratedView:
    """Return the view of one camera."""
    name, size = calibration.names[index], calibration.sizes[index]
    camera = calibration.cameras.view(index)
    (right, down, forward), centre = camera.rotation[0], camera.centre
    assert centre is not None
    pitch, heading = np.arcsin(forward[1]), np.arctan2(-forward[0], -forward[2])
    x, y, z = -camera.rotation[0].T @ camera.translation[0]
    level = LevelCamera(float(camera.focal[0]), (0.0, 0.0), pitch, heading, (x, y, z))
    # Directions of the level image in that of the camera.
    axes = level.axes
    roll = np.array([[axes[0] @ right, axes[0] @ down], [-axes[1] @ right, -axes[1] @ down]])
    if roll[0, 0] < np.cos(np.radians(_STEEPEST)):
        raise ValueError(
            f"cameras must be upright in a world with z up, got {name} with a roll of "
            f"{np.degrees(np.arccos(np.clip(roll[0, 0], -1, 1))):.0f}°; check the calibration's "
            "axes"
        )
    keypoints = person_keypoints(track)
    seen = keypoints.weight > 0
    limbs = int((seen.sum(axis=1) >= 6).sum())
    if limbs < min(track.frames, max(_FEWEST, _SHARE * track.frames)):
        raise ValueError(
            f"every camera must show the person, got {limbs} of {track.frames} frames with six "
            f"limb joints in {name}; leave it out"
        )
    shown = keypoints.points[seen]
    low, high = np.quantile(shown, [0.05, 0.95], axis=0)
    if (high > 1.1 * np.array(size)).any() or (low < -0.1 * np.array(size)).any():
        raise ValueError(
            f"keypoints of {name} must be pixels of its image of {size[0]} × {size[1]}, got "
            f"{low[0]:.3g} to {high[0]:.3g} in x and {low[1]:.3g} to {high[1]:.3g} in y"
        )
    levelled = (calibration.undistorted(index, keypoints.points) - centre[0]) @ roll.T
    levelled = np.where(seen[..., None], levelled, 0.0)
    return CalibratedView(name, keypoints._replace(points=levelled), level, roll, centre[0])


class _Recording(NamedTuple):
    """Averaged keypoints of all views, and cameras and path in units of the person's size."""

    views: list[PersonKeypoints]
    cameras: LevelCameras
    path: np.ndarray
    prior: WindowPrior

    def sized(self, size: float) -> _Recording:
        """Return the recording in units that are ``size`` times larger."""
        views = tuple(
            replace(view, position=tuple(np.array(view.position) / size))
            for view in self.cameras.views
        )
        return self._replace(cameras=LevelCameras(views), path=self.path / size)

    def mirrored(self) -> _Recording:
        """Return the recording with left and right exchanged."""
        return self._replace(views=[view.mirrored() for view in self.views])

    def posterior(self, start: int, noise: float, candidates: int = 3) -> WindowPosterior:
        """Return the posterior of the window from a frame on."""
        rows = slice(start, start + self.prior.frames)
        points, weight = [], []
        for camera, keypoints in zip(self.cameras.views, self.views, strict=True):
            weight.append(keypoints.weight[rows])
            seen = weight[-1][..., None] > 0
            points.append(np.where(seen, camera.normalised(keypoints.points[rows]), 0.0))
        observed = Observed(np.stack(points), np.stack(weight), noise)
        return lift_window_views(
            self.prior, self.cameras, observed, self.path[rows], candidates=candidates
        )


def lift_views(
    views: Sequence[CalibratedView],
    fps: float,
    *,
    size: float | None,
    noise: float | None,
    guess: float,
    draws: int,
    seed: int,
    progress: bool,
) -> LiftedViews:
    """Return the posterior of a person's motion given several views.

    Parameters
    ----------
    views : sequence of CalibratedView
    fps : float
    size : float, optional
        Size of the person relative to the prior's; estimated by default.
    noise : float, optional
        Noise of the keypoints, pixels; estimated by default, from ``guess``.
    guess : float
    draws, seed, progress
        As for :func:`~probmotion.lifting.recording_lift.lift`.

    Raises
    ------
    ValueError
        If the recording is too short, or the person's size is not that of people.
    """
    frames = len(views[0].keypoints.points)
    prior, starts, step = cut(frames, fps, len(views))
    cameras = LevelCameras(tuple(view.camera for view in views))
    keypoints = consistent_sides([view.keypoints for view in views], cameras)
    coarse = [averaged(each, step) for each in keypoints]
    path, apparent = _located(cameras, coarse)
    check_size(apparent)
    recording = _Recording(coarse, cameras, path, prior)
    first = noise or guess
    with one_thread(), progress_bar(len(starts), "lift", progress) as bar:
        total = np.sum([view.weight.sum(axis=1) for view in coarse], axis=0)
        seen = [total[start : start + prior.frames].sum() for start in starts]
        chosen = [starts[i] for i in sorted(np.argsort(seen)[::-1][:_TRIED].tolist())]
        size = size or _size(recording, apparent, chosen, first)
        recording = recording.sized(size)
        estimate, mirrored = _noise(recording, chosen, first)
        level = noise or estimate
        mean, chains, windows = stitched(
            lambda start: recording.posterior(start, level),
            starts,
            step,
            frames,
            draws,
            seed,
            bar.update,
        )
    evidence = [
        Evidence(each, fps, camera, level, mean, mirrored)
        for each, camera in zip(keypoints, recording.cameras.views, strict=True)
    ]
    chains *= size
    bones = proportions(windows, len(views))
    return LiftedViews(size * mean, chains, level, keypoints, _worst(evidence, bones))


def _noise(recording: _Recording, starts: Sequence[int], noise: float) -> tuple[float, float]:
    """Return the noise, pixels, and the log evidence of exchanged sides per window."""
    parts = [recording.posterior(start, noise, 2).best for start in starts]
    squares = np.concatenate([part.standardised[part.standardised > 0] for part in parts])
    exchanged = recording.mirrored()
    others = [exchanged.posterior(start, noise, 2).best for start in starts]
    scores = [other.score - part.score for other, part in zip(others, parts, strict=True)]
    estimate = noise * np.sqrt(np.median(squares) / (MEDIAN * _FITTED))
    return float(estimate), float(np.mean(scores))


def _located(cameras: LevelCameras, views: Sequence[PersonKeypoints]) -> tuple[np.ndarray, float]:
    """Return the path of the body's middle, (L, 3), metres, and the person's apparent size.

    In each frame, the point is the mean of Gaussians that are narrow across the views' rays and
    wide along them, about the depth at which a person of size 1 has the size of the image.
    """
    precision, pull = 0.0, 0.0
    paths: list[BodyPath] = [body_path(view) for view in views]
    for camera, keypoints, path in zip(cameras.views, views, paths, strict=True):
        depth = camera.focal / smooth_size(path.size)
        points = camera.points(camera.normalised(path.middle), depth)
        rays = points - camera.position
        rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        along = rays[:, :, None] * rays[:, None, :]
        weight = np.where((keypoints.weight > 0).any(axis=1), 1.0, _UNSEEN)
        spread = (_ALONG * depth)[:, None, None]
        part = weight[:, None, None] * ((np.eye(3) - along) / _ACROSS**2 + along / spread**2)
        precision, pull = precision + part, pull + part @ points[..., None]
    middle: np.ndarray = np.linalg.solve(precision, pull)[..., 0]
    ratios = [
        (camera.depth(middle) * path.size / camera.focal)[(keypoints.weight > 0).any(axis=1)]
        for camera, keypoints, path in zip(cameras.views, views, paths, strict=True)
    ]
    return middle, float(np.median(np.concatenate(ratios)))


def check_size(size: float) -> None:
    """Refuse calibrations in which a person has an unlikely size, relative to 1.7 m."""
    low, high = _SIZES
    if not low <= size <= high:
        raise ValueError(
            "calibration must be in metres, with the floor near z = 0 and of the cameras of these "
            f"keypoints, got a person of about {1.7 * size:.2g} m"
        )


def _size(recording: _Recording, apparent: float, starts: Sequence[int], noise: float) -> float:
    """Return the person's size relative to the prior's, from the bones of some windows."""
    size, bones = apparent, PERSON.n_joints - 1
    for _ in range(_ROUNDS):
        parts = [recording.sized(size).posterior(start, noise, 2) for start in starts]
        ratios = [1 + PROPORTIONS * part.best.mean[-bones:] for part in parts]
        size *= float(np.median(ratios))
    return size


def _worst(evidence: Sequence[Evidence], bones: Check) -> tuple[Check, ...]:
    """Return the checks of V views, each with its largest value over the views.

    Unusual motion is not marked, as several views determine it. V views may have √V times the noise
    of one. Of three or more views, one that contradicts the others is left with large residuals,
    while joints of detectors and of the prior differ by less; two views would meet halfway.
    """
    views = len(evidence)
    worst = {
        checks[0].name: max(checks, key=lambda check: check.value)
        for checks in zip(*map(checked, evidence), strict=True)
    }
    limit = float(np.sqrt(views) * _NOISE)
    noise = replace(
        worst["noise"],
        limit=limit,
        problem=f"the keypoints' noise is more than {100 * limit:.1f} cm at the person's distance",
    )
    residual = replace(
        worst["residual"],
        limit=_CONTRADICTIONS[views > 2],
        problem="keypoints of a view contradict the others (calibration, synchronisation, person?)",
    )
    return noise, residual, bones, replace(worst["mirrored"], limit=0.0)
