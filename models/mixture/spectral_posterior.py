"""Exact posterior of a spectral mixture under a linear Gaussian likelihood."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, partial

import numpy as np

from probmotion.arrays import Array, logsumexp
from probmotion.models.mixture.conditioning import (
    Component,
    Components,
    Conditional,
    Information,
    rotation,
    turned,
)
from probmotion.models.mixture.posterior import natural_parameters
from probmotion.models.mixture.rotated_mixture import rotation_coefficients, rotation_fields
from probmotion.posteriors.protocols import Likelihood

__all__ = ["SpectralPosterior", "condition", "draw"]

_NEGLIGIBLE = 1e-9  # probability of components without effect on moments
_TINY = 1e-16  # probability of components without effect on means, relative to the largest


def condition(
    components: Components, information: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Condition a mixture on exp(−½ xᵀΛx + ηᵀx) at every entry, for n values of η.

    Parameters
    ----------
    components : Components
        Mixture p(X).
    information : ndarray, (L, J, 3, 3)
        Λ.
    shift : ndarray, (n, L, J, 3)
        η.

    Returns
    -------
    log_joint : ndarray, (n, C, A)
        Log of each component's probability times its integral of the likelihood.
    mean : ndarray, (n, L, J, 3)
        Posterior mean of the mixture, metres.
    """
    split = Information.of(information)
    log_joint = np.empty((len(shift), len(components.gaussians), len(components.yaws)))
    mean = np.zeros(shift.shape)
    top = np.full(len(shift), -np.inf)
    total = np.zeros(len(shift))
    for c, azimuths, log_terms, means in _conditioned(components, split, shift):
        log_joint[:, c, azimuths] = log_terms
        # Accumulate Σ p E[X] relative to the largest term so far.
        raised = np.maximum(top, log_terms.max(axis=1))
        old = np.exp(top - raised)
        weights = np.exp(log_terms - raised[:, None])
        weights[weights < _TINY] = 0.0
        total = total * old + weights.sum(axis=1)
        mean *= old[:, None, None, None]
        if weights.any():
            mean += means(weights)
        top = raised
    return log_joint, mean / total[:, None, None, None]


