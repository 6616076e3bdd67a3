"""The trainer: exact solutions, exact resumption, and what it says when it cannot go on."""

from __future__ import annotations

import csv
import math
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from probmotion.models.training.checkpoints import CheckpointError, load_checkpoint
from probmotion.models.training.runs import steps_taken
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import Diverged, check_device, train

CPU = torch.device("cpu")


class Line:
    """Linear regression on all data at once: its least-squares solution is known."""

    kind = "line"

    def __init__(self):
        rng = np.random.default_rng(0)
        self.x = torch.tensor(rng.normal(size=(50, 3)), dtype=torch.float32)
        true = torch.tensor([[1.0, -2.0, 0.5]])
        noise = torch.tensor(rng.normal(size=(50, 1)), dtype=torch.float32)
        self.y = self.x @ true.T + 0.3 + noise
        torch_state = torch.random.get_rng_state()
        self.network = nn.Linear(3, 1)
        torch.random.set_rng_state(torch_state)
        with torch.no_grad():
            self.network.weight.zero_()
            self.network.bias.zero_()
        self.settings = {"data": "line", "rates": [0.5, 1 / 3]}

    def training_loss(self, network, rng, batch, device):
        return ((network(self.x) - self.y) ** 2).mean()

    def validation_loss(self, network, device):
        return float(((network(self.x) - self.y) ** 2).mean())

    @property
    def solution(self):
        design = np.column_stack([self.x.numpy(), np.ones(50)]).astype(float)
        return np.linalg.lstsq(design, self.y.numpy().astype(float), rcond=None)[0].ravel()


class Curve(Line):
    """A network with dropout and a running mean, on random batches."""

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


def tensors(folder, name="state", kind="curve"):
    known = kind if name == "model" else f"{kind} in training"
    return load_checkpoint(folder / f"{name}.safetensors", known).tensors


def assert_same(folder, other):
    """Two runs left the same network, moving average, optimiser and losses, bit for bit."""
    for name in ("model", "state"):
        ours, theirs = tensors(folder, name), tensors(other, name)
        assert ours.keys() == theirs.keys()
        for key, tensor in ours.items():
            assert torch.equal(tensor, theirs[key]), key


def numbers(result):
    return [(row["step"], row["loss"], row["validation_loss"]) for row in result.history]


SETTINGS = TrainingSettings(steps=30, batch=8, learning_rate=3e-3, warmup=5, checkpoint_every=10)


def test_regression_reaches_the_least_squares_solution(tmp_path):
    line = Line()
    settings = TrainingSettings(
        steps=1500, learning_rate=0.01, weight_decay=0.0, ema=0.99, checkpoint_every=500
    )
    result = train(line, settings, tmp_path, progress=False)
    got = tensors(tmp_path, "model", "line")
    found = np.append(got["weight"].numpy().ravel(), got["bias"].numpy())
    np.testing.assert_allclose(found, line.solution, atol=1e-4)
    losses = [row["loss"] for row in result.history]
    assert losses[0] > losses[1]
    design = np.column_stack([line.x.numpy(), np.ones(50)])
    residual = line.y.numpy().ravel() - design @ line.solution
    assert result.history[-1]["validation_loss"] == pytest.approx((residual**2).mean(), rel=1e-5)


def test_weight_decay_shrinks_and_clipping_and_warm_up_are_as_said(tmp_path):
    # AdamW's first step moves every weight by the rate of that step, whatever the gradient's size.
    line = Line()
    settings = TrainingSettings(steps=1, learning_rate=0.1, warmup=10, weight_decay=0.0, ema=0.0)
    train(line, settings, tmp_path / "a", progress=False)
    moved = tensors(tmp_path / "a", "model", "line")["weight"]
    np.testing.assert_allclose(abs(moved.numpy()), 0.01, rtol=1e-4)
    assert [settings.rate(step) for step in (1, 5, 10, 11)] == pytest.approx([0.01, 0.05, 0.1, 0.1])
    assert replace(settings, warmup=0).rate(1) == 0.1
    # The second moment that the optimiser keeps is that of the clipped gradient.
    line = Line()
    train(line, replace(settings, clip=1e-3), tmp_path / "b", progress=False)
    state = tensors(tmp_path / "b", "state", "line")
    gradient = [state[f"optimiser.{n}.exp_avg"].ravel() / 0.1 for n in (0, 1)]
    assert float(torch.cat(gradient).norm()) == pytest.approx(1e-3, rel=1e-3)
    # Decay alone: the gradient is 0 at the solution, and AdamW multiplies by 1 − rate · decay.
    line = Line()
    with torch.no_grad():
        line.network.weight.copy_(torch.ones(1, 3))
    line.training_loss = lambda network, rng, batch, device: 0 * network(line.x).sum()
    train(line, replace(settings, weight_decay=0.5, warmup=0), tmp_path / "c", progress=False)
    np.testing.assert_allclose(tensors(tmp_path / "c", "model", "line")["weight"], 0.95, rtol=1e-6)


