"""A failing cell is a row with its reason, never a hole or a stop."""

from __future__ import annotations

import ast
import math
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import fields, replace
from pathlib import Path

import pytest
from toy_samplers import (
    Diverged,
    Dying,
    Endless,
    Hungry,
    Interrupted,
    NotANumber,
    PriorDraws,
    Quitting,
    Unchecked,
    Unwritable,
    generation,
    monocular,
    small_prior,
)

from probmotion import MotionPosterior, Skeleton
from probmotion.comparison import Comparison, compare
from probmotion.comparison.results.failures import CellNotKept, Failure, TimeIsUp, WorkerDied
from probmotion.comparison.run.time_limits import time_limit
from probmotion.models import GaussianMixtureMotion

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}
WORDS = {
    NotANumber(): "nan",
    Unchecked(): "nan",
    Diverged(): "nan",
    Hungry(): "memory",
    Quitting(): "SystemExit",
}


def test_every_failure_is_a_row_with_its_word(tmp_path):
    comparison = compare(generation(), [*WORDS, PriorDraws()], out=tmp_path, **SMALL)
    words = {each.sampler: each.failure and each.failure.word for each in comparison.results}
    assert words == {sampler.name: word for sampler, word in WORDS.items()} | {"prior-draws": None}
    table = comparison.table()
    failed = table[table["metric"] == "failed"]
    assert set(failed["sampler"]) == {sampler.name for sampler in WORDS}
    for word in WORDS.values():
        assert word in str(table)


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (RuntimeError("RESOURCE_EXHAUSTED: out of memory"), "memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "memory"),
        (type("OutOfMemoryError", (RuntimeError,), {})("CUDA"), "memory"),
        (WorkerDied(killed=True), "memory"),
        (WorkerDied(killed=False), "died"),
        (
            ValueError("theta must be finite, got 3 values that are NaN or infinite, the first"),
            "nan",
        ),
        (FloatingPointError("overflow"), "nan"),
        (ValueError("theta is wrong"), "ValueError"),
        (TimeIsUp(3.0), "time"),
    ],
)
def test_the_word_of_an_error(error, word):
    assert Failure.of(error).word == word


def test_errors_travel_between_processes():
    for error in (TimeIsUp(2.5), CellNotKept("the disk is full")):
        assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_cell_that_takes_longer_than_its_limit_is_a_row():
    samplers = [Endless(), PriorDraws()]
    start = time.monotonic()
    comparison = compare(generation(), samplers, time_limit=1.0, seeds=2, **SMALL)
    assert time.monotonic() - start < 30
    failures = {(each.sampler, each.seed): each.failure for each in comparison.results}
    assert failures["endless", 0].word == failures["endless", 1].word == "time"
    assert "took longer than time_limit, 1 seconds" in failures["endless", 0].message
    assert failures["prior-draws", 0] is failures["prior-draws", 1] is None


def test_processes_are_killed_where_an_alarm_is_not_heard():
    samplers = {
        "deaf": Endless(deaf=True),
        "dying": Dying(),
        "interrupted": Interrupted(),
        "right": PriorDraws(),
    }
    comparison = compare(
        generation(), samplers, time_limit=6.0, seeds=2, **(SMALL | {"workers": 2})
    )
    words = {(r.sampler, r.seed): r.failure and r.failure.word for r in comparison.results}
    assert words == {
        **{("deaf", seed): "time" for seed in (0, 1)},
        **{("dying", seed): "died" for seed in (0, 1)},
        **{("interrupted", seed): "KeyboardInterrupt" for seed in (0, 1)},
        # What one process dies of fails no other's cell.
        **{("right", seed): None for seed in (0, 1)},
    }


def test_a_cells_clock_starts_when_libraries_are_there(monkeypatch):
    order = []

    def limit(seconds):
        order.append("clock")
        return time_limit(seconds)

    monkeypatch.setattr("probmotion.metrics.load_libraries", lambda: order.append("libraries"))
    monkeypatch.setattr("probmotion.comparison.run.cells.time_limit", limit)
    compare(generation(), PriorDraws(), **SMALL)
    assert order == ["libraries", "clock"]


