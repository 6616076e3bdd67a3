"""Tests of `tempered` and `smc` on posteriors with known weights, moments and evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.special import expit
from scipy.stats import multivariate_normal, norm, t

from probmotion import MotionPosterior, Skeleton, seeds
from probmotion.arrays import array_namespace, constant, logsumexp
from probmotion.comparison.results.budgets import Budget, affordable
from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.samplers import MetropolisHastings, ParallelTempering, SequentialMonteCarlo
from probmotion.samplers.mcmc import annealing, ladder
from probmotion.samplers.mcmc.ladder import Ladder, equal_rejection
from probmotion.samplers.mcmc.split_gradients import split_gradient
from probmotion.samplers.mcmc.tempering import TemperedDensity, move

WIDTH = 4.0  # standard deviation of the prior


@dataclass(frozen=True, eq=False)
class Broad:
    """Prior of one joint, N(0, 16 I)."""

    frames: int = 1
    fps: float = 20.0
    dim: int = 3

    @property
    def skeleton(self):
        return Skeleton(["point"], [-1])

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 1, 1, 3)

    def log_density(self, theta):
        xp = array_namespace(theta)
        constant_part = 3 * math.log(WIDTH * math.sqrt(2 * math.pi))
        return -0.5 * xp.sum(theta**2, axis=-1) / WIDTH**2 - constant_part

    def initial(self, rng, n):
        return WIDTH * rng.standard_normal((n, 3))

    def sample(self, rng, n):
        return self.motion(self.initial(rng, n))


@dataclass(frozen=True, eq=False)
class Peaks:
    """Likelihood that is a sum of Gaussian peaks, so that the posterior is a Gaussian mixture."""

    weights: np.ndarray
    centres: np.ndarray
    widths: np.ndarray

    def log_density(self, positions):
        xp = array_namespace(positions)
        theta = positions[..., 0, 0, :]
        terms = []
        for weight, centre, width in zip(self.weights, self.centres, self.widths, strict=True):
            square = xp.sum((theta - constant(centre, theta)) ** 2, axis=-1) / width**2
            terms.append(math.log(weight) - 0.5 * square)
        return logsumexp(xp.stack(terms, axis=-1))

    def simulate(self, rng, positions):
        return self

    def exact(self):
        """Return weights, means and standard deviations of the posterior's modes, and log p(y)."""
        total = np.sqrt(WIDTH**2 + self.widths**2)
        log_masses = np.log(self.weights) + 3 * np.log(self.widths * math.sqrt(2 * math.pi))
        log_masses += norm(0, total[:, None]).logpdf(self.centres).sum(axis=1)
        masses = np.exp(log_masses)
        means = self.centres * (WIDTH / total)[:, None] ** 2
        return masses / masses.sum(), means, WIDTH * self.widths / total, math.log(masses.sum())


PEAKS = Peaks(np.array([1.0, 3.0]), np.array([[-3.0, 0, 0], [3.0, 1.0, 0]]), np.array([0.4, 0.3]))
ONE = Peaks(np.ones(1), np.array([[2.0, -1.0, 0.5]]), np.array([0.2]))
TEMPERED = ParallelTempering(rungs=8, warmup=75, thin=2, candidates=500)
SMC = SequentialMonteCarlo(particles=128, thin=2, candidates=500)


@pytest.fixture(scope="module")
def peaks():
    return MotionPosterior(Broad(), PEAKS)


def mode_scores(theta):
    """Return z-scores of mode proportions, means and variances of draws (chains, draws, 3).

    Chains are independent, so their spread gives the standard error of each mean over them.
    """
    weights, means, deviations, _ = PEAKS.exact()
    first = theta[..., 0] < 0
    values = [first - weights[0]]
    for mode, chosen in enumerate((first, ~first)):
        white = (theta - means[mode]) / deviations[mode]
        values += [np.where(chosen, white[..., axis], 0) for axis in range(3)]
        values.append(np.where(chosen, (white**2).sum(axis=-1) - 3, 0))
    averages = np.array([value.mean(axis=1) for value in values])
    chains = averages.shape[1]
    error = averages.std(axis=1, ddof=1) / math.sqrt(chains)
    # Where all chains agree exactly, any difference counts.
    return averages.mean(axis=1) / np.maximum(error, 1e-12), t(chains - 1).isf(
        1e-3 / len(values) / 2
    )


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
def test_draws_follow_a_mixture_of_known_weights(peaks, sampler, gradients):
    sampler = replace(sampler, gradients=gradients)
    run = sampler.sample(peaks, draws=100, chains=10, seed=1, progress=False)
    assert ("gradient" in run.counts) == gradients
    scores, limit = mode_scores(run.dataset["theta"].values)
    assert np.abs(scores).max() < limit, scores


