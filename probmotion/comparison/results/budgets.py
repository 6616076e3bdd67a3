"""Equal budgets: how much of its setting of effort a sampler can afford on a problem.

A sampler's class names in ``effort`` the settings that its cost grows with, the first one counted
in its own units and the others kept in proportion to it, and in ``least_effort`` the smallest
value that makes sense. Pilot runs, each of 2 to 8 times the effort of the one before, show what a
unit of it costs; the cost is a straight line in all of ours but NUTS, whose trajectories adapt. Of
seconds the first pilot is run twice: libraries compile at the first. And what else a machine does
adds to some: where the last three are not on a line they are run again, the cheapest first, until
they are, or the pilots have cost as much as the budget.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior
from probmotion.validation import check_count, check_positive

__all__ = ["Budget", "affordable", "check_budget", "effort_of"]

# What an evaluation counts, if not 1; a gradient comes with its value, which costs about as much.
_WORTH = {"gradient": 2}
# The pilots end when they have shown this share of what the effort may cost; each aims at a little
# more, so that the last is not missed by as little.
_SHOWN, _WANTED = 0.25, 0.3
# How much more effort the next pilot has: the less has been spent, the more.
_GROWTH = 2, 8
# A sampler whose cost has not grown at this multiple of the effort that it was given has none, as
# one whose network is trained already. Evaluations are counted; seconds vary by this share.
_MULTIPLE = 64
_NOISE = 0.1
# The last pilot is off the line through the two before it by more than this share of its seconds.
_BENT = 0.15


@dataclass(frozen=True)
class Budget:
    """What every sampler may spend on a cell: evaluations or seconds, one of them.

    Parameters
    ----------
    evaluations : int, optional
        All that the sampler counts, each of one motion (one view of one motion for a 2D denoiser):
        of denoiser, its covariance and the density 1 each, of a gradient 2. A gradient step of a
        network that a sampler trains is one gradient.
    seconds : float, optional
        Of the clock, on the machine where the cells run.

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
                f"Budget has evaluations {self.evaluations} and seconds {self.seconds}, expected "
                "one of them"
            )
        if self.evaluations is not None:
            check_count("evaluations", self.evaluations)
        if self.seconds is not None:
            check_positive("seconds", self.seconds)
            # 6 and 6.0 are one budget.
            object.__setattr__(self, "seconds", float(self.seconds))

    @property
    def amount(self) -> float:
        """The number that was given."""
        given = self.seconds if self.evaluations is None else self.evaluations
        assert given is not None
        return float(given)

    def spent(self, draws: MotionDraws) -> float:
        """Return what a run cost, in the budget's unit."""
        if self.evaluations is None:
            return draws.seconds
        return float(sum(_WORTH.get(kind, 1) * count for kind, count in draws.counts.items()))

    def words(self, amount: float) -> str:
        """Return an amount with its unit."""
        if self.evaluations is None:
            return f"{amount:.3g} seconds"
        return f"{round(amount):,} evaluations".replace(",", " ")

    def __str__(self) -> str:
        if self.evaluations is None:
            return self.words(self.amount)
        return f"{self.words(self.amount)} (a gradient counts 2, any other 1)"


def check_budget(budget: object) -> None:
    """Raise ``ValueError`` unless it is a budget or None."""
    if budget is not None and not isinstance(budget, Budget):
        raise ValueError(f"budget must be a Budget, got {budget!r}")


def effort_of(sampler: Sampler) -> tuple[str, ...]:
    """Return the settings that a sampler's cost grows with, the one that is counted first."""
    named: Any = getattr(sampler, "effort", ())
    return (named,) if isinstance(named, str) else tuple(named)


