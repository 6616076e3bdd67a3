"""Pose pairs lifted from annotations by a learnt Gaussian prior and the physical prior.

An :class:`~probmotion.models.unseen_depth.annotation_prior.AnnotationPrior` lifts annotations in
closed form, but bone lengths of its draws vary by a fifth, and people penetrate each other. Here
its density N(X) of positions is multiplied by the physical prior f(X) of
:class:`~probmotion.models.pose_pairs.pose_pairs.PosePairPrior` (Yin et al. 2018, eq. 2) and, for
bones of length l, by b(X) = Π exp(−(log l − log l₀)²/2σ²), with its σ and l₀ of the seed. The
posterior of annotation y,

    p(X | y) ∝ N(X) f(X) b(X) p(y | X),

is sampled by parallel tempering with Metropolis steps. Replicas differ in the power of b(X): where
bones may shorten, limbs can pass through the image plane, from one order in depth to the other.
Replicas start from draws of N(X) p(y | X) or, if these have too many invalid joint angles, from the
nearest valid poses. Views of less than a thousandth of the largest probability are left out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.models.pose_pairs.pair_moves import APPROACH, Body, moves_of
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior, check_size
from probmotion.models.unseen_depth.keypoints import (
    as_keypoints,
    centred_images,
    visibility_groups,
)
from probmotion.models.unseen_depth.physical_lifting_kernels import walk_lift
from probmotion.posteriors.sampling import progress_bar
from probmotion.threads import only_one_thread
from probmotion.validation import check_count

__all__ = [
    "LEAST_POWER", "LiftMixture", "checked_keypoints", "lift_mixtures", "lift_moves",
    "physical_lifts", "valid_start",
]  # fmt: skip

LEAST_POWER = 0.15
"""Power of b(X) at which limbs pass through the image plane."""
_POWERS = np.geomspace(LEAST_POWER, 1.0, 6)  # Four to five of ten swaps are accepted.
_INITIAL_SIZE = 0.03  # of the steps, radians, metres or log length
_LEAST_VARIANCE = 1e-9  # relative; the variance of the mean depth is 0


def physical_lifts(
    prior: AnnotationPrior,
    annotations: Annotations | np.ndarray,
    physics: PosePairPrior,
    *,
    draws: int = 1,
    warmup: int = 64,
    sweeps: int = 32,
    seed: int = 0,
    progress: bool = False,
) -> np.ndarray:
    """Draw physically plausible poses from the posterior of each annotation.

    Parameters
    ----------
    prior : AnnotationPrior
        Gaussian prior over pose pairs, learnt from annotations.
    annotations : Annotations or ndarray, (n, J, 2)
        Keypoints in the order of the joints of ``physics``, metres at the scale of the people; NaN
        where a joint is missing.
    physics : PosePairPrior
        Physical prior with the bone lengths of the people. Its density of root positions is not
        used.
    draws : int
        Number of states of each annotation's chain.
    warmup : int
        Number of sweeps that tune step sizes. A sweep is 50 Metropolis steps of each of six
        replicas, 1 to 3 ms.
    sweeps : int
        Number of sweeps before each draw.
    seed : int
        Random seed. Draws of an annotation do not depend on other annotations or on ``draws``.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    ndarray, (draws, n, J, 3)
        Poses, metres, in the axes of :class:`AnnotationLifts`.

    Raises
    ------
    ValueError
        If the joints differ, keypoints are not at the scale of the people, or the prior's noise is
        so small that covariances cannot be factorised.
    """
    check_count("draws", draws)
    check_count("warmup", warmup)
    check_count("sweeps", sweeps)
    images, centres = centred_images(checked_keypoints(annotations, prior, physics))
    moves = lift_moves(physics.body)
    out = np.empty((draws, len(images), prior.n_joints, 3))

    def walk(mixture: LiftMixture) -> None:
        rng = seeds.generator(seed, "physical lift", mixture.row)
        poses = np.stack([valid_start(mixture, physics, rng) for _ in _POWERS])
        log_sizes = np.full((len(_POWERS), 2, APPROACH), math.log(_INITIAL_SIZE))
        for number in range(-1, draws):
            first = warmup + number * sweeps if number >= 0 else 0
            walk_lift(
                poses, _POWERS, mixture.log_weights, mixture.means, mixture.cells, mixture.roots,
                first, warmup if number < 0 else sweeps, moves, log_sizes, number < 0,
                physics.body, physics.physics, rng,
            )  # fmt: skip
            poses[..., 2] -= poses[..., 2].mean(axis=1, keepdims=True)
            if number >= 0:
                out[number, mixture.row] = poses[-1]

    cores = 1 if only_one_thread() else os.cpu_count() or 1
    with progress_bar(len(images), "lifts", progress) as bar, ThreadPoolExecutor(cores) as threads:
        for mixtures in lift_mixtures(prior, images):
            futures = [threads.submit(walk, mixture) for mixture in mixtures]
            try:
                for future in as_completed(futures):
                    future.result()
                    bar.update()
            except BaseException:
                threads.shutdown(cancel_futures=True)
                raise
    out[..., :2] += centres[:, None]
    return out


def checked_keypoints(
    annotations: Annotations | np.ndarray, prior: AnnotationPrior, physics: PosePairPrior
) -> np.ndarray:
    """Return the keypoints (n, J, 2) of annotations.

    Raises
    ------
    ValueError
        If their joints or scale, or the joints of the priors, differ.
    """
    if physics.skeleton.n_joints != prior.n_joints:
        raise ValueError(
            f"physics must have the prior's {prior.n_joints} joints, got "
            f"{physics.skeleton.n_joints}"
        )
    if isinstance(annotations, Annotations):
        names = annotations.skeleton.canonical_names
        if names != physics.skeleton.canonical_names:
            raise ValueError(
                "annotations must have the joints of physics, "
                f"{', '.join(physics.skeleton.canonical_names)}, got {', '.join(names)}"
            )
    keypoints = as_keypoints(annotations, prior.n_joints)
    check_size(keypoints, prior.means[0], "multiply them by lift(…, unknown_scale=True).scales")
    return keypoints


class LiftMixture(NamedTuple):
    """Gaussian mixture N(X) p(y | X) of annotation ``row``, arguments of :func:`walk_lift`."""

    row: int
    weights: np.ndarray
    log_weights: np.ndarray
    means: np.ndarray
    cells: np.ndarray
    roots: np.ndarray
    spreads: np.ndarray

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Return a pose (J, 3)."""
        component = int(rng.choice(len(self.weights), p=self.weights))
        spread = self.spreads[self.cells[component]]
        flat = self.means[component] + spread @ rng.standard_normal(spread.shape[1])
        return np.ascontiguousarray(flat.reshape(3, -1).T)


