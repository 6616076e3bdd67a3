"""Animations of draws for the report, with one canvas per sampler and a common clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem, read_stored
from probmotion.comparison.results.summary import verdict_text
from probmotion.metrics.verdict import Verdict
from probmotion.plots.animation import animation_html
from probmotion.plots.motion_data import Shown, choose_draws

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["BUDGET", "animation", "compared_draws", "featured_problem", "shown_problems"]

_DRAWS = 4  # Maximum number of draws per sampler.
_MAX_POSES = 6  # Maximum number of draws per sampler if motions have one frame.
BUDGET = 3_000_000
"""Maximum size of motions and images in bytes, before base64 encoding."""
_MAX_MEASURED = 64  # Maximum number of draws for standard deviations.
_N_COMPARED = 3  # Number of samplers in the comparison on the first screen.
_HELD_OUT = "held-out poses"
_REFERENCE = "reference draws"


def shown_problems(comparison: GridResults, budget: int = BUDGET) -> Iterator[Shown | None]:
    """Yield the motions to show for each problem, at most 4 draws or 6 poses of each sampler.

    Draws, then frames, are omitted until the motions fit into ``budget`` bytes. A problem without
    motions yields None. Draws are read when they are needed, so that the memory does not grow with
    the number of runs.
    """
    problems = list(comparison.plan.problems)
    size = 2 * sum(_size(comparison, name) for name in problems)
    fraction = next(
        (n / _DRAWS for n in range(_DRAWS, 1, -1) if n / _DRAWS * size <= budget), 1 / _DRAWS
    )
    step = max(1, int(np.ceil(fraction * size / budget)))
    for name in problems:
        yield _shown(comparison, name, _first_runs(comparison, name), fraction, step)


def _first_runs(comparison: GridResults, name: str) -> dict[str, int]:
    """Return the samplers with draws of a problem, with their first seeds that have draws."""
    runs = {
        result.sampler: result.seed
        for result in reversed(comparison.results)
        if result.problem == name and result.failure is None
    }
    return {sampler: runs[sampler] for sampler in comparison.plan.samplers if sampler in runs}


def _size(comparison: GridResults, name: str) -> int:
    """Return the number of coordinates to show, as if all samplers had those of the first."""
    runs = _first_runs(comparison, name)
    shown = _shown(comparison, name, dict(list(runs.items())[:1]))
    if shown is None:
        return 0
    sizes = [row.size for row in shown.rows.values()]
    return sum(sizes) + max(0, len(runs) - 1) * sizes[-1]


def _shown(
    comparison: GridResults,
    name: str,
    runs: Mapping[str, int],
    fraction: float = 1.0,
    step: int = 1,
) -> Shown | None:
    """Return the motions of stored draws and of runs, a seed by sampler."""
    problem = read_stored(comparison.folder / "problems" / name)
    rows: dict[str, np.ndarray] = {}
    if problem is not None and problem.held_out is not None:
        rows[_HELD_OUT] = _thinned(problem.held_out, _MAX_POSES, fraction)
    if problem is not None and problem.reference is not None:
        rows[_REFERENCE] = _thinned(problem.reference, _DRAWS, fraction)
    for sampler, seed in runs.items():
        draws = comparison.draws(name, sampler, seed)
        problem = problem or StoredProblem(draws.skeleton, draws.fps)
        n = _DRAWS if draws.positions.shape[2] > 1 else _MAX_POSES
        rows[sampler] = _thinned(draws.flat(), n, fraction)
    return Shown(problem, rows, step) if problem is not None and rows else None


def _thinned(motions: np.ndarray, n: int, fraction: float) -> np.ndarray:
    """Return a fraction of at most n evenly spaced draws."""
    chosen = choose_draws(motions, n)
    return choose_draws(chosen, max(1, round(fraction * len(chosen))))


def featured_problem(comparison: GridResults) -> str:
    """Return the first problem with observations, or else the first problem."""
    problems = list(comparison.plan.problems)
    for name in problems:
        stored = read_stored(comparison.folder / "problems" / name)
        if stored is not None and stored.has_observations:
            return name
    return problems[0]


def compared_draws(comparison: GridResults, name: str, verdicts: Mapping[str, Verdict]) -> str:
    """Return an animation of truth, recommended sampler and wrong samplers; empty without draws.

    Joints are coloured by their standard deviation.
    """
    samplers = _compared(comparison, name, verdicts)
    problem = read_stored(comparison.folder / "problems" / name)
    rows: dict[str, np.ndarray] = {}
    if problem is not None and problem.truth is not None:
        rows["truth"] = problem.truth[None]
    elif problem is not None and problem.reference is not None:
        rows[_REFERENCE] = problem.reference
    for sampler, seed in samplers.items():
        draws = comparison.draws(name, sampler, seed)
        problem = problem or StoredProblem(draws.skeleton, draws.fps)
        rows[sampler] = choose_draws(draws.flat(), _MAX_MEASURED)
    if problem is None or not rows:
        return ""
    captions = {
        label: f"{label}: {verdict_text(comparison, name, label)}" if label in verdicts else label
        for label in rows
    }
    return animation_html(
        name,
        Shown(problem, rows, overlaid=True),
        captions,
        attributes='aria-labelledby="featured-name" aria-describedby="keys"',
    )


def _compared(
    comparison: GridResults, name: str, verdicts: Mapping[str, Verdict]
) -> dict[str, int]:
    """Return the samplers to compare, with a seed that has draws.

    The fastest right sampler, or else an undecided one, if possible not ``exact``, is followed by
    wrong, then by other samplers.
    """
    runs = {
        run.sampler: run
        for run in reversed(comparison.results)
        if run.problem == name and run.failure is None
    }
    order = [sampler for sampler in comparison.plan.samplers if sampler in runs]
    judged = [sampler for sampler in order if sampler in verdicts]
    wrong = [sampler for sampler in judged if verdicts[sampler].is_wrong]
    others = [sampler for sampler in judged if sampler not in wrong]
    others.sort(
        key=lambda each: (
            not verdicts[each].is_right,
            each == "exact",
            runs[each].metrics.get("seconds", np.inf),
        )
    )
    chosen = dict.fromkeys([*others[:1], *wrong, *order])
    return {sampler: runs[sampler].seed for sampler in list(chosen)[:_N_COMPARED]}


def animation(name: str, shown: Shown, place: int, missing: Mapping[str, str]) -> str:
    """Return the animation of one problem as HTML.

    ``place`` is the index of the problem in the report, used in HTML ids; ``missing`` maps samplers
    without draws to the reason, as HTML.
    """
    cards = [
        f"<figure><figcaption>{escape(sampler)}: no draws, {why}</figcaption></figure>"
        for sampler, why in missing.items()
    ]
    text = _description(shown)
    paragraph = f'<p class="quiet">{escape(text)}</p>\n' if text else ""
    captions = {
        label: _counted(label, len(motions), shown.problem) for label, motions in shown.rows.items()
    }
    labels = f'aria-labelledby="skeletons-{place}" aria-describedby="keys"'
    return paragraph + animation_html(name, shown, captions, further_cards=cards, attributes=labels)


def _counted(label: str, n: int, problem: StoredProblem) -> str:
    if label == _HELD_OUT and problem.held_out is not None:
        return f"{n} held-out pose{'s' * (n != 1)}"
    if label == _REFERENCE and problem.reference is not None:
        return f"{n} reference draw{'s' * (n != 1)}"
    return f"{label}: {n} draw{'s' * (n != 1)}"


def _description(shown: Shown) -> str:
    """Return a description of the observations, missing reference draws and omitted frames."""
    problem = shown.problem
    parts = []
    for observed, words in ((problem.keypoints, "keypoints"), (problem.joints, "noisy 3D joints")):
        if observed is None:
            continue
        visible = np.isfinite(observed[..., 0])
        frames = np.flatnonzero(visible.any(axis=1))
        text = (
            f"The observations are {int(visible.sum())} {words} in {len(frames)} of "
            f"{len(visible)} frames"
        )
        if len(frames) == 1:
            text += f", all in frame {frames[0] // shown.step + 1}"
        parts.append(text + ".")
    if problem.keypoints is not None:
        parts.append("The initial view is rotated from the first camera to show depth.")
    if problem.has_observations and problem.keypoints is None and problem.joints is None:
        parts.append("The observations are not shown.")
    if problem.reference is None and problem.held_out is None:
        parts.append("Reference draws are not available.")
    if shown.step > 1:
        parts.append(f"Every {shown.step}th frame is shown to limit the size of the report.")
    return " ".join(parts)
