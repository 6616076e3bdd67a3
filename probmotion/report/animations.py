"""The part of a comparison's page where skeletons play: a canvas per sampler, one clock for all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem, read_stored
from probmotion.report.motions import Shown, choose_draws, motion_numbers

if TYPE_CHECKING:
    from probmotion.comparison.results.grid_results import GridResults

__all__ = ["BUDGET", "players", "shown_problems"]

_MOST = 4
_MOST_POSES = 6
BUDGET = 9_000_000
"""Bytes of numbers and pictures that a page may have: written in letters they are a third more."""
_HELD_OUT = "held-out poses"
_REFERENCE = "reference draws"


def shown_problems(comparison: GridResults, budget: int = BUDGET) -> dict[str, Shown]:
    """Return what can be seen of each problem, by name: 4 draws of each sampler, or as many as fit.

    Where one of each is still too much, frames are left out as well. A problem that no sampler drew
    from and that has no reference draws is not among them.
    """
    found = {}
    for name in comparison.plan.problems:
        if (shown := _shown(comparison, name)) is not None:
            found[name] = shown
    sizes = [sum(row.size for row in shown.rows.values()) for shown in found.values()]
    for most in range(_MOST, 0, -1):
        kept = most / _MOST
        if 2 * kept * sum(sizes) <= budget or most == 1:
            break
    step = max(1, int(np.ceil(2 * kept * sum(sizes) / budget)))
    return {
        name: Shown(
            shown.problem,
            {
                label: choose_draws(row, max(1, round(kept * len(row))))
                for label, row in shown.rows.items()
            },
            step,
        )
        for name, shown in found.items()
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
    kept = _kept(comparison, name)
    if kept is None:
        if skeleton is None:
            return None
        kept = StoredProblem(skeleton, fps)
    rows: dict[str, np.ndarray] = {}
    if kept.held_out is not None:
        rows[_HELD_OUT] = choose_draws(kept.held_out, _MOST_POSES)
    if kept.reference is not None:
        rows[_REFERENCE] = choose_draws(kept.reference, _MOST)
    rows |= {label: drawn[label] for label in comparison.plan.samplers if label in drawn}
    return Shown(kept, rows) if rows else None


def _kept(comparison: GridResults, name: str) -> StoredProblem | None:
    """What the comparison kept of a problem; of one that is registered, what it has."""
    kept = read_stored(comparison.folder / "problems" / name)
    if kept is not None:
        return kept
    from probmotion.problems.catalogue import load_problem, problem_descriptions

    if problem_descriptions().get(name) != comparison.plan.problems[name]:
        return None
    try:
        return StoredProblem.of(load_problem(name))
    except FileNotFoundError:
        return None


def players(name: str, shown: Shown, place: int, missing: Mapping[str, str]) -> str:
    """Return the controls, canvases and numbers of one problem as HTML.

    Parameters
    ----------
    name : str
        The problem's.
    shown : Shown
        What is drawn.
    place : int
        The problem's number in the page, for its ids.
    missing : mapping of str
        Why, by sampler, there is nothing to be seen of it: HTML.
    """
    data = motion_numbers(shown)
    problem = shown.problem
    # Nothing in the numbers can end the script.
    numbers = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", r"\u003c")
    height = f"{data['columns'] * data['across']:.3f} / {data['up']:.3f}"
    with_truth = "" if problem.truth is None else ", the truth in grey behind each"
    cards = []
    for label, motions in shown.rows.items():
        what = _counted(label, len(motions), problem)
        words = f"{what}, on {name}, as {_kind(shown)}{with_truth}."
        cards.append(
            f'<figure><canvas role="img" style="aspect-ratio: {height}" '
            f'aria-label="{escape(words)}">A browser with scripts shows it.</canvas>'
            f"<figcaption>{escape(what)}</figcaption></figure>"
        )
    cards += [
        f"<figure><figcaption>{escape(sampler)}: no draws, {why}</figcaption></figure>"
        for sampler, why in missing.items()
    ]
    said = _sentence(shown)
    sentence = f'<p class="quiet">{escape(said)}</p>' if said else ""
    still, unfilmed = data["frames"] == 1, problem.camera is None
    return f"""\
<div class="player">
{sentence}
<div class="controls"{_hidden(still and unfilmed and problem.truth is None)}>
<button type="button" data-does="play"{_hidden(still)}>Play</button>
<input type="range" min="0" max="{data["frames"] - 1}" value="0" step="1" \
aria-label="Frame of {escape(name)}"{_hidden(still)}>
<output{_hidden(still)}></output>
<button type="button" data-does="camera" aria-pressed="false"{_hidden(unfilmed)}>\
Camera’s view</button>
<label{_hidden(problem.truth is None)}><input type="checkbox" data-does="truth" checked> \
truth</label>
</div>
<ul class="key quiet">{_key(problem)}</ul>
<div class="cards" role="group" tabindex="0" aria-labelledby="skeletons-{place}" \
aria-describedby="keys">
{chr(10).join(cards)}
</div>
<script type="application/json">{numbers}</script>
</div>"""


def _hidden(hidden: bool) -> str:
    return " hidden" if hidden else ""


def _counted(label: str, n: int, problem: StoredProblem) -> str:
    if label == _HELD_OUT and problem.held_out is not None:
        return f"{n} held-out pose{'s' * (n != 1)}"
    if label == _REFERENCE and problem.reference is not None:
        return f"{n} reference draw{'s' * (n != 1)}"
    return f"{label}: {n} draw{'s' * (n != 1)}"


def _kind(shown: Shown) -> str:
    return "skeletons" if shown.frames == 1 else "moving skeletons"


def _key(problem: StoredProblem) -> str:
    entries = []
    if problem.skeleton.mirrored_pairs:
        entries += [("left", "left side"), ("right", "right side")]
    if problem.truth is not None:
        entries.append(("ghost", "truth"))
    items = [
        f'<li><span style="background: var(--{colour})"></span>{words}</li>'
        for colour, words in entries
    ]
    if problem.joints is not None:
        items.append('<li><span class="ring"></span>noisy 3D joints (the evidence)</li>')
    if problem.keypoints is not None:
        items.append('<li><span class="ring"></span>keypoints, in the camera’s view</li>')
    return "".join(items)


def _sentence(shown: Shown) -> str:
    """Say what is seen, and what is not."""
    problem = shown.problem
    parts = []
    for seen, words in ((problem.keypoints, "keypoints"), (problem.joints, "noisy 3D joints")):
        if seen is None:
            continue
        there = np.isfinite(seen[..., 0])
        frames = np.flatnonzero(there.any(axis=1))
        text = (
            f"The evidence has {int(there.sum())} {words} in {len(frames)} of {len(there)} frames"
        )
        if len(frames) == 1:
            text += f", all in frame {frames[0] // shown.step + 1}"
        parts.append(text + ".")
    if problem.keypoints is not None:
        parts.append("The views start beside the first camera, where what it cannot see is seen.")
    if problem.has_observations and problem.keypoints is None and problem.joints is None:
        parts.append("The evidence is of a kind that is not drawn.")
    if problem.reference is None and problem.held_out is None:
        parts.append("There are no reference draws.")
    if shown.step > 1:
        parts.append(f"To keep the page small, every {shown.step}th frame is shown.")
    return " ".join(parts)
