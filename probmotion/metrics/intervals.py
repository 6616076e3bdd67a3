"""Confidence intervals over seeds, and samplers statistically tied with the best.

For each seed, samplers are compared on the same problem, reference draws and directions, so paired
differences are free of the variation between seeds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from probmotion.validation import check_shape

__all__ = ["best_and_tied", "t_interval"]

# Standard deviation of the difference of two values rounded to integers.
_TWO_ROUNDINGS = 1 / math.sqrt(6)


def t_interval(values: Sequence[float] | np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Return Student's confidence interval for the mean of independent normal values.

    Parameters
    ----------
    values : sequence of float, (n,)
        One value or paired difference per seed; the interval is infinite for n = 1.
    level : float
        Confidence level, between 0 and 1.
    """
    from scipy import stats

    values = np.asarray(values, np.float64)
    check_shape("values", values, ("n",))
    if not len(values) or not np.isfinite(values).all():
        raise ValueError(f"values must be one or more finite numbers, got {values.tolist()}")
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1, got {level!r}")
    n = len(values)
    if n == 1:
        return -math.inf, math.inf
    mean = float(values.mean())
    half_width = float(stats.t.isf((1 - level) / 2, n - 1) * values.std(ddof=1) / math.sqrt(n))
    return mean - half_width, mean + half_width


def best_and_tied(
    values: Mapping[str, Sequence[float]],
    *,
    target: float | None,
    ratio: bool = False,
    lower_is_better: bool = True,
    level: float = 0.95,
    step: float = 0.0,
) -> tuple[str, set[str]]:
    """Return the best sampler and the set of samplers statistically tied with it, itself included.

    The best has the lowest mean error over seeds. A sampler is worse if the Holm-corrected Student
    interval of its paired differences to the best, over common seeds, is above 0 (Holm 1979). The
    most significant of m differences has level 1 − .05/m, the next 1 − .05/(m − 1), and so on until
    an interval includes 0. With one seed, all samplers are tied. The standard deviation of
    differences is at least that of the difference of two values rounded to ``step``.

    The set contains the truly best sampler with probability ≥ .95. The probability that it contains
    only one of several equal samplers is ≤ .05. Since the best is selected from the same values,
    the probability that any of ten equal samplers is excluded is about .1.

    Parameters
    ----------
    values : mapping of str to sequence of float
        One value per seed for each sampler, seeds in the same order; NaN for a failed run. Samplers
        without values or with an infinite error are excluded. The best is one of the samplers with
        the fewest failed runs.
    target : float or None
        Ideal value; the error is the distance from it. If None, the value is the error.
    ratio : bool
        Whether the distance is abs(log(value/target)) instead of abs(value − target).
    lower_is_better : bool
        Whether lower values are better, if ``target`` is None.
    level : float
        Joint confidence level; the probabilities above are for .95.
    step : float
        Rounding step of the values; 0 if they are not rounded.
    """
    errors = _errors(values, target, ratio, lower_is_better)
    n_seeds = {name: np.isfinite(row).sum() for name, row in errors.items()}
    complete = [name for name in errors if n_seeds[name] == max(n_seeds.values())]
    best = min(complete, key=lambda name: float(np.nanmean(errors[name])))
    paired = {}
    for name, row in errors.items():
        differences = row - errors[best]
        paired[name] = differences[np.isfinite(differences)]
    p_values = {name: _tail(paired[name], _TWO_ROUNDINGS * step) for name in set(errors) - {best}}
    tied = set(errors)
    for rank, name in enumerate(sorted(p_values, key=lambda name: p_values[name])):
        if 2 * p_values[name] >= (1 - level) / (len(p_values) - rank):
            break
        tied.remove(name)
    return best, tied


def _errors(
    values: Mapping[str, Sequence[float]],
    target: float | None,
    ratio: bool,
    lower_is_better: bool,
) -> dict[str, np.ndarray]:
    """Return the errors of each sampler, one per seed; lower is better."""
    if ratio and (target is None or target <= 0):
        raise ValueError(f"target must be above 0 for a ratio, got {target!r}")
    rows = {name: np.asarray(row, np.float64) for name, row in values.items()}
    if len({row.shape for row in rows.values()}) > 1:
        lengths = ", ".join(f"{name} {len(row)}" for name, row in rows.items())
        raise ValueError(f"values must have equal numbers of seeds, got {lengths}")
    errors = {}
    for name, row in rows.items():
        check_shape(f"values of {name}", row, ("n",))
        if ratio and (row < 0).any():
            raise ValueError(f"values of {name} must be at least 0, got {row.min()}")
        if target is None:
            error = row if lower_is_better else -row
        elif ratio:
            with np.errstate(divide="ignore"):
                error = np.abs(np.log(row / target))
        else:
            error = np.abs(row - target)
        if np.isfinite(error).any() and not np.isinf(error).any():
            errors[name] = error
    if not errors:
        raise ValueError("values must contain a sampler with a finite value, got none")
    return errors


def _tail(differences: np.ndarray, least_spread: float) -> float:
    """Return the p-value of the one-sided t-test that the mean difference is above 0."""
    from scipy import stats

    n = len(differences)
    if n < 2:
        return 1.0
    mean = float(differences.mean())
    spread = max(float(differences.std(ddof=1)), least_spread)
    if spread == 0:
        return 0.0 if mean > 0 else 1.0
    return float(stats.t.sf(mean / (spread / math.sqrt(n)), n - 1))
