"""What each of a sampler's approximations does to its draws, on problems whose truth is known."""

from __future__ import annotations

from probmotion.bias.budget import bias_budget
from probmotion.bias.result import BiasBudget

__all__ = ["BiasBudget", "bias_budget"]
