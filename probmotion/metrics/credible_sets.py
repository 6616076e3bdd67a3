"""Credible sets: the level of the smallest one that holds a truth, by its rank."""

from __future__ import annotations

import numpy as np

__all__ = ["DENSITY", "DISTANCE", "credible_level"]

DENSITY, DISTANCE = "log density", "distance"
"""Quantities whose credible sets are not central intervals."""


def credible_level(quantity: str, ranks: np.ndarray) -> np.ndarray:
    """Return the level of the smallest credible set that holds the truth, by its rank in [0, 1].

    Of :data:`DENSITY` the set of highest density (Hermans et al. 2022, "A crisis in
    simulation-based inference?"); of :data:`DISTANCE` the ball about a random point (Lemos et al.
    2023, "Sampling-based accuracy testing of posterior estimators"); of any other quantity the
    central interval.
    """
    if quantity == DENSITY:
        return 1 - ranks
    return ranks if quantity == DISTANCE else np.abs(2 * ranks - 1)
