"""Calibration passes exact samplers at the nominal level, and detects and names wrong ones."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest, kstest, norm
from toy_samplers import small_prior

from probmotion import Motion, MotionDraws, MotionPosterior, UnsupportedPosterior, seeds
from probmotion.calibration.grid import calibrate
from probmotion.calibration.negative_control import Overconfident
from probmotion.calibration.quantities import quantities
from probmotion.calibration.ranks import independent_draws, rank
from probmotion.calibration.result import Calibration
from probmotion.calibration.table import LEVELS, coverage_curve
from probmotion.comparison import Budget
from probmotion.metrics.uniformity import DENSITY, DISTANCE, uniformity_p_value
from probmotion.posteriors.problem import Problem, simulated
from probmotion.posteriors.sampling import Interrupted
from probmotion.problems.observations import observe

prior = cache(small_prior)


def unsimulated(how="occluded"):
    drawn = prior().sample(np.random.default_rng(0), 1)[0]
    likelihood = observe(Motion(drawn, prior().skeleton, 30.0), how, 0.3, 0)
    return Problem("toy", "a toy", MotionPosterior(prior(), likelihood), drawn)


def toy(how="occluded"):
    return simulated(unsimulated(how))


@dataclass(frozen=True)
class Batch:
    """Sampler of exact draws from one random stream; appends its seeds to a log file."""

    name: ClassVar[str] = "batch"
    requires: ClassVar[tuple[type, ...]] = ()
    effort: ClassVar[tuple[str, ...]] = ("thin",)
    prior_only: bool = False
    log: str = ""
    fails_above: float = math.inf
    thin: int = 1

    def sample(self, posterior, *, draws=1000, chains=1, seed=0, initial=None, progress=True):
        if self.log:
            with open(self.log, "a") as file:
                file.write(f"{seed}\n")
        rng = seeds.generator(seed, "batch")
        if rng.random() > self.fails_above:
            raise RuntimeError("division by zero")
        likelihood = None if self.prior_only else posterior.likelihood
        x = posterior.prior.exact_posterior(likelihood).sample(rng, draws * chains)
        return MotionDraws.of(
            posterior,
            self,
            x.reshape(chains, draws, *x.shape[1:]),
            seed=seed,
            seconds=1.5,
            theta=np.zeros((chains, draws, posterior.dim)),
            log_density=np.zeros((chains, draws)),
            statistics={"acceptance_rate": np.full((chains, draws), 0.25)},
            counts={"density": 7 * self.thin},
            independent=True,
        )


@dataclass(frozen=True)
class Unsupported(Batch):
    name: ClassVar[str] = "unfit"

    def sample(self, posterior, **options):
        raise UnsupportedPosterior("unfit", "accepts no likelihood", "observations", ["exact"])


@dataclass(frozen=True)
class Stopped(Batch):
    def sample(self, posterior, **options):
        raise Interrupted(super().sample(posterior, **options))


SMALL = {"draws": 30, "chains": 2, "workers": 0, "progress": False}


def direct_ranks(seed, shift=0.0, width=1.0, n=150, draws=50):
    """Return ranks for θ ~ N(0, 1), y | θ ~ N(θ, 1) and shifted, scaled posterior draws."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=n)
    y = theta + rng.normal(size=n)
    drawn = y[:, None] / 2 + math.sqrt(0.5) * (shift + width * rng.normal(size=(n, draws)))
    return np.array([rank(t, d, rng) for t, d in zip(theta, drawn, strict=True)])


def nominal_coverage(width):
    return 2 * norm.cdf(width * norm.ppf((1 + LEVELS) / 2)) - 1


def test_exact_draws_pass_at_the_nominal_level():
    p_values = [uniformity_p_value(direct_ranks(seed)) for seed in range(40)]
    assert kstest(p_values, "uniform").pvalue > 0.01
    assert binomtest(sum(p <= 0.05 for p in p_values), 40, 0.05).pvalue > 0.01


@pytest.mark.parametrize(("shift", "width"), [(0.5, 1), (-0.5, 1), (0, 0.6), (0, 1.6)])
def test_biased_narrow_and_wide_draws_fail(shift, width):
    for seed in range(3):
        assert uniformity_p_value(direct_ranks(seed, shift, width)) < 0.01
    if shift == 0:
        coverage = coverage_curve("direction 1", direct_ranks(0, width=width, n=2000, draws=200))
        assert np.abs(coverage - nominal_coverage(width)).max() < 0.04


