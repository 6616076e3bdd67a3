"""Equal budgets: affordable settings, identical in every run of a sampler."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from toy_samplers import SMALL, Napping, PriorDraws, Walking, count, generation, monocular

from probmotion import UnsupportedPosterior
from probmotion.comparison import Budget, Comparison, compare
from probmotion.comparison.results.budgets import affordable, effort_of
from probmotion.files import read_json, write_json
from probmotion.posteriors.sampling import load_sampler, sampler_names
from probmotion.samplers import MetropolisHastings, MultiViewAncestral, SplitGibbs


class Pilot:
    """Pilot with a given cost that records the strides it ran with."""

    def __init__(self, cost):
        self.cost = cost
        self.strides = []

    def __call__(self, sampler):
        self.strides.append(sampler.stride)
        return self.cost(sampler.stride)


@pytest.mark.parametrize("fixed", [0, 70, 900])
@pytest.mark.parametrize("slope", [1, 7.5, 60])
@pytest.mark.parametrize("amount", [1030, 5000, 123_456])
def test_the_largest_effort_within_the_budget_is_chosen(fixed, slope, amount):
    pilot = Pilot(lambda stride: fixed + slope * stride)
    stride = affordable(Budget(evaluations=amount), Walking(), pilot)["stride"]
    assert fixed + slope * stride <= amount < fixed + slope * (stride + 1)
    # Without the fixed cost, all pilots spend about one budget.
    assert sum(slope * stride for stride in pilot.strides) <= 1.1 * amount
    assert len(pilot.strides) <= 7


def test_other_effort_settings_are_scaled_in_proportion():
    pilot = Pilot(lambda stride: 10 * stride)
    settings = affordable(Budget(evaluations=300), Walking(stride=20, start=100), pilot)
    assert settings == {"stride": 30, "start": 150}
    assert affordable(Budget(evaluations=25), Walking(stride=20, start=3), pilot)["start"] == 1
    assert affordable(Budget(evaluations=25), Walking(stride=20, start=0), pilot)["start"] == 0


@pytest.mark.parametrize("amount", [150, 592, 1184])
def test_budgets_determine_the_particles_of_split_gibbs(amount):
    def pilot(sampler):
        return sampler.start_steps * sampler.particles + sampler.steps

    settings = affordable(Budget(evaluations=amount), SplitGibbs(), pilot)
    assert settings["particles"] == round(settings["steps"] / 50)
    # The number of particles is rounded, and so is the cost.
    assert pilot(SplitGibbs(**settings)) == pytest.approx(amount, rel=0.1)


def test_efforts_of_zero_keep_other_settings():
    def pilot(sampler):
        return sampler.particles

    sampler = SplitGibbs(steps=0)
    assert affordable(Budget(evaluations=8), sampler, pilot) == {"steps": 0, "particles": 8}


def test_a_budget_below_the_least_effort_is_unsupported():
    pilot = Pilot(lambda stride: 100 + 10 * stride)
    message = "walking needs 120 evaluations with stride=2, s"
    with pytest.raises(UnsupportedPosterior, match=message) as error:
        affordable(Budget(evaluations=119), Walking(), pilot)
    assert error.value.word == "budget"
    assert affordable(Budget(evaluations=120), Walking(), pilot)["stride"] == 2


@pytest.mark.parametrize("most", [10, 12, 15, 37])
def test_the_range_of_the_settings_limits_the_effort(most):
    pilot = Pilot(lambda stride: stride)
    assert affordable(Budget(evaluations=5000), Walking(most=most), pilot)["stride"] == most
    assert max(pilot.strides) <= most


def test_samplers_without_effort_keep_their_settings():
    pilot = Pilot(lambda stride: 5)
    for sampler in (Walking(), PriorDraws()):
        assert affordable(Budget(evaluations=5000), sampler, pilot) == {}
    assert max(pilot.strides) <= 64 * 20
    # Also if the noise of seconds looks like a small increase.
    pilot = Pilot(lambda stride: 10.0 if len(pilot.strides) < 3 else 11.5)
    assert affordable(Budget(seconds=60.0), Walking(), pilot) == {}
    assert len(pilot.strides) < 10


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "either evaluations or seconds, got None and None"),
        ({"evaluations": 5, "seconds": 1.0}, r"either evaluations or seconds, got 5 and 1\.0"),
        ({"evaluations": 0}, "evaluations must be an integer of at least 1, got 0"),
        ({"evaluations": 1.5}, r"evaluations must be an integer of at least 1, got 1\.5"),
        ({"seconds": -1.0}, r"seconds must be a finite number above 0, got -1\.0"),
    ],
)
def test_invalid_budgets_raise(given, message):
    with pytest.raises(ValueError, match=message):
        Budget(**given)


def test_budgets_of_integer_and_float_seconds_have_the_same_fingerprint():
    assert repr(Budget(seconds=6)) == repr(Budget(seconds=6.0))


@pytest.mark.parametrize("name", sampler_names())
def test_effort_settings_of_registered_samplers_are_integers(name):
    sampler = load_sampler(name)()
    assert bool(effort_of(sampler)) == (name != "exact")
    for setting in effort_of(sampler):
        assert isinstance(getattr(sampler, setting), int)
    if effort_of(sampler):
        least = getattr(sampler, "least_effort", 1)
        dataclasses.replace(sampler, **{effort_of(sampler)[0]: least})


def test_runs_spend_the_budget_and_record_it(tmp_path):
    samplers = {"a": Walking(stride=7, start=3), "b": Walking(start=1000), "free": PriorDraws(2.0)}
    budget = Budget(evaluations=2000)
    comparison = compare(generation(), samplers, seeds=2, budget=budget, out=tmp_path, **SMALL)
    table = comparison.table().set_index(["sampler", "seed", "metric"])["value"]
    for sampler in "ab":
        settings = []
        for seed in (0, 1):
            used = table[sampler, seed, "density_evaluations"]
            used += 2 * table[sampler, seed, "gradient_evaluations"]
            assert 0.9 * 2000 <= used <= 2000
            assert table[sampler, seed, "budget_used"] == used
            run = tmp_path / "runs" / "generation" / sampler / str(seed) / "run.json"
            stored = json.loads(run.read_text())["budget"]
            assert stored["used"] == used
            assert stored["allowed"].startswith("2 000 evaluations")
            attributes = comparison.draws("generation", sampler, seed).dataset.attrs
            assert stored["settings"].items() <= json.loads(attributes["settings"]).items()
            assert table[sampler, seed, "set_stride"] == stored["settings"]["stride"]
            settings.append(stored["settings"])
        assert settings[0] == settings[1]
    assert table["free", 0, "denoiser_evaluations"] == 100
    notes = Comparison.load(tmp_path).notes
    assert "every sampler had 2 000 evaluations (a gradient counts 2, any other 1) per run" in notes
    assert "free has no effort setting and ran with the given settings" in notes
    used = f"{table['a', 0, 'budget_used']:.3g}"
    (note,) = (note for note in notes if note.startswith("used per run"))
    assert f": a {used} to {used}, b" in note
    # Settings that the budget replaced are not reported as changed.
    assert not any(note.startswith("a ran with") for note in notes)
    assert "free ran with spread=2.0 and defaults otherwise" in notes


def test_pilots_are_stored_for_later_runs(tmp_path):
    diary = tmp_path / "diary"
    settings = {"budget": Budget(evaluations=2000), "out": tmp_path / "out", **SMALL}
    sampler = Walking(diary=str(diary))
    first = compare(generation(), sampler, **settings)
    before = count(diary)
    assert before > 1
    more = compare(generation(), sampler, **settings | {"seeds": 3})
    assert count(diary) == before + 2
    assert {str(result.budget) for result in more.results} == {str(first.results[0].budget)}
    for budget in (Budget(evaluations=3000), Budget(seconds=3.0), None):
        with pytest.raises(ValueError, match="contains finished runs with budget 2 000 evaluatio"):
            compare(generation(), sampler, **settings | {"budget": budget})


def test_stored_pilots_of_seconds_are_not_repeated(tmp_path):
    settings = {"budget": Budget(seconds=0.4), "out": tmp_path, **SMALL}
    (result,) = compare(generation(), Napping(), **settings).results
    assert result.budget["settings"] == {"rounds": 40}
    assert result.metrics["budget_used"] == pytest.approx(0.4)
    (path,) = tmp_path.glob("pilots/*/*.json")
    stored = path.read_text()
    # Other settings, as another measurement may give them, are not mixed with stored runs.
    write_json(path, read_json(path) | {"settings": {"rounds": 30}})
    with pytest.raises(ValueError, match="made with other settings"):
        compare(generation(), Napping(), **settings)
    path.write_text(stored)
    more = compare(generation(), Napping(), **settings | {"seeds": 2})
    assert {each.budget["settings"]["rounds"] for each in more.results} == {40}
    assert "every sampler had 0.4 seconds per run" in more.notes


def test_compilation_in_the_first_pilot_does_not_count():
    pilot = Pilot(lambda stride: 0.01 * stride + (10 if len(pilot.strides) == 1 else 0))
    assert affordable(Budget(seconds=3.0), Walking(), pilot)["stride"] == 300
    assert pilot.strides[0] == pilot.strides[1]


@pytest.mark.parametrize("slowed", range(7))
def test_a_pilot_that_was_slowed_down_is_repeated(slowed):
    pilot = Pilot(
        lambda stride: (0.05 + 0.01 * stride) * (1.5 if len(pilot.strides) == 1 + slowed else 1)
    )
    settings = affordable(Budget(seconds=6), Walking(stride=100), pilot)
    assert settings["stride"] == pytest.approx(595, rel=0.01)
    # Five pilots suffice if none is slow; others repeat only what deviates.
    assert len(pilot.strides) <= (8 if slowed < 5 else 5)
    assert sum(0.05 + 0.01 * stride for stride in pilot.strides) < 1.5 * 6


def test_nonlinear_costs_are_repeated_once_within_the_budget():
    pilot = Pilot(lambda stride: 1e-3 * stride**1.5)
    stride = affordable(Budget(seconds=6.0), Walking(stride=100), pilot)["stride"]
    assert 0.5 * 6 < 1e-3 * stride**1.5 < 1.5 * 6
    assert all(pilot.strides.count(stride) <= 2 for stride in pilot.strides)
    counted = Pilot(pilot.cost)
    affordable(Budget(evaluations=6), Walking(stride=100), counted)
    assert len(counted.strides) == len(set(counted.strides))


def test_samplers_that_exceed_the_budget_are_recorded():
    samplers = {"rich": Walking(start=10**6), "poor": Walking()}
    comparison = compare(generation(), samplers, budget=Budget(evaluations=2000), **SMALL)
    words = [result.failure and result.failure.word for result in comparison.results]
    assert words == ["budget", None]
    assert "rich on generation: walking needs" in str(comparison.table())


def test_registered_samplers_spend_the_budget():
    samplers = {"mh": MetropolisHastings(candidates=10), "mas": MultiViewAncestral()}
    comparison = compare(monocular(), samplers, budget=Budget(evaluations=6000), **SMALL)
    for result in comparison.results:
        assert result.failure is None
        assert 0.8 * 6000 <= result.budget["used"] <= 6000
        assert np.isfinite(result.metrics["swd_ratio"])
