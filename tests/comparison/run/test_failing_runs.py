"""Failing runs are recorded with their reason and never stop the grid."""

from __future__ import annotations

import ast
import pickle
import re
import signal
import sys
import threading
import time
from dataclasses import dataclass, fields
from typing import ClassVar

import pytest
from toy_samplers import (
    SMALL,
    Failing,
    PriorDraws,
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
    "raise": ("RuntimeError", "singular matrix"),
    "nan": ("nan", "nan returned 1 positions that are not finite or beyond 1e+100 metres"),
    "diverged": ("nan", "diverged returned 36 positions that are not finite or beyond 1e+100"),
    "infinite": ("nan", "positions must be finite, got 720 values that are NaN or infinite"),
    "memory": ("memory", "MemoryError"),
    "exit": ("SystemExit", "3"),
    "unwritable": ("TypeError", "Invalid value for attr 'odd'"),
    "none": ("TypeError", "none must return MotionDraws, got NoneType"),
    "other skeleton": ("ValueError", "other skeleton must return draws of the posterior's skele"),
    "too few": ("ValueError", "too few must return 2 chains of 10 draws, got 2 of 9"),
    "one chain": ("ValueError", "one chain must return 2 chains of 10 draws, got 1 of 20"),
    "no time": ("ValueError", "no time must return draws with their run time, got seconds=nan"),
}


def test_every_failure_is_recorded_with_word_and_message(tmp_path):
    samplers = {how: Failing(how=how) for how in FAILURES} | {"right": PriorDraws()}
    comparison = compare(generation(), samplers, out=tmp_path, **SMALL)
    failures = {result.sampler: result.failure for result in comparison.results}
    assert failures.pop("right") is None
    table = comparison.table()
    for how, (word, message) in FAILURES.items():
        assert failures[how].word == word
        assert failures[how].message.startswith(message)
        assert word in str(table)
    assert set(table[table["metric"] == "failed"]["sampler"]) == set(FAILURES)
    assert not list(tmp_path.glob("runs/*/*/.unfinished*"))


class OutOfMemoryError(RuntimeError):
    """Error of the name that torch uses."""


