"""Failing runs are recorded with their reason and never stop the grid."""

from __future__ import annotations

import ast
import pickle
import re
import signal
import threading
import time
from dataclasses import dataclass, fields
from typing import ClassVar

import pytest
from toy_samplers import (
    SMALL,
    Failing,
    PriorDraws,
    count,
    finish,
    generation,
    monocular,
    small_prior,
    start,
)

from probmotion import MotionPosterior
from probmotion.comparison import Comparison, compare
from probmotion.comparison.results.failures import (
    Failure,
    ResultNotWritten,
    TimeLimitExceeded,
    WorkerDied,
)
from probmotion.comparison.run.time_limits import time_limit
from probmotion.models import GaussianMixtureMotion

FAILURES = {
    "raise": ("RuntimeError", "the floor gave way"),
    "nan": ("nan", "nan returned 1 positions that are not finite or beyond 1e+100 metres"),
    "diverged": ("nan", "diverged returned 36 positions that are not finite or beyond 1e+100"),
    "infinite": ("nan", "positions must be finite, got 720 values that are NaN or infinite"),
    "memory": ("memory", "MemoryError"),
    "exit": ("SystemExit", "3"),
    "unwritable": ("TypeError", "Invalid value for attr 'odd'"),
    "none": ("TypeError", "none must return MotionDraws, got NoneType"),
    "array": ("TypeError", "array must return MotionDraws, got ndarray"),
    "other skeleton": ("ValueError", "other skeleton must return draws of the posterior's skele"),
    "too few": ("ValueError", "too few must return 2 chains of 10 draws, got 2 of 9"),
    "one chain": ("ValueError", "one chain must return 2 chains of 10 draws, got 1 of 20"),
    "no time": ("ValueError", "no time must return draws with their run time, got seconds=nan"),
}


def failures_of(comparison):
    return {(r.sampler, r.seed): r.failure and r.failure.word for r in comparison.results}


def test_every_failure_is_recorded_with_word_and_message(tmp_path):
    samplers = {how: Failing(how=how) for how in FAILURES} | {"right": PriorDraws()}
    found = compare(generation(), samplers, out=tmp_path, **SMALL)
    failures = {result.sampler: result.failure for result in found.results}
    assert failures.pop("right") is None
    for how, (word, message) in FAILURES.items():
        assert failures[how].word == word
        assert failures[how].message.startswith(message)
        assert word in str(found.table())
    table = found.table()
    assert set(table[table["metric"] == "failed"]["sampler"]) == set(FAILURES)
    assert not list(tmp_path.glob("runs/*/*/.unfinished*"))


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (RuntimeError("RESOURCE_EXHAUSTED: out of memory"), "memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "memory"),
        (type("OutOfMemoryError", (RuntimeError,), {})("CUDA"), "memory"),
        (WorkerDied(killed=True), "memory"),
        (WorkerDied(killed=False), "died"),
        (FloatingPointError("overflow"), "nan"),
        (ValueError("theta is wrong"), "ValueError"),
        (TimeLimitExceeded(3.0), "time"),
    ],
)
def test_word_of_an_error(error, word):
    assert Failure.of(error).word == word


def test_errors_can_be_pickled():
    for error in (TimeLimitExceeded(2.5), ResultNotWritten("the disk is full")):
        assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_runs_beyond_the_time_limit_are_recorded():
    samplers = {"hang": Failing(how="hang"), "right": PriorDraws()}
    start = time.monotonic()
    comparison = compare(generation(), samplers, time_limit=2.0, **SMALL)
    assert time.monotonic() - start < 30
    for result in comparison.results:
        if result.sampler == "hang":
            assert str(result.failure) == "time: took longer than time_limit, 2 seconds"
        else:
            assert result.failure is None


def test_failures_of_worker_processes_are_recorded():
    @dataclass(frozen=True)
    class Local(PriorDraws):
        name: ClassVar[str] = "local"

        def __reduce__(self):
            raise TypeError("Local holds a telescope")

    samplers = {
        "hang": Failing(how="hang without signals"),
        "die": Failing(how="die"),
        "interrupt": Failing(how="KeyboardInterrupt"),
        "unwritable": Failing(how="unwritable"),
        "local": Local(),
        "right": PriorDraws(),
    }
    settings = SMALL | {"workers": 2}
    found = compare(generation(), samplers, time_limit=5.0, **settings)
    assert failures_of(found) == {
        ("hang", 0): "time",
        ("die", 0): "died",
        ("interrupt", 0): "KeyboardInterrupt",
        ("unwritable", 0): "TypeError",
        ("local", 0): "TypeError",
        ("right", 0): None,
    }
    messages = {
        result.sampler: result.failure and result.failure.message for result in found.results
    }
    assert messages["die"] == "a worker process died during this run, possibly out of memory"
    assert messages["local"] == (
        "generation/local/0 cannot be sent to a worker process: Local holds a telescope; make it "
        "picklable or use workers=0"
    )


def test_the_clock_of_a_run_starts_after_loading_libraries(monkeypatch):
    order = []

    def limit(seconds):
        order.append("clock")
        return time_limit(seconds)

    libraries = "probmotion.metrics.measures.load_libraries"
    monkeypatch.setattr(libraries, lambda: order.append("libraries"))
    monkeypatch.setattr("probmotion.comparison.run.grid_runs.time_limit", limit)
    compare(generation(), PriorDraws(), **SMALL)
    assert order == ["libraries", "clock"]