def affordable(
    budget: Budget, sampler: Sampler, pilot: Callable[[Sampler], float]
) -> dict[str, int]:
    """Return the settings with which a sampler spends a budget, or none if it has no such setting.

    The largest effort whose cost, by a line through the last two pilots, is within the budget.

    Parameters
    ----------
    budget : Budget
        What it may spend.
    sampler : Sampler
        With the settings that were asked for.
    pilot : callable
        Runs a sampler and returns what it spent.

    Raises
    ------
    UnsupportedPosterior
        If the least effort already costs more; its word is ``budget``.
    """
    if not effort_of(sampler):
        return {}
    given = getattr(sampler, effort_of(sampler)[0])
    effort = _least(sampler)
    costs = [(effort, pilot(_with(sampler, effort)))]
    if budget.seconds is not None:
        # What is compiled at the first run is there for all that follow.
        costs = [(effort, min(costs[0][1], pilot(_with(sampler, effort))))]
    if costs[0][1] > budget.amount:
        raise UnsupportedPosterior(
            sampler.name,
            f"needs {budget.words(costs[0][1])} with {_in_words(sampler, effort)}, and the budget "
            f"is {budget.words(budget.amount)}",
            word="budget",
        )
    noise = _NOISE if budget.evaluations is None else 0.0
    shown, wanted = (share * (budget.amount - costs[0][1]) for share in (_SHOWN, _WANTED))
    while costs[-1][1] - costs[0][1] <= shown:
        next_one = _next_effort(costs, costs[0][1] + wanted)
        effort = _within_range(sampler, costs[-1][0], next_one)
        if effort == costs[-1][0]:
            break
        if effort > _MULTIPLE * given and costs[-1][1] <= (1 + noise) * costs[-2][1]:
            return {}
        costs.append((effort, pilot(_with(sampler, effort))))
    if budget.seconds is not None:
        for place in range(-3, 0):
            if _bends(costs) and sum(seconds for _, seconds in costs) < budget.amount:
                effort, seconds = costs[place]
                costs[place] = effort, min(seconds, pilot(_with(sampler, effort)))
    return _settings(sampler, _within_range(sampler, costs[0][0], _solve(costs, budget.amount)))


def _next_effort(costs: list[tuple[int, float]], wanted: float) -> int:
    """Return the next pilot's effort: towards what is wanted, within bounds on its growth."""
    least, most = _GROWTH
    effort, spent = costs[-1]
    if len(costs) == 1 and spent > 0:
        # Of this it is not known how much every run must spend: no more than all of it.
        growth = wanted / spent
    elif len(costs) > 1 and spent > costs[-2][1]:
        growth = _solve(costs, wanted) / effort
    else:
        growth = most
    return math.ceil(effort * min(max(growth, least), most))


def _bends(costs: list[tuple[int, float]]) -> bool:
    """Whether the last pilot did not cost what the line through the two before it says."""
    if len(costs) < 3:
        return False
    (low, cheap), (middle, dearer), (high, dear) = costs[-3:]
    foreseen = dearer + (dearer - cheap) * (high - middle) / (middle - low)
    return abs(dear - foreseen) > _BENT * dear


def _solve(costs: list[tuple[int, float]], amount: float) -> int:
    """Return where the line through the last two pilots meets the amount."""
    if len(costs) == 1:
        return costs[0][0]
    (low, cheap), (high, dear) = costs[-2:]
    if dear <= cheap:
        return high
    meets = low + (amount - cheap) * (high - low) / (dear - cheap)
    # A whole number is not missed by rounding.
    return max(costs[0][0], int(meets + 1e-9 * abs(meets)))


def _settings(sampler: Sampler, effort: int) -> dict[str, int]:
    first, *others = effort_of(sampler)
    given = getattr(sampler, first)
    scaled = {}
    for name in others:
        value = getattr(sampler, name)
        scaled[name] = max(min(value, 1), round(value * effort / given))
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
    """The smallest effort that makes sense and that the sampler's other settings allow."""
    effort = getattr(sampler, "least_effort", 1)
    given = getattr(sampler, effort_of(sampler)[0])
    return next((e for e in range(effort, given) if _accepts(sampler, e)), given)


def _within_range(sampler: Sampler, low: int, high: int) -> int:
    """The largest effort up to ``high`` that the sampler's other settings allow."""
    if _accepts(sampler, high):
        return high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if _accepts(sampler, middle) else (low, middle)
    return low


def _in_words(sampler: Sampler, effort: int) -> str:
    return ", ".join(f"{name}={value}" for name, value in _settings(sampler, effort).items())