def test_the_rate_is_halved_where_asked(tmp_path):
    settings = TrainingSettings(learning_rate=0.8, warmup=4, halve_at=(6, 10))
    found = [settings.rate(step) for step in (1, 4, 6, 7, 10, 11, 1000)]
    assert found == pytest.approx([0.2, 0.8, 0.8, 0.4, 0.4, 0.2, 0.2])
    # Under warm-up too, and marks in any order.
    assert replace(settings, halve_at=(10, 2)).rate(3) == pytest.approx(0.3)
    # A constant slope: Adam's steps are as long as the rate of each.
    line = Line()
    line.training_loss = lambda network, rng, batch, device: network.weight.sum()
    plain = TrainingSettings(
        steps=6, learning_rate=0.1, warmup=0, weight_decay=0.0, ema=0.0, halve_at=(2, 4)
    )
    train(line, plain, tmp_path / "run", progress=False)
    moved = tensors(tmp_path / "run", "model", "line")["weight"]
    np.testing.assert_allclose(moved, -2 * (0.1 + 0.05 + 0.025), rtol=1e-4)
    # It is of the run: another is refused, the same goes on.
    with pytest.raises(ValueError, match=r"holds a run with halve_at \[2, 4\], expected \[2\]"):
        train(Line(), replace(plain, halve_at=(2,)), tmp_path / "run", progress=False)
    train(Line(), replace(plain, steps=7), tmp_path / "run", progress=False)


def test_adamax_divides_by_the_largest_gradient_and_resumes(tmp_path):
    """u ← max(0.999 u, |g|), m ← 0.9 m + 0.1 g, θ ← θ − rate/(1 − 0.9ᵏ) m/u (Kingma and Ba)."""
    slopes = [1.0, -4.0, 0.5]
    line = Line()

    def loss(network, rng, batch, device):
        return slopes[loss.calls] * network.weight.sum()

    def counted(*arguments):
        found = loss(*arguments)
        loss.calls += 1
        return found

    loss.calls = 0
    line.training_loss = counted
    settings = TrainingSettings(
        steps=3, learning_rate=0.1, warmup=0, weight_decay=0.0, ema=0.0, clip=np.inf
    )
    train(line, replace(settings, optimiser="adamax"), tmp_path / "a", progress=False)
    weight = largest = mean = 0.0
    for step, slope in enumerate(slopes, start=1):
        largest, mean = max(0.999 * largest, abs(slope)), 0.9 * mean + 0.1 * slope
        weight -= 0.1 / (1 - 0.9**step) * mean / largest
    moved = tensors(tmp_path / "a", "model", "line")["weight"]
    np.testing.assert_allclose(moved, weight, rtol=1e-5)
    asked = replace(SETTINGS, optimiser="adamax")
    train(Curve(), asked, tmp_path / "whole", progress=False)
    train(Curve(), replace(asked, steps=10), tmp_path / "parts", progress=False)
    train(Curve(), asked, tmp_path / "parts", progress=False)
    assert_same(tmp_path / "whole", tmp_path / "parts")
    with pytest.raises(ValueError, match="holds a run with optimiser adamax, expected adamw"):
        train(Curve(), SETTINGS, tmp_path / "whole", progress=False)


