"""Compiled Metropolis walk over pose pairs and views."""

from __future__ import annotations

import numpy as np

from probmotion.extras import NO_ALLOCATION, numba
from probmotion.interaction.geometry.graph_kernels import max_edges
from probmotion.models.pose_pairs.annotation_moves import (
    approach,
    draw_sides,
    log_side_probability,
    scaled_depths,
    transfer,
)
from probmotion.models.pose_pairs.joint_limits_frames import overwrite
from probmotion.models.pose_pairs.pair_densities import (
    Physics,
    ViewAnnotations,
    Workspace,
    log_annotations,
    log_measure,
    log_penetration,
    log_prior,
    log_surrogate,
    log_view,
    workspace,
    write_limit_terms,
)
from probmotion.models.pose_pairs.pair_moves import (
    APPROACH,
    SHIFT,
    STRETCH,
    TURN,
    Body,
    propose,
    resample_placement,
)

__all__ = ["walk"]

_SURROGATE_STEPS = 40
"""Surrogate steps per proposal, for an acceptance rate of about two thirds."""
_ANNOTATION_PROPOSALS = 2
"""Proposals of another annotation per block of surrogate steps."""
_VIEW_PROPOSALS = 2
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
    auxiliary variable, drawn given the pose with probability ∝ likelihood^power. Between blocks,
    the pose may move from one annotation to another (:func:`transfer`).

    Updates in place: ``pose`` (J, 3), metres; ``parts`` (2 + 2 K,) of :func:`log_prior_terms`; and
    the counters of surrogate steps ``tried`` and ``taken`` (moves,).
    """
    logs, new_logs = np.empty(views.near.shape[1]), np.empty(views.near.shape[1])
    new_pose, new_parts = np.empty_like(pose), np.empty_like(parts)
    work = workspace(body, physics, max_edges(len(pose), views.prepared.graph))
    if power > 0:
        log_annotations(pose, view, body, views, logs)
    for done in range(0, n_steps, _SURROGATE_STEPS):
        new_pose[:], new_parts[:] = pose, parts
        chosen = _draw_index(power * logs, rng) if power > 0 else 0
        log_gain = _surrogate_walk(
            new_pose, new_parts, view, views.near[view, chosen], power,
            min(_SURROGATE_STEPS, n_steps - done), moves, sizes, tried, taken, body, physics,
            views, work, rng,
        )  # fmt: skip
        if power > 0:
            log_annotations(new_pose, view, body, views, new_logs)
            log_ratio = _log_ratio(logs, new_logs, chosen, chosen, power) - power * log_gain
            if -rng.standard_exponential() < log_ratio:
                pose[:], parts[:], logs[:] = new_pose, new_parts, new_logs
            for _ in range(_ANNOTATION_PROPOSALS):
                _propose_transfer(
                    pose, parts, logs, view, power, body, physics, views, work, new_pose,
                    new_parts, new_logs, rng,
                )  # fmt: skip
        else:
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
def _propose_transfer(
    pose: np.ndarray,
    parts: np.ndarray,
    logs: np.ndarray,
    view: int,
    power: float,
    body: Body,
    physics: Physics,
    views: ViewAnnotations,
    work: Workspace,
    new_pose: np.ndarray,
    new_parts: np.ndarray,
    new_logs: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Propose to move the pose from an annotation, drawn given the pose, to another.

    Delayed acceptance: surrogates and measure first, then joint limits and penetration, then
    likelihoods. Updates ``pose``, ``parts`` and ``logs`` in place; the other arrays are workspace.
    """
    near, old, new = views.near[view], _draw_index(power * logs, rng), int(rng.random() * len(logs))
    if old == new:
        return
    depths = scaled_depths(pose, view, body, views)
    sides = draw_sides(depths, rng)
    log_volume = transfer(
        pose, sides, view, near[old], near[new], body, views, work.image, new_pose
    )
    if log_volume == -np.inf:
        return
    log_sides = log_side_probability(sides, scaled_depths(new_pose, view, body, views))
    log_sides -= log_side_probability(sides, depths)
    log_gain = log_surrogate(new_pose, view, near[new], body, views, work)
    log_gain -= log_surrogate(pose, view, near[old], body, views, work)
    new_parts[:] = parts
    new_parts[0], new_parts[1] = log_measure(new_pose, body), 0.0
    log_ratio = log_volume + log_sides + power * log_gain + new_parts[0] - parts[0]
    if not -rng.standard_exponential() < log_ratio:
        return
    lower_bound = log_prior(parts, physics) - parts[0] - rng.standard_exponential()
    for person in range(len(body.roots)):
        write_limit_terms(new_pose, person, physics, new_parts, work)
    if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
        return
    new_parts[1] = log_penetration(new_pose, physics, work)
    if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
        return
    log_annotations(new_pose, view, body, views, new_logs)
    log_ratio = _log_ratio(logs, new_logs, old, new, power) - power * log_gain
    if -rng.standard_exponential() < log_ratio:
        pose[:], parts[:], logs[:] = new_pose, new_parts, new_logs


