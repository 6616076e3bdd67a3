"""Pose pairs of synthetic dances with few annotations, and statistics of chains."""

from __future__ import annotations

import numpy as np
from arviz_stats.base import array_stats

from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior

__all__ = ["MAX_Z", "base_draws", "small_likelihood", "small_prior", "z_scores"]

MAX_Z = 4.4
"""One in 100 000 normal variables exceeds this z-score."""


def small_likelihood() -> AnnotatedPairs:
    """Return annotations of three dances in five views."""
    drawn = draw_annotations(synthetic_dances(3), 40, seed=0, known_views=True)
    return AnnotatedPairs(drawn.annotations, n_views=5, n_near=4, noise=0.15)


def small_prior() -> PosePairPrior:
    """Return the prior around a frame of a dance."""
    (dance,) = synthetic_dances(1)
    return PosePairPrior(dance.positions[30], dance.skeleton)


def base_draws(prior: PosePairPrior) -> np.ndarray:
    """Return independent draws of the base measure, without limits or penetration, (n, J, 3)."""
    rng, n = np.random.default_rng(1), 30_000
    seed, skeleton = prior.seed[0], prior.skeleton
    poses = np.empty((n, *seed.shape))
    for root in skeleton.roots:
        poses[:, root] = seed[root] + prior.root_noise * rng.standard_normal((n, 3))
    for joint, parent in skeleton.bones:
        direction = rng.standard_normal((n, 3))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        length = np.linalg.norm(seed[joint] - seed[parent])
        length = length * np.exp(prior.bone_noise * rng.standard_normal((n, 1)))
        poses[:, joint] = poses[:, parent] + length * direction
    return poses


def z_scores(values: np.ndarray, mean: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return deviations of the chains' means (chain, draw, k) in standard errors."""
    ess = np.asarray(array_stats.ess(values, method="mean", chain_axis=0, draw_axis=1))
    variance = values.var(axis=(0, 1), ddof=1) / ess
    return (values.mean(axis=(0, 1)) - mean) / np.sqrt(variance + error**2)
