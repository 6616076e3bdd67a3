"""Repair of exchanged left and right limbs in views that contradict the others."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product

import numpy as np

from probmotion.lifting.camera import LevelCamera, LevelCameras
from probmotion.lifting.keypoints import PERSON, SIDED, PersonKeypoints

__all__ = ["consistent_sides"]

_APART = 0.05  # typical distance between rays to one joint, metres
_EXCHANGED = 0.5  # cost of a view with exchanged sides in a frame
_CHANGE = 5.0  # cost of a view that is exchanged or repaired from one frame to the next


def consistent_sides(
    views: Sequence[PersonKeypoints], cameras: LevelCameras
) -> list[PersonKeypoints]:
    """Return the keypoints of V views with the sides on which most views agree.

    Where as many views disagree, those of the first views are kept.

    Rays of two views to one joint meet. For arms and legs, the cheapest sequence of sets of views
    with exchanged sides (Viterbi) has the smallest sum of log(1 + d²/σ²) over pairs of views, with
    the distances d of rays, and of costs of exchanges and of changes.
    """
    order = list(PERSON.mirrored_order)
    rays = [_rays(camera, view) for camera, view in zip(cameras.views, views, strict=True)]
    states = np.array(list(product([False, True], repeat=len(views))))
    changes = _CHANGE * (states[:, None] != states).sum(axis=-1)
    points = [view.points.copy() for view in views]
    weight = [view.weight.copy() for view in views]
    shares = np.zeros(len(views))
    for group in SIDED:
        joints = [j for j, name in enumerate(PERSON.joint_names) if name.endswith(group)]
        mirrored = [order[j] for j in joints]
        costs = np.tile(_EXCHANGED * states.sum(axis=1), (len(points[0]), 1))
        for v, w in combinations(range(len(views)), 2):
            baseline = np.subtract(cameras.views[w].position, cameras.views[v].position)
            same = _apart(rays[v][:, joints], rays[w][:, joints], baseline)
            cross = _apart(rays[v][:, joints], rays[w][:, mirrored], baseline)
            differs = states[:, v] != states[:, w]
            costs += np.where(differs, cross[:, None], same[:, None])
        chosen = states[_cheapest(costs, changes)]
        for v in range(len(views)):
            frames = np.flatnonzero(chosen[:, v])[:, None]
            points[v][frames, joints] = views[v].points[frames, mirrored]
            weight[v][frames, joints] = views[v].weight[frames, mirrored]
            shares[v] += len(frames) / len(points[v]) / len(SIDED)
    return [
        PersonKeypoints(points[v], weight[v], min(1.0, view.swapped + float(shares[v])))
        for v, view in enumerate(views)
    ]


def _rays(camera: LevelCamera, view: PersonKeypoints) -> np.ndarray:
    """Return the directions of the keypoints, (L, J, 3), of length 1; NaN where missing."""
    depth = np.ones(view.weight.shape)
    rays = camera.points(camera.normalised(view.points), depth) - camera.position
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    directions: np.ndarray = np.where(view.weight[..., None] > 0, rays, np.nan)
    return directions


def _apart(first: np.ndarray, second: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """Return Σ log(1 + d²/σ²) over pairs of rays, (L, n, 3) → (L,); missing ones count 0."""
    normal = np.cross(first, second)
    length = np.maximum(np.linalg.norm(normal, axis=-1), 1e-6)
    distance = np.abs(normal @ baseline) / length
    total: np.ndarray = np.nansum(np.log1p((distance / _APART) ** 2), axis=1)
    return total


def _cheapest(costs: np.ndarray, changes: np.ndarray) -> np.ndarray:
    """Return the cheapest sequence of states, (L,), with costs (L, S) and of changes (S, S)."""
    total, origins = costs[0], np.zeros(costs.shape, dtype=int)
    for frame in range(1, len(costs)):
        ways = total[:, None] + changes
        origins[frame] = ways.argmin(axis=0)
        total = ways.min(axis=0) + costs[frame]
    path = np.empty(len(costs), dtype=int)
    path[-1] = total.argmin()
    for frame in range(len(costs) - 1, 0, -1):
        path[frame - 1] = origins[frame, path[frame]]
    return path
