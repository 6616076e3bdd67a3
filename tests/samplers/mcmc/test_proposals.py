"""Tests of symmetric proposals: detailed balance, independence of chains, adaptation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from scipy.stats import norm

from probmotion import MotionPosterior
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import AdaptiveCovariance, Isotropic

CHAINS = 8_000


@dataclass(frozen=True)
class DriftingStep:
    """θ' ~ N(θ + d, s² I), an asymmetric proposal."""

    guided: ClassVar[bool] = False

    corrected: bool = True
    drift: float = 0.3
    scale: float = 0.6

    def begin(self, theta):
        return {}

    def propose(self, generators, theta, guide, state):
        noise = np.stack([rng.standard_normal(theta.shape[1]) for rng in generators])
        return theta + self.drift + self.scale * noise

    def log_ratio(self, theta, guide, proposed, proposed_guide, state):
        if not self.corrected:
            return np.zeros(len(theta))
        # log N(−step | d, s²) − log N(step | d, s²)
        return -2 * self.drift * (proposed - theta).sum(axis=1) / self.scale**2

    def learn(self, state, theta, acceptance):
        return state

    def settled(self, state):
        return state


def worst_imbalance(prior, proposal):
    """Count transitions between quartiles along (1, 1, 1) in one step of chains from the target.

    Under detailed balance N(A → B) and N(B → A) have the same mean. Returns the largest of
    |N(A → B) − N(B → A)| / √(N(A → B) + N(B → A)), each about standard normal.
    """
    start = prior.initial(np.random.default_rng(1), CHAINS)
    sampler = MetropolisHastings(proposal=proposal, warmup=0, thin=1)
    draws = sampler.sample(
        MotionPosterior(prior), draws=1, chains=CHAINS, initial=start, progress=False
    )
    end = draws.dataset["theta"].values[:, 0]

    edges = np.quantile(start.sum(axis=1), np.arange(1, 4) / 4)
    flow = np.zeros((4, 4))
    np.add.at(flow, tuple(np.digitize(theta.sum(axis=1), edges) for theta in (start, end)), 1)
    both = flow + flow.T
    np.fill_diagonal(both, 0)
    counted = both > 20
    assert counted.sum() >= 8
    return (np.abs(flow - flow.T)[counted] / np.sqrt(both[counted])).max()


# Family-wise failure rate 1e-3 over four two-sided tests of 6 pairs.
LIMIT = norm.isf(1e-3 / 4 / 12)


@pytest.mark.parametrize(
    "proposal",
    [Isotropic(scale=0.8), AdaptiveCovariance(scale=0.8), DriftingStep()],
    ids=["isotropic", "adaptive", "asymmetric"],
)
def test_one_step_satisfies_detailed_balance(two_modes, proposal):
    assert worst_imbalance(two_modes, proposal) < LIMIT


def test_detailed_balance_detects_a_missing_proposal_ratio(two_modes):
    assert worst_imbalance(two_modes, DriftingStep(corrected=False)) > LIMIT


def generators(chains, seed=0):
    return [np.random.default_rng([seed, chain]) for chain in range(chains)]


@pytest.mark.parametrize("proposal", [Isotropic(), AdaptiveCovariance()])
def test_chains_propose_independently(proposal):
    theta = np.random.default_rng(0).normal(size=(5, 4))
    acceptance = np.linspace(0.1, 0.9, 5)

    def run(chains):
        streams, at = generators(chains), theta[:chains]
        state = proposal.begin(at)
        for _ in range(120):  # more than the first window
            at = proposal.propose(streams, at, np.empty((chains, 0)), state)
            state = proposal.learn(state, at, acceptance[:chains])
        return at

    np.testing.assert_array_equal(run(5)[:2], run(2))


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
    proposed = proposal.propose(generators(1), np.zeros((1, 3)), np.empty((1, 0)), state)
    assert np.isfinite(proposed).all()
    assert (proposed != 0).all()


@pytest.mark.parametrize("proposal", [Isotropic(target=0.4), AdaptiveCovariance(target=0.4)])
def test_warm_up_reaches_the_target_acceptance(two_modes, proposal):
    sampler = MetropolisHastings(proposal=proposal, warmup=1500, thin=1)
    draws = sampler.sample(MotionPosterior(two_modes), draws=1000, chains=8, progress=False)
    chains = draws.dataset["acceptance"].values.mean(axis=1)
    # Robbins-Monro steps of size n^(−0.6) leave log s with a spread of about n^(−0.3).
    assert np.abs(chains.mean() - 0.4) < 0.04
    assert np.abs(chains - 0.4).max() < 0.12


def test_no_target_disables_the_adaptation():
    proposal = Isotropic(scale=0.25, target=None)
    state = proposal.begin(np.zeros((3, 2)))
    state = proposal.learn(state, np.zeros((3, 2)), np.ones(3))
    np.testing.assert_allclose(np.exp(state["log_scale"]), 0.25)
