"""Studies of samplers' settings run through the grid, to their tables and pages."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from probmotion import Comparison

SCRIPT = Path(__file__).parents[1] / "notebooks" / "ablations" / "settings.py"


@pytest.mark.slow
def test_settings_are_compared_as_samplers(tmp_path, monkeypatch, capsys):
    asked = ["--studies", "correctors", "--draws", "12", "--seeds", "2", "--workers", "1"]
    monkeypatch.setattr(sys, "argv", ["settings.py", "--out", str(tmp_path), *asked])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    printed = capsys.readouterr().out
    found = Comparison.load(tmp_path / "correctors")
    assert list(found.plan.problems) == ["gait", "gait-monocular"]
    assert str(found.table()) in printed
    assert not found.failures
    assert (tmp_path / "correctors" / "report.html").stat().st_size > 1e5
    # Every corrector step asks the denoiser once more.
    table = found.table()
    asked_for = table[table["metric"] == "denoiser_evaluations"].groupby("sampler")["value"].mean()
    assert asked_for["mvpc, no corrector"] < asked_for["mvpc"] < asked_for["mvpc, 3 correctors"]
