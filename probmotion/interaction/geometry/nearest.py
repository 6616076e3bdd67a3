"""The annotation nearest to a projection: what the likelihood of pose-pairs asks, many times over.

Yin, Huang, Cohen-Or and Zhang, "Sampling of closely interacting pose-pairs", eqs. 8 and 9. The
compiled counterpart of :mod:`probmotion.interaction.geometry.coordinates` and
:mod:`probmotion.interaction.geometry.shape_context`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from probmotion.interaction.geometry.graph_kernels import count_degenerate, graphs_of_visible
from probmotion.interaction.geometry.graphs import GRAPHS, check_graph, joggle_offsets
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
"""What pose-pairs can be compared by; the kernels know them by their places."""


class PairComparer:
    """Annotated 2D pose-pairs, prepared so that projections are compared with them fast.

    A projection is first brought to the annotation by the least-squares rotation and translation
    over the annotation's visible joints (no reflection), then compared:

    - ``interaction``: eq. 8 over the graphs of both, metres. The projection's graph is that of
      all its joints, the annotation's that of its visible ones; edges with a hidden end do not
      count.
    - ``cartesian``: the root mean square distance of the visible joints, metres.
    - ``shape-context``: the mean χ² cost of the visible joints' shape contexts, in [0, 1].

    Parameters
    ----------
    keypoints : numpy.ndarray
        Annotations, shape (n, J, 2), metres; those of hidden joints are never read.
    visible : numpy.ndarray
        Which joints are annotated, bool, shape (n, J).
    measure : str
        One of :data:`MEASURES`.
    graph : str
        One of :data:`~probmotion.interaction.geometry.graphs.GRAPHS`; only ``interaction`` has one.
    epsilon : float
        ε of eq. 8, metres.

    Attributes
    ----------
    prepared, options
        What compiled code of others reads: the annotations, and measure, graph and ε as its
        kernels know them.

    Raises
    ------
    ValueError
        If shapes do not fit, there is no annotation, a visible keypoint is not finite, or an
        option is unknown.
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
                f"keypoints has shape {keypoints.shape}, expected at least one annotation of 1 to "
                "256 joints"
            )
        if measure not in MEASURES:
            raise ValueError(f"measure must be one of {', '.join(MEASURES)}, got {measure!r}")
        check_graph(graph)
        check_positive("epsilon", epsilon)
        keypoints = np.where(visible[..., None], keypoints, 0.0)
        check_finite("keypoints", keypoints)
        self.measure, self.graph, self.epsilon = measure, graph, float(epsilon)
        self.n_annotations, self.n_joints = keypoints.shape[:2]
        self.options = (MEASURES.index(measure), GRAPHS.index(graph), self.epsilon)
        self.prepared = _prepare(keypoints, visible, *self.options)

    def nearest(
        self, projections: np.ndarray, candidates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the nearest candidate annotation is, and which it is.

        The result of a projection depends neither on its batch nor on the number of threads,
        which is Numba's (``numba.set_num_threads``).

        Parameters
        ----------
        projections : numpy.ndarray
            Pose-pairs as seen in V views, shape (B, V, J, 2), metres.
        candidates : numpy.ndarray
            The annotations to look at in each view, integers, shape (V, N), N at least 1.

        Returns
        -------
        distances : numpy.ndarray
            Shape (B, V); infinite where no candidate shares an edge (joints, for the measures
            without a graph) with the projection.
        indices : numpy.ndarray
            Shape (B, V), of equally near ones the first among the candidates.

        Raises
        ------
        ValueError
            If shapes do not fit, a projection is not finite, or a candidate is not an annotation.
        """
        projections = self._checked(projections, ("B", "V", self.n_joints, 2))
        candidates = self._checked_candidates(candidates, projections.shape[1])
        # One thread needs no pool of threads, which a process could not fork after.
        alone = only_one_thread() or numba.get_num_threads() == 1
        several = projections.shape[0] * projections.shape[1] > 1
        kernel = nearest_in_batch_on_threads if several and not alone else nearest_in_batch
        return kernel(projections, candidates, self.prepared, *self.options)

    def distances(self, projections: np.ndarray) -> np.ndarray:
        """Return the distances to all annotations, (B, n), as for retrieval.

        Parameters
        ----------
        projections : numpy.ndarray
            Shape (B, J, 2), metres.

        Raises
        ------
        ValueError
            If the shape does not fit or a projection is not finite.
        """
        projections = self._checked(projections, ("B", self.n_joints, 2))
        return all_distances(projections, self.prepared, *self.options)

    def degenerate(self, projections: np.ndarray) -> int:
        """Return how many projections had to be moved by tiny offsets to be triangulated.

        Parameters
        ----------
        projections : numpy.ndarray
            Shape (…, J, 2), metres. Graphs other than Delaunay's never need it.

        Raises
        ------
        ValueError
            If the shape does not fit or a projection is not finite.
        """
        projections = self._checked(projections, ("…", self.n_joints, 2))
        flat = projections.reshape(math.prod(projections.shape[:-2]), self.n_joints, 2)
        return int(count_degenerate(flat, self.options[1], self.prepared.offsets))

    def _checked(self, projections: np.ndarray, expected: tuple[int | str, ...]) -> np.ndarray:
        projections = np.ascontiguousarray(projections, dtype=np.float64)
        check_shape("projections", projections, expected)
        if not np.isfinite(projections).all():
            check_finite("projections", projections)
        return projections

    def _checked_candidates(self, candidates: np.ndarray, n_views: int) -> np.ndarray:
        candidates = np.ascontiguousarray(candidates)
        check_shape("candidates", candidates, (n_views, "N"))
        if candidates.dtype.kind not in "iu":
            raise ValueError(f"candidates has dtype {candidates.dtype}, expected integers")
        if candidates.shape[1] == 0:
            raise ValueError(
                f"candidates must have shape at least one annotation a view, got {candidates.shape}"
            )
        if candidates.size and (candidates.min() < 0 or candidates.max() >= self.n_annotations):
            raise ValueError(
                f"candidates holds {candidates.min()} to {candidates.max()}, expected 0 to "
                f"{self.n_annotations - 1}"
            )
        return candidates.astype(np.int64, copy=False)


def _prepare(
    keypoints: np.ndarray, visible: np.ndarray, measure: int, graph: int, epsilon: float
) -> Prepared:
    """Return what the kernels need of annotations; hidden keypoints are 0."""
    n_joints = keypoints.shape[1]
    n_visible = visible.sum(axis=1)
    offsets = joggle_offsets(n_joints, 2)
    mean = keypoints.sum(axis=1) / np.maximum(n_visible, 1)[:, None]
    centred = np.where(visible[..., None], keypoints - mean[:, None], 0.0)
    # Each measure prepares what it reads, and nothing of the others.
    graphed = slice(None if MEASURES[measure] == "interaction" else 0)
    binned = slice(None if MEASURES[measure] == "shape-context" else 0)
    n_edges, edges, weights = graphs_of_visible(
        keypoints[graphed], visible[graphed], graph, epsilon, offsets
    )
    kept = np.arange(weights.shape[1]) < n_edges[:, None]
    return Prepared(
        joints=np.ascontiguousarray(np.swapaxes(centred, 1, 2)),
        seen=visible.astype(np.float64),
        n_visible=n_visible,
        square=(centred**2).sum(axis=(1, 2)),
        edge_start=np.concatenate([[0], np.cumsum(n_edges)]),
        edges=np.ascontiguousarray(edges[kept].T),
        weights=weights[kept],
        contexts=shape_contexts(keypoints[binned], visible[binned]),
        shared=shared_table(n_joints - 1),
        offsets=offsets,
    )
