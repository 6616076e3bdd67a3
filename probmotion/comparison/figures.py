"""The pictures of a comparison: quality against cost, and every sampler's draws as skeletons."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.qualities import first_quality
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.plots.pairs import draw_pairs
from probmotion.plots.quality import plot_quality_against_cost
from probmotion.plots.skeletons import draw_skeletons

if TYPE_CHECKING:
    from probmotion.comparison.comparison import Comparison
    from probmotion.motion.skeleton import Skeleton
    from probmotion.posteriors.problem import Problem

__all__ = ["draw_comparison", "draw_problem"]

_SHOWN = 4
_POSES = 6


def draw_comparison(
    comparison: Comparison, problems: Iterable[Problem], folder: str | Path
) -> list[Path]:
    """Write the plot and one picture of skeletons per problem; return their paths.

    The plot is of the first of :data:`~probmotion.comparison.results.qualities.QUALITIES` that was
    measured. Where none was, there is no plot.

    Parameters
    ----------
    comparison : Comparison
        What was drawn.
    problems : iterable of Problem
        Those of its problems to draw.
    folder : str or Path
        Where ``quality_against_cost.png`` and ``skeletons_<problem>.png`` go.
    """
    folder = Path(folder)
    written = []
    table = comparison.table()
    if quality := first_quality(table):
        written.append(folder / "quality_against_cost.png")
        plot_quality_against_cost(table, written[0], quality=quality)
    for problem in problems:
        path = folder / f"skeletons_{problem.name}.png"
        draw_problem(comparison, problem, path)
        written.append(path)
    return written


def draw_problem(comparison: Comparison, problem: Problem, path: str | Path) -> None:
    """Write each sampler's draws of a problem below exact draws, or those of a long run.

    Where there is evidence, motions are seen from the side of the first camera, which is what it
    does not show, and the truth stands behind them in grey. Where there is none, all motions are
    turned to the same heading. Of single poses, some that were held out stand above the draws.

    Raises
    ------
    ValueError
        If there is neither a sampler's draw nor a reference draw.
    """
    drawn = {}
    shown = _SHOWN if problem.held_out is None else _POSES
    for result in comparison.results:
        if result.problem == problem.name and result.seed == 0 and result.failure is None:
            motions = comparison.draws(problem.name, result.sampler).flat()
            # Neighbours in a chain look alike: show draws that are far apart.
            drawn[result.sampler] = motions[:: max(1, len(motions) // shown)]
    rows = {}
    if "exact" in drawn:
        rows["exact"] = drawn.pop("exact")
    elif problem.has_reference:
        label = "reference" if problem.known is None else "exact draws"
        rows[label] = problem.reference(0, shown)
    rows |= drawn
    if not rows:
        raise ValueError(f"problem is {problem.name!r}, which no sampler drew from")
    posterior = problem.posterior
    if problem.held_out is not None:
        _draw_poses({"held out": problem.held_out} | rows, posterior.skeleton, path, problem.name)
        return
    cameras = getattr(posterior.likelihood, "cameras", None)
    if posterior.likelihood is None:
        sided = bool(posterior.skeleton.mirrored_pairs)
        heading = np.pi / 2 - 0.35 if sided else None
        draw_skeletons(rows, posterior.skeleton, path, heading=heading, title=problem.name)
        return
    azimuth = 0.0 if cameras is None else float(cameras.azimuth[0]) + np.pi / 2
    draw_skeletons(
        rows,
        posterior.skeleton,
        path,
        azimuth=azimuth,
        truth=problem.truth,
        title=problem.name + ("" if cameras is None else ", seen from the camera's side"),
    )


def _draw_poses(
    rows: dict[str, np.ndarray], skeleton: Skeleton, path: str | Path, title: str
) -> None:
    """Write poses of several people, each row's evenly apart: (n, 1, J, 3).

    All are turned to the first, as where a pair stands and which way is up may be left open.
    """
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
