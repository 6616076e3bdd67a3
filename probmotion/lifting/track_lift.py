"""Lifting of one camera's keypoints to 3D motion, window by window."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.checks import MEDIAN, Evidence, checked
from probmotion.lifting.keypoints import (
    PERSON,
    BodyPath,
    PersonKeypoints,
    averaged,
    body_path,
    person_keypoints,
    smooth_size,
)
from probmotion.lifting.result import Lift
from probmotion.lifting.window_fit import Observed, lift_window
from probmotion.lifting.window_posterior import WindowPosterior
from probmotion.lifting.window_prior import WindowPrior
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.posteriors.sampling import progress_bar
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_positive

__all__ = ["lift"]

_SECONDS = 2.0  # length of a window
_RATE = 15.0  # approximate rate at which keypoints are averaged, per second
_SLOWEST = 5.0  # frame rate
_FEWEST = 8  # frames of a window at this rate
_FOV = 60.0  # default horizontal field of view, degrees
_HEIGHT, _HEIGHT_SPREAD = 1.7, 0.06  # of adults: mean, metres, and relative standard deviation
_MEASURED = 0.01  # relative standard deviation of a given height
_NOISE = 0.004  # first estimate of the keypoints' noise, of the image's longer side
_PITCHES = np.radians([-20.0, 0.0, 20.0])  # first estimates
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


def lift(
    track: KeypointTrack,
    *,
    image_size: tuple[int, int],
    fov: float = _FOV,
    pitch: float | None = None,
    height: float | None = None,
    noise: float | None = None,
    draws: int = 100,
    seed: int = 0,
    progress: bool = True,
) -> Lift:
    """Return the posterior of a person's 3D motion given the keypoints of one still camera.

    The recording is cut into windows of two seconds that overlap by half. Each has a mixture of
    Gaussian approximations (:mod:`probmotion.lifting.window_fit`) under the prior
    ``cmu-motion``. Means are averaged with weights that fall linearly to 0 at a window's ends; each
    draw continues from the previous window's. The pitch of the camera and the keypoints' noise are
    those of the largest evidence in three windows.

    Parameters
    ----------
    track : KeypointTrack
        Keypoints of one person, pixels.
    image_size : tuple of int
        Width and height of the video, pixels.
    fov : float
        Horizontal field of view, degrees. Distances from the camera are proportional to the focal
        length, which one still view hardly determines.
    pitch : float, optional
        Angle of the camera above the horizon, degrees, negative if it looks down; estimated by
        default.
    height : float, optional
        The person's height, metres; by default 1.7 ± .1: each draw has its own.
    noise : float, optional
        Scale of the noise of a keypoint of confidence 1, pixels; estimated by default.
    draws : int
        Number of posterior draws.
    seed : int
        Seed of the draws.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If the track is too short, has too few keypoints, or arguments are out of range.
    """
    check_count("draws", draws, least=2)
    check_count("seed", seed, least=0)
    check_positive("image_size", min(image_size))
    if track.fps < _SLOWEST:
        raise ValueError(
            f"track must have at least {_SLOWEST:g} frames per second, got {track.fps:g}; check fps"
        )
    if not 10 <= fov <= 150:
        raise ValueError(f"fov must be 10 to 150 degrees, got {fov:g}")
    if pitch is not None and not -80 <= pitch <= 80:
        raise ValueError(f"pitch must be -80 to 80 degrees, got {pitch:g}")
    if height is not None and not 0.5 <= height <= 2.5:
        raise ValueError(f"height must be .5 to 2.5 metres, got {height:g}; is it in metres?")
    if noise is not None:
        check_positive("noise", noise)
    keypoints = person_keypoints(track)
    _check_visible(keypoints.weight, track)
    _check_inside(keypoints, image_size)
    windows = _windows(keypoints, track.fps)
    focal = 0.5 * image_size[0] / np.tan(np.radians(fov) / 2)
    camera = LevelCamera(focal, (image_size[0] / 2, image_size[1] / 2))
    steps = len(windows.starts)
    with one_thread(), progress_bar(steps, "lift", progress) as bar:
        guess = noise or _NOISE * max(image_size)
        camera, estimate, mirrored = _estimated(
            windows, camera, guess, None if pitch is None else np.radians(pitch)
        )
        noise = noise or estimate
        pool = ThreadPoolExecutor(2)
        try:
            futures = [
                pool.submit(windows.posterior, start, camera, noise) for start in windows.starts
            ]
            posteriors = []
            for future in futures:
                posteriors.append(future.result())
                bar.update()
        finally:
            pool.shutdown(cancel_futures=True)
        mean, chains = _stitched(windows, posteriors, track.frames, draws, seed)
    floor = float(np.median([_floor(posterior) for posterior in posteriors]))
    scale = (height or _HEIGHT) / _HEIGHT
    spread = _HEIGHT_SPREAD if height is None else _MEASURED
    # Size and distance are proportional: the camera stays where it is.
    chains *= 1 + spread * seeds.generator(seed, "lift: size").standard_normal((draws, 1, 1, 1))
    chains -= [0.0, floor, 0.0]
    chains *= scale
    motion = Motion(scale * (mean - [0.0, floor, 0.0]), PERSON, track.fps, name=track.name)
    evidence = Evidence(keypoints, camera, noise, mean, posteriors, mirrored)
    return Lift(
        motion,
        chains,
        camera,
        -scale * floor,
        noise,
        keypoints.points,
        keypoints.weight,
        keypoints.swapped,
        checked(evidence),
    )


def _check_visible(weight: np.ndarray, track: KeypointTrack) -> None:
    """Refuse recordings in which the person is absent from half of the frames."""
    limbs = (weight > 0).sum(axis=1) >= 6
    if limbs.mean() < 0.5:
        raise ValueError(
            f"track must show the person in at least half of the frames, got "
            f"{int(limbs.sum())} of {track.frames} frames with six limb joints; cut the video"
        )


def _check_inside(keypoints: PersonKeypoints, image_size: tuple[int, int]) -> None:
    """Refuse keypoints that are not pixels of the image."""
    seen = keypoints.points[keypoints.weight > 0]
    low, high = np.quantile(seen, 0.05, axis=0), np.quantile(seen, 0.95, axis=0)
    size = np.array(image_size)
    if (high > 1.1 * size).any() or (low < -0.1 * size).any() or (high - low).max() < 5:
        raise ValueError(
            f"keypoints must be pixels of an image of {image_size[0]} × {image_size[1]}, got "
            f"{low[0]:.3g} to {high[0]:.3g} in x and {low[1]:.3g} to {high[1]:.3g} in y; give "
            "the video's size as image_size"
        )


@lru_cache(maxsize=2)
def _prior(frames: int, fps: float) -> WindowPrior:
    """Return the shipped prior for windows; cached per process."""
    return WindowPrior(SpectralMixtureMotion.load("cmu-motion"), frames, fps)


def _windows(keypoints: PersonKeypoints, fps: float) -> _Windows:
    """Cut keypoints into windows."""
    step = max(1, round(fps / _RATE))
    coarse = averaged(keypoints, step)
    frames = len(coarse.points)
    if frames < _FEWEST:
        raise ValueError(
            f"track must have at least {_FEWEST * step} frames at {fps:g} frames per second, got "
            f"{len(keypoints.points)}"
        )
    length = min(frames, round(_SECONDS * fps / step))
    count = max(1, -(-2 * (frames - length) // length) + 1)
    starts = np.linspace(0, frames - length, count).round().astype(int).tolist()
    return _Windows(coarse, body_path(coarse), _prior(length, fps / step), starts, step)


def _estimated(
    windows: _Windows, camera: LevelCamera, noise: float, pitch: float | None
) -> tuple[LevelCamera, float, float]:
    """Return the camera with its pitch, the noise, and the evidence for mirrored keypoints."""
    weight, length = windows.keypoints.weight, windows.prior.frames
    seen = [weight[start : start + length].sum() for start in windows.starts]
    order = np.argsort(seen)[::-1]
    chosen = [windows.starts[i] for i in np.sort(order[: max(_TRIED, len(order) // 2)])]
    chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, _TRIED).round().astype(int)]
    chosen = sorted(set(chosen))

    def found(
        pitch: float, tilt: float, windows: _Windows = windows, candidates: int = 2
    ) -> list[WindowPosterior]:
        tilted = replace(camera, pitch=float(pitch))
        return [
            windows.posterior(start, tilted, noise, candidates=candidates, tilt=tilt)
            for start in chosen
        ]

    def score(posteriors: list[WindowPosterior]) -> float:
        return sum(posterior.best.score for posterior in posteriors)

    if pitch is None:
        first = max((found(start, _TILT) for start in _PITCHES), key=score)
        pitch = float(np.median([posterior.best.pitch for posterior in first]))
        second = found(pitch, _TILT, candidates=3)
        pitch = float(np.median([posterior.best.pitch for posterior in second]))
    camera = replace(camera, pitch=pitch)
    parts = found(pitch, 0.0)
    squares = np.concatenate([part.best.standardised[part.best.standardised > 0] for part in parts])
    noise = float(noise * np.sqrt(np.median(squares) / (MEDIAN * _FITTED)))
    order_of = list(PERSON.mirrored_order)
    exchanged = windows.keypoints._replace(
        points=windows.keypoints.points[:, order_of], weight=weight[:, order_of]
    )
    other = score(found(pitch, 0.0, windows._replace(keypoints=exchanged)))
    return camera, noise, (other - score(parts)) / len(chosen)


def _floor(posterior: WindowPosterior) -> float:
    """Return the height of the floor relative to the camera in the most probable mode."""
    return float(posterior.origin[1] + posterior.floor(posterior.best))


def _stitched(
    windows: _Windows, posteriors: list[WindowPosterior], frames: int, draws: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (L, J, 3) and draws (n, L, J, 3) of all windows."""
    step, length = windows.step, windows.prior.frames * windows.step
    J = PERSON.n_joints
    mean, total = np.zeros((frames, J, 3)), np.zeros((frames, 1, 1))
    chains = np.zeros((draws, frames, J, 3))
    done = 0  # frames that all draws have
    for number, (start, posterior) in enumerate(zip(windows.starts, posteriors, strict=True)):
        first = start * step
        last = frames if number == len(posteriors) - 1 else first + length
        times = (np.arange(last - first) - (step - 1) / 2) / step
        ramp = np.minimum(np.arange(last - first) + 1, last - first - np.arange(last - first))
        mean[first:last] += ramp[:, None, None] * posterior.mean(times)
        total[first:last] += ramp[:, None, None]
        rng = seeds.generator(seed, f"lift {start}")
        # Keep earlier frames up to the middle of the overlap.
        kept = 0 if number == 0 else (done - first) // 2
        if kept > step:
            joined = np.array([kept - 1 - step, kept - 1])
            part = posterior.sample(rng, draws, times, times[joined], chains[:, first + joined])
        else:
            kept = 0
            part = posterior.sample(rng, draws, times)
        chains[:, first + kept : last] = part[:, kept:]
        done = last
    return mean / total, chains
