"""Compiled parallel tempering of a pose pair that is lifted from one annotation."""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.models.pose_pairs.pair_densities import (
    Physics,
    log_lengths,
    log_penetration,
    workspace,
    write_limit_terms,
)
from probmotion.models.pose_pairs.pair_moves import SHIFT, TURN, Body, propose

__all__ = ["walk_lift", "walk_replica"]

_STEPS = 50  # Metropolis steps of a replica between swaps
_TARGET_ACCEPTANCE = 0.3


@numba.njit(cache=True, nogil=True)
def walk_lift(
    poses: np.ndarray,
    powers: np.ndarray,
    log_weights: np.ndarray,
    means: np.ndarray,
    cells: np.ndarray,
    roots: np.ndarray,
    first: int,
    sweeps: int,
    moves: np.ndarray,
    log_sizes: np.ndarray,
    tune: bool,
    body: Body,
    physics: Physics,
    rng: np.random.Generator,
) -> None:
    """Sample K replicas of pose X and component c by parallel tempering.

    The density of replica k is w_c N(X; m_c, C_c) times the physical prior, with the density of
    bone lengths to the power ``powers[k]``. After a sweep of 50 steps of each, neighbours are
    swapped by a Metropolis step, even and odd ones in turn (Syed et al. 2022);
    ``first`` is the number of earlier sweeps.

    Updates in place: ``poses`` (K, J, 3) and, with ``tune``, ``log_sizes`` (K, 2, kinds) of moves
    in all directions and in depth. ``log_weights`` (c,) are log w_c − ½ log det C_c; ``means``
    (c, 3 J) contain all x, all y, all z; ``roots`` (C, 3 J, r) are matrices R with R Rᵀ = C⁻¹, of
    which ``cells`` (c,) selects those of the components.
    """
    replicas = len(powers)
    squares, counts = np.empty(replicas), np.empty((2, *log_sizes.shape[1:]))
    for sweep in range(first, first + sweeps):
        for k in range(replicas):
            counts[:] = 0.0
            walk_replica(
                poses[k], log_weights, means, cells, roots, powers[k], _STEPS, moves,
                np.exp(log_sizes[k]), counts[0], counts[1], body, physics, rng,
            )  # fmt: skip
            if tune:
                surplus = counts[1] - _TARGET_ACCEPTANCE * counts[0]
                log_sizes[k] += surplus / np.sqrt(_STEPS * (sweep + 1.0))
            squares[k] = log_lengths(poses[k], body)[1]
        for k in range(sweep % 2, replicas - 1, 2):
            change = (powers[k + 1] - powers[k]) * (squares[k + 1] - squares[k])
            if -rng.standard_exponential() < 0.5 * change / body.bone_noise**2:
                hotter = poses[k].copy()
                poses[k], poses[k + 1] = poses[k + 1], hotter


@numba.njit(cache=True, nogil=True)
def walk_replica(
    pose: np.ndarray,
    log_weights: np.ndarray,
    means: np.ndarray,
    cells: np.ndarray,
    roots: np.ndarray,
    power: float,
    n_steps: int,
    moves: np.ndarray,
    sizes: np.ndarray,
    tried: np.ndarray,
    taken: np.ndarray,
    body: Body,
    physics: Physics,
    rng: np.random.Generator,
) -> None:
    """Draw the component given ``pose``, then move ``pose`` by Metropolis steps.

    Half of the shifts and rotations are in depth, where a pose is less certain than in the image.
    ``sizes`` (2, kinds) of moves are those in all directions and in depth. The numbers of tried and
    taken moves, ``tried`` and ``taken`` (2, kinds), are updated.
    """
    people = len(body.roots)
    work = workspace(body, physics, 0)
    parts, proposed, new_parts = np.zeros(2 + 2 * people), work.pose, work.parts
    white, new_white = np.empty(roots.shape[2]), np.empty(roots.shape[2])
    component = _draw_component(pose, log_weights, means, cells, roots, white, rng)
    root = roots[cells[component]]
    _whiten(pose, means[component], root, white)
    parts[0] = -0.5 * (white @ white) + _log_bones(pose, body, power)
    parts[1] = log_penetration(pose, physics, work)
    for person in range(people):
        write_limit_terms(pose, person, physics, parts, work)
    for _ in range(n_steps):
        number = int(rng.random() * len(moves))
        kind, joint = moves[number, 0], moves[number, 1]
        depth = int(rng.random() * 2)
        tried[depth, kind] += 1
        propose(pose, moves[number], sizes[depth, kind], body, rng, proposed, depth == 1)
        new_parts[:] = parts
        # Delayed acceptance: the Gaussian first (Christen and Fox 2005).
        new_white[:] = white
        _add_change(pose, proposed, root, new_white)
        new_parts[0] = -0.5 * (new_white @ new_white) + _log_bones(proposed, body, power)
        accepted = -rng.standard_exponential() < new_parts[0] - parts[0]
        if accepted:
            if kind != TURN and kind != SHIFT:
                write_limit_terms(proposed, body.person[joint], physics, new_parts, work)
            accepted = new_parts[2 + people :].sum() <= physics.max_invalid
        if accepted:
            new_parts[1] = log_penetration(proposed, physics, work)
            gain = new_parts[1 : 2 + people].sum() - parts[1 : 2 + people].sum()
            accepted = -rng.standard_exponential() < gain
        if accepted:
            pose[:], parts[:], white[:] = proposed, new_parts, new_white
            taken[depth, kind] += 1


@numba.njit(cache=True, nogil=True)
def _log_bones(pose: np.ndarray, body: Body, power: float) -> float:
    """Return the log density of the bone lengths, up to a constant.

    It is relative to the base measure of the moves, uniform directions and log lengths: a bone of
    length l has the volume element l³ d(log l) d(direction).
    """
    total, squares = log_lengths(pose, body)
    return 3.0 * total - 0.5 * power * squares / body.bone_noise**2


@numba.njit(cache=True, nogil=True)
def _whiten(pose: np.ndarray, mean: np.ndarray, root: np.ndarray, white: np.ndarray) -> None:
    """Write Rᵀ (X − m), which does not depend on the mean depth, to ``white`` (r,)."""
    white[:] = 0.0
    _add_change(np.ascontiguousarray(mean.reshape(3, -1).T), pose, root, white)


@numba.njit(cache=True, nogil=True)
def _add_change(old: np.ndarray, new: np.ndarray, root: np.ndarray, white: np.ndarray) -> None:
    """Add Rᵀ (new − old) to ``white``."""
    n = len(old)
    for joint in range(n):
        for i in range(3):
            change = new[joint, i] - old[joint, i]
            if change != 0.0:
                row = root[i * n + joint]
                for k in range(len(white)):
                    white[k] += change * row[k]


@numba.njit(cache=True, nogil=True)
def _draw_component(
    pose: np.ndarray,
    log_weights: np.ndarray,
    means: np.ndarray,
    cells: np.ndarray,
    roots: np.ndarray,
    white: np.ndarray,
    rng: np.random.Generator,
) -> int:
    """Draw the component given the pose; ``white`` (r,) is workspace."""
    logs = log_weights.copy()
    for c in range(len(logs)):
        _whiten(pose, means[c], roots[cells[c]], white)
        logs[c] -= 0.5 * (white @ white)
    total = np.cumsum(np.exp(logs - logs.max()))
    return min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), len(logs) - 1)