def lift_moves(body: Body) -> np.ndarray:
    """Return the moves that need no annotations of a view; see :func:`.pair_moves.moves_of`."""
    moves = moves_of(body)
    return moves[moves[:, 0] != APPROACH]


def valid_start(
    mixture: LiftMixture, physics: PosePairPrior, rng: np.random.Generator
) -> np.ndarray:
    """Draw a pose (J, 3) of a mixture; the nearest valid one if too many joints are invalid."""
    pose = mixture.draw(rng)
    if (~physics.joint_limits.is_valid(pose)).sum() > physics.max_invalid:
        return physics.joint_limits.nearest_valid(pose)
    return pose


def lift_mixtures(prior: AnnotationPrior, images: np.ndarray) -> Iterator[list[LiftMixture]]:
    """Yield the posteriors of images (n, 2 J) with the same visible joints."""
    for rows, visible in visibility_groups(images):
        evidence = prior.cells.evidence(images[rows], visible, False)
        weights = evidence.weights()
        parts = list(prior.cells.posteriors(images[rows], visible, evidence, weights))
        factors = [_factors(prior.cells.covariance(part, visible)) for part in parts]
        roots, spreads, norms = (np.array(each) for each in zip(*factors, strict=True))
        members: list[list[tuple[int, int]]] = [[] for _ in rows]
        for number, part in enumerate(parts):
            for position, index in enumerate(part.rows):
                members[index].append((number, position))
        mixtures = []
        for index, row in enumerate(rows):
            cells = np.array([number for number, _ in members[index]])
            probabilities = np.array([parts[p].weights[i] for p, i in members[index]])
            mixtures.append(
                LiftMixture(
                    row=int(row),
                    weights=probabilities,
                    log_weights=np.log(probabilities) - norms[cells],
                    means=np.stack([parts[p].mean[i] for p, i in members[index]]),
                    cells=cells,
                    roots=roots,
                    spreads=spreads,
                )
            )
        yield mixtures


def _factors(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return R and S, (3J, 3J − 1), with R Rᵀ = C⁻¹, S Sᵀ = C, and ½ log det C, on C's range."""
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = values[1:], vectors[:, 1:]
    if values[0] < _LEAST_VARIANCE * values[-1]:
        raise ValueError(
            "covariances of the prior given an annotation must have variances of at least "
            f"{_LEAST_VARIANCE:g} of the largest one, got {values[0] / values[-1]:.2g}; use more "
            "noise"
        )
    return vectors / np.sqrt(values), vectors * np.sqrt(values), 0.5 * float(np.log(values).sum())
