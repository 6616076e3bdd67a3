"""The grid: every cell on its own, the same bits wherever it runs, failures as failures."""

from __future__ import annotations

import json
import re
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import ClassVar

import numpy as np
import pandas as pd
import pytest
from toy_samplers import (
    Counting,
    Crashing,
    Dying,
    PriorDraws,
    TooFew,
    generation,
    monocular,
)

from probmotion import MotionPosterior
from probmotion.comparison import Comparison, compare
from probmotion.comparison.results.plan import Plan
from probmotion.posteriors.problem import Problem
from probmotion.samplers import ExactSampler

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}


def numbers(comparison):
    """All but the seconds, which are never the same."""
    table = pd.DataFrame(comparison.table())
    kept = table[~table["metric"].isin(["seconds", "peak_memory_mib"])]
    return kept.to_csv(index=False)


@pytest.fixture(scope="module")
def grid():
    samplers = {"exact": ExactSampler(), "wide": PriorDraws(2.0)}
    return compare([generation(), monocular()], samplers, seeds=2, **SMALL)


def test_the_table_is_tidy(grid):
    table = grid.table()
    assert list(table.columns) == ["problem", "sampler", "seed", "metric", "value"]
    assert table["value"].dtype == float
    assert set(table["problem"]) == {"generation", "monocular"}
    assert set(table["seed"]) == {0, 1}
    assert not table.duplicated(["problem", "sampler", "seed", "metric"]).any()
    wide = table[(table["sampler"] == "wide") & (table["problem"] == "generation")]
    values = wide.set_index(["metric", "seed"])["value"]
    assert values["variance_ratio", 0] == pytest.approx(4, rel=0.5)
    assert values["denoiser_evaluations", 1] == 100


def test_samplers_share_exact_draws_and_seeds_do_not(monkeypatch):
    asked = []
    right = Problem.reference

    def reference(self, seed, n):
        asked.append(seed)
        return right(self, seed, n)

    monkeypatch.setattr(Problem, "reference", reference)
    samplers = {"exact": ExactSampler(), "wide": PriorDraws(2.0)}
    compare(generation(), samplers, seeds=2, **SMALL)
    assert len(set(asked)) == 2


def test_draws_are_kept_and_seeds_differ(grid):
    zero, one = (grid.draws("generation", "exact", seed) for seed in (0, 1))
    assert zero.positions.shape == (2, 10, 4, 3, 3)
    assert (zero.flat() != one.flat()).all()
    with pytest.raises(ValueError, match="there is no cell of problem 'generation', sampler 'mas'"):
        grid.draws("generation", "mas")
    with pytest.raises(ValueError, match="wide has no draws of monocular: prior-draws takes no"):
        grid.draws("monocular", "wide")


def test_a_cell_does_not_depend_on_the_rest_of_the_grid(grid):
    alone = compare(monocular(), ExactSampler(), **SMALL)
    np.testing.assert_array_equal(
        alone.draws("monocular", "exact").flat(), grid.draws("monocular", "exact").flat()
    )
    theirs = pd.DataFrame(grid.table()).set_index(["problem", "sampler", "seed", "metric"])["value"]
    for row in alone.table().itertuples():
        if row.metric not in ("seconds", "peak_memory_mib"):
            assert theirs["monocular", "exact", 0, row.metric] == row.value


def test_every_cell_has_random_numbers_of_its_own():
    problems = {"a": generation(), "b": generation()}
    found = compare(problems, {"a": PriorDraws(), "b": PriorDraws()}, seeds=2, **SMALL)
    first = [
        found.draws(problem, sampler, seed).flat()[0].tobytes()
        for problem, sampler, seed in found.plan.cells()
    ]
    assert len(set(first)) == len(first) == 8


