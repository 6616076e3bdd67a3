"""Compiled: a Metropolis walk over pose-pairs in joint positions, and over the views of them."""

from __future__ import annotations

import numba
import numpy as np

from probmotion.interaction.geometry.graph_kernels import edge_room
from probmotion.problems.references.pair_densities import (
    Physics,
    Sight,
    judge,
    log_annotations,
    log_measure,
    log_penetration,
    log_prior,
    log_sketch,
    log_view,
)
from probmotion.problems.references.pair_moves import SHIFT, TURN, Body, place_anew, propose

__all__ = ["walk"]

_LOT = 40
"""Steps by a sketch: of so many, two lots in three are taken."""
_VIEWS_ASKED = 6
"""Of any number of views: all would take longer than the steps between."""


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
    sight: Sight,
    rng: np.random.Generator,
) -> tuple[int, float]:
    """Walk on prior · L_v^power in pose and view; return the view and log L_v.

    Lots of steps go by a sketch of L_v, which is of one annotation and its own graph, and each lot
    is taken or left as things are (surrogate transitions, Liu 2001). Meanwhile the annotation is a
    part of the state: drawn in proportion to its likelihood to the power, given the pose.

    Parameters
    ----------
    pose : ndarray, (J, 3)
        Metres; changes in place.
    parts : ndarray, (2 + 2 K,)
        Of :func:`weigh`; kept up to date.
    view : int
        v.
    power : float
        Inverse temperature.
    n_steps : int
        Steps of the pose.
    moves, sizes : ndarray, (moves, 3) and (moves,)
        Of :func:`moves_of`, and how large each is: radians, metres, or shares of a length.
    tried, taken : ndarray, (moves,)
        Counts of steps by the sketch, added to.
    body, physics, sight
        The posterior's arrays.
    rng : numpy.random.Generator
        Of the chain.
    """
    logs, new_logs = np.empty(sight.near.shape[1]), np.empty(sight.near.shape[1])
    there, parts_there = np.empty_like(pose), np.empty_like(parts)
    if power > 0:
        log_annotations(pose, view, body, sight, logs)
    for done in range(0, n_steps, _LOT):
        there[:], parts_there[:] = pose, parts
        chosen = _drawn(power * logs, rng) if power > 0 else 0
        gained = _walk_by_sketch(
            there, parts_there, view, sight.near[view, chosen], power, min(_LOT, n_steps - done),
            moves, sizes, tried, taken, body, physics, sight, rng,
        )  # fmt: skip
        if power > 0:
            log_annotations(there, view, body, sight, new_logs)
            ratio = power * (new_logs[chosen] - logs[chosen] - gained)
            ratio += _log_sum_over_best(power * logs) - _log_sum_over_best(power * new_logs)
            if not -rng.standard_exponential() < ratio:
                continue
            logs[:] = new_logs
        pose[:], parts[:] = there, parts_there
    place_anew(pose, parts, body, rng)
    if power == 0:
        view = int(rng.random() * len(sight.vectors))
        return view, log_view(pose, view, body, sight)
    log_l = logs.max()
    for _ in range(_VIEWS_ASKED):
        # What a view must reach is drawn first: that it does not is sooner known than what it is.
        other = int(rng.random() * len(sight.vectors))
        least = log_l - rng.standard_exponential() / power
        found = log_view(pose, other, body, sight, least)
        if found >= least:
            view, log_l = other, found
    return view, log_l


@numba.njit(cache=True, nogil=True)
def _walk_by_sketch(
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
    sight: Sight,
    rng: np.random.Generator,
) -> float:
    """Take Metropolis steps on prior · sketch^power; return by how much the log sketch rose."""
    proposed, weighed = np.empty_like(pose), np.empty_like(parts)
    apart, terms = np.empty((2, len(pose))), np.empty(edge_room(len(pose), sight.graph))
    start = 0.0
    if power > 0:
        start = log_sketch(pose, view, annotation, body, sight, apart, terms)
    here = start
    for _ in range(n_steps):
        number = int(rng.random() * len(moves))
        kind, joint = moves[number, 0], moves[number, 1]
        tried[number] += 1
        propose(pose, moves[number], sizes[number], body, rng, proposed)
        weighed[:] = parts
        # First by what is cheap, then by what is not (Christen and Fox 2005).
        weighed[0] = log_measure(proposed, body)
        new = 0.0
        if power > 0:
            new = log_sketch(proposed, view, annotation, body, sight, apart, terms)
        if not -rng.standard_exponential() < weighed[0] - parts[0] + power * (new - here):
            continue
        weighed[1] = log_penetration(proposed, physics)
        least = log_prior(parts, physics) - parts[0] - rng.standard_exponential()
        # Limits take away at most: without them, some are known to be left already.
        if weighed[1] < least:
            continue
        if kind != TURN and kind != SHIFT:
            judge(proposed, body.person[joint], physics, weighed)
        if not log_prior(weighed, physics) - weighed[0] >= least:
            continue
        pose[:], parts[:], here = proposed, weighed, new
        taken[number] += 1
    return here - start


@numba.njit(cache=True, nogil=True)
def _drawn(logs: np.ndarray, rng: np.random.Generator) -> int:
    """Return one of several, drawn in proportion to exp(logs)."""
    total = np.cumsum(np.exp(logs - logs.max()))
    return min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), len(logs) - 1)


@numba.njit(cache=True, nogil=True)
def _log_sum_over_best(logs: np.ndarray) -> float:
    """Return log Σ exp(logs) − max logs."""
    return np.log(np.exp(logs - logs.max()).sum())
