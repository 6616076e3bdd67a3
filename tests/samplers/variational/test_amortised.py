"""Tests of amortised inference: exact posteriors, reproducibility, principal coordinates, loss."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, MotionPosterior, UnsupportedPosterior
from probmotion.metrics.distribution import mean_error, trace_ratio
from probmotion.samplers.variational.amortised import AmortisedPosterior, AmortisedSettings
from probmotion.samplers.variational.amortised_network import ConditionalVAE
from probmotion.samplers.variational.simulated_pairs import (
    MotionCoordinates,
    PrincipalCoordinates,
    SimulatedPairs,
    observed_entries,
    simulate_pairs,
)
from probmotion.seeds import NormalStreams

SMALL = AmortisedSettings(
    steps=800, pairs=8000, latent=6, components=8, experts=4, hidden=48, learning_rate=5e-3
)
QUICK = replace(SMALL, steps=30, pairs=600)


def streams(n, seed=0):
    return NormalStreams.of_draws(seed, [(0, i) for i in range(n)])


def draw(posterior, settings=SMALL, n=2000, seed=0):
    fitted = AmortisedPosterior.fit(posterior, settings, seed, False)
    return fitted.draw(streams(n))


def smooth_gaussian(gaussian_motion, frames=6, joints=2):
    """Return a Gaussian with three smooth directions and small noise."""
    rng = np.random.default_rng(3)
    D = frames * joints * 3
    factor = rng.standard_normal((D, 3)) * np.array([1.0, 0.5, 0.2])
    mean = rng.standard_normal((frames, joints, 3))
    return gaussian_motion(mean, factor @ factor.T + 0.05**2 * np.eye(D))


@pytest.mark.parametrize(
    "observed",
    [
        "joints",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("none", "keypoints", "occluded")),
    ],
)
def test_linear_gaussian_posteriors_are_learnt(gaussian_motion, observed):
    prior = smooth_gaussian(gaussian_motion)
    truth = prior.sample(np.random.default_rng(1), 1)[0]
    rng = np.random.default_rng(2)
    confidence = np.ones(truth.shape[:2])
    if observed == "occluded":
        confidence[1:5, 1] = 0
    likelihood, mean, covariance = None, prior.mean, prior.covariance
    if observed == "joints":
        likelihood = Joints3D(truth, 0.1).simulate(rng, truth)
    elif observed != "none":
        blank, camera = np.zeros((1, *truth.shape[:2], 2)), Cameras.around([0.4], [0.2])
        likelihood = Keypoints2D(blank, camera, 0.1, confidence[None]).simulate(rng, truth)
    if likelihood is not None:
        mean, covariance = prior.posterior(likelihood)
    draws = draw(MotionPosterior(prior, likelihood)).reshape(2000, -1)
    exact = np.random.default_rng(5).multivariate_normal(mean.ravel(), covariance, 4000)
    assert mean_error(draws, exact) < 0.2
    assert 0.8 < trace_ratio(draws, exact) < 1.25
    variance, axes = np.linalg.eigh(covariance)
    ratio = ((draws @ axes).var(axis=0) / variance)[-3:]
    assert (ratio > 0.6).all()
    assert (ratio < 1.6).all()


@pytest.mark.slow
def test_modes_are_drawn_in_proportion_to_their_mass(gaussian_motion):
    class TwoDepths(gaussian_motion):
        """Prior of one joint with depth ±1, which a frontal view does not determine."""

        def sample(self, rng, n):
            positions = 0.05 * rng.standard_normal((n, 3, 1, 3))
            positions += rng.standard_normal((n, 1, 1, 3)) * np.array([1.0, 1.0, 0.1])
            positions[..., 2] += rng.choice([-1.0, 1.0], size=(n, 1, 1), p=[0.3, 0.7])
            return positions

    prior = TwoDepths(np.zeros((3, 1, 3)), np.eye(9))
    likelihood = Keypoints2D(np.zeros((1, 3, 1, 2)), Cameras.around([0.0], [0.0]), 0.1)
    settings = replace(SMALL, steps=1600)
    depth = draw(MotionPosterior(prior, likelihood), settings)[..., 0, 2].mean(axis=1)
    assert abs((depth > 0).mean() - 0.7) < 0.1
    between = np.abs(depth) < 0.5
    assert between.mean() < 0.05
    for sign in (-1, 1):
        mode = depth[np.sign(depth) == sign]
        assert abs(np.median(mode) - sign) < 0.1
        assert 0.06 < np.std(mode[np.abs(mode) > 0.5]) < 0.16


def test_training_is_reproducible_and_changes_no_global_state(gaussian_motion, monkeypatch):
    posterior = MotionPosterior(smooth_gaussian(gaussian_motion))
    threads, loss = [], ConditionalVAE.loss

    def spy(*arguments):
        threads.append(torch.get_num_threads())
        return loss(*arguments)

    monkeypatch.setattr(ConditionalVAE, "loss", spy)
    numpy_state = np.random.get_state()[1].copy()  # noqa: NPY002
    before = torch.get_rng_state()
    try:
        torch.set_num_threads(2)
        first = draw(posterior, QUICK, n=4)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert set(threads) == {1}
    assert torch.equal(torch.get_rng_state(), before)
    assert np.array_equal(np.random.get_state()[1], numpy_state)  # noqa: NPY002
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(6)
        np.testing.assert_array_equal(draw(posterior, QUICK, n=4), first)
    assert not np.allclose(draw(posterior, QUICK, n=4, seed=1), first)


def test_pairs_are_simulated_from_the_likelihood(gaussian_motion):
    prior = smooth_gaussian(gaussian_motion)
    confidence = np.ones((2, 6, 2))
    confidence[0, 2, 1] = 0
    blank = np.zeros((2, 6, 2, 2))
    cameras = Cameras.ring(2)
    likelihood = Keypoints2D(blank, cameras, 0.03, confidence)
    pairs = list(simulate_pairs(MotionPosterior(prior, likelihood), 0, 2500))
    assert [len(chunk.positions) for chunk in pairs] == [2000, 500]
    observed = np.concatenate([chunk.observed for chunk in pairs])
    positions = np.concatenate([chunk.positions for chunk in pairs])
    assert observed.shape == (2500, 6, 8)
    keypoints = observed.reshape(2500, 6, 2, 2, 2)
    assert np.all(keypoints[:, 2, 0, 1] == 0)
    noise = np.moveaxis(keypoints, 2, 1) - cameras.project(positions)
    noise[:, 0, 2, 1] = np.nan
    assert np.nanstd(noise) == pytest.approx(0.03, rel=0.02)
    entries = observed_entries(likelihood, 6).reshape(6, 2, 2, 2)
    np.testing.assert_array_equal(np.moveaxis(entries, 1, 0), likelihood.keypoints)


def test_principal_coordinates_and_their_complement_sum_to_the_values():
    rng = np.random.default_rng(0)
    values = rng.standard_normal((50, 4, 2, 3)) @ rng.standard_normal((3, 3))
    basis = PrincipalCoordinates.of(values, 5)
    x = basis.coordinates(values)
    np.testing.assert_allclose(x.T @ x / 50, np.eye(5), atol=1e-9)
    flat = values.reshape(50, -1)
    complement = basis.without(flat - basis.mean)
    np.testing.assert_allclose(basis.values(x) + complement, flat, atol=1e-12)
    np.testing.assert_allclose(basis.coordinates(basis.values(x) + complement), x, atol=1e-9)
    constant = np.concatenate([values[..., :2], np.zeros((50, 4, 2, 1))], axis=-1)
    assert len(PrincipalCoordinates.of(constant, 100).deviation) == 16


def test_the_remainder_is_the_gaussian_conditional():
    """For X = c a + e, e ~ N(0, δ²), y = X + noise, E[e | y, c] = δ²/(δ² + σ²) (y − c a)."""
    rng = np.random.default_rng(0)
    n, delta, sigma = 40_000, 0.1, 0.2
    axis = rng.standard_normal((5, 2, 3))
    axis /= np.linalg.norm(axis)
    positions = 3 * rng.standard_normal((n, 1, 1, 1)) * axis
    positions += delta * rng.standard_normal(positions.shape)
    observed = (positions + sigma * rng.standard_normal(positions.shape)).reshape(n, 5, 6)
    y = np.zeros((n, 0))
    motions = MotionCoordinates.learn(SimulatedPairs(positions, observed), y, 1)
    expected = delta**2 / (delta**2 + sigma**2)
    np.testing.assert_allclose(motions.gain, expected * np.eye(6)[None].repeat(5, 0), atol=0.05)
    x = motions.coordinates(positions[:1], y[:1]).repeat(4000, 0)
    flat = motions.motions(x, y[:4000], observed[0], rng.standard_normal((4000, 5, 6)))
    np.testing.assert_allclose(motions.coordinates(flat, y[:4000]), x, atol=1e-9)
    spread = np.sum(flat.var(axis=0)) / 29
    assert spread == pytest.approx(delta**2 * sigma**2 / (delta**2 + sigma**2), rel=0.05)


def test_loss_is_the_evidence_lower_bound():
    """Compare with torch.distributions, up to constants."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = ConditionalVAE(4, 3, 2, 5, 3, 8)
        for weights in network.parameters():
            weights.data += 0.3 * torch.randn_like(weights)
        x, y, noise = torch.randn(6, 4), torch.randn(6, 3), torch.randn(6, 2)
    normal, constant = torch.distributions.Normal, 0.5 * math.log(2 * math.pi)
    mean, log_scale = network.encode(x, y)
    r = normal(mean, log_scale.exp())
    z = mean + log_scale.exp() * noise
    log_weight, means, log_scales = network.prior(y)
    p = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(logits=log_weight),
        torch.distributions.Independent(normal(means, log_scales.exp()), 1),
    )
    d = normal(network.decode(z, y), network.log_scale.exp()).log_prob(x).sum(1) + 4 * constant
    kl = r.log_prob(z).sum(1) - p.log_prob(z)
    for weight in (0.1, 1.0):
        expected = (-d + weight * kl).mean()
        torch.testing.assert_close(network.loss(x, y, noise, weight), expected)


def test_divergence_and_infinite_variance_are_errors(gaussian_motion):
    posterior = MotionPosterior(smooth_gaussian(gaussian_motion))
    with pytest.raises(
        ValueError, match=r"diverged at step \d+ with learning_rate 1e\+30; use a sm"
    ):
        draw(posterior, replace(QUICK, learning_rate=1e30))
    outliers = Joints3D(np.zeros((2, 1, 3)), 0.1, degrees_of_freedom=2.0)
    with pytest.raises(UnsupportedPosterior, match=r"than 2 degrees of freedom .*, got 2"):
        observed_entries(outliers, 2)