@pytest.mark.parametrize("where", ["processes", "threads", "foreign processes", "bars"])
def test_the_bits_are_the_same_wherever_cells_run(grid, where, capsys):
    samplers = {"exact": ExactSampler(), "wide": PriorDraws(2.0)}
    problems = [generation(), monocular()]
    settings = {**SMALL, "seeds": 2}
    if where == "processes":
        found = compare(problems, samplers, **(settings | {"workers": 2}))
    elif where == "threads":
        with ThreadPoolExecutor(2) as executor:
            found = compare(problems, samplers, executor=executor, **settings)
    elif where == "foreign processes":
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
            found = compare(problems, samplers, executor=executor, **settings)
    else:
        found = compare(problems, samplers, **{**settings, "progress": True})
        assert "cells" in capsys.readouterr().err
    assert numbers(found) == numbers(grid)
    for seed in (0, 1):
        np.testing.assert_array_equal(
            found.draws("generation", "wide", seed).flat(),
            grid.draws("generation", "wide", seed).flat(),
        )


def test_registered_problems_are_the_same_in_every_process():
    here, there = (
        compare("quadruped", ExactSampler(), **(SMALL | {"workers": workers})) for workers in (1, 2)
    )
    assert numbers(here) == numbers(there)


def test_what_stands_for_exact_draws_is_said(tmp_path):
    names = ("gait", "gait-noisy3d", "walk-vae-monocular", "dance-pairs")
    plan = Plan.of({name: name for name in names}, {}, draws=8, chains=2, seeds=1)
    assert [re.sub(r"1\.00\d", "1.00", sentence) for sentence in plan.references] == [
        "what stands for exact draws of gait-noisy3d are 960 draws of long runs of outlier-gibbs, "
        "R-hat 1.00",
        "what stands for exact draws of walk-vae-monocular are 960 draws of long runs of nuts, "
        "R-hat 1.00",
        "what stands for exact draws of dance-pairs are 2000 draws of long runs of "
        "tempered-pairs, R-hat 1.00, wherever motions stand",
    ]
    plan.save(tmp_path)
    assert Plan.load(tmp_path) == plan
    assert Comparison(tmp_path, plan).notes == list(plan.references)


def test_failures_are_recorded_and_stop_nothing(tmp_path):
    samplers = [Crashing(), PriorDraws(), TooFew()]
    comparison = compare([generation(), monocular()], samplers, out=tmp_path, **SMALL)
    table = comparison.table()
    rows = {(row.problem, row.sampler, row.metric): row.value for row in table.itertuples()}
    assert rows["generation", "crashing", "failed"] == 1
    assert rows["generation", "prior-draws", "swd_ratio"] > 0
    assert rows["monocular", "prior-draws", "unsupported"] == 1
    assert ("generation", "crashing", "swd_ratio") not in rows
    kept = json.loads((tmp_path / "failures.json").read_text())
    said = {(entry["problem"], entry["sampler"]): entry for entry in kept}
    assert len(said) == len(kept) == 5
    assert said["generation", "crashing"]["message"] == "the floor gave way"
    assert "toy_samplers.py" in said["generation", "crashing"]["traceback"]
    assert (
        said["generation", "too-few"]["message"]
        == "too-few returned 2 chains of 9 draws, expected 2 of 10"
    )
    printed = str(table)
    assert "prior-draws on monocular: prior-draws takes no evidence; exact would do" in printed
    assert "crashing on generation: the floor gave way" in printed


def test_a_worker_that_dies_fails_its_own_cell():
    samplers = [Dying(), PriorDraws(), ExactSampler()]
    comparison = compare(generation(), samplers, seeds=2, **(SMALL | {"workers": 2}))
    metrics = {
        (result.sampler, result.seed): result.metrics or result.failure.message
        for result in comparison.results
    }
    assert len(metrics) == 6
    assert "a worker process died" in metrics["dying", 0]
    assert "a worker process died" in metrics["dying", 1]
    failed = {key for key, value in metrics.items() if isinstance(value, str)}
    assert failed == {("dying", 0), ("dying", 1)}