def draw(
    components: Components,
    information: np.ndarray,
    shift: np.ndarray,
    log_joint: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return one draw of the posterior for each of n values of η, (n, L, J, 3), metres.

    Arguments are those of :func:`condition` and ``log_joint``, (n, C, A), its result.
    """
    split = Information.of(information)
    n, A = len(shift), len(components.yaws)
    flat = log_joint.reshape(n, -1)
    cumulative = np.cumsum(np.exp(flat - flat.max(axis=1, keepdims=True)), axis=1)
    chosen = (cumulative < rng.random((n, 1)) * cumulative[:, -1:]).sum(axis=1)
    scores = rng.standard_normal((n, shift.shape[1], 3 * shift.shape[2]))
    unit = rng.standard_normal(shift.shape)
    out = np.empty(shift.shape)
    conditionals: dict[int, Conditional] = {}
    for index in np.unique(chosen).tolist():
        c, a = divmod(index, A)
        rows = np.flatnonzero(chosen == index)
        component, R = components.gaussians[c], rotation(components.yaws[a])
        local = split if split.isotropic else split.rotated(R)
        if not split.isotropic or c not in conditionals:
            conditionals = {c: Conditional(component, local)}
        conditional = conditionals[c]
        pull = (local.all @ component.mean[..., None])[..., 0]
        centre = component.mean + conditional.solve(shift[rows] @ R - pull)
        out[rows] = (centre + conditional.draw(component.draw(scores[rows]), unit[rows])) @ R.T
    return out


def _conditioned(
    components: Components, information: Information, shift: np.ndarray
) -> Iterator[tuple[int, slice, np.ndarray, Callable[[np.ndarray], np.ndarray]]]:
    """Yield per component: index, azimuths, their log terms (n, a), and a sum of weighted means."""
    if information.isotropic:
        # P does not depend on the azimuth: three base fields of η give all azimuths.
        fields = rotation_fields(shift.reshape(len(shift), -1, 3)).swapaxes(0, 1)
        fields = fields.reshape(3, *shift.shape)
        to_world = rotation_coefficients(components.yaws)
        to_canonical = rotation_coefficients(-components.yaws)
        for c, component in enumerate(components.gaussians):
            conditional = Conditional(component, information)
            terms, solved = _solve(component, conditional, information, fields, to_canonical)
            log_terms = terms + components.log_weights[c]

            def means(
                weights: np.ndarray, component: Component = component, solved: np.ndarray = solved
            ) -> np.ndarray:
                sums = (weights[:, None] * to_world.T) @ to_canonical  # (n, 3, 3)
                solved[2] += component.mean
                base = sums @ solved.reshape(3, len(weights), -1).swapaxes(0, 1)
                straight, turned, fixed = base.swapaxes(0, 1).reshape(solved.shape)
                x = straight[..., 0] + turned[..., 2]
                z = straight[..., 2] - turned[..., 0]
                return np.stack([x, fixed[..., 1], z], axis=-1)

            yield c, slice(None), log_terms, means
        return
    for a, yaw in enumerate(components.yaws):
        local = information.rotated(rotation(yaw))
        fields = turned(shift, -yaw)[None]
        for c, component in enumerate(components.gaussians):
            conditional = Conditional(component, local)
            terms, solved = _solve(component, conditional, local, fields, np.ones((1, 1)))
            clean = turned(solved[0] + component.mean, yaw)
            yield c, slice(a, a + 1), terms + components.log_weights[c], partial(_weighted, clean)


def _weighted(motions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return motions times weights: ``(n, L, J, 3), (n, 1) → (n, L, J, 3)``."""
    product: np.ndarray = weights[:, :, None, None] * motions
    return product


def _solve(
    component: Component,
    conditional: Conditional,
    information: Information,
    fields: np.ndarray,
    coefficients: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return log integrals for η = Σ_i c_i η_i and the conditional means of the fields.

    Parameters
    ----------
    fields : ndarray, (i, n, L, J, 3)
        η_i in the canonical frame.
    coefficients : ndarray, (a, i)
        c; the last coefficient is 1.

    Returns
    -------
    log_terms : ndarray, (n, a)
        log ∫ N(x; m, C) exp(−½ xᵀΛx + ηᵀx) dx.
    solved : ndarray, (i, n, L, J, 3)
        P η_i, the last with η − Λ m, so that Σ c_i P η_i = E[x] − m.
    """
    i, n = fields.shape[:2]
    pull = (information.all @ component.mean[..., None])[..., 0]
    linear = (fields.reshape(i, n, -1) @ component.mean.ravel()).T
    shifted = fields.copy()
    shifted[-1] -= pull
    solved = conditional.solve(shifted.reshape(i * n, *fields.shape[2:])).reshape(fields.shape)
    left, right = (part.reshape(i, n, -1).swapaxes(0, 1) for part in (shifted, solved))
    gram = left @ right.swapaxes(1, 2)
    square = ((coefficients @ gram) * coefficients).sum(axis=2)
    constant = -0.5 * float((component.mean * pull).sum()) - 0.5 * conditional.log_determinant
    return linear @ coefficients.T + 0.5 * square + constant, solved


class SpectralPosterior:
    """Posterior p(X | y) of a spectral mixture; the prior if there is no likelihood.

    Created by :meth:`SpectralMixtureMotion.exact_posterior` from the prior's components, its log
    density and mean (L, J, 3), and a likelihood with ``linear()``; raises ``NotConjugate`` for
    other likelihoods.
    """

    def __init__(
        self,
        components: Components,
        log_prior: Callable[[Array], Array],
        prior_mean: np.ndarray,
        likelihood: Likelihood | None,
    ) -> None:
        self.components = components
        self.likelihood = likelihood
        self._log_prior = log_prior
        self._prior_mean = prior_mean
        L, J, _ = prior_mean.shape
        seen = getattr(likelihood, "entries", None)
        if seen is not None and seen.confidence.shape[-2:] != (L, J):
            got = "{} frames of {} joints".format(*seen.confidence.shape[-2:])
            raise ValueError(f"likelihood must have {L} frames of {J} joints, got {got}")
        information, shift, self._constant = natural_parameters(likelihood, L * J)
        self.information = information.reshape(L, J, 3, 3)
        self.shift = shift.reshape(L, J, 3)

    @cached_property
    def _conditioned(self) -> tuple[np.ndarray, np.ndarray]:
        """Log joint density log p(y, c, a), (C, A), and E[X | y], (L, J, 3)."""
        if self.likelihood is None:
            parts = self.components
            return np.repeat(parts.log_weights[:, None], len(parts.yaws), axis=1), self._prior_mean
        log_joint, mean = condition(self.components, self.information, self.shift[None])
        return log_joint[0] + self._constant, mean[0]

    @property
    def log_marginal_likelihood(self) -> float:
        """Log marginal likelihood log p(y)."""
        return float(logsumexp(self._conditioned[0].reshape(-1)))

    @property
    def component_probabilities(self) -> np.ndarray:
        """Probabilities p(component c, azimuth a | y), (C, A)."""
        return np.exp(self._conditioned[0] - self.log_marginal_likelihood)

    def mean(self) -> np.ndarray:
        """Return E[X | y], (L, J, 3), metres."""
        return self._conditioned[1].copy()

    def covariances(self) -> np.ndarray:
        """Return the covariance matrix of each entry given y, (L, J, 3, 3), square metres."""
        probabilities = self.component_probabilities
        information = Information.of(self.information)
        mean = self.mean()
        total = np.zeros((*mean.shape, 3))
        for c, component in enumerate(self.components.gaussians):
            azimuths = np.flatnonzero(probabilities[c] > _NEGLIGIBLE)
            # With isotropic information, azimuths have the same covariance.
            for group in azimuths[None] if information.isotropic else azimuths[:, None]:
                if len(group) == 0:
                    continue
                rotations = np.stack([rotation(self.components.yaws[a]) for a in group])
                local = information if information.isotropic else information.rotated(rotations[0])
                conditional = Conditional(component, local)
                pull = (local.all @ component.mean[..., None])[..., 0]
                turns = rotations[:, None]
                solved = conditional.solve(self.shift @ turns - pull)
                difference = (component.mean + solved) @ turns.swapaxes(2, 3) - mean
                weights = probabilities[c, group]
                across = np.moveaxis(difference, 0, -1)
                total += (across * weights) @ across.swapaxes(2, 3)
                # Σ_a w_a R_a M R_aᵀ as one product with all entries of each M.
                turn = np.einsum("a,aij,akl->jlik", weights, rotations, rotations).reshape(9, 9)
                total += (conditional.marginals.reshape(-1, 9) @ turn).reshape(total.shape)
        return total

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n independent draws, (n, L, J, 3), metres."""
        log_joint = np.broadcast_to(self._conditioned[0], (n, *self._conditioned[0].shape))
        shift = np.broadcast_to(self.shift, (n, *self.shift.shape))
        return draw(self.components, self.information, shift, log_joint, rng)

    def log_density(self, positions: Array) -> Array:
        """Return log p(X | y), normalised: ``(…, L, J, 3) → (…)``; NumPy, torch or JAX."""
        value = self._log_prior(positions)
        if self.likelihood is None:
            return value
        evidence = self.log_marginal_likelihood
        return value + self.likelihood.log_density(positions) - evidence