def test_one_temperature_stays_in_a_mode(peaks):
    """The same test fails for Metropolis-Hastings from one mode."""
    starts = np.tile(PEAKS.exact()[1][0], (10, 1))
    walk = MetropolisHastings(warmup=300, thin=2)
    run = walk.sample(peaks, draws=100, chains=10, seed=1, initial=starts, progress=False)
    scores, limit = mode_scores(run.dataset["theta"].values)
    assert np.abs(scores).max() > limit


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("likelihood", [ONE, PEAKS], ids=["gaussian", "mixture"])
def test_the_evidence_of_smc_agrees_with_the_exact_one(likelihood, gradients):
    """Adaptation biases the estimate of p(y) by less than its standard error."""
    posterior = MotionPosterior(Broad(), likelihood)
    sampler = replace(SMC, gradients=gradients, moves=2)
    run = sampler.sample(posterior, draws=1, chains=20, seed=2, progress=False)
    ratio = np.exp(run.dataset["log_evidence"].values - likelihood.exact()[-1])
    error = ratio.std(ddof=1) / math.sqrt(len(ratio))
    assert error < 0.1
    assert abs(ratio.mean() - 1) < 4 * error


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("power", [0.0, 0.02, 1.0])
def test_moves_leave_the_tempered_posterior_invariant(gradients, power):
    """Points that start as exact draws remain exact; a draw of the prior replaces the first."""
    posterior = MotionPosterior(Broad(), ONE)
    density = TemperedDensity(SMC, posterior, gradients)
    precision = 1 / WIDTH**2 + power / 0.04
    mean, deviation = power / 0.04 * ONE.centres[0] / precision, precision**-0.5
    rng, n = np.random.default_rng(3), 20_000
    powers = np.full(n, power)
    points = density.points(mean + deviation * rng.standard_normal((n, 3)), powers)
    root, step = deviation * np.array([[1.0, 0.5, 2.0]]), np.full(n, 0.8)
    fresh = np.array([9.0, 8.0, 7.0]) if power == 0 else None
    moved, acceptance = move(density, points, powers, root, step, rng, fresh)
    assert 0.2 < acceptance.mean() < 0.99
    assert np.abs(np.corrcoef(moved.theta[:, 0], points.theta[:, 0])[0, 1]) < 0.97
    if fresh is not None:
        np.testing.assert_array_equal(moved.theta[0], fresh)
    white = (moved.theta - mean) / deviation
    assert np.abs(white.mean(axis=0)).max() < 4.5 / math.sqrt(n)
    assert np.abs((white**2).mean(axis=0) - 1).max() < 4.5 * math.sqrt(2 / n)
    again = density.points(moved.theta, powers)
    for part, expected in zip(moved, again, strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-9, atol=1e-9)


def ladder_of(posterior, rungs=5):
    """Return a ladder whose replicas are away from their targets."""
    density = TemperedDensity(TEMPERED, posterior, False)
    return Ladder.begin(density, seeds.generator(0), rungs, 32, 500, lambda n: None)


def test_swaps_are_accepted_by_the_ratio_of_tempered_densities(peaks, monkeypatch):
    replicas = ladder_of(peaks)
    monkeypatch.setattr(ladder, "move", lambda density, points, *rest: (points, np.ones(5)))
    counts, expected = np.zeros((2, 4)), None
    for sweep in range(1000):
        replicas.points = start = replicas.density.points(
            np.linspace(-4.6, -3.0, 5)[:, None] * [1, 0, 0], replicas.powers
        )
        _, rejection, _ = replicas.sweep()
        order = np.searchsorted(start.theta[:, 0], replicas.points.theta[:, 0])
        counts[sweep % 2] += order[:-1] > np.arange(4)
        levels = [start.log_density(np.full(5, power)) for power in replicas.powers]
        ratio = [
            levels[i][i + 1] + levels[i + 1][i] - levels[i][i] - levels[i + 1][i + 1]
            for i in range(4)
        ]
        expected = np.exp(np.minimum(0, ratio))
        np.testing.assert_allclose(rejection, 1 - expected, rtol=1e-9, atol=1e-12)
    # Even and odd pairs alternate.
    assert (counts[0, 1::2] == 0).all()
    assert (counts[1, 0::2] == 0).all()
    rates = np.array([counts[i % 2, i] for i in range(4)]) / 500
    assert 0.05 < expected.min() < 0.9
    np.testing.assert_allclose(rates, expected, atol=4 * math.sqrt(0.25 / 500))


