"""`exact`, `nuts`, `ensemble` and `mh` against posteriors written out in dense algebra.

Every quantity compared is a mean over draws, divided by its Monte Carlo standard error from its
own effective sample size: about standard normal if the sampler is right. All comparisons of the
file together fail by chance once in a thousand seeds (Bonferroni), and a sampler of a slightly
wrong posterior must fail.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from probmotion import Cameras, Keypoints2D, Motion, MotionPosterior
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.samplers import NUTS, Ensemble, ExactSampler, MetropolisHastings
from probmotion.samplers.mcmc.nuts_kernel import compiled

L, J, K, RANK, AZIMUTHS = 3, 4, 2, 2, 4
PROBLEMS = ("prior", "monocular", "sparse")
SAMPLERS = {
    "exact": (ExactSampler(), 2000, 2),
    "nuts": (NUTS(warmup=300), 1000, 4),
    "ensemble": (Ensemble(walkers=12, warmup=300, thin=10), 12 * 200, 4),
    "mh": (MetropolisHastings(warmup=1000, thin=6), 1500, 8),
}
DIRECTIONS, QUANTILES = 6, (0.1, 0.5, 0.9)
COMPARISONS = DIRECTIONS * (2 + len(QUANTILES)) * len(PROBLEMS) * len(SAMPLERS)
LIMIT = norm.isf(1e-3 / COMPARISONS / 2)


@dataclass(frozen=True)
class Dense:
    """A mixture of Gaussians over all positions, every covariance written out."""

    log_weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    @classmethod
    def of(cls, posterior: MotionPosterior) -> Dense:
        """Condition every component of the prior on the evidence by itself."""
        prior, terms = posterior.prior, []
        for k in range(K):
            for yaw in prior.yaws:
                c, s = np.cos(yaw), np.sin(yaw)
                turn = np.kron(np.eye(L * J), [[c, 0, s], [0, 1, 0], [-s, 0, c]])
                mean = turn @ prior.means[k].ravel()
                factors = turn @ prior.factors[k].reshape(RANK, -1).T
                covariance = factors @ factors.T + prior.noise**2 * np.eye(len(mean))
                log_weight = np.log(prior.weights[k] / AZIMUTHS)
                if posterior.likelihood is not None:
                    evidence = posterior.likelihood
                    seen = evidence.entries.visible[0].ravel()
                    P = np.kron(np.eye(L * J), evidence.cameras.image_axes[0])
                    P = P.reshape(L * J, 2, -1)[seen].reshape(2 * seen.sum(), -1)
                    y = evidence.keypoints[0].reshape(-1, 2)[seen] - evidence.cameras.offset[0]
                    predicted = P @ covariance @ P.T + evidence.noise**2 * np.eye(len(P))
                    log_weight += multivariate_normal(P @ mean, predicted).logpdf(y.ravel())
                    gain = np.linalg.solve(predicted, P @ covariance).T
                    mean = mean + gain @ (y.ravel() - P @ mean)
                    covariance = covariance - gain @ P @ covariance
                terms.append((log_weight, mean, covariance))
        log_weights, means, covariances = (np.array(part) for part in zip(*terms, strict=True))
        return cls(log_weights - logsumexp(log_weights), means, covariances)

    @property
    def effective_components(self) -> float:
        return float(np.exp(-(np.exp(self.log_weights) * self.log_weights).sum()))

    def directions(self) -> np.ndarray:
        """Half the leading principal axes, half at random, (n, D)."""
        weights = np.exp(self.log_weights)
        apart = self.means - weights @ self.means
        total = np.tensordot(weights, self.covariances, 1) + (weights[:, None] * apart).T @ apart
        leading = np.linalg.eigh(total)[1].T[::-1][: DIRECTIONS // 2]
        others = np.random.default_rng(7).normal(size=(DIRECTIONS - len(leading), len(total)))
        return np.concatenate([leading, others / np.linalg.norm(others, axis=1, keepdims=True)])

    def along(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights, means and deviations of the mixture of X · direction."""
        variances = np.einsum("i,cij,j->c", direction, self.covariances, direction)
        return np.exp(self.log_weights), self.means @ direction, np.sqrt(variances)