def test_what_measures_import_is_there_with_the_libraries():
    program = """
import sys
from toy_samplers import PriorDraws, generation
from probmotion.metrics import load_libraries, measure

problem = generation()
draws = PriorDraws().sample(problem.posterior, draws=10, chains=2, seed=0, progress=False)
draws.dataset.attrs["independent"] = 0  # so that it has an ESS
if {prepared}:
    load_libraries()
known = set(sys.modules)
measure(problem, draws, 0)
heavy = {{name.partition(".")[0] for name in set(sys.modules) - known}}
print(sorted(heavy & {{"arviz_stats", "scipy", "sklearn"}}))
"""
    said = [
        subprocess.run(
            [sys.executable, "-c", program.format(prepared=prepared)],
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for prepared in (True, False)
    ]
    assert said[0] == "[]"
    assert {"arviz_stats", "sklearn"} <= set(ast.literal_eval(said[1]))


def test_the_limit_is_no_part_of_the_question(tmp_path):
    diary = tmp_path / "diary"
    for limit in (None, 50.0, None):
        sampler = PriorDraws(diary=str(diary))
        compare(generation(), sampler, time_limit=limit, out=tmp_path, **SMALL)
    assert len(diary.read_text().split()) == 1
    with pytest.raises(ValueError, match="time_limit must be a finite number above 0, got 0"):
        compare(generation(), PriorDraws(), time_limit=0, **SMALL)


def test_a_limit_ends_a_block_and_leaves_the_caller_s_timer():
    rung = []
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        start = time.monotonic()
        with pytest.raises(TimeIsUp), time_limit(0.1):
            time.sleep(20)
        assert time.monotonic() - start < 10
        with time_limit(60.0):
            pass
        time.sleep(max(0.0, 0.7 - (time.monotonic() - start)))
        assert rung == [1]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_a_limit_that_a_library_wraps_is_still_a_limit():
    def library():
        try:
            time.sleep(20)
        except BaseException as error:
            raise ValueError("INTERNAL: callback") from error

    with pytest.raises(TimeIsUp), time_limit(0.1):
        library()
    with pytest.raises(ValueError, match="its own"), time_limit(60.0):
        raise ValueError("its own")


def test_on_another_thread_a_limit_is_told_at_the_end():
    found = []

    def work():
        try:
            with time_limit(0.05):
                time.sleep(0.2)
                found.append("ended")
        except TimeIsUp:
            found.append("told")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == ["ended", "told"]


@pytest.mark.parametrize("workers", [0, 2])
def test_draws_that_no_file_can_hold_are_a_row(tmp_path, workers):
    samplers = {"odd": Unwritable(), "right": PriorDraws()}
    found = compare(generation(), samplers, out=tmp_path, **(SMALL | {"workers": workers}))
    words = {result.sampler: result.failure and result.failure.word for result in found.results}
    assert words == {"odd": "TypeError", "right": None}
    assert not list(tmp_path.glob("cells/*/*/.unfinished*"))


@pytest.mark.parametrize(("workers", "how"), [(0, ()), (2, ()), (2, ("slow",))])
def test_a_full_disk_loses_nothing_that_is_finished(tmp_path, workers, how):
    script = tmp_path / "run.py"
    script.write_text(FULL_DISK)
    out = tmp_path / "out"
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, str(script), str(out), str(workers), *how],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert run.returncode == 1
    last = run.stderr.strip().splitlines()[-1]
    assert "OSError: out cannot be written to any more" in last
    finished = int(re.search(r"with (\d) of 4 cells finished, which are kept in", last)[1])
    # Of two workers one may still be at its first cell when the other's disk is full.
    assert finished == 2 if workers == 0 else 1 <= finished <= 2
    assert len(Comparison.load(out).results) == finished
    # Not even what a worker was killed at while it wrote.
    assert (out / "began to write").exists() == bool(how)
    assert not list(out.glob("cells/*/*/.unfinished*"))
    # On a disk with room the same command goes on.
    subprocess.run(
        [sys.executable, str(script), str(out), str(workers), "room"],
        env={**os.environ, "PYTHONPATH": paths},
        check=True,
        timeout=200,
    )
    assert len(Comparison.load(out).results) == 4


FULL_DISK = """
import resource, sys, time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from toy_samplers import PriorDraws, generation
from probmotion.comparison import compare, plan
from probmotion.draws import MotionDraws


def save_slowly(draws, path, save=MotionDraws.save):
    save(draws, path)
    if path.parent.name.startswith(".unfinished-0"):
        Path(sys.argv[1], "began to write").touch()
        time.sleep(100)


@dataclass(frozen=True)
class Filling(PriorDraws):
    # Until its third cell there is room.
    room: ClassVar[bool] = "room" in sys.argv

    def sample(self, posterior, **settings):
        if "slow" in sys.argv:
            MotionDraws.save = save_slowly
        if self.spread > 1 and not self.room:
            while "slow" in sys.argv and not Path(sys.argv[1], "began to write").exists():
                time.sleep(0.01)
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
        return super().sample(posterior, **settings)


samplers = {"a": Filling(1.0), "b": Filling(2.0)}
# All cells of one sampler first.
plan.Plan.cells = lambda self: (("generation", s, k) for s in self.samplers for k in (0, 1))
out, workers, *_ = sys.argv[1:]
compare(generation(), samplers, seeds=2, draws=20, chains=2, out=out, workers=int(workers),
        progress=False)
"""


