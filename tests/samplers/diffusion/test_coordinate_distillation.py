"""Tests of score distillation in coordinates: expected gradient, convergence to modes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from probmotion import Joints3D, MotionPosterior, UnsupportedPosterior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Denoises2D, DenoisesCoordinates
from probmotion.posteriors.sampling import missing, suited
from probmotion.samplers import ScoreDistillation
from probmotion.samplers.diffusion.coordinate_distillation import coordinate_distillation_gradient

QUICK = ScoreDistillation(iterations=20)


@dataclass(frozen=True, eq=False)
class LinearMotion:
    """Prior with θ ~ N(0, I) and X = A θ + b, in torch like a network."""

    matrix: np.ndarray
    offset: np.ndarray
    skeleton: Skeleton = field(default_factory=lambda: Skeleton(["a", "b"], [-1, 0]))
    frames: int = 2
    fps: float = 30.0
    dim: int = 5

    def motion(self, theta):
        if isinstance(theta, np.ndarray):
            return self.motion(torch.tensor(theta)).numpy()
        positions = theta @ torch.tensor(self.matrix).T + torch.tensor(self.offset)
        return positions.reshape(*theta.shape[:-1], 2, 2, 3)

    def log_density(self, theta):
        return -0.5 * (theta**2).sum(-1) - 0.5 * self.dim * math.log(2 * math.pi)

    def initial(self, rng, n):
        return rng.standard_normal((n, self.dim))

    def denoise_coordinates(self, theta_t, alpha_bar):
        return alpha_bar**0.5 * theta_t


@pytest.fixture(scope="module")
def prior():
    rng = np.random.default_rng(0)
    # The observations determine some coordinates well and others poorly.
    matrix = rng.normal(size=(12, 5)) * [1.0, 1.0, 0.5, 0.2, 0.05]
    return LinearMotion(matrix, rng.normal(size=12))


@pytest.mark.parametrize("alpha_bar", [0.01, 0.5, 0.999])
def test_expected_gradient_is_the_negative_score_of_the_noisy_prior(alpha_bar):
    """E_ε[ε_φ − ε] = −√(1−ᾱ) ∇ log p_t(√ᾱ θ) for θ ~ N(m, S); the mean is over ε and −ε."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 5))
    mean, covariance = rng.normal(size=5), root @ root.T + np.eye(5)
    noisy = alpha_bar * covariance + (1 - alpha_bar) * np.eye(5)

    class Correlated:
        def denoise_coordinates(self, theta_t, alpha_bar):
            gain = alpha_bar**0.5 * np.linalg.solve(noisy, covariance)
            return mean + (theta_t - alpha_bar**0.5 * mean) @ gain

    theta, noise = rng.normal(size=(2, 7, 5))
    pair = [
        coordinate_distillation_gradient(Correlated(), theta, sign * noise, alpha_bar)
        for sign in (1, -1)
    ]
    score = -math.sqrt(alpha_bar) * np.linalg.solve(noisy, (theta - mean).T).T
    np.testing.assert_allclose(np.mean(pair, axis=0), -((1 - alpha_bar) ** 0.5) * score, atol=1e-9)
    assert abs(pair[0] - pair[1]).max() > 1e-3


def observed(prior, noise, **options):
    rng = np.random.default_rng(4)
    truth = prior.motion(np.random.default_rng(3).normal(size=5))
    joints = truth + noise * rng.normal(size=truth.shape)
    return MotionPosterior(prior, Joints3D(joints, noise=noise, **options))


def exact(prior, likelihood):
    """Return the mean (and mode) and covariance of the posterior."""
    weight = np.repeat(likelihood.entries.precision.ravel(), 3)
    covariance = np.linalg.inv(np.eye(5) + prior.matrix.T @ (weight[:, None] * prior.matrix))
    shift = prior.matrix.T @ (weight * (likelihood.joints.ravel() - prior.offset))
    return covariance @ shift, covariance


def distilled(sampler, posterior, **options):
    return sampler.sample(posterior, **({"draws": 20, "progress": False} | options))


def thetas(draws):
    return draws.dataset["theta"].values[0]


