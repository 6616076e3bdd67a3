"""SIGKILL at every file that a grid writes loses no finished run and leaves no partial file."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from toy_samplers import finish, start

from probmotion.files import forget_killed, written_whole

# In a pilot, between the files of a run, before a run, in the table.
MOMENTS = [
    r"open pilots/generation/\.walking",
    r"os\.rename pilots/generation/\.walking",
    r"os\.rename runs/generation/walking/\.unfinished-1-\d+/\.draws",
    r"open runs/generation/walking/\.unfinished-1-\d+/\.run",
    r"os\.rename runs/generation/walking/\.unfinished-1-\d+$",
    r"os\.rename \.table",
]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the killed processes are forked")
def test_a_grid_killed_at_any_file_can_be_continued(tmp_path):
    output, _ = finish(start(Path(__file__).parent / "killed_runs.py", tmp_path))
    kills = [json.loads(line) for line in output.splitlines()]
    for kill in kills:
        # Runs are complete or absent; finished ones are neither repeated nor written again.
        assert kill["broken"] == kill["changed"] == kill["left"] == [], kill
        assert kill["run"] == kill["missing"], kill
        assert kill["same table"], kill
    for moment in MOMENTS:
        assert any(re.match(moment, kill["event"]) for kill in kills), moment
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
