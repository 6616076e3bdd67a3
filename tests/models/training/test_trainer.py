"""Trainer: exact solutions, bit-identical resumption, early stopping and divergence."""

from __future__ import annotations

import csv
import math
import os
import shutil
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from probmotion.cli.training_options import run_training
from probmotion.models.training.checkpoints import CheckpointError, load_checkpoint
from probmotion.models.training.runs import steps_taken
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import Diverged, train


class Line:
    """Linear regression on all data, with a known least-squares solution."""

    kind = "line"

    def __init__(self):
        rng = np.random.default_rng(0)
        self.x = torch.tensor(rng.normal(size=(50, 3)), dtype=torch.float32)
        true = torch.tensor([[1.0, -2.0, 0.5]])
        noise = torch.tensor(rng.normal(size=(50, 1)), dtype=torch.float32)
        self.y = self.x @ true.T + 0.3 + noise
        with torch.random.fork_rng(devices=[]):
            self.network = nn.Linear(3, 1)
        nn.init.zeros_(self.network.weight)
        nn.init.zeros_(self.network.bias)
        self.settings = {"data": "line", "rates": [0.5, 1 / 3]}

    def training_loss(self, network, rng, batch, device):
        return ((network(self.x) - self.y) ** 2).mean()

    def validation_loss(self, network, device):
        return float(((network(self.x) - self.y) ** 2).mean())


class Curve(Line):
    """Network with dropout and a running mean, trained on random batches."""

    kind = "curve"

    def __init__(self, watch=None):
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            self.network = nn.Sequential(
                nn.Linear(3, 16), nn.BatchNorm1d(16), nn.GELU(), nn.Dropout(0.3), nn.Linear(16, 1)
            )
        self.watch = watch
        self.calls = 0

    def training_loss(self, network, rng, batch, device):
        self.calls += 1
        if self.watch is not None:
            self.watch(self)
        rows = torch.tensor(rng.integers(0, 50, batch))
        noisy = self.x[rows] + 0.1 * torch.tensor(rng.standard_normal((batch, 3))).float()
        return ((network(noisy) - self.y[rows]) ** 2).mean()


class Overfits(Line):
    """Model of one weight that converges to 1; the validation loss is lowest at 0.4."""

    def __init__(self):
        super().__init__()
        self.network = nn.Linear(1, 1, bias=False)
        nn.init.zeros_(self.network.weight)

    def training_loss(self, network, rng, batch, device):
        return ((network.weight - 1) ** 2).sum()

    def validation_loss(self, network, device):
        return abs(float(network.weight) - 0.4)


SETTINGS = TrainingSettings(steps=30, batch=8, learning_rate=3e-3, warmup=5, checkpoint_every=10)
BASE = TrainingSettings(steps=1, learning_rate=0.1, warmup=0, weight_decay=0.0, ema=0.0)


def run(trainee, folder, settings=SETTINGS, **changes):
    return train(trainee, replace(settings, **changes), folder, progress=False)


def tensors(folder, name="state", kind="curve"):
    stored_kind = kind if name == "model" else f"{kind} in training"
    return load_checkpoint(folder / f"{name}.safetensors", stored_kind).tensors


