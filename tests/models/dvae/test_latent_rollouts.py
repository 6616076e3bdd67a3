"""Latent rollouts on a linear-Gaussian model, where the optimal bound is log p(y)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion.models.dvae.latent_rollouts import rollout
from probmotion.models.dvae.variational_terms import log_normal

T, N = 5, 20_000
A, Q, NOISE = np.array([0.9, -0.6]), np.array([0.5, 0.8]), 0.4
# Orthogonal columns make the exact conditionals diagonal, like q.
C = np.array([[1.0, 0.5], [0.4, -0.8], [0.0, 0.3]])
C[2, 0] = -(C[:2, 0] @ C[:2, 1]) / C[2, 1]
START = np.array([0.7, -1.2])
Y = np.random.default_rng(0).normal(size=(T, 3)) + 0.5
# The moments of all z follow from z_t − a z_{t−1} = q ε_t.
INVERSE = np.linalg.inv(np.eye(2 * T) - np.diag(np.tile(A, T - 1), -2))
MEAN = INVERSE[:, :2] @ (A * START)
COVARIANCE = INVERSE * np.tile(Q**2, T) @ INVERSE.T


class Walk:
    """Generative model z_t = a z_{t−1} + q ε, z₀ = x₀."""

    def start(self, initial):
        return initial

    def priors(self, states):
        means = torch.stack([state * torch.tensor(A) for state in states], 1)
        return means, torch.tensor(np.log(Q)).expand_as(means)

    def step(self, state, latent):
        return latent


class ExactPosterior:
    """Inference by q(z_t | z_{t−1}, y_{t:T}) = N(gain_t z_{t−1} + offset_t, scale_t²)."""

    def __init__(self):
        """Run a backward information filter."""
        information, shift = np.zeros(2), np.zeros(2)
        self.gain, self.offset, self.scale = torch.zeros((3, T, 2), dtype=torch.float64)
        for t in reversed(range(T)):
            # Update precision and precision times mean from p(y_{t+1:T} | z_t) to p(y_{t:T} | z_t).
            spread = 1 + Q**2 * information
            information, shift = A**2 * information / spread, A * shift / spread
            information = information + (C**2).sum(0) / NOISE**2
            shift = shift + Y[t] @ C / NOISE**2
            precision = 1 / Q**2 + information
            self.gain[t] = torch.tensor(A / Q**2 / precision)
            self.offset[t] = torch.tensor(shift / precision)
            self.scale[t] = torch.tensor(precision**-0.5)

    def start(self, initial):
        return initial

    def posterior(self, state, frame, generative_state):
        assert torch.equal(generative_state, state)
        mean = self.gain[frame - 1] * state + self.offset[frame - 1]
        return mean, self.scale[frame - 1].log().expand_as(mean)

    def step(self, state, latent):
        return latent


def standard(n=N):
    return torch.tensor(np.random.default_rng(1).standard_normal((n, T, 2)))


def initial(n=N):
    return torch.tensor(START).expand(n, 2)


def test_bound_at_exact_posterior_is_log_marginal_likelihood():
    """The bound is E_q[log p(y | z)] − KL, as in `Denoiser.bound`."""
    result = rollout(Walk(), initial(), standard(), ExactPosterior())
    residual = torch.tensor(Y) - result.latents @ torch.tensor(C.T)
    bounds = (log_normal(residual, NOISE).sum((1, 2)) - result.kl).numpy()
    observe = np.kron(np.eye(T), C)
    spread = observe @ COVARIANCE @ observe.T + NOISE**2 * np.eye(3 * T)
    log_marginal = stats.multivariate_normal.logpdf(Y.ravel(), observe @ MEAN, spread)
    error = bounds.std() / math.sqrt(N)
    assert bounds.mean() == pytest.approx(log_marginal, abs=5 * error)
    assert error < 0.03


def test_innovations_reproduce_the_latents_without_inference():
    """Innovations are the standard normal coordinates of the prior."""
    result = rollout(Walk(), initial(7), standard(7), ExactPosterior())
    again = rollout(Walk(), initial(7), result.innovations)
    torch.testing.assert_close(again.latents, result.latents)
    assert torch.equal(again.innovations, result.innovations)
    assert torch.equal(again.kl, torch.zeros(7, dtype=torch.float64))
    assert len(again.states) == T
    torch.testing.assert_close(again.states[-1], result.states[-1])


def test_draws_without_inference_follow_the_prior():
    drawn = rollout(Walk(), initial(), standard()).latents.flatten(1).numpy()
    deviation = np.sqrt(np.diag(COVARIANCE))
    assert (abs(drawn.mean(0) - MEAN) / deviation).max() < 5 / math.sqrt(N)
    error = abs(np.cov(drawn.T) - COVARIANCE) / np.outer(deviation, deviation)
    assert error.max() < 5 * math.sqrt(2 / N)
    means = rollout(Walk(), initial(1), torch.zeros(1, T, 2, dtype=torch.float64)).latents
    np.testing.assert_allclose(means.ravel(), MEAN)
