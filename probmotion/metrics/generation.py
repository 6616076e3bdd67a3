"""Similarity of generated to real 2D motions in an evaluator's feature space (MAS, section 6.3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
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
    "diversity",
    "frechet_distance",
]

# Recall below which a generator is considered collapsed (MAS, table 2).
COLLAPSED_BELOW = 0.1
_CHAMFER_FRAMES = 10  # frames per window (Sun et al. 2024)
# Mean and standard deviation over repeats of each score.
Scores = dict[str, tuple[float, float]]


@runtime_checkable
class EncodesViews(Protocol):
    """Feature extractor of 2D motions."""

    @property
    def skeleton(self) -> Skeleton:
        """Skeleton of the J joints."""

    @property
    def frames(self) -> int:
        """Maximum number of frames of a motion."""

    def features(self, views: np.ndarray, lengths: np.ndarray | None = None) -> np.ndarray:
        """Return features of views in metres, root at the origin: ``(N, L, J, 2) → (N, D)``."""


def frechet_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the squared Fréchet distance between the fitted Gaussians (Heusel et al. 2017, eq. 6).

    ‖μ_a − μ_b‖² + tr(C_a + C_b − 2 (C_a C_b)^½) for features (N, D) and (M, D) of means μ and
    covariances C = RᵀR. The trace of (C_a C_b)^½ is the sum of the singular values of R_a R_bᵀ,
    also stable for fewer motions than features. Each set of N motions adds a bias of about
    tr C (D + 5) / (4 N), so compare generators at equal sizes.

    Raises
    ------
    ValueError
        If shapes disagree, a set has fewer than two motions or a feature is not finite.
    """
    check_shape("a", a, ("N", "D"))
    check_shape("b", b, ("M", a.shape[1]))
    for name, features in (("a", a), ("b", b)):
        check_finite(name, features)
        if len(features) < 2:
            raise ValueError(f"{name} must have at least 2 motions, got {len(features)}")
    root_a, root_b = _covariance_root(a), _covariance_root(b)
    cross = np.linalg.svd(root_a @ root_b.T, compute_uv=False).sum()
    means = ((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum()
    distance = means + (root_a**2).sum() + (root_b**2).sum() - 2 * cross
    # Rounding errors are about ±1e-15 tr C for equal sets.
    return max(0.0, float(distance))


def _covariance_root(features: np.ndarray) -> np.ndarray:
    """Return R such that RᵀR is the covariance of the features."""
    centred = (features - features.mean(axis=0)) / math.sqrt(len(features) - 1)
    return np.linalg.qr(centred).R


def diversity(features: np.ndarray, rng: np.random.Generator, pairs: int = 200) -> float:
    """Return the mean feature distance within random pairs of motions, from features (N, D), N ≥ 2.

    The definition is that of the MAS authors' code (200 pairs); the paper calls it the variance.
    """
    check_count("pairs", pairs)
    if len(features) < 2:
        raise ValueError(f"features must have at least 2 motions, got {len(features)}")
    first = rng.integers(0, len(features), pairs)
    second = (first + rng.integers(1, len(features), pairs)) % len(features)
    return float(np.linalg.norm(features[first] - features[second], axis=1).mean())


@dataclass(frozen=True, eq=False)
class GenerationReference:
    """Real 2D motions as a reference for generated motions.

    Parameters
    ----------
    evaluator : EncodesViews
        Feature extractor.
    held_out_features : ndarray, (M, D)
        Features of real motions outside the training sets of generator and evaluator.
    learnt_features : ndarray, (M, D), optional
        Features of the training clips. With few training clips, held-out clips differ so much
        that no generator scores well against them; see :meth:`of_learnt`.
    elevation : float
        Elevation of the cameras that view generated motions, radians.
    distance : float
        Distance from the cameras to the root, metres.
    held_out_views : ndarray, (M', L', J, 2), optional
        Held-out motions, metres, centred on the root, for the Chamfer distance.
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
        """Return a reference with the training clips instead of held-out motions."""
        if self.learnt_features is None:
            raise ValueError("learnt_features must be given, got None")
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
        """Return mean and standard deviation of the scores of 3D motions, (N, L, J, 3) metres.

        - ``fid``: squared Fréchet distance of features; 0 is ideal
        - ``diversity``: mean feature distance between two motions; ideally that of real motions
        - ``precision``: fraction of generated motions on the manifold of real ones; 1 is best
        - ``recall``: fraction of real motions on the manifold of generated ones; 1 is best

        Every repeat films up to ``samples`` motions from new azimuths. The first repeats are the
        same for any ``repeats``. The standard deviation (ddof 1) between repeats covers azimuths
        and subsets, not training or the choice of held-out motions. (The MAS authors' code prints
        the 95 % interval of the mean, 1.96 standard deviations / √repeats.)

        Scores for ``angles="side"`` require motions with random headings, such as motions lifted
        from random views. If all motions face +Z, even real motions have poor scores.
        """
        return self._score(positions, partial(self._project, angles=angles), seed, samples, repeats)

    def score_views(
        self, views: np.ndarray, *, seed: int, samples: int = 1000, repeats: int = 10
    ) -> Scores:
        """Return the scores of 2D motions, (N, L, J, 2) metres, in subsets of size ``samples``."""
        return self._score(views, lambda chosen, rng: chosen, seed, samples, repeats)

    def chamfer(self, positions: np.ndarray, *, seed: int) -> MotionChamfer:
        """Return the Motion Chamfer Distance of one view of each motion, (N, L, J, 3) metres.

        Windows have 10 frames, or fewer if motions are shorter. Requires ``held_out_views``.
        """
        if self.held_out_views is None:
            raise ValueError("held_out_views must be given, got None")
        views = self._project(positions, seeds.generator(seed, "chamfer"))
        frames = min(_CHAMFER_FRAMES, views.shape[1], self.held_out_views.shape[1])
        generated, real = (
            motions[:, : motions.shape[1] // frames * frames]
            for motions in (views, self.held_out_views)
        )
        return motion_chamfer_distance(generated, real, frames=frames)

    def _project(
        self, positions: np.ndarray, rng: np.random.Generator, angles: Angles = "all"
    ) -> np.ndarray:
        return film_motions(
            positions,
            rng,
            elevation=self.elevation,
            distance=self.distance,
            angles=angles,
            root=self.evaluator.skeleton.roots[0],
        )

    def _score(
        self,
        motions: np.ndarray,
        view: Callable[[np.ndarray, np.random.Generator], np.ndarray],
        seed: int,
        samples: int,
        repeats: int,
    ) -> Scores:
        check_count("samples", samples, least=2)
        check_count("repeats", repeats, least=2)
        rows = []
        for repeat in range(repeats):
            rng = seeds.generator(seed, "views", repeat)
            views = view(motions[rng.permutation(len(motions))[:samples]], rng)
            features = self.evaluator.features(views)
            fid = frechet_distance(features, self.held_out_features)
            spread = diversity(features, seeds.generator(seed, "pairs", repeat))
            rows.append([fid, spread, *precision_recall(features, self.held_out_features)])
        columns = zip(("fid", "diversity", "precision", "recall"), np.transpose(rows), strict=True)
        return {name: (float(row.mean()), float(row.std(ddof=1))) for name, row in columns}
