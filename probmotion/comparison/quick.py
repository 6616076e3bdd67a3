"""What makes a look at many problems quick: few draws, few seconds, and settings that cost less.

Nothing of it is used unless asked for, and all of it is printed under the table and stored with the
draws like any other.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from probmotion.comparison.results.budgets import Budget
from probmotion.posteriors.sampling import Sampler, importable_samplers, load_sampler

__all__ = ["QUICK", "QUICK_BUDGET", "QUICK_DRAWS", "QUICK_LIMIT", "quick_samplers"]

QUICK: Mapping[str, Mapping[str, Any]] = {
    "sds": {"iterations": 2000},
    "dvae": {"training_steps": 600, "training_pairs": 8000},
}
"""By sampler: the settings that differ from its own defaults."""

QUICK_DRAWS = 40
"""Of a cell."""

QUICK_BUDGET = Budget(seconds=6.0)
"""Of a cell."""

QUICK_LIMIT = 60.0
"""Seconds after which a cell, or the pilots of its budget, is given up (``time_limit``)."""


def quick_samplers(names: Iterable[str] | None = None) -> dict[str, Sampler]:
    """Return samplers with their quick settings, by name; all registered ones by default.

    Raises
    ------
    ValueError
        If a name is unknown; the message lists the known ones.
    """
    chosen = importable_samplers() if names is None else names
    return {name: load_sampler(name)(**QUICK.get(name, {})) for name in chosen}
