"""Compiled: a Metropolis walk over pose-pairs in joint positions, given one view."""

from __future__ import annotations

import numba
import numpy as np

from probmotion.interaction.nearest_kernels import centred, distance_to, look, nearest_to
from probmotion.problems.pair_densities import (
    Physics,
    Sight,
    choose_view,
    judge,
    log_measure,
    log_penetration,
    log_prior,
    picture_of,
)
from probmotion.problems.pair_moves import SHIFT, TURN, Body, place_anew, propose

__all__ = ["scan", "walk"]


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
) -> None:
    """Take Metropolis steps on prior · L_v^power, moves drawn at random; ``pose`` changes in place.

    Parameters
    ----------
    pose : ndarray, (J, 3)
        Metres.
    parts : ndarray, (2 + 2 K,)
        Of :func:`weigh`; kept up to date.
    view : int
        v.
    power : float
        Inverse temperature.
    n_steps : int
        Steps.
    moves, sizes : ndarray, (moves, 2) and (moves,)
        Of :func:`moves_of`, and how large each is: radians, metres, or shares of a length.
    tried, taken : ndarray, (moves,)
        Counts, added to.
    body, physics, sight
        The posterior's arrays.
    rng : numpy.random.Generator
        Of the chain.
    """
    proposed, weighed = np.empty_like(pose), np.empty_like(parts)
    near, prepared, measure = sight.near[view], sight.prepared, sight.measure
    energy = -0.5 * power / sight.noise**2
    picture = picture_of(pose, view, body, sight)
    joints, edges, weights, n_edges, bins = look(
        picture, prepared, measure, sight.graph, sight.epsilon
    )
    distance, nearest = nearest_to(
        joints, edges, weights, n_edges, bins, near, prepared, measure, np.inf
    )
    for _ in range(n_steps):
        number = int(rng.random() * len(moves))
        kind, joint = moves[number]
        tried[number] += 1
        propose(pose, kind, joint, sizes[number], body, rng, proposed)
        weighed[:] = parts
        weighed[0] = log_measure(proposed, body)
        # First by the graph and the annotation of the pose that is left: a guess, for a tenth of
        # the price (Christen and Fox 2005).
        guess = weighed[0] - parts[0]
        if power > 0:
            picture = picture_of(proposed, view, body, sight)
            guessed = distance_to(
                centred(picture), edges, weights, n_edges, bins, nearest, prepared, measure
            )
            guess += energy * (guessed**2 - distance**2)
        if not -rng.standard_exponential() < guess:
            continue
        # Then as things are, less what the guess has asked already. What is cheap comes first: no
        # other part can lift a pose again, all are 0 at most.
        least = log_prior(parts, physics) + min(0.0, guess) - rng.standard_exponential()
        least += energy * distance**2 if power > 0 else 0.0
        weighed[1] = log_penetration(proposed, physics)
        if weighed[0] + weighed[1] < least:
            continue
        if kind != TURN and kind != SHIFT:
            judge(proposed, body.person[joint], physics, weighed)
        found = log_prior(weighed, physics)
        if not found >= least:
            continue
        back = parts[0] - weighed[0]
        if power == 0:
            if not found + min(0.0, back) >= least:
                continue
        else:
            seen = look(picture, prepared, measure, sight.graph, sight.epsilon)
            within = np.sqrt((least - found) / energy)
            new, which = nearest_to(*seen, near, prepared, measure, within)
            if which < 0:
                continue
            left = distance_to(joints, *seen[1:], which, prepared, measure)
            back += energy * (left**2 - new**2)
            if not found + energy * new**2 + min(0.0, back) >= least:
                continue
            joints, edges, weights, n_edges, bins = seen
            distance, nearest = new, which
        pose[:], parts[:] = proposed, weighed
        taken[number] += 1
    place_anew(pose, parts, body, rng)


@numba.njit(cache=True, nogil=True)
def scan(
    poses: np.ndarray,
    parts: np.ndarray,
    seen: np.ndarray,
    views: np.ndarray,
    powers: np.ndarray,
    n_steps: int,
    moves: np.ndarray,
    sizes: np.ndarray,
    tried: np.ndarray,
    taken: np.ndarray,
    body: Body,
    physics: Physics,
    sight: Sight,
    rng: np.random.Generator,
) -> None:
    """Let every level walk and choose its view anew: arguments as :func:`walk`'s, one a level.

    ``seen`` (levels, 2) gets log L_v of each level's view, and log L of all views.
    """
    for level in range(len(poses)):
        walk(
            poses[level], parts[level], views[level], powers[level], n_steps,
            moves, sizes[level], tried[level], taken[level], body, physics, sight, rng,
        )  # fmt: skip
        views[level], seen[level, 0], seen[level, 1] = choose_view(
            poses[level], powers[level], body, sight, rng
        )
