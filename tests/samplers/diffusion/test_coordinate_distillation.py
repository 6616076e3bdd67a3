"""Score distillation in a prior's coordinates: its expected gradient, where it settles."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from probmotion import Joints3D, MotionDraws, MotionPosterior, UnsupportedPosterior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Denoises2D, DenoisesCoordinates, HasLogDensity
from probmotion.posteriors.sampling import Interrupted, missing, suited
from probmotion.samplers import ScoreDistillation
from probmotion.samplers.diffusion import coordinate_distillation
from probmotion.samplers.diffusion.coordinate_distillation import coordinate_distillation_gradient

QUICK = ScoreDistillation(iterations=20)


@dataclass(frozen=True, eq=False)
class LinearMotion:
    """θ ~ N(0, I) and X = A θ + b, as a network would be: torch inside, NumPy let in."""

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
    # From coordinates that the evidence pins down to one that it hardly sees.
    matrix = rng.normal(size=(12, 5)) * [1.0, 1.0, 0.5, 0.2, 0.05]
    return LinearMotion(matrix, rng.normal(size=12))


def evidence(prior, noise, **options):
    rng = np.random.default_rng(4)
    truth = prior.motion(np.random.default_rng(3).normal(size=5))
    return Joints3D(truth + noise * rng.normal(size=truth.shape), noise=noise, **options)


def exact(prior, likelihood):
    """The posterior's mean, which is its mode, and covariance."""
    weight = np.repeat(likelihood.entries.precision.ravel(), 3)
    covariance = np.linalg.inv(np.eye(5) + prior.matrix.T @ (weight[:, None] * prior.matrix))
    shift = prior.matrix.T @ (weight * (likelihood.joints.ravel() - prior.offset))
    return covariance @ shift, covariance


def distilled(sampler, posterior, **options):
    return sampler.sample(posterior, **({"draws": 20, "progress": False} | options))


@pytest.mark.parametrize("alpha_bar", [0.01, 0.5, 0.999])
def test_the_expected_gradient_is_that_of_the_standard_normal(prior, alpha_bar):
    """E_ε[ε_φ − ε] = √(ᾱ(1−ᾱ)) θ = −√(ᾱ(1−ᾱ)) ∇ log p(θ); ε and −ε average to it exactly."""
    rng = np.random.default_rng(0)
    theta, noise = rng.normal(size=(2, 7, 5))
    both = [
        coordinate_distillation_gradient(prior, theta, sign * noise, alpha_bar) for sign in (1, -1)
    ]
    share = math.sqrt(alpha_bar * (1 - alpha_bar))
    np.testing.assert_allclose(np.mean(both, axis=0), share * theta, atol=1e-12)
    # What is left is noise of size ᾱ.
    np.testing.assert_allclose(both[0] - share * theta, -alpha_bar * noise, atol=1e-12)


def test_of_another_prior_it_is_the_score_where_noise_is_small():
    """θ ~ N(m, S) in closed form: the expected gradient over the share tends to S⁻¹(θ − m)."""
    rng = np.random.default_rng(1)
    root = rng.normal(size=(5, 5))
    mean, covariance = rng.normal(size=5), root @ root.T + np.eye(5)

    class Correlated:
        def denoise_coordinates(self, theta_t, alpha_bar):
            noisy = alpha_bar * covariance + (1 - alpha_bar) * np.eye(5)
            gain = alpha_bar**0.5 * np.linalg.solve(noisy, covariance)
            return mean + (theta_t - alpha_bar**0.5 * mean) @ gain

    theta, noise = rng.normal(size=(2, 7, 5))
    score = -np.linalg.solve(covariance, (theta - mean).T).T
    gaps = []
    for alpha_bar in (0.99, 0.9999):
        both = [
            coordinate_distillation_gradient(Correlated(), theta, sign * noise, alpha_bar)
            for sign in (1, -1)
        ]
        found = np.mean(both, axis=0) / math.sqrt(alpha_bar * (1 - alpha_bar))
        gaps.append(abs(found + score).max())
    assert gaps[1] < 1e-3
    assert gaps[0] > 50 * gaps[1]


