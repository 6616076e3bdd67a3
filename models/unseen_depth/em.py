"""Expectation maximisation of a Gaussian mixture over poses from images in unknown views.

This is probabilistic non-rigid structure from motion (Torresani, Hertzmann & Bregler 2008) with
a full covariance, and with the camera's view integrated over a grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.arrays import logsumexp
from probmotion.models.unseen_depth.keypoints import centred_images, visibility_groups
from probmotion.models.unseen_depth.view_cells import ViewCells

__all__ = ["Moments", "Poses", "expectation", "maximisation"]

_PSEUDO_POSES = 10  # weight of the white initial covariance, in annotations
_FLOOR = 0.005  # least standard deviation of a pose's coordinates, metres


class Poses(NamedTuple):
    """Gaussian mixture: weights (K,), means (K, J, 3) and covariances (K, 3J, 3J), metres."""

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray


class Moments(NamedTuple):
    """Results of an E step.

    ``counts`` (K,), ``sums`` (K, J, 3) and ``squares`` (K, 3J, 3J) are the expected number of
    poses, their sum and second moment in the canonical frame. ``depths`` (n, J) and ``scales`` (n,)
    are posterior means. ``azimuth_concentration`` is 1 if all views share one horizontal axis, and
    0 if azimuths are uniform. ``log_density`` is the mean log density of an image.
    """

    counts: np.ndarray
    sums: np.ndarray
    squares: np.ndarray
    depths: np.ndarray
    scales: np.ndarray
    azimuth_concentration: float
    log_density: float


def expectation(cells: ViewCells, keypoints: np.ndarray, unknown_scale: bool) -> Moments:
    """Return the moments of the poses of keypoints (n, J, 2), NaN where missing."""
    images, _ = centred_images(keypoints)
    n, J, C = len(images), cells.n_joints, len(cells.means)
    counts, sums, squares = np.zeros(C), np.zeros((C, 3 * J)), np.zeros((C, 3 * J, 3 * J))
    depths, scales, total = np.zeros((n, J)), np.zeros(n), 0.0
    axes = np.zeros(n, dtype=complex)  # means of the azimuths' directions, opposite ones alike
    for rows, visible in visibility_groups(images):
        evidence = cells.evidence(images[rows], visible, unknown_scale)
        weights = evidence.weights()
        axes[rows] = weights @ np.exp(2j * cells.views[:, 0])
        scales[rows] = (weights * evidence.scale).sum(axis=1)
        total += float(logsumexp(evidence.log_density, axis=-1).sum())
        for part in cells.posteriors(images[rows], visible, evidence, weights):
            weighted = part.weights[:, None] * part.mean
            counts[part.cell] += part.weights.sum()
            sums[part.cell] += weighted.sum(axis=0)
            squares[part.cell] += weighted.T @ part.mean
            squares[part.cell] += part.weights.sum() * cells.covariance(part, visible)
            if part.stretch.shape[1]:
                squares[part.cell] += (part.weights[:, None] * part.stretch).T @ part.stretch
            depths[rows[part.rows]] += weighted[:, 2 * J :]
    # Relative to each annotation's own uncertainty: an ambiguous azimuth does not hide an axis.
    concentration = abs(axes.sum()) / max(abs(axes).sum(), 1e-12)
    first, second = cells.in_canonical_frame(sums, squares)
    K = len(first)
    # The position is unknown: poses are about the mean of their joints.
    first = first - first.mean(axis=1, keepdims=True)
    second = second - second.mean(axis=1, keepdims=True)
    second = second - second.mean(axis=3, keepdims=True)
    return Moments(
        counts.reshape(K, -1).sum(axis=1),
        first,
        second.reshape(K, 3 * J, 3 * J),
        depths,
        scales,
        float(concentration),
        total / n,
    )


def maximisation(moments: Moments, spread: float) -> Poses:
    """Return the mixture with these moments, shrunk towards a white covariance of sd ``spread``.

    With several components, each covariance is also shrunk towards their mean.
    """
    counts = moments.counts[:, None, None]
    K, J = moments.sums.shape[:2]
    means = moments.sums / counts
    flat = means.reshape(K, -1, 1)
    scatter = moments.squares - counts * flat * np.swapaxes(flat, 1, 2)
    if K > 1:
        common = scatter.sum(axis=0) / counts.sum()
        scatter, counts = scatter + 3 * J * common, counts + 3 * J
    white = (_PSEUDO_POSES * spread**2 / counts + _FLOOR**2) * np.eye(3 * J)
    covariances = scatter / (counts + _PSEUDO_POSES) + white
    covariances = (covariances + np.swapaxes(covariances, 1, 2)) / 2
    return Poses(moments.counts / moments.counts.sum(), means, covariances)
