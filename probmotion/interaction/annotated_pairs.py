"""Likelihood of 3D pose-pairs given 2D annotations of the same kind of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, logsumexp
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.backbones import annotation_views
from probmotion.interaction.annotations.views import ViewDistribution, project_to_views
from probmotion.interaction.geometry.nearest import PairComparer
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["AnnotatedPairs"]


@dataclass(frozen=True, eq=False)
class AnnotatedPairs:
    """Likelihood of pose-pairs given annotations in similar views (Yin et al. 2018, eqs. 5-9).

    L(Θ) ∝ (1/m) Σᵢ max_j exp(−d(M Θ_vᵢ, p_j)²/2σ_l²) with m views vᵢ ~ f(v), where M Θ_v is the
    pose-pair Θ projected to view v, p_j an annotation and d the dissimilarity. Views are fixed by
    ``seed``, unless :meth:`evaluate` draws fresh ones for an unbiased estimate.

    Parameters
    ----------
    annotations : Annotations
        n annotated pairs with views, metres.
    n_views : int
        Number of views m.
    n_near : int
        Number of annotations compared per view, nearest in view angle.
    noise : float
        Scale σ_l of the dissimilarity, metres; dimensionless for shape contexts.
    view_bandwidth : float
        Bandwidth σ_v of the view distribution f(v), radians.
    measure : str
        Dissimilarity d: ``"interaction"``, ``"cartesian"`` or ``"shape-context"``.
    graph : str
        Graph of the interaction coordinates; one of
        :data:`probmotion.interaction.geometry.graphs.GRAPHS`.
    shortest_edge : float
        Lower limit ε of the edge lengths in eq. 8, metres.
    seed : int
        Seed of the views.
    """

    annotations: Annotations
    n_views: int = 32
    n_near: int = 32
    noise: float = 0.01
    view_bandwidth: float = 0.5
    measure: str = "interaction"
    graph: str = "delaunay"
    shortest_edge: float = 0.05
    seed: int = 0
    distribution: ViewDistribution = field(init=False, repr=False)
    comparer: PairComparer = field(init=False, repr=False)
    views: np.ndarray = field(init=False, repr=False)
    near: np.ndarray = field(init=False, repr=False)

    frames = 1
    differentiable = False

    def __post_init__(self) -> None:
        check_count("n_views", self.n_views)
        check_count("n_near", self.n_near)
        check_positive("noise", self.noise)
        if self.annotations.views is None:
            raise ValueError(
                "annotations must have views, got none: estimate them with "
                "AnnotatedPairs.estimated(annotations, seed_pose)"
            )
        check_positive("view_bandwidth", self.view_bandwidth)
        check_positive("shortest_edge", self.shortest_edge)
        _check_metres(self.annotations)
        distribution = ViewDistribution(self.annotations.views, self.view_bandwidth)
        comparer = PairComparer(
            self.annotations.keypoints,
            self.annotations.visible,
            measure=self.measure,
            graph=self.graph,
            epsilon=self.shortest_edge,
        )
        views = distribution.sample(seeds.generator(self.seed, "views"), self.n_views)
        object.__setattr__(self, "distribution", distribution)
        object.__setattr__(self, "comparer", comparer)
        object.__setattr__(self, "views", views)
        object.__setattr__(self, "near", distribution.near(views, self.n_near))

    @classmethod
    def estimated(
        cls, annotations: Annotations, seed_pose: np.ndarray, **settings: object
    ) -> AnnotatedPairs:
        """Return the likelihood with views estimated from the backbones.

        Parameters
        ----------
        annotations : Annotations
            Annotations; existing views are ignored. Annotations without an estimate are omitted and
            counted in ``dropped``.
        seed_pose : ndarray, (J, 3)
            3D pose-pair with the torsos to fit, metres.
        **settings
            Other parameters of :class:`AnnotatedPairs`.
        """
        check_shape("seed_pose", np.asarray(seed_pose), (annotations.skeleton.n_joints, 3))
        views = annotation_views(annotations, seed_pose)
        known = ~np.isnan(views).any(axis=-1)
        if not known.any():
            raise ValueError(
                "annotations must show at least three torso joints of each person in one frame, "
                f"got none in {len(views)} frames"
            )
        dropped = dict(annotations.dropped)
        if not known.all():
            dropped["view not estimated"] = int((~known).sum())
        usable = replace(annotations, views=views, dropped=dropped).subset(known)
        return cls(usable, **settings)  # type: ignore[arg-type]

    @property
    def skeleton(self) -> Skeleton:
        """Skeleton of the annotated pairs."""
        return self.annotations.skeleton

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return self.skeleton.n_joints

    @property
    def log_bound(self) -> float:
        """Upper bound of log L, 0; allows truncated posteriors to skip evaluations."""
        return 0.0

    def log_density(self, positions: Array) -> np.ndarray:
        """Return log L up to a constant: ``(…, 1, J, 3) → (…)``; NumPy arrays only."""
        if not isinstance(positions, np.ndarray):
            raise ValueError(
                f"positions must be a NumPy array, got {type(positions).__name__}: the likelihood "
                "is not differentiable"
            )
        check_shape("positions", positions, ("…", 1, self.n_joints, 3))
        poses = np.asarray(positions, dtype=np.float64).reshape(-1, self.n_joints, 3)
        projected = project_to_views(poses, self.views, self.skeleton)
        log_terms = self.comparer.log_terms(projected, self.near, self.noise)
        return self._mean(log_terms).reshape(positions.shape[:-3])

    def evaluate(
        self, positions: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return log L and the closest annotation in each view.

        Parameters
        ----------
        positions : ndarray, (…, 1, J, 3)
            Pose-pairs, metres.
        generators : sequence of numpy.random.Generator, optional
            One per pose-pair, to draw fresh views: exp(log L) is then an unbiased estimate, for
            pseudo-marginal samplers (Andrieu and Roberts 2009). Views are fixed by default.

        Returns
        -------
        log_density : ndarray, (…)
        closest : ndarray of int, (…, m)
        """
        check_shape("positions", positions, ("…", 1, self.n_joints, 3))
        batch = positions.shape[:-3]
        poses = np.asarray(positions, dtype=np.float64).reshape(-1, self.n_joints, 3)
        if generators is None:
            projected = project_to_views(poses, self.views, self.skeleton)
            distances, closest = self.comparer.nearest(projected, self.near)
        else:
            results = []
            for pose, rng in zip(poses, generators, strict=True):
                views = self.distribution.sample(rng, self.n_views)
                projected = project_to_views(pose[None], views, self.skeleton)
                near = self.distribution.near(views, self.n_near)
                results.append(self.comparer.nearest(projected, near))
            distances, closest = (np.concatenate(rows) for rows in zip(*results, strict=True))
        log_density = self._mean(-0.5 * (distances / self.noise) ** 2)
        return log_density.reshape(batch), closest.reshape(*batch, self.n_views)

    def _mean(self, log_terms: np.ndarray) -> np.ndarray:
        """Return the log of the mean over views: ``(…, m) → (…)``."""
        return logsumexp(log_terms, axis=-1) - math.log(self.n_views)

    def degenerate_fraction(self, positions: np.ndarray) -> float:
        """Return the fraction of projections of poses (n, 1, J, 3) with degenerate joints."""
        check_shape("positions", positions, ("n", 1, self.n_joints, 3))
        projections = project_to_views(positions[:, 0], self.views, self.skeleton)
        return self.comparer.degenerate(projections) / (len(projections) * self.n_views)

    def joint_speeds(self, closest: np.ndarray) -> np.ndarray:
        """Return the mean squared joint speeds of the closest annotations (eq. 12).

        Parameters
        ----------
        closest : ndarray of int, (…, m)
            Indices of the annotations D' of eq. 12, one per view; may repeat.

        Returns
        -------
        speeds : ndarray, (…, J, 2)
            Mean squared rotation (radians²) and stretch (metres²) of each bone per frame.
        """
        return self._squared_differences[closest].mean(axis=-3)

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> AnnotatedPairs:
        """Return the likelihood of simulated annotations of one pose-pair (1, J, 3).

        Each annotation is a projection to a view drawn from f(v), with Gaussian noise σ_l. This
        is not the model of eq. 9, which has no generative form.
        """
        check_shape("positions", positions, (1, self.n_joints, 3))
        views = self.distribution.sample(rng, len(self.annotations))
        exact = project_to_views(np.asarray(positions, dtype=np.float64), views, self.skeleton)[0]
        keypoints = exact + self.noise * rng.standard_normal(exact.shape)
        drawn = replace(
            self.annotations,
            keypoints=keypoints,
            visible=np.ones(keypoints.shape[:-1], dtype=bool),
            neighbours=np.full((len(keypoints), 2, *keypoints.shape[1:]), np.nan),
            views=views,
        )
        return replace(self, annotations=drawn)

    @cached_property
    def _squared_differences(self) -> np.ndarray:
        """Squared turn and stretch of every joint in every annotation, (n, J, 2)."""
        turn, stretch = self.annotations.local_differences()
        return np.stack([turn**2, stretch**2], axis=-1)


def _check_metres(annotations: Annotations) -> None:
    """Raise ``ValueError`` if the bone lengths are not those of people in metres."""
    shortest, longest = 0.05, 2.0
    ends, starts = np.array(annotations.skeleton.bones).T
    bones = annotations.keypoints[:, ends] - annotations.keypoints[:, starts]
    seen = annotations.visible[:, ends] & annotations.visible[:, starts]
    if not seen.any():
        return
    length = float(np.quantile(np.linalg.norm(bones[seen], axis=-1), 0.9))
    if not shortest < length < longest:
        raise ValueError(
            f"annotations must have bones of {shortest:g} to {longest:g} m (0.9 quantile), got "
            f"{length:.3g}: keypoints must be in metres"
        )
