"""Cutting of a recording into overlapping windows, and joining of the windows' posteriors."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.lifting.keypoints import PERSON
from probmotion.lifting.window_posterior import WindowPosterior, WindowSummary
from probmotion.lifting.window_prior import WindowPrior
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion

__all__ = ["Stitched", "cut", "stitched"]

_SECONDS = 2.0  # length of a window
_RATE = 15.0  # approximate rate at which keypoints are averaged, per second
_FEWEST = 8  # frames of a window at this rate
_AHEAD = 4  # windows that are computed or wait
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


class Stitched(NamedTuple):
    """Mean (L, J, 3) and draws (n, L, J, 3) of all windows, and the windows' summaries."""

    mean: np.ndarray
    draws: np.ndarray
    windows: list[WindowSummary]


def stitched(
    posterior: Callable[[int], WindowPosterior],
    starts: Sequence[int],
    step: int,
    frames: int,
    draws: int,
    seed: int,
    update: Callable[[], object],
) -> Stitched:
    """Return the mean and draws of all windows.

    Parameters
    ----------
    posterior : callable
        Returns the posterior of the window at a start; called by two threads.
    starts : sequence of int
        First frames of the windows, in steps of ``step`` frames.
    step, frames, draws, seed : int
    update : callable
        Called after each window.
    """
    J = PERSON.n_joints
    mean, total = np.zeros((frames, J, 3)), np.zeros((frames, 1, 1))
    chains = np.zeros((draws, frames, J, 3))
    summaries = []
    done = 0  # frames that all draws have
    with closing(_fitted(posterior, starts)) as windows:
        for number, (start, window) in enumerate(zip(starts, windows, strict=True)):
            first = start * step
            last = frames if number == len(starts) - 1 else first + window.prior.frames * step
            times = (np.arange(last - first) - (step - 1) / 2) / step
            ramp = np.minimum(np.arange(last - first) + 1, last - first - np.arange(last - first))
            mean[first:last] += ramp[:, None, None] * window.mean(times)
            total[first:last] += ramp[:, None, None]
            rng = seeds.generator(seed, f"lift {start}")
            # Keep earlier frames up to the middle of the overlap.
            kept = 0 if number == 0 else (done - first) // 2
            if kept > step:
                joined = np.array([kept - 1 - step, kept - 1])
                part = window.sample(rng, draws, times, times[joined], chains[:, first + joined])
            else:
                kept = 0
                part = window.sample(rng, draws, times)
            chains[:, first + kept : last] = part[:, kept:]
            done = last
            summaries.append(window.summary)
            update()
    return Stitched(mean / total, chains, summaries)


def _fitted(
    posterior: Callable[[int], WindowPosterior], starts: Sequence[int]
) -> Generator[WindowPosterior, None, None]:
    """Yield the posterior of the window at every start.

    Few are held at a time: those of ten minutes need 2 GB.
    """
    pool = ThreadPoolExecutor(2)
    waiting: deque[Future[WindowPosterior]] = deque()
    try:
        for start in starts:
            waiting.append(pool.submit(posterior, start))
            if len(waiting) == _AHEAD:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
