"""2D marginal of a spectral mixture in one orthographic view: denoiser and covariance products.

In a view, frequencies remain independent, but the directions of a component depend on azimuth and
frequency: each has a covariance matrix over the 2 J image coordinates, decomposed once per view.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from probmotion.models.mixture.conditioning import Components, rotation
from probmotion.models.mixture.rotated_spectra import blocks
from probmotion.models.mixture.spectrum import to_frequencies

__all__ = ["ViewSpectra"]

_NEGLIGIBLE = 1e-16  # responsibilities below are set to 0


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

    def denoise(self, y: np.ndarray, variance: float) -> np.ndarray:
        """Return E[x | y]: ``(n, L, J, 2) → (n, L, J, 2)``."""
        out = np.empty_like(y)
        for rows, block in blocks(y):
            weights, means = self._condition(block, variance)
            n = rows.stop - rows.start
            mean = np.sum([weights[c, :, None, None] * part for c, part in means], axis=0)
            out[rows] = mean[:n].reshape(n, *y.shape[1:])
        return out

    def covariance(self, y: np.ndarray, variance: float) -> Callable[[np.ndarray], np.ndarray]:
        """Return u ↦ Cov[x | y] u for each row of y: arrays (n, L, J, 2)."""
        gains = variance * self._sizes / (self._sizes + variance)
        states = []
        for _, block in blocks(y):
            weights, means = self._condition(block, variance)
            mean = np.sum([weights[c, :, None, None] * part for c, part in means], axis=0)
            states.append([(c, weights[c, :, None, None], part - mean) for c, part in means])

        def product(vectors: np.ndarray) -> np.ndarray:
            out = np.empty_like(vectors)
            for (rows, direction), state in zip(blocks(vectors), states, strict=True):
                flat = direction.reshape(len(direction), *self._means.shape[1:])
                total = np.zeros_like(flat)
                for c, weight, away in state:
                    along = away * (away * flat).sum(axis=(1, 2), keepdims=True)
                    total += weight * (self._product(c, gains[c], flat) + along)
                n = rows.stop - rows.start
                out[rows] = total[:n].reshape(n, *vectors.shape[1:])
            return out

        return product

    def _condition(
        self, block: np.ndarray, variance: float
    ) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
        """Return responsibilities (C A, n), and the conditional means of those that are not 0."""
        flat = block.reshape(len(block), *self._means.shape[1:])
        total = self._sizes + variance
        # Where view and noise are both exact, the observation decides alone.
        precision = 1 / np.maximum(total, np.finfo(float).tiny)
        logits = np.empty((len(self._means), len(block)))
        for c, (mean, axes) in enumerate(zip(self._means, self._axes, strict=True)):
            scores = np.matmul((flat - mean).swapaxes(0, 1), axes)  # (L, n, 2 J)
            logits[c] = -0.5 * np.einsum("lnp,lp->n", scores**2, precision[c])
        logits += (self._log_weights + 0.5 * np.log(precision).sum(axis=(1, 2)))[:, None]
        weights = np.exp(logits - logits.max(axis=0))
        weights /= weights.sum(axis=0)
        weights[weights < _NEGLIGIBLE] = 0.0
        gain = self._sizes * precision
        means = []
        for c in np.flatnonzero(weights.any(axis=1)).tolist():
            deviation = self._product(c, gain[c], flat - self._means[c])
            means.append((c, self._means[c] + deviation))
        return weights, means

    def _product(self, c: int, gain: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        """Return U diag(gain) Uᵀ v at each frequency: ``(n, L, 2 J) → (n, L, 2 J)``."""
        scores = np.matmul(vectors.swapaxes(0, 1), self._axes[c]) * gain[:, None, :]
        return np.matmul(scores, self._axes[c].swapaxes(1, 2)).swapaxes(0, 1)
