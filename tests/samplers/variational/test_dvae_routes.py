"""`DVAEInference` with a family that holds the exact posterior, its routes and what it refuses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import HasInferenceNetwork, InferenceNetwork
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers import DVAEInference
from probmotion.samplers.variational.amortised import AmortisedPosterior

FIT = DVAEInference(mode="optimization", iterations=400, learning_rate=0.02)
BRIEF = DVAEInference(training_steps=20, training_pairs=150)


def run(sampler, posterior, draws=3, chains=2, seed=9, **options):
    return sampler.sample(
        posterior, draws=draws, chains=chains, seed=seed, progress=False, **options
    )


# --- a family that holds the exact posterior


@dataclass(frozen=True, eq=False)
class OneDirection:
    """X = mean + θ direction, θ ~ N(0, 1)."""

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

    def exact(self, evidence):
        """Mean and standard deviation of θ, and log p(y), by completing the square."""
        mean, direction = (part.ravel() for part in self.parts)
        variance = evidence.noise**2
        precision = 1 + direction @ direction / variance
        residual = evidence.joints.ravel() - mean
        middle = residual @ direction / variance / precision
        square = residual @ residual / variance - precision * middle**2
        constant = len(mean) * math.log(2 * math.pi * variance) + math.log(precision)
        return middle, precision**-0.5, -0.5 * (square + constant)


class GaussianNetwork:
    """q(θ) = N(m, s²), which answers the prior before it is fitted."""

    def __init__(self):
        self.begun, self.options = [], []

    def reads(self, likelihood):
        return isinstance(likelihood, Joints3D)

    def on(self, prior, likelihood, **options):
        self.begun.append(GaussianInference(prior, likelihood))
        self.options.append(options)
        return self.begun[-1]


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
def test_where_q_holds_the_posterior_a_fit_finds_it(theta):
    """And its bound is log p(y): the optimum of the ELBO is the exact evidence and posterior."""
    network = GaussianNetwork()
    posterior = one_direction(network, theta)
    mean, deviation, log_marginal_likelihood = posterior.prior.exact(posterior.likelihood)
    draws = run(FIT, posterior, draws=1000)
    found = draws.dataset["theta"].values.ravel()
    # Adam's noise, and that of 2000 draws.
    assert found.mean() == pytest.approx(mean, abs=0.15 * deviation)
    assert found.std() == pytest.approx(deviation, rel=0.1)
    predicted = FIT.predict(posterior, seed=9, progress=False)
    middle = posterior.prior.motion(np.array([mean]))
    largest = abs(posterior.prior.parts[1]).max()
    np.testing.assert_allclose(predicted.positions, middle, atol=0.15 * deviation * largest)
    rngs = [np.random.default_rng(number) for number in range(400)]
    losses = [
        float(network.begun[0].loss(rng, initial_entropy=True, latent_weight=1.0).detach())
        for rng in rngs
    ]
    assert -np.mean(losses) == pytest.approx(
        log_marginal_likelihood, abs=5 * np.std(losses) / 20 + 0.02
    )
    # Log densities at the draws are those of the posterior: prior times likelihood.
    np.testing.assert_allclose(
        draws.dataset["log_density"].values.ravel(), posterior.log_density(found[:, None])
    )
    assert draws.counts == {"gradient": 400}


def test_regression_answers_what_the_network_does():
    draws = run(DVAEInference(), one_direction(GaussianNetwork()), draws=1000)
    assert draws.dataset["theta"].values.std() == pytest.approx(1.0, rel=0.1)
    assert draws.counts == {"gradient": 0}


def test_without_the_prior_s_weight_a_fit_finds_the_best_motion():
    """The bound is then E_q[log p(y | θ)], largest where q is a point at the likelihood's mode."""
    network = GaussianNetwork()
    posterior = one_direction(network)
    run(replace(FIT, latent_weight=0.0, iterations=1200), posterior)
    m, log_s = network.begun[0].numbers.detach().numpy()
    mean, deviation, _ = posterior.prior.exact(posterior.likelihood)
    # Posterior precision is 1 + that of the likelihood.
    assert m == pytest.approx(mean / (1 - deviation**2), abs=0.1)
    assert log_s < math.log(0.3 * deviation)


@pytest.mark.parametrize(("iterations", "rate"), [(1, 1e300), (20, 1e300), (5, 1e4)])
def test_a_fit_that_diverges_is_one_sentence(iterations, rate):
    """To NaN, also in the last step after which nothing looks, or to where numbers still are."""
    sampler = replace(FIT, iterations=iterations, learning_rate=rate)
    with pytest.raises(
        ValueError,
        match=r"^learning_rate is \S+, with which the fit diverged: its loss went from \S+ to \S+; "
        r"expected a smaller one$",
    ):
        run(sampler, one_direction(GaussianNetwork()))


# --- the steps of a fit