def rejections(powers, seed=0, n=10_000):
    """Return swap rejections between exact tempered posteriors of ``ONE``."""
    rng = np.random.default_rng(seed)
    precision = 1 / WIDTH**2 + powers / 0.04
    means = (powers / 0.04 / precision)[:, None] * ONE.centres[0]
    theta = (
        means[:, None]
        + rng.standard_normal((len(powers), n, 3)) / np.sqrt(precision)[:, None, None]
    )
    log_likelihood = ONE.log_density(theta[..., None, None, :])
    ratio = -np.diff(powers)[:, None] * np.diff(log_likelihood, axis=0)
    return 1 - np.exp(np.minimum(0, ratio)).mean(axis=1)


def test_warm_up_adapts_the_ladder_to_equal_rejection():
    """On a Gaussian posterior, whose tempered versions are known, from equally spaced powers."""
    replicas = ladder_of(MotionPosterior(Broad(), ONE), 7)
    replicas.powers = np.linspace(0, 1, 7)
    assert rejections(replicas.powers).std() > 0.25
    replicas.warm_up(1575, lambda n: None)
    assert replicas.powers[0] == 0
    assert replicas.powers[-1] == 1
    assert rejections(replicas.powers).std() < 0.09


def test_ladders_are_spaced_by_the_barrier():
    powers = np.array([0.0, 0.1, 1.0])
    np.testing.assert_allclose(equal_rejection(powers, np.array([0.4, 0.4]), 3), powers)
    finer = equal_rejection(powers, np.array([0.2, 0.6]), 5)
    assert finer[1] == pytest.approx(0.1, rel=1e-4)
    assert (np.diff(finer) > 0).all()
    np.testing.assert_allclose(equal_rejection(np.linspace(0, 1, 5), np.zeros(4), 3), [0, 0.5, 1])


def test_restarts_carry_prior_draws_to_the_posterior(peaks):
    """Each needs at least as many sweeps as rungs; non-reversible swaps need few more."""
    run = TEMPERED.sample(peaks, draws=200, chains=2, seed=5, progress=False)
    restarts = run.dataset["restarts"].values.sum(axis=1)
    rungs = run.state["powers"].shape[1]
    sweeps = 200 * TEMPERED.thin
    rejected = 1 - run.dataset["swap_rate"].values.mean()
    ideal = sweeps / (2 + 2 * (rungs - 1) * rejected / (1 - rejected))
    assert (restarts > 0.3 * ideal).all()
    assert (restarts < 2 * ideal).all()


@dataclass(frozen=True, eq=False)
class Faulty(Peaks):
    """Likelihood that is NaN, or 0, at points beyond ``limit``."""

    value: float = math.nan
    limit: float = 0.0

    def log_density(self, positions):
        right = super().log_density(positions)
        return np.where(positions[..., 0, 0, 0] > self.limit, self.value, right)


def faulty(value, limit):
    return MotionPosterior(
        Broad(), Faulty(PEAKS.weights, PEAKS.centres, PEAKS.widths, value, limit)
    )


@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_density_that_is_nan_names_its_point(sampler, value):
    message = (
        rf"log_density must be finite or -inf, got {value} at point \d+ of \d+, with likelihood "
        r"to the power 0, theta \[ ?\d"
    )
    with pytest.raises(ValueError, match=message):
        sampler.sample(faulty(value, 5.0), draws=2, progress=False)


@dataclass(frozen=True, eq=False)
class Hollow(Peaks):
    """Likelihood that is NaN near one of its peaks, where draws of the prior rarely are."""

    def log_density(self, positions):
        xp = array_namespace(positions)
        theta = positions[..., 0, 0, :]
        square = xp.sum((theta - constant(self.centres[1], theta)) ** 2, axis=-1)
        return xp.where(square < 0.04, math.nan, super().log_density(positions))


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
def test_a_density_that_is_nan_in_one_replica_names_its_power(sampler, gradients):
    posterior = MotionPosterior(Broad(), Hollow(PEAKS.weights, PEAKS.centres, PEAKS.widths))
    message = (
        r"got nan at point \d+ of \d+, with likelihood to the power (0\.\d+|1), theta \[.*\]; "
        "return -inf where the density is 0"
    )
    with pytest.raises(ValueError, match=message):
        replace(sampler, gradients=gradients).sample(posterior, draws=500, seed=1, progress=False)


def test_ladders_have_two_rungs_at_least():
    with pytest.raises(ValueError, match="rungs must be an integer of at least 2, got 1"):
        ParallelTempering(rungs=1)


@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
def test_regions_without_likelihood_are_left(sampler):
    """Half of the prior has likelihood 0, as has one mode of the posterior."""
    run = sampler.sample(faulty(-math.inf, 0.0), draws=300, chains=4, seed=6, progress=False)
    theta = run.dataset["theta"].values
    assert theta[..., 0].max() <= 0
    _, means, deviations, _ = PEAKS.exact()
    np.testing.assert_allclose(theta.mean(axis=(0, 1)), means[0], atol=0.4 * deviations[0])


