"""2D marginal of a spectral mixture in one orthographic view: denoiser and covariance products.

In a view, frequencies remain independent, but the directions of a component depend on azimuth and
frequency: each has a covariance matrix over the 2 J image coordinates, decomposed once per view.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from probmotion.models.mixture.conditioning import Components, rotation
from probmotion.models.mixture.rotated_spectra import blocks
from probmotion.models.mixture.spectrum import to_frequencies

__all__ = ["ViewSpectra"]

_NEGLIGIBLE = 1e-16  # responsibilities below are set to 0
_SMALLEST = 1e-200  # total variance, so that squared deviations times the precision are finite


class _Level(NamedTuple):
    """Quantities that depend only on the variance v of the noise.

    For components with the covariance S: ``precision`` (S + v)⁻¹, (C A, L, 2 J, 2 J), and
    ``offsets``, (C A,), log densities of y at their means, up to a constant.
    """

    variance: float
    precision: np.ndarray
    offsets: np.ndarray


class ViewSpectra:
    """Mixture of views x observed as y = x + N(0, v I), in DCT coefficients.

    Parameters
    ----------
    components : Components
        Mixture of motions.
    axes : ndarray, (2, 3)
        Image axes of the orthographic camera.
    """

    def __init__(self, components: Components, axes: np.ndarray) -> None:
        L, J, _ = components.gaussians[0].mean.shape
        shape = (len(components.gaussians) * len(components.yaws), L, 2 * J)
        self._means = np.empty(shape)
        self._sizes = np.empty(shape)
        self._axes = np.empty((*shape, 2 * J))
        self._log_weights = np.repeat(components.log_weights, len(components.yaws))
        row = 0
        for component in components.gaussians:
            mean = to_frequencies(component.mean, axis=0)
            directions = component.directions[component.band].reshape(L, J, 3, -1)
            for azimuth in components.yaws:
                projection = axes @ rotation(azimuth)
                seen = np.einsum("mx,ljxp->ljmp", projection, directions, optimize=True)
                seen = seen.reshape(L, 2 * J, -1)
                covariance = (seen * component.variances[:, None, :]) @ seen.swapaxes(1, 2)
                size, self._axes[row] = np.linalg.eigh(covariance)
                self._sizes[row] = np.maximum(size, 0.0)
                self._means[row] = (mean @ projection.T).reshape(L, 2 * J)
                row += 1
        self._last: _Level | None = None

    def denoise(self, y: np.ndarray, variance: float) -> np.ndarray:
        """Return E[x | y]: ``(n, L, J, 2) → (n, L, J, 2)``."""
        level = self._level(variance)
        out = np.empty_like(y)
        for rows, block in self._blocks(y):
            weights, scores = self._condition(block, level)
            mean = block - variance * np.einsum("cn,clnp->lnp", weights, scores)
            self._fill(out[rows], mean)
        return out

    def covariance(self, y: np.ndarray, variance: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return u ↦ Cov[x | y] u for each row of y: arrays (n, L, J, 2)."""
        level = self._level(variance)
        states = []
        for _, block in self._blocks(y):
            weights, scores = self._condition(block, level)
            # Differences between the mean and the components' conditional means, divided by v.
            scores = scores - np.einsum("cn,clnp->lnp", weights, scores)
            used = np.flatnonzero(weights.any(axis=1))
            states.append((used, weights[used], variance * scores[used]))

        def product(vectors: np.ndarray) -> np.ndarray:
            out = np.empty_like(vectors)
            for (rows, block), (used, weights, away) in zip(
                self._blocks(vectors), states, strict=True
            ):
                along = weights * np.einsum("clnp,lnp->cn", away, block)
                # A component's own covariance is v − v² (S + v)⁻¹.
                shrunk = np.matmul(block, level.precision[used])
                own = variance * (block - variance * np.einsum("cn,clnp->lnp", weights, shrunk))
                self._fill(out[rows], own + np.einsum("cn,clnp->lnp", along, away))
            return out

        return product

    def _level(self, variance: float) -> _Level:
        """Return the quantities of a noise level; the last one is kept."""
        level = self._last
        if level is None or level.variance != variance:
            # Where view and noise are both exact, the observation decides alone.
            precision = 1 / np.maximum(self._sizes + variance, _SMALLEST)
            offsets = self._log_weights + 0.5 * np.log(precision).sum(axis=(1, 2))
            matrices = (self._axes * precision[:, :, None, :]) @ self._axes.swapaxes(2, 3)
            level = self._last = _Level(variance, matrices, offsets)
        return level

    def _condition(self, block: np.ndarray, level: _Level) -> tuple[np.ndarray, np.ndarray]:
        """Return responsibilities (C A, n), and (y − E[x | y, c]) / v, (C A, L, n, 2 J)."""
        deviations = block - self._means[:, :, None]
        scores = np.matmul(deviations, level.precision)
        logits = -0.5 * np.einsum("clnp,clnp->cn", deviations, scores)
        logits += level.offsets[:, None]
        weights = np.exp(logits - logits.max(axis=0))
        weights /= weights.sum(axis=0)
        weights[weights < _NEGLIGIBLE] = 0.0
        return weights, scores

    def _blocks(self, rows: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield the slice and the rows of each block, (L, n, 2 J), padded with zeros."""
        L, P = self._means.shape[1:]
        for part, block in blocks(rows):
            yield part, np.ascontiguousarray(block.reshape(-1, L, P).swapaxes(0, 1))

    @staticmethod
    def _fill(out: np.ndarray, block: np.ndarray) -> None:
        """Write the rows of a block, (L, n, 2 J), to ``out``, (≤ n, L, J, 2)."""
        out[...] = block.swapaxes(0, 1)[: len(out)].reshape(out.shape)
