"""Measures of draws, one file per question: distribution, accuracy, chains, cost."""

from __future__ import annotations

from probmotion.metrics.measures import accuracy_of, measure

__all__ = ["accuracy_of", "measure"]
