"""Grids that share a folder: locked problems, array jobs and other versions."""

from __future__ import annotations

import json
from unittest.mock import Mock

import pytest
from toy_samplers import SMALL, PriorDraws, count, generation, monocular, start

from probmotion.comparison import Comparison, compare
from probmotion.comparison.run.locks import locked
from probmotion.files import read_json
from probmotion.samplers import ExactSampler

HOLDER = """
import sys, time
from pathlib import Path
from probmotion.comparison.run.locks import locked
from probmotion.files import read_json
with locked(Path(sys.argv[1]), ["generation"]):
    print("locked", flush=True)
    time.sleep(60)
"""


def test_a_problem_is_locked_until_the_other_process_is_killed(tmp_path):
    diary = tmp_path / "diary"
    with start("-c", HOLDER, tmp_path) as holder:
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(ValueError, match=r"in use, got .*, where another process is running g"):
            compare(generation(), PriorDraws(diary=str(diary)), out=tmp_path, **SMALL)
        assert count(diary) == 0
        # Other problems are not locked.
        assert compare(monocular(), ExactSampler(), out=tmp_path, **SMALL).failures == []
        holder.kill()
    compare(generation(), PriorDraws(diary=str(diary)), out=tmp_path, **SMALL)
    assert count(diary) == 1


def test_locks_are_released_after_errors(tmp_path):
    for _ in range(2):
        with pytest.raises(ValueError, match="stop"), locked(tmp_path, ["a", "b"]):
            raise ValueError("stop")
    with locked(tmp_path, ["a"]):
        with pytest.raises(ValueError, match="running a;"), locked(tmp_path, "ba"):
            pass
        # Problems locked before the failing one are released.
        with locked(tmp_path, ["b"]):
            pass


def test_a_file_system_without_locks_raises(tmp_path, monkeypatch):
    monkeypatch.setattr("fcntl.flock", Mock(side_effect=OSError(38, "Function not implemented")))
    with pytest.raises(OSError, match=r"out must support file locks, got .*: Function not impl"):
        compare(generation(), PriorDraws(), out=tmp_path, **SMALL)


def test_array_jobs_share_a_folder_that_one_call_gathers(tmp_path):
    diary = tmp_path / "diary"
    problems = {"one": generation(), "two": generation()}
    samplers = {"toy": PriorDraws(diary=str(diary))}
    for name, problem in problems.items():
        compare({name: problem}, samplers, seeds=2, out=tmp_path, **SMALL)
    assert count(diary) == 4
    assert len(Comparison.load(tmp_path).results) == 4
    gathered = compare(problems, samplers, seeds=2, out=tmp_path, **SMALL)
    assert count(diary) == 4
    assert len(gathered.results) == len(Comparison.load(tmp_path).results) == 4


def test_folders_of_other_formats_raise(tmp_path):
    diary = tmp_path / "diary"
    sampler = PriorDraws(diary=str(diary))
    compare(generation(), sampler, out=tmp_path, **SMALL)
    plan = tmp_path / "comparison.json"
    stored = read_json(plan)  # without the checksum
    first = {name: value for name, value in stored.items() if name != "format"}
    for other, version in ((stored | {"format": 7}, 7), (first, 1)):
        plan.write_text(json.dumps(other))
        message = rf"out must be written by .* \(format 3\), got .* of format {version};"
        with pytest.raises(ValueError, match=message):
            compare(generation(), sampler, out=tmp_path, **SMALL)
        with pytest.raises(ValueError, match=message):
            Comparison.load(tmp_path)
        assert json.loads(plan.read_text()) == other
    assert count(diary) == 1