@pytest.mark.parametrize(
    ("noise", "options"),
    [
        (0.1, {}),
        (1.0, {"weighting": "residual"}),
        (1.0, {"weighting": "variance", "levels": "annealed"}),
    ],
)
def test_draws_concentrate_at_the_exact_mode(prior, noise, options):
    posterior = observed(prior, noise)
    mode, covariance = exact(prior, posterior.likelihood)
    theta = thetas(distilled(ScoreDistillation(iterations=2000, **options), posterior))
    np.testing.assert_allclose(theta.mean(axis=0), mode, atol=0.06)
    if not options:
        assert (theta.std(axis=0) < 0.5 * np.sqrt(np.diag(covariance))).all()
    if noise == 1:
        # Negative control: half or twice the weight of the prior moves the mode further.
        for c in (0.5**0.5, 2**0.5):
            other = exact(LinearMotion(prior.matrix * c, prior.offset), posterior.likelihood)[0]
            assert abs(c * other - mode).max() > 0.12


def test_modes_without_observations_and_with_outliers(prior):
    draws = distilled(ScoreDistillation(iterations=2000), MotionPosterior(prior))
    assert abs(thetas(draws).mean(axis=0)).max() < 0.1
    assert thetas(draws).std() < 0.2
    assert draws.counts == {"denoiser": 20 * 2000, "gradient": 0, "density": 20}
    confidence = np.ones((2, 2))
    confidence[0, 1] = 0
    posterior = observed(prior, 0.3, confidence=confidence, degrees_of_freedom=3.0)
    best = minimize(lambda theta: -float(posterior.log_density(theta)), np.zeros(5), tol=1e-10)
    draws = distilled(ScoreDistillation(iterations=2000), posterior)
    np.testing.assert_allclose(thetas(draws).mean(axis=0), best.x, atol=0.06)
    assert (draws.dataset["log_density"] <= -best.fun + 1e-9).all()


def test_a_draw_depends_only_on_its_seed_chain_and_number(prior):
    posterior = observed(prior, 0.1)
    full = distilled(QUICK, posterior, draws=5, chains=3, seed=2)
    theta = full.dataset["theta"].values
    assert len(np.unique(theta.reshape(15, -1), axis=0)) == 15
    np.testing.assert_allclose(full.positions.values, prior.motion(theta), atol=1e-12)
    np.testing.assert_allclose(full.dataset["log_density"], posterior.log_density(theta))
    assert full.counts == {"denoiser": 300, "gradient": 300, "density": 15}
    for sampler, draws, chains in ((replace(QUICK, batch=2), 5, 3), (QUICK, 4, 2)):
        subset = distilled(sampler, posterior, seed=2, draws=draws, chains=chains)
        for name in ("theta", "positions", "log_density"):
            expected = full.dataset[name].values[:chains, :draws]
            np.testing.assert_allclose(subset.dataset[name].values, expected, rtol=0, atol=1e-9)


def test_one_of_two_protocols_is_required(prior, gaussian, two_modes):
    class WithoutDensity(LinearMotion):
        log_density = None

    assert "sds" in suited(MotionPosterior(prior))
    assert missing(ScoreDistillation, MotionPosterior(prior)) == []
    assert missing(ScoreDistillation, MotionPosterior(gaussian)) == []
    posterior = MotionPosterior(two_modes)
    assert missing(ScoreDistillation, posterior) == [Denoises2D | DenoisesCoordinates]
    with pytest.raises(
        UnsupportedPosterior,
        match=r"^sds needs a prior with Denoises2D or DenoisesCoordinates, got TwoModes; try .*nut",
    ) as refused:
        distilled(QUICK, posterior)
    assert refused.value.word == "Denoises2D"
    with pytest.raises(UnsupportedPosterior, match="got WithoutDensity"):
        distilled(QUICK, MotionPosterior(WithoutDensity(np.zeros((12, 5)), np.zeros(12))))


def test_likelihoods_without_a_finite_torch_gradient_are_refused(prior):
    @dataclass
    class Custom:
        function: object
        differentiable: bool = True

        def log_density(self, positions):
            return self.function(positions)

        def simulate(self, rng, positions):
            return self

    for likelihood, reason in (
        (Custom(None, differentiable=False), "but it has no gradient"),
        (Custom(lambda x: np.asarray(x).sum((1, 2, 3))), "but got RuntimeError: Can't call numpy"),
        (Custom(lambda x: x.detach().sum((1, 2, 3))), "but LinearMotion returns none"),
    ):
        with pytest.raises(
            UnsupportedPosterior,
            match=f"^sds needs a log likelihood that torch can differentiate, {reason}.*; try .*$",
        ) as refused:
            distilled(QUICK, MotionPosterior(prior, likelihood))
        assert refused.value.word == "gradient"
    steep = Custom(lambda x: (x * torch.inf).sum((1, 2, 3)))
    with pytest.raises(ValueError, match="gradient of the log likelihood must be finite, got 100"):
        distilled(QUICK, MotionPosterior(prior, steep))
