"""Calibration: what is right passes with the stated level, what is wrong is found and named."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
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
from probmotion.metrics.credible_sets import DENSITY, DISTANCE, credible_level
from probmotion.metrics.uniformity import uniformity_p_value
from probmotion.posteriors.problem import Problem, simulated
from probmotion.posteriors.sampling import Interrupted
from probmotion.problems.observations import observe

prior = cache(small_prior)


def plain(how="occluded"):
    drawn = prior().sample(np.random.default_rng(0), 1)[0]
    evidence = observe(Motion(drawn, prior().skeleton, 30.0), how, 0.3, 0)
    return Problem("toy", "a toy", MotionPosterior(prior(), evidence), drawn)


def toy(how="occluded"):
    return simulated(plain(how))


@dataclass(frozen=True)
class Batch:
    """Exact draws, all from one stream: quicker than one stream each. Notes its runs in a file."""

    name: ClassVar[str] = "batch"
    requires: ClassVar[tuple[type, ...]] = ()
    blind: bool = False
    diary: str = ""
    fails_above: float = math.inf
    thin: int = 1

    def sample(self, posterior, *, draws=1000, chains=1, seed=0, initial=None, progress=True):
        if self.diary:
            with open(self.diary, "a") as file:
                file.write(f"{seed}\n")
        rng = seeds.generator(seed, "batch")
        if rng.random() > self.fails_above:
            raise RuntimeError("the floor gave way")
        likelihood = None if self.blind else posterior.likelihood
        x = posterior.prior.exact_posterior(likelihood).sample(rng, draws * chains)
        return MotionDraws.of(
            posterior,
            self,
            x.reshape(chains, draws, *x.shape[1:]),
            seed=seed,
            seconds=1.5,
            theta=np.zeros((chains, draws, posterior.dim)),
            log_density=np.zeros((chains, draws)),
            statistics={"acceptance": np.full((chains, draws), 0.25)},
            counts={"density": 7 * self.thin},
            independent=True,
        )


@dataclass(frozen=True)
class Paid(Batch):
    """Notes how it was thinned."""

    effort: ClassVar[tuple[str, ...]] = ("thin",)

    def sample(self, posterior, **asked):
        Path(self.diary).parent.joinpath(f"thin-{self.thin}").touch()
        return super().sample(posterior, **asked)


@dataclass(frozen=True)
class Unfit(Batch):
    name: ClassVar[str] = "unfit"

    def sample(self, posterior, **settings):
        raise UnsupportedPosterior("unfit", "takes no evidence", "observations", ["exact"])


SMALL = {"draws": 30, "chains": 2, "workers": 0, "progress": False}


# Direct ranks: a Gaussian posterior N(μ, 1) of θ, draws of N(μ + shift, width²).


def direct_ranks(seed, shift=0.0, width=1.0, n=150, draws=50):
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=n)
    # Given y ~ N(θ, 1): θ | y ~ N(y/2, 1/2).
    y = theta + rng.normal(size=n)
    drawn = y[:, None] / 2 + math.sqrt(0.5) * (shift + width * rng.normal(size=(n, draws)))
    return np.array([rank(t, d, rng) for t, d in zip(theta, drawn, strict=True)])


def test_exact_draws_of_a_conjugate_gaussian_pass_with_the_stated_level():
    p_values = [uniformity_p_value(direct_ranks(seed)) for seed in range(40)]
    assert kstest(p_values, "uniform").pvalue > 0.01
    assert binomtest(sum(p <= 0.05 for p in p_values), 40, 0.05).pvalue > 0.01


@pytest.mark.parametrize(("shift", "width"), [(0.5, 1), (-0.5, 1), (0, 0.6), (0, 1.6)])
def test_biased_narrow_and_wide_draws_fail(shift, width):
    for seed in range(5):
        assert uniformity_p_value(direct_ranks(seed, shift, width)) < 0.01


def test_coverage_is_what_the_widths_say():
    for width in (0.5, 1.0, 2.0):
        ranks = direct_ranks(0, width=width, n=4000, draws=200)
        expected = 2 * norm.cdf(width * norm.ppf((1 + LEVELS) / 2)) - 1
        assert np.abs(coverage_curve("direction 1", ranks) - expected).max() < 0.03


@pytest.mark.parametrize("width", [0.5, 1.0])
def test_in_one_dimension_balls_about_the_middle_are_the_sets_of_highest_density(width):
    rng = np.random.default_rng(4)
    truth = rng.normal(size=300)
    draws = width * rng.normal(size=(300, 60))

    def of(quantity, function):
        ties = np.random.default_rng(5)
        ranks = [rank(function(t), function(d), ties) for t, d in zip(truth, draws, strict=True)]
        return coverage_curve(quantity, np.array(ranks))

    balls = of(DISTANCE, np.abs)
    highest = of(DENSITY, lambda x: -(x**2))
    central = of("direction 1", lambda x: x)
    # The same ranks from the other end; U differs.
    np.testing.assert_allclose(balls, highest, atol=0.02)
    expected = 2 * norm.cdf(width * norm.ppf((1 + LEVELS) / 2)) - 1
    for found in (balls, highest, central):
        np.testing.assert_allclose(found, expected, atol=0.1)


def test_balls_about_random_points_cover_as_they_say_if_draws_are_exact():
    rng = np.random.default_rng(6)
    truth, elsewhere = 2 * rng.normal(size=(2, 2000))
    y = truth + rng.normal(size=2000)
    exact = 0.8 * y[:, None] + math.sqrt(0.8) * rng.normal(size=(2000, 40))
    for draws, right in (
        (exact, True),
        (0.8 * y[:, None] + 0.5 * (exact - 0.8 * y[:, None]), False),
    ):
        ranks = np.array(
            [
                rank(abs(t - e), abs(d - e), rng)
                for t, d, e in zip(truth, draws, elsewhere, strict=True)
            ]
        )
        assert (uniformity_p_value(credible_level(DISTANCE, ranks)) > 0.01) == right


def test_ties_are_broken_at_random():
    rng = np.random.default_rng(7)
    dice = rng.integers(0, 3, size=(400, 10))
    ranks = np.array([rank(row[0], row[1:], rng) for row in dice])
    assert uniformity_p_value(ranks) > 0.01
    assert rank(5.0, np.arange(5.0), rng) > 5 / 6
    assert rank(-1.0, np.arange(5.0), rng) < 1 / 6
    # None where only −∞ is: the truth may be anywhere.
    assert 0 < rank(-np.inf, np.full(9, -np.inf), rng) < 1


def autoregression(rng, n, draws, memory):
    x = np.empty((n, draws))
    x[:, 0] = rng.normal(size=n)
    for t in range(1, draws):
        x[:, t] = memory * x[:, t - 1] + math.sqrt(1 - memory**2) * rng.normal(size=n)
    return x


class Run:
    """What `independent_draws` asks of a run."""

    independent = False
    dataset: ClassVar[dict] = {}


def test_chains_are_thinned_to_about_independent_draws():
    rng = np.random.default_rng(8)
    chains = autoregression(rng, 4, 500, 0.9)
    kept = independent_draws(chains, Run())
    expected = 4 * 500 * (1 - 0.9) / (1 + 0.9)
    assert 0.6 * expected < len(kept) < 1.5 * expected
    assert set(kept) <= set(chains.ravel())
    assert len(independent_draws(rng.normal(size=(4, 500)), Run())) > 1500
    # What never moves is one draw.
    assert len(independent_draws(np.ones((2, 50)), Run())) == 1
    walkers = Run()
    walkers.dataset = {"autocorrelation_time": pd.Series([10.0, 20.0])}
    assert len(independent_draws(chains, walkers)) == 100
    walkers.dataset = {"autocorrelation_time": pd.Series([10.0, np.nan])}
    assert len(independent_draws(chains, walkers)) == 1


def test_a_right_chain_passes_thinned_and_would_not_unthinned():
    rng = np.random.default_rng(9)
    chains = autoregression(rng, 1200, 200, 0.9)
    pairs = list(zip(rng.normal(size=1200), chains, strict=True))
    thinned = [rank(t, independent_draws(chain[None], Run()), rng) for t, chain in pairs[:300]]
    assert uniformity_p_value(np.array(thinned)) > 0.05
    assert uniformity_p_value(np.array([rank(t, chain, rng) for t, chain in pairs])) < 1e-3


# The whole, on a small mixture.


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    samplers = {"batch": Batch(), "overconfident": Overconfident(Batch())}
    return calibrate(toy(), samplers, simulations=100, out=tmp_path_factory.mktemp("a"), **SMALL)


@pytest.fixture(scope="module")
def odd():
    samplers = {"blind": Batch(blind=True), "brittle": Batch(fails_above=0.7), "unfit": Unfit()}
    return calibrate(toy(), samplers, simulations=30, **SMALL)


def scores(calibration, sampler):
    table = pd.DataFrame(calibration.table())
    return table[table["sampler"] == sampler].set_index("quantity")


def test_exact_draws_pass_and_the_negative_control_fails_at_once(calibration):
    right, wrong = scores(calibration, "batch"), scores(calibration, "overconfident")
    assert right.loc["all", "p_value"] > 0.05
    assert wrong.loc["all", "p_value"] < 1e-6
    assert right.loc["all", "coverage_90"] == pytest.approx(0.9, abs=0.06)
    assert wrong.loc["all", "coverage_90"] < 0.75
    assert right.loc["all", "coverage_error"] < 0.05 < wrong.loc["all", "coverage_error"]
    assert calibration.verdict("toy", "batch").startswith(
        "batch on toy: no deviation found in 100 simulations (p = "
    )
    sentence = calibration.verdict("toy", "overconfident")
    assert sentence.startswith("overconfident on toy: too sure: 90 % intervals hold ")
    assert sentence.endswith(" % (p < .001, 100 simulations)")


def test_draws_from_the_prior_are_found_by_what_depends_on_the_evidence(odd):
    blind = scores(odd, "blind")["p_value"]
    assert (blind.drop(["all", "log likelihood", "log density"]) > 0.005).all()
    assert blind["log likelihood"] < 1e-4
    assert "no deviation" not in odd.verdict("toy", "blind")


def test_failures_are_counted_and_said(odd):
    brittle, unfit = scores(odd, "brittle"), scores(odd, "unfit")
    failed = int(brittle.loc["all", "failed"])
    assert 2 < failed < 20
    assert brittle.loc["all", "simulations"] == 30 - failed
    assert len(odd.ranks("toy", "brittle")["direction 1"]) == 30 - failed
    said = f"{failed} of 30 simulations failed, the first: the floor gave way"
    assert said in odd.verdict("toy", "brittle")
    assert list(unfit.index) == ["all"]
    assert (unfit.loc["all", "failed"], unfit.loc["all", "simulations"]) == (30, 0)
    assert math.isnan(unfit.loc["all", "p_value"])
    assert odd.verdict("toy", "unfit").startswith("unfit on toy: not supported, unfit takes")
    assert f"brittle on toy: the floor gave way ({failed} of 30 simulations)" in odd.notes
    assert (
        "unfit on toy: unfit takes no evidence; exact would do (30 of 30 simulations)" in odd.notes
    )
    assert len(odd.failures) == failed + 30


def test_the_table_is_tidy_and_prints_a_line_per_sampler(odd):
    table = odd.table()
    assert list(table.columns) == [
        "problem", "sampler", "quantity", "p_value", "coverage_90", "coverage_error",
        "simulations", "failed",
    ]  # fmt: skip
    assert not table.duplicated(["problem", "sampler", "quantity"]).any()
    asked = [one.name for one in quantities(toy().posterior)]
    assert list(scores(odd, "blind").index) == [
        "all", *asked, "log likelihood", "log density", "distance",
    ]  # fmt: skip
    lines = str(table).splitlines()
    assert lines[0] == "toy"
    assert [line.split()[0] for line in lines[2:5]] == list(odd.plan.samplers)
    assert max(map(len, lines[:5])) <= 100
    for sampler in odd.plan.samplers:
        assert odd.verdict("toy", sampler) in lines
    kept = pd.read_csv(odd.folder / "table.csv")
    assert kept["p_value"].to_numpy() == pytest.approx(table["p_value"].to_numpy(), nan_ok=True)


def test_coverage_has_an_interval_that_holds_it(calibration):
    frame = calibration.coverage("toy", "batch")
    assert (frame["lower"] <= frame["coverage"]).all()
    assert (frame["coverage"] <= frame["upper"]).all()
    ninety = frame[frame["level"] == 0.9].set_index("quantity")["coverage"]
    assert ninety["direction 1"] == scores(calibration, "batch").loc["direction 1", "coverage_90"]
    inside = (frame["lower"] <= frame["level"]) & (frame["level"] <= frame["upper"])
    assert inside.mean() > 0.8


def test_it_is_read_again_and_plotted(calibration, monkeypatch, tmp_path):
    again = Calibration.load(calibration.folder.parent)
    assert again.table().equals(calibration.table())
    drawn = {}
    monkeypatch.setattr(
        "probmotion.plots.ranks.draw_ranks",
        lambda blocks, path: drawn.update({path: blocks}),
    )
    assert again.plot() == calibration.folder / "ranks.png"
    assert calibration.plot(tmp_path / "a.png", problem="toy") == tmp_path / "a.png"
    for blocks in drawn.values():
        assert list(blocks) == [again.verdict("toy", name) for name in ("batch", "overconfident")]
    with pytest.raises(ValueError, match="sampler must be one of batch, over, got 'mas'"):
        calibration.ranks("toy", "mas")
    with pytest.raises(ValueError, match="problem must be one of toy, got 'gait'"):
        calibration.plot(tmp_path / "a.png", problem="gait")
    with pytest.raises(ValueError, match=r"which holds no comparison\.json"):
        Calibration.load(tmp_path)


def test_a_run_goes_on_where_it_was_and_ranks_do_not_depend_on_the_order(tmp_path):
    diary = tmp_path / "diary"
    once = partial(calibrate, toy(), Batch(diary=str(diary)), **SMALL)
    first = once(simulations=10, out=tmp_path / "kept")
    assert len(diary.read_text().split()) == 10
    more = once(simulations=14, out=tmp_path / "kept")
    assert len(set(diary.read_text().split())) == len(diary.read_text().split()) == 14
    with ThreadPoolExecutor(2) as executor:
        other = once(simulations=14, executor=executor)
    for name, ranks in other.ranks("toy", "batch").items():
        np.testing.assert_array_equal(ranks, more.ranks("toy", "batch")[name])
        np.testing.assert_array_equal(ranks[:10], first.ranks("toy", "batch")[name])
    with pytest.raises(ValueError, match="made with other settings"):
        once(simulations=10, out=tmp_path / "kept", draws=20)


def test_what_a_budget_buys_is_found_once_and_all_simulations_have_it(tmp_path):
    paid = Paid(diary=str(tmp_path / "diary"))
    asked = partial(calibrate, toy(), paid, out=tmp_path / "kept", **SMALL)
    held = asked(simulations=10, budget=Budget(evaluations=350))
    assert (tmp_path / "thin-50").exists()
    pilots = len((tmp_path / "diary").read_text().split()) - 10
    assert pilots > 0
    assert held.notes[0].startswith("every sampler had 350 evaluations")
    assert held.notes[0].endswith("per simulation")
    assert held.notes[1] == "used per simulation: batch 350 to 350"
    assert not list((tmp_path / "kept").rglob("draws.nc"))
    asked(simulations=12, budget=Budget(evaluations=350))
    assert len((tmp_path / "diary").read_text().split()) == pilots + 12
    plain_ranks = calibrate(toy(), replace(paid, thin=50), simulations=10, **SMALL)
    for name, ranks in plain_ranks.ranks("toy", "batch").items():
        np.testing.assert_array_equal(held.ranks("toy", "batch")[name], ranks)
    with pytest.raises(ValueError, match="made with other settings"):
        asked(simulations=12, budget=Budget(evaluations=700))
    with pytest.raises(ValueError, match="budget must be a Budget, got 350"):
        asked(simulations=12, budget=350)


def test_no_draws_are_kept_and_a_temporary_folder_goes(tmp_path):
    held = calibrate(toy("none"), Batch(), simulations=10, **SMALL)
    folder = Path(held.folder)
    assert not list(folder.rglob("draws.nc"))
    assert "log likelihood" not in held.ranks("toy", "batch")
    assert not any(name.startswith("hidden") for name in held.ranks("toy", "batch"))
    del held
    assert not folder.parent.exists()


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="problems has 'toy', which cannot be simulated"):
        calibrate(plain(), Batch(), simulations=10, **SMALL)
    with pytest.raises(ValueError, match="simulations must be an integer of at least 10, got 3"):
        calibrate(toy(), Batch(), simulations=3, **SMALL)
    with pytest.raises(ValueError, match="draws must be a multiple of chains, 2, got 41"):
        calibrate(toy(), Batch(), simulations=10, draws=41, chains=2)
    no_truth = replace(plain(), simulate=lambda number: replace(plain(), truth=None))
    held = calibrate(no_truth, Batch(), simulations=10, **SMALL)
    assert "toy simulates no truth" in held.verdict("toy", "batch")


def test_simulations_that_differ_in_kind_are_judged_by_what_they_share():
    bare = replace(plain(), posterior=MotionPosterior(prior()))
    problem = replace(toy(), simulate=lambda n: toy().simulate(n) if n % 3 else bare)
    held = calibrate(problem, Batch(), simulations=10, **SMALL)
    assert held.failures == []
    assert {len(ranks) for ranks in held.ranks("toy", "batch").values()} == {10}
    assert "log likelihood" not in held.ranks("toy", "batch")
    (said,) = (note for note in held.notes if "left out" in note)
    assert said == ("batch on toy: log likelihood is left out, which not all simulations have")
    assert held.ranked


# The negative control.


def test_overconfident_draws_keep_their_mean_and_lose_the_rest():
    posterior = plain().posterior
    right = Batch().sample(posterior, draws=30, chains=2, seed=3)
    wrong = Overconfident(Batch(), 0.25).sample(posterior, draws=30, chains=2, seed=3)
    np.testing.assert_allclose(wrong.flat().mean(axis=0), right.flat().mean(axis=0))
    np.testing.assert_allclose(wrong.flat().std(axis=0), 0.25 * right.flat().std(axis=0))
    assert wrong.dataset.attrs["sampler"] == "overconfident"
    assert wrong.counts == {"density": 7}
    assert wrong.independent
    assert (wrong.dataset["acceptance"] == 0.25).all()
    assert "log_density" not in wrong.dataset
    assert "theta" not in wrong.dataset


@pytest.mark.parametrize("factor", [0, 1, 2.0, math.nan])
def test_a_factor_that_does_not_shrink_is_refused(factor):
    with pytest.raises(ValueError, match="factor is"):
        Overconfident(Batch(), factor)


@dataclass(frozen=True)
class Stopped(Batch):
    def sample(self, posterior, **settings):
        raise Interrupted(super().sample(posterior, **settings))


def test_what_an_interrupted_sampler_had_finished_is_pulled_too():
    settings = {"draws": 10, "chains": 2, "seed": 1}
    expected = Overconfident(Batch()).sample(plain().posterior, **settings)
    with pytest.raises(Interrupted) as stop:
        Overconfident(Stopped()).sample(plain().posterior, **settings)
    np.testing.assert_array_equal(stop.value.draws.flat(), expected.flat())
