"""Tests of `DVAEInference` with an exact variational family, of its optimiser and its networks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch

from probmotion import Joints3D, Motion, MotionPosterior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import HasInferenceNetwork, InferenceNetwork
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers import DVAEInference

FIT = DVAEInference(mode="optimization", iterations=400, learning_rate=0.02)
QUICK = DVAEInference(training_steps=20, training_pairs=150)


def run(sampler, posterior, draws=3, chains=2, seed=9, **options):
    return sampler.sample(
        posterior, draws=draws, chains=chains, seed=seed, progress=False, **options
    )


@dataclass(frozen=True, eq=False)
class OneDirection:
    """Prior X = mean + θ direction with θ ~ N(0, 1)."""

    inference_network: object = None
    frames: int = 3
    fps: float = 30.0
    dim: int = 1

    @property
    def skeleton(self):
        return Skeleton(["a", "b"], [-1, 0])

    @property
    def parts(self):
        rng = np.random.default_rng(0)
        return rng.normal(size=(2, 3, 2, 3))

    def motion(self, theta):
        mean, direction = self.parts
        return mean + np.asarray(theta)[..., None, None] * direction

    def log_density(self, theta):
        return -0.5 * (np.asarray(theta) ** 2).sum(-1) - 0.5 * math.log(2 * math.pi)

    def initial(self, rng, n):
        return rng.standard_normal((n, 1))

    def sample(self, rng, n):
        return self.motion(self.initial(rng, n))

    def exact(self, likelihood):
        """Return the mean and standard deviation of θ, and log p(y)."""
        mean, direction = (part.ravel() for part in self.parts)
        variance = likelihood.noise**2
        precision = 1 + direction @ direction / variance
        residual = likelihood.joints.ravel() - mean
        centre = residual @ direction / variance / precision
        square = residual @ residual / variance - precision * centre**2
        constant = len(mean) * math.log(2 * math.pi * variance) + math.log(precision)
        return centre, precision**-0.5, -0.5 * (square + constant)


class GaussianNetwork:
    """Inference network with q(θ) = N(m, s²), initially the prior."""

    def __init__(self):
        self.inferences, self.options = [], []

    def reads(self, likelihood):
        return isinstance(likelihood, Joints3D)

    def on(self, prior, likelihood, **options):
        self.inferences.append(GaussianInference(prior, likelihood))
        self.options.append(options)
        return self.inferences[-1]


class GaussianInference:
    def __init__(self, prior, likelihood):
        self.prior, self.likelihood = prior, likelihood
        self.numbers = torch.zeros(2, dtype=torch.float64)

    def parameters(self):
        return [self.numbers.requires_grad_()]

    def loss(self, rng, *, initial_entropy, latent_weight):
        m, log_s = self.numbers
        theta = m + torch.exp(log_s) * float(rng.standard_normal())
        mean, direction = (torch.tensor(part) for part in self.prior.parts)
        data = self.likelihood.log_density(mean + theta * direction)
        return latent_weight * (0.5 * (m**2 + torch.exp(2 * log_s) - 1) - log_s) - data

    def draw(self, streams, n):
        m, log_s = self.numbers.detach().numpy()
        theta = m + np.exp(log_s) * streams.standard_normal((n, 1))
        return self.prior.motion(theta), theta

    def predict(self, rng, *, average):
        return self.prior.motion(self.numbers.detach().numpy()[:1])


def one_direction(network=None, theta=0.7, noise=2.0):
    prior = OneDirection(network)
    truth = Motion(prior.motion(np.array([theta])), prior.skeleton, prior.fps)
    return MotionPosterior(prior, Joints3D.observe(truth, noise, 1))


@pytest.mark.parametrize("theta", [-1.5, 0.7])
def test_optimisation_finds_a_posterior_in_the_family(theta):
    """The optimum of the ELBO is log p(y)."""
    network = GaussianNetwork()
    posterior = one_direction(network, theta)
    mean, deviation, log_marginal_likelihood = posterior.prior.exact(posterior.likelihood)
    regression = run(DVAEInference(), posterior, draws=1000)
    assert regression.dataset["theta"].values.std() == pytest.approx(1.0, rel=0.1)
    assert regression.counts == {"gradient": 0}
    draws = run(FIT, posterior, draws=1000)
    values = draws.dataset["theta"].values.ravel()
    assert values.mean() == pytest.approx(mean, abs=0.15 * deviation)
    assert values.std() == pytest.approx(deviation, rel=0.1)
    predicted = FIT.predict(posterior, seed=9, progress=False)
    expected = posterior.prior.motion(np.array([mean]))
    largest = abs(posterior.prior.parts[1]).max()
    np.testing.assert_allclose(predicted.positions, expected, atol=0.15 * deviation * largest)
    loss = partial(network.inferences[1].loss, initial_entropy=True, latent_weight=1.0)
    losses = [float(loss(np.random.default_rng(number)).detach()) for number in range(400)]
    assert -np.mean(losses) == pytest.approx(
        log_marginal_likelihood, abs=5 * np.std(losses) / 20 + 0.02
    )
    np.testing.assert_allclose(
        draws.dataset["log_density"].values.ravel(), posterior.log_density(values[:, None])
    )
    assert draws.counts == {"gradient": 400}


def test_latent_weight_0_finds_the_maximum_likelihood_estimate():
    """With weight 0 the bound is E_q[log p(y | θ)]; its maximum is a point mass at the mode."""
    network = GaussianNetwork()
    posterior = one_direction(network)
    run(replace(FIT, latent_weight=0.0, iterations=1200), posterior)
    m, log_s = network.inferences[0].numbers.detach().numpy()
    mean, deviation, _ = posterior.prior.exact(posterior.likelihood)
    # The posterior precision is 1 + that of the likelihood.
    assert m == pytest.approx(mean / (1 - deviation**2), abs=0.1)
    assert log_s < math.log(0.3 * deviation)


@pytest.mark.parametrize(("iterations", "rate"), [(1, 1e300), (20, 1e300), (5, 1e4)])
def test_divergence_is_an_error(iterations, rate):
    """The loss becomes NaN, also in the last step, or large but finite."""
    sampler = replace(FIT, iterations=iterations, learning_rate=rate)
    with pytest.raises(
        ValueError,
        match=r"^optimisation diverged with learning_rate \S+ from loss \S+ to \S+; use a sm",
    ):
        run(sampler, one_direction(GaussianNetwork()))


class Slopes(GaussianNetwork):
    """Network whose loss at iteration t is g_t·x, with x in two tensors."""

    def __init__(self, gradients):
        super().__init__()
        self.x = [torch.zeros(2, 2, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)]
        # The last call repeats the first iteration, to detect divergence.
        self.gradients = iter(torch.tensor(np.concatenate([gradients, gradients[:1]])))

    def on(self, prior, likelihood, **options):
        return self

    def parameters(self):
        return [part.requires_grad_() for part in self.x]

    def loss(self, rng, *, initial_entropy, latent_weight):
        assert (initial_entropy, latent_weight) == (False, 0.5)
        return next(self.gradients) @ torch.cat([part.flatten() for part in self.x])

    def predict(self, rng, *, average):
        return np.zeros((3, 2, 3))


def adam(gradients, rate, max_norm):
    """Return x by Adam (Kingma & Ba, algorithm 1) with clipping and half-cosine decay."""
    x, m, v = np.zeros((3, gradients.shape[1]))
    for t, g in enumerate(gradients):
        g = g * min(1.0, max_norm / np.sqrt((g**2).sum()))
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g**2
        step = (m / (1 - 0.9 ** (t + 1))) / (np.sqrt(v / (1 - 0.999 ** (t + 1))) + 1e-8)
        x = x - rate * 0.5 * (1 + np.cos(np.pi * t / len(gradients))) * step
    return x


def test_optimiser_is_adam_with_clipping_and_half_cosine_decay():
    rng = np.random.default_rng(4)
    sizes = rng.uniform(0.5, 20.0, 60)
    sizes[0] = 2000.0
    gradients = rng.normal(2.0, 1.0, (60, 7)) * sizes[:, None]
    norms = np.linalg.norm(gradients, axis=1)
    assert norms[0] > 5000
    assert 10 < (norms > 30).sum() < 50
    network = Slopes(gradients)
    sampler = DVAEInference(
        mode="optimization", iterations=60, initial_entropy=False, latent_weight=0.5
    )
    sampler.predict(one_direction(network), progress=False)
    x = torch.cat([part.detach().flatten() for part in network.x])
    np.testing.assert_allclose(x, adam(gradients, 2e-3, 30.0), atol=1e-6)


def test_draws_have_theta_only_if_the_prior_has_a_density():
    class WithoutDensity(OneDirection):
        log_density = None

    posterior = MotionPosterior(WithoutDensity(GaussianNetwork()), one_direction().likelihood)
    assert "theta" not in run(DVAEInference(), posterior).dataset


def test_seconds_include_the_optimisation(monkeypatch):
    """Only the start of the inference advances the clock."""
    clock = [0.0]
    monkeypatch.setattr("probmotion.samplers.independent.time.perf_counter", lambda: clock[0])

    class Slow(GaussianNetwork):
        def on(self, prior, likelihood, **options):
            clock[0] += 100.0
            return super().on(prior, likelihood, **options)

    assert run(DVAEInference(), one_direction(Slow())).seconds == 100.0


@pytest.mark.parametrize(
    ("kind", "network"),
    [("joints", None), ("keypoints", None), ("none", None), ("none", GaussianNetwork())],
)
def test_a_network_is_trained_for_other_priors(
    trainings, mixture, mixture_posterior, kind, network
):
    """This includes missing observations, which a given network does not support."""
    likelihood = mixture_posterior.likelihood if kind == "keypoints" else None
    if kind == "joints":
        likelihood = Joints3D(mixture.sample(np.random.default_rng(2), 1)[0], 0.3)
    posterior = MotionPosterior(mixture, likelihood)
    sampler = replace(QUICK, network=network)
    draws = run(sampler, posterior)
    assert draws.positions.shape == (2, 3, 2, 2, 3)
    assert "theta" not in draws.dataset
    [settings] = trainings
    assert (settings.steps, settings.pairs) == (20, 150)
    with pytest.raises(UnsupportedPosterior, match="dvae predicts a motion only with an inference"):
        sampler.predict(posterior, progress=False)


def test_a_given_network_takes_precedence(trainings):
    prior_network, network = GaussianNetwork(), GaussianNetwork()
    sampler = DVAEInference(network=network, overlap=2, degrees_of_freedom=5.0)
    for posterior in (one_direction(prior_network), one_direction()):
        run(sampler, posterior)
        sampler.predict(posterior, progress=False)
    assert network.options == [{"degrees_of_freedom": 5.0, "overlap": 2}] * 4
    assert prior_network.options == []
    assert trainings == []
    assert isinstance(prior_network, InferenceNetwork)
    assert isinstance(posterior.prior, HasInferenceNetwork)


def test_a_given_network_must_support_the_observations(mixture_posterior):
    for draw in (run, lambda sampler, given: sampler.predict(given, progress=False)):
        with pytest.raises(
            UnsupportedPosterior, match=r"^dvae requires a network that supports Keypoints2D$"
        ) as refused:
            draw(replace(QUICK, network=GaussianNetwork()), mixture_posterior)
        assert refused.value.word == "observations"
