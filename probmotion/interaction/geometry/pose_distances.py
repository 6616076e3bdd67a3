"""Distances between 3D poses, invariant to position and heading (Yin et al. 2018).

The second pose is first rigidly aligned to the first by least squares (no reflection).

- ``"interaction"`` (D_IC): eq. 8 over the edges of both poses' Delaunay tetrahedra, metres.
- ``"cartesian"`` (D_C): root-mean-square distance of corresponding joints, metres.
- ``"shape-context"`` (D_S): mean χ² cost of corresponding 3D shape contexts, 0 to 1, about the
  vertical of the first pose; symmetric only if both poses are upright after alignment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from probmotion.interaction.geometry.graphs import graph_edges
from probmotion.interaction.geometry.pose_distance_kernels import (
    cartesian_minima,
    interaction_minima,
)
from probmotion.interaction.geometry.shape_distance_kernels import ring_counts, shape_minima
from probmotion.validation import check_finite, check_shape

__all__ = ["MEASURES", "Measure", "check_measure", "pose_distances"]

_SHORTEST_EDGE = 0.05  # ε of eq. 8, metres


Measure = tuple[Callable[[np.ndarray], tuple[np.ndarray, ...]], Callable[..., None]]
"""Functions ``prepare`` and ``minima`` of a distance.

``minima(*prepare(truths), *prepare(draws), out)`` lowers ``out`` (n,) to the distance of each
of the truths (n, J, 3) to its nearest draw.
"""


def pose_distances(first: np.ndarray, second: np.ndarray, measure: str) -> np.ndarray:
    """Return the distances between poses: ``(n, J, 3), (m, J, 3) → (n, m)``, metres.

    ``measure`` is one of :data:`MEASURES`; shape-context distances are dimensionless.
    """
    check_measure(measure)
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    check_shape("first", first, ("n", "J", 3))
    check_shape("second", second, ("m", first.shape[1], 3))
    check_finite("first", first)
    check_finite("second", second)
    prepare, lower_minima = MEASURES[measure]
    prepared, distances = prepare(first), np.full((len(second), len(first)), np.inf)
    for pose, row in zip(second, distances, strict=True):
        lower_minima(*prepared, *prepare(pose[None]), row)
    return distances.T


def check_measure(measure: str) -> None:
    """Raise ``ValueError`` unless ``measure`` is one of :data:`MEASURES`."""
    if measure not in MEASURES:
        raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")


def _centred(poses: np.ndarray) -> tuple[np.ndarray]:
    """Return poses centred on their mean joint."""
    return (np.ascontiguousarray(poses - poses.mean(axis=1, keepdims=True)),)


def _triangulated(poses: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return centred poses, the index of each pose's first edge, the edges and their weights."""
    (centred,) = _centred(poses)
    edges, weights = [np.empty((0, 2), dtype=np.int32)], [np.empty(0)]
    for pose in centred:
        edges.append(graph_edges(pose, "delaunay").astype(np.int32))
        first, second = edges[-1].T
        weight = 1 / np.maximum(_SHORTEST_EDGE, np.linalg.norm(pose[first] - pose[second], axis=1))
        weights.append(weight / weight.sum())
    starts = np.cumsum([0, *map(len, weights[1:])], dtype=np.int64)
    return centred, starts, np.concatenate(edges), np.concatenate(weights)


def _ringed(poses: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return centred poses and the ring counts of their joints, (n, J, 5)."""
    (centred,) = _centred(poses)
    return centred, ring_counts(centred)


MEASURES: Mapping[str, Measure] = {
    "interaction": (_triangulated, interaction_minima),
    "cartesian": (_centred, cartesian_minima),
    "shape-context": (_ringed, shape_minima),
}
"""Distances by name."""
