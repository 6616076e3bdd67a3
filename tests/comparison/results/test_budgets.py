"""Equal budgets: what a sampler can afford, the same in every cell and every run."""

from __future__ import annotations

import dataclasses
import json
import time

import numpy as np
import pytest
from toy_samplers import Napping, PriorDraws, Walking, generation, monocular

from probmotion import UnsupportedPosterior
from probmotion.comparison import Budget, Comparison, compare
from probmotion.comparison.results.budgets import affordable, effort_of
from probmotion.posteriors.sampling import load_sampler, sampler_names
from probmotion.samplers import MetropolisHastings, MultiViewAncestral

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}


def line(fixed, slope):
    """A pilot whose cost is a straight line in the stride, and the efforts that it was run with."""
    asked = []

    def pilot(sampler):
        asked.append(sampler.stride)
        return fixed + slope * sampler.stride

    return pilot, asked


@pytest.mark.parametrize("fixed", [0, 70, 900])
@pytest.mark.parametrize("slope", [1, 7.5, 60])
@pytest.mark.parametrize("amount", [1030, 5000, 123_456])
def test_the_largest_effort_within_the_budget_is_found(fixed, slope, amount):
    pilot, asked = line(fixed, slope)
    found = affordable(Budget(evaluations=amount), Walking(), pilot)["stride"]
    assert fixed + slope * found <= amount < fixed + slope * (found + 1)
    # Pilots spend about a cell's budget besides what every run of the sampler must spend.
    assert sum(slope * stride for stride in asked) <= 1.1 * amount
    assert len(asked) <= 7


def test_other_settings_of_effort_keep_their_proportion():
    pilot, _ = line(0, 10)
    found = affordable(Budget(evaluations=300), Walking(stride=20, start=100), pilot)
    assert found == {"stride": 30, "start": 150}
    assert affordable(Budget(evaluations=25), Walking(stride=20, start=3), pilot)["start"] == 1
    assert affordable(Budget(evaluations=25), Walking(stride=20, start=0), pilot)["start"] == 0


def test_a_sampler_that_cannot_go_as_low_says_so():
    pilot, _ = line(100, 10)
    with pytest.raises(
        UnsupportedPosterior, match="walking needs 120 evaluations with stride=2, s"
    ) as e:
        affordable(Budget(evaluations=119), Walking(), pilot)
    assert e.value.word == "budget"
    assert affordable(Budget(evaluations=120), Walking(), pilot)["stride"] == 2


@pytest.mark.parametrize("most", [10, 12, 15])
def test_a_range_that_ends_before_the_budget_does_is_used_to_its_end(most):
    pilot, asked = line(0, 1)
    assert affordable(Budget(evaluations=5000), Walking(most=most), pilot)["stride"] == most
    assert max(asked) <= most


def test_cost_that_rises_once_and_then_stays_ends_the_pilots():
    asked = []

    def pilot(sampler):
        asked.append(sampler.stride)
        return 10.0 if len(asked) < 3 else 11.5

    assert affordable(Budget(seconds=60.0), Walking(), pilot) == {}
    assert len(asked) < 10


def test_the_settings_own_range_is_kept():
    pilot, asked = line(0, 1)
    assert affordable(Budget(evaluations=5000), Walking(most=37), pilot)["stride"] == 37
    assert max(asked) <= 37


def test_a_sampler_without_effort_or_whose_effort_costs_nothing_runs_as_it_is():
    pilot, asked = line(5, 0)
    assert affordable(Budget(evaluations=5000), Walking(), pilot) == {}
    assert affordable(Budget(evaluations=5000), PriorDraws(), pilot) == {}
    assert max(asked) <= 64 * 20


@pytest.mark.parametrize("given", [{}, {"evaluations": 5, "seconds": 1.0}])
def test_a_budget_is_one_number(given):
    with pytest.raises(ValueError, match="expected one of them"):
        Budget(**given)


@pytest.mark.parametrize("given", [{"evaluations": 0}, {"evaluations": 1.5}, {"seconds": -1.0}])
def test_a_budget_is_above_zero(given):
    with pytest.raises(ValueError, match=rf"{next(iter(given))} is .*, expected"):
        Budget(**given)
    with pytest.raises(ValueError, match="budget must be a Budget, got 5"):
        compare(generation(), PriorDraws(), budget=5, **SMALL)


