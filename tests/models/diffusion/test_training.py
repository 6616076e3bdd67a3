"""What the diffusion model learns from: the loss by hand, and what must have no part in it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
CPU = torch.device("cpu")
SIZE = DiffusionSettings.tiny(frames=10)
NONE = Augmentation.none()


def track(frames=10, seed=0, name="clip/0", skeleton=BODY):
    rng = np.random.default_rng(seed)
    keypoints = 0.2 + 0.3 * rng.normal(size=(frames, skeleton.n_joints, 2))
    keypoints[:, 0] = 0
    sure = np.ones((frames, skeleton.n_joints))
    return KeypointTrack(keypoints, sure, skeleton, 20.0, name)


def made(tracks, size=SIZE, **options):
    return DiffusionTrainee(tracks, [track(seed=99, name="held-out/0")], size, **options)


def loss_and_gradient(trainee, batch=8, seed=0):
    network = trainee.network.eval()
    network.zero_grad()
    loss = trainee.training_loss(network, np.random.default_rng(seed), batch, CPU)
    loss.backward()
    return loss.item(), {name: value.grad.clone() for name, value in network.named_parameters()}


def assert_same(ours, theirs):
    assert ours[0] == theirs[0]
    for name, gradient in ours[1].items():
        assert torch.equal(gradient, theirs[1][name]), name


class Knows(nn.Module):
    """A network that always answers the same, in standardised units."""

    def __init__(self, answer):
        super().__init__()
        self.answer = nn.Parameter(torch.tensor(answer, dtype=torch.float32))
        self.seen = []

    def forward(self, motions, levels, valid=None):
        self.seen.append((motions.detach(), levels, valid))
        return self.answer.expand(motions.shape)


def test_the_loss_is_the_mean_squared_error_of_the_clean_motion():
    trainee = made([track()], augmentation=NONE)
    standards = trainee.standards
    moving = standards.deviation > 0
    clean = (track().keypoints - standards.mean) / np.where(moving, standards.deviation, 1)
    # The mean's error is the variance, 1; that of the truth is 0; the root does not count.
    for answer, wanted in ((np.zeros((10, 8)), 1.0), (clean.reshape(10, 8), 0.0)):
        network = Knows(answer)
        loss = trainee.training_loss(network, np.random.default_rng(0), 3, CPU)
        assert loss.item() == pytest.approx(wanted, abs=1e-5)
    off = clean.reshape(10, 8).copy()
    off[2, 5] += 0.6
    off[:, :2] = 77
    network = Knows(off)
    loss = trainee.training_loss(network, np.random.default_rng(0), 3, CPU)
    assert loss.item() == pytest.approx(0.36 / 60, rel=1e-4)
    loss.backward()
    assert (network.answer.grad[:, :2] == 0).all()


def test_what_enters_has_unit_size_at_every_level():
    trainee = made([track(frames=10)], augmentation=NONE)
    network = Knows(np.zeros((10, 8)))
    trainee.training_loss(network, np.random.default_rng(0), 4000, CPU)
    motions, levels, valid = network.seen[0]
    assert valid.all()
    assert (int(levels.min()), int(levels.max())) == (1, 100)
    # t ~ U{1..100}: each some 40 times, Poisson deviation 6.3.
    counts = np.bincount(levels.numpy(), minlength=101)[1:]
    assert abs(counts - 40).max() < 6 * math.sqrt(40)
    for low in range(0, 100, 20):
        some = motions[(levels > low) & (levels <= low + 20)]
        assert float(some.square().mean()) == pytest.approx(1, abs=0.05)
        assert float(some.mean()) == pytest.approx(0, abs=0.03)


def test_the_door_is_the_one_that_sampling_uses():
    trainee = made([track()], augmentation=NONE)
    network = Knows(np.zeros((10, 8)))
    trainee.training_loss(network, seeds.generator(5), 1, CPU)
    trained, levels, _ = network.seen[0]
    # The same noisy motion, made by hand from the same random numbers.
    rng = seeds.generator(5)
    drawn = trainee.batches.draw(rng, 1)
    level = int(rng.integers(1, 101, 1)[0])
    noise = rng.standard_normal(drawn.keypoints.shape, dtype=np.float32)
    alpha_bar = SIZE.schedule.alpha_bar[level]
    clean = drawn.keypoints / trainee.standards.scale
    x_t = math.sqrt(alpha_bar) * clean + math.sqrt(1 - alpha_bar) * noise
    sampled = Knows(np.zeros((10, 8)))
    prior = MotionDiffusion(sampled, SIZE, trainee.standards, BODY, 20.0)
    prior.denoise(x_t[:, None], alpha_bar, None)
    assert int(levels[0]) == level
    assert float(sampled.seen[0][1][0]) == pytest.approx(level)
    torch.testing.assert_close(sampled.seen[0][0][:1], trained, rtol=1e-4, atol=1e-4)


def test_joints_of_low_confidence_have_no_influence():
    given = track()
    confidence = given.confidence.copy()
    confidence[2:6, 3] = 0.1
    confidence[:, 1] = np.where(np.arange(10) == 4, 0.29, 1.0)
    low = replace(given, confidence=confidence)
    wild = low.keypoints.copy()
    wild[confidence < 0.3] += 1e3
    trainees = [made([low]), made([replace(low, keypoints=wild)])]
    for seed in range(3):
        assert_same(*(loss_and_gradient(trainee, seed=seed) for trainee in trainees))
    # Nor does what the network says about them.
    network = Knows(np.zeros((10, 8)))
    plain = made([low], augmentation=NONE)
    plain.training_loss(network, np.random.default_rng(0), 4, CPU).backward()
    pulled = network.answer.grad.unflatten(1, (4, 2))
    assert (pulled[torch.tensor(confidence < 0.3)] == 0).all()
    assert (pulled[torch.tensor(confidence >= 0.3)][:, 0] != 0).sum() > 20
    # Above the threshold they do.
    others = [made([one], threshold=0.05) for one in (low, replace(low, keypoints=wild))]
    assert loss_and_gradient(others[0])[0] != loss_and_gradient(others[1])[0]


def test_padding_has_no_influence():
    # A network for longer motions sees the same short ones, with more padding.
    class Pads(nn.Module):
        def __init__(self, network):
            super().__init__()
            self.network = network

        def forward(self, motions, levels, valid):
            motions = torch.where(valid[..., None], motions, 1e4)
            found = self.network(motions, levels, valid)
            return torch.where(valid[..., None], found, 1e4)

    trainee = made([track(frames=6), track(frames=4, seed=1)])
    network = trainee.network.eval()
    wanted, _ = loss_and_gradient(trainee)
    loss = trainee.training_loss(Pads(network), np.random.default_rng(0), 8, CPU)
    assert loss.item() == pytest.approx(wanted, rel=1e-5)


def test_the_threshold_is_of_the_training_alone_and_said_in_the_card():
    trainee = made([track()], threshold=0.5, augmentation=Augmentation(shift=0.25))
    kept = json.loads(json.dumps(trainee.settings))
    assert kept["threshold"] == 0.5
    assert kept["augmentation"] == {"shortest": 0.5, "scale": 0.05, "shift": 0.25, "mirror": True}
    assert kept["data"]["clips"] == ["clip"]
    assert kept["validation_data"]["clips"] == ["held-out"]
    assert DiffusionSettings(**kept["size"]) == SIZE
    np.testing.assert_array_equal(kept["mean"], trainee.standards.mean)


def test_the_validation_loss_is_one_number():
    trainee = made([track()])
    network = trainee.network.eval()
    with torch.no_grad():
        first, second = (trainee.validation_loss(network, CPU) for _ in range(2))
    assert first == second
    # Of held-out tracks alone, unvaried.
    other = made([track(), track(seed=4, name="clip/1")], augmentation=NONE)
    other.standards, other.network = trainee.standards, trainee.network
    with torch.no_grad():
        assert other.validation_loss(network, CPU) == first


def test_a_run_with_dropout_goes_on_bit_for_bit(tmp_path):
    size = replace(SIZE, dropout=0.2)
    settings = TrainingSettings(steps=12, batch=4, warmup=2, checkpoint_every=6)

    def run(folder, steps):
        trainee = made([track(frames=14), track(seed=1)], size)
        return train(trainee, replace(settings, steps=steps), folder, progress=False)

    whole = run(tmp_path / "whole", 12)
    run(tmp_path / "parts", 6)
    parts = run(tmp_path / "parts", 12)
    assert whole.model.read_bytes()[-20_000:] == parts.model.read_bytes()[-20_000:]
    assert [row["loss"] for row in whole.history] == [row["loss"] for row in parts.history]
    other = made([track(frames=14), track(seed=2)], size)
    with pytest.raises(ValueError, match=r"holds a run with .*; give it a folder of its own"):
        train(other, settings, tmp_path / "parts", progress=False)


def test_a_constant_is_learnt_exactly(tmp_path):
    # One picture that never moves but for one joint's jump: the best estimate is the data.
    keypoints = np.tile(track(frames=1).keypoints, (10, 1, 1))
    keypoints[5:, 3] += 0.5
    still = replace(track(), keypoints=keypoints)
    trainee = DiffusionTrainee([still], [still], SIZE, augmentation=NONE)
    settings = TrainingSettings(
        steps=300, batch=8, learning_rate=5e-3, warmup=10, ema=0.9, checkpoint_every=150
    )
    result = train(trainee, settings, tmp_path, progress=False)
    prior = MotionDiffusion.load(result.model)
    # Of what is not a noisy picture of the data no one has told it anything.
    noise = np.random.default_rng(0).standard_normal((2, 1, 10, 4, 2))
    for level in (60, 100):
        kept = SIZE.schedule.alpha_bar[level]
        x_t = np.sqrt(kept) * keypoints / prior.scale + np.sqrt(1 - kept) * noise
        clean = prior.denoise(x_t, kept, None)[:, 0] * prior.scale
        assert np.sqrt(((clean - keypoints) ** 2).mean()) < 0.005


def test_people_who_stay_put_have_a_loss_of_unit_size_when_they_are_shifted():
    # Metres: the path is in the data, and leads nowhere. Without the shift's part, it is 800.
    keypoints = 0.3 * np.arange(8.0).reshape(4, 2)
    keypoints = keypoints + 0.002 * np.random.default_rng(0).normal(size=(10, 4, 2))
    keypoints -= keypoints[:, :1].mean(axis=0)
    still = replace(track(), keypoints=keypoints)
    trainee = made([still], augmentation=replace(NONE, shift=0.1))
    loss = trainee.training_loss(Knows(np.zeros((10, 8))), np.random.default_rng(0), 2000, CPU)
    assert loss.item() == pytest.approx(1, abs=0.1)
    # A root that is at the origin is somewhere else in each window, and is learnt.
    centred = made([track()], augmentation=replace(NONE, shift=0.1))
    assert (centred.standards.deviation[0] > 0).all()


def test_joints_that_no_track_shows_are_refused_and_held_out_ones_are_not():
    confidence = np.ones((10, 4))
    confidence[:, [1, 3]] = 0.1
    blind = replace(track(), confidence=confidence)
    with pytest.raises(
        ValueError,
        match=r"^tracks never shows left_hand, head with a confidence of 0\.3 or more, expected "
        r"every joint to be seen somewhere; choose a skeleton without them$",
    ):
        made([blind], augmentation=NONE)
    with pytest.raises(ValueError, match=r"^tracks never shows head with"):
        made([blind])  # mirrored, the right hand is a left one
    assert made([blind], threshold=0.1).batches.never_seen == ()
    trainee = DiffusionTrainee([track()], [blind], SIZE)
    with torch.no_grad():
        assert math.isfinite(trainee.validation_loss(trainee.network.eval(), CPU))


def test_bad_input_is_refused_in_a_sentence():
    point = Skeleton(["point", "other"], [-1, 0])
    with pytest.raises(ValueError, match="validation has another skeleton than tracks"):
        DiffusionTrainee([track()], [track(skeleton=point)], SIZE)
    with pytest.raises(ValueError, match="tracks must contain at least one track, got none"):
        made([])
    faster = replace(track(seed=3), fps=25.0)
    with pytest.raises(ValueError, match="validation is at 25 frames per second, expected tracks'"):
        DiffusionTrainee([track()], [faster], SIZE)
