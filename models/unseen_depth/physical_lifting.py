"""Pose pairs lifted from annotations by a learnt Gaussian prior and the physical prior.

An :class:`~probmotion.models.unseen_depth.annotation_prior.AnnotationPrior` lifts annotations in
closed form, but bone lengths of its draws differ by a fifth, and people penetrate each other. Here
its density N(X) is multiplied by the physical prior f(X) of
:class:`~probmotion.models.pose_pairs.pose_pairs.PosePairPrior` (Yin et al. 2018, eq. 2) and by its
density of bone lengths. The posterior of annotation y,

    p(X | y) ∝ N(X) f(X) p(y | X),

is sampled by Metropolis steps. They start from a draw without f, or, if it has too many invalid
joint angles, from the nearest valid pose.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.models.pose_pairs.pair_moves import APPROACH, moves_of
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
from probmotion.models.unseen_depth.keypoints import (
    as_keypoints,
    centred_images,
    visibility_groups,
)
from probmotion.models.unseen_depth.physical_lifting_kernels import walk_lift
from probmotion.posteriors.sampling import progress_bar
from probmotion.threads import only_one_thread
from probmotion.validation import check_count

__all__ = ["physical_lifts"]

_INITIAL_SIZE = 0.03  # of the steps, radians, metres or log length
_LEAST_VARIANCE = 1e-9  # relative; the variance of the mean depth is 0


def physical_lifts(
    prior: AnnotationPrior,
    annotations: Annotations | np.ndarray,
    physics: PosePairPrior,
    *,
    draws: int = 1,
    steps: int = 4000,
    seed: int = 0,
    progress: bool = False,
) -> np.ndarray:
    """Draw physically plausible poses from the posterior of each annotation.

    Parameters
    ----------
    prior : AnnotationPrior
        Gaussian prior over pose pairs, learnt from annotations.
    annotations : Annotations or ndarray, (n, J, 2)
        Keypoints as for :meth:`AnnotationPrior.lift`, metres; NaN where a joint is missing.
    physics : PosePairPrior
        Physical prior with the bone lengths of the people. Its density of root positions is not
        used.
    draws : int
        Number of states of each annotation's chain, ``steps`` apart.
    steps : int
        Number of Metropolis steps before each draw; those before the first tune step sizes. About 6
        µs each.
    seed : int
        Random seed. Draws of an annotation depend on its index and on its number of draws alone.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    ndarray, (draws, n, J, 3)
        Poses, metres, in the axes of :class:`AnnotationLifts`.

    Raises
    ------
    ValueError
        If the priors' numbers of joints differ.
    """
    if physics.skeleton.n_joints != prior.n_joints:
        raise ValueError(
            f"physics must have the prior's {prior.n_joints} joints, got "
            f"{physics.skeleton.n_joints}"
        )
    check_count("draws", draws)
    check_count("steps", steps)
    keypoints = as_keypoints(annotations, prior.n_joints)
    images, centres = centred_images(keypoints)
    moves = moves_of(physics.body)
    moves = moves[moves[:, 0] != APPROACH]
    out = np.empty((draws, len(images), prior.n_joints, 3))

    def walk(mixture: _Mixture) -> None:
        rng = seeds.generator(seed, "physical lift", mixture.row)
        pose, component = mixture.draw(rng)
        log_sizes = np.full(APPROACH, math.log(_INITIAL_SIZE))
        if (~physics.joint_limits.is_valid(pose)).sum() > physics.max_invalid:
            pose = physics.joint_limits.nearest_valid(pose)
        for number in range(draws):
            component = walk_lift(
                pose, component, mixture.log_weights, mixture.means, mixture.cells, mixture.roots,
                steps, moves, log_sizes, number == 0, physics.body, physics.physics, rng,
            )  # fmt: skip
            pose[:, 2] -= pose[:, 2].mean()
            out[number, mixture.row] = pose

    cores = 1 if only_one_thread() else os.cpu_count() or 1
    with progress_bar(len(images), "lifts", progress) as bar, ThreadPoolExecutor(cores) as threads:
        for mixtures in _mixtures(prior, images):
            futures = [threads.submit(walk, mixture) for mixture in mixtures]
            for future in wait(futures, return_when=FIRST_EXCEPTION).done:
                future.result()
            bar.update(len(futures))
    out[..., :2] += centres[:, None]
    return out


class _Mixture(NamedTuple):
    """Gaussian mixture posterior of annotation ``row``, arguments of :func:`walk_lift`."""

    row: int
    weights: np.ndarray
    log_weights: np.ndarray
    means: np.ndarray
    cells: np.ndarray
    roots: np.ndarray
    spreads: np.ndarray

    def draw(self, rng: np.random.Generator) -> tuple[np.ndarray, int]:
        """Return a pose (J, 3) and its component."""
        component = int(rng.choice(len(self.weights), p=self.weights))
        spread = self.spreads[self.cells[component]]
        flat = self.means[component] + spread @ rng.standard_normal(spread.shape[1])
        return np.ascontiguousarray(flat.reshape(3, -1).T), component


def _mixtures(prior: AnnotationPrior, images: np.ndarray) -> Iterator[list[_Mixture]]:
    """Yield the posteriors of images (n, 2 J) with the same visible joints."""
    for rows, visible in visibility_groups(images):
        evidence = prior.cells.evidence(images[rows], visible, False)
        weights = evidence.weights()
        parts = list(prior.cells.posteriors(images[rows], visible, evidence, weights))
        factors = [_factors(prior.cells.covariance(part, visible)) for part in parts]
        roots, spreads, norms = (np.array(each) for each in zip(*factors, strict=True))
        members: list[list[tuple[int, int]]] = [[] for _ in rows]
        for number, part in enumerate(parts):
            for position, row in enumerate(part.rows):
                members[row].append((number, position))
        mixtures = []
        for index, row in enumerate(rows):
            cells = np.array([number for number, _ in members[index]])
            probabilities = np.array([parts[p].weights[i] for p, i in members[index]])
            mixtures.append(
                _Mixture(
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
    assert values[0] > _LEAST_VARIANCE * values[-1]
    return vectors / np.sqrt(values), vectors * np.sqrt(values), 0.5 * float(np.log(values).sum())
