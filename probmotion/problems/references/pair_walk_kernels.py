"""Compiled Metropolis walk over pose pairs and views."""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.graph_kernels import max_edges
from probmotion.problems.references.pair_densities import (
    Physics,
    ViewAnnotations,
    log_annotations,
    log_measure,
    log_penetration,
    log_prior,
    log_surrogate,
    log_view,
    write_limit_terms,
)
from probmotion.problems.references.pair_moves import SHIFT, TURN, Body, propose, resample_placement

__all__ = ["walk"]

_SURROGATE_STEPS = 40
"""Surrogate steps per proposal, for an acceptance rate of about two thirds."""
_VIEW_PROPOSALS = 6
"""View proposals per walk."""


@numba.njit(cache=True, nogil=True)
def walk(
    pose: np.ndarray,
    parts: np.ndarray,
    view: int,
    power: float,
    n_steps: int,
    moves: np.ndarray,
    sizes: np.ndarray,
    tried: np.ndarray,
    taken: np.ndarray,
    body: Body,
    physics: Physics,
    views: ViewAnnotations,
    rng: np.random.Generator,
) -> tuple[int, float]:
    """Sample pose and view v from prior · L_v^power by Metropolis; return v and log L_v.

    Blocks of steps target a surrogate of L_v, the graph distance to one annotation, and are
    accepted or rejected as a whole (surrogate transitions, Liu 2001). The annotation is an
    auxiliary variable, drawn given the pose with probability ∝ likelihood^power.

    Updates in place: ``pose`` (J, 3), metres; ``parts`` (2 + 2 K,) of :func:`log_prior_terms`; and
    the counters of surrogate steps ``tried`` and ``taken`` (moves,).
    """
    logs, new_logs = np.empty(views.near.shape[1]), np.empty(views.near.shape[1])
    new_pose, new_parts = np.empty_like(pose), np.empty_like(parts)
    if power > 0:
        log_annotations(pose, view, body, views, logs)
    for done in range(0, n_steps, _SURROGATE_STEPS):
        new_pose[:], new_parts[:] = pose, parts
        chosen = _draw_index(power * logs, rng) if power > 0 else 0
        log_gain = _surrogate_walk(
            new_pose, new_parts, view, views.near[view, chosen], power,
            min(_SURROGATE_STEPS, n_steps - done), moves, sizes, tried, taken, body, physics,
            views, rng,
        )  # fmt: skip
        if power > 0:
            log_annotations(new_pose, view, body, views, new_logs)
            ratio = power * (new_logs[chosen] - logs[chosen] - log_gain)
            ratio += _log_sum_over_best(power * logs) - _log_sum_over_best(power * new_logs)
            if not -rng.standard_exponential() < ratio:
                continue
            logs[:] = new_logs
        pose[:], parts[:] = new_pose, new_parts
    resample_placement(pose, parts, body, rng)
    if power == 0:
        view = int(rng.random() * len(views.vectors))
        return view, log_view(pose, view, body, views, -np.inf)
    log_l = logs.max()
    for _ in range(_VIEW_PROPOSALS):
        # Draw the acceptance threshold first, to terminate the evaluation early.
        other = int(rng.random() * len(views.vectors))
        lower_bound = log_l - rng.standard_exponential() / power
        other_log_l = log_view(pose, other, body, views, lower_bound)
        if other_log_l >= lower_bound:
            view, log_l = other, other_log_l
    return view, log_l


@numba.njit(cache=True, nogil=True)
def _surrogate_walk(
    pose: np.ndarray,
    parts: np.ndarray,
    view: int,
    annotation: int,
    power: float,
    n_steps: int,
    moves: np.ndarray,
    sizes: np.ndarray,
    tried: np.ndarray,
    taken: np.ndarray,
    body: Body,
    physics: Physics,
    views: ViewAnnotations,
    rng: np.random.Generator,
) -> float:
    """Take Metropolis steps on prior · surrogate^power; return the change of the log surrogate."""
    proposed, new_parts = np.empty_like(pose), np.empty_like(parts)
    errors, terms = np.empty((2, len(pose))), np.empty(max_edges(len(pose), views.prepared.graph))
    start = log_surrogate(pose, view, annotation, body, views, errors, terms) if power > 0 else 0.0
    current = start
    for _ in range(n_steps):
        number = int(rng.random() * len(moves))
        kind, joint = moves[number, 0], moves[number, 1]
        tried[number] += 1
        propose(pose, moves[number], sizes[number], body, rng, proposed)
        new_parts[:] = parts
        # Delayed acceptance: evaluate cheap terms first (Christen and Fox 2005).
        new_parts[0] = log_measure(proposed, body)
        new = 0.0
        if power > 0:
            new = log_surrogate(proposed, view, annotation, body, views, errors, terms)
        if not -rng.standard_exponential() < new_parts[0] - parts[0] + power * (new - current):
            continue
        new_parts[1] = log_penetration(proposed, physics)
        lower_bound = log_prior(parts, physics) - parts[0] - rng.standard_exponential()
        # Joint limits only decrease the density, so penetration alone may suffice to reject.
        if new_parts[1] < lower_bound:
            continue
        if kind != TURN and kind != SHIFT:
            write_limit_terms(proposed, body.person[joint], physics, new_parts)
        if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
            continue
        pose[:], parts[:], current = proposed, new_parts, new
        taken[number] += 1
    return current - start


@numba.njit(cache=True, nogil=True)
def _draw_index(logs: np.ndarray, rng: np.random.Generator) -> int:
    """Draw an index in proportion to exp(logs)."""
    total = np.cumsum(np.exp(logs - logs.max()))
    return min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), len(logs) - 1)


@numba.njit(cache=True, nogil=True)
def _log_sum_over_best(logs: np.ndarray) -> float:
    """Return log Σ exp(logs) − max logs."""
    return np.log(np.exp(logs - logs.max()).sum())
