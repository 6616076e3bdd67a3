"""Two runs and one folder: locked where they would meet, shared where they do not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from toy_samplers import PriorDraws, generation, monocular

from probmotion.comparison import Comparison, compare
from probmotion.comparison.run import tasks
from probmotion.comparison.run.locks import locked
from probmotion.samplers import ExactSampler

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}
HOLDER = """
import sys, time
from pathlib import Path
from probmotion.comparison.locks import locked
with locked(Path(sys.argv[1]), ["generation"]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_runs_of_one_problem_are_told_apart_until_one_is_killed(tmp_path):
    diary = tmp_path / "diary"
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        env={**os.environ, "PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
    )
    with holder:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=r"out is .*, where another run is at work on gener"):
            compare(generation(), PriorDraws(diary=str(diary)), out=tmp_path, **SMALL)
        assert not diary.exists()
        # Another problem's cells are nobody's.
        assert compare(monocular(), ExactSampler(), out=tmp_path, **SMALL).failures == []
        holder.kill()
    # SIGKILL lets nothing run: the system lets go of the lock.
    compare(generation(), PriorDraws(diary=str(diary)), out=tmp_path, **SMALL)
    assert len(diary.read_text().split()) == 1


def test_a_lock_is_let_go_when_a_run_ends_or_fails(tmp_path):
    for _ in range(2):
        with pytest.raises(ValueError, match="stop"), locked(tmp_path, ["a", "b"]):
            raise ValueError("stop")
    with (
        locked(tmp_path, ["a"]),
        pytest.raises(ValueError, match="work on a;"),
        locked(tmp_path, "ba"),
    ):
        pass
    # What was locked before the one that was not is free again.
    with locked(tmp_path, ["b"]):
        pass


def test_a_file_system_without_locks_is_said_so(tmp_path, monkeypatch):
    import fcntl

    def no_locks(*_):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(
        OSError, match=r"out is .*, whose files cannot be locked, Function not impl"
    ):
        compare(generation(), PriorDraws(), out=tmp_path, **SMALL)


def test_tasks_of_an_array_job_share_a_folder_and_one_call_gathers_them(tmp_path):
    """The recipe of the README: a run per problem, then one over all, which computes nothing."""
    diary = tmp_path / "diary"
    problems = {"one": generation(), "two": generation()}
    samplers = {"toy": PriorDraws(diary=str(diary))}
    for name, problem in problems.items():
        alone = compare({name: problem}, samplers, seeds=2, out=tmp_path, **SMALL)
        assert set(alone.table()["problem"]) == {name}
    assert len(diary.read_text().split()) == 4
    gathered = compare(problems, samplers, seeds=2, out=tmp_path, **SMALL)
    assert len(diary.read_text().split()) == 4
    assert len(gathered.results) == len(Comparison.load(tmp_path).results) == 4


def test_a_folder_of_another_version_is_refused(tmp_path, monkeypatch):
    diary = tmp_path / "diary"
    sampler = PriorDraws(diary=str(diary))
    compare(generation(), sampler, out=tmp_path, **SMALL)
    kept = (tmp_path / "comparison.json").read_text()
    assert json.loads(kept)["format"] == 1

    other = json.dumps(json.loads(kept) | {"format": 7})
    (tmp_path / "comparison.json").write_text(other)
    sentence = r"out is .*, which another version of probmotion wrote \(format 7, expected 1\); exp"
    with pytest.raises(ValueError, match=sentence):
        compare(generation(), sampler, out=tmp_path, **SMALL)
    with pytest.raises(ValueError, match=sentence):
        Comparison.load(tmp_path)
    assert (tmp_path / "comparison.json").read_text() == other

    (tmp_path / "comparison.json").write_text(kept)
    monkeypatch.setattr(tasks, "library_versions", lambda: {"probmotion": "0.0.7"})
    with pytest.raises(
        ValueError, match="1 finished cells made with other settings, evidence or li"
    ):
        compare(generation(), sampler, out=tmp_path, **SMALL)
    assert len(diary.read_text().split()) == 1


def test_plans_without_a_format_are_the_first_one(tmp_path):
    compare(generation(), PriorDraws(), out=tmp_path, **SMALL)
    held = json.loads((tmp_path / "comparison.json").read_text())
    del held["format"], held["notes"]
    (tmp_path / "comparison.json").write_text(json.dumps(held))
    assert len(Comparison.load(tmp_path).results) == 1