def scores(dense: Dense, positions: np.ndarray, walkers: int = 1) -> np.ndarray:
    """Return z of mean, variance and distribution function along all directions."""
    found = []
    chains, draws = positions.shape[:2]
    flat = positions.reshape(chains, draws, -1)
    for direction in dense.directions():
        weights, means, deviations = dense.along(direction)
        mean = weights @ means
        x = flat @ direction
        found.append(score(x, mean, walkers))
        variance = weights @ (deviations**2 + (means - mean) ** 2)
        found.append(score((x - mean) ** 2, variance, walkers))

        def below(at: float, parts: tuple = (weights, means, deviations)) -> float:
            return float(parts[0] @ norm.cdf((at - parts[1]) / parts[2]))

        for level in QUANTILES:
            width = 20 * np.sqrt(variance)
            edge = brentq(lambda at, q=level: below(at) - q, mean - width, mean + width)
            found.append(score((x < edge).astype(float), level, walkers))
    return np.array(found)


def score(values: np.ndarray, truth: float, walkers: int) -> float:
    """Return (mean − truth) / its Monte Carlo standard error.

    Walkers of one ensemble depend on each other: their mean at each iteration is the series.
    """
    from arviz_stats.base import array_stats

    chains = len(values)
    series = values.reshape(chains, -1, walkers).mean(axis=-1)
    size = array_stats.ess(series, method="mean", chain_axis=0, draw_axis=1)
    return float((series.mean() - truth) / math.sqrt(series.var() / size))


@pytest.fixture(scope="module")
def posteriors() -> dict[str, MotionPosterior]:
    """Small problems whose modes are all in reach, so that a right sampler has no excuse."""
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


def test_the_sparse_problem_has_several_modes(posteriors):
    assert Dense.of(posteriors["sparse"]).effective_components > 3
    assert Dense.of(posteriors["monocular"]).effective_components < 3


@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("name", SAMPLERS)
def test_a_sampler_agrees_with_the_exact_posterior(name, problem, posteriors):
    sampler, draws, chains = SAMPLERS[name]
    posterior = posteriors[problem]
    result = sampler.sample(posterior, draws=draws, chains=chains, seed=11, progress=False)
    walkers = getattr(sampler, "walkers", 1)
    z = scores(Dense.of(posterior), result.positions.values, walkers)
    assert np.abs(z).max() < LIMIT, f"{np.abs(z).max():.1f} standard errors, limit {LIMIT:.1f}"


@pytest.mark.parametrize(
    "problem", [PROBLEMS[0], *(pytest.param(p, marks=pytest.mark.slow) for p in PROBLEMS[1:])]
)
@pytest.mark.parametrize("name", SAMPLERS)
def test_a_sampler_of_a_slightly_wrong_posterior_fails(name, problem, posteriors, monkeypatch):
    """The negative controls: the same walk on p^0.7; exact draws of a wider prior."""
    sampler, draws, chains = SAMPLERS[name]
    posterior, right = posteriors[problem], MotionPosterior.log_density
    wrong = posterior
    if name == "exact":
        wider = replace(posterior.prior, factors=1.3 * posterior.prior.factors)
        wrong = MotionPosterior(wider, posterior.likelihood)
    else:
        monkeypatch.setattr(
            MotionPosterior, "log_density", lambda self, theta: 0.7 * right(self, theta)
        )
        compiled.cache_clear()
    result = sampler.sample(wrong, draws=draws, chains=chains, seed=11, progress=False)
    compiled.cache_clear()
    walkers = getattr(sampler, "walkers", 1)
    z = scores(Dense.of(posterior), result.positions.values, walkers)
    assert np.abs(z).max() > LIMIT
