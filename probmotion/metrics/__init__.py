"""Measures of draws, one file per question: distribution, accuracy, chains, cost."""

from __future__ import annotations

from importlib import import_module

from probmotion.metrics.measures import accuracy_of, measure

__all__ = ["accuracy_of", "load_libraries", "measure"]

_LATE = (
    "arviz_stats.base",
    "scipy.spatial.distance",
    "sklearn.decomposition",
    "sklearn.model_selection",
    "sklearn.svm",
)


def load_libraries() -> None:
    """Import what measures import when they are first asked, so that no cell's clock counts it."""
    for name in _LATE:
        import_module(name)
