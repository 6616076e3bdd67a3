"""Experiment grids: independent runs, identical results wherever they run, recorded failures."""

from __future__ import annotations

import json
import os
import re
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Timer
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from toy_samplers import (
    SMALL,
    Counting,
    Failing,
    PriorDraws,
    Walking,
    generation,
    monocular,
    numbers,
)

from probmotion.comparison import Budget, Comparison, compare
from probmotion.comparison.figures import draw_comparison
from probmotion.comparison.results.failures import ResultNotWritten
from probmotion.comparison.results.plan import Plan
from probmotion.posteriors.problem import Problem
from probmotion.samplers import ExactSampler


def test_table_has_one_row_per_metric(grid):
    table = grid.table()
    assert list(table.columns) == ["problem", "sampler", "seed", "metric", "value"]
    assert table["value"].dtype == float
    assert not table.duplicated(["problem", "sampler", "seed", "metric"]).any()
    values = table.set_index(["problem", "sampler", "metric", "seed"])["value"]
    assert values["generation", "wide", "variance_ratio", 0] == pytest.approx(4, rel=0.5)
    assert values["generation", "wide", "denoiser_evaluations", 1] == 100


def test_samplers_share_reference_draws_but_seeds_do_not():
    with patch.object(Problem, "reference", autospec=True, side_effect=Problem.reference) as called:
        compare(generation(), {"a": PriorDraws(), "b": PriorDraws(2.0)}, seeds=2, **SMALL)
    assert len({call.args[1] for call in called.call_args_list}) == 2


def test_draws_are_stored_by_problem_sampler_and_seed(grid):
    zero, one = (grid.draws("generation", "exact", seed) for seed in (0, 1))
    assert zero.positions.shape == (2, 10, 4, 3, 3)
    assert (zero.flat() != one.flat()).all()
    with pytest.raises(ValueError, match="must exist, got problem 'generation', sampler 'mas'"):
        grid.draws("generation", "mas")
    with pytest.raises(ValueError, match="wide has no draws of monocular: prior-draws takes no"):
        grid.draws("monocular", "wide")


def test_a_run_does_not_depend_on_the_rest_of_the_grid(grid):
    alone = compare(monocular(), ExactSampler(), **SMALL)
    np.testing.assert_array_equal(
        alone.draws("monocular", "exact").flat(), grid.draws("monocular", "exact").flat()
    )
    table = grid.table().query("problem == 'monocular' and sampler == 'exact' and seed == 0")
    assert numbers(alone.table()) == numbers(table)


def test_every_run_has_different_random_numbers():
    problems = {"a": generation(), "b": generation()}
    comparison = compare(problems, {"a": PriorDraws(), "b": PriorDraws()}, seeds=2, **SMALL)
    first = {comparison.draws(*address).flat()[0].tobytes() for address in comparison.plan.runs()}
    assert len(first) == 8


def test_results_are_identical_in_processes_and_threads(grid, samplers, tmp_path, monkeypatch):
    problems, settings = [generation(), monocular()], {**SMALL, "seeds": 2}
    comparisons = [compare(problems, samplers, **(settings | {"workers": 2}))]
    # Threads with another working directory than the relative ``out``.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    with ThreadPoolExecutor(2, initializer=os.chdir, initargs=[tmp_path / "elsewhere"]) as executor:
        comparisons.append(compare(problems, samplers, executor=executor, out="out", **settings))
    assert not list((tmp_path / "elsewhere").iterdir())
    for each in comparisons:
        assert numbers(each.table()) == numbers(grid.table())
        np.testing.assert_array_equal(
            each.draws("generation", "wide", 1).flat(), grid.draws("generation", "wide", 1).flat()
        )


def test_registered_problems_and_budgets_give_identical_results_in_a_worker(capsys):
    settings = {**SMALL, "budget": Budget(evaluations=500), "time_limit": 100.0}
    here = compare("gait(frames=4)", Walking(), **settings | {"progress": True})
    assert "[1/1] gait(frames=4) walking seed 0: " in capsys.readouterr().err
    there = compare("gait(frames=4)", Walking(), **settings | {"workers": 1})
    assert numbers(here.table()) == numbers(there.table())
    assert here.results[0].budget == there.results[0].budget


