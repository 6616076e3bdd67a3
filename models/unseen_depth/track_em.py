"""Expectation maximisation of a spectral mixture of motions from images in unknown views.

The DCT coefficients of a motion at frequency f are x_f ~ N(m_f, C_f), independent between
frequencies, and those of its image are y_f = A x_f + ε, where A projects all joints in one view.
The posterior of x_f in each view is Gaussian, so that the E step is exact.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from probmotion.arrays import logsumexp
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.conditioning import Component, rotation
from probmotion.models.mixture.spectral_fit import Moments
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectrum import (
    from_frequencies,
    principal_directions,
    ramp,
    to_frequencies,
    translations,
)

__all__ = ["Expectation", "expectation", "maximisation", "moments", "prior_of"]

_LEAST_WEIGHT = 1e-3  # less probable views, relative to the most probable one, are left out
_PSEUDO_WINDOWS = 10  # weight of the white covariance, in windows
_WHITE = 0.005  # its standard deviation, metres


class Expectation(NamedTuple):
    """Results of an E step, with deviations of coefficients from the components' means.

    ``counts`` (K,), ``sums`` (K, L, P) and ``squares`` (K, L, P, P) are the expected number of
    windows, and sums and second moments of deviations from ``means`` (K, L, P). ``coefficients``
    (n, L, P), ``images`` (n, L, J, 2) and ``depths`` (n, L, J) are posterior means of the motions
    in their canonical heading, of their images, and of the joints' distances behind the origin.
    ``azimuth_concentration`` is 1 if all views share one horizontal axis, and 0 if azimuths are
    uniform. ``log_density`` is the mean log density of a window.
    """

    counts: np.ndarray
    sums: np.ndarray
    squares: np.ndarray
    means: np.ndarray
    coefficients: np.ndarray
    images: np.ndarray
    depths: np.ndarray
    azimuth_concentration: float
    log_density: float


def expectation(
    prior: SpectralMixtureMotion, images: np.ndarray, elevations: np.ndarray, noise: float
) -> Expectation:
    """Return the moments of the motions of images (n, L, J, 2), x right, y down, metres.

    Views have the azimuths of the prior and these elevations (E,), equally probable; ``noise`` is
    the standard deviation σ of the coordinates.
    """
    n, L, J, _ = images.shape
    P = 3 * J
    y = to_frequencies(images.reshape(n, L, 2 * J), axis=1).transpose(1, 2, 0).copy()  # (L, 2 J, n)
    gaussians = prior.components.gaussians
    K = len(gaussians)
    means = np.stack([to_frequencies(part.mean, axis=0).reshape(L, P) for part in gaussians])
    covariances = [_covariances(part) for part in gaussians]
    cameras = Cameras.around(np.zeros(len(elevations)), elevations).rotation
    views = [(azimuth, camera @ rotation(azimuth)) for camera in cameras for azimuth in prior.yaws]
    cells = [
        (k, azimuth, np.kron(np.eye(J), axes[:2]), axes[2])
        for k in range(K)
        for azimuth, axes in views
    ]

    def image_precision(k: int, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return A C and the inverse Cholesky factor of A C Aᵀ + σ² I, at all frequencies."""
        seen = A @ covariances[k]
        total = seen @ A.T + noise**2 * np.eye(2 * J)
        return seen, np.linalg.inv(np.linalg.cholesky(total))

    logits = np.empty((len(cells), n))
    for c, (k, _, A, _) in enumerate(cells):
        factor = image_precision(k, A)[1]
        logdet = np.log(np.diagonal(factor, axis1=1, axis2=2)).sum()
        logits[c] = prior.components.log_weights[k] - math.log(len(elevations)) + logdet
        # One frequency at a time, whose images fit into a core's cache.
        for image, centre, whitening in zip(y, means[k] @ A.T, factor, strict=True):
            white = whitening @ image - (whitening @ centre)[:, None]
            logits[c] -= np.einsum("in,in->n", white, white) / 2
    log_density = logsumexp(logits, axis=0)
    weights = np.exp(logits - logits.max(axis=0))
    weights[weights < _LEAST_WEIGHT] = 0.0
    weights /= weights.sum(axis=0)

    counts, sums, squares = np.zeros(K), np.zeros((K, L, P)), np.zeros((K, L, P, P))
    coefficients, seen_images = np.zeros((L, n, P)), np.zeros((L, n, 2 * J))
    depths = np.zeros((L, n, J))
    directions = np.zeros(n, dtype=complex)  # means of azimuths, opposite ones alike
    for weight, (k, azimuth, A, away) in zip(weights, cells, strict=True):
        rows = np.flatnonzero(weight)
        if not len(rows):
            continue
        seen, factor = image_precision(k, A)
        gain = factor.swapaxes(1, 2) @ (factor @ seen)
        deviation = (y[:, :, rows].swapaxes(1, 2) - (means[k] @ A.T)[:, None]) @ gain
        weighted = weight[rows, None] * deviation
        counts[k] += weight.sum()
        sums[k] += weighted.sum(axis=1)
        within = covariances[k] - seen.swapaxes(1, 2) @ gain
        squares[k] += weighted.swapaxes(1, 2) @ deviation + weight.sum() * within
        mean = weighted + weight[rows, None] * means[k][:, None]
        coefficients[:, rows] += mean
        seen_images[:, rows] += mean @ A.T
        depths[:, rows] += mean.reshape(L, -1, J, 3) @ away
        directions[rows] += weight[rows] * np.exp(2j * azimuth)
    return Expectation(
        counts,
        sums,
        squares,
        means,
        coefficients.swapaxes(0, 1),
        from_frequencies(seen_images.swapaxes(0, 1), axis=1).reshape(n, L, J, 2),
        from_frequencies(depths.swapaxes(0, 1), axis=1),
        # Relative to each window's own uncertainty: an ambiguous azimuth does not hide an axis.
        float(abs(directions.sum()) / max(abs(directions).sum(), 1e-12)),
        float(log_density.mean()) - J * L * math.log(2 * math.pi),
    )