@pytest.mark.parametrize("name", sampler_names())
def test_every_sampler_names_settings_that_are_counts(name):
    sampler = load_sampler(name)()
    assert bool(effort_of(sampler)) == (name != "exact")
    for setting in effort_of(sampler):
        assert isinstance(getattr(sampler, setting), int)
    if effort_of(sampler):
        least = getattr(sampler, "least_effort", 1)
        dataclasses.replace(sampler, **{effort_of(sampler)[0]: least})


def test_all_cells_spend_the_budget_and_say_what_they_used(tmp_path):
    samplers = {
        "a": Walking(),
        "b": Walking(start=1000),
        "c": Walking(stride=3),
        "free": PriorDraws(),
    }
    found = compare(
        generation(), samplers, seeds=2, budget=Budget(evaluations=2000), out=tmp_path, **SMALL
    )
    table = found.table().set_index(["sampler", "seed", "metric"])["value"]
    for sampler in "abc":
        settings = []
        for seed in (0, 1):
            used = sum(
                weight * table[sampler, seed, f"{kind}_evaluations"]
                for kind, weight in (("density", 1), ("gradient", 2))
            )
            assert 0.9 * 2000 <= used <= 2000
            assert table[sampler, seed, "budget_used"] == used
            kept = json.loads(
                (tmp_path / f"cells/generation/{sampler}/{seed}/cell.json").read_text()
            )
            assert kept["budget"]["used"] == used
            assert kept["budget"]["asked"].startswith("2 000 evaluations")
            drawn = json.loads(found.draws("generation", sampler, seed).dataset.attrs["settings"])
            assert kept["budget"]["settings"].items() <= drawn.items()
            settings.append(kept["budget"]["settings"])
        assert settings[0] == settings[1]
    assert table["free", 0, "denoiser_evaluations"] == 100
    printed = str(Comparison.load(tmp_path).table())
    assert "every sampler had 2 000 evaluations (a gradient counts 2, any other 1)" in printed
    assert "free has no setting of effort and ran as given" in printed


def test_the_same_settings_in_processes_and_when_a_run_goes_on(tmp_path):
    diary = tmp_path / "diary"
    settings = {"budget": Budget(evaluations=2000), **SMALL}

    def used(found):
        return [result.budget for result in found.results]

    here = compare(generation(), Walking(), **settings)
    there = compare(generation(), Walking(), **(settings | {"workers": 2}))
    assert used(here) == used(there)
    sampler = Walking(diary=str(diary))
    for seeds, runs in ((1, 1), (1, 0), (3, 2)):
        before = len(diary.read_text().split()) if diary.exists() else 0
        found = compare(generation(), sampler, seeds=seeds, out=tmp_path / "out", **settings)
        fresh = len(diary.read_text().split()) - before
        pilots = fresh - runs if before == 0 else 0
        assert fresh == runs + pilots
    assert pilots == 0
    assert used(found)[0] == used(here)[0]
    for change in (
        {"budget": Budget(evaluations=3000)},
        {"budget": Budget(seconds=3.0)},
        {"budget": None},
    ):
        with pytest.raises(ValueError, match="made with other settings"):
            compare(generation(), sampler, out=tmp_path / "out", **(settings | change))


def test_seconds_are_measured_once_and_kept(tmp_path):
    budget = Budget(seconds=0.4)
    found = compare(generation(), Napping(), budget=budget, out=tmp_path, **SMALL)
    (result,) = found.results
    assert result.budget["settings"] == {"rounds": 40}
    assert result.metrics["budget_used"] == pytest.approx(0.4)
    (kept,) = tmp_path.glob("pilots/*/*.json")
    slower = json.loads(kept.read_text())
    kept.write_text(json.dumps(slower | {"settings": {"rounds": 30}}))
    # What was measured at another time is not mixed with what is there.
    with pytest.raises(ValueError, match="made with other settings"):
        compare(generation(), Napping(), budget=budget, out=tmp_path, **SMALL)
    kept.write_text(json.dumps(slower))
    start = time.monotonic()
    more = compare(generation(), Napping(), budget=budget, seeds=2, out=tmp_path, **SMALL)
    assert {r.budget["settings"]["rounds"] for r in more.results} == {40}
    assert time.monotonic() - start < 30
    assert "every sampler had 0.4 seconds per cell" in more.notes


