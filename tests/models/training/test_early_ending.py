"""A run that ends where the validation loss falls no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch import nn

from probmotion.cli.training_options import run_training
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train


class Overfits:
    """One weight that is pulled to 1; its validation loss is least on the way, at ``best``."""

    kind = "line"
    best = 0.4

    def __init__(self):
        self.network = nn.Linear(1, 1, bias=False)
        nn.init.zeros_(self.network.weight)
        self.settings = {}

    def training_loss(self, network, rng, batch, device):
        return ((network.weight - 1) ** 2).sum()

    def validation_loss(self, network, device):
        return abs(float(network.weight) - self.best)


def test_a_run_that_no_longer_improves_ends_with_its_best_model(tmp_path):
    settings = TrainingSettings(
        steps=100, learning_rate=0.1, warmup=0, ema=0.0, checkpoint_every=1, patience=3
    )
    whole = train(Overfits(), settings, tmp_path / "run", progress=False)
    losses = [row["validation_loss"] for row in whole.history]
    assert len(losses) == np.argmin(losses) + 1 + 3 < 100
    kept = load_checkpoint(whole.model, "line")
    assert whole.kept == whole.history[int(np.argmin(losses))]
    assert whole.steps == len(losses)
    assert kept.settings["step"] == np.argmin(losses) + 1
    assert abs(float(kept.tensors["weight"]) - Overfits.best) == pytest.approx(min(losses))
    # Asked again, it has ended; stopped on the way and gone on, it ends the same.
    asked_again = train(Overfits(), settings, tmp_path / "run", progress=False)
    assert (asked_again.history, asked_again.kept) == (whole.history, whole.kept)
    assert asked_again.steps == 0
    train(Overfits(), replace(settings, steps=3), tmp_path / "parts", progress=False)
    again = train(Overfits(), settings, tmp_path / "parts", progress=False)
    assert [row["validation_loss"] for row in again.history] == losses
    assert load_checkpoint(again.model, "line").tensors["weight"] == kept.tensors["weight"]


def test_the_command_says_which_checkpoint_is_kept_and_that_the_run_has_ended(tmp_path, capsys):
    settings = TrainingSettings(
        steps=100, learning_rate=0.1, warmup=0, ema=0.0, checkpoint_every=1, patience=3
    )
    run_training(Overfits(), settings, tmp_path, "cpu")
    best = load_checkpoint(tmp_path / "model.safetensors", "line").settings["step"]
    said = capsys.readouterr().out
    assert f": step {best}, loss" in said
    ended = f"it ended at step {best + 3}, as the validation loss fell no more\n"
    assert said.endswith(ended)
    run_training(Overfits(), settings, tmp_path, "cpu")
    finished = f"is finished: it has taken {best + 3} steps of 100; {ended}"
    assert capsys.readouterr().out.endswith(finished)
