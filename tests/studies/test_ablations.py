"""Studies of what settings and parts are worth run to their tables and pages."""

from __future__ import annotations

import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probmotion import Comparison
from probmotion.models.vae import training as motion_vae_training

SCRIPTS = Path(__file__).parents[2] / "notebooks" / "ablations"


def run(script: str, *asked: str, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", [script, *asked])
    runpy.run_path(str(SCRIPTS / script), run_name="__main__")


@pytest.mark.slow
def test_settings_are_compared_as_samplers(tmp_path, monkeypatch, capsys):
    asked = ["--studies", "correctors", "--draws", "12", "--seeds", "2", "--workers", "1"]
    run("settings.py", "--out", str(tmp_path), *asked, monkeypatch=monkeypatch)
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


def of_motion_vae(folder: Path, *parts: str, monkeypatch) -> list[pd.DataFrame]:
    """Run parts of the motion VAE's study at its smallest; return the tables that it wrote."""
    asked = ["--quick", "--draws", "12", "--out", str(folder), "--parts", *parts]
    run("motion_vae.py", *asked, monkeypatch=monkeypatch)
    return [pd.read_csv(folder / f"{part}.csv", index_col=0) for part in parts]


@pytest.mark.slow
def test_what_the_motion_vae_s_parts_are_worth_comes_in_tables(tmp_path, monkeypatch):
    brief = [
        replace(phase, steps=2) for phase in motion_vae_training.usual_motion_vae_training("tiny")
    ]
    monkeypatch.setattr(motion_vae_training, "usual_motion_vae_training", lambda size: brief)
    views, table, data = of_motion_vae(tmp_path, "views", "table", "data", monkeypatch=monkeypatch)
    assert list(views.index) == [1, 1, 2, 2, 4, 4]
    # Where there is one, it is the nearest to the truth.
    assert (views.loc[1, "right"] == 1).all()
    np.testing.assert_allclose(views.loc[1, "mpjpe"], views.loc[1, "least_mpjpe"])

    script = runpy.run_path(str(SCRIPTS / "motion_vae.py"))
    learnt = table[:-2]
    assert list(learnt.index) == list(script["VARIANTS"])
    assert np.isfinite(learnt).all(axis=None)
    # Each is another network.
    assert learnt["velocity_error"].is_unique

    few, more, smooth = data.index
    measures = table.columns.drop("seconds")
    # These are of the same networks.
    for row, variant in ((more, "no smoothness"), (smooth, "final")):
        np.testing.assert_allclose(data.loc[row, measures], table.loc[variant, measures])
    poses = table.loc["no motion VAE", ["pck", "pck_0.05", "velocity_error"]]
    np.testing.assert_allclose(data.loc[smooth, [f"poses_{name}" for name in poses.index]], poses)
    assert (data.loc[few, measures] != data.loc[more, measures]).all()


@pytest.mark.slow
def test_the_motion_vae_generates_beside_other_ways(tmp_path, monkeypatch):
    (generation,) = of_motion_vae(tmp_path, "generation", monkeypatch=monkeypatch)
    real = "real motion that was learnt from"
    assert list(generation.index) == ["motion VAE", "MAS", "SDS", real]
    assert (generation["sequences"] == 20).all()
    # Fifty iterations leave distillation far away.
    for name in ("mcd_test", "to_test_mm"):
        assert generation.loc[real, name] < generation.loc["SDS", name] / 2
        assert generation.loc["motion VAE", name] < generation.loc["SDS", name] / 2