@pytest.mark.parametrize(
    ("error", "word"),
    [
        (RuntimeError("RESOURCE_EXHAUSTED: out of memory"), "memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "memory"),
        (OutOfMemoryError("CUDA"), "memory"),
        (WorkerDied(killed=True), "memory"),
        (WorkerDied(killed=False), "died"),
        (FloatingPointError("overflow"), "nan"),
        (ValueError("theta is wrong"), "ValueError"),
        (ModuleNotFoundError("jax must be installed"), "not installed"),
        (TimeLimitExceeded(3.0), "time"),
        (ResultNotWritten("the disk is full"), "ResultNotWritten"),
    ],
)
def test_errors_have_a_word_and_can_be_pickled(error, word):
    assert Failure.of(error).word == word
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_runs_beyond_the_time_limit_are_recorded():
    samplers = {"hang": Failing(how="hang"), "right": PriorDraws()}
    comparison = compare(generation(), samplers, time_limit=2.0, **SMALL)
    failures = {result.sampler: result.failure for result in comparison.results}
    assert failures["right"] is None
    assert str(failures["hang"]) == "time: took longer than time_limit, 2 seconds"


def test_failures_of_worker_processes_are_recorded():
    @dataclass(frozen=True)
    class Local(PriorDraws):
        name: ClassVar[str] = "local"

        def __reduce__(self):
            raise TypeError("Local refuses")

    samplers = {
        "hang": Failing(how="hang without signals"),
        "die": Failing(how="die"),
        "interrupt": Failing(how="KeyboardInterrupt"),
        "unwritable": Failing(how="unwritable"),
        "local": Local(),
        "right": PriorDraws(),
    }
    comparison = compare(generation(), samplers, time_limit=3.0, **SMALL | {"workers": 2})
    failures = {result.sampler: result.failure for result in comparison.results}
    assert failures.pop("right") is None
    assert {sampler: failure.word for sampler, failure in failures.items()} == {
        "hang": "time",
        "die": "died",
        "interrupt": "KeyboardInterrupt",
        "unwritable": "TypeError",
        "local": "TypeError",
    }
    message = "a worker process died during this run, possibly out of memory"
    assert failures["die"].message == message
    assert failures["local"].message == (
        "generation/local/0 cannot be sent to a worker process: Local refuses; make it "
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
modules = [set(sys.modules)]
for call in (load_libraries, lambda: measure(problem, draws, 0)):
    call()
    modules.append(set(sys.modules))
heavy = [{name.partition(".")[0] for name in new - old} for old, new in zip(modules, modules[1:])]
print([sorted({"arviz_stats", "scipy"} & names) for names in heavy])
"""
    loaded, later = ast.literal_eval(finish(start("-c", program))[0])
    assert "arviz_stats" in loaded
    assert later == []


def test_a_time_limit_resumes_the_timer_of_the_caller():
    handler = signal.getsignal(signal.SIGALRM)
    signal.setitimer(signal.ITIMER_REAL, 100.0)
    try:
        with pytest.raises(TimeLimitExceeded), time_limit(0.1):
            time.sleep(20)
    finally:
        left, _ = signal.setitimer(signal.ITIMER_REAL, 0)
    assert 80 < left < 99.95
    assert signal.getsignal(signal.SIGALRM) is handler


def test_a_time_limit_is_not_lost_in_a_destructor(monkeypatch):
    # Python reports exceptions of destructors and goes on.
    class Slow:
        def __del__(self):
            time.sleep(0.2)

    def block():
        Slow()
        time.sleep(20)

    reported = []
    monkeypatch.setattr(sys, "unraisablehook", reported.append)
    start = time.monotonic()
    with pytest.raises(TimeLimitExceeded), time_limit(0.1):
        block()
    assert len(reported) == 1
    assert time.monotonic() - start < 10


def test_clean_up_has_a_second():
    events = []

    def block():
        try:
            time.sleep(20)
        finally:
            time.sleep(0.3)
            events.append("cleaned")

    handler = signal.getsignal(signal.SIGALRM)
    for seconds in (1e-5, 0.1):
        with pytest.raises(TimeLimitExceeded), time_limit(seconds):
            block()
        assert signal.getsignal(signal.SIGALRM) is handler
        assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert events[-1:] == ["cleaned"]


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
    events = []

    def work():
        try:
            with time_limit(0.05):
                time.sleep(0.2)
                events.append("ended")
        except TimeLimitExceeded:
            events.append("raised")

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert events == ["ended", "raised"]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_full_disk_loses_no_finished_run(tmp_path, workers):
    script, out = tmp_path / "run.py", tmp_path / "out"
    script.write_text(FULL_DISK)
    last = finish(start(script, out, workers), returncode=1)[1].strip().splitlines()[-1]
    assert "OSError: cannot write to out" in last
    finished = int(re.search(r"with (\d) of 4 runs finished and stored in", last)[1])
    # One of two workers may still be in its first run when the disk is full.
    assert finished == 2 if workers == 0 else 1 <= finished <= 2
    assert len(Comparison.load(out).results) == finished
    assert not list(out.glob("runs/*/*/.unfinished*"))
    if workers == 0:  # with space on the disk the same command continues
        finish(start(script, out, workers, "room"))
        assert len(Comparison.load(out).results) == 4


FULL_DISK = """
import resource, sys
from dataclasses import dataclass
from typing import ClassVar
from toy_samplers import PriorDraws, generation
from probmotion.comparison import compare
from probmotion.comparison.results.plan import Plan


@dataclass(frozen=True)
class Filling(PriorDraws):
    # There is space until the third run.
    room: ClassVar[bool] = "room" in sys.argv

    def sample(self, posterior, **settings):
        if self.spread > 1 and not self.room:
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
    given = small_prior()
    prior = Broken(**{each.name: getattr(given, each.name) for each in fields(given) if each.init})
    likelihood = monocular().posterior.likelihood if observed else None
    problems = {"broken": MotionPosterior(prior, likelihood), "right": generation()}
    results = compare(problems, PriorDraws(), **SMALL).results
    words = {result.problem: result.failure and result.failure.word for result in results}
    assert words == {"broken": "observations" if observed else "NotImplementedError", "right": None}


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


comparison = compare(toy_samplers.generation(), [Mine(), Greedy()], draws=20, progress=False)
print({result.sampler: result.failure and result.failure.word for result in comparison.results})
"""