def test_weights_that_are_frozen_stay_and_a_trainee_knows_the_step(tmp_path):
    class Steps(Curve):
        def __init__(self):
            super().__init__()
            self.network[0].requires_grad_(False)
            self.asked = []

        def anneal(self, step):
            self.asked.append((step, self.calls))

    made = Steps()
    before = made.network[0].weight.clone()
    train(made, SETTINGS, tmp_path, progress=False)
    assert made.asked == [(step, step - 1) for step in range(1, 31)]
    assert torch.equal(made.network[0].weight, before)
    assert not torch.equal(made.network[4].weight, Curve().network[4].weight)


def test_the_moving_average_is_the_one_made_by_hand(tmp_path):
    path, weights = tmp_path / "run", []

    def note(curve):
        weights.append([value.detach().clone() for value in curve.network.parameters()])

    curve = Curve(note)
    first = [value.detach().clone() for value in curve.network.parameters()]
    train(curve, replace(SETTINGS, ema=0.5), path, progress=False)
    weights = [*weights[1:], [value.detach() for value in curve.network.parameters()]]
    average = first
    for step, now in enumerate(weights, start=1):
        decay = min(0.5, (1 + step) / (10 + step))
        average = [decay * a + (1 - decay) * b for a, b in zip(average, now, strict=True)]
    kept = tensors(path, "model")
    for (name, _), wanted in zip(curve.network.named_parameters(), average, strict=True):
        torch.testing.assert_close(kept[name], wanted, rtol=1e-5, atol=1e-6)
    # Running means are the network's own.
    running = curve.network.state_dict()["1.running_mean"]
    assert torch.equal(kept["1.running_mean"], running)


def test_without_an_average_the_weights_themselves_are_kept(tmp_path):
    curve = Curve()
    train(curve, replace(SETTINGS, ema=0.0), tmp_path, progress=False)
    for name, value in tensors(tmp_path, "model").items():
        assert torch.equal(value, curve.network.state_dict()[name])


def test_fewer_steps_and_then_more_are_the_same_run(tmp_path):
    whole = train(Curve(), SETTINGS, tmp_path / "whole", progress=False)
    train(Curve(), replace(SETTINGS, steps=10), tmp_path / "parts", progress=False)
    later = Curve()
    parts = train(later, SETTINGS, tmp_path / "parts", progress=False)
    assert later.calls == 20
    assert_same(tmp_path / "whole", tmp_path / "parts")
    assert numbers(whole) == numbers(parts)
    # Dropout does something: without it the run is another.
    other = Curve()
    other.network[3].p = 0.0
    train(other, SETTINGS, tmp_path / "other", progress=False)
    with pytest.raises(AssertionError):
        assert_same(tmp_path / "whole", tmp_path / "other")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_goes_on_bit_for_bit(tmp_path, number):
    whole = train(Curve(), SETTINGS, tmp_path / "whole", progress=False)

    def stop(curve):
        if curve.calls == 13:
            os.kill(os.getpid(), number)

    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt, match="stopped at step 13 of 30, which is kept in"):
        train(Curve(stop), SETTINGS, tmp_path / "parts", progress=False)
    assert signal.getsignal(number) is before
    later = Curve()
    parts = train(later, SETTINGS, tmp_path / "parts", progress=False)
    assert later.calls == 17
    assert_same(tmp_path / "whole", tmp_path / "parts")
    assert numbers(whole) == numbers(parts)


