"""Which sampler, and how wrong is it? The grid problem × sampler × seed, and its table."""

from __future__ import annotations

from probmotion.comparison.grid import compare
from probmotion.comparison.quick import QUICK, quick_samplers
from probmotion.comparison.result import Comparison

__all__ = ["QUICK", "Comparison", "compare", "quick_samplers"]
