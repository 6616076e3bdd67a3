"""Budgets, and sampler settings that use the same budget on a problem.

A sampler class lists the settings that determine its cost in ``effort``: the first is tuned, the
others are scaled in proportion, and ``least_effort`` is the smallest useful value of the first.
Pilot runs, each with 2 to 8 times the effort of the previous one, measure the cost, which is linear
in the effort for all samplers of this package except NUTS. With a budget in seconds the first pilot
runs twice, to exclude compilation, and pilots are repeated if their costs are not linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior
from probmotion.validation import check_count, check_positive

__all__ = ["Budget", "affordable", "effort_of"]

# Costs of evaluations that are not 1: a gradient costs 2, because it also computes the value.
_WEIGHTS = {"gradient": 2}
# Pilots stop once they cost more than the first fraction of the budget; they aim at the second.
_ENOUGH, _TARGET = 0.25, 0.3
# Minimum and maximum growth factor of the effort between pilots.
_GROWTH = 2, 8
# The effort is not tuned if the cost has not increased at this multiple of the given effort.
_MULTIPLE = 64
# Relative noise of measured times; evaluation counts are exact.
_NOISE = 0.1
# Maximum relative deviation of the last pilot from the line through the previous two.
_DEVIATION = 0.15


@dataclass(frozen=True)
class Budget:
    """Cost of a run, equal for all samplers, either in evaluations or in seconds.

    Parameters
    ----------
    evaluations : int, optional
        Number of evaluations of the denoiser, its covariance or the density, for one motion (one
        view of a 2D denoiser). A gradient counts as two evaluations, a training step of a network
        as one gradient.
    seconds : float, optional
        Wall-clock time on the machine that runs the grid.

    Raises
    ------
    ValueError
        If both or neither are given, or a number is out of range.
    """

    evaluations: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        if (self.evaluations is None) == (self.seconds is None):
            raise ValueError(
                "a budget must have either evaluations or seconds, "
                f"got {self.evaluations} and {self.seconds}"
            )
        if self.evaluations is not None:
            check_count("evaluations", self.evaluations)
        if self.seconds is not None:
            check_positive("seconds", self.seconds)
            # Budgets of 6 and 6.0 seconds are equal, with equal fingerprints.
            object.__setattr__(self, "seconds", float(self.seconds))

    @property
    def amount(self) -> float:
        """Number of evaluations or seconds."""
        given = self.seconds if self.evaluations is None else self.evaluations
        assert given is not None
        return float(given)

    def spent(self, draws: MotionDraws) -> float:
        """Return the cost of a run in the unit of the budget."""
        if self.evaluations is None:
            return draws.seconds
        return float(sum(_WEIGHTS.get(kind, 1) * count for kind, count in draws.counts.items()))

    def words(self, amount: float) -> str:
        """Return an amount with its unit."""
        if self.evaluations is None:
            return f"{amount:.3g} seconds"
        return f"{round(amount):,} evaluations".replace(",", " ")

    def __str__(self) -> str:
        if self.evaluations is None:
            return self.words(self.amount)
        return f"{self.words(self.amount)} (a gradient counts 2, any other 1)"


def effort_of(sampler: Sampler) -> tuple[str, ...]:
    """Return the settings that determine a sampler's cost, the tuned one first."""
    named: Any = getattr(sampler, "effort", ())
    return (named,) if isinstance(named, str) else tuple(named)


