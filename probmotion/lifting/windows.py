"""Cutting of a recording into overlapping windows, and joining of the windows' posteriors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np

from probmotion import seeds
from probmotion.lifting.keypoints import PERSON
from probmotion.lifting.window_posterior import WindowPosterior
from probmotion.lifting.window_prior import WindowPrior
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion

__all__ = ["cut", "fitted", "stitched"]

_SECONDS = 2.0  # length of a window
_RATE = 15.0  # approximate rate at which keypoints are averaged, per second
_FEWEST = 8  # frames of a window at this rate
_SMALLEST = (0.02, 0.01)  # coefficients that one camera and several determine, metres


@lru_cache(maxsize=2)
def _prior(frames: int, fps: float, smallest: float) -> WindowPrior:
    """Return the shipped prior for windows; cached per process."""
    return WindowPrior(SpectralMixtureMotion.load("cmu-motion"), frames, fps, smallest)


def cut(frames: int, fps: float, views: int) -> tuple[WindowPrior, list[int], int]:
    """Cut a recording of a number of views into windows that overlap by half.

    Returns the prior of a window, the windows' first frames in steps, and the number of frames of a
    step, which are averaged; raises ``ValueError`` if there are too few frames.
    """
    step = max(1, round(fps / _RATE))
    coarse = frames // step
    if coarse < _FEWEST:
        raise ValueError(
            f"track must have at least {_FEWEST * step} frames at {fps:g} frames per second, got "
            f"{frames}"
        )
    length = min(coarse, round(_SECONDS * fps / step))
    count = max(1, -(-2 * (coarse - length) // length) + 1)
    starts = np.linspace(0, coarse - length, count).round().astype(int).tolist()
    return _prior(length, fps / step, _SMALLEST[views > 1]), starts, step


def fitted(
    posterior: Callable[[int], WindowPosterior],
    starts: Sequence[int],
    update: Callable[[], object],
) -> list[WindowPosterior]:
    """Return the posterior of the window at every start, computed by two threads.

    ``update`` is called after each.
    """
    pool = ThreadPoolExecutor(2)
    try:
        futures = [pool.submit(posterior, start) for start in starts]
        posteriors = []
        for future in futures:
            posteriors.append(future.result())
            update()
    finally:
        pool.shutdown(cancel_futures=True)
    return posteriors


def stitched(
    posteriors: Sequence[WindowPosterior],
    starts: Sequence[int],
    step: int,
    frames: int,
    draws: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (L, J, 3) and draws (n, L, J, 3) of all windows.

    ``starts`` are the windows' first frames in steps of ``step`` frames.
    """
    length, J = posteriors[0].prior.frames * step, PERSON.n_joints
    mean, total = np.zeros((frames, J, 3)), np.zeros((frames, 1, 1))
    chains = np.zeros((draws, frames, J, 3))
    done = 0  # frames that all draws have
    for number, (start, posterior) in enumerate(zip(starts, posteriors, strict=True)):
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
