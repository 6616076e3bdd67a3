"""`AnnotatedPairs`: what 2D annotations of a kind of motion say of a 3D pose-pair."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

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
    """L(Θ) ∝ (1/m) Σᵢ max_j exp(−d(M Θ_vᵢ, p_j)²/2σ_l²), vᵢ ~ f(v) (Yin et al. 2018, eqs. 5-9).

    A pose-pair is as likely as its projections are like what was annotated in similar views. The m
    views are drawn once, from the seed, so that the density is a function; :meth:`evaluate` with
    generators draws fresh ones, an unbiased estimate of the integral over views.

    Parameters
    ----------
    annotations : Annotations
        n annotated pairs with their views, metres.
    n_views : int
        m.
    n_near : int
        Annotations that each view is compared with: the nearest in view angle.
    noise : float
        σ_l, in the unit of the dissimilarity: metres, but for shape context, which has none.
    view_bandwidth : float
        σ_v, radians.
    measure : str
        ``"interaction"``: interaction coordinates; ``"cartesian"`` or ``"shape-context"``.
    graph : str
        Whose edges interaction coordinates are taken along; see
        :data:`probmotion.interaction.geometry.graphs.GRAPHS`.
    shortest_edge : float
        ε of eq. 8, metres.
    seed : int
        Seed of the views.

    Raises
    ------
    ValueError
        If the annotations have no views, or a number is out of range.
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
                "annotations has no views, expected them known or estimated: use "
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
        """Return the likelihood of annotations whose views are estimated from their backbones.

        Parameters
        ----------
        annotations : Annotations
            What was annotated; views that it has are not used. Those whose view cannot be estimated
        are left out and counted in ``dropped``.
        seed_pose : ndarray, (J, 3)
            A 3D pose-pair, whose torsos are fitted to the annotations, metres.
        **settings
            The other parameters of the class.
        """
        if np.shape(seed_pose) != (annotations.skeleton.n_joints, 3):
            raise ValueError(
                f"seed_pose has shape {np.shape(seed_pose)}, expected "
                f"({annotations.skeleton.n_joints}, 3): the annotations are of "
                f"{len(annotations.skeleton.roots)} people"
            )
        views = annotation_views(annotations, seed_pose)
        known = ~np.isnan(views).any(axis=-1)
        if not known.any():
            raise ValueError(
                f"annotations shows too little of the torsos in all {len(views)} pictures to "
                "estimate views, expected at least three torso joints of each person in one"
            )
        dropped = dict(annotations.dropped)
        if not known.all():
            dropped["view not to be estimated"] = int((~known).sum())
        kept = replace(annotations, views=views).subset(np.flatnonzero(known))
        return cls(replace(kept, dropped=dropped), **settings)  # type: ignore[arg-type]

    @property
    def skeleton(self) -> Skeleton:
        """Of the annotated pairs."""
        return self.annotations.skeleton

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return self.skeleton.n_joints

    @property
    def log_bound(self) -> float:
        """The most that log L can be, 0: no pose need be compared that this cannot save."""
        return 0.0

    def log_density(self, positions: Array) -> np.ndarray:
        """Return log L up to a constant: ``(…, 1, J, 3) → (…)``; NumPy arrays only.

        Raises
        ------
        ValueError
            If the array is torch's or JAX's: graphs are not differentiable.
        """
        if not isinstance(positions, np.ndarray):
            raise ValueError(
                f"positions is a {type(positions).__name__}, expected a NumPy array: the graphs "
                "of interaction coordinates have no gradient"
            )
        return self.evaluate(positions)[0]

    def evaluate(
        self, positions: np.ndarray, generators: Sequence[np.random.Generator] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return log L and the annotation that is closest in each view.

        Parameters
        ----------
        positions : ndarray, (…, 1, J, 3)
            Pose-pairs, metres.
        generators : sequence of numpy.random.Generator, optional
            One per pose-pair, each of which draws views of its own: exp(log L) is then an unbiased
            estimate, as the pseudo-marginal method needs (Andrieu and Roberts 2009). By
            default the fixed views.

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
            found = [
                self._with_fresh_views(pose, rng)
                for pose, rng in zip(poses, generators, strict=True)
            ]
            distances, closest = (np.concatenate(rows) for rows in zip(*found, strict=True))
        log_terms = -0.5 * (distances / self.noise) ** 2
        log_density = logsumexp(log_terms, axis=-1) - math.log(self.n_views)
        return log_density.reshape(batch), closest.reshape(*batch, self.n_views)

    def degenerate_fraction(self, positions: np.ndarray) -> float:
        """Return the share of pictures of poses (n, 1, J, 3) whose joints had to be joggled."""
        check_shape("positions", positions, ("n", 1, self.n_joints, 3))
        pictures = project_to_views(positions[:, 0], self.views, self.skeleton)
        return self.comparer.degenerate(pictures) / (pictures.shape[0] * pictures.shape[1])

    def joint_speeds(self, closest: np.ndarray) -> np.ndarray:
        """Return how fast joints move in the annotations that are closest (eq. 12's mean).

        Parameters
        ----------
        closest : ndarray of int, (…, m)
            Annotations, one per view: D'. One that is closest in several views counts as often.

        Returns
        -------
        speeds : ndarray, (…, J, 2)
            Mean squared turn of the bone, radians², and stretch, metres², per frame.
        """
        return self._squared_differences[closest].mean(axis=-3)

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> AnnotatedPairs:
        """Return the likelihood of as many annotations of one pose-pair (1, J, 3).

        Each is its projection in a view drawn from f(v), every keypoint moved by noise of
        standard deviation σ_l: the density itself is not that of any such picture.
        """
        check_shape("positions", positions, (1, self.n_joints, 3))
        views = self.distribution.sample(rng, len(self.annotations))
        seen = project_to_views(np.asarray(positions, dtype=np.float64), views, self.skeleton)[0]
        seen = seen + self.noise * rng.standard_normal(seen.shape)
        still = np.full((len(seen), 2, *seen.shape[1:]), np.nan)
        drawn = replace(
            self.annotations,
            keypoints=seen,
            visible=np.ones(seen.shape[:-1], dtype=bool),
            neighbours=still,
            views=views,
        )
        return replace(self, annotations=drawn)

    def _with_fresh_views(
        self, pose: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        views = self.distribution.sample(rng, self.n_views)
        projected = project_to_views(pose[None], views, self.skeleton)
        return self.comparer.nearest(projected, self.distribution.near(views, self.n_near))

    @property
    def _squared_differences(self) -> np.ndarray:
        """Squared turn and stretch of every joint in every annotation, (n, J, 2)."""
        if "squared" not in self.__dict__:
            turn, stretch = self.annotations.local_differences()
            object.__setattr__(self, "squared", np.stack([turn**2, stretch**2], axis=-1))
        return self.__dict__["squared"]


def _check_metres(annotations: Annotations) -> None:
    """Raise ``ValueError`` where the pictures' bones are of no one's length."""
    ends, starts = np.array(annotations.skeleton.bones).T
    bones = annotations.keypoints[:, ends] - annotations.keypoints[:, starts]
    seen = annotations.visible[:, ends] & annotations.visible[:, starts]
    if not seen.any():
        return
    length = float(np.quantile(np.linalg.norm(bones[seen], axis=-1), 0.9))
    if not _BONES[0] < length < _BONES[1]:
        raise ValueError(
            f"annotations has bones {length:.3g} long (0.9 quantile), expected {_BONES[0]:g} to "
            f"{_BONES[1]:g} m: keypoints are metres"
        )


_BONES = (0.05, 2.0)