@pytest.mark.parametrize("library", ["torch", "jax", None])
def test_a_note_says_that_no_library_computes_gradients(library):
    versions = {"numpy": "2", **({library: "1"} if library else {})}
    plan = Plan(problems={}, samplers={}, draws=1, chains=1, seeds=1, versions=versions)
    assert any("KSD² is not measured" in note for note in plan.notes) == (library is None)


def test_notes_name_the_source_of_long_run_references(tmp_path):
    names = ("gait", "gait-noisy3d")
    problems = {name: name for name in names}
    plan = Plan.of(problems, {"walking": Walking()}, draws=8, chains=2, seeds=1)
    assert [re.sub(r"1\.00\d", "1.00", note) for note in plan.references] == [
        "reference draws of gait-noisy3d are 960 draws from long runs of outlier-gibbs (R-hat 1.00)"
    ]
    plan.save(tmp_path)
    assert Plan.load(tmp_path) == plan
    assert Comparison(tmp_path, plan).notes == list(plan.references)


def test_failures_are_recorded_and_do_not_stop_the_grid(grid):
    values = grid.table().set_index(["problem", "sampler", "metric", "seed"])["value"]
    assert values["generation", "crashing", "failed", 0] == 1
    assert values["monocular", "wide", "unsupported", 1] == 1
    assert values["generation", "wide", "swd_ratio", 1] > 0
    stored = json.loads((grid.folder / "failures.json").read_text())
    by_run = {(each["problem"], each["sampler"], each["seed"]): each for each in stored}
    assert len(by_run) == len(stored) == 6
    assert by_run["monocular", "wide", 1]["word"] == "observations"
    crashed = by_run["generation", "crashing", 0]
    assert crashed["message"] == "singular matrix"
    assert "toy_samplers.py" in crashed["traceback"]
    assert "wide on monocular: prior-draws takes no observations; try exact" in grid.notes
    assert "crashing on generation: singular matrix" in grid.notes


def test_figures_are_written_for_every_problem_with_draws_or_references(grid, tmp_path):
    names = [
        *("quality_against_cost", "skeletons_generation", "skeletons_monocular"),
        "spread_monocular",
    ]
    written = draw_comparison(grid, [generation(), monocular()], tmp_path)
    assert written == [tmp_path / f"{name}{kind}" for name in names for kind in (".png", ".pdf")]
    for path in written:
        assert path.read_bytes().startswith(b"\x89PNG" if path.suffix == ".png" else b"%PDF")


def test_a_problem_is_sent_to_a_worker_once(tmp_path):
    diary = tmp_path / "diary"
    settings = SMALL | {"workers": 1}
    compare([generation(), monocular()], Counting(diary=str(diary)), seeds=3, **settings)
    assert diary.read_text() == "1 1 1 2 2 2 "


class Choosy(ThreadPoolExecutor):
    """Executor that refuses the tasks of one sampler, forgets and fails those of others."""

    error: Exception = OSError("the cluster is gone")

    def submit(self, function, task, **settings):
        if task.sampler == "refused":
            raise TypeError("refused cannot be sent")
        future = Future()
        if task.sampler == "forgotten":
            future.set_result(None)
        elif task.sampler == "failed":
            future.set_exception(self.error)
        else:
            return super().submit(function, task, **settings)
        return future


def test_failures_of_an_executor_are_recorded():
    samplers = {name: PriorDraws() for name in ("refused", "forgotten", "failed", "right")}
    with Choosy(1) as executor:
        comparison = compare(generation(), samplers, executor=executor, **SMALL)
        executor.error = ResultNotWritten("No space left on device")
        with pytest.raises(OSError, match="to out, No space left on device, with 0 of 1 runs"):
            compare(generation(), {"failed": PriorDraws()}, executor=executor, **SMALL)
    failures = {result.sampler: str(result.failure) for result in comparison.results}
    assert failures == {
        "refused": "TypeError: refused cannot be sent",
        "forgotten": "FileNotFoundError: generation/forgotten/0 ended without a result in out; "
        "workers must have access to out",
        "failed": "OSError: the cluster is gone",
        "right": "None",
    }


