"""Integrated autocorrelation time of an ensemble."""

from __future__ import annotations

import numpy as np

__all__ = ["autocorrelation_time"]

_WINDOW = 5
"""Sokal's c: the window is the smallest lag of at least c times the running estimate."""


def autocorrelation_time(trace: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation time of every coordinate.

    Uses Sokal's estimator (1989) with the automatic window of equation C.2, averaged over walkers.

    Parameters
    ----------
    trace : ndarray, (iterations, walkers, dim)
        States of all walkers, at least four iterations.

    Returns
    -------
    ndarray, (dim,)
        Times in iterations; 1 for independent iterations, NaN for a constant coordinate.

    Notes
    -----
    Unlike in emcee, all walkers are centred at their common mean. With one mean per walker, the
    estimate is biased for short runs: 5 times too small for a run of 2 autocorrelation times.
    """
    n = len(trace)
    centred = trace - trace.mean(axis=(0, 1))
    power = (np.abs(np.fft.rfft(centred, 2 * n, axis=0)) ** 2).mean(axis=1)
    covariance = np.fft.irfft(power, 2 * n, axis=0)[: n // 2]
    covariance /= np.arange(n, n - n // 2, -1)[:, None]
    correlation = covariance / np.where(covariance[0] == 0, np.nan, covariance[0])
    times = 2 * np.cumsum(correlation, axis=0) - 1
    long_enough = np.arange(n // 2)[:, None] >= _WINDOW * times
    # If the run is too short for the window, use the largest estimate, which is conservative.
    windowed = np.take_along_axis(times, long_enough.argmax(axis=0)[None], axis=0)[0]
    return np.where(long_enough.any(axis=0), windowed, times.max(axis=0))
