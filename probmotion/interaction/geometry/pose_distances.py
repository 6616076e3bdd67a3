"""How unlike 3D poses are, whatever their place and heading: three measures (Yin et al. 2018).

Every measure is taken after the rigid motion (a rotation about any axis and a translation, no
reflection) that best brings the second pose's joints onto the first one's in least squares.

- ``"interaction"`` (D_IC): eq. 8 with 3D vectors along the edges of the Delaunay tetrahedra of
  both poses, metres.
- ``"cartesian"`` (D_C): root mean square distance of corresponding joints, metres.
- ``"shape-context"`` (D_S): mean χ² cost of corresponding joints' 3D shape contexts, 0 to 1, with
  the first pose's vertical for both.

All are 0 for two copies of one pose. The first two are symmetric; D_S is where both poses stand
upright when they are aligned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from probmotion.interaction.geometry.graphs import graph_edges
from probmotion.interaction.geometry.pose_distance_kernels import (
    cartesian_minima,
    cartesian_table,
    interaction_minima,
    interaction_table,
)
from probmotion.interaction.geometry.shape_distance_kernels import (
    ring_counts,
    shape_minima,
    shape_table,
)
from probmotion.validation import check_finite, check_shape

__all__ = ["MEASURES", "SHORTEST_EDGE", "Measure", "pose_distances"]

SHORTEST_EDGE = 0.05
"""ε of eq. 8, metres."""

Prepared = tuple[np.ndarray, ...]
"""What the compiled functions of a measure take of a set of poses."""


class Measure(NamedTuple):
    """``prepare`` poses (n, J, 3) once; then fill a ``table`` (n, m), or lower ``minima`` (n,)."""

    prepare: Callable[[np.ndarray], Prepared]
    table: Callable[..., None]
    minima: Callable[..., None]


def pose_distances(first: np.ndarray, second: np.ndarray, measure: str) -> np.ndarray:
    """Return the distance of every pose of one set from every pose of another.

    Parameters
    ----------
    first, second : ndarray, (n, J, 3) and (m, J, 3)
        Poses of the same J joints, metres.
    measure : str
        One of :data:`MEASURES`.

    Returns
    -------
    distances : ndarray, (n, m)
        Metres, or without unit for shape contexts.

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite, or the measure is unknown.
    """
    check_measure(measure)
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    check_shape("first", first, ("n", "J", 3))
    check_shape("second", second, ("m", first.shape[1], 3))
    check_finite("first", first)
    check_finite("second", second)
    prepare, fill, _ = MEASURES[measure]
    table = np.empty((len(first), len(second)))
    fill(*prepare(first), *prepare(second), table)
    return table


def check_measure(measure: str) -> None:
    """Raise ``ValueError`` unless ``measure`` is one of :data:`MEASURES`."""
    if measure not in MEASURES:
        raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")


def _centred(poses: np.ndarray) -> Prepared:
    """Return poses about their mean joint."""
    return (np.ascontiguousarray(poses - poses.mean(axis=1, keepdims=True)),)


def _triangulated(poses: np.ndarray) -> Prepared:
    """Return centred poses with where their edges start, all edges (E, 2) and their weights (E,).

    The weights ``1 / max(ε, ‖u_ij‖)`` of each pose are made to sum to 1.
    """
    (centred,) = _centred(poses)
    edges, weights = [np.empty((0, 2), dtype=np.int32)], [np.empty(0)]
    for pose in centred:
        found = graph_edges(pose, "delaunay").astype(np.int32)
        lengths = np.linalg.norm(pose[found[:, 0]] - pose[found[:, 1]], axis=1)
        weight = 1 / np.maximum(SHORTEST_EDGE, lengths)
        edges.append(found)
        weights.append(weight / weight.sum())
    starts = np.cumsum([0, *map(len, weights[1:])], dtype=np.int64)
    return centred, starts, np.concatenate(edges), np.concatenate(weights)


def _ringed(poses: np.ndarray) -> Prepared:
    """Return centred poses with the counts of their joints' rings, (n, J, 5)."""
    (centred,) = _centred(poses)
    return centred, ring_counts(centred)


MEASURES: Mapping[str, Measure] = {
    "interaction": Measure(_triangulated, interaction_table, interaction_minima),
    "cartesian": Measure(_centred, cartesian_table, cartesian_minima),
    "shape-context": Measure(_ringed, shape_table, shape_minima),
}
"""The measures by name."""
