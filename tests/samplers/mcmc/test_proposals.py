"""Tests of symmetric proposals and their adaptation."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import MotionPosterior
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import AdaptiveCovariance, Isotropic


def test_adaptive_covariance_learns_the_covariance_of_the_chain():
    """For independent points C Cᵀ converges to their covariance, and s is 2.38/√dim."""
    rng = np.random.default_rng(0)
    covariance = np.array([[4.0, 1.5, 0.0], [1.5, 1.0, 0.1], [0.0, 0.1, 0.05]])
    root = np.linalg.cholesky(covariance)
    proposal = AdaptiveCovariance()
    state = proposal.begin(np.zeros((2, 3)))
    for _ in range(50 + 100 + 200 + 400 + 800 + 1600):
        points = 7.0 + rng.standard_normal((2, 3)) @ root.T
        state = proposal.learn(state, points, np.full(2, proposal.target))
    np.testing.assert_allclose(np.exp(state["log_scale"]), 2.38 / np.sqrt(3))
    for learnt in state["root"] @ state["root"].swapaxes(1, 2):
        np.testing.assert_allclose(learnt, covariance, atol=5 * 4.0 * np.sqrt(2 / 1600))
        white = np.linalg.solve(root, np.linalg.solve(root, learnt).T)
        np.testing.assert_allclose(white, np.eye(3), atol=5 * np.sqrt(2 / 1600))


def test_a_chain_that_never_moved_has_a_valid_covariance():
    proposal = AdaptiveCovariance()
    state = proposal.begin(np.zeros((1, 3)))
    for _ in range(50):
        state = proposal.learn(state, np.zeros((1, 3)), np.zeros(1))
    proposed = proposal.propose(
        [np.random.default_rng(0)], np.zeros((1, 3)), np.empty((1, 0)), state
    )
    assert np.isfinite(proposed).all()
    assert (proposed != 0).all()


@pytest.mark.parametrize("proposal", [Isotropic(target=0.4), AdaptiveCovariance(target=0.4)])
def test_warm_up_reaches_the_target_acceptance(two_modes, proposal):
    sampler = MetropolisHastings(proposal=proposal, warmup=1500, thin=1)
    draws = sampler.sample(MotionPosterior(two_modes), draws=1000, chains=8, progress=False)
    chains = draws.dataset["acceptance_rate"].values.mean(axis=1)
    # After Robbins-Monro steps of size n^(−0.6) log s has a spread of about n^(−0.3).
    assert np.abs(chains.mean() - 0.4) < 0.04
    assert np.abs(chains - 0.4).max() < 0.12


def test_no_target_disables_the_adaptation():
    proposal = Isotropic(scale=0.25, target=None)
    state = proposal.begin(np.zeros((3, 2)))
    state = proposal.learn(state, np.zeros((3, 2)), np.ones(3))
    np.testing.assert_allclose(np.exp(state["log_scale"]), 0.25)