@pytest.mark.parametrize("weighting", ["constant", "variance", "residual"])
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_with_evidence_it_settles_at_the_exact_mode(prior, weighting, noise):
    """Strong evidence or weak: a prior that counted half, or twice, would show in the weak case."""
    likelihood = evidence(prior, noise)
    mode, covariance = exact(prior, likelihood)
    sampler = ScoreDistillation(iterations=2000, weighting=weighting)
    theta = distilled(sampler, MotionPosterior(prior, likelihood)).dataset["theta"].values[0]
    np.testing.assert_allclose(theta.mean(axis=0), mode, atol=0.06)
    # Over-confident, as its docstring says.
    assert (theta.std(axis=0) < 0.5 * np.sqrt(np.diag(covariance))).all()
    miscounted = [
        exact(LinearMotion(prior.matrix * c, prior.offset), likelihood)[0] * c
        for c in (0.5**0.5, 2**0.5)
    ]
    if noise == 1:
        assert all(abs(other - mode).max() > 0.12 for other in miscounted)


def test_falling_levels_leave_the_balance_as_it_is(prior):
    """At the end every level is low, where one weight for the likelihood would drown the prior."""
    likelihood = evidence(prior, 1.0)
    mode, _ = exact(prior, likelihood)
    sampler = ScoreDistillation(iterations=2000, levels="annealed", weighting="variance")
    theta = distilled(sampler, MotionPosterior(prior, likelihood)).dataset["theta"].values[0]
    np.testing.assert_allclose(theta.mean(axis=0), mode, atol=0.06)


def test_hidden_joints_and_outliers_are_the_likelihood_s_business(prior):
    """Student-t noise, one joint hidden: the log density at the end is the highest there is."""
    confidence = np.ones((2, 2))
    confidence[0, 1] = 0
    likelihood = evidence(prior, 0.3, confidence=confidence, degrees_of_freedom=3.0)
    posterior = MotionPosterior(prior, likelihood)
    best = minimize(lambda theta: -float(posterior.log_density(theta)), np.zeros(5), tol=1e-10)
    found = distilled(ScoreDistillation(iterations=2000), posterior)
    np.testing.assert_allclose(found.dataset["theta"].values[0].mean(axis=0), best.x, atol=0.06)
    assert (found.dataset["log_density"] <= -best.fun + 1e-9).all()


def test_without_evidence_it_settles_at_the_prior_s_mode(prior):
    found = distilled(ScoreDistillation(iterations=2000), MotionPosterior(prior))
    assert abs(found.dataset["theta"].values[0].mean(axis=0)).max() < 0.1
    assert found.dataset["theta"].values.std() < 0.2
    assert found.counts == {"denoiser": 20 * 2000, "gradient": 0, "density": 20}


def test_what_is_stored_belongs_together(prior, tmp_path):
    posterior = MotionPosterior(prior, evidence(prior, 0.1))
    found = distilled(QUICK, posterior, draws=3, chains=2)
    theta = found.dataset["theta"].values
    assert theta.shape == (2, 3, 5)
    np.testing.assert_allclose(found.positions.values, prior.motion(theta), atol=1e-12)
    np.testing.assert_allclose(found.dataset["log_density"], posterior.log_density(theta))
    assert found.independent
    assert found.counts == {"denoiser": 120, "gradient": 120, "density": 6}
    found.save(tmp_path / "draws.nc")
    loaded = MotionDraws.load(tmp_path / "draws.nc")
    np.testing.assert_array_equal(loaded.dataset["theta"], theta)


def test_draws_depend_on_their_names_alone(prior):
    posterior = MotionPosterior(prior, evidence(prior, 0.1))
    whole = distilled(QUICK, posterior, draws=5, chains=3, seed=2)
    assert len(np.unique(whole.dataset["theta"].values.reshape(15, -1), axis=0)) == 15
    for sampler, options in (
        (replace(QUICK, batch=2), {"draws": 5, "chains": 3}),
        (QUICK, {"draws": 5, "chains": 3, "progress": True}),
        (QUICK, {"draws": 4, "chains": 2}),
        (QUICK, {"draws": 1, "chains": 1}),
    ):
        few = distilled(sampler, posterior, seed=2, **options)
        for name in ("theta", "positions", "log_density"):
            wanted = whole.dataset[name].values[: options["chains"], : options["draws"]]
            np.testing.assert_allclose(few.dataset[name].values, wanted, rtol=0, atol=1e-9)
    other = distilled(QUICK, posterior, draws=5, chains=3, seed=3)
    assert (other.dataset["theta"].values != whole.dataset["theta"].values).all()