@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
def test_unusable_posteriors_are_refused(sampler, two_modes, minimal):
    n = sampler.candidates
    with pytest.raises(ValueError, match=rf"likelihood must be positive .*, got 0 of {n}; use"):
        sampler.sample(faulty(-math.inf, -1e9), draws=2, progress=False)
    # A few draws of N(0, 16) are below this limit: too few to represent the posterior.
    few = 4 * norm.ppf(4 / n)
    with pytest.raises(ValueError, match=rf"at 10 or more draws of the prior, got [1-9] of {n};"):
        sampler.sample(faulty(-math.inf, few), draws=2, progress=False)
    with pytest.raises(ValueError, match="initial must be None or an earlier run, got ndarray: "):
        sampler.sample(faulty(0.0, 9.0), initial=np.zeros((1, 3)), progress=False)

    class Seeded:
        skeleton, frames, fps, dim = two_modes.skeleton, 1, 20.0, 3
        motion, log_density, initial = two_modes.motion, two_modes.log_density, two_modes.initial

    with pytest.raises(
        UnsupportedPosterior, match=rf"^{sampler.name} needs a prior with Samplable, got Seeded"
    ):
        sampler.sample(MotionPosterior(Seeded()), draws=2, progress=False)


@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
def test_draws_without_observations_are_those_of_the_prior(sampler):
    run = sampler.sample(MotionPosterior(Broad()), draws=200, chains=8, seed=7, progress=False)
    theta = run.dataset["theta"].values.reshape(-1, 3) / WIDTH
    assert np.abs(theta.mean(axis=0)).max() < 4.5 / math.sqrt(1600 / 3)
    np.testing.assert_allclose(np.cov(theta.T), np.eye(3), atol=0.25)


def test_gradients_of_both_parts_are_those_of_finite_differences(peaks):
    """In any number of points, and with the likelihood's constant."""
    split = split_gradient(peaks)
    theta = np.random.default_rng(8).normal(size=(81, 3))
    log_prior, log_likelihood, *gradients = split(theta)
    np.testing.assert_allclose(log_prior, multivariate_normal(np.zeros(3), 16).logpdf(theta))
    np.testing.assert_allclose(log_likelihood, PEAKS.log_density(theta[:, None, None]))
    functions = (Broad().log_density, lambda theta: PEAKS.log_density(theta[:, None, None]))
    for function, gradient in zip(functions, gradients, strict=True):
        for axis, step in enumerate(1e-6 * np.eye(3)):
            slope = (function(theta + step) - function(theta - step)) / 2e-6
            np.testing.assert_allclose(gradient[:, axis], slope, rtol=1e-5, atol=1e-6)
    assert split_gradient(faulty(0.0, 0.0)) is None


def test_successive_powers_have_a_conditional_sample_size_of_97_percent():
    log_likelihood = np.random.default_rng(9).normal(size=500) * 50
    weights = expit(np.linspace(-3, 3, 500))
    weights /= weights.sum()
    rise = annealing._rise(log_likelihood, weights, 0.1)
    ratio = np.exp(rise * (log_likelihood - log_likelihood.max()))
    size = (weights @ ratio) ** 2 / (weights @ ratio**2)
    assert size == pytest.approx(0.97, abs=1e-3)
    assert annealing._rise(1e-3 * log_likelihood, weights, 0.1) == pytest.approx(0.9)


def test_systematic_resampling_rounds_expected_numbers():
    rng = np.random.default_rng(10)
    weights = rng.dirichlet(np.ones(50))
    counts = np.array(
        [np.bincount(annealing._resampled(weights, 50, rng), minlength=50) for _ in range(4000)]
    )
    assert (np.abs(counts - 50 * weights) < 1).all()
    np.testing.assert_allclose(counts.mean(axis=0), 50 * weights, atol=4 * 0.5 / math.sqrt(4000))


def test_bars_do_not_change_draws(peaks):
    for sampler in (replace(TEMPERED, warmup=20), replace(SMC, particles=32)):
        shown, hidden = (
            sampler.sample(peaks, draws=5, seed=seeds.integer(0, "bars"), progress=progress)
            for progress in (True, False)
        )
        np.testing.assert_array_equal(shown.positions.values, hidden.positions.values)


@pytest.mark.parametrize("sampler", [TEMPERED, SMC], ids=lambda sampler: sampler.name)
def test_budgets_too_small_for_one_sweep_are_refused(peaks, sampler):
    def pilot(sampler):
        return budget.spent(sampler.sample(peaks, draws=2, progress=False))

    budget = Budget(evaluations=400)
    message = (
        rf"{sampler.name} needs [\d ]+ evaluations with .+=\d.*; the budget is 400 evaluations"
    )
    with pytest.raises(UnsupportedPosterior, match=message) as refused:
        affordable(budget, sampler, pilot)
    assert refused.value.word == "budget"
