"""Static pictures of motions and of comparisons."""

from __future__ import annotations

from probmotion.pictures.plots import plot_quality_against_cost
from probmotion.pictures.skeletons import draw_skeletons

__all__ = ["draw_skeletons", "plot_quality_against_cost"]