def test_ctrl_c_in_a_process_of_its_own(tmp_path):
    """All runs are processes of their own: what else a process has loaded may round otherwise."""
    program = f"""
import importlib.util, sys, time
spec = importlib.util.spec_from_file_location("toys", {__file__!r})
toys = importlib.util.module_from_spec(spec)
sys.modules["toys"] = toys
spec.loader.exec_module(toys)
def wait(curve):
    print(curve.calls, flush=True)
    time.sleep(0.01)
settings = toys.replace(toys.SETTINGS, steps=int(sys.argv[2]))
toys.train(toys.Curve(wait), settings, sys.argv[1], progress=False)
"""

    def started(name, steps):
        return subprocess.Popen(
            [sys.executable, "-c", program, str(tmp_path / name), str(steps)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    process = started("parts", 100_000)
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "12":
            process.send_signal(signal.SIGINT)
            break
    _, words = process.communicate(timeout=60)
    assert process.returncode != 0
    stopped = int(words.rpartition("stopped at step ")[2].split()[0])
    assert 12 <= stopped < 1000
    later, _ = started("parts", stopped + 5).communicate(timeout=60)
    assert later.split()[-1] == "5"
    whole, _ = started("whole", stopped + 5).communicate(timeout=60)
    assert whole.split()[-1] == str(stopped + 5)
    assert_same(tmp_path / "whole", tmp_path / "parts")


def test_a_finished_run_does_nothing_more(tmp_path):
    first = train(Curve(), SETTINGS, tmp_path, progress=False)
    again = Curve()
    second = train(again, SETTINGS, tmp_path, progress=True)
    assert again.calls == 0
    assert second.model == first.model == tmp_path / "model.safetensors"
    assert second.history == first.history


@pytest.mark.parametrize("steps", [15, 30, 40])
@pytest.mark.parametrize("harm", ["missing", "cut", "rubbish"])
def test_a_model_that_is_missing_or_damaged_is_written_anew_from_the_state(tmp_path, harm, steps):
    train(Curve(), SETTINGS, tmp_path / "run", progress=False)
    model = tmp_path / "run" / "model.safetensors"
    before = model.read_bytes()
    if harm == "missing":
        model.unlink()
    else:
        model.write_bytes(before[:-50] if harm == "cut" else b"mine")
    asked = replace(SETTINGS, steps=steps)
    train(Curve(), asked, tmp_path / "run", progress=False)
    if steps <= 30:
        assert model.read_bytes() == before
    else:
        train(Curve(), asked, tmp_path / "whole", progress=False)
        assert_same(tmp_path / "whole", tmp_path / "run")


def test_a_run_that_is_refused_writes_no_model(tmp_path):
    train(Curve(), SETTINGS, tmp_path, progress=False)
    (tmp_path / "model.safetensors").unlink()
    with pytest.raises(ValueError, match="holds a run with batch "):
        train(Curve(), replace(SETTINGS, batch=9), tmp_path, progress=False)
    assert not (tmp_path / "model.safetensors").exists()


def test_steps_taken_are_those_of_the_state(tmp_path):
    assert steps_taken(tmp_path, "curve") == 0
    train(Curve(), SETTINGS, tmp_path, progress=False)
    (tmp_path / "model.safetensors").unlink()
    assert steps_taken(tmp_path, "curve") == 30
    with pytest.raises(CheckpointError, match="holds a curve in training, expected a line in"):
        steps_taken(tmp_path, "line")


def test_other_settings_or_data_are_refused(tmp_path):
    train(Curve(), SETTINGS, tmp_path, progress=False)
    for changed in ({"batch": 9}, {"seed": 1}, {"learning_rate": 0.1}, {"clip": np.inf}):
        with pytest.raises(ValueError, match=f"holds a run with {next(iter(changed))} "):
            train(Curve(), replace(SETTINGS, **changed), tmp_path, progress=False)
    other = Curve()
    other.settings = other.settings | {"data": "other"}
    with pytest.raises(ValueError, match="holds a run with data line, expected other; give it"):
        train(other, SETTINGS, tmp_path, progress=False)
    with pytest.raises(CheckpointError, match="holds a curve in training, expected a line in"):
        train(Line(), SETTINGS, tmp_path, progress=False)
    train(Curve(), replace(SETTINGS, checkpoint_every=7, steps=31), tmp_path, progress=False)


def test_checkpoints_that_come_more_often_change_no_step(tmp_path):
    train(Curve(), SETTINGS, tmp_path / "a", progress=False)
    train(Curve(), replace(SETTINGS, checkpoint_every=3), tmp_path / "b", progress=False)
    ours, theirs = tensors(tmp_path / "a", "model"), tensors(tmp_path / "b", "model")
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


@pytest.mark.parametrize("what", ["loss", "gradient"])
def test_divergence_is_said_and_the_last_good_checkpoint_stays(tmp_path, what):
    class Explodes(Curve):
        def training_loss(self, network, rng, batch, device):
            loss = super().training_loss(network, rng, batch, device)
            if self.calls != 15:
                return loss
            if what == "loss":
                return loss * float("nan")
            # √ has an infinite slope at 0.
            return loss + torch.sqrt(0 * network[0].weight.sum())

    said = "the loss is nan" if what == "loss" else "the gradient is not finite"
    with pytest.raises(
        Diverged, match=f"training diverged at step 15: {said}; the last good"
    ) as stopped:
        train(Explodes(), SETTINGS, tmp_path, progress=False)
    # This folder would refuse another rate; one without a checkpoint would not.
    assert str(stopped.value).endswith("; try a smaller learning_rate in another folder")
    with pytest.raises(ValueError, match="holds a run with learning_rate "):
        train(Curve(), replace(SETTINGS, learning_rate=1e-4), tmp_path, progress=False)
    train(Curve(), replace(SETTINGS, steps=10), tmp_path / "good", progress=False)
    assert_same(tmp_path / "good", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_file()) == [
        "losses.csv",
        "model.safetensors",
        "state.safetensors",
    ]
    early = replace(SETTINGS, checkpoint_every=100)
    with pytest.raises(Diverged, match=r"no checkpoint yet; try a smaller learning_rate$"):
        train(Explodes(), early, tmp_path / "early", progress=False)


def test_losses_are_in_a_table(tmp_path):
    result = train(Curve(), SETTINGS, tmp_path, progress=False)
    with open(tmp_path / "losses.csv", encoding="utf-8") as file:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    assert rows == result.history
    assert [row["step"] for row in rows] == [10, 20, 30]


def test_global_random_numbers_are_left_alone(tmp_path):
    torch.manual_seed(11)
    wanted = torch.rand(3)
    torch.manual_seed(11)
    curve = Curve()
    train(curve, SETTINGS, tmp_path / "a", progress=False)
    assert torch.equal(torch.rand(3), wanted)
    # And they do not matter.
    torch.manual_seed(12)
    train(Curve(), SETTINGS, tmp_path / "b", progress=False)
    assert_same(tmp_path / "a", tmp_path / "b")


def test_a_run_in_another_thread_is_the_same(tmp_path):
    train(Curve(), SETTINGS, tmp_path / "here", progress=False)
    failed = []

    def work():
        try:
            train(Curve(), SETTINGS, tmp_path / "there", progress=False)
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert failed == []
    assert_same(tmp_path / "here", tmp_path / "there")


def test_bad_input_is_refused_in_a_sentence(tmp_path):
    for name, value in [
        ("steps", 0),
        ("batch", 1.5),
        ("warmup", -1),
        ("learning_rate", 0.0),
        ("learning_rate", float("nan")),
        ("ema", 1.0),
        ("clip", 0.0),
        ("clip", float("nan")),
        ("weight_decay", -0.1),
        ("weight_decay", float("inf")),
        ("seed", True),
        ("optimiser", "sgd"),
        ("halve_at", (10, 0)),
    ]:
        with pytest.raises(ValueError, match=f"^{name} is .*expected"):
            TrainingSettings(**{name: value})
    with pytest.raises(ValueError, match="device must be cpu or cuda, got 'tpu'"):
        check_device("tpu")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="this machine has no CUDA; expected 'cpu'"):
            train(Curve(), SETTINGS, tmp_path / "new", device="cuda")
        assert not (tmp_path / "new").exists()
    assert check_device("cpu") == CPU


def test_a_validation_loss_that_is_not_finite_stops_with_the_last_good_checkpoint(tmp_path):
    class Blind(Curve):
        def validation_loss(self, network, device):
            self.asked = getattr(self, "asked", 0) + 1
            return math.nan if self.asked > 1 else super().validation_loss(network, device)

    with pytest.raises(Diverged, match="diverged at step 20: the validation loss is nan; the last"):
        train(Blind(), SETTINGS, tmp_path, progress=False)
    train(Curve(), replace(SETTINGS, steps=10), tmp_path / "good", progress=False)
    assert_same(tmp_path / "good", tmp_path)
