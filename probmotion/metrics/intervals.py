"""Is a difference between samplers more than chance? Means over seeds, with intervals.

Every sampler meets the same problem, exact draws and directions at one seed, so that samplers are
compared seed by seed: what a seed makes hard for all of them drops out of the difference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from probmotion.validation import check_shape

__all__ = ["best_and_tied", "t_interval"]


def t_interval(values: Sequence[float] | np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Return Student's interval of the mean that the values scatter around.

    It holds that mean with probability ``level`` if they are independent and normal; of values
    that a seed pairs, hand in the differences.

    Parameters
    ----------
    values : sequence of float, (n,)
        One per seed. With one there is no spread to be seen, and the interval is all numbers.
    level : float
        Between 0 and 1.

    Raises
    ------
    ValueError
        If there is no value, one is not finite, or the level is out of range.
    """
    from scipy import stats

    values = np.asarray(values, np.float64)
    check_shape("values", values, ("n",))
    if not len(values) or not np.isfinite(values).all():
        raise ValueError(f"values must be at least one, all finite, got {values.tolist()}")
    if not 0 < level < 1:
        raise ValueError(f"level must be a number between 0 and 1, got {level!r}")
    n = len(values)
    if n == 1:
        return -math.inf, math.inf
    middle = float(values.mean())
    reach = float(stats.t.isf((1 - level) / 2, n - 1) * values.std(ddof=1) / math.sqrt(n))
    return middle - reach, middle + reach


def best_and_tied(
    values: Mapping[str, Sequence[float]],
    *,
    target: float | None,
    ratio: bool = False,
    lower_is_better: bool = True,
    level: float = 0.95,
    step: float = 0.0,
) -> tuple[str, set[str]]:
    """Return the best sampler, and all that are not distinguishable from it, itself among them.

    The best has the lowest mean over seeds. Another is left out if Student's interval of its
    paired differences to the best, over the seeds that both have, lies above 0. The intervals are
    at Holm's levels (Holm 1979): the clearest of m others at 1 − .05/m, the next at 1 − .05/(m −
    1), and so on until one holds 0; it and all after it are tied. With one seed nothing is
    distinguishable, and all are tied.

    Differences of values that are rounded scatter at least as two roundings do: a share of 20 draws
    moves by twentieths, and two seeds with the same difference do not show that it has no spread.

    So the truly best is among the tied with probability .95 or more, and one of equals stands alone
    with .05 or less. That *some* one of many equals is left out is likelier, about .1 of ten,
    because the best is chosen by the same values.

    Parameters
    ----------
    values : mapping of str to sequence of float
        By sampler one value per seed, the seeds in the same order for all; NaN where a run failed
        or is not there. A sampler with no value is not compared; one that lacks a seed which
        another has is not the best. One with an infinite error is neither best nor tied.
    target : float or None
        The right value, for a measure that has one: the error is the distance from it, seed by
        seed. None where the value itself is the error.
    ratio : bool
        Whether the distance is |log(value/target)|, so that half is as wrong as double.
    lower_is_better : bool
        For a measure without a target.
    level : float
        Of the intervals together.
    step : float
        What values are rounded to; 0 if they are not.

    Raises
    ------
    ValueError
        If samplers have different numbers of seeds, none has a finite error, or a ratio has a
        target or value below 0.
    """
    errors = _errors(values, target, ratio, lower_is_better)
    found = {name: np.isfinite(row).sum() for name, row in errors.items()}
    complete = [name for name in errors if found[name] == max(found.values())]
    best = min(complete, key=lambda name: float(np.nanmean(errors[name])))
    apart = {}
    for name, row in errors.items():
        differences = row - errors[best]
        apart[name] = differences[np.isfinite(differences)]
    chance = {name: _tail(apart[name], _TWO_ROUNDINGS * step) for name in set(errors) - {best}}
    tied = set(errors)
    for rank, name in enumerate(sorted(chance, key=lambda name: chance[name])):
        if 2 * chance[name] >= (1 - level) / (len(chance) - rank):
            break
        tied.remove(name)
    return best, tied


def _errors(
    values: Mapping[str, Sequence[float]],
    target: float | None,
    ratio: bool,
    lower_is_better: bool,
) -> dict[str, np.ndarray]:
    """Return by sampler how wrong it is, one number per seed; lower is better."""
    if ratio and (target is None or target <= 0):
        raise ValueError(f"target must be a number above 0 for a ratio, got {target!r}")
    rows = {name: np.asarray(row, np.float64) for name, row in values.items()}
    if len({row.shape for row in rows.values()}) > 1:
        lengths = ", ".join(f"{name} {len(row)}" for name, row in rows.items())
        raise ValueError(f"values has different numbers of seeds: {lengths}")
    errors = {}
    for name, row in rows.items():
        check_shape(f"values of {name}", row, ("n",))
        if ratio and (row < 0).any():
            raise ValueError(f"values of {name} has {row.min()}, expected ratios of at least 0")
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
        raise ValueError("values has no sampler with a finite value, expected at least one")
    return errors


_TWO_ROUNDINGS = 1 / math.sqrt(6)
"""Standard deviation of the difference of two values that are rounded to whole numbers."""


def _tail(differences: np.ndarray, least_spread: float) -> float:
    """Return the probability of differences so clearly above 0 by chance."""
    from scipy import stats

    n = len(differences)
    if n < 2:
        return 1.0
    middle = float(differences.mean())
    spread = max(float(differences.std(ddof=1)), least_spread)
    if spread == 0:
        return 0.0 if middle > 0 else 1.0
    return float(stats.t.sf(middle / (spread / math.sqrt(n)), n - 1))