def test_what_is_compiled_at_the_first_run_is_no_cost_of_a_cell():
    """Of 3 seconds, 10 of which the first run of all takes more."""
    asked = []

    def pilot(sampler):
        asked.append(sampler.stride)
        return 0.01 * sampler.stride + (10 if len(asked) == 1 else 0)

    found = affordable(Budget(seconds=3.0), Walking(), pilot)
    assert found["stride"] == 300
    assert asked[0] == asked[1]


@pytest.mark.parametrize("slowed", range(7))
def test_a_pilot_that_something_slowed_down_is_no_measure(slowed):
    """Of 6 seconds, at 1/100 for a unit of effort; one pilot takes half as long again."""
    asked = []

    def pilot(sampler):
        asked.append(sampler.stride)
        return (0.05 + 0.01 * sampler.stride) * (1.5 if len(asked) == 1 + slowed else 1)

    found = affordable(Budget(seconds=6.0), Walking(stride=100), pilot)
    assert found["stride"] == pytest.approx(595, rel=0.01)
    # What was suspected is run again, and no more: five pilots do where nothing is slow.
    assert len(asked) <= (8 if slowed < 5 else 5)
    assert sum(0.05 + 0.01 * stride for stride in asked) < 1.5 * 6


def test_a_cost_that_is_no_line_is_asked_again_once():
    """As that of trajectories that adapt."""
    asked = []

    def pilot(sampler):
        asked.append(sampler.stride)
        return 1e-3 * sampler.stride**1.5

    found = affordable(Budget(seconds=6.0), Walking(stride=100), pilot)["stride"]
    assert 0.5 * 6 < 1e-3 * found**1.5 < 1.5 * 6
    assert all(asked.count(stride) <= 2 for stride in asked)
    # Not where pilots have cost as much as a cell already.
    asked.clear()
    steep = affordable(
        Budget(seconds=5.0), Walking(stride=100), lambda each: 0.4 * pilot(each) ** (4 / 3) / 0.01
    )
    assert steep
    assert asked.count(2) == 2
    assert len(asked) == 1 + len(set(asked))
    asked.clear()
    affordable(Budget(evaluations=6), Walking(stride=100), pilot)
    assert len(asked) == len(set(asked))


def test_notes_say_what_was_used_and_not_what_the_budget_has_replaced():
    samplers = {"walking": Walking(stride=7, start=3), "free": PriorDraws(2.0)}
    found = compare(generation(), samplers, seeds=2, budget=Budget(evaluations=2000), **SMALL)
    table = found.table()
    used = table[table["metric"] == "budget_used"].groupby("sampler")["value"].mean()
    words = f"walking {used['walking']:.3g} to {used['walking']:.3g}, free 100 to 100"
    assert any(note.startswith("used per cell") and note.endswith(words) for note in found.notes)
    assert not any(note.startswith("walking ran with") for note in found.notes)
    assert "free ran with spread=2.0; its other settings are its defaults" in found.notes
    for result in found.results:
        if result.sampler == "walking":
            assert result.metrics["set_stride"] == result.budget["settings"]["stride"] > 7


def test_what_a_sampler_cannot_do_and_cannot_afford_are_rows(tmp_path):
    samplers = {"rich": Walking(start=10**6), "poor": Walking(), "prior": PriorDraws()}
    budget = Budget(evaluations=2000)
    found = compare([generation(), monocular()], samplers, budget=budget, out=tmp_path, **SMALL)
    words = {(r.problem, r.sampler): r.failure and r.failure.word for r in found.results}
    assert words == {
        ("generation", "rich"): "budget",
        ("generation", "poor"): None,
        ("generation", "prior"): None,
        **{("monocular", name): "observations" for name in samplers},
    }
    assert "rich on generation: walking needs" in str(found.table())


def test_the_library_s_own_samplers_spend_what_they_may():
    samplers = {
        "mh": MetropolisHastings(candidates=10),
        "mas": MultiViewAncestral(),
    }
    found = compare(monocular(), samplers, budget=Budget(evaluations=6000), **SMALL)
    for result in found.results:
        assert result.failure is None
        assert 0.8 * 6000 <= result.budget["used"] <= 6000
    table = found.table()
    assert np.isfinite(table[table["metric"] == "swd_ratio"]["value"]).all()
