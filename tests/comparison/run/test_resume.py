"""A run that was stopped goes on: nothing finished is lost, nothing is computed twice."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from toy_samplers import CrashingOnce, Interrupting, PriorDraws, generation, monocular

from probmotion.comparison import Comparison, compare

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}

SCRIPT = """
import sys
from toy_samplers import PriorDraws, generation, monocular
from probmotion.comparison import compare

if __name__ == "__main__":
    out, diary, nap, workers = sys.argv[1:]
    samplers = {
        name: PriorDraws(spread, float(nap), diary) for name, spread in (("a", 1.0), ("b", 2.0))
    }
    compare(generation(), samplers, seeds=4, draws=20, chains=2, out=out, workers=int(workers))
"""


def numbers(folder):
    table = pd.read_csv(Path(folder) / "table.csv")
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].to_csv(index=False)


def runs(diary):
    return len(diary.read_text().split()) if diary.exists() else 0


def start(script, out, diary, nap=0.0, workers=0):
    command = [sys.executable, str(script), str(out), str(diary), str(nap), str(workers)]
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": paths}, stderr=subprocess.PIPE, text=True
    )


def finish(process):
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0, said


def wait_for_cells(out, n, seconds=60.0):
    limit = time.monotonic() + seconds
    while len(list(Path(out).glob("cells/*/*/[0-9]/cell.json"))) < n:
        assert time.monotonic() < limit, "the run made no progress"
        time.sleep(0.02)


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "run.py"
    path.write_text(SCRIPT)
    return path


def test_workers_die_with_a_run_that_is_killed_and_it_goes_on_where_it_was(script, tmp_path):
    diary = tmp_path / "diary"
    finish(start(script, tmp_path / "whole", diary))
    assert runs(diary) == 8
    diary.unlink()

    # The nap is a setting, so that both runs below must take it to be the same run.
    process = start(script, tmp_path / "cut", diary, nap=0.3, workers=2)
    wait_for_cells(tmp_path / "cut", 3)
    process.kill()
    process.communicate()
    finished = {
        path: path.stat().st_mtime_ns for path in tmp_path.glob("cut/cells/*/*/[0-9]/cell.json")
    }
    assert 3 <= len(finished) < 8
    time.sleep(1.0)  # orphans, if they lived, would write here
    assert len(list(tmp_path.glob("cut/cells/*/*/[0-9]/cell.json"))) <= len(finished) + 2
    diary.unlink()

    finish(start(script, tmp_path / "cut", diary, nap=0.3, workers=2))
    assert 8 - len(finished) - 2 <= runs(diary) <= 8 - len(finished)
    for path, written in finished.items():
        assert path.stat().st_mtime_ns == written
    assert numbers(tmp_path / "cut") == numbers(tmp_path / "whole")
    assert not list(tmp_path.glob("cut/**/*unfinished*"))


@pytest.mark.parametrize("workers", [0, 2])
def test_ctrl_c_stops_at_once_and_keeps_what_is_finished(script, tmp_path, workers):
    diary = tmp_path / "diary"
    process = start(script, tmp_path / "cut", diary, nap=0.5, workers=workers)
    wait_for_cells(tmp_path / "cut", 2)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode != 0
    assert "KeyboardInterrupt: interrupted with" in said
    finished = len(Comparison.load(tmp_path / "cut").results)
    assert 2 <= finished < 8
    assert f"interrupted with {finished} of 8 cells finished, which are kept in" in said
    time.sleep(0.7)
    assert len(Comparison.load(tmp_path / "cut").results) == finished


def test_without_a_folder_ctrl_c_says_where_the_cells_are(tmp_path):
    sampler = Interrupting(diary=str(tmp_path / "diary"))
    with pytest.raises(KeyboardInterrupt, match="interrupted with 1 of 3 cells") as caught:
        compare(generation(), sampler, seeds=3, **SMALL)
    folder = str(caught.value).split("kept in ")[1].split(";")[0]
    assert len(Comparison.load(folder).results) == 1


def test_a_finished_grid_is_not_run_again(tmp_path):
    diary = tmp_path / "diary"
    sampler = PriorDraws(diary=str(diary))
    for _ in range(2):
        compare(generation(), sampler, seeds=3, out=tmp_path / "out", **SMALL)
        assert runs(diary) == 3
    compare(generation(), sampler, seeds=4, out=tmp_path / "out", **SMALL)
    assert runs(diary) == 4


def test_other_settings_need_another_folder(tmp_path):
    diary = tmp_path / "diary"
    out = tmp_path / "out"

    def run(problem, spread=1.0, **settings):
        named = {"sampler": PriorDraws(spread, diary=str(diary))}
        compare({"problem": problem}, named, out=out, **(SMALL | settings))
        return runs(diary)

    assert run(generation()) == 1
    kept = (out / "table.csv").read_bytes()
    for change in (
        {"problem": generation(), "spread": 1.5},
        {"problem": generation(), "draws": 40},
        {"problem": generation(), "chains": 4},
        {"problem": monocular()},
    ):
        with pytest.raises(ValueError, match="holds 1 finished cells made with other settings"):
            run(**change)
    assert (out / "table.csv").read_bytes() == kept
    assert run(generation()) == 1
    # More of the same is no other comparison.
    assert run(generation(), seeds=2) == 2


def test_failures_are_tried_again_and_unfit_samplers_are_not(tmp_path):
    mended, diary = tmp_path / "mended", tmp_path / "diary"
    samplers = [CrashingOnce(mended=str(mended)), PriorDraws(diary=str(diary))]

    def run():
        comparison = compare([generation(), monocular()], samplers, out=tmp_path / "out", **SMALL)
        return {(each.problem, each.sampler): each.failure for each in comparison.results}

    first = run()
    assert first["generation", "crashing-once"].word == "RuntimeError"
    assert first["monocular", "prior-draws"].word == "observations"
    assert runs(diary) == 2
    mended.touch()
    second = run()
    assert second["generation", "crashing-once"] is None
    assert second["monocular", "prior-draws"].word == "observations"
    assert runs(diary) == 2


def test_damaged_and_half_written_cells_are_run_again(tmp_path):
    diary = tmp_path / "diary"
    sampler = PriorDraws(diary=str(diary))
    compare(generation(), sampler, seeds=2, out=tmp_path, **SMALL)
    before = numbers(tmp_path)
    cells = tmp_path / "cells" / "generation" / "prior-draws"
    (cells / "0" / "cell.json").write_text('{"problem": "gen')
    (cells / ".unfinished-1-77").mkdir()
    compare(generation(), sampler, seeds=2, out=tmp_path, **SMALL)
    assert runs(diary) == 3
    assert numbers(tmp_path) == before
    assert sorted(path.name for path in cells.iterdir()) == ["0", "1"]
