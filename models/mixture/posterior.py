"""Exact posterior of the Gaussian-mixture prior under a linear Gaussian likelihood.

The posterior is also a mixture. At one joint and frame, the likelihood of a position x is
exp(−½ xᵀΛx + ηᵀx). With the noise δ ε integrated out, it has the same form in m_k + W_k z with
Λ̃ = SΛ and η̃ = Sη, S = (I + δ²Λ)⁻¹. Rotated means and factors are combinations of three base
fields (``rotated_mixture``), so K small Gram matrices determine those of all K·A components.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from probmotion.arrays import Array, array_namespace, constant, logsumexp
from probmotion.models.mixture.rotated_mixture import rotation_coefficients
from probmotion.posteriors.protocols import Likelihood, NotConjugate
from probmotion.seeds import RandomNumbers

__all__ = ["MixturePosterior", "natural_parameters"]


class MixturePosterior:
    """Posterior p(X | y) of a rotated Gaussian mixture; the prior if there is no likelihood.

    Created by :meth:`GaussianMixtureMotion.exact_posterior` from base fields (K, 1 + r, 3, L·J, 3),
    azimuths (A,), style probabilities (K,), noise δ, the shape (L, J, 3) and a likelihood with
    ``linear()``; raises ``NotConjugate`` for other likelihoods.
    """

    def __init__(
        self,
        base_fields: np.ndarray,
        azimuths: np.ndarray,
        weights: np.ndarray,
        noise: float,
        shape: tuple[int, ...],
        likelihood: Likelihood | None,
    ) -> None:
        self.shape = shape
        self.noise = noise
        self.weights = weights
        self.fields = base_fields
        self.turns = rotation_coefficients(azimuths)
        self.information, self.shift, constant_part = natural_parameters(
            likelihood, base_fields.shape[3]
        )
        variance = noise**2
        self._shrink = np.linalg.inv(np.eye(3) + variance * self.information)
        metric = self._shrink @ self.information
        shrunk_shift = np.einsum("fij,fj->fi", self._shrink, self.shift)
        weighted = np.einsum("fij,knefj->knefi", metric, base_fields)
        gram = np.einsum("kicfx,kjdfx->kijcd", base_fields, weighted, optimize=True)
        turns = self.turns
        self._gram = np.einsum("kijcd,ac,ad->kaij", gram, turns, turns, optimize=True)
        linear = np.einsum("fx,kicfx->kic", shrunk_shift, base_fields, optimize=True)
        self._linear = np.einsum("kic,ac->kai", linear, turns)
        constant_part -= 0.5 * np.linalg.slogdet(np.linalg.inv(self._shrink))[1].sum()
        constant_part += 0.5 * variance * float((self.shift * shrunk_shift).sum())
        log_weights = np.log(weights)[:, None] - math.log(len(azimuths))
        # log π p(y | z, k, a) = offset + slope·z − ½ zᵀ H z, π: prior of k, a
        self._offset = (
            log_weights + constant_part + self._linear[..., 0] - 0.5 * self._gram[..., 0, 0]
        )
        self._slope = self._linear[..., 1:] - self._gram[..., 0, 1:]
        self._curvature = self._gram[..., 1:, 1:]

    @cached_property
    def _latent_precision(self) -> np.ndarray:
        return np.eye(self._slope.shape[-1]) + self._curvature

    @cached_property
    def _latent_mean(self) -> np.ndarray:
        return np.linalg.solve(self._latent_precision, self._slope[..., None])[..., 0]

    @cached_property
    def _latent_root(self) -> np.ndarray:
        """Matrix C with C Cᵀ = Cov[z | y, k, a], (K, A, r, r): precision = L Lᵀ, so C = L⁻ᵀ."""
        lower = np.linalg.cholesky(self._latent_precision)
        return np.swapaxes(np.linalg.inv(lower), -1, -2)

    @cached_property
    def _noise_root(self) -> np.ndarray:
        """Cholesky factor of S, the covariance of X / δ given m + W z and y, (F, 3, 3)."""
        return np.linalg.cholesky(self._shrink)

    @cached_property
    def _log_joint(self) -> np.ndarray:
        """Log joint density log p(y, k, a), (K, A)."""
        log_det = np.linalg.slogdet(self._latent_precision)[1]
        return self._offset + 0.5 * ((self._slope * self._latent_mean).sum(axis=-1) - log_det)

    @property
    def log_marginal_likelihood(self) -> float:
        """Log marginal likelihood log p(y)."""
        return float(logsumexp(self._log_joint.reshape(-1)))

    @property
    def component_probabilities(self) -> np.ndarray:
        """Probabilities p(style k, azimuth a | y), (K, A)."""
        return np.exp(self._log_joint - self.log_marginal_likelihood)

    def mean(self) -> np.ndarray:
        """Return E[X | y], (L, J, 3), metres."""
        weights = self.component_probabilities
        latent = np.concatenate([np.ones((*weights.shape, 1)), self._latent_mean], axis=-1)
        base = np.einsum("ka,kai,ac->kic", weights, latent, self.turns, optimize=True)
        clean = np.einsum("kic,kicfx->fx", base, self.fields, optimize=True)
        return self._given_clean(clean).reshape(self.shape)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent draws, (n, L, J, 3), metres."""
        probabilities = self.component_probabilities
        flat = probabilities.reshape(-1)
        chosen = rng.choice(flat.size, size=n, p=flat / flat.sum())
        style, azimuth = np.divmod(chosen, probabilities.shape[1])
        unit = rng.standard_normal((n, self._slope.shape[-1]))
        spread = (self._latent_root[style, azimuth] @ unit[..., None])[..., 0]
        return self._motions(rng, style, azimuth, self._latent_mean[style, azimuth] + spread)

    def complete(self, rng: RandomNumbers, latent: np.ndarray) -> np.ndarray:
        """Return one draw from p(X | z, y) for each z: ``(n, r) → (n, L, J, 3)``, metres."""
        logits = np.asarray(self._log_terms(latent))
        logits = logits - logits.max(axis=-1, keepdims=True)
        cumulative = np.cumsum(np.exp(logits), axis=-1)
        level = rng.random((len(latent), 1)) * cumulative[:, -1:]
        chosen = (cumulative < level).sum(axis=-1)
        style, azimuth = np.divmod(chosen, self._offset.shape[1])
        return self._motions(rng, style, azimuth, latent)

    def log_likelihood(self, latent: Array) -> Array:
        """Return log p(y | z) with style, azimuth and noise integrated out: ``(…, r) → (…)``."""
        return logsumexp(self._log_terms(latent))

    def log_density(self, positions: Array) -> Array:
        """Return log p(X | y), normalised: ``(…, L, J, 3) → (…)``; NumPy, torch or JAX."""
        xp = array_namespace(positions)
        K, width, _, F, _ = self.fields.shape
        A = len(self.turns)
        n = math.prod(positions.shape[:-3])
        flat = xp.reshape(positions, (n, F, 3))
        # Given (k, a), X is Gaussian with precision Q = Λ + I/δ² around the latent subspace.
        centred = flat - constant(self._given_clean(np.zeros((F, 3))), flat)
        precision = self.information + np.eye(3) / self.noise**2
        weighted = xp.sum(constant(precision, flat) * centred[:, :, None, :], axis=-1)
        square = xp.sum(weighted * centred, axis=(-2, -1))
        shrunk = np.einsum("fxy,kicfy->kicfx", self._shrink, self.fields)
        products = xp.reshape(weighted, (n, F * 3)) @ constant(shrunk.reshape(-1, F * 3).T, flat)
        rotated = xp.reshape(products, (n, K, width, 3)) @ constant(self.turns.T, flat)
        rotated = xp.permute_dims(rotated, (0, 1, 3, 2))
        gram = self._clean_gram
        slope = rotated[..., 1:] - constant(gram[..., 0, 1:], flat)
        slope = slope + constant(self._slope, flat)
        total = self._latent_precision + gram[..., 1:, 1:]
        half = constant(np.linalg.inv(np.linalg.cholesky(total)), flat)
        latent = xp.sum(half * slope[..., None, :], axis=-1)
        log_det = np.linalg.slogdet(total)[1]
        offset = self._offset - self.log_marginal_likelihood - 0.5 * (log_det + gram[..., 0, 0])
        logits = rotated[..., 0] + 0.5 * xp.sum(latent**2, axis=-1) + constant(offset, flat)
        norm = F * 3 * math.log(2 * math.pi) - np.linalg.slogdet(precision)[1].sum()
        value = logsumexp(xp.reshape(logits, (n, K * A))) - 0.5 * (square + float(norm))
        return xp.reshape(value, positions.shape[:-3])

    @cached_property
    def _clean_gram(self) -> np.ndarray:
        """Gram matrices of S·(mean, factors) under Q = Λ + I/δ², (K, A, 1 + r, 1 + r).

        S Q S = S / δ², because S Q = I/δ².
        """
        shrunk = np.einsum("fxy,kicfy->kicfx", self._shrink, self.fields) / self.noise**2
        gram = np.einsum("kicfx,kjdfx->kijcd", self.fields, shrunk, optimize=True)
        return np.einsum("kijcd,ac,ad->kaij", gram, self.turns, self.turns, optimize=True)

    def _log_terms(self, latent: Array) -> Array:
        """Return log p(k, a) p(y | z, k, a), ``(…, r) → (…, K·A)``."""
        xp = array_namespace(latent)
        rank = self._slope.shape[-1]
        batch = latent.shape[:-1]
        n = math.prod(batch)
        flat = xp.reshape(latent, (n, rank))
        slope = constant(self._slope.reshape(-1, rank).T, flat)
        curvature = constant(self._curvature.reshape(-1, rank * rank).T, flat)
        square = xp.reshape(flat[:, :, None] * flat[:, None, :], (n, rank * rank))
        offset = constant(self._offset.reshape(-1), flat)
        terms = offset + flat @ slope - 0.5 * (square @ curvature)
        return xp.reshape(terms, (*batch, terms.shape[-1]))

    def _given_clean(self, clean: np.ndarray) -> np.ndarray:
        """Return E[X | m + W z = clean, y] = S (clean + δ² η): ``(…, F, 3) → (…, F, 3)``."""
        return np.einsum("fij,...fj->...fi", self._shrink, clean + self.noise**2 * self.shift)

    def _motions(
        self,
        rng: RandomNumbers,
        style: np.ndarray,
        azimuth: np.ndarray,
        latent: np.ndarray,
    ) -> np.ndarray:
        """Draw X given style, azimuth and z, (n, L, J, 3)."""
        n = len(latent)
        out = np.empty((n, *self.fields.shape[3:]))
        for row in range(n):
            weights = np.concatenate([[1.0], latent[row]])[:, None] * self.turns[azimuth[row]]
            out[row] = np.tensordot(weights, self.fields[style[row]], axes=2)
        noise = rng.standard_normal(out.shape)
        spread = np.einsum("fij,nfj->nfi", self._noise_root, noise)
        out = self._given_clean(out) + self.noise * spread
        return out.reshape(n, *self.shape)


def natural_parameters(
    likelihood: Likelihood | None, F: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return Λ (F, 3, 3), η (F, 3) and the terms of log p(y | X) that do not depend on X."""
    if likelihood is None:
        return np.zeros((F, 3, 3)), np.zeros((F, 3)), 0.0
    linear = getattr(likelihood, "linear", None)
    if linear is None:
        raise NotConjugate(
            f"likelihood must have a linear() method, got {type(likelihood).__name__}"
        )
    axes, target, precision = linear()
    M = axes.shape[1]
    target = target.reshape(len(axes), F, M)
    precision = precision.reshape(len(axes), F)
    information = np.einsum("vf,vmi,vmj->fij", precision, axes, axes)
    shift = np.einsum("vf,vmi,vfm->fi", precision, axes, target)
    seen = precision > 0
    log_norm = 0.5 * M * float(np.log(precision[seen] / (2 * math.pi)).sum())
    energy = float((precision[..., None] * target**2).sum())
    return information, shift, log_norm - 0.5 * energy
