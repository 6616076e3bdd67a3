"""Ablation studies run and write their tables and reports."""

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


def run(script: str, *arguments: str, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    monkeypatch.syspath_prepend(SCRIPTS)
    runpy.run_path(str(SCRIPTS / script), run_name="__main__")


@pytest.mark.slow
def test_settings_are_compared_as_samplers(tmp_path, monkeypatch, capsys):
    arguments = ["--studies", "correctors", "--draws", "12", "--seeds", "2", "--workers", "1"]
    run("settings.py", "--out", str(tmp_path), *arguments, monkeypatch=monkeypatch)
    printed = capsys.readouterr().out
    comparison = Comparison.load(tmp_path / "correctors")
    assert list(comparison.plan.problems) == ["gait", "gait-monocular"]
    assert str(comparison.table()) in printed
    assert not comparison.failures
    assert (tmp_path / "correctors" / "report.html").stat().st_size > 1e5
    # Every corrector step evaluates the denoiser once more.
    table = comparison.table()
    calls = table[table["metric"] == "denoiser_evaluations"].groupby("sampler")["value"].mean()
    assert calls["mvpc, no corrector"] < calls["mvpc"] < calls["mvpc, 3 correctors"]


def run_motion_vae(folder: Path, *parts: str, monkeypatch) -> list[pd.DataFrame]:
    """Run parts of the motion VAE study with minimal settings; return the tables."""
    arguments = ["--quick", "--draws", "12", "--out", str(folder), "--parts", *parts]
    run("motion_vae.py", *arguments, monkeypatch=monkeypatch)
    return [pd.read_csv(folder / f"{part}.csv", index_col=0) for part in parts]


@pytest.mark.slow
def test_motion_vae_ablations_write_their_tables(tmp_path, monkeypatch):
    training = [
        replace(phase, steps=2) for phase in motion_vae_training.usual_motion_vae_training("tiny")
    ]
    monkeypatch.setattr(motion_vae_training, "usual_motion_vae_training", lambda size: training)
    views, table, data = run_motion_vae(tmp_path, "views", "table", "data", monkeypatch=monkeypatch)
    assert list(views.index) == [1, 1, 2, 2, 4, 4]
    # A single hypothesis is also the closest to the truth.
    assert (views.loc[1, "right"] == 1).all()
    np.testing.assert_allclose(views.loc[1, "mpjpe"], views.loc[1, "least_mpjpe"])

    script = runpy.run_path(str(SCRIPTS / "motion_vae.py"))
    learnt = table[:-2]
    assert list(learnt.index) == list(script["VARIANTS"])
    assert np.isfinite(learnt).all(axis=None)
    # Each variant is a different network.
    assert learnt["velocity_error"].is_unique

    less_data, full_data, smoothed = data.index
    measures = table.columns.drop("seconds")
    # These rows belong to the same networks.
    for row, variant in ((full_data, "no smoothness"), (smoothed, "final")):
        np.testing.assert_allclose(data.loc[row, measures], table.loc[variant, measures])
    poses = table.loc["no motion VAE", ["pck", "pck_0.05", "velocity_error"]]
    np.testing.assert_allclose(data.loc[smoothed, [f"poses_{name}" for name in poses.index]], poses)
    assert (data.loc[less_data, measures] != data.loc[full_data, measures]).all()


@pytest.mark.slow
def test_motion_vae_generation_is_compared_with_mas_and_sds(tmp_path, monkeypatch):
    (generation,) = run_motion_vae(tmp_path, "generation", monkeypatch=monkeypatch)
    real = "real motion that was learnt from"
    assert list(generation.index) == ["motion VAE", "MAS", "SDS", real]
    assert (generation["sequences"] == 20).all()
    # After 50 iterations, SDS is still far from real motion.
    for name in ("mcd_test", "to_test_mm"):
        assert generation.loc[real, name] < generation.loc["SDS", name] / 2
        assert generation.loc["motion VAE", name] < generation.loc["SDS", name] / 2