class Slopes(GaussianNetwork):
    """Its loss at iteration t is g_t·x, and x is in two tensors."""

    def __init__(self, gradients):
        super().__init__()
        self.gradients = torch.tensor(gradients)

    def on(self, prior, likelihood, **options):
        self.begun.append(SlopeInference(prior, likelihood, self.gradients))
        return self.begun[-1]


class SlopeInference(GaussianInference):
    def __init__(self, prior, likelihood, gradients):
        super().__init__(prior, likelihood)
        self.gradients, self.asked = gradients, 0
        self.x = [torch.zeros(2, 2, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)]

    def parameters(self):
        return [part.requires_grad_() for part in self.x]

    def loss(self, rng, *, initial_entropy, latent_weight):
        # The last one asked for is the first again: whether the fit diverged.
        gradient = self.gradients[self.asked % len(self.gradients)]
        self.asked += 1
        return gradient @ torch.cat([part.flatten() for part in self.x])


def fitted_x(gradients, **settings):
    """Return x, (7,), after as many iterations as there are gradients; it begins at 0."""
    network = Slopes(gradients)
    sampler = DVAEInference(mode="optimization", iterations=len(gradients), **settings)
    sampler.predict(one_direction(network), progress=False)
    return np.concatenate([part.detach().numpy().ravel() for part in network.begun[0].x])


def adam(gradients, rate, greatest):
    """Return x by Adam (Kingma & Ba, algorithm 1): norms bounded, a half cosine of rates to 0."""
    x, m, v = np.zeros((3, gradients.shape[1]))
    for t, g in enumerate(gradients):
        g = g * min(1.0, greatest / np.sqrt((g**2).sum()))
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g**2
        step = (m / (1 - 0.9 ** (t + 1))) / (np.sqrt(v / (1 - 0.999 ** (t + 1))) + 1e-8)
        x = x - rate * 0.5 * (1 + np.cos(np.pi * t / len(gradients))) * step
    return x


def test_a_fit_is_adam_with_bounded_gradients_and_a_rate_that_falls_by_half_a_cosine():
    rng = np.random.default_rng(4)
    sizes = rng.uniform(0.5, 20.0, 60)
    sizes[0] = 2000.0
    gradients = rng.normal(2.0, 1.0, (60, 7)) * sizes[:, None]
    norms = np.linalg.norm(gradients, axis=1)
    assert norms[0] > 5000
    assert 10 < (norms > 30).sum() < 50
    np.testing.assert_allclose(fitted_x(gradients), adam(gradients, 2e-3, 30.0), atol=1e-6)


@pytest.mark.parametrize("size", [0.1, 5000.0])
def test_under_a_constant_gradient_a_fit_moves_by_its_rates(size):
    """Adam's step is then its rate, and a half cosine's T rates are (T + 1)/2 times the first."""
    direction = np.array([1.0, -2.0, 0.5, 3.0, -1.0, 1.5, -0.7])
    moved = fitted_x(np.tile(size * direction, (40, 1)), learning_rate=0.01)
    np.testing.assert_allclose(moved, -0.01 * 41 / 2 * np.sign(direction), rtol=1e-5)


# --- what is kept


def test_theta_is_kept_where_the_prior_has_a_density():
    class Undense(OneDirection):
        log_density = None

    some = one_direction()
    posterior = MotionPosterior(Undense(GaussianNetwork()), some.likelihood)
    assert "theta" not in run(DVAEInference(), posterior).dataset


def test_the_seconds_are_of_the_fit_too(monkeypatch):
    """A clock that only the beginning of an inference moves."""
    now = [0.0]
    monkeypatch.setattr("probmotion.samplers.independent.time.perf_counter", lambda: now[0])

    class Slow(GaussianNetwork):
        def on(self, prior, likelihood, **options):
            now[0] += 100.0
            return super().on(prior, likelihood, **options)

    assert run(DVAEInference(), one_direction(Slow())).seconds == 100.0


# --- other routes


@pytest.fixture
def trainings(monkeypatch):
    """Settings that networks were trained with here."""
    used, fit = [], AmortisedPosterior.fit

    def spy(posterior, settings, *rest):
        used.append(settings)
        return fit(posterior, settings, *rest)

    monkeypatch.setattr(AmortisedPosterior, "fit", spy)
    return used


def mixture():
    rng = np.random.default_rng(1)
    return GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b"], [-1, 0]),
        fps=30.0,
        means=rng.normal(size=(2, 2, 2, 3)),
        factors=rng.normal(size=(2, 2, 2, 2, 3)),
        weights=np.array([0.6, 0.4]),
        noise=0.3,
        azimuths=4,
    )


def seen_of(prior, how):
    truth = Motion(prior.sample(np.random.default_rng(2), 1)[0], prior.skeleton, prior.fps)
    if how == "joints":
        return Joints3D.observe(truth, 0.3, 0)
    return Keypoints2D.observe(truth, Cameras.ring(1, elevation=0.3), 0.3, seed=0)