def test_a_problem_travels_to_a_worker_once(tmp_path):
    """What is compiled of a user's own posterior is found again."""
    diary = tmp_path / "diary"
    settings = SMALL | {"workers": 1}
    compare([generation(), monocular()], Counting(diary=str(diary)), seeds=3, **settings)
    assert diary.read_text() == "1 1 1 2 2 2 "


def test_what_cannot_travel_to_a_worker_fails_its_own_cell():
    @dataclass(frozen=True)
    class Local(PriorDraws):
        name: ClassVar[str] = "local"

        def __reduce__(self):
            raise TypeError("Local holds a telescope")

    comparison = compare(generation(), [Local(), PriorDraws()], **(SMALL | {"workers": 2}))
    found = {result.sampler: result for result in comparison.results}
    assert found["local"].failure.message == (
        "generation/local/0 cannot be sent to a process, Local holds a telescope; expected what "
        "can be pickled, or workers=0"
    )
    assert found["prior-draws"].failure is None


def test_a_bare_posterior_and_other_names():
    posterior = generation().posterior
    assert compare(posterior, PriorDraws(), **SMALL).plan.problems.keys() == {"posterior"}
    named = compare({"mine": posterior, "two": generation()}, {"a": PriorDraws()}, **SMALL)
    assert set(named.table()["problem"]) == {"mine", "two"}
    assert isinstance(posterior, MotionPosterior)


@pytest.mark.parametrize(
    ("problems", "samplers", "settings", "sentence"),
    [
        ("gate", None, {}, "problem must be one of gait, gait-monocular, got 'gate'"),
        (
            "gait",
            "hamster",
            {},
            "sampler must be one of ancestral3d, dvae, got 'hamster'",
        ),
        (3, None, {}, "problems has a int, expected names, Problem or MotionPosterior objects"),
        ("gait", PriorDraws, {}, "samplers has PriorDraws, expected names or objects with name"),
        ([], None, {}, "problems must contain at least one, got none"),
        ("gait", [], {}, "samplers must contain at least one, got none"),
        ("gait", "exact", {"executor": 3}, "executor must be one that has submit, got 3"),
        ("gait", [3], {}, "samplers has int, expected names or objects with name"),
        ("gait", ["exact", "exact"], {}, "samplers has two called 'exact', expected different"),
        ("gait", {"../up": "exact"}, {}, "samplers has the name '../up', expected letters"),
        ("gait", "exact", {"draws": 9}, "draws must be an integer of at least 10, got 9"),
        ("gait", "exact", {"draws": 21}, "draws must be a multiple of chains, 2, got 21"),
        ("gait", "exact", {"workers": -1}, "workers must be an integer of at least 0, got -1"),
        ("gait", "exact", {"seeds": 1.5}, "seeds must be an integer of at least 1, got 1.5"),
    ],
)
def test_every_mistake_is_one_sentence_before_anything_runs(
    problems, samplers, settings, sentence, tmp_path
):
    with pytest.raises(ValueError, match=sentence.replace("(", r"\(").replace(".", r"\.")):
        compare(problems, samplers, out=tmp_path / "out", **(SMALL | settings))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_said_before_anything_runs(tmp_path):
    diary = tmp_path / "diary"
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    for folder in (blocked, blocked / "below"):
        with pytest.raises(OSError, match=r"out is .*; expected a writable folder"):
            compare(generation(), PriorDraws(diary=str(diary)), out=folder, **SMALL)
    assert not diary.exists()


def test_a_folder_that_holds_no_comparison_is_said_so(tmp_path):
    with pytest.raises(ValueError, match=r"holds no comparison\.json, expected one that compare"):
        Comparison.load(tmp_path)
    (tmp_path / "comparison.json").write_text("{")
    with pytest.raises(ValueError, match="is damaged"):
        Comparison.load(tmp_path)
