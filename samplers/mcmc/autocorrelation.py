"""How many iterations of an ensemble are worth one independent one."""

from __future__ import annotations

import numpy as np

__all__ = ["autocorrelation_time"]

_WINDOW = 5
"""Sokal's c: lags are summed up to the first that is c times the sum so far."""


def autocorrelation_time(trace: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation time of every coordinate of an ensemble.

    Sokal's estimate (1989, with the automatic window of his equation C.2), averaged over walkers.

    Parameters
    ----------
    trace : ndarray, (iterations, walkers, dim)
        At least four iterations of all walkers.

    Returns
    -------
    ndarray, (dim,)
        Iterations; 1 for independent ones, NaN for a coordinate that never moved.

    Notes
    -----
    emcee's own estimate centres each walker at its own mean, which hides the slow part of a run
    that is not much longer than the answer (5 times too small at 2 autocorrelation times). Here
    all walkers, which have one distribution, share their mean.
    """
    n = len(trace)
    apart = trace - trace.mean(axis=(0, 1))
    power = (np.abs(np.fft.rfft(apart, 2 * n, axis=0)) ** 2).mean(axis=1)
    covariance = np.fft.irfft(power, 2 * n, axis=0)[: n // 2]
    covariance /= np.arange(n, n - n // 2, -1)[:, None]
    still = covariance[0] == 0
    correlation = covariance / np.where(still, np.nan, covariance[0])
    times = 2 * np.cumsum(correlation, axis=0) - 1
    long_enough = np.arange(n // 2)[:, None] >= _WINDOW * times
    # Where the run is too short for its window the largest sum is the safest.
    windowed = np.take_along_axis(times, long_enough.argmax(axis=0)[None], axis=0)[0]
    return np.where(long_enough.any(axis=0), windowed, times.max(axis=0))
