"""Interrupted grids continue without losing or repeating finished runs."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pandas as pd
import pytest
from toy_samplers import SMALL, Failing, PriorDraws, count, generation, monocular, numbers, start

from probmotion.comparison import compare

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


def test_a_killed_grid_stops_its_workers_and_can_be_continued(tmp_path):
    cut, diary, nap = tmp_path / "cut", tmp_path / "diary", 0.3
    pattern = "runs/*/*/[0-9]/run.json"
    with start("-c", SCRIPT, cut, diary, nap) as process:
        limit = time.monotonic() + 60
        while len(list(cut.glob(pattern))) < 3:
            assert time.monotonic() < limit, "the grid made no progress"
            time.sleep(0.02)
        process.kill()
    finished = {path: path.stat().st_mtime_ns for path in cut.glob(pattern)}
    assert 3 <= len(finished) < 8
    time.sleep(1.0)  # surviving workers would write now
    assert len(list(cut.glob(pattern))) <= len(finished) + 2
    diary.unlink()

    spreads = {"a": 1.0, "b": 2.0}
    samplers = {name: PriorDraws(spread, nap, str(diary)) for name, spread in spreads.items()}
    compare(generation(), samplers, seeds=4, out=cut, **SMALL)
    assert 8 - len(finished) - 2 <= count(diary) <= 8 - len(finished)
    for path, written in finished.items():
        assert path.stat().st_mtime_ns == written
    assert not list(cut.glob("**/*unfinished*"))
    samplers = {name: PriorDraws(spread) for name, spread in spreads.items()}
    compare(generation(), samplers, seeds=4, out=tmp_path / "complete", **SMALL)
    assert table(cut) == table(tmp_path / "complete")


def test_finished_runs_are_not_repeated_with_more_seeds_or_another_limit(tmp_path):
    diary = tmp_path / "diary"
    sampler = PriorDraws(diary=str(diary))
    for seeds, limit in ((3, None), (3, 50.0), (4, None)):
        settings = {"seeds": seeds, "time_limit": limit, "out": tmp_path / "out"}
        compare(generation(), sampler, **settings, **SMALL)
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
        with pytest.raises(ValueError, match=r"out must be a new folder, .* contains finished ru"):
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

    for word in ("RuntimeError", None):
        comparison = compare([generation(), monocular()], samplers, out=tmp_path / "out", **SMALL)
        failures = {(run.problem, run.sampler): run.failure for run in comparison.results}
        assert failures["monocular", "prior"].word == "observations"
        crashed = failures["generation", "crashing"]
        assert (crashed and crashed.word) == word
        assert count(diary) == 2
        mended.touch()


def test_damaged_runs_are_repeated(tmp_path):
    diary, out = tmp_path / "diary", tmp_path / "out"
    sampler = PriorDraws(diary=str(diary))
    first = compare(generation(), sampler, seeds=4, out=out, **SMALL)
    before = table(out)
    runs = out / "runs" / "generation" / "prior-draws"
    (runs / "0" / "run.json").write_text('{"problem": "gen')
    (runs / "1" / "draws.nc").unlink()
    os.truncate(runs / "3" / "draws.nc", 200)
    (runs / ".unfinished-1-77").mkdir()
    again = compare(generation(), sampler, seeds=4, out=out, **SMALL)
    assert count(diary) == 4 + 3
    assert table(out) == before
    assert sorted(path.name for path in runs.iterdir() if path.is_dir()) == ["0", "1", "2", "3"]
    for seed in range(4):
        address = ("generation", "prior-draws", seed)
        assert (again.draws(*address).flat() == first.draws(*address).flat()).all()