def test_an_interrupted_run_keeps_its_coordinates(prior, monkeypatch):
    posterior = MotionPosterior(prior, evidence(prior, 0.1))
    sampler = replace(QUICK, batch=4)
    whole = distilled(sampler, posterior, draws=6, chains=3)
    calls = []

    def stopping(*arguments):
        calls.append(arguments)
        if len(calls) > 2 * sampler.iterations + 3:
            raise KeyboardInterrupt
        return coordinate_distillation_gradient(*arguments)

    monkeypatch.setattr(coordinate_distillation, "coordinate_distillation_gradient", stopping)
    with pytest.raises(Interrupted) as stopped:
        distilled(sampler, posterior, draws=6, chains=3)
    kept = stopped.value.draws
    # Two batches of four are two whole draws of three chains.
    assert kept.dataset["theta"].shape == (3, 2, 5)
    for name in ("theta", "positions", "log_density"):
        np.testing.assert_allclose(
            kept.dataset[name].values, whole.dataset[name].values[:, :2], atol=1e-9
        )


def test_one_of_two_protocols_is_enough(prior, lively):
    assert isinstance(prior, DenoisesCoordinates)
    assert not isinstance(prior, Denoises2D)
    assert "sds" in suited(MotionPosterior(prior))
    assert missing(ScoreDistillation, MotionPosterior(prior)) == []
    assert missing(ScoreDistillation, MotionPosterior(lively)) == []
    assert not isinstance(lively, HasLogDensity)


def test_a_prior_with_neither_is_told_of_both(two_bumps):
    class Undense(LinearMotion):
        log_density = None

    posterior = MotionPosterior(two_bumps)
    assert missing(ScoreDistillation, posterior) == [Denoises2D | DenoisesCoordinates]
    with pytest.raises(
        UnsupportedPosterior,
        match=r"^sds needs a prior with Denoises2D or DenoisesCoordinates, which TwoBumps is not; "
        r".*nuts.* would do$",
    ) as no:
        distilled(QUICK, posterior)
    assert no.value.word == "Denoises2D"
    with pytest.raises(UnsupportedPosterior, match="which Undense is not"):
        distilled(QUICK, MotionPosterior(Undense(np.zeros((12, 5)), np.zeros(12))))


def test_a_2d_denoiser_keeps_its_own_way_and_its_refusal_of_evidence(lively):
    class Both(type(lively)):
        def log_density(self, theta):
            return -0.5 * (theta**2).sum(-1)

        def initial(self, rng, n):
            return rng.standard_normal((n, self.dim))

        def denoise_coordinates(self, theta_t, alpha_bar):
            raise AssertionError

    prior = Both(lively.mean, lively.covariance, lively.scale)
    assert isinstance(prior, DenoisesCoordinates)
    np.testing.assert_array_equal(
        distilled(QUICK, MotionPosterior(prior), draws=2).positions,
        distilled(QUICK, MotionPosterior(lively), draws=2).positions,
    )
    with pytest.raises(UnsupportedPosterior, match=r"place for evidence; .*mas, .*mvpc.* would do"):
        distilled(QUICK, MotionPosterior(prior, Joints3D(lively.mean, noise=0.1)))


def test_a_likelihood_without_a_torch_gradient_is_refused(prior):
    @dataclass
    class Silent:
        answer: object
        differentiable: bool = True

        def log_density(self, positions):
            return self.answer(positions)

        def simulate(self, rng, positions):
            return self

    for likelihood, reason in (
        (Silent(None, differentiable=False), "which Silent has not"),
        (Silent(lambda x: np.asarray(x).sum((1, 2, 3))), "but met RuntimeError: Can't call numpy"),
        (Silent(lambda x: x.detach().sum((1, 2, 3))), "which LinearMotion does not pass through"),
    ):
        with pytest.raises(
            UnsupportedPosterior,
            match=f"^sds needs a log likelihood with a gradient by torch, {reason}.*would do$",
        ) as no:
            distilled(QUICK, MotionPosterior(prior, likelihood))
        assert no.value.word == "gradient"
    steep = Silent(lambda x: (x * torch.inf).sum((1, 2, 3)))
    with pytest.raises(ValueError, match="gradient of the log likelihood has 100 values that are"):
        distilled(QUICK, MotionPosterior(prior, steep))
    with pytest.raises(
        ValueError, match="initial is ndarray, expected None: sds starts every draw"
    ):
        distilled(QUICK, MotionPosterior(prior), initial=np.zeros((1, 5)))
