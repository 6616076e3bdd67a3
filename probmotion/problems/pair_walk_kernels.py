"""Compiled: one walk over pose-pairs in joint positions, given one view of the evidence.

The measure that the density is relative to is a product: bones point anywhere alike, their log
lengths and the roots' places are normal, as in ``PoseChart.log_measure`` but for the roots'
frames, which move nothing. Each move is a rotation of some bones, or a step of a length or a place:
it keeps areas and volumes as they are, so that densities alone decide.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from probmotion.interaction.nearest_kernels import (
    Prepared,
    centred,
    distance_to,
    look,
    nearest_of,
    nearest_to,
)
from probmotion.models.joint_limits_kernels import LimitArrays, project_poses
from probmotion.models.penetration_kernels import total_depths

__all__ = [
    "Body",
    "Physics",
    "Sight",
    "choose_view",
    "log_prior",
    "log_view",
    "moves_of",
    "scan",
    "weigh",
]

SWING, SLIDE, STRETCH, CRANK, TURN, SHIFT = range(6)
_HALF_TURN = 0.3
"""How often a crank turns by any angle."""


class Body(NamedTuple):
    """Two people or more, and where their seed stands."""

    parents: np.ndarray
    """(J,) int64, −1 for roots."""
    below: np.ndarray
    """(J, J) bool: whether a joint is another, or hangs from it."""
    only_child: np.ndarray
    """(J,) int64: the one joint that hangs from a bone's end, or −1."""
    roots: np.ndarray
    """(K,) int64."""
    chests: np.ndarray
    """(K,) int64."""
    person: np.ndarray
    """(J,) int64: whose each joint is, 0 to K − 1."""
    seed: np.ndarray
    """(J, 3) metres."""
    bone_noise: float
    root_noise: float


class Physics(NamedTuple):
    """Eq. 2: joint limits, penetration and their numbers."""

    trees: np.ndarray
    limits: LimitArrays
    bones: np.ndarray
    radii: np.ndarray
    pairs: np.ndarray
    penetration_weight: float
    position_noise: float
    max_invalid: int


class Sight(NamedTuple):
    """Eqs. 6 to 9: views, the annotations near each, and how they are compared."""

    vectors: np.ndarray
    """(V, 3), V at least 1."""
    near: np.ndarray
    """(V, N) int64."""
    prepared: Prepared
    measure: int
    graph: int
    epsilon: float
    noise: float


def moves_of(body: Body) -> np.ndarray:
    """Return every move, its kind and the joint or root that it is of: (moves, 2)."""
    bones = np.flatnonzero(body.parents >= 0)
    found = [(kind, joint) for kind in (SWING, SLIDE, STRETCH) for joint in bones]
    found += [(CRANK, joint) for joint in bones if body.only_child[joint] >= 0]
    found += [(kind, root) for kind in (TURN, SHIFT) for root in body.roots]
    return np.array(found, dtype=np.int64)


@numba.njit(cache=True, nogil=True)
def weigh(pose: np.ndarray, body: Body, physics: Physics, parts: np.ndarray) -> None:
    """Write what a pose's log prior is made of: ``parts`` (2 + 2 K,).

    First the normal log lengths and places, then penetration, then each person's distance to the
    joint limits (eq. 2), then each person's invalid angles, a count.
    """
    parts[0] = _log_measure(pose, body)
    parts[1] = _log_penetration(pose, physics)
    for person in range(len(body.roots)):
        _judge(pose, person, physics, parts)


@numba.njit(cache=True, nogil=True)
def log_prior(parts: np.ndarray, physics: Physics) -> float:
    """Return the log prior, up to a constant, of parts that :func:`weigh` wrote."""
    people = len(parts) // 2 - 1
    if parts[2 + people :].sum() > physics.max_invalid:
        return -np.inf
    return parts[: 2 + people].sum()


@numba.njit(cache=True, nogil=True)
def log_view(pose: np.ndarray, view: int, body: Body, sight: Sight) -> float:
    """Return log L(Θ_v; v) of one view: −d²/2σ_l² of the nearest annotation (eq. 9)."""
    distance, _ = nearest_of(
        _picture(pose, view, body, sight),
        sight.near[view],
        sight.prepared,
        sight.measure,
        sight.graph,
        sight.epsilon,
        np.inf,
    )
    return -0.5 * (distance / sight.noise) ** 2