def test_balls_and_highest_density_sets_of_a_gaussian():
    rng = np.random.default_rng(4)
    truth, draws = rng.normal(size=300), 0.5 * rng.normal(size=(300, 60))

    def coverage(quantity, function):
        ties = np.random.default_rng(5)
        ranks = [rank(function(t), function(d), ties) for t, d in zip(truth, draws, strict=True)]
        return coverage_curve(quantity, np.array(ranks))

    balls, highest = coverage(DISTANCE, np.abs), coverage(DENSITY, lambda x: -(x**2))
    np.testing.assert_allclose(balls, highest, atol=0.02)
    np.testing.assert_allclose(balls, nominal_coverage(0.5), atol=0.1)


def test_ties_are_broken_at_random():
    rng = np.random.default_rng(7)
    dice = rng.integers(0, 3, size=(400, 10))
    ranks = np.array([rank(row[0], row[1:], rng) for row in dice])
    assert uniformity_p_value(ranks) > 0.01
    assert rank(5.0, np.arange(5.0), rng) > 5 / 6
    assert rank(-1.0, np.arange(5.0), rng) < 1 / 6
    assert 0 < rank(-np.inf, np.full(9, -np.inf), rng) < 1


def autoregression(rng, n, draws, memory):
    x = np.empty((n, draws))
    x[:, 0] = rng.normal(size=n)
    for t in range(1, draws):
        x[:, t] = memory * x[:, t - 1] + math.sqrt(1 - memory**2) * rng.normal(size=n)
    return x


def run(times=None):
    """Return a stand-in for the draws of a chain, or of an ensemble if ``times`` is given."""
    dataset = {} if times is None else {"autocorrelation_time": pd.Series(times)}
    return SimpleNamespace(independent=False, dataset=dataset)


def test_chains_are_thinned_to_about_independent_draws():
    rng = np.random.default_rng(8)
    chains = autoregression(rng, 4, 500, 0.9)
    thinned = independent_draws(chains, run())
    expected = 4 * 500 * (1 - 0.9) / (1 + 0.9)
    assert 0.6 * expected < len(thinned) < 1.5 * expected
    assert set(thinned) <= set(chains.ravel())
    assert len(independent_draws(rng.normal(size=(4, 500)), run())) > 1500
    assert len(independent_draws(np.ones((2, 50)), run())) == 1
    assert len(independent_draws(chains, run([10.0, 20.0]))) == 100
    assert len(independent_draws(chains, run([10.0, np.nan]))) == 1


def test_exact_chains_pass_only_if_thinned():
    rng = np.random.default_rng(9)
    chains = autoregression(rng, 1200, 200, 0.9)
    pairs = list(zip(rng.normal(size=1200), chains, strict=True))
    thinned = [rank(t, independent_draws(chain[None], run()), rng) for t, chain in pairs[:300]]
    assert uniformity_p_value(np.array(thinned)) > 0.05
    assert uniformity_p_value(np.array([rank(t, chain, rng) for t, chain in pairs])) < 1e-3


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    samplers = {"batch": Batch(), "overconfident": Overconfident(Batch())}
    return calibrate(toy(), samplers, simulations=60, out=tmp_path_factory.mktemp("a"), **SMALL)


@pytest.fixture(scope="module")
def mixed():
    brittle = Batch(fails_above=0.7)
    samplers = {"prior": Batch(prior_only=True), "brittle": brittle, "unfit": Unsupported()}
    return calibrate(toy(), samplers, simulations=30, **SMALL)


def scores(calibration, sampler):
    table = pd.DataFrame(calibration.table())
    return table[table["sampler"] == sampler].set_index("quantity")


def test_exact_draws_pass_and_the_negative_control_fails(calibration):
    right, wrong = scores(calibration, "batch"), scores(calibration, "overconfident")
    assert right.loc["all", "p_value"] > 0.05
    assert wrong.loc["all", "p_value"] < 1e-4
    assert right.loc["all", "coverage_90"] == pytest.approx(0.9, abs=0.06)
    assert wrong.loc["all", "coverage_90"] < 0.75
    assert right.loc["all", "coverage_error"] < 0.05 < wrong.loc["all", "coverage_error"]
    sentence = calibration.verdict("toy", "batch")
    assert sentence.startswith("batch on toy: no deviation found in 60 simulations (p = ")
    sentence = calibration.verdict("toy", "overconfident")
    assert sentence.startswith("overconfident on toy: overconfident: 90 % intervals cover ")
    assert sentence.endswith(" % (p < .001, 60 simulations)")


