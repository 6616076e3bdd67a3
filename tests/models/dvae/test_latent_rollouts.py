"""Latent rollouts on a linear-Gaussian model, where the optimal bound is log p(y)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Normal, kl_divergence

from probmotion.models.dvae.latent_rollouts import rollout
from probmotion.models.dvae.variational_terms import log_normal

T, N = 5, 20_000
A, Q, NOISE = np.array([0.9, -0.6]), np.array([0.5, 0.8]), 0.4
# Orthogonal columns make the exact conditionals diagonal, like q.
C = np.array([[1.0, 0.5], [0.4, -0.8], [0.0, 0.3]])
C[2, 0] = -(C[:2, 0] @ C[:2, 1]) / C[2, 1]
START = np.array([0.7, -1.2])
Y = np.random.default_rng(0).normal(size=(T, 3)) + 0.5


class Walk:
    """z_t = a z_{t−1} + q ε, z₀ = x₀."""

    def start(self, initial):
        return initial

    def priors(self, states):
        means = torch.stack([state * torch.tensor(A) for state in states], 1)
        return means, torch.tensor(np.log(Q)).expand_as(means)

    def step(self, state, latent):
        return latent


class Linear:
    """q(z_t | z_{t−1}) = N(gain_t z_{t−1} + offset_t, scale_t²)."""

    def __init__(self, gain, offset, log_scale):
        self.gain, self.offset, self.log_scale = gain, offset, log_scale

    def start(self, initial):
        return initial

    def posterior(self, state, frame, moved):
        assert torch.equal(moved, state)
        mean = self.gain[frame - 1] * state + self.offset[frame - 1]
        return mean, self.log_scale[frame - 1].expand_as(mean)

    def step(self, state, latent):
        return latent


def exact():
    """Return q(z_t | z_{t−1}, y_{t:T}) by a backward information filter."""
    information, shift = np.zeros(2), np.zeros(2)
    gain, offset, scale = np.zeros((3, T, 2))
    for t in reversed(range(T)):
        # Precision and precision times mean of p(y_{t+1:T} | z_t), then of p(y_{t:T} | z_t).
        spread = 1 + Q**2 * information
        information, shift = A**2 * information / spread, A * shift / spread
        information = information + (C**2).sum(0) / NOISE**2
        shift = shift + Y[t] @ C / NOISE**2
        precision = 1 / Q**2 + information
        gain[t], offset[t], scale[t] = A / Q**2 / precision, shift / precision, precision**-0.5
    return Linear(*(torch.tensor(value) for value in (gain, offset, np.log(scale))))


def joint():
    """Return mean and covariance of all z, and the observation matrix."""
    mean = np.concatenate([A ** (t + 1) * START for t in range(T)])
    covariance = np.zeros((2 * T, 2 * T))
    for t in range(T):
        for s in range(T):
            for d in range(2):
                shared = sum(
                    A[d] ** (t - u) * A[d] ** (s - u) * Q[d] ** 2 for u in range(min(t, s) + 1)
                )
                covariance[2 * t + d, 2 * s + d] = shared
    observe = np.kron(np.eye(T), C)
    return mean, covariance, observe


def log_marginal_likelihood():
    mean, covariance, observe = joint()
    spread = observe @ covariance @ observe.T + NOISE**2 * np.eye(3 * T)
    return stats.multivariate_normal.logpdf(Y.ravel(), observe @ mean, spread)


def bounds(q, noise):
    """Return E_q[log p(y | z)] − KL for every draw, as in `Denoiser.bound`."""
    start = torch.tensor(START).expand(len(noise), 2)
    rolled = rollout(Walk(), start, noise, q)
    residual = torch.tensor(Y) - rolled.latents @ torch.tensor(C.T)
    return log_normal(residual, NOISE).sum((1, 2)) - rolled.kl


def standard(n=N, seed=1):
    return torch.tensor(np.random.default_rng(seed).standard_normal((n, T, 2)))


def test_bound_at_exact_posterior_is_log_marginal_likelihood():
    found = bounds(exact(), standard()).numpy()
    assert found.mean() == pytest.approx(
        log_marginal_likelihood(), abs=5 * found.std() / math.sqrt(N)
    )
    assert found.std() / math.sqrt(N) < 0.03


@pytest.mark.parametrize("name", ["gain", "offset", "log_scale"])
@pytest.mark.parametrize("frame", [0, T - 1])
@pytest.mark.parametrize("change", [-0.2, 0.2])
def test_perturbed_q_has_a_lower_bound(name, frame, change):
    """The gap is KL(q ‖ posterior), which is known at the last frame."""
    best, other = exact(), exact()
    getattr(other, name)[frame, 0] += change
    less = (bounds(best, standard()) - bounds(other, standard())).numpy()
    error = less.std() / math.sqrt(N)
    assert less.mean() > 5 * error
    if frame == T - 1:
        scale = math.exp(float(best.log_scale[-1, 0]))
        if name == "offset":
            assert less.mean() == pytest.approx(0.5 * (change / scale) ** 2, abs=5 * error)
        elif name == "log_scale":
            wanted = 0.5 * (math.exp(2 * change) - 1) - change
            assert less.mean() == pytest.approx(wanted, abs=5 * error)


def test_divergence_matches_torch_at_every_frame():
    q, start = exact(), torch.tensor(START).expand(7, 2)
    rolled = rollout(Walk(), start, standard(7), q)
    before, wanted = start, torch.zeros(7, dtype=torch.float64)
    for t in range(T):
        mean = q.gain[t] * before + q.offset[t]
        p = Normal(torch.tensor(A) * before, torch.tensor(Q))
        wanted += kl_divergence(Normal(mean, q.log_scale[t].exp()), p).sum(-1)
        before = rolled.latents[:, t]
        torch.testing.assert_close(before, mean + q.log_scale[t].exp() * standard(7)[:, t])
    torch.testing.assert_close(rolled.kl, wanted)


def test_innovations_reproduce_the_latents_without_inference():
    """Innovations are the standard normal coordinates of the prior."""
    start = torch.tensor(START).expand(7, 2)
    rolled = rollout(Walk(), start, standard(7), exact())
    again = rollout(Walk(), start, rolled.innovations)
    torch.testing.assert_close(again.latents, rolled.latents)
    assert torch.equal(again.innovations, rolled.innovations)
    assert torch.equal(again.kl, torch.zeros(7, dtype=torch.float64))
    assert len(again.states) == T
    torch.testing.assert_close(again.states[-1], rolled.states[-1])


def test_draws_without_inference_follow_the_prior():
    mean, covariance, _ = joint()
    start = torch.tensor(START).expand(N, 2)
    drawn = rollout(Walk(), start, standard()).latents.flatten(1).numpy()
    deviation = np.sqrt(np.diag(covariance))
    assert (abs(drawn.mean(0) - mean) / deviation).max() < 5 / math.sqrt(N)
    off = abs(np.cov(drawn.T) - covariance) / np.outer(deviation, deviation)
    assert off.max() < 5 * math.sqrt(2 / N)
    means = rollout(Walk(), start[:1], torch.zeros(1, T, 2, dtype=torch.float64)).latents
    np.testing.assert_allclose(means.ravel(), mean)
