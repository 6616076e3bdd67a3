"""Clocks that jump, processes that share a folder, and workers without memory."""

from __future__ import annotations

import datetime
import itertools
import os
import resource
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from toy_samplers import SMALL, PriorDraws, generation, numbers
from victims import Process, weights

import probmotion as pm
from probmotion.cli.main import main
from probmotion.comparison import Comparison, compare
from probmotion.comparison.results.failures import TimeLimitExceeded
from probmotion.comparison.run.time_limits import time_limit
from probmotion.data.synthetic.gaits import make_gait
from probmotion.files import locked_folder
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.posteriors import streams


@dataclass(frozen=True)
class Greedy(PriorDraws):
    """Needs more memory than its process may have."""

    name: ClassVar[str] = "greedy"

    def sample(self, posterior, **settings):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + 2**28, resource.RLIM_INFINITY))
        try:
            np.zeros(2**28)  # 2 GiB
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
        raise AssertionError


@dataclass(frozen=True)
class Killed(PriorDraws):
    """Is killed by the system, as when memory runs out."""

    name: ClassVar[str] = "killed"

    def sample(self, posterior, **settings):
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def set_clock(monkeypatch):
    """Function after which the clock of the computer is set back and forth at each reading."""

    def jump():
        jumps = itertools.accumulate(itertools.cycle([3_000_000, -7_000_000]))
        now, today = time.time, datetime.date.today()

        class Date(datetime.date):
            @classmethod
            def today(cls):
                return today + datetime.timedelta(seconds=next(jumps))

        monkeypatch.setattr(time, "time", lambda: now() + next(jumps))
        monkeypatch.setattr(time, "time_ns", lambda: int(1e9 * time.time()))
        monkeypatch.setattr(datetime, "date", Date)

    return jump


def touch(folder):
    """Give files a time of change in the past or future."""
    for number, path in enumerate(sorted(folder.rglob("*"))):
        os.utime(path, (1e9, 1e9) if number % 2 else (4e9, 4e9))


def stream(folder, number):
    posterior = pm.problem("gait-monocular", frames=6).posterior
    sampler = pm.samplers.MetropolisHastings(warmup=20, thin=1)
    options = {"draws": 80 * number, "chains": 2, "progress": False}
    return pm.sample(posterior, sampler, stream=folder, **options)


def stream_results(folder):
    draws = pm.open_draws(folder)
    return draws.positions.values.tobytes(), [draws.seconds]


def train(folder, number):
    clips = folder.parent / "clips"
    if not clips.exists():
        clips.mkdir()
        for walk in range(5):
            pm.save(make_gait("walk", walk, frames=40, fps=30.0), clips / f"walk{walk}.npz")
    words = "--size tiny --validation walk3 --test walk4 --batch 4 --checkpoint-every 2"
    more = ["--clips", f"{clips}/walk*.npz", "--steps", f"{4 * number}", "--out", f"{folder}"]
    assert main(["train", "dvae", *words.split(), *more]) == 0


def train_results(folder):
    history = load_checkpoint(folder / "model.safetensors", "motion-dvae").settings["history"]
    return weights(folder), [row["seconds"] for row in history]


def grid(folder, number):
    return compare(generation(), PriorDraws(), seeds=number, out=folder, **SMALL)


def grid_results(folder):
    table = Comparison.load(folder).table()
    return numbers(table), table.set_index("metric")["value"]["seconds"]


RESUMED = {
    "streamed chain": (stream, stream_results),
    "training": (train, train_results),
    "grid in a folder": (grid, grid_results),
}


@pytest.mark.parametrize("name", RESUMED)
def test_resumed_runs_do_not_depend_on_the_clock(name, tmp_path, set_clock, account, monkeypatch):
    """The clock is set before a run is resumed and at each reading, and files are of any time."""
    monkeypatch.setattr(streams, "_BLOCK_BYTES", 80_000)
    run, results = RESUMED[name]
    run(tmp_path / "undisturbed", 2)
    expected, _ = results(tmp_path / "undisturbed")
    set_clock()
    with account("clock", name):
        run(tmp_path / "out", 1)
        touch(tmp_path / "out")
        run(tmp_path / "out", 2)
        got, seconds = results(tmp_path / "out")
        assert got == expected
        assert all(0 <= second < 600 for second in seconds)


def test_results_do_not_depend_on_the_clock(set_clock, account):
    """The clock of the computer is set back and forth; time limits and results are the same."""
    expected = compare(generation(), PriorDraws(), **SMALL)
    set_clock()
    with account("clock", "grid"):
        jumping = compare(generation(), PriorDraws(), time_limit=600.0, **SMALL)
        assert numbers(jumping.table()) == numbers(expected.table())
        seconds = jumping.table().set_index("metric")["value"]["seconds"]
        assert 0 <= seconds < 600
    with account("clock", "time limit"), pytest.raises(TimeLimitExceeded), time_limit(0.1):
        time.sleep(300)


@pytest.mark.parametrize("name", ["streamed chain", "grid"])
def test_two_runs_in_one_folder(name, tmp_path, account):
    """The second ends with a sentence; the first is not disturbed."""
    for number in range(5):
        pm.save(make_gait("walk", number, frames=60, fps=30.0), tmp_path / f"walk{number}.npz")
    out = tmp_path / "out"
    first = Process(name, out, tmp_path)
    lock = out / ("runs/gait(frames=8)/.lock" if name == "grid" else ".lock")
    while not lock.exists() and first.wait(0.01) is None:
        pass
    with account("two runs", name):
        second = Process(name, out, tmp_path, log=tmp_path / "second.log")
        # The first may have finished; then the second finds a finished run.
        if second.wait(300) != 0:
            assert "use, got" in second.printed()
            assert "another folder" in second.printed()
        assert first.wait(300) == 0, first.printed()


def test_a_locked_folder_is_refused_by_training(tmp_path, account):
    walk = ["--steps", "1", "--frames", "12", "--views", "1", "--size", "tiny"]
    with account("two runs", "training"), locked_folder("out", tmp_path):
        assert main(["train", "diffusion", *walk, "--out", str(tmp_path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_workers_without_memory_are_failed_rows(workers, account):
    samplers = [Greedy(), PriorDraws(), *([Killed()] if workers else [])]
    with account("memory", f"grid of {workers} workers"):
        results = compare(generation(), samplers, **SMALL | {"workers": workers}).results
        words = {result.sampler: result.failure and result.failure.word for result in results}
        expected = {"greedy": "memory", "prior-draws": None}
        assert words == expected | ({"killed": "memory"} if workers else {})
