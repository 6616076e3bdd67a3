"""Interrupted grids continue without losing or repeating finished runs."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pandas as pd
import pytest
from toy_samplers import (
    SMALL,
    Failing,
    PriorDraws,
    count,
    generation,
    monocular,
    numbers,
    start,
)

from probmotion.comparison import Comparison, compare

SCRIPT = """
import sys
from toy_samplers import PriorDraws, generation
from probmotion.comparison import compare

out, diary, nap = sys.argv[1:]
spreads = {"a": 1.0, "b": 2.0}
samplers = {name: PriorDraws(spread, float(nap), diary) for name, spread in spreads.items()}
compare(generation(), samplers, seeds=4, draws=20, chains=2, out=out, workers=2)
"""


def table(folder: Path) -> str:
    return numbers(pd.read_csv(folder / "table.csv"))


def interrupted(folder: Path, finished: int, how: signal.Signals, nap: float) -> str:
    """Start a grid of 8 runs, interrupt it after some, and return its error."""
    (folder / "run.py").write_text(SCRIPT)
    process = start(folder / "run.py", folder / "cut", folder / "diary", nap)
    limit = time.monotonic() + 60
    while len(list(folder.glob("cut/runs/*/*/[0-9]/run.json"))) < finished:
        assert time.monotonic() < limit, "the grid made no progress"
        time.sleep(0.02)
    process.send_signal(how)
    errors = process.communicate(timeout=20)[1]
    assert process.returncode != 0
    return errors


def test_a_killed_grid_stops_its_workers_and_can_be_continued(tmp_path):
    diary = tmp_path / "diary"
    interrupted(tmp_path, 3, signal.SIGKILL, nap=0.3)
    finished = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cut/runs/*/*/*/run.json")}
    assert 3 <= len(finished) < 8
    time.sleep(1.0)  # surviving workers would write now
    assert len(list(tmp_path.glob("cut/runs/*/*/[0-9]/run.json"))) <= len(finished) + 2
    diary.unlink()

    spreads = {"a": 1.0, "b": 2.0}
    samplers = {name: PriorDraws(spread, 0.3, str(diary)) for name, spread in spreads.items()}
    compare(generation(), samplers, seeds=4, out=tmp_path / "cut", **SMALL)
    assert 8 - len(finished) - 2 <= count(diary) <= 8 - len(finished)
    for path, written in finished.items():
        assert path.stat().st_mtime_ns == written
    assert not list(tmp_path.glob("cut/**/*unfinished*"))
    samplers = {name: PriorDraws(spread) for name, spread in spreads.items()}
    compare(generation(), samplers, seeds=4, out=tmp_path / "whole", **SMALL)
    assert table(tmp_path / "cut") == table(tmp_path / "whole")


def test_ctrl_c_stops_workers_and_keeps_finished_runs(tmp_path):
    errors = interrupted(tmp_path, 2, signal.SIGINT, nap=0.5)
    finished = len(Comparison.load(tmp_path / "cut").results)
    assert 2 <= finished < 8
    assert f"KeyboardInterrupt: interrupted with {finished} of 8 runs finished and stored" in errors
    time.sleep(0.7)
    assert len(Comparison.load(tmp_path / "cut").results) == finished


def test_finished_runs_are_not_repeated(tmp_path):
    diary = tmp_path / "diary"
    sampler = PriorDraws(diary=str(diary))
    for seeds in (3, 3, 4):
        compare(generation(), sampler, seeds=seeds, out=tmp_path / "out", **SMALL)
        assert count(diary) == seeds


def test_other_inputs_require_another_folder(tmp_path):
    diary, out = tmp_path / "diary", tmp_path / "out"

    def run(problem, spread=1.0, **settings):
        named = {"sampler": PriorDraws(spread, diary=str(diary))}
        compare({"problem": problem}, named, out=out, **(SMALL | settings))
        return count(diary)

    assert run(generation()) == 1
    stored = (out / "table.csv").read_bytes()
    for change in (
        {"problem": generation(), "spread": 1.5},
        {"problem": generation(), "draws": 40},
        {"problem": generation(), "chains": 4},
        {"problem": monocular()},
    ):
        with pytest.raises(ValueError, match="holds 1 finished runs made with other settings"):
            run(**change)
    assert (out / "table.csv").read_bytes() == stored
    assert run(generation()) == 1
    assert run(generation(), seeds=2) == 2


def test_failures_are_retried_but_unsupported_samplers_are_not(tmp_path):
    mended, diary = tmp_path / "mended", tmp_path / "diary"
    samplers = {
        "crashing": Failing(how="until the file exists", file=str(mended)),
        "prior": PriorDraws(diary=str(diary)),
    }

    def run():
        comparison = compare([generation(), monocular()], samplers, out=tmp_path / "out", **SMALL)
        return {(r.problem, r.sampler): r.failure and r.failure.word for r in comparison.results}

    first = run()
    assert first["generation", "crashing"] == "RuntimeError"
    assert first["monocular", "prior"] == "observations"
    assert count(diary) == 2
    mended.touch()
    second = run()
    assert second["generation", "crashing"] is None
    assert second["monocular", "prior"] == "observations"
    assert count(diary) == 2


def test_damaged_runs_are_repeated(tmp_path):
    diary, out = tmp_path / "diary", tmp_path / "out"
    sampler = PriorDraws(diary=str(diary))
    first = compare(generation(), sampler, seeds=4, out=out, **SMALL)
    before = table(out)
    runs = out / "runs" / "generation" / "prior-draws"
    whole = (runs / "3" / "draws.nc").read_bytes()
    (runs / "0" / "run.json").write_text('{"problem": "gen')
    (runs / "1" / "draws.nc").unlink()
    (runs / "3" / "draws.nc").write_bytes(whole[:200])
    (runs / ".unfinished-1-77").mkdir()
    again = compare(generation(), sampler, seeds=4, out=out, **SMALL)
    assert count(diary) == 4 + 3
    assert table(out) == before
    assert sorted(path.name for path in runs.iterdir() if path.is_dir()) == ["0", "1", "2", "3"]
    for seed in range(4):
        address = ("generation", "prior-draws", seed)
        assert (again.draws(*address).flat() == first.draws(*address).flat()).all()