def test_prior_draws_are_detected_by_the_likelihood_and_failures_counted(mixed):
    p_values = scores(mixed, "prior")["p_value"]
    names = [quantity.name for quantity in quantities(toy().posterior)]
    assert list(p_values.index) == ["all", *names, "log likelihood", "log density", "distance"]
    assert (p_values.drop(["all", "log likelihood", "log density"]) > 0.005).all()
    assert p_values["log likelihood"] < 1e-4
    assert "no deviation" not in mixed.verdict("toy", "prior")
    brittle, unfit = scores(mixed, "brittle"), scores(mixed, "unfit")
    failed = int(brittle.loc["all", "failed"])
    assert 2 < failed < 20
    assert brittle.loc["all", "simulations"] == 30 - failed
    assert len(mixed.ranks("toy", "brittle")["direction 1"]) == 30 - failed
    sentence = f"{failed} of 30 simulations failed, the first: division by zero"
    assert sentence in mixed.verdict("toy", "brittle")
    assert list(unfit.index) == ["all"]
    assert (unfit.loc["all", "failed"], unfit.loc["all", "simulations"]) == (30, 0)
    assert math.isnan(unfit.loc["all", "p_value"])
    assert mixed.verdict("toy", "unfit").startswith("unfit on toy: not supported, unfit accepts")
    assert f"brittle on toy: division by zero ({failed} of 30 simulations)" in mixed.notes
    assert any("accepts no likelihood; try exact (30 of 30 sim" in note for note in mixed.notes)
    assert len(mixed.failures) == failed + 30


def test_the_table_prints_a_line_per_sampler(mixed):
    table = mixed.table()
    lines = str(table).splitlines()
    assert lines[0] == "toy"
    assert [line.split()[0] for line in lines[2:5]] == list(mixed.plan.samplers)
    assert {mixed.verdict("toy", sampler) for sampler in mixed.plan.samplers} < {*lines}
    stored = pd.read_csv(mixed.folder / "table.csv")
    assert list(stored.columns) == list(table.columns)
    assert stored["p_value"].to_numpy() == pytest.approx(table["p_value"].to_numpy(), nan_ok=True)


def test_coverage_has_an_interval(calibration):
    frame = calibration.coverage("toy", "batch")
    assert frame["coverage"].between(frame["lower"], frame["upper"]).all()
    assert frame["level"].between(frame["lower"], frame["upper"]).mean() > 0.8


def test_loading_and_plotting(calibration, monkeypatch, tmp_path):
    again = Calibration.load(calibration.folder.parent)
    assert again.table().equals(calibration.table())
    drawn = {}
    monkeypatch.setattr(
        "probmotion.plots.ranks.draw_ranks", lambda blocks, path: drawn.update({path: blocks})
    )
    assert again.plot() == calibration.folder / "ranks.png"
    assert calibration.plot(tmp_path / "a.png", problem="toy") == tmp_path / "a.png"
    verdicts = [again.verdict("toy", name) for name in ("batch", "overconfident")]
    assert [list(blocks) for blocks in drawn.values()] == [verdicts, verdicts]
    with pytest.raises(ValueError, match="sampler must be one of batch, overconfident, got 'mas'"):
        calibration.ranks("toy", "mas")
    with pytest.raises(ValueError, match="problem must be one of toy, got 'gait'"):
        calibration.plot(tmp_path / "a.png", problem="gait")
    with pytest.raises(ValueError, match=r"comparison\.json"):
        Calibration.load(tmp_path)


def test_resuming_and_extending(tmp_path):
    log = tmp_path / "log"
    once = partial(calibrate, toy(), Batch(log=str(log)), **SMALL)
    first = once(simulations=10, out=tmp_path / "kept")
    assert len(log.read_text().split()) == 10
    more = once(simulations=14, out=tmp_path / "kept")
    assert len(set(log.read_text().split())) == len(log.read_text().split()) == 14
    with ThreadPoolExecutor(2) as executor:
        other = once(simulations=14, executor=executor)
    for name, ranks in other.ranks("toy", "batch").items():
        np.testing.assert_array_equal(ranks, more.ranks("toy", "batch")[name])
        np.testing.assert_array_equal(ranks[:10], first.ranks("toy", "batch")[name])
    with pytest.raises(ValueError, match="contains finished runs with"):
        once(simulations=10, out=tmp_path / "kept", draws=20)


