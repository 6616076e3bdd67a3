"""Settings of quick runs: a small budget and cheaper samplers."""

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
"""Reduced settings by sampler; other settings have their defaults."""

QUICK_DRAWS = 200
"""Number of draws per run."""

QUICK_BUDGET = Budget(seconds=6.0)
"""Budget of a run."""

QUICK_LIMIT = 60.0
"""Time limit in seconds of a run, or of the pilots of its budget."""


def quick_samplers(names: Iterable[str] | None = None) -> dict[str, Sampler]:
    """Return samplers with quick settings by name; all registered samplers by default.

    Raises
    ------
    ValueError
        If a name is unknown.
    """
    chosen = importable_samplers() if names is None else names
    return {name: load_sampler(name)(**QUICK.get(name, {})) for name in chosen}
