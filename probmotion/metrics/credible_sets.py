"""Levels of the smallest credible sets that contain the truth, computed from ranks."""

from __future__ import annotations

import numpy as np

__all__ = ["DENSITY", "DISTANCE", "credible_level"]

# Quantities whose credible sets are not central intervals.
DENSITY, DISTANCE = "log density", "distance"


def credible_level(quantity: str, ranks: np.ndarray) -> np.ndarray:
    """Return the level of the smallest credible set that contains the truth of rank in [0, 1].

    The set is a highest-density region for :data:`DENSITY` (Hermans et al. 2022, "A crisis in
    simulation-based inference?"), a ball around a random point for :data:`DISTANCE` (Lemos et al.
    2023, "Sampling-based accuracy testing of posterior estimators") and else a central interval.
    """
    if quantity == DENSITY:
        return 1 - ranks
    return ranks if quantity == DISTANCE else np.abs(2 * ranks - 1)
