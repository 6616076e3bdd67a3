"""SIGKILL at every file that a run writes: what was finished stays, and nothing is half-written."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from probmotion.files import forget_killed, written_whole

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="runs are forked to be killed")

# In a pilot, between the files of a cell, before a cell is there, in a simulation, in a table.
MOMENTS = [
    ("comparison", r"open pilots/generation/\.walking"),
    ("comparison", r"os\.rename pilots/generation/\.walking"),
    ("comparison", r"os\.rename cells/generation/walking/\.unfinished-1-\d+/\.draws"),
    ("comparison", r"open cells/generation/walking/\.unfinished-1-\d+/cell\.json"),
    ("comparison", r"os\.rename cells/generation/walking/\.unfinished-1-\d+$"),
    ("comparison", r"os\.rename \.table"),
    ("calibration", r"open calibration/cells/generation/prior-draws/.*/cell\.json"),
    ("calibration", r"os\.rename calibration/cells/generation/prior-draws/\.unfinished-\d-\d+$"),
    ("calibration", r"os\.rename calibration/\.table"),
]


def test_a_run_that_is_killed_at_any_of_its_files_goes_on(tmp_path):
    script = Path(__file__).parent / "killed_runs.py"
    paths = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | {"PYTHONPATH": paths},
    )
    assert done.returncode == 0, done.stderr
    kills = [json.loads(line) for line in done.stdout.splitlines()]
    for kill in kills:
        # A cell is whole or not there, and what is finished is neither run nor written again.
        assert kill["broken"] == [], kill
        assert kill["written again"] == [], kill
        assert kill["runs"] == kill["missing"], kill
        assert kill["left"] == [], kill
        assert kill["same table"], kill
    for run, moment in MOMENTS:
        assert any(kill["run"] == run and re.match(moment, kill["event"]) for kill in kills)
    # They fall before anything is finished, and after all of it.
    assert {kill["missing"] for kill in kills} == {0, 1, 2, 5}


def test_what_others_are_still_writing_is_left(tmp_path):
    with written_whole(tmp_path / "table.csv") as mine:
        machine = mine.name.split(".")[2]
        dead = mine.with_name(f".table.{machine}.{2**30}.unfinished.csv")
        elsewhere = mine.with_name(f".table.{int(machine, 16) ^ 1:08x}.{2**30}.unfinished.csv")
        kept = [mine, elsewhere, tmp_path / ".table.unfinished.csv", tmp_path / "cell.json"]
        for path in [dead, *kept]:
            path.write_text("half")
        forget_killed(tmp_path)
        assert not dead.exists()
        assert all(path.exists() for path in kept)
    assert (tmp_path / "table.csv").read_text() == "half"
