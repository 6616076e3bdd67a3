"""Training of the diffusion model: values of the loss, masked inputs and resumption."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee, usual_training
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
CPU = torch.device("cpu")
SIZE = DiffusionSettings.tiny(frames=10)
NONE = Augmentation.none()


def track(frames=10, seed=0, name="clip/0"):
    rng = np.random.default_rng(seed)
    keypoints = 0.2 + 0.3 * rng.normal(size=(frames, 4, 2))
    keypoints[:, 0] = 0
    return KeypointTrack(keypoints, np.ones((frames, 4)), BODY, 20.0, name)


def trainee_of(*tracks, size=SIZE, **options):
    return DiffusionTrainee(tracks, [track(seed=99, name="held-out/0")], size, **options)


def loss_and_gradient(trainee, seed=0):
    network = trainee.network.eval()
    network.zero_grad()
    loss = trainee.training_loss(network, np.random.default_rng(seed), 8, CPU)
    loss.backward()
    return [loss.detach(), *(value.grad.clone() for value in network.parameters())]


class Constant(nn.Module):
    """Network with constant output in standardised units that records its inputs."""

    def __init__(self, output=0.0):
        super().__init__()
        output = np.broadcast_to(output, (10, 8)).copy()
        self.output = nn.Parameter(torch.tensor(output, dtype=torch.float32))
        self.inputs = []

    def forward(self, motions, levels, valid=None):
        self.inputs.append((motions.detach(), levels, valid))
        return self.output[: motions.shape[1]].expand(motions.shape)

    def loss(self, trainee, n=3):
        return trainee.training_loss(self, np.random.default_rng(0), n, CPU)


def test_loss_is_the_mean_squared_error_of_the_clean_motion():
    trainee = trainee_of(track(), augmentation=NONE)
    standards = trainee.standards
    moving = standards.deviation > 0
    clean = (track().keypoints - standards.mean) / np.where(moving, standards.deviation, 1)
    clean = clean.reshape(10, 8)
    # A network that returns the mean has loss 1, the variance; the root is excluded.
    assert Constant().loss(trainee).item() == pytest.approx(1.0, abs=1e-5)
    assert Constant(clean).loss(trainee).item() == pytest.approx(0.0, abs=1e-5)
    clean[2, 5] += 0.6
    clean[:, :2] = 77
    network = Constant(clean)
    loss = network.loss(trainee)
    assert loss.item() == pytest.approx(0.36 / 60, rel=1e-4)
    loss.backward()
    assert (network.output.grad[:, :2] == 0).all()


def test_inputs_have_unit_variance_at_every_level():
    network = Constant()
    network.loss(trainee_of(track(), augmentation=NONE), 4000)
    motions, levels, valid = network.inputs[0]
    assert valid.all()
    # For t ~ U{1..100}, each level occurs about 40 times, with Poisson deviation 6.3.
    counts = np.bincount(levels.numpy(), minlength=101)
    assert counts[0] == 0
    assert len(counts) == 101
    assert abs(counts[1:] - 40).max() < 6 * math.sqrt(40)
    for low in range(0, 100, 20):
        selected = motions[(levels > low) & (levels <= low + 20)]
        assert float(selected.square().mean()) == pytest.approx(1, abs=0.05)
        assert float(selected.mean()) == pytest.approx(0, abs=0.03)


def test_training_and_sampling_standardise_equally():
    trainee = trainee_of(track(), augmentation=NONE)
    network = Constant()
    trainee.training_loss(network, seeds.generator(5), 1, CPU)
    trained, levels, _ = network.inputs[0]
    # Compute the same noisy motion from the same random numbers.
    rng = seeds.generator(5)
    drawn = trainee.batches.draw(rng, 1)
    level = int(rng.integers(1, 101, 1)[0])
    noise = rng.standard_normal(drawn.keypoints.shape, dtype=np.float32)
    alpha_bar = SIZE.schedule.alpha_bar[level]
    clean = drawn.keypoints / trainee.standards.scale
    x_t = math.sqrt(alpha_bar) * clean + math.sqrt(1 - alpha_bar) * noise
    sampled = Constant()
    prior = MotionDiffusion(sampled, SIZE, trainee.standards, BODY, 20.0)
    prior.denoise(x_t[:, None], alpha_bar, None)
    assert int(levels[0]) == level
    assert float(sampled.inputs[0][1][0]) == pytest.approx(level)
    torch.testing.assert_close(sampled.inputs[0][0][:1], trained, rtol=1e-4, atol=1e-4)


def test_joints_below_the_threshold_have_no_effect():
    given = track()
    confidence = given.confidence.copy()
    confidence[2:6, 3] = 0.1
    confidence[:, 1] = np.where(np.arange(10) == 4, 0.29, 1.0)
    low = replace(given, confidence=confidence)
    wild = low.keypoints.copy()
    wild[confidence < 0.3] += 1e3
    pair = [low, replace(low, keypoints=wild)]
    for seed in range(3):
        first, second = (loss_and_gradient(trainee_of(one), seed) for one in pair)
        assert all(map(torch.equal, first, second))
    # The network's outputs for these joints have no effect either.
    network = Constant()
    network.loss(trainee_of(low, augmentation=NONE), 4).backward()
    gradient = network.output.grad.unflatten(1, (4, 2))
    assert (gradient[torch.tensor(confidence < 0.3)] == 0).all()
    assert (gradient[torch.tensor(confidence >= 0.3)][:, 0] != 0).sum() > 20
    first, second = (loss_and_gradient(trainee_of(one, threshold=0.05)) for one in pair)
    assert first[0] != second[0]


def test_padding_has_no_effect():
    network = Constant()
    trainee = trainee_of(track(frames=6), track(frames=4, seed=1), augmentation=NONE)
    network.loss(trainee, 8).backward()
    ((_, _, valid),) = network.inputs
    assert {*valid.sum(dim=1).tolist()} == {4, 6}
    assert (network.output.grad[6:] == 0).all()


def test_validation_loss_depends_on_held_out_tracks_only():
    trainee = trainee_of(track())
    other = trainee_of(track(), track(seed=4, name="clip/1"), augmentation=NONE)
    other.standards = trainee.standards
    with torch.no_grad():
        losses = [one.validation_loss(trainee.network.eval(), CPU) for one in 2 * [trainee, other]]
    assert len(set(losses)) == 1


def test_run_with_dropout_resumes_bit_identically(tmp_path):
    settings = TrainingSettings(steps=12, batch=4, warmup=2, checkpoint_every=6)

    def run(folder, steps, seed=1):
        trainee = trainee_of(track(frames=14), track(seed=seed), size=replace(SIZE, dropout=0.2))
        return train(trainee, replace(settings, steps=steps), tmp_path / folder, progress=False)

    full = run("full", 12)
    run("parts", 6)
    resumed = run("parts", 12)
    assert full.model.read_bytes()[-20_000:] == resumed.model.read_bytes()[-20_000:]
    assert [row["loss"] for row in full.history] == [row["loss"] for row in resumed.history]
    with pytest.raises(ValueError, match=r"must be .* to resume .*; use another folder"):
        run("parts", 12, seed=2)


def test_network_learns_a_single_motion(tmp_path):
    keypoints = np.tile(track(frames=1).keypoints, (10, 1, 1))
    keypoints[5:, 3] += 0.5
    static = replace(track(), keypoints=keypoints)
    trainee = DiffusionTrainee([static], [static], SIZE, augmentation=NONE)
    settings = TrainingSettings(
        steps=200, batch=8, learning_rate=5e-3, warmup=10, ema=0.9, checkpoint_every=200
    )
    prior = MotionDiffusion.load(train(trainee, settings, tmp_path, progress=False).model)
    noise = np.random.default_rng(0).standard_normal((2, 1, 10, 4, 2))
    for level in (60, 100):
        alpha_bar = SIZE.schedule.alpha_bar[level]
        x_t = np.sqrt(alpha_bar) * keypoints / prior.scale + np.sqrt(1 - alpha_bar) * noise
        clean = prior.denoise(x_t, alpha_bar, None)[:, 0] * prior.scale
        assert np.sqrt(((clean - keypoints) ** 2).mean()) < 0.005


def test_loss_of_shifted_static_tracks_is_about_one():
    # The tracks are not centred on the root; without the shift in the standards the loss is 800.
    keypoints = 0.3 * np.arange(8.0).reshape(4, 2)
    keypoints = keypoints + 0.002 * np.random.default_rng(0).normal(size=(10, 4, 2))
    keypoints -= keypoints[:, :1].mean(axis=0)
    static = replace(track(), keypoints=keypoints)
    loss = Constant().loss(trainee_of(static, augmentation=replace(NONE, shift=0.1)), 2000)
    assert loss.item() == pytest.approx(1, abs=0.1)


def test_invalid_arguments_are_rejected():
    confidence = np.ones((10, 4))
    confidence[:, [1, 3]] = 0.1
    low = replace(track(), confidence=confidence)
    with pytest.raises(ValueError, match=r"got none for left_hand, head; choose"):
        trainee_of(low, augmentation=NONE)
    # Held-out tracks may lack joints.
    trainee = DiffusionTrainee([track()], [low], SIZE)
    with torch.no_grad():
        assert math.isfinite(trainee.validation_loss(trainee.network.eval(), CPU))
    assert usual_training("reference-code").clip == math.inf
    with pytest.raises(ValueError, match="size must be one of tiny, small, paper, reference-code"):
        usual_training("large")