def assert_same(folder, other):
    """Assert that network, moving average, optimiser and losses are bit-identical."""
    for name in ("model", "state"):
        first, second = tensors(folder, name), tensors(other, name)
        assert first.keys() == second.keys()
        for key, tensor in first.items():
            assert torch.equal(tensor, second[key]), key


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """Folder and result of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(Curve(), folder)


def test_regression_reaches_the_least_squares_solution(tmp_path):
    line = Line()
    result = run(line, tmp_path, BASE, steps=300, ema=0.9, checkpoint_every=150)
    saved = tensors(tmp_path, "model", "line")
    design = np.column_stack([line.x.numpy(), np.ones(50)]).astype(float)
    y = line.y.numpy().ravel().astype(float)
    solution, (residual,) = np.linalg.lstsq(design, y, rcond=None)[:2]
    weights = np.append(saved["weight"].numpy().ravel(), saved["bias"].numpy())
    np.testing.assert_allclose(weights, solution, atol=1e-4)
    assert result.history[-1]["validation_loss"] == pytest.approx(residual / 50, rel=1e-5)


def test_warm_up_clipping_and_weight_decay(tmp_path):
    # The first step of AdamW has the length of its learning rate for every weight.
    settings = replace(BASE, warmup=10)
    run(Line(), tmp_path / "a", settings)
    weight = tensors(tmp_path / "a", "model", "line")["weight"]
    np.testing.assert_allclose(abs(weight.numpy()), 0.01, rtol=1e-4)
    # The optimiser's moments are those of the clipped gradient.
    run(Line(), tmp_path / "b", settings, clip=1e-3)
    state = tensors(tmp_path / "b", "state", "line")
    gradient = [state[f"optimiser.{n}.exp_avg"].ravel() / 0.1 for n in (0, 1)]
    assert float(torch.cat(gradient).norm()) == pytest.approx(1e-3, rel=1e-3)
    # Without a gradient, AdamW multiplies weights by 1 − rate · decay.
    line = Line()
    nn.init.ones_(line.network.weight)
    line.training_loss = lambda network, rng, batch, device: 0 * network(line.x).sum()
    run(line, tmp_path / "c", BASE, weight_decay=0.5)
    np.testing.assert_allclose(tensors(tmp_path / "c", "model", "line")["weight"], 0.95, rtol=1e-6)


def test_learning_rate_rises_and_is_halved(tmp_path):
    settings = TrainingSettings(learning_rate=0.8, warmup=4, halve_at=(6, 10))
    rates = [settings.rate(step) for step in (1, 4, 6, 7, 10, 11, 1000)]
    assert rates == pytest.approx([0.2, 0.8, 0.8, 0.4, 0.4, 0.2, 0.2])
    # Halving also applies during warm-up and for steps in any order.
    assert replace(settings, halve_at=(10, 2)).rate(3) == pytest.approx(0.3)
    # With a constant gradient the steps of Adam have the length of the learning rate.
    line = Line()
    line.training_loss = lambda network, rng, batch, device: network.weight.sum()
    run(line, tmp_path, BASE, steps=6, halve_at=(2, 4))
    weight = tensors(tmp_path, "model", "line")["weight"]
    np.testing.assert_allclose(weight, -2 * (0.1 + 0.05 + 0.025), rtol=1e-4)
    with pytest.raises(ValueError, match=r"halve_at must be \[2, 4\] to resume .*, got \[2\]"):
        run(Line(), tmp_path, BASE, steps=6, halve_at=(2,))


def test_adamax_matches_its_definition(tmp_path):
    """u ← max(0.999 u, |g|), m ← 0.9 m + 0.1 g, θ ← θ − rate/(1 − 0.9ᵏ) m/u (Kingma and Ba)."""
    slopes = [1.0, -4.0, 0.5]
    line, remaining = Line(), iter(slopes)
    line.training_loss = lambda network, *_: next(remaining) * network.weight.sum()
    for steps in (2, 3):
        # Resume before the last step.
        run(line, tmp_path, BASE, steps=steps, clip=np.inf, optimiser="adamax")
    weight = largest = mean = 0.0
    for step, slope in enumerate(slopes, start=1):
        largest, mean = max(0.999 * largest, abs(slope)), 0.9 * mean + 0.1 * slope
        weight -= 0.1 / (1 - 0.9**step) * mean / largest
    np.testing.assert_allclose(tensors(tmp_path, "model", "line")["weight"], weight, rtol=1e-5)


def test_frozen_weights_are_unchanged_and_anneal_receives_the_step(tmp_path):
    trainee, steps = Curve(), []
    trainee.network[0].requires_grad_(False)
    trainee.anneal = lambda step: steps.append((step, trainee.calls))
    run(trainee, tmp_path)
    assert steps == [(step, step - 1) for step in range(1, 31)]
    unchanged = [
        torch.equal(trainee.network[part].weight, Curve().network[part].weight) for part in (0, 4)
    ]
    assert unchanged == [True, False]


def test_moving_average_matches_its_recursion(tmp_path):
    weights = []

    def note(curve):
        weights.append([value.detach().clone() for value in curve.network.parameters()])

    curve = Curve(note)
    run(curve, tmp_path / "a", ema=0.5)
    note(curve)
    average = weights[0]
    for step, current in enumerate(weights[1:], start=1):
        decay = min(0.5, (1 + step) / (10 + step))
        average = [decay * a + (1 - decay) * b for a, b in zip(average, current, strict=True)]
    saved = tensors(tmp_path / "a", "model")
    for (name, _), expected in zip(curve.network.named_parameters(), average, strict=True):
        torch.testing.assert_close(saved[name], expected, rtol=1e-5, atol=1e-6)
    # Buffers are copied.
    assert torch.equal(saved["1.running_mean"], curve.network.state_dict()["1.running_mean"])
    run(curve := Curve(), tmp_path / "b", ema=0.0)
    for name, value in tensors(tmp_path / "b", "model").items():
        assert torch.equal(value, curve.network.state_dict()[name])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_run_resumes_bit_identically(full, tmp_path, number):
    def stop(curve):
        if curve.calls == 13:
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt, match="stopped at step 13 of 30, saved in"):
        run(Curve(stop), tmp_path)
    assert signal.getsignal(number) is before
    resumed = Curve()
    run(resumed, tmp_path)
    assert resumed.calls == 17
    assert_same(full[0], tmp_path)


def test_finished_run_takes_no_steps(full):
    again = Curve()
    second = train(again, SETTINGS, full[0], progress=True)
    assert again.calls == second.steps == 0
    assert second.history == full[1].history
    with open(full[0] / "losses.csv", encoding="utf-8") as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    assert rows == second.history
    assert [row["step"] for row in rows] == [10, 20, 30]


@pytest.mark.parametrize(("content", "steps"), [(None, 15), (slice(-50), 40), (slice(9), 15)])
def test_missing_or_damaged_model_is_restored_from_the_state(full, tmp_path, content, steps):
    shutil.copytree(full[0], tmp_path / "run")
    model = tmp_path / "run" / "model.safetensors"
    before = model.read_bytes()
    model.unlink()
    if content is not None:
        model.write_bytes(before[content])
    run(Curve(), tmp_path / "run", steps=steps)
    if steps == 15:
        assert model.read_bytes() == before
    else:
        run(Curve(), tmp_path / "whole", steps=steps)
        assert_same(tmp_path / "whole", tmp_path / "run")


def test_other_settings_or_data_are_rejected(full, tmp_path):
    shutil.copytree(full[0], tmp_path / "run")
    copied = tmp_path / "run"
    (copied / "model.safetensors").unlink()
    assert (steps_taken(copied, "curve"), steps_taken(tmp_path, "curve")) == (30, 0)
    for name, value in (("batch", 9), ("seed", 1), ("clip", np.inf), ("optimiser", "adamax")):
        with pytest.raises(ValueError, match=f"{name} must be .* to resume"):
            run(Curve(), copied, **{name: value})
    other = Curve()
    other.settings = other.settings | {"data": "other"}
    with pytest.raises(ValueError, match=r"data must be line to resume .*, got other; use ano"):
        run(other, copied)
    with pytest.raises(CheckpointError, match="must contain a line in training, got a curve in"):
        run(Line(), copied)
    assert not (copied / "model.safetensors").exists()
    run(Curve(), copied, checkpoint_every=7, steps=31)


@pytest.mark.parametrize(
    ("fault", "step", "message"),
    [
        ("loss", 15, "the loss is nan"),
        ("gradient", 15, "the gradient is not finite"),
        ("validation", 20, "the validation loss is nan"),
    ],
)
def test_divergence_leaves_the_last_good_checkpoint(tmp_path, fault, step, message):
    class Explodes(Curve):
        def training_loss(self, network, rng, batch, device):
            loss = super().training_loss(network, rng, batch, device)
            if self.calls != 15 or fault == "validation":
                return loss
            if fault == "loss":
                return loss * float("nan")
            # The square root has an infinite slope at 0.
            return loss + torch.sqrt(0 * network[0].weight.sum())

        def validation_loss(self, network, device):
            loss = super().validation_loss(network, device)
            return math.nan if fault == "validation" and self.calls == 20 else loss

    with pytest.raises(Diverged, match=f"diverged at step {step}: {message}; the last.*another fo"):
        run(Explodes(), tmp_path / "run")
    run(Curve(), tmp_path / "good", steps=10)
    assert_same(tmp_path / "good", tmp_path / "run")
    if fault != "validation":
        with pytest.raises(Diverged, match=r"no checkpoint yet; try a smaller learning_rate$"):
            run(Explodes(), tmp_path / "early", checkpoint_every=100)


def test_run_does_not_depend_on_thread_global_generator_or_checkpoints(full, tmp_path):
    torch.manual_seed(11)
    expected = torch.rand(3)
    torch.manual_seed(11)
    options = {"checkpoint_every": 3}
    thread = threading.Thread(target=run, args=(Curve(), tmp_path), kwargs=options)
    thread.start()
    thread.join()
    assert torch.equal(torch.rand(3), expected)
    assert_same(full[0], tmp_path)


EARLY = replace(BASE, steps=100, checkpoint_every=1, patience=3)


def test_early_stopping_saves_the_best_model(tmp_path):
    full = run(Overfits(), tmp_path / "run", EARLY)
    losses = [row["validation_loss"] for row in full.history]
    best = int(np.argmin(losses))
    assert full.steps == len(losses) == best + 1 + 3 < 100
    assert full.saved == full.history[best]
    saved = load_checkpoint(full.model, "line")
    assert saved.settings["step"] == best + 1
    assert abs(float(saved.tensors["weight"]) - 0.4) == pytest.approx(min(losses))
    run(Overfits(), tmp_path / "parts", EARLY, steps=3)
    for steps in (best + 1, 0):
        resumed = run(Overfits(), tmp_path / "parts", EARLY)
        assert [row["validation_loss"] for row in resumed.history] == losses
        assert (resumed.saved["step"], resumed.steps) == (best + 1, steps)
        assert load_checkpoint(resumed.model, "line").tensors == saved.tensors


def test_command_reports_early_stopping(tmp_path, capsys):
    run_training(Overfits(), EARLY, tmp_path, "cpu")
    best = load_checkpoint(tmp_path / "model.safetensors", "line").settings["step"]
    printed = capsys.readouterr().out
    assert f": step {best}, loss" in printed
    assert f"stopped early at step {best + 3}: validation loss" in printed
    run_training(Overfits(), EARLY, tmp_path, "cpu")
    assert "is finished" in capsys.readouterr().out


def test_invalid_settings_are_rejected():
    for name, value in [("ema", 1.0), ("clip", 0.0), ("clip", math.nan), ("weight_decay", -0.1),
                        ("weight_decay", math.inf), ("optimiser", "sgd"), ("halve_at", (10, 0)),
                        ("warmup", -1)]:  # fmt: skip
        with pytest.raises(ValueError, match=f"^{name} must be .*got"):
            TrainingSettings(**{name: value})


def test_an_unavailable_device_is_rejected_before_the_folder_is_created(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="device must be cpu, got cuda, which is not available"):
        train(Curve(), SETTINGS, tmp_path / "new", device="cuda")
    assert not (tmp_path / "new").exists()