def test_the_budget_is_the_same_for_all_simulations(tmp_path):
    log = tmp_path / "log"
    sampler = Batch(log=str(log))
    once = partial(calibrate, toy(), sampler, out=tmp_path / "kept", **SMALL)
    result = once(simulations=10, budget=Budget(evaluations=350))
    pilots = len(log.read_text().split()) - 10
    assert pilots > 0
    assert result.notes[0].endswith("per simulation")
    assert result.notes[1] == "used per simulation: batch 350 to 350"
    once(simulations=12, budget=Budget(evaluations=350))
    assert len(log.read_text().split()) == pilots + 12
    expected = calibrate(toy(), replace(sampler, thin=50), simulations=10, **SMALL)
    for name, ranks in expected.ranks("toy", "batch").items():
        np.testing.assert_array_equal(result.ranks("toy", "batch")[name], ranks)
    with pytest.raises(ValueError, match="contains finished runs with"):
        once(simulations=12, budget=Budget(evaluations=700))


def test_draws_are_not_stored_and_temporary_folders_are_removed():
    result = calibrate(toy("none"), Batch(), simulations=10, **SMALL)
    folder = result.folder
    assert not list(folder.rglob("draws.nc"))
    names = set(result.ranks("toy", "batch"))
    assert not any(name.startswith(("log likelihood", "hidden")) for name in names)
    del result
    assert not folder.parent.exists()


def test_posteriors_are_simulated_from_their_prior():
    results = [
        calibrate({"toy": target}, Batch(), simulations=10, **SMALL)
        for target in (toy(), toy().posterior)
    ]
    first, second = (result.ranks("toy", "batch") for result in results)
    assert first.keys() == second.keys()
    for name, ranks in first.items():
        np.testing.assert_array_equal(ranks, second[name])


@pytest.mark.parametrize(
    ("problem", "options", "message"),
    [
        (unsimulated, {}, "problems must have simulate, got 'toy' without"),
        (toy, {"samplers": np.zeros((2, 3))}, "must sample every simulation, got finished draws"),
        (toy, {"simulations": 3}, "simulations must be an integer of at least 10, got 3"),
        (toy, {"draws": 41}, "draws must be a multiple of chains, 2, got 41"),
        (toy, {"budget": 350}, "budget must be a Budget, got 350"),
    ],
)
def test_invalid_arguments(problem, options, message):
    with pytest.raises(ValueError, match=message):
        calibrate(problem(), **({"samplers": Batch(), "simulations": 10} | SMALL | options))
    for factor in (0, 1, math.nan):
        with pytest.raises(ValueError, match="factor must be"):
            Overconfident(Batch(), factor)


def test_simulations_may_lack_a_truth_or_a_quantity():
    no_truth = replace(unsimulated(), simulate=lambda number: replace(unsimulated(), truth=None))
    result = calibrate(no_truth, Batch(), simulations=10, **SMALL)
    assert "simulations of toy must have a truth" in result.verdict("toy", "batch")
    unobserved = replace(unsimulated(), posterior=MotionPosterior(prior()))
    problem = replace(toy(), simulate=lambda n: toy().simulate(n) if n % 3 else unobserved)
    result = calibrate(problem, Batch(), simulations=10, **SMALL)
    assert result.failures == []
    assert {len(ranks) for ranks in result.ranks("toy", "batch").values()} == {10}
    assert "log likelihood" not in result.ranks("toy", "batch")
    assert "batch on toy: log likelihood skipped, not in all simulations" in result.notes


def test_the_negative_control_shrinks_draws_towards_their_mean():
    posterior = unsimulated().posterior
    options = {"draws": 30, "chains": 2, "seed": 3}
    right = Batch().sample(posterior, **options)
    wrong = Overconfident(Batch(), 0.25).sample(posterior, **options)
    np.testing.assert_allclose(wrong.flat().mean(axis=0), right.flat().mean(axis=0))
    np.testing.assert_allclose(wrong.flat().std(axis=0), 0.25 * right.flat().std(axis=0))
    assert wrong.dataset.attrs["sampler"] == "overconfident"
    assert wrong.counts == {"density": 7}
    assert wrong.independent
    assert (wrong.dataset["acceptance_rate"] == 0.25).all()
    assert not {"log_density", "theta"} & set(wrong.dataset)
    with pytest.raises(Interrupted) as stop:
        Overconfident(Stopped(), 0.25).sample(posterior, **options)
    np.testing.assert_array_equal(stop.value.draws.flat(), wrong.flat())
