"""Figures of a comparison: quality against cost, skeletons of draws, and their spread."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.comparison.results.headline_metrics import headline_metric
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.plots.motion_data import choose_draws
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.quality import plot_quality_against_cost
from probmotion.plots.skeletons import draw_skeletons
from probmotion.plots.spread import plot_spread
from probmotion.plots.style import finish_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from probmotion.comparison.results.grid_results import GridResults
    from probmotion.motion.skeleton import Skeleton
    from probmotion.posteriors.problem import Problem

__all__ = ["draw_comparison"]

_DRAWS = 4  # draws per sampler
_POSES = 6  # poses per sampler of problems with held-out poses
_SPREAD = 100  # draws per sampler and reference draws of the spread
_SIDE_VIEW = np.pi / 2 - 0.35
"""Heading of bodies without observations, radians."""


def draw_comparison(
    comparison: GridResults, problems: Iterable[Problem], folder: str | Path
) -> list[Path]:
    """Write the figures of a comparison, each as PNG and PDF, and return their paths.

    The figures are ``quality_against_cost``, ``skeletons_<problem>`` and, for problems with
    observations, ``spread_<problem>`` of at most 100 draws per sampler. The quality plot is omitted
    if no headline metric was measured. With observations, motions are viewed at a right angle to
    the first camera, if any, with the truth in grey.

    Parameters
    ----------
    comparison : GridResults
        Results of a grid.
    problems : iterable of Problem
        Problems to draw.
    folder : str or Path
        Existing folder.

    Raises
    ------
    ValueError
        If a problem has neither draws nor references.
    """
    figures: dict[str, Figure] = {}
    table = comparison.table()
    if headline_metric(table):
        figures["quality_against_cost"] = plot_quality_against_cost(
            table, verdicts=comparison.verdicts()
        )
    for problem in problems:
        figures |= _draw_problem(comparison, problem)
    paths = [Path(folder) / f"{name}{suffix}" for name in figures for suffix in (".png", ".pdf")]
    for path in paths:
        finish_figure(figures[path.stem], path)
    return paths


def _draw_problem(comparison: GridResults, problem: Problem) -> dict[str, Figure]:
    """Return figures of each sampler's draws of a problem below exact or reference draws."""
    draws = {
        result.sampler: choose_draws(comparison.draws(problem.name, result.sampler).flat(), _SPREAD)
        for result in comparison.results
        if result.problem == problem.name and result.seed == 0 and result.failure is None
    }
    if "exact" in draws:
        draws = {"exact": draws.pop("exact")} | draws
    elif problem.has_reference:
        label = "reference" if problem.exact_source is None else "exact draws"
        n = _SPREAD if problem.stored is None else min(_SPREAD, problem.stored.n)
        draws = {label: problem.reference(0, n)} | draws
    if not draws:
        raise ValueError(f"problem must have draws or references, got none for {problem.name!r}")
    shown = _DRAWS if problem.held_out is None else _POSES
    # Choose evenly spaced draws, because consecutive draws of a chain are similar.
    rows = {label: motions[:: max(1, len(motions) // shown)] for label, motions in draws.items()}
    name = f"skeletons_{problem.name}"
    skeleton, likelihood = problem.posterior.skeleton, problem.posterior.likelihood
    if problem.held_out is not None:
        return {name: _draw_poses({"held out": problem.held_out} | rows, skeleton, problem.name)}
    if likelihood is None:
        heading = _SIDE_VIEW if skeleton.mirrored_pairs else None
        return {name: draw_skeletons(rows, skeleton, heading=heading, title=problem.name)}
    cameras = getattr(likelihood, "cameras", None)
    view: dict[str, Any] = {
        "azimuth": 0.0 if cameras is None else float(cameras.azimuth[0]) + np.pi / 2,
        "truth": problem.truth,
        "title": problem.name + ("" if cameras is None else ", viewed at 90° to the camera"),
    }
    figures = {name: draw_skeletons(rows, skeleton, **view)}
    several = {label: motions for label, motions in draws.items() if len(motions) > 1}
    if several:
        figures[f"spread_{problem.name}"] = plot_spread(several, skeleton, **view)
    return figures


def _draw_poses(rows: dict[str, np.ndarray], skeleton: Skeleton, title: str) -> Figure:
    """Return a figure of evenly spaced poses of each row, (n, 1, J, 3), aligned with the first."""
    chosen = {
        label: motions[:: max(1, len(motions) // _POSES), 0][:_POSES]
        for label, motions in rows.items()
    }
    first = next(iter(chosen.values()))[0]
    chosen = {
        label: align_rigidly(poses, np.broadcast_to(first, poses.shape))
        for label, poses in chosen.items()
    }
    return draw_pairs(chosen, skeleton, columns=_POSES, azimuth=0.6, elevation=0.2, title=title)