@numba.njit(cache=True, nogil=True)
def choose_view(
    pose: np.ndarray, power: float, body: Body, sight: Sight, rng: np.random.Generator
) -> tuple[int, float, float]:
    """Return a view drawn in proportion to L_v^power, its log L_v, and log L of all views."""
    n_views = len(sight.vectors)
    logs = np.empty(n_views)
    for view in range(n_views):
        logs[view] = log_view(pose, view, body, sight)
    most = logs.max()
    total = np.cumsum(np.exp(power * (logs - most)))
    view = min(int(np.searchsorted(total, rng.random() * total[-1], side="right")), n_views - 1)
    return view, logs[view], most + np.log(np.exp(logs - most).mean())


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
    picture = _picture(pose, view, body, sight)
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
        _propose(pose, kind, joint, sizes[number], body, rng, proposed)
        weighed[:] = parts
        weighed[0] = _log_measure(proposed, body)
        # First by the graph and the annotation of the pose that is left: a guess, for a tenth of
        # the price (Christen and Fox 2005).
        guess = weighed[0] - parts[0]
        if power > 0:
            picture = _picture(proposed, view, body, sight)
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
        weighed[1] = _log_penetration(proposed, physics)
        if weighed[0] + weighed[1] < least:
            continue
        if kind != TURN and kind != SHIFT:
            _judge(proposed, body.person[joint], physics, weighed)
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
    _place_anew(pose, parts, body, rng)


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


@numba.njit(cache=True, nogil=True)
def _log_measure(pose: np.ndarray, body: Body) -> float:
    """Return the log density of normal log lengths and places of roots, 0 at the seed."""
    lengths = 0.0
    for joint in range(len(pose)):
        parent = body.parents[joint]
        if parent >= 0:
            here, there = 0.0, 0.0
            for i in range(3):
                here += (pose[joint, i] - pose[parent, i]) ** 2
                there += (body.seed[joint, i] - body.seed[parent, i]) ** 2
            lengths += (0.5 * np.log(here / there)) ** 2
    return _log_places(pose, body) - 0.5 * lengths / body.bone_noise**2


@numba.njit(cache=True, nogil=True)
def _log_places(pose: np.ndarray, body: Body) -> float:
    total = 0.0
    for root in body.roots:
        for i in range(3):
            total += (pose[root, i] - body.seed[root, i]) ** 2
    return -0.5 * total / body.root_noise**2


@numba.njit(cache=True, nogil=True)
def _log_penetration(pose: np.ndarray, physics: Physics) -> float:
    poses = pose.reshape(1, len(pose), 3)
    depth = total_depths(poses, physics.bones, physics.radii, physics.pairs)[0]
    return -0.5 * physics.penetration_weight * (depth / physics.position_noise) ** 2


@numba.njit(cache=True, nogil=True)
def _judge(pose: np.ndarray, person: int, physics: Physics, parts: np.ndarray) -> None:
    """Write a person's part of ‖X − X̂‖² and the number of invalid angles."""
    poses = pose.reshape(1, len(pose), 3)
    valid, nearest = project_poses(poses, physics.trees[person : person + 1], physics.limits)
    apart = ((poses - nearest) ** 2).sum()
    parts[2 + person] = -0.5 * apart / physics.position_noise**2
    parts[2 + len(physics.trees) + person] = valid.size - valid.sum()


@numba.njit(cache=True, nogil=True)
def _picture(pose: np.ndarray, view: int, body: Body, sight: Sight) -> np.ndarray:
    """Return a pose as seen in a view, (J, 2), metres."""
    frame, picture = np.empty((3, 3)), np.empty((len(pose), 2))
    _local_frame(pose, body, frame)
    _project(pose, frame, sight.vectors[view], picture)
    return picture


@numba.njit(cache=True, nogil=True)
def _propose(
    pose: np.ndarray,
    kind: int,
    joint: int,
    size: float,
    body: Body,
    rng: np.random.Generator,
    proposed: np.ndarray,
) -> None:
    proposed[:] = pose
    parent = body.parents[joint]
    turn, vector, centre = np.empty((3, 3)), np.empty(3), np.zeros(3)
    for i in range(3):
        vector[i] = size * rng.standard_normal()
    if kind == SHIFT:
        for k in range(len(pose)):
            if body.below[joint, k]:
                proposed[k] += vector
    elif kind == STRETCH:
        factor = np.exp(vector[0]) - 1.0
        for i in range(3):
            vector[i] = factor * (pose[joint, i] - pose[parent, i])
        for k in range(len(pose)):
            if body.below[joint, k]:
                proposed[k] += vector
    elif kind == TURN:
        people = 0
        for k in range(len(pose)):
            if body.below[joint, k]:
                centre += pose[k]
                people += 1
        _rotation(vector, turn)
        _turn_about(proposed, body.below[joint], centre / people, turn)
    elif kind == SWING:
        _rotation(vector, turn)
        _turn_about(proposed, body.below[joint], pose[parent], turn)
    elif kind == SLIDE:
        _rotation(vector, turn)
        for i in range(3):
            moved = -(pose[joint, i] - pose[parent, i])
            for m in range(3):
                moved += turn[i, m] * (pose[joint, m] - pose[parent, m])
            vector[i] = moved
        for k in range(len(pose)):
            if body.below[joint, k]:
                proposed[k] += vector
    else:
        angle = vector[0]
        if rng.random() < _HALF_TURN:
            angle = np.pi * (2.0 * rng.random() - 1.0)
        axis = pose[body.only_child[joint]] - pose[parent]
        length = np.sqrt((axis**2).sum())
        if length > 0:
            _rotation(axis * (angle / length), turn)
            alone = np.zeros(len(pose), dtype=np.bool_)
            alone[joint] = True
            _turn_about(proposed, alone, pose[parent], turn)


