"""Agreement of `exact` and of Markov chains with posteriors in dense linear algebra.

Each comparison divides the error of a mean over draws by its Monte Carlo standard error. The limit
makes the family-wise failure rate 1/1000 (Bonferroni). Negative controls sample a slightly wrong
posterior and must fail.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from probmotion import Cameras, Keypoints2D, Motion, MotionPosterior
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.samplers import (
    NUTS,
    Ensemble,
    ExactSampler,
    MetropolisHastings,
    ParallelTempering,
    SequentialMonteCarlo,
)
from probmotion.samplers.mcmc.nuts_kernel import compiled

L, J, K, RANK, AZIMUTHS = 3, 4, 2, 2, 4
PROBLEMS = ("prior", "monocular", "sparse")
SAMPLERS = {
    "exact": (ExactSampler(), 2000, 2),
    "nuts": (NUTS(warmup=300), 600, 4),
    "ensemble": (Ensemble(walkers=12, warmup=300, thin=10), 12 * 200, 2),
    "mh": (MetropolisHastings(warmup=1000, thin=6), 1000, 8),
    "tempered": (ParallelTempering(rungs=6, warmup=175, thin=3, gradients=False), 500, 8),
    "smc": (SequentialMonteCarlo(particles=500, moves=2, thin=20, gradients=False), 500, 8),
}
DIRECTIONS, QUANTILES = 6, (0.1, 0.5, 0.9)
COMPARISONS = DIRECTIONS * (2 + len(QUANTILES)) * len(PROBLEMS) * len(SAMPLERS)
LIMIT = norm.isf(1e-3 / COMPARISONS / 2)


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@dataclass(frozen=True)
class Dense:
    """Mixture of Gaussians over all positions, with dense covariances."""

    log_weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    @classmethod
    def of(cls, posterior):
        """Condition every component of the prior on the observations."""
        prior, likelihood, terms = posterior.prior, posterior.likelihood, []
        for k in range(K):
            for yaw in prior.yaws:
                c, s = np.cos(yaw), np.sin(yaw)
                turn = np.kron(np.eye(L * J), [[c, 0, s], [0, 1, 0], [-s, 0, c]])
                mean = turn @ prior.means[k].ravel()
                factors = turn @ prior.factors[k].reshape(RANK, -1).T
                covariance = factors @ factors.T + prior.noise**2 * np.eye(len(mean))
                log_weight = np.log(prior.weights[k] / AZIMUTHS)
                if likelihood is not None:
                    visible = likelihood.entries.visible[0].ravel()
                    P = np.kron(np.eye(L * J), likelihood.cameras.image_axes[0])
                    P = P.reshape(L * J, 2, -1)[visible].reshape(2 * visible.sum(), -1)
                    offset = likelihood.cameras.offset[0]
                    y = (likelihood.keypoints[0].reshape(-1, 2)[visible] - offset).ravel()
                    predicted = P @ covariance @ P.T + likelihood.noise**2 * np.eye(len(P))
                    log_weight += multivariate_normal(P @ mean, predicted).logpdf(y)
                    gain = np.linalg.solve(predicted, P @ covariance).T
                    mean = mean + gain @ (y - P @ mean)
                    covariance = covariance - gain @ P @ covariance
                terms.append((log_weight, mean, covariance))
        log_weights, means, covariances = (np.array(part) for part in zip(*terms, strict=True))
        return cls(log_weights - logsumexp(log_weights), means, covariances)

    def directions(self):
        """Return the leading principal axes and as many random directions, (n, D)."""
        weights = np.exp(self.log_weights)
        centred = self.means - weights @ self.means
        total = (
            np.tensordot(weights, self.covariances, 1) + (weights[:, None] * centred).T @ centred
        )
        leading = np.linalg.eigh(total)[1].T[::-1][: DIRECTIONS // 2]
        others = np.random.default_rng(7).normal(size=(DIRECTIONS - len(leading), len(total)))
        return np.concatenate([leading, others / np.linalg.norm(others, axis=1, keepdims=True)])


def scores(dense, positions, walkers):
    """Return z-scores of the mean, variance and quantiles along all directions."""
    z = []
    flat = positions.reshape(*positions.shape[:2], -1)
    weights = np.exp(dense.log_weights)
    for direction in dense.directions():
        means = dense.means @ direction
        deviations = np.sqrt(np.einsum("i,cij,j->c", direction, dense.covariances, direction))
        mean = weights @ means
        x = flat @ direction
        z.append(score(x, mean, walkers))
        variance = weights @ (deviations**2 + (means - mean) ** 2)
        z.append(score((x - mean) ** 2, variance, walkers))
        grid = mean + np.sqrt(variance) * np.linspace(-8, 8, 20_001)
        cumulative = norm.cdf((grid[:, None] - means) / deviations) @ weights
        for edge, level in zip(np.interp(QUANTILES, cumulative, grid), QUANTILES, strict=True):
            z.append(score((x < edge).astype(float), level, walkers))
    return np.array(z)


def draw(name, posterior):
    """Return the positions of draws and the number of walkers per chain."""
    sampler, draws, chains = SAMPLERS[name]
    result = sampler.sample(posterior, draws=draws, chains=chains, seed=11, progress=False)
    return result.positions.values, getattr(sampler, "walkers", 1)


def score(values, truth, walkers):
    """Return (mean − truth) / standard error; the walkers of an ensemble are averaged first."""
    from arviz_stats.base import array_stats

    series = values.reshape(len(values), -1, walkers).mean(axis=-1)
    size = array_stats.ess(series, method="mean", chain_axis=0, draw_axis=1)
    return float((series.mean() - truth) / math.sqrt(series.var() / size))


@pytest.fixture(scope="module")
def posteriors():
    """Return small problems with modes between which chains mix."""
    rng = np.random.default_rng(2)
    prior = GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b", "c", "d"], [-1, 0, 1, 2]),
        fps=30.0,
        means=0.6 * rng.normal(size=(K, L, J, 3)),
        factors=0.4 * rng.normal(size=(K, RANK, L, J, 3)),
        weights=np.array([0.65, 0.35]),
        noise=0.1,
        azimuths=AZIMUTHS,
    )
    truth = Motion(prior.sample(np.random.default_rng(5), 1)[0], prior.skeleton, prior.fps)
    camera = Cameras.ring(1, elevation=0.3)
    hidden = np.ones((L, J), dtype=bool)
    hidden[1, :1] = False
    return {
        "prior": MotionPosterior(prior),
        "monocular": MotionPosterior(prior, Keypoints2D.observe(truth, camera, 0.4, seed=0)),
        "sparse": MotionPosterior(
            prior, Keypoints2D.observe(truth, camera, 0.3, seed=0, hidden=hidden)
        ),
    }


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        *((name, "sparse") for name in SAMPLERS),
        *(("exact", problem) for problem in ("prior", "monocular")),
        ("mh", "prior"),
        *(slow(name, "prior") for name in ("nuts", "ensemble")),
        *(slow(name, "monocular") for name in SAMPLERS if name != "exact"),
    ],
)
def test_samplers_agree_with_the_exact_posterior(name, problem, posteriors):
    posterior = posteriors[problem]
    z = scores(Dense.of(posterior), *draw(name, posterior))
    assert np.abs(z).max() < LIMIT, f"{np.abs(z).max():.1f} standard errors, limit {LIMIT:.1f}"


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        *((name, "prior") for name in ("exact", "mh")),
        *(slow(name, "prior") for name in ("nuts", "ensemble")),
        *(slow(name, problem) for name in SAMPLERS for problem in PROBLEMS[1:]),
    ],
)
def test_samplers_of_a_slightly_wrong_posterior_fail(name, problem, posteriors, monkeypatch):
    """Negative controls: a wider prior, or chains with target p^0.7."""
    right = MotionPosterior.log_density
    posterior = wrong = posteriors[problem]
    if name in ("exact", "tempered", "smc"):
        wrong = replace(
            posterior, prior=replace(posterior.prior, factors=1.3 * posterior.prior.factors)
        )
    else:
        monkeypatch.setattr(
            MotionPosterior, "log_density", lambda self, theta: 0.7 * right(self, theta)
        )
        compiled.cache_clear()
    z = scores(Dense.of(posterior), *draw(name, wrong))
    compiled.cache_clear()
    assert np.abs(z).max() > LIMIT