@pytest.mark.parametrize(
    ("shown", "network"),
    [("joints", None), ("keypoints", None), ("nothing", None), ("nothing", GaussianNetwork())],
)
def test_for_another_prior_a_network_is_trained(trainings, shown, network):
    """One that is handed in has nothing to read where there is no evidence."""
    prior = mixture()
    posterior = MotionPosterior(prior, None if shown == "nothing" else seen_of(prior, shown))
    sampler = replace(BRIEF, network=network)
    draws = run(sampler, posterior)
    assert draws.positions.shape == (2, 3, 2, 2, 3)
    assert "theta" not in draws.dataset
    [settings] = trainings
    assert (settings.steps, settings.pairs) == (20, 150)
    np.testing.assert_array_equal(run(sampler, posterior).positions, draws.positions)
    with pytest.raises(
        UnsupportedPosterior, match="dvae predicts one motion only where a network was trained"
    ):
        sampler.predict(posterior, progress=False)


def test_a_network_that_is_handed_in_goes_before_the_prior_s(trainings):
    own, given = GaussianNetwork(), GaussianNetwork()
    sampler = DVAEInference(network=given, overlap=2, degrees_of_freedom=5.0)
    for posterior in (one_direction(own), one_direction()):
        run(sampler, posterior)
        sampler.predict(posterior, progress=False)
    assert given.options == [{"degrees_of_freedom": 5.0, "overlap": 2}] * 4
    assert own.options == []
    assert trainings == []
    assert isinstance(own, InferenceNetwork)
    assert isinstance(posterior.prior, HasInferenceNetwork)


# --- refusals


def test_a_network_that_cannot_read_the_evidence_is_not_passed_over():
    prior = mixture()
    posterior = MotionPosterior(prior, seen_of(prior, "keypoints"))
    for draw in (run, lambda sampler, some: sampler.predict(some, progress=False)):
        with pytest.raises(
            UnsupportedPosterior, match=r"^dvae was given a network that does not read Keypoints2D$"
        ) as refused:
            draw(replace(BRIEF, network=GaussianNetwork()), posterior)
        assert refused.value.word == "observations"


def test_a_prior_that_cannot_be_sampled_is_refused(two_bumps):
    posterior = MotionPosterior(two_bumps)
    assert "dvae" not in suited(posterior)
    with pytest.raises(
        UnsupportedPosterior, match=r"^dvae needs a prior with Samplable, which TwoBumps is not; "
    ) as refused:
        run(DVAEInference(), posterior)
    assert refused.value.word == "Samplable"


def test_it_starts_from_noise():
    posterior = one_direction(GaussianNetwork())
    with pytest.raises(ValueError, match="initial is ndarray, expected None: dvae starts every"):
        run(DVAEInference(), posterior, initial=np.zeros((2, posterior.dim)))


@pytest.mark.parametrize(
    ("setting", "value", "sentence"),
    [
        ("mode", "both", "mode must be one of regression, optimization, got 'both'"),
        ("iterations", 0, "iterations must be an integer of at least 1, got 0"),
        ("batch", 1.5, "batch must be an integer of at least 1, got 1.5"),
        ("training_steps", 0, "training_steps must be an integer of at least 1, got 0"),
        ("training_pairs", 99, "training_pairs must be an integer of at least 100, got 99"),
        ("overlap", 0, "overlap must be an integer of at least 1, got 0"),
        ("learning_rate", 0.0, "learning_rate must be a finite number above 0, got 0.0"),
        ("degrees_of_freedom", 0.0, "degrees_of_freedom must be a number above 0 or inf, got 0.0"),
        ("degrees_of_freedom", "4", "degrees_of_freedom must be a number above 0 or inf, got '4'"),
        ("degrees_of_freedom", math.nan, "degrees_of_freedom must be a number above 0, got nan"),
        ("latent_weight", -0.1, "latent_weight must be a finite number of at least 0, got -0.1"),
        ("latent_weight", math.inf, "latent_weight must be a finite number of at least, got inf"),
        ("latent_weight", "x", "latent_weight must be a finite number of at least 0, got 'x'"),
        ("network", "body-dvae", "network must be an InferenceNetwork, got 'body-dvae'"),
    ],
)
def test_settings_out_of_range_are_refused(setting, value, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        DVAEInference(**{setting: value})


@pytest.mark.parametrize(("name", "bad"), [("draws", 0), ("chains", 1.5)])
def test_wrong_numbers_are_refused_before_anything_is_learnt(trainings, name, bad):
    posterior = MotionPosterior(mixture())
    with pytest.raises(ValueError, match=f"{name} must be an integer of at least 1, got {bad}"):
        run(DVAEInference(), posterior, **{name: bad})
    assert trainings == []
