"""`Comparison`: the results of a grid with its figures and its report."""

from __future__ import annotations

from pathlib import Path

from probmotion.calibration.result import Calibration
from probmotion.comparison.results.grid_results import GridResults
from probmotion.plots.quality import plot_quality_against_cost
from probmotion.report.page import write_report

__all__ = ["Comparison"]

_FIGURE = "quality_against_cost.png"


class Comparison(GridResults):
    """What every sampler drew on every problem, and what was measured of it.

    See :class:`~probmotion.comparison.results.grid_results.GridResults` for its table and draws.
    """

    def plot(self, path: str | Path | None = None) -> Path:
        """Draw quality against cost and return where; beside the cells by default."""
        target = self.folder / _FIGURE if path is None else Path(path)
        plot_quality_against_cost(self.table(), target)
        return target

    def report(self, path: str | Path, calibration: Calibration | None = None) -> Path:
        """Write one page, ``.html``, that opens offline: tables, plots, draws that play."""
        return write_report(self, path, calibration)
