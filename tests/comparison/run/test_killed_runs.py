"""SIGKILL at every file that a grid writes loses no finished run and leaves no partial file."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from toy_samplers import finish, start

from probmotion.files import forget_killed, written_whole

# In a pilot, between the files of a run, before a run, in a simulation, in a table.
MOMENTS = [
    ("comparison", r"open pilots/generation/\.walking"),
    ("comparison", r"os\.rename pilots/generation/\.walking"),
    ("comparison", r"os\.rename runs/generation/walking/\.unfinished-1-\d+/\.draws"),
    ("comparison", r"open runs/generation/walking/\.unfinished-1-\d+/run\.json"),
    ("comparison", r"os\.rename runs/generation/walking/\.unfinished-1-\d+$"),
    ("comparison", r"os\.rename \.table"),
    ("calibration", r"open calibration/runs/generation/prior-draws/.*/run\.json"),
    ("calibration", r"os\.rename calibration/runs/generation/prior-draws/\.unfinished-\d-\d+$"),
    ("calibration", r"os\.rename calibration/\.table"),
]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the killed processes are forked")
def test_a_grid_killed_at_any_file_can_be_continued(tmp_path):
    output, _ = finish(start(Path(__file__).parent / "killed_runs.py", tmp_path))
    kills = [json.loads(line) for line in output.splitlines()]
    for kill in kills:
        # Runs are complete or absent; finished ones are neither repeated nor written again.
        assert kill["broken"] == [], kill
        assert kill["written again"] == [], kill
        assert kill["run"] == kill["missing"], kill
        assert kill["left"] == [], kill
        assert kill["same table"], kill
    for grid, moment in MOMENTS:
        assert any(kill["grid"] == grid and re.match(moment, kill["event"]) for kill in kills)
    # Kills happen before the first run is finished and after the last.
    assert {kill["missing"] for kill in kills} == {0, 1, 2, 5}


def test_partial_files_of_other_processes_are_left(tmp_path):
    with written_whole(tmp_path / "table.csv") as mine:
        machine = mine.name.split(".")[2]
        dead = mine.with_name(f".table.{machine}.{2**30}.unfinished.csv")
        elsewhere = mine.with_name(f".table.{int(machine, 16) ^ 1:08x}.{2**30}.unfinished.csv")
        left = [mine, elsewhere, tmp_path / ".table.unfinished.csv", tmp_path / "run.json"]
        for path in [dead, *left]:
            path.write_text("half")
        forget_killed(tmp_path)
        assert not dead.exists()
        assert all(path.exists() for path in left)
    assert (tmp_path / "table.csv").read_text() == "half"