def test_libraries_of_the_metrics_are_loaded_beforehand():
    program = """
import sys
from toy_samplers import PriorDraws, generation
from probmotion.metrics.measures import load_libraries, measure

problem = generation()
draws = PriorDraws().sample(problem.posterior, draws=10, chains=2, seed=0, progress=False)
draws.dataset.attrs["independent"] = 0  # so that ESS is measured
if {prepared}:
    load_libraries()
known = set(sys.modules)
measure(problem, draws, 0)
heavy = {{name.partition(".")[0] for name in set(sys.modules) - known}}
print(sorted(heavy & {{"arviz_stats", "scipy", "sklearn"}}))
"""
    processes = [start("-c", program.format(prepared=prepared)) for prepared in (True, False)]
    first, second = (ast.literal_eval(finish(process)[0]) for process in processes)
    assert first == []
    assert {"arviz_stats", "sklearn"} <= set(second)


def test_runs_are_reused_with_another_time_limit(tmp_path):
    diary = tmp_path / "diary"
    for limit in (None, 50.0, None):
        sampler = PriorDraws(diary=str(diary))
        compare(generation(), sampler, time_limit=limit, out=tmp_path, **SMALL)
    assert count(diary) == 1


def test_a_time_limit_resumes_the_timer_of_the_caller():
    rung = []
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.5)
        start = time.monotonic()
        with pytest.raises(TimeLimitExceeded), time_limit(0.1):
            time.sleep(20)
        assert time.monotonic() - start < 10
        with time_limit(60.0):
            pass
        time.sleep(max(0.0, 0.7 - (time.monotonic() - start)))
        assert rung == [1]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_a_time_limit_that_a_library_wraps_is_recognised():
    def library():
        try:
            time.sleep(20)
        except BaseException as error:
            raise ValueError("INTERNAL: callback") from error

    with pytest.raises(TimeLimitExceeded), time_limit(0.1):
        library()
    with pytest.raises(ValueError, match="its own"), time_limit(60.0):
        raise ValueError("its own")


def test_a_time_limit_on_another_thread_raises_at_the_end():
    found = []

    def work():
        try:
            with time_limit(0.05):
                time.sleep(0.2)
                found.append("ended")
        except TimeLimitExceeded:
            found.append("raised")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == ["ended", "raised"]


@pytest.mark.parametrize(("workers", "how"), [(0, ()), (2, ("slow",))])
def test_a_full_disk_loses_no_finished_run(tmp_path, workers, how):
    script = tmp_path / "run.py"
    script.write_text(FULL_DISK)
    out = tmp_path / "out"
    last = finish(start(script, out, workers, *how), returncode=1)[1].strip().splitlines()[-1]
    assert "OSError: cannot write to out" in last
    finished = int(re.search(r"with (\d) of 4 runs finished and stored in", last)[1])
    # One of two workers may still be in its first run when the disk is full.
    assert finished == 2 if workers == 0 else 1 <= finished <= 2
    assert len(Comparison.load(out).results) == finished
    # Nor do workers that were killed while writing leave anything.
    assert (out / "began to write").exists() == bool(how)
    assert not list(out.glob("runs/*/*/.unfinished*"))
    if workers == 0:  # with space on the disk the same command continues
        finish(start(script, out, workers, "room"))
        assert len(Comparison.load(out).results) == 4


FULL_DISK = """
import resource, sys, time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from toy_samplers import PriorDraws, generation
from probmotion.comparison import compare
from probmotion.comparison.results.plan import Plan
from probmotion.posteriors.draws import MotionDraws


def save_slowly(draws, path, save=MotionDraws.save):
    save(draws, path)
    if path.parent.name.startswith(".unfinished-0"):
        Path(sys.argv[1], "began to write").touch()
        time.sleep(100)


@dataclass(frozen=True)
class Filling(PriorDraws):
    # There is space until the third run.
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
# All runs of one sampler first.
Plan.runs = lambda self: (("generation", s, k) for s in self.samplers for k in (0, 1))
out, workers, *_ = sys.argv[1:]
compare(generation(), samplers, seeds=2, draws=20, chains=2, out=out, workers=int(workers),
        progress=False)
"""


class Broken(GaussianMixtureMotion):
    """Prior whose posterior and draws are not implemented."""

    def exact_posterior(self, *given, **named):
        raise NotImplementedError("to be written")

    def sample(self, rng, n):
        raise NotImplementedError("to be written")


@pytest.mark.parametrize("observed", [True, False])
def test_failing_reference_draws_do_not_stop_other_problems(observed):
    whole = small_prior()
    prior = Broken(**{each.name: getattr(whole, each.name) for each in fields(whole) if each.init})
    likelihood = monocular().posterior.likelihood if observed else None
    problems = {"broken": MotionPosterior(prior, likelihood), "whole": generation()}
    found = compare(problems, PriorDraws(), **SMALL)
    words = {result.problem: result.failure and result.failure.word for result in found.results}
    assert words == {"broken": "observations" if observed else "NotImplementedError", "whole": None}


def test_scripts_need_no_main_guard_in_worker_processes(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    output, errors = finish(start(script, cwd=tmp_path))
    assert ast.literal_eval(output) == {"mine": None, "greedy": "memory"}
    # No worker runs the script.
    assert errors.count("the script runs") == 1


SCRIPT = """
import os, signal, sys
from dataclasses import dataclass
from typing import ClassVar
import toy_samplers
from probmotion.comparison import compare

print("the script runs", file=sys.stderr)


@dataclass(frozen=True)
class Mine(toy_samplers.PriorDraws):
    name: ClassVar[str] = "mine"


@dataclass(frozen=True)
class Greedy(Mine):
    name: ClassVar[str] = "greedy"

    def sample(self, posterior, **settings):
        # As the system does when memory runs out.
        os.kill(os.getpid(), signal.SIGKILL)


found = compare(toy_samplers.generation(), [Mine(), Greedy()], draws=20, progress=False)
print({result.sampler: result.failure and result.failure.word for result in found.results})
"""
