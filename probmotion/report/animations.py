"""Animations of draws for the report, with one canvas per sampler and a common clock."""

from __future__ import annotations

from collections.abc import Mapping
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


def shown_problems(comparison: GridResults, budget: int = BUDGET) -> dict[str, Shown]:
    """Return the motions to show for each problem, at most 4 draws or 6 poses of each sampler.

    Draws, then frames, are omitted until the motions fit into ``budget`` bytes. Problems without
    motions are omitted.
    """
    problems = {}
    for name in comparison.plan.problems:
        if (shown := _shown(comparison, name)) is not None:
            problems[name] = shown
    size = 2 * sum(row.size for shown in problems.values() for row in shown.rows.values())
    fraction = next(
        (n / _DRAWS for n in range(_DRAWS, 1, -1) if n / _DRAWS * size <= budget), 1 / _DRAWS
    )
    step = max(1, int(np.ceil(fraction * size / budget)))
    return {
        name: Shown(
            shown.problem,
            {
                label: choose_draws(row, max(1, round(fraction * len(row))))
                for label, row in shown.rows.items()
            },
            step,
        )
        for name, shown in problems.items()
    }


def _shown(comparison: GridResults, name: str) -> Shown | None:
    drawn, skeleton, fps = {}, None, 0.0
    for result in comparison.results:
        if result.problem != name or result.failure is not None or result.sampler in drawn:
            continue
        draws = comparison.draws(name, result.sampler, result.seed)
        skeleton, fps = draws.skeleton, draws.fps
        motions = draws.flat()
        drawn[result.sampler] = choose_draws(
            motions, _DRAWS if motions.shape[1] > 1 else _MAX_POSES
        )
    problem = read_stored(comparison.folder / "problems" / name)
    if problem is None:
        if skeleton is None:
            return None
        problem = StoredProblem(skeleton, fps)
    rows: dict[str, np.ndarray] = {}
    if problem.held_out is not None:
        rows[_HELD_OUT] = choose_draws(problem.held_out, _MAX_POSES)
    if problem.reference is not None:
        rows[_REFERENCE] = choose_draws(problem.reference, _DRAWS)
    rows |= {label: drawn[label] for label in comparison.plan.samplers if label in drawn}
    return Shown(problem, rows) if rows else None


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
    drawn = {sampler: comparison.draws(name, sampler, seed) for sampler, seed in samplers.items()}
    problem = read_stored(comparison.folder / "problems" / name)
    if problem is None:
        if not drawn:
            return ""
        first = next(iter(drawn.values()))
        problem = StoredProblem(first.skeleton, first.fps)
    rows: dict[str, np.ndarray] = {}
    if problem.truth is not None:
        rows["truth"] = problem.truth[None]
    elif problem.reference is not None:
        rows[_REFERENCE] = problem.reference
    rows |= {label: choose_draws(draws.flat(), _MAX_MEASURED) for label, draws in drawn.items()}
    if not rows:
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