@numba.njit(**NO_ALLOCATION)
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
    work: Workspace,
    rng: np.random.Generator,
) -> float:
    """Take Metropolis steps on prior · surrogate^power; return the change of the log surrogate.

    At power 0, the annotation only serves the moves.
    """
    proposed, new_parts = work.pose, work.parts
    start = log_surrogate(pose, view, annotation, body, views, work) if power > 0 else 0.0
    current = start
    for _ in range(n_steps):
        number = int(rng.random() * len(moves))
        kind, joint = moves[number, 0], moves[number, 1]
        tried[number] += 1
        log_volume = 0.0
        if kind == APPROACH:
            ratio = np.exp(sizes[number] * rng.standard_normal())
            log_volume = approach(
                pose, joint, ratio, view, annotation, body, views, work.image, proposed
            )
            if log_volume == -np.inf:
                continue
        else:
            propose(pose, moves[number], sizes[number], body, rng, proposed)
        overwrite(new_parts, parts)
        if kind in (STRETCH, TURN, SHIFT):
            new_parts[0] = log_measure(proposed, body)  # Others keep bone lengths and roots.
        # Delayed acceptance: evaluate cheap terms first (Christen and Fox 2005).
        new = 0.0
        if power > 0:
            new = log_surrogate(proposed, view, annotation, body, views, work)
        log_ratio = new_parts[0] - parts[0] + power * (new - current) + log_volume
        if not -rng.standard_exponential() < log_ratio:
            continue
        lower_bound = log_prior(parts, physics) - parts[0] - rng.standard_exponential()
        new_parts[1] = 0.0
        if kind == APPROACH and joint < 0:
            for person in range(len(body.roots)):
                write_limit_terms(proposed, person, physics, new_parts, work)
        elif kind != TURN and kind != SHIFT:
            write_limit_terms(proposed, body.person[joint], physics, new_parts, work)
        # Penetration only decreases the density, so joint limits, which reject more often, may
        # suffice to reject.
        if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
            continue
        new_parts[1] = log_penetration(proposed, physics, work)
        if not log_prior(new_parts, physics) - new_parts[0] >= lower_bound:
            continue
        overwrite(pose, proposed)
        overwrite(parts, new_parts)
        current = new
        taken[number] += 1
    return current - start


@numba.njit(cache=True, nogil=True)
def _draw_index(logs: np.ndarray, rng: np.random.Generator) -> int:
    """Draw an index in proportion to exp(logs)."""
    total = np.cumsum(np.exp(logs - logs.max()))
    return min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), len(logs) - 1)


@numba.njit(cache=True, nogil=True)
def _log_ratio(logs: np.ndarray, new_logs: np.ndarray, old: int, new: int, power: float) -> float:
    """Return the log ratio of likelihood^power times the probability of the annotation."""
    gain = power * (new_logs[new] - logs[old])
    return gain + _log_sum_over_best(power * logs) - _log_sum_over_best(power * new_logs)


@numba.njit(cache=True, nogil=True)
def _log_sum_over_best(logs: np.ndarray) -> float:
    """Return log Σ exp(logs) − max logs."""
    return np.log(np.exp(logs - logs.max()).sum())
