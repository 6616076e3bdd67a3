"""Tests of velocity-biased proposals and pseudo-marginal chains on a normal target.

The closest annotation, and with it the step size, depends on the sign of x₀ and of x₀ − 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import norm

from probmotion import MotionDraws, MotionPosterior, UnsupportedPosterior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.samplers import NUTS, MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic, VelocityBiased

POINT = Skeleton(["point"], [-1])
CHAINS, DRAWS, THIN = 40, 200, 12


@dataclass(frozen=True, eq=False)
class Point:
    """Prior of the position θ ~ N(0, 2² I) of one joint."""

    skeleton = POINT
    frames = 1
    fps = 30.0
    dim = 3

    def motion(self, theta):
        return theta[..., None, None, :]

    def log_density(self, theta):
        return -0.125 * (theta**2).sum(axis=-1)

    def initial(self, rng, n):
        return 2 * rng.standard_normal((n, 3))

    def coordinate_speeds(self, joint_speeds):
        return np.repeat(joint_speeds[..., 0, :1], 3, axis=-1) * np.array([1.0, 0.1, 0.0])


@dataclass(frozen=True, eq=False)
class Annotations:
    """Likelihood log L = −(x₀ − 1)²/2, with estimates whose noise depends on x₀."""

    noise: float = 0.0
    unbiased: bool = True
    differentiable = False

    def evaluate(self, positions, generators=None):
        x = positions[..., 0, 0, 0]
        log_density = -0.5 * (x - 1) ** 2
        if generators is not None:
            size = self.noise * (x > 1)
            error = size * np.array([rng.standard_normal() for rng in generators])
            log_density = log_density + error - (0.5 * size**2 if self.unbiased else 0)
        return log_density, np.stack([x > 1, x > 0], axis=-1).astype(int)

    def joint_speeds(self, closest):
        return np.repeat(np.where(closest, 9.0, 0.01)[..., None, None], 2, axis=-1).mean(axis=-3)

    def log_density(self, positions):
        return self.evaluate(positions)[0]

    def simulate(self, rng, positions):
        return self


class WithoutRatio(VelocityBiased):
    """Velocity-biased steps without the ratio of proposal densities."""

    def log_ratio(self, theta, guide, proposed, proposed_guide, state):
        return np.zeros(len(theta))


def moments(sampler, likelihood):
    """Return the errors of the mean and variance of x₀ in standard errors."""
    posterior = MotionPosterior(Point(), likelihood)
    rng = np.random.default_rng(0)
    # Start from exact draws: the precision of x₀ is 1/4 + 1 and its mean 1/1.25.
    start = np.column_stack(
        [0.8 + np.sqrt(0.8) * rng.standard_normal(CHAINS), 2 * rng.standard_normal((CHAINS, 2))]
    )
    draws = sampler.sample(posterior, draws=DRAWS, chains=CHAINS, initial=start, progress=False)
    x = draws.dataset["theta"].values[..., 0]
    pairs = np.stack([x, (x - 0.8) ** 2]).mean(axis=2)
    return np.abs(pairs.mean(axis=1) - 0.8) / (pairs.std(axis=1, ddof=1) / np.sqrt(CHAINS))


def mh(proposal, **settings):
    return MetropolisHastings(proposal=proposal, warmup=0, thin=THIN, **settings)


STEPS = {"scale": 1.0, "base": 0.3, "bias": 1.0, "target": None}
# Each of two scores exceeds 4 with probability 1e-4 for a correct chain.
LIMIT = 4.0


def test_velocity_biased_chains_have_the_correct_moments():
    assert moments(mh(VelocityBiased(**STEPS)), Annotations()).max() < LIMIT


def test_moments_detect_a_missing_proposal_ratio():
    assert moments(mh(WithoutRatio(**STEPS)), Annotations()).max() > 2 * LIMIT


@pytest.mark.parametrize("proposal", [Isotropic(1.0, None), VelocityBiased(**STEPS)])
def test_pseudo_marginal_chains_have_the_correct_moments(proposal):
    sampler = mh(proposal, pseudo_marginal=True)
    assert moments(sampler, Annotations(noise=0.7)).max() < LIMIT


def test_moments_detect_a_biased_estimate():
    sampler = mh(Isotropic(1.0, None), pseudo_marginal=True)
    assert moments(sampler, Annotations(noise=1.2, unbiased=False)).max() > 2 * LIMIT


def test_log_ratio_is_that_of_the_normal_densities():
    proposal = VelocityBiased(scale=0.7, base=0.2, bias=2.0)
    rng = np.random.default_rng(1)
    theta, proposed, guide, other = rng.random((4, 5, 3))
    state = proposal.begin(theta)
    forward, backward = (0.7 * np.sqrt(0.04 + 2 * g) for g in (guide, other))
    expected = norm.logpdf(theta, proposed, backward) - norm.logpdf(proposed, theta, forward)
    ratio = proposal.log_ratio(theta, guide, proposed, other, state)
    np.testing.assert_allclose(ratio, expected.sum(axis=1))


def test_continuing_equals_one_run(tmp_path):
    sampler = MetropolisHastings(proposal=VelocityBiased(), warmup=30, thin=2, pseudo_marginal=True)
    posterior = MotionPosterior(Point(), Annotations(noise=0.5))
    complete = sampler.sample(posterior, draws=20, chains=3, progress=False)
    sampler.sample(posterior, draws=8, chains=3, progress=False).save(tmp_path / "first.nc")
    first = MotionDraws.load(tmp_path / "first.nc")
    rest = sampler.sample(posterior, draws=12, chains=3, initial=first, progress=False)
    theta = [run.dataset["theta"].values for run in (first, rest)]
    np.testing.assert_array_equal(np.concatenate(theta, axis=1), complete.dataset["theta"])


def test_pseudo_marginal_chains_are_independent():
    """Proposals outside the support of the prior draw no views."""

    class Bounded(Point):
        def log_density(self, theta):
            return np.where(np.abs(theta).max(axis=-1) < 2, 0.0, -np.inf)

    posterior = MotionPosterior(Bounded(), Annotations(noise=0.5))
    sampler = mh(Isotropic(1.5, None), pseudo_marginal=True)
    start = np.zeros((4, 3))
    batch = sampler.sample(posterior, draws=20, chains=4, initial=start, progress=False)
    single = sampler.sample(posterior, draws=20, chains=1, initial=start[:1], progress=False)
    assert float(batch.dataset["acceptance_rate"].mean()) < 0.6
    for name in ("theta", "log_density"):
        assert np.array_equal(*(run.dataset[name].values[0] for run in (batch, single)))


def test_estimates_of_another_posterior_are_not_continued():
    class Steeper(Annotations):
        def evaluate(self, positions, generators=None):
            log_density, closest = super().evaluate(positions, generators)
            return 3 * log_density - 1, closest

    sampler = mh(Isotropic(1.0, None), pseudo_marginal=True)
    posterior, other = (MotionPosterior(Point(), kind(0.5)) for kind in (Annotations, Steeper))
    first = sampler.sample(posterior, draws=3, progress=False)
    with pytest.raises(ValueError, match="initial must be a run of the same posterior"):
        sampler.sample(other, draws=3, initial=first, progress=False)


def test_unsupported_likelihoods_are_refused(two_modes):
    for sampler in (mh(VelocityBiased()), mh(Isotropic(), pseudo_marginal=True)):
        with pytest.raises(UnsupportedPosterior, match="likelihood that implements ComparesViews"):
            sampler.sample(MotionPosterior(two_modes), draws=2, progress=False)
    with pytest.raises(
        UnsupportedPosterior, match="which Annotations does not have; try ensemble, mh"
    ):
        NUTS().sample(MotionPosterior(Point(), Annotations()), draws=2, progress=False)
    posterior = TruncatedPosterior(Point(), Annotations(noise=0.5), limit=100)
    with pytest.raises(ValueError, match="limit must be infinite"):
        mh(Isotropic(), pseudo_marginal=True).sample(posterior, draws=2, progress=False)
