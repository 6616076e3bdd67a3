"""A prior that is a network, which torch and NumPy read but not JAX, under all that it fits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import norm

from probmotion import Joints3D, MotionPosterior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import suited
from probmotion.samplers import NUTS, Ensemble, MetropolisHastings, ScoreDistillation

CHAINS = {
    "nuts": (NUTS(warmup=150, candidates=200), 200, 2),
    "mh": (MetropolisHastings(warmup=1000, thin=8), 1500, 4),
    "ensemble": (Ensemble(walkers=24, warmup=300, thin=8), 24 * 120, 4),
}
DIM = 6
# Mean and variance of all coordinates by each sampler: by chance one in a thousand seeds fails.
LIMIT = norm.isf(1e-3 / (2 * DIM * len(CHAINS)) / 2)

pytestmark = pytest.mark.slow  # chains long enough to compare their moments


class DecodedMotion:
    """θ ~ N(0, I), and a multi-layer perceptron from θ to the positions of three joints."""

    skeleton = Skeleton(["hip", "knee", "foot"], [-1, 0, 1])
    frames, fps, dim = 2, 30.0, DIM

    def __init__(self):
        rng = np.random.default_rng(0)
        shapes = ((16, DIM), (2 * 3 * 3, 16))
        self.first, self.last = (
            torch.tensor(rng.normal(size=shape) / math.sqrt(shape[1])) for shape in shapes
        )

    def motion(self, theta):
        if isinstance(theta, np.ndarray):
            return self.motion(torch.tensor(theta)).numpy()
        if not isinstance(theta, torch.Tensor):
            raise TypeError(f"theta must be a NumPy or torch array, got {type(theta).__name__}")
        positions = torch.tanh(1.5 * theta @ self.first.T) @ self.last.T
        return positions.reshape(*theta.shape[:-1], self.frames, 3, 3)

    def log_density(self, theta):
        if not isinstance(theta, np.ndarray | torch.Tensor):
            raise TypeError(f"theta must be a NumPy or torch array, got {type(theta).__name__}")
        return -0.5 * (theta**2).sum(-1) - 0.5 * DIM * math.log(2 * math.pi)

    def initial(self, rng, n):
        return rng.standard_normal((n, DIM))

    def denoise_coordinates(self, theta_t, alpha_bar):
        return alpha_bar**0.5 * theta_t


@pytest.fixture(scope="module")
def posterior():
    prior = DecodedMotion()
    truth = prior.motion(np.random.default_rng(1).normal(size=DIM))
    confidence = np.ones((2, 3))
    confidence[1, 2] = 0
    seen = truth + 0.4 * np.random.default_rng(2).normal(size=truth.shape)
    return MotionPosterior(prior, Joints3D(seen, 0.4, confidence, skeleton=prior.skeleton))


@pytest.fixture(scope="module")
def runs(posterior):
    return {
        name: sampler.sample(posterior, draws=draws, chains=chains, seed=5, progress=False)
        for name, (sampler, draws, chains) in CHAINS.items()
    }


@pytest.fixture(scope="module")
def weighed(posterior):
    """θ from the prior, (n, dim), and its share of the posterior: an answer without a chain."""
    theta = np.random.default_rng(3).normal(size=(400_000, DIM))
    log_weight = posterior.log_likelihood(theta)
    weight = np.exp(log_weight - log_weight.max())
    return theta, weight / weight.sum()


def estimate(values, walkers):
    """Mean of (chains, draws) and its standard error; an ensemble's walkers are one series."""
    from arviz_stats.base import array_stats

    series = values.reshape(len(values), -1, walkers).mean(axis=-1)
    size = array_stats.ess(series, method="mean", chain_axis=0, draw_axis=1)
    return series.mean(), math.sqrt(series.var() / size)


def weighed_estimate(values, weight):
    """Return the mean of weighted draws and its standard error."""
    mean = weight @ values
    return mean, math.sqrt(weight**2 @ (values - mean) ** 2)


def test_all_that_need_a_density_fit_and_jax_is_kept_out(posterior):
    import jax

    assert {"nuts", "mh", "ensemble", "sds"} <= set(suited(posterior))
    for function in (posterior.motion, posterior.log_density):
        with pytest.raises(TypeError, match="expected a NumPy or torch array"):
            function(jax.numpy.zeros(DIM))


@pytest.mark.parametrize("name", CHAINS)
def test_chains_agree_with_weighed_draws_of_the_prior(name, runs, weighed):
    theta, weight = weighed
    assert 1 / (weight**2).sum() > 1000
    centre = weight @ theta
    walkers = getattr(CHAINS[name][0], "walkers", 1)
    found = runs[name].dataset["theta"].values
    for i in range(DIM):
        for power in (1, 2):
            mean, error = estimate((found[..., i] - centre[i]) ** power, walkers)
            wanted, doubt = weighed_estimate((theta[:, i] - centre[i]) ** power, weight)
            z = (mean - wanted) / math.hypot(error, doubt)
            assert abs(z) < LIMIT, f"coordinate {i}, power {power}: {z:.1f} standard errors"


@pytest.mark.parametrize("pair", [("nuts", "mh"), ("nuts", "ensemble"), ("mh", "ensemble")])
def test_chains_agree_with_each_other(pair, runs):
    """Mean and variance of every coordinate of θ."""
    found = [runs[name].dataset["theta"].values for name in pair]
    walkers = [getattr(CHAINS[name][0], "walkers", 1) for name in pair]
    centre = found[0].mean(axis=(0, 1))
    for i in range(DIM):
        for power in (1, 2):
            one, two = (
                estimate((theta[..., i] - centre[i]) ** power, w)
                for theta, w in zip(found, walkers, strict=True)
            )
            assert abs(one[0] - two[0]) < LIMIT * math.hypot(one[1], two[1])


def test_the_comparison_would_see_a_prior_of_another_width(posterior, weighed, monkeypatch):
    """The negative control: `mh` on a prior 1.3 times as wide."""
    right = DecodedMotion.log_density
    monkeypatch.setattr(DecodedMotion, "log_density", lambda self, at: right(self, at / 1.3))
    sampler, draws, chains = CHAINS["mh"]
    wrong = sampler.sample(posterior, draws=draws, chains=chains, seed=5, progress=False)
    theta, weight = weighed
    centre = weight @ theta
    z = []
    for i in range(DIM):
        square = (wrong.dataset["theta"].values[..., i] - centre[i]) ** 2
        mean, error = estimate(square, 1)
        wanted, doubt = weighed_estimate((theta[:, i] - centre[i]) ** 2, weight)
        z.append((mean - wanted) / math.hypot(error, doubt))
    assert max(z) > LIMIT


def test_draws_are_what_the_decoder_makes_of_them(posterior, runs):
    for found in runs.values():
        theta = found.dataset["theta"].values
        np.testing.assert_allclose(
            found.positions.values, posterior.prior.motion(theta), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(
            found.dataset["log_density"], posterior.log_density(theta), rtol=0, atol=1e-9
        )


def test_score_distillation_climbs_above_the_draws(posterior, runs):
    """It seeks modes: its points are denser than nearly all of the posterior's draws."""
    found = ScoreDistillation(iterations=1500).sample(posterior, draws=10, progress=False)
    level = np.quantile(runs["nuts"].dataset["log_density"].values, 0.95)
    assert found.dataset["log_density"].values.min() > level
    assert found.counts["gradient"] == 15_000
