"""Animations of draws for the report, with one canvas per sampler and a common clock."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem, read_stored
from probmotion.plots.animation import animation_html
from probmotion.plots.motion_data import Shown, choose_draws

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["BUDGET", "animation", "shown_problems"]

_MOST = 4  # Maximum number of draws per sampler.
_MOST_POSES = 6  # Maximum number of draws per sampler if motions have one frame.
BUDGET = 9_000_000
"""Maximum size of motions and images in bytes, before base64 encoding."""
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
        (n / _MOST for n in range(_MOST, 1, -1) if n / _MOST * size <= budget), 1 / _MOST
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
            motions, _MOST if motions.shape[1] > 1 else _MOST_POSES
        )
    problem = read_stored(comparison.folder / "problems" / name)
    if problem is None:
        if skeleton is None:
            return None
        problem = StoredProblem(skeleton, fps)
    rows: dict[str, np.ndarray] = {}
    if problem.held_out is not None:
        rows[_HELD_OUT] = choose_draws(problem.held_out, _MOST_POSES)
    if problem.reference is not None:
        rows[_REFERENCE] = choose_draws(problem.reference, _MOST)
    rows |= {label: drawn[label] for label in comparison.plan.samplers if label in drawn}
    return Shown(problem, rows) if rows else None


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