def moments(expected: Expectation, fps: float) -> list[Moments]:
    """Return the moments of each component, shrunk by a little white variance."""
    result = []
    L, P = expected.sums.shape[1:]
    along, slope = translations(P // 3), ramp(L, fps)
    for k, count in enumerate(np.maximum(expected.counts, 1e-12)):
        shift = expected.sums[k] / count
        mean = expected.means[k] + shift
        pose = mean[0] / math.sqrt(L)
        pose = pose - along @ (along.T @ pose)
        # Least squares of the mean path's coefficients on those of a ramp.
        path, square = mean @ along / math.sqrt(P // 3), slope @ slope
        velocity = slope @ path / square if square > 0 else np.zeros(2)
        modelled = math.sqrt(P // 3) * slope[:, None] * (along @ velocity)
        modelled[0] += math.sqrt(L) * pose
        rest = mean - modelled
        bands = expected.squares[k] / count
        bands = bands - shift[:, :, None] * shift[:, None] + rest[:, :, None] * rest[:, None]
        white = _PSEUDO_WINDOWS * _WHITE**2 * np.eye(P)
        result.append(Moments(pose, velocity, (count * bands + white) / (count + _PSEUDO_WINDOWS)))
    return result


def maximisation(
    expected: Expectation,
    prior: SpectralMixtureMotion,
    towards: Moments | None = None,
    pseudo_windows: float = 0.0,
) -> SpectralMixtureMotion:
    """Return the prior with the moments of an E step.

    With several components, each is shrunk towards the moments ``towards``, which count as
    ``pseudo_windows`` windows.
    """
    parts = moments(expected, prior.fps)
    if towards is not None:
        shares = expected.counts / (expected.counts + pseudo_windows)
        parts = [part.shrunk(towards, share) for part, share in zip(parts, shares, strict=True)]
    return prior_of(parts, expected.counts, prior)


def prior_of(
    parts: list[Moments], counts: np.ndarray, prior: SpectralMixtureMotion
) -> SpectralMixtureMotion:
    """Return a prior with the moments of each component, otherwise as ``prior``."""
    spectra = [principal_directions(part.bands, prior.band) for part in parts]
    return replace(
        prior,
        poses=np.stack([part.pose.reshape(-1, 3) for part in parts]),
        velocities=np.stack([part.velocity for part in parts]),
        directions=np.stack([directions for directions, _ in spectra]),
        variances=np.stack([variances for _, variances in spectra]),
        weights=(counts + 1) / (counts + 1).sum(),
    )


def _covariances(component: Component) -> np.ndarray:
    """Return covariances of the coefficients at each frequency, (L, P, P)."""
    V = component.directions[component.band]
    return (V * component.variances[:, None, :]) @ V.swapaxes(1, 2)