@numba.njit(cache=True, nogil=True)
def _place_anew(pose: np.ndarray, parts: np.ndarray, body: Body, rng: np.random.Generator) -> None:
    """Turn the pair by any rotation and draw where it stands: all else sees the same pair."""
    n_roots = len(body.roots)
    middle, start, new = np.zeros(3), np.zeros(3), np.empty(3)
    for root in body.roots:
        middle += pose[root] / n_roots
        start += body.seed[root] / n_roots
    for i in range(3):
        new[i] = start[i] + body.root_noise / np.sqrt(n_roots) * rng.standard_normal()
    turn = np.empty((3, 3))
    _any_rotation(rng, turn)
    # The middle is drawn from what the roots' places say of it; what is left is how the roots
    # stand about it.
    before, after = 0.0, 0.0
    for root in body.roots:
        for i in range(3):
            turned = 0.0
            for m in range(3):
                turned += turn[i, m] * (pose[root, m] - middle[m])
            wanted = body.seed[root, i] - start[i]
            before += (pose[root, i] - middle[i] - wanted) ** 2
            after += (turned - wanted) ** 2
    log_ratio = 0.5 * (before - after) / body.root_noise**2
    if -rng.standard_exponential() < log_ratio:
        parts[0] -= _log_places(pose, body)
        _turn_about(pose, np.ones(len(pose), dtype=np.bool_), middle, turn)
        pose += new - middle
        parts[0] += _log_places(pose, body)


@numba.njit(cache=True, nogil=True)
def _turn_about(pose: np.ndarray, chosen: np.ndarray, centre: np.ndarray, turn: np.ndarray) -> None:
    for k in range(len(pose)):
        if chosen[k]:
            x, y, z = pose[k, 0] - centre[0], pose[k, 1] - centre[1], pose[k, 2] - centre[2]
            for i in range(3):
                pose[k, i] = centre[i] + turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z


@numba.njit(cache=True, nogil=True)
def _rotation(vector: np.ndarray, turn: np.ndarray) -> None:
    """Write the matrix of a rotation vector."""
    angle = np.sqrt((vector**2).sum())
    half = 0.5 * angle
    scale = np.sin(half) / angle if angle > 1e-12 else 0.5
    _of_quaternion(np.cos(half), scale * vector[0], scale * vector[1], scale * vector[2], turn)


@numba.njit(cache=True, nogil=True)
def _any_rotation(rng: np.random.Generator, turn: np.ndarray) -> None:
    w, x, y, z = (
        rng.standard_normal(),
        rng.standard_normal(),
        rng.standard_normal(),
        rng.standard_normal(),
    )
    size = np.sqrt(w * w + x * x + y * y + z * z)
    _of_quaternion(w / size, x / size, y / size, z / size, turn)


@numba.njit(cache=True, nogil=True)
def _of_quaternion(w: float, x: float, y: float, z: float, turn: np.ndarray) -> None:
    turn[0, 0], turn[0, 1], turn[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
    )
    turn[1, 0], turn[1, 1], turn[1, 2] = (
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
    )
    turn[2, 0], turn[2, 1], turn[2, 2] = (
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@numba.njit(cache=True, nogil=True)
def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(np.sqrt((vector**2).sum()), 1e-300)


@numba.njit(cache=True, nogil=True)
def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    found = np.empty(3)
    found[0] = a[1] * b[2] - a[2] * b[1]
    found[1] = a[2] * b[0] - a[0] * b[2]
    found[2] = a[0] * b[1] - a[1] * b[0]
    return found


@numba.njit(cache=True, nogil=True)
def _local_frame(pose: np.ndarray, body: Body, frame: np.ndarray) -> None:
    """Write i, j and k of :func:`~probmotion.interaction.local_frames.local_frames` as columns."""
    up = np.zeros(3)
    for person in range(len(body.roots)):
        up += _unit(pose[body.chests[person]] - pose[body.roots[person]])
    frame[:, 0] = _unit(pose[body.roots[1]] - pose[body.roots[0]])
    frame[:, 1] = _unit(up)
    frame[:, 2] = _cross(frame[:, 0], frame[:, 1])


@numba.njit(cache=True, nogil=True)
def _project(pose: np.ndarray, frame: np.ndarray, vector: np.ndarray, picture: np.ndarray) -> None:
    """Write the orthographic picture, as :func:`~probmotion.interaction.views.project_to_views`.

    Up is anything across the view here: annotations are turned to fit.
    """
    towards = np.zeros(3)
    for i in range(3):
        for k in range(3):
            towards[i] += frame[i, k] * vector[k]
    towards = _unit(towards)
    other = np.zeros(3)
    other[np.abs(towards).argmin()] = 1.0
    right = _unit(_cross(other, towards))
    up = _cross(towards, right)
    for joint in range(len(pose)):
        x, y = 0.0, 0.0
        for i in range(3):
            x += right[i] * pose[joint, i]
            y += up[i] * pose[joint, i]
        picture[joint, 0], picture[joint, 1] = x, y