def affordable(
    budget: Budget, sampler: Sampler, pilot: Callable[[Sampler], float]
) -> dict[str, int]:
    """Return the settings with which a sampler uses a budget; empty if no effort affects its cost.

    The effort is the largest whose cost, extrapolated from the last two pilots, is within the
    budget.

    Parameters
    ----------
    budget : Budget
        Budget of a run.
    sampler : Sampler
        Sampler with its original settings.
    pilot : callable
        Function that runs a sampler and returns its cost in the unit of the budget.

    Raises
    ------
    UnsupportedPosterior
        If the least effort exceeds the budget (failure word ``budget``).
    """
    if not effort_of(sampler):
        return {}
    given = getattr(sampler, effort_of(sampler)[0])
    effort = _least(sampler)
    costs = [(effort, pilot(_with(sampler, effort)))]
    if budget.seconds is not None:
        # The first run may include compilation.
        costs = [(effort, min(costs[0][1], pilot(_with(sampler, effort))))]
    if costs[0][1] > budget.amount:
        settings = ", ".join(f"{name}={n}" for name, n in _settings(sampler, effort).items())
        raise UnsupportedPosterior(
            sampler.name,
            f"needs {budget.words(costs[0][1])} with {settings}; the budget "
            f"is {budget.words(budget.amount)}",
            word="budget",
        )
    noise = _NOISE if budget.evaluations is None else 0.0
    enough, target = (part * (budget.amount - costs[0][1]) for part in (_ENOUGH, _TARGET))
    while costs[-1][1] - costs[0][1] <= enough:
        proposed = _next_effort(costs, costs[0][1] + target)
        effort = _within_range(sampler, costs[-1][0], proposed)
        if effort == costs[-1][0]:
            break
        if effort > _MULTIPLE * given and costs[-1][1] <= (1 + noise) * costs[-2][1]:
            return {}
        costs.append((effort, pilot(_with(sampler, effort))))
    if budget.seconds is not None:
        for index in range(-3, 0):
            if _is_nonlinear(costs) and sum(seconds for _, seconds in costs) < budget.amount:
                effort, seconds = costs[index]
                costs[index] = effort, min(seconds, pilot(_with(sampler, effort)))
    return _settings(sampler, _within_range(sampler, costs[0][0], _solve(costs, budget.amount)))


def _next_effort(costs: list[tuple[int, float]], target: float) -> int:
    """Return the effort of the next pilot for a target cost, with bounded growth."""
    least, most = _GROWTH
    effort, spent = costs[-1]
    if len(costs) == 1 and spent > 0:
        # The fixed cost is unknown and assumed to be zero.
        growth = target / spent
    elif len(costs) > 1 and spent > costs[-2][1]:
        growth = _solve(costs, target) / effort
    else:
        growth = most
    return math.ceil(effort * min(max(growth, least), most))


def _is_nonlinear(costs: list[tuple[int, float]]) -> bool:
    """Whether the last pilot deviates from the line through the previous two."""
    if len(costs) < 3:
        return False
    (x0, y0), (x1, y1), (x2, y2) = costs[-3:]
    predicted = y1 + (y1 - y0) * (x2 - x1) / (x1 - x0)
    return abs(y2 - predicted) > _DEVIATION * y2


def _solve(costs: list[tuple[int, float]], amount: float) -> int:
    """Return the effort at which the line through the last two pilots reaches an amount."""
    if len(costs) == 1:
        return costs[0][0]
    (x0, y0), (x1, y1) = costs[-2:]
    if y1 <= y0:
        return x1
    solution = x0 + (amount - y0) * (x1 - x0) / (y1 - y0)
    # The tolerance prevents rounding errors just below an integer.
    return max(costs[0][0], int(solution + 1e-9 * abs(solution)))


def _settings(sampler: Sampler, effort: int) -> dict[str, int]:
    first, *others = effort_of(sampler)
    given = getattr(sampler, first)
    scaled = {}
    for name in others:
        value = getattr(sampler, name)
        scaled[name] = max(min(value, 1), round(value * effort / given)) if given else value
    return {first: effort, **scaled}


def _with(sampler: Any, effort: int) -> Any:
    return replace(sampler, **_settings(sampler, effort))


def _accepts(sampler: Sampler, effort: int) -> bool:
    try:
        _with(sampler, effort)
    except ValueError:
        return False
    return True


def _least(sampler: Sampler) -> int:
    """Return the smallest useful effort that the sampler's other settings allow."""
    effort = getattr(sampler, "least_effort", 1)
    given = getattr(sampler, effort_of(sampler)[0])
    return next((e for e in range(effort, given) if _accepts(sampler, e)), given)


def _within_range(sampler: Sampler, low: int, high: int) -> int:
    """Return the largest effort up to ``high`` that the sampler's other settings allow."""
    if _accepts(sampler, high):
        return high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _accepts(sampler, middle) else (low, middle)
    return low
