"""Gaussian poses seen in every view of a grid: exact posteriors of poses, views and scales.

A pose X ~ N(μ_k, Σ_k) of component k, seen in view v, is in camera axes X^c = R_v X + t with an
unknown position t. Its image y = (X^c)_xy + ε, ε ~ N(0, σ² I), is Gaussian, so that in each cell
(k, v) the posterior of X^c given y is Gaussian, and the cell's probability is known. Coordinates
are ordered (3, J): all x, all y, all z; an image is the first 2J of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from probmotion.interaction.annotations.sources import world_axes

__all__ = [
    "CellEvidence",
    "CellPosterior",
    "OneDirectionError",
    "ViewCells",
    "check_view_directions",
    "elevation_levels",
    "likely_scales",
]

_POSITION_SD = 10.0  # standard deviation of the unknown position in the image, metres
_HORIZONTAL = 0.1  # weight of horizontal against vertical extents, which views hardly change
_LOG_SCALE_SD = 0.1  # of the prior of an unknown scale
_NEWTON_STEPS = 6
_ROWS = 128  # images evaluated at a time
_ELEVATION_STEP = np.radians(10.0)  # largest distance of the grid's elevations
_ONE_AZIMUTH = 0.85  # concentration of azimuths within about 13 degrees of one axis (one sd)
_LEAST_WEIGHT = 1e-3  # cells of less posterior probability than this are left out


class OneDirectionError(ValueError):
    """All views share one horizontal direction, so that the depth is not identifiable."""


class CellEvidence(NamedTuple):
    """Log density of each image in each cell, and the posterior of its scale there: (n, C)."""

    log_density: np.ndarray
    scale: np.ndarray
    scale_variance: np.ndarray

    def weights(self) -> np.ndarray:
        """Return the posterior probabilities of the cells, (n, C), without negligible ones."""
        weights = np.exp(self.log_density - self.log_density.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        weights[weights < _LEAST_WEIGHT * weights.max(axis=1, keepdims=True)] = 0.0
        return weights / weights.sum(axis=1, keepdims=True)


class CellPosterior(NamedTuple):
    """Posterior of the poses of the images ``rows``, given that they come from one cell.

    The pose of row i is N(mean_i, prior − gainᵀ prior_xy + stretch_i stretch_iᵀ), where ``gain``
    (m, 3J) maps the m visible image coordinates, and stretch_i is due to the unknown scale.
    """

    cell: int
    rows: np.ndarray
    weights: np.ndarray
    mean: np.ndarray
    gain: np.ndarray
    stretch: np.ndarray


class ViewCells:
    """Cells (k, v) of K Gaussians and V views.

    Parameters
    ----------
    weights, means, covariances : ndarray, (K,), (K, J, 3), (K, 3J, 3J)
        Mixture of Gaussians over centred poses in the canonical frame, metres.
    views : ndarray, (V, 2)
        Azimuths and elevations, equally probable a priori, radians.
    noise : float
        Standard deviation σ of the image coordinates, metres.
    """

    def __init__(
        self,
        weights: np.ndarray,
        means: np.ndarray,
        covariances: np.ndarray,
        views: np.ndarray,
        noise: float,
    ) -> None:
        K, J = means.shape[:2]
        V, self.n_joints = len(views), J
        self.mean_pose = np.tensordot(weights, means, 1)
        self.component = np.repeat(np.arange(K), V)
        self.views = np.tile(views, (K, 1))
        self.axes = world_axes(self.views)
        # Rotating a covariance is one matrix product if its axes are ordered (3, 3, J, J).
        self._turns = np.einsum("cai,cbl->cabil", self.axes, self.axes).reshape(K, 9 * V, 9)
        self.means = np.einsum("cai,cji->caj", self.axes, means[self.component])
        self.means = self.means.reshape(K * V, 3 * J)
        self.covariances = self._in_camera(covariances.reshape(K, J, 3, J, 3))
        # The position in the image is unknown; the depth is relative to its mean over the joints.
        self.covariances[:, :J, :J] += _POSITION_SD**2
        self.covariances[:, J : 2 * J, J : 2 * J] += _POSITION_SD**2
        images = self.covariances[:, : 2 * J, : 2 * J] + noise**2 * np.eye(2 * J)
        self.precisions = np.linalg.inv(images)
        self.gains = self.precisions @ self.covariances[:, : 2 * J]
        logdet = np.linalg.slogdet(images)[1]
        # Densities are with respect to a flat prior of the position.
        flat = 2 * np.log(_POSITION_SD)
        self.log_norms = np.log(weights)[self.component] - np.log(V) - logdet / 2 + flat

    def _in_camera(self, covariances: np.ndarray) -> np.ndarray:
        """Return covariances in camera axes, (C, 3J, 3J)."""
        C, J = len(self.axes), self.n_joints
        by_axes = covariances.transpose(0, 2, 4, 1, 3).reshape(-1, 9, J * J)
        both = (self._turns @ by_axes).reshape(C, 3, 3, J, J).transpose(0, 1, 3, 2, 4)
        both[:, 2] -= both[:, 2].mean(axis=1, keepdims=True)
        both[:, :, :, 2] -= both[:, :, :, 2].mean(axis=3, keepdims=True)
        return both.reshape(C, 3 * J, 3 * J)

    def evidence(
        self, images: np.ndarray, visible: np.ndarray, unknown_scale: bool
    ) -> CellEvidence:
        """Return the log density of images (n, 2J) with one mask ``visible`` (2J,) in every cell.

        An unknown scale u, u y = (X^c)_xy + ε, has a log-normal prior with sd .1 around the
        :func:`likely_scales`: with a flat one, EM would explain narrow images as small broad ones.
        Given a cell, log u has the log density d log u − (a u² − 2b u + c)/2 plus the prior's,
        integrated by Laplace's method.
        """
        hidden = ~visible
        n, C = len(images), len(self.means)
        images = np.where(visible, images, 0.0)
        means = np.where(visible, self.means[:, : images.shape[1]], 0.0)[:, None]
        inner = self.precisions[:, hidden][:, :, hidden]
        logdet = np.linalg.slogdet(inner)[1]

        def products(left: np.ndarray, right: np.ndarray) -> np.ndarray:
            """Return the products of (C, n, 2J) with the precision of the visible coordinates."""
            weighted = left @ self.precisions
            result = np.einsum("cni,cni->nc", weighted, np.broadcast_to(right, weighted.shape))
            if hidden.any():  # the Schur complement of the hidden coordinates' precision
                other = weighted if right is left else right @ self.precisions
                solved = np.linalg.solve(inner, np.swapaxes(weighted[..., hidden], 1, 2))
                result -= np.einsum("chn,cnh->nc", solved, other[..., hidden])
            return result

        a, b = np.empty((n, C)), np.empty((n, C))
        for start in range(0, n, _ROWS):
            rows = slice(start, start + _ROWS)
            if unknown_scale:
                observed = np.broadcast_to(images[rows], (C, *images[rows].shape))
                a[rows], b[rows] = products(observed, observed), products(observed, means)
            else:
                residuals = images[rows] - means
                a[rows] = products(residuals, residuals)
        constant = self.log_norms - logdet / 2 - (visible.sum() - 2) * np.log(2 * np.pi) / 2
        if not unknown_scale:
            ones = np.broadcast_to(1.0, a.shape)
            return CellEvidence(constant - a / 2, ones, np.broadcast_to(0.0, a.shape))
        c = products(means, means)
        prior = np.log(likely_scales(self.mean_pose, images, visible))[:, None]
        degrees = visible.sum() - 2  # 2 for the position
        a, b = a * np.exp(2 * prior), b * np.exp(prior)
        log_scale = np.zeros((n, C))  # relative to the prior's median
        for _ in range(_NEWTON_STEPS):
            u = np.exp(log_scale)
            slope = degrees - a * u**2 + b * u - log_scale / _LOG_SCALE_SD**2
            curvature = np.maximum(2 * a * u**2 - b * u, 0.0) + 1 / _LOG_SCALE_SD**2
            log_scale += np.clip(slope / curvature, -0.3, 0.3)
        u = np.exp(log_scale)
        curvature = np.maximum(2 * a * u**2 - b * u, 0.0) + 1 / _LOG_SCALE_SD**2
        log_density = constant + degrees * (prior + log_scale)
        log_density -= (a * u**2 - 2 * b * u + c + (log_scale / _LOG_SCALE_SD) ** 2) / 2
        log_density -= np.log(curvature * _LOG_SCALE_SD**2) / 2
        scale = u * np.exp(prior)
        return CellEvidence(log_density, scale, scale**2 / curvature)

    def posteriors(
        self, images: np.ndarray, visible: np.ndarray, evidence: CellEvidence, weights: np.ndarray
    ) -> Iterator[CellPosterior]:
        """Yield the posterior of the images in each cell where their ``weights`` are not 0."""
        hidden = ~visible
        observed = images[:, visible]
        for cell in np.flatnonzero(weights.any(axis=0)):
            rows = np.flatnonzero(weights[:, cell])
            gain = self.gains[cell, visible]
            if hidden.any():
                precision = self.precisions[cell]
                inner, outer = precision[np.ix_(hidden, hidden)], precision[np.ix_(hidden, visible)]
                gain = gain - np.linalg.solve(inner, outer).T @ self.gains[cell, hidden]
            scale = evidence.scale[rows, cell, None]
            residuals = observed[rows] * scale - self.means[cell, : len(visible)][visible]
            mean = self.means[cell] + residuals @ gain
            stretch = np.zeros((len(rows), 0))
            if evidence.scale_variance[rows, cell].any():
                stretch = np.sqrt(evidence.scale_variance[rows, cell, None]) * (
                    observed[rows] @ gain
                )
            yield CellPosterior(int(cell), rows, weights[rows, cell], mean, gain, stretch)

    def covariance(self, posterior: CellPosterior, visible: np.ndarray) -> np.ndarray:
        """Return the covariance of a posterior given the scale, (3J, 3J)."""
        prior = self.covariances[posterior.cell]
        return prior - posterior.gain.T @ prior[: len(visible)][visible]

    def variances(self, posterior: CellPosterior, visible: np.ndarray) -> np.ndarray:
        """Return the variances of the coordinates, (m, 3J), or (1, 3J) if the scale is known."""
        prior = self.covariances[posterior.cell]
        within = prior[: len(visible)][visible]
        variances = prior.diagonal() - np.einsum("mi,mi->i", posterior.gain, within)
        if posterior.stretch.shape[1]:
            return variances + posterior.stretch**2
        return variances[None]

    def in_canonical_frame(self, sums: np.ndarray, squares: np.ndarray) -> tuple[np.ndarray, ...]:
        """Rotate sums (C, 3J) and second moments (C, 3J, 3J) back, and add those of a component.

        The results are (K, J, 3) and (K, J, 3, J, 3).
        """
        K, J = len(self._turns), self.n_joints
        axes = self.axes.reshape(K, -1, 3)  # rows (V, 3)
        first = np.swapaxes(sums.reshape(K, -1, J), 1, 2) @ axes
        by_axes = squares.reshape(-1, 3, J, 3, J).transpose(0, 1, 3, 2, 4).reshape(K, -1, J * J)
        second = np.swapaxes(self._turns, 1, 2) @ by_axes
        return first, second.reshape(K, 3, 3, J, J).transpose(0, 3, 1, 4, 2)


def likely_scales(pose: np.ndarray, images: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the ratios of the sizes of a pose (J, 3) and of images (n, 2J), (n,).

    The vertical extent of the visible joints counts ten times as much as the horizontal one.
    """
    J = len(pose)
    joints = visible[:J]
    squares = (pose[joints] - pose[joints].mean(axis=0)) ** 2 @ [
        _HORIZONTAL / 2,
        1.0,
        _HORIZONTAL / 2,
    ]
    x, y = images[:, :J][:, joints], images[:, J:][:, joints]
    sizes = _HORIZONTAL * (x**2).sum(axis=1) + (y**2).sum(axis=1)
    return np.asarray(np.sqrt(squares.sum() / sizes))


def elevation_levels(elevations: tuple[float, float]) -> np.ndarray:
    """Return midpoints of intervals of at most 10° that cover a range of elevations, radians."""
    low, high = elevations
    if not -np.pi / 2 <= low <= high <= np.pi / 2:
        raise ValueError(f"elevations must be ordered and from -π/2 to π/2, got {elevations}")
    count = max(1, math.ceil((high - low) / _ELEVATION_STEP - 1e-9))
    return np.asarray(low + (np.arange(count) + 0.5) * (high - low) / count)


def check_view_directions(name: str, azimuth_concentration: float) -> None:
    """Raise :class:`OneDirectionError` if all views share one horizontal direction."""
    if azimuth_concentration > _ONE_AZIMUTH:
        raise OneDirectionError(
            f"{name} must show the poses from several directions, got one view direction only: "
            f"the depth is not identifiable; add {name} from other sides"
        )
