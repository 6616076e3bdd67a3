"""Figures of a comparison: quality against cost, and skeletons of every sampler's draws."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.headline_metrics import headline_metric
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.quality import plot_quality_against_cost
from probmotion.plots.skeletons import draw_skeletons

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults
    from probmotion.motion.skeleton import Skeleton
    from probmotion.posteriors.problem import Problem

__all__ = ["draw_comparison"]

_DRAWS = 4  # draws per sampler
_POSES = 6  # poses per sampler of problems with held-out poses
_SIDE_VIEW = np.pi / 2 - 0.35
"""Heading of bodies without observations, radians."""


def draw_comparison(
    comparison: GridResults, problems: Iterable[Problem], folder: str | Path
) -> list[Path]:
    """Write ``quality_against_cost.png`` and ``skeletons_<problem>.png``; return their paths.

    The quality plot is omitted if no headline metric was measured. With observations, motions are
    viewed at a right angle to the first camera, if any, with the truth in grey.

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
    folder = Path(folder)
    written = []
    table = comparison.table()
    if headline_metric(table):
        written.append(folder / "quality_against_cost.png")
        plot_quality_against_cost(table, written[0])
    for problem in problems:
        written.append(folder / f"skeletons_{problem.name}.png")
        _draw_problem(comparison, problem, written[-1])
    return written


def _draw_problem(comparison: GridResults, problem: Problem, path: Path) -> None:
    """Write each sampler's draws of a problem below exact or reference draws."""
    drawn = {}
    shown = _DRAWS if problem.held_out is None else _POSES
    for result in comparison.results:
        if result.problem == problem.name and result.seed == 0 and result.failure is None:
            motions = comparison.draws(problem.name, result.sampler).flat()
            # Choose evenly spaced draws, because consecutive draws of a chain are similar.
            drawn[result.sampler] = motions[:: max(1, len(motions) // shown)]
    rows = {}
    if "exact" in drawn:
        rows["exact"] = drawn.pop("exact")
    elif problem.has_reference:
        label = "reference" if problem.exact_source is None else "exact draws"
        rows[label] = problem.reference(0, shown)
    rows |= drawn
    if not rows:
        raise ValueError(f"problem must have draws or references, got none for {problem.name!r}")
    skeleton, likelihood = problem.posterior.skeleton, problem.posterior.likelihood
    if problem.held_out is not None:
        _draw_poses({"held out": problem.held_out} | rows, skeleton, path, problem.name)
        return
    if likelihood is None:
        heading = _SIDE_VIEW if skeleton.mirrored_pairs else None
        draw_skeletons(rows, skeleton, path, heading=heading, title=problem.name)
        return
    cameras = getattr(likelihood, "cameras", None)
    draw_skeletons(
        rows,
        skeleton,
        path,
        azimuth=0.0 if cameras is None else float(cameras.azimuth[0]) + np.pi / 2,
        truth=problem.truth,
        title=problem.name + ("" if cameras is None else ", viewed at 90° to the camera"),
    )


def _draw_poses(rows: dict[str, np.ndarray], skeleton: Skeleton, path: Path, title: str) -> None:
    """Write evenly spaced poses of each row, (n, 1, J, 3), aligned with the first pose."""
    chosen = {
        label: motions[:: max(1, len(motions) // _POSES), 0][:_POSES]
        for label, motions in rows.items()
    }
    first = next(iter(chosen.values()))[0]
    chosen = {
        label: align_rigidly(poses, np.broadcast_to(first, poses.shape))
        for label, poses in chosen.items()
    }
    draw_pairs(chosen, skeleton, path, columns=_POSES, azimuth=0.6, elevation=0.2, title=title)
