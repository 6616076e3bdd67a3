"""The distribution of physical lifts of one annotation, as motions of a single frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array, logsumexp, to_numpy
from probmotion.models.pose_pairs.pair_moves import APPROACH
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
from probmotion.models.unseen_depth.keypoints import centred_images
from probmotion.models.unseen_depth.physical_lifting import (
    LEAST_POWER,
    LiftMixture,
    checked_keypoints,
    lift_mixtures,
    lift_moves,
    valid_start,
)
from probmotion.models.unseen_depth.physical_lifting_kernels import walk_replica
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Likelihood
from probmotion.validation import check_shape

__all__ = ["DEPTH_SD", "LiftWalks", "PhysicalLift"]

_STARTS = 4  # of walks, as many as chains by default
DEPTH_SD = 0.05
"""Standard deviation of the mean depth, metres."""


@dataclass(frozen=True, eq=False)
class PhysicalLift:
    """p(X | y) of :mod:`.physical_lifting` for one annotation y, with a density of the mean depth.

    θ are the coordinates of ``physics.chart``. Positions are in the axes of the camera, x and y in
    place; the mean depth of the joints, which an image does not show, is normal (sd 5 cm). The
    annotation is part of this prior: its posterior has no likelihood.

    Parameters
    ----------
    learnt : AnnotationPrior
        Gaussian prior over pose pairs, learnt from annotations.
    keypoints : ndarray, (J, 2)
        The annotation, metres at the scale of the people, x right, y up; NaN where a joint is
        missing.
    physics : PosePairPrior
        Physical prior with the bone lengths of the people. Its density of root positions is not
        used.

    Raises
    ------
    ValueError
        As :func:`~.physical_lifting.physical_lifts`.
    """

    learnt: AnnotationPrior
    keypoints: np.ndarray
    physics: PosePairPrior
    mixture: LiftMixture = field(init=False, repr=False)

    frames = 1
    differentiable = False

    def __post_init__(self) -> None:
        keypoints = np.array(self.keypoints, dtype=np.float64)
        check_shape("keypoints", keypoints, ("J", 2))
        images, [centre] = centred_images(
            checked_keypoints(keypoints[None], self.learnt, self.physics)
        )
        object.__setattr__(self, "keypoints", keypoints)
        [[mixture]] = lift_mixtures(self.learnt, images)
        offset = np.repeat([*centre, 0.0], self.learnt.n_joints)
        object.__setattr__(self, "mixture", mixture._replace(means=mixture.means + offset))

    @property
    def skeleton(self) -> Skeleton:
        """Skeleton of the people."""
        return self.physics.skeleton

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.physics.fps

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return self.physics.dim

    @cached_property
    def seed(self) -> np.ndarray:
        """Poses at which walks start, (4, J, 3), metres."""
        return self._starts(seeds.generator(0, "physical lift", "starts"), _STARTS)

    def motion(self, theta: Array) -> Array:
        """Return the pose at θ as a one-frame motion: ``(…, dim) → (…, 1, J, 3)``, metres."""
        return self.physics.motion(theta)

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n initial points, (n, dim): lifts without the physical prior, made valid."""
        return self.physics.coordinates(self._starts(rng, n))

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError``, as the annotation is part of the prior."""
        raise ValueError(
            "likelihood must be None, since the annotation is part of PhysicalLift, got "
            f"{type(likelihood).__name__}"
        )

    def log_density(self, theta: Array) -> np.ndarray:
        """Return log p(θ), up to a constant: ``(…, dim) → (…)``."""
        theta = to_numpy(theta)
        log_measure = self.log_measure(theta)
        # Bone lengths, or their squares, can overflow; they have density 0.
        with np.errstate(over="ignore", invalid="ignore"):
            positions = self.motion(theta)
            inside = np.isfinite(log_measure) & np.isfinite(positions).all(axis=(-3, -2, -1))
            log_prior = self.log_prior(positions[inside])
        log_density = np.full(inside.shape, -np.inf)
        log_density[inside] = np.where(np.isnan(log_prior), -np.inf, log_prior)
        return np.where(inside, log_measure, 0.0) + log_density

    def log_measure(self, theta: Array) -> np.ndarray:
        """Return the log density of θ for uniform positions: ``(…, dim) → (…)``."""
        return self.physics.chart.log_volume(to_numpy(theta))

    def log_prior(self, positions: Array) -> np.ndarray:
        """Return log p(X | y), up to a constant: ``(…, 1, J, 3) → (…)``."""
        positions = to_numpy(positions)
        check_shape("positions", positions, ("…", 1, self.skeleton.n_joints, 3))
        poses = positions[..., 0, :, :]
        flat = np.swapaxes(poses, -1, -2).reshape(*poses.shape[:-2], 3 * poses.shape[-2])
        logs = []
        for log_weight, mean, cell in zip(
            self.mixture.log_weights, self.mixture.means, self.mixture.cells, strict=True
        ):
            white = (flat - mean) @ self.mixture.roots[cell]
            logs.append(log_weight - 0.5 * (white**2).sum(axis=-1))
        depth = poses[..., 2].mean(axis=-1) / DEPTH_SD
        log_gaussian = logsumexp(np.stack(logs, axis=-1), axis=-1) - 0.5 * depth**2
        return log_gaussian + self.log_bones(poses) + self.physics.log_plausibility(positions)

    def log_bones(self, poses: np.ndarray) -> np.ndarray:
        """Return log b(X) of the bone lengths of poses: ``(…, J, 3) → (…)``."""
        joints, parents = np.array(self.skeleton.bones).T
        lengths, given = (
            np.linalg.norm(each[..., joints, :] - each[..., parents, :], axis=-1)
            for each in (poses, self.physics.chart.seed)
        )
        # A bone of length 0 has density 0.
        with np.errstate(divide="ignore"):
            changes = np.log(lengths / given)
        return -0.5 * (changes**2).sum(axis=-1) / self.physics.bone_noise**2

    def walks(self, likelihood: Likelihood | None) -> LiftWalks:
        """Return walks over poses; there is no likelihood."""
        return LiftWalks(self)

    def _starts(self, rng: np.random.Generator, n: int) -> np.ndarray:
        poses = np.stack([valid_start(self.mixture, self.physics, rng) for _ in range(n)])
        poses[..., 2] += DEPTH_SD * rng.standard_normal((n, 1))
        return poses


@dataclass(frozen=True, eq=False)
class LiftWalks:
    """Compiled walks of :mod:`.physical_lifting_kernels`; see the protocol ``Walks``.

    There is one view, with likelihood b(X)^0.85. The prior is the rest of p(X | y), including
    b(X)^0.15.
    """

    prior: PhysicalLift

    n_views = 1

    @cached_property
    def moves(self) -> np.ndarray:
        """Whether a move is in depth, and its kind, (n_moves, 2)."""
        return np.argwhere(np.ones((2, APPROACH), dtype=bool))

    @cached_property
    def _proposals(self) -> np.ndarray:
        return lift_moves(self.prior.physics.body)

    def terms(self, pose: np.ndarray) -> np.ndarray:
        """Return no terms: walks compute them anew."""
        return np.empty(0)

    def log_view(self, pose: np.ndarray, view: int) -> float:
        """Return the log likelihood, .85 log b(X)."""
        return (1 - LEAST_POWER) * float(self.prior.log_bones(pose))

    def log_density(self, pose: np.ndarray, terms: np.ndarray) -> float:
        """Return log p(X | y), up to a constant."""
        return float(self.prior.log_prior(pose[None]))

    def walk(
        self,
        pose: np.ndarray,
        terms: np.ndarray,
        view: int,
        power: float,
        steps: int,
        sizes: np.ndarray,
        tried: np.ndarray,
        taken: np.ndarray,
        rng: np.random.Generator,
    ) -> tuple[int, float]:
        """Take Metropolis steps and draw the mean depth; return 0 and the log likelihood."""
        mixture, physics, shape = self.prior.mixture, self.prior.physics, (2, APPROACH)
        of_bones = LEAST_POWER + (1 - LEAST_POWER) * power
        walk_replica(
            pose, mixture.log_weights, mixture.means, mixture.cells, mixture.roots, of_bones, steps,
            self._proposals, sizes.reshape(shape), tried.reshape(shape), taken.reshape(shape),
            physics.body, physics.physics, rng,
        )  # fmt: skip
        pose[:, 2] += DEPTH_SD * rng.standard_normal() - pose[:, 2].mean()
        return 0, self.log_view(pose, 0)
