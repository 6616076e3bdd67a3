"""Which sampler, and how wrong is it? The grid problem × sampler × seed, and its table."""

from __future__ import annotations

from probmotion.comparison.budgets import Budget
from probmotion.comparison.grid import compare
from probmotion.comparison.quick import (
    QUICK,
    QUICK_BUDGET,
    QUICK_DRAWS,
    QUICK_LIMIT,
    quick_samplers,
)
from probmotion.comparison.result import Comparison

__all__ = [
    "QUICK",
    "QUICK_BUDGET",
    "QUICK_DRAWS",
    "QUICK_LIMIT",
    "Budget",
    "Comparison",
    "compare",
    "quick_samplers",
]
