"""How like real 2D motion is generated motion? The published evaluation (MAS, section 6.3).

Sets of motions are compared by their features, (N, D), which an evaluator makes of 2D views.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass, fields, replace
from typing import Protocol, runtime_checkable

import numpy as np

from probmotion import seeds
from probmotion.metrics.distribution import precision_recall
from probmotion.metrics.filming import Angles, film_motions
from probmotion.metrics.motion_chamfer import MotionChamfer, motion_chamfer_distance
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = [
    "COLLAPSED_BELOW",
    "EncodesViews",
    "GenerationReference",
    "GenerationScores",
    "diversity",
    "frechet_distance",
    "score_features",
    "score_generation",
]

COLLAPSED_BELOW = 0.1
"""Recall below which a generator has collapsed (MAS, table 2)."""

_CHAMFER_FRAMES = 10  # as published

Scores = dict[str, tuple[float, float]]
"""Mean and standard deviation over repeats, by the names of :class:`GenerationScores`."""


@runtime_checkable
class EncodesViews(Protocol):
    """What makes features of 2D motions."""

    @property
    def skeleton(self) -> Skeleton:
        """The J joints."""

    @property
    def frames(self) -> int:
        """Most frames of a motion."""

    def features(self, views: np.ndarray, lengths: np.ndarray | None = None) -> np.ndarray:
        """Return features: ``(N, L, J, 2) → (N, D)``; views in metres, centred on the root."""


@dataclass(frozen=True)
class GenerationScores:
    """How one set of motions compares with real ones.

    Parameters
    ----------
    fid : float
        Fréchet distance of features; 0 is right.
    diversity : float
        Mean distance of two motions; the real motions' own is right.
    precision : float
        Share of motions among real ones; 1 is best.
    recall : float
        Share of real motions among these; 1 is best.
    """

    fid: float
    diversity: float
    precision: float
    recall: float

    @property
    def collapsed(self) -> bool:
        """Whether the generator has lost most of what there is: recall < .1."""
        return self.recall < COLLAPSED_BELOW


def frechet_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the squared Fréchet distance of two sets' Gaussians (Heusel et al. 2017, eq. 6).

    ‖μ_a − μ_b‖² + tr(C_a + C_b − 2 (C_a C_b)^½). With C = RᵀR, R triangular, the last trace is
    the sum of the singular values of R_a R_bᵀ: no root of a matrix, and no trouble with fewer
    motions than features. Small sets raise it, by about tr C (D + 5) / (4 N) each if features
    vary alike: compare generators at equal sizes.

    Parameters
    ----------
    a, b : ndarray, (N, D) and (M, D)
        Features.

    Raises
    ------
    ValueError
        If shapes disagree, a set has fewer than two motions or a number is not finite.
    """
    check_shape("a", a, ("N", "D"))
    check_shape("b", b, ("M", a.shape[1]))
    for name, features in (("a", a), ("b", b)):
        check_finite(name, features)
        if len(features) < 2:
            raise ValueError(f"{name} has {len(features)} motions, expected at least 2")
    root_a, root_b = _covariance_root(a), _covariance_root(b)
    shared = np.linalg.svd(root_a @ root_b.T, compute_uv=False).sum()
    apart = ((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum()
    distance = apart + (root_a**2).sum() + (root_b**2).sum() - 2 * shared
    # Of equal sets, rounding leaves some 1e-15 tr C of either sign.
    return max(0.0, float(distance))


def _covariance_root(features: np.ndarray) -> np.ndarray:
    """R with RᵀR the covariance."""
    apart = (features - features.mean(axis=0)) / math.sqrt(len(features) - 1)
    return np.linalg.qr(apart).R


def diversity(features: np.ndarray, rng: np.random.Generator, pairs: int = 200) -> float:
    """Return the mean distance of random pairs of different motions.

    As in the MAS authors' code (200 pairs); their paper calls it the variance.

    Parameters
    ----------
    features : ndarray, (N, D)
        Of the motions.
    rng : Generator
        Of the pairs.
    pairs : int
        How many.

    Raises
    ------
    ValueError
        If there are fewer than two motions.
    """
    check_count("pairs", pairs)
    if len(features) < 2:
        raise ValueError(f"features has {len(features)} motions, expected at least 2")
    first = rng.integers(0, len(features), pairs)
    second = (first + rng.integers(1, len(features), pairs)) % len(features)
    return float(np.linalg.norm(features[first] - features[second], axis=1).mean())


def score_features(
    features: np.ndarray, held_out: np.ndarray, rng: np.random.Generator
) -> GenerationScores:
    """Return how motions compare with held-out real ones, by their features (N, D), (M, D).

    Precision and recall have k = 3. ``rng`` draws the pairs of the diversity.
    """
    precision, recall = precision_recall(features, held_out)
    fid = frechet_distance(features, held_out)
    return GenerationScores(fid, diversity(features, rng), precision, recall)


def score_generation(
    features_of: Callable[[np.ndarray], np.ndarray],
    draw_views: Callable[[np.random.Generator, int], np.ndarray],
    held_out_features: np.ndarray,
    *,
    seed: int,
    samples: int = 1000,
    repeats: int = 10,
) -> Scores:
    """Return mean and standard deviation of every score over repeats.

    The ± is the standard deviation of one repeat's score (with repeats − 1 in the denominator),
    over whatever ``draw_views`` draws anew. (The MAS authors' code prints the 95 % interval of the
    mean, 1.96 standard deviations / √repeats.)

    Parameters
    ----------
    features_of : callable
        Makes features of views: ``(N, L, J, 2) → (N, D)``.
    draw_views : callable
        Returns views, given a generator and how many are wanted at most.
    held_out_features : ndarray, (M, D)
        Of real motions: the same in every repeat.
    seed : int
        Repeat r is the same however many there are.
    samples : int
        Motions per repeat.
    repeats : int
        At least 2.
    """
    check_count("samples", samples, least=2)
    check_count("repeats", repeats, least=2)
    found = []
    for repeat in range(repeats):
        views = draw_views(seeds.generator(seed, "views", repeat), samples)
        pairs = seeds.generator(seed, "pairs", repeat)
        found.append(score_features(features_of(views), held_out_features, pairs))
    columns = np.array([astuple(scores) for scores in found]).T
    names = [field.name for field in fields(GenerationScores)]
    return {
        name: (float(column.mean()), float(column.std(ddof=1)))
        for name, column in zip(names, columns, strict=True)
    }


@dataclass(frozen=True, eq=False)
class GenerationReference:
    """Real 2D motion that generated motion is compared with, and how that is filmed.

    Parameters
    ----------
    evaluator : EncodesViews
        Makes the features.
    held_out_features : ndarray, (M, D)
        Of real motions that neither the generator nor the evaluator learnt from.
    learnt_features : ndarray, (M, D), optional
        Of the clips that were learnt from, filmed anew. Where clips are few, those that were held
        out are another matter, and no model of the first can come near them; see :meth:`of_learnt`.
    elevation : float
        Of the cameras that film generated 3D motions, radians.
    distance : float
        From them to the root, metres.
    held_out_views : ndarray, (M', L', J, 2), optional
        Some of the held-out motions themselves, metres, centred on the root: their distance from
        generated ones needs no features.

    Raises
    ------
    ValueError
        If the features are not (M, D), the views not (M', L', J, 2), or one is not finite.
    """

    evaluator: EncodesViews
    held_out_features: np.ndarray
    learnt_features: np.ndarray | None = None
    elevation: float = math.pi / 16
    distance: float = 7.0
    held_out_views: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.held_out_views is not None:
            joints = self.evaluator.skeleton.n_joints
            check_shape("held_out_views", self.held_out_views, ("M", "L", joints, 2))
            check_finite("held_out_views", self.held_out_views)
        check_shape("held_out_features", self.held_out_features, ("M", "D"))
        check_finite("held_out_features", self.held_out_features)
        if self.learnt_features is not None:
            width = self.held_out_features.shape[1]
            check_shape("learnt_features", self.learnt_features, ("M", width))
            check_finite("learnt_features", self.learnt_features)

    def of_learnt(self) -> GenerationReference:
        """Return the reference whose real motions are those that were learnt from.

        Raises
        ------
        ValueError
            If their features are not known.
        """
        if self.learnt_features is None:
            raise ValueError("learnt_features must be features of learnt motions, got missing")
        return replace(self, held_out_features=self.learnt_features)

    def score_motions(
        self,
        positions: np.ndarray,
        *,
        seed: int,
        samples: int = 1000,
        repeats: int = 10,
        angles: Angles = "all",
    ) -> Scores:
        """Return the scores of 3D motions, (N, L, J, 3) metres.

        Every repeat films ``samples`` of them, or all if there are no more, each from a fresh
        side. The ± so holds the chance of sides and, if there are more, of subsets: of halves it is
        that of the draws over √2. It does not hold that of training, or of the held-out motions.

        Views from the ``side`` compare with held-out views from all around only if azimuth 0 is
        no side of the body's own: motions lifted from views at random azimuths, or that face any
        way. Motions that all face +Z have another distribution there, however real they are.
        """

        def film(rng: np.random.Generator, n: int) -> np.ndarray:
            return self._film(positions[_subset(rng, len(positions), n)], rng, angles)

        return self._score(film, seed, samples, repeats)

    def chamfer(self, positions: np.ndarray, *, seed: int) -> MotionChamfer:
        """Return the Motion Chamfer Distance of 3D motions, (N, L, J, 3) metres, each seen once.

        Whole windows of 10 frames are compared, or of as many as there are if there are fewer.

        Raises
        ------
        ValueError
            If no motions were held out, but features alone.
        """
        if self.held_out_views is None:
            raise ValueError("held_out_views must be 2D motions to compare with, got missing")
        views = self._film(positions, seeds.generator(seed, "chamfer"), "all")
        frames = min(_CHAMFER_FRAMES, views.shape[1], self.held_out_views.shape[1])
        shown, real = (
            some[:, : some.shape[1] // frames * frames] for some in (views, self.held_out_views)
        )
        return motion_chamfer_distance(shown, real, frames=frames)

    def _film(self, positions: np.ndarray, rng: np.random.Generator, angles: Angles) -> np.ndarray:
        return film_motions(
            positions,
            rng,
            elevation=self.elevation,
            distance=self.distance,
            angles=angles,
            root=self.evaluator.skeleton.roots[0],
        )

    def score_views(
        self, views: np.ndarray, *, seed: int, samples: int = 1000, repeats: int = 10
    ) -> Scores:
        """Return the scores of 2D motions, (N, L, J, 2) metres, such as real ones.

        Every repeat takes ``samples`` of them; if there are no more, only the diversity has a ±.
        """

        def take(rng: np.random.Generator, n: int) -> np.ndarray:
            return views[_subset(rng, len(views), n)]

        return self._score(take, seed, samples, repeats)

    def _score(
        self,
        draw_views: Callable[[np.random.Generator, int], np.ndarray],
        seed: int,
        samples: int,
        repeats: int,
    ) -> Scores:
        return score_generation(
            self.evaluator.features,
            draw_views,
            self.held_out_features,
            seed=seed,
            samples=samples,
            repeats=repeats,
        )


def _subset(rng: np.random.Generator, n: int, most: int) -> np.ndarray:
    """Which of n are taken: ``most`` at random, or all."""
    return rng.permutation(n)[:most]