class Returning(PriorDraws):
    """Returns something else than it should."""

    def sample(self, posterior, **settings):
        drawn = super().sample(posterior, **settings)
        if self.name == "nothing":
            return None
        if self.name == "array":
            return drawn.positions.values
        names = [f"{name} of another" for name in drawn.skeleton.joint_names]
        other = replace(posterior.prior, skeleton=Skeleton(names, drawn.skeleton.parents))
        settings = {key: value for key, value in settings.items() if key != "initial"}
        return PriorDraws().sample(MotionPosterior(other), **settings)


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ("nothing", "nothing returned NoneType, expected MotionDraws"),
        ("array", "array returned ndarray, expected MotionDraws"),
        ("other", "other returned draws of another skeleton, expected the posterior's"),
    ],
)
def test_what_is_no_motion_of_the_posterior_is_a_row_that_says_so(tmp_path, what, sentence):
    kind = type("Kind", (Returning,), {"name": what})
    (cell,) = compare(generation(), kind(), out=tmp_path, **SMALL).results
    assert str(cell.failure.message) == sentence


def test_a_cell_whose_draws_were_lost_is_computed_again(tmp_path):
    asked = {"out": tmp_path / "out", **SMALL}
    sampler = PriorDraws(diary=str(tmp_path / "diary"))
    first = compare(generation(), sampler, **asked)
    (lost,) = (tmp_path / "out").rglob("draws.nc")
    lost.unlink()
    again = compare(generation(), sampler, **asked)
    assert len((tmp_path / "diary").read_text().splitlines()) == 2
    assert lost.exists()
    assert len(again.table()) == len(first.table())


def test_a_cell_whose_draws_were_cut_off_is_computed_again(tmp_path):
    asked = {"out": tmp_path / "out", **SMALL}
    compare(generation(), PriorDraws(), **asked)
    (cut,) = (tmp_path / "out").rglob("draws.nc")
    whole = cut.read_bytes()
    cut.write_bytes(whole[:200])
    again = compare(generation(), PriorDraws(), **asked)
    assert len(cut.read_bytes()) == len(whole)
    assert again.draws("generation", "prior-draws").flat().shape[0] == SMALL["draws"]


class Broken(GaussianMixtureMotion):
    """A prior whose posterior and draws are not written yet."""

    def exact_posterior(self, *given, **named):
        raise NotImplementedError("to be written")

    def sample(self, rng, n):
        raise NotImplementedError("to be written")


@pytest.mark.parametrize("evidence", [True, False])
def test_a_problem_whose_references_fail_stops_no_other(evidence):
    whole = small_prior()
    prior = Broken(**{each.name: getattr(whole, each.name) for each in fields(whole) if each.init})
    likelihood = monocular().posterior.likelihood if evidence else None
    problems = {"broken": MotionPosterior(prior, likelihood), "whole": generation()}
    found = compare(problems, PriorDraws(), **SMALL)
    words = {result.problem: result.failure and result.failure.word for result in found.results}
    assert words == {"broken": "observations" if evidence else "NotImplementedError", "whole": None}


class InOneChain(PriorDraws):
    """Returns as many draws as it was asked for, in one chain."""

    def sample(self, posterior, *, draws, chains, **settings):
        return super().sample(posterior, draws=draws * chains, chains=1, **settings)


class Timeless(PriorDraws):
    """Does not know how long it took."""

    def sample(self, posterior, **settings):
        drawn = super().sample(posterior, **settings)
        return replace(drawn, dataset=drawn.dataset.assign_attrs(seconds=math.nan))


@pytest.mark.parametrize(
    ("sampler", "sentence"),
    [
        (InOneChain(), "prior-draws returned 1 chains of 20 draws, expected 2 of 10"),
        (Timeless(), "prior-draws returned draws with seconds=nan, expected those that they took"),
    ],
)
def test_draws_of_another_kind_than_asked_for_are_a_row(sampler, sentence):
    (cell,) = compare(generation(), sampler, **SMALL).results
    assert cell.failure.message == sentence
