"""Search for the nearest annotation of a 2D projection (Yin et al. 2018, eqs. 8-9).

The code is the compiled counterpart of :mod:`probmotion.interaction.geometry.coordinates` and
:mod:`probmotion.interaction.geometry.shape_context`.
"""

from __future__ import annotations

import numpy as np

from probmotion.extras import numba
from probmotion.interaction.geometry.graph_kernels import graphs_of_visible, max_edges, write_graph
from probmotion.interaction.geometry.graphs import GRAPHS, check_graph, joggle_offsets
from probmotion.interaction.geometry.likelihood_kernels import (
    log_terms_in_batch,
    log_terms_on_threads,
)
from probmotion.interaction.geometry.nearest_kernels import (
    Prepared,
    all_distances,
    nearest_in_batch,
    nearest_in_batch_on_threads,
)
from probmotion.interaction.geometry.shape_context import shape_contexts, shared_table
from probmotion.threads import only_one_thread
from probmotion.validation import check_finite, check_positive, check_shape

__all__ = ["MEASURES", "PairComparer"]

MEASURES = ("interaction", "cartesian", "shape-context")
"""Names of distances between 2D pose-pairs; kernels use the index."""


class PairComparer:
    """Distance computation between 2D projections and a fixed set of annotated pose-pairs.

    A projection is first rigidly aligned to the visible joints of the annotation (no reflection).

    - ``interaction``: eq. 8, metres. The graphs connect all joints of the projection and the
      visible joints of the annotation; edges with an occluded end are ignored.
    - ``cartesian``: root-mean-square distance of the visible joints, metres.
    - ``shape-context``: mean χ² cost of the visible joints' shape contexts, in [0, 1].

    Parameters
    ----------
    keypoints : ndarray, (n, J, 2)
        Annotated joints, metres; occluded joints are ignored.
    visible : ndarray of bool, (n, J)
        Mask of annotated joints.
    measure : str
        Distance, one of :data:`MEASURES`.
    graph : str
        Graph for ``interaction``, one of :data:`~probmotion.interaction.geometry.graphs.GRAPHS`.
    epsilon : float
        ε of eq. 8, metres.

    Attributes
    ----------
    prepared : Prepared
        Precomputed data and options for the compiled code.
    """

    def __init__(
        self,
        keypoints: np.ndarray,
        visible: np.ndarray,
        *,
        measure: str = "interaction",
        graph: str = "delaunay",
        epsilon: float = 0.05,
    ) -> None:
        keypoints = np.asarray(keypoints, dtype=np.float64)
        visible = np.ascontiguousarray(visible, dtype=bool)
        check_shape("keypoints", keypoints, ("n", "J", 2))
        check_shape("visible", visible, keypoints.shape[:2])
        if not 1 <= keypoints.shape[1] <= 256 or len(keypoints) == 0:
            raise ValueError(
                "keypoints must contain at least one annotation of 1 to 256 joints, got shape "
                f"{keypoints.shape}"
            )
        if measure not in MEASURES:
            raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")
        check_graph(graph)
        check_positive("epsilon", epsilon)
        keypoints = np.where(visible[..., None], keypoints, 0.0)
        check_finite("keypoints", keypoints)
        self.measure, self.graph, self.epsilon = measure, graph, float(epsilon)
        self.n_annotations, self.n_joints = keypoints.shape[:2]
        self.prepared = _prepare(
            keypoints, visible, MEASURES.index(measure), GRAPHS.index(graph), self.epsilon
        )

    def nearest(
        self, projections: np.ndarray, candidates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance and index of each projection's nearest candidate annotation.

        Results are bit-identical for any batch size and thread count (``numba.set_num_threads``).

        Parameters
        ----------
        projections : ndarray, (B, V, J, 2)
            Projections of pose-pairs to V views, metres.
        candidates : ndarray of int, (V, N)
            Indices of the annotations to compare in each view, at least one.

        Returns
        -------
        distances : ndarray, (B, V)
            Distances; infinite if no candidate shares an edge (``cartesian``: a joint,
            ``shape-context``: two joints) with the projection.
        indices : ndarray of int, (B, V)
            Indices of the annotations; the first candidate in case of ties.
        """
        projections = self._checked(projections, ("B", "V", self.n_joints, 2))
        candidates = self._checked_candidates(candidates, projections.shape[1])
        serial = _serial(projections.shape[0] * projections.shape[1])
        kernel = nearest_in_batch if serial else nearest_in_batch_on_threads
        return kernel(projections, candidates, self.prepared)

    def log_terms(
        self, projections: np.ndarray, candidates: np.ndarray, noise: float
    ) -> np.ndarray:
        """Return −d²/2σ_l² for the distance d to the nearest candidate in each view (eq. 9).

        Parameters
        ----------
        projections, candidates : ndarray, (B, V, J, 2) and (V, N)
            As in :meth:`nearest`.
        noise : float
            Scale σ_l of the distances.

        Returns
        -------
        log_terms : ndarray, (B, V)
            −∞ for views that are negligible beside another view of the same pose-pair, in
            addition to those without a distance.
        """
        if self.measure != "interaction":
            distances, _ = self.nearest(projections, candidates)
            return -0.5 * (distances / noise) ** 2
        projections = self._checked(projections, ("B", "V", self.n_joints, 2))
        candidates = self._checked_candidates(candidates, projections.shape[1])
        kernel = log_terms_in_batch if _serial(len(projections)) else log_terms_on_threads
        return kernel(projections, candidates, self.prepared, float(noise))

    def distances(self, projections: np.ndarray) -> np.ndarray:
        """Return the distances of projections, (B, J, 2) in metres, to all annotations, (B, n)."""
        projections = self._checked(projections, ("B", self.n_joints, 2))
        return all_distances(projections, self.prepared)

    def degenerate(self, projections: np.ndarray) -> int:
        """Return the number of projections, (…, J, 2), with a degenerate Delaunay graph."""
        projections = self._checked(projections, ("…", self.n_joints, 2))
        graph, offsets = self.prepared.graph, self.prepared.offsets
        edges = np.empty((max_edges(self.n_joints, graph), 2), dtype=np.uint16)
        flat = projections.reshape(-1, self.n_joints, 2)
        return sum(bool(write_graph(points, graph, offsets, edges)[1]) for points in flat)

    def _checked(self, projections: np.ndarray, expected: tuple[int | str, ...]) -> np.ndarray:
        projections = np.ascontiguousarray(projections, dtype=np.float64)
        check_shape("projections", projections, expected)
        check_finite("projections", projections)
        return projections

    def _checked_candidates(self, candidates: np.ndarray, n_views: int) -> np.ndarray:
        candidates = np.ascontiguousarray(candidates)
        check_shape("candidates", candidates, (n_views, "N"))
        if candidates.dtype.kind not in "iu":
            raise ValueError(f"candidates must be integers, got {candidates.dtype}")
        if candidates.shape[1] == 0:
            raise ValueError("candidates must contain at least one annotation per view, got none")
        if candidates.size and not 0 <= candidates.min() <= candidates.max() < self.n_annotations:
            raise ValueError(
                f"candidates must be from 0 to {self.n_annotations - 1}, got "
                f"{candidates.min()} to {candidates.max()}"
            )
        return candidates.astype(np.int64, copy=False)


def _serial(tasks: int) -> bool:
    """Return whether to run tasks on the calling thread.

    A thread pool for one thread is avoided because a process cannot fork after starting one.
    """
    return only_one_thread() or numba.get_num_threads() == 1 or tasks < 2


def _prepare(
    keypoints: np.ndarray, visible: np.ndarray, measure: int, graph: int, epsilon: float
) -> Prepared:
    """Precompute the data of the kernels; occluded keypoints must be 0."""
    n_joints = keypoints.shape[1]
    n_visible = visible.sum(axis=1)
    offsets = joggle_offsets(n_joints, 2)
    mean = keypoints.sum(axis=1) / np.maximum(n_visible, 1)[:, None]
    centred = np.where(visible[..., None], keypoints - mean[:, None], 0.0)
    # Prepare only the data of the chosen measure.
    graphed = slice(None if MEASURES[measure] == "interaction" else 0)
    binned = slice(None if MEASURES[measure] == "shape-context" else 0)
    n_edges, edges, weights = graphs_of_visible(
        keypoints[graphed], visible[graphed], graph, epsilon, offsets
    )
    used = np.arange(weights.shape[1]) < n_edges[:, None]
    return Prepared(
        joints=np.ascontiguousarray(np.swapaxes(centred, 1, 2)),
        seen=visible.astype(np.float64),
        n_visible=n_visible,
        square=(centred**2).sum(axis=(1, 2)),
        edge_start=np.concatenate([[0], np.cumsum(n_edges)]),
        edges=np.ascontiguousarray(edges[used].T),
        weights=weights[used],
        contexts=shape_contexts(keypoints[binned], visible[binned]),
        shared=shared_table(n_joints - 1),
        offsets=offsets,
        measure=measure,
        graph=graph,
        epsilon=epsilon,
    )