def test_runs_that_a_shut_down_executor_cancels_are_recorded():
    executor = ThreadPoolExecutor(1)
    samplers = {"first": PriorDraws(nap=0.5), "second": PriorDraws(), "third": PriorDraws()}
    shut = Timer(0.2, executor.shutdown, kwargs={"wait": False, "cancel_futures": True})
    shut.start()
    comparison = compare(generation(), samplers, executor=executor, **SMALL)
    shut.join()
    messages = [result.failure and result.failure.message for result in comparison.results]
    assert messages == [None, *2 * ["the executor cancelled it"]]


def test_posteriors_and_mappings_are_accepted():
    posterior = generation().posterior
    assert compare(posterior, PriorDraws(), **SMALL).plan.problems.keys() == {"posterior"}
    named = compare({"mine": posterior, "two": generation()}, {"a": PriorDraws()}, **SMALL)
    assert set(pd.DataFrame(named.table())["problem"]) == {"mine", "two"}


@pytest.mark.parametrize(
    ("problems", "samplers", "settings", "message"),
    [
        ("gate", None, {}, "problem must be one of gait, gait-monocular, .*, got 'gate'"),
        ("gait", "hamster", {}, "sampler must be one of ancestral3d, dvae, .*, got 'hamster'"),
        (3, None, {}, "problems must be names, Problem or MotionPosterior objects, got int"),
        ("gait", PriorDraws, {}, "samplers must be names, objects .*, got the class PriorDraws"),
        ([], None, {}, "problems must contain at least one, got none"),
        ("gait", [], {}, "samplers must contain at least one, got none"),
        ("gait", "exact", {"executor": 3}, r"executor must be an object with submit\(\), .* got 3"),
        ("gait", "exact", {"executor": ThreadPoolExecutor}, "executor must be an object with subm"),
        ("gait", [3], {}, "draws must be MotionDraws, an ArviZ tree, or an array .*, got int"),
        ("gait", ["exact", "exact"], {}, "samplers must have different names, got 'exact' twice"),
        ("gait", {"../up": "exact"}, {}, r"samplers must consist of .*, got '\.\./up'"),
        ("gait", "exact", {"draws": 9}, "draws must be an integer of at least 10, got 9"),
        ("gait", "exact", {"draws": 21}, "draws must be a multiple of chains, 2, got 21"),
        ("gait", "exact", {"workers": -1}, "workers must be an integer of at least 0, got -1"),
        ("gait", "exact", {"seeds": 1.5}, "seeds must be an integer of at least 1, got 1.5"),
        ("gait", "exact", {"time_limit": 0}, "time_limit must be a finite number above 0, got 0"),
        ("gait", "exact", {"budget": 5}, "budget must be a Budget, got 5"),
    ],
)
def test_invalid_arguments_raise_before_anything_runs(
    problems, samplers, settings, message, tmp_path
):
    with pytest.raises(ValueError, match=message):
        compare(problems, samplers, out=tmp_path / "out", **(SMALL | settings))
    assert not (tmp_path / "out").exists()


def test_loading_another_folder_raises(tmp_path):
    message = r"must be written by compare\(\), .* without comparison\.json"
    with pytest.raises(ValueError, match=message):
        Comparison.load(tmp_path)
    (tmp_path / "comparison.json").write_text("{")
    with pytest.raises(ValueError, match="is damaged"):
        Comparison.load(tmp_path)


def test_interrupting_reports_the_temporary_folder(tmp_path):
    sampler = Failing(how="interrupt the second run", diary=str(tmp_path / "diary"))
    with pytest.raises(KeyboardInterrupt, match="interrupted with 1 of 3 runs") as caught:
        compare(generation(), sampler, seeds=3, **SMALL)
    folder = re.search(r"stored in (.*?);", str(caught.value))[1]
    assert len(Comparison.load(folder).results) == 1
