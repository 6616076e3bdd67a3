"""Learning a Motion-DVAE: the loss by hand, annealing, published units, and runs that resume."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Normal, kl_divergence

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.bodies.body_states import BodyStates, rest_pose, turned_about_vertical
from probmotion.models.dvae.layers import trust_in
from probmotion.models.dvae.motion_dvae import KIND, MotionDVAE
from probmotion.models.dvae.motion_windows import MotionWindows
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.training import DVAETrainee, usual_dvae_training
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import Anneals, train
from probmotion.motion.motion import Motion

PERSON = Skeleton.preset("person14")
TINY = replace(DVAESettings.tiny(), frames=6)
# Metres that a joint moves in a frame: the unit in which evidence and pose are compared.
STEP = 0.05
CPU = torch.device("cpu")
B = 3


@pytest.fixture(scope="module")
def clips():
    return [
        make_gait(style, number, frames=20).retarget(PERSON)
        for style in ("walk", "run")
        for number in range(4)
    ]


@pytest.fixture(scope="module")
def states(clips):
    return BodyStates(PERSON, rest_pose(PERSON, [clip.positions for clip in clips]))


def trainee(clips, states, size=TINY, **options):
    made = DVAETrainee(clips[1:], clips[:1], size, states, **options)
    with torch.no_grad():
        # Scales that differ, as after training.
        made.network.generative.log_scales.copy_(torch.log(torch.tensor([0.02, 0.1, 0.2, 0.05])))
    return made


def validated(made):
    with torch.no_grad():
        return made.validation_loss(made.network, CPU)


def parts_by_hand(made, windows, noise):
    """Errors of translation, orientation, rotations and joints, and Σ_t KL, (B, …) each."""
    network, size = made.network, made.size
    x = torch.tensor(windows.states, dtype=torch.float32)
    bodies = torch.tensor(windows.bodies, dtype=torch.float32)
    joints = made.states.positions(x, bodies)
    shown = (joints - network.joint_mean) / network.joint_deviation
    # Every joint is trusted wholly, and the noise's tails are Gaussian.
    frames = torch.cat([shown.flatten(2), torch.ones(B, 6, 14), torch.zeros(B, 6, 1)], -1)
    standard = (x - network.state_mean) / network.state_deviation
    p, q = network.generative, network.encoder

    def gaussian(numbers):
        mean, raw = numbers.chunk(2, -1)
        return Normal(mean, torch.exp(6 * torch.tanh(raw / 6)))

    def begun(starts):
        hidden, cell = starts(standard[:, 0]).chunk(2, -1)
        return torch.tanh(hidden), cell

    cumulative = size.decoder == "cumulative"
    h, motion, divergence, decoded = begun(p.starts), standard[:, 0], 0.0, []
    lat = None if cumulative else begun(q.starts)
    for t in range(1, 6):
        # h^data_t has read y_T, …, y_t.
        _, (data, _) = q.reader(frames[:, t:].flip(1))
        if cumulative:
            now = network.state_mean + network.state_deviation * motion
            apart = (joints[:, t] - made.states.positions(now[:, None], bodies)[:, 0]) / STEP
            seen = [h[0], data[0], motion, apart.flatten(1), torch.ones(B, 14)]
        else:
            seen = [lat[0], data[0]]
        posterior = gaussian(q.latents(torch.cat(seen, -1)))
        divergence = divergence + kl_divergence(posterior, gaussian(p.latent_prior(h[0]))).sum(-1)
        z = posterior.mean + posterior.stddev * noise[:, t - 1]
        h = p.recurrent(z, h)
        if cumulative:
            motion = motion + p.decoder(h[0]) + p.straight(z)
        else:
            motion, lat = p.decoder(h[0]), q.recurrent(z, lat)
        decoded.append(network.state_mean + network.state_deviation * motion)
    found = torch.stack(decoded, 1)
    error = found - x[:, 1:]
    apart = made.states.positions(found, bodies) - joints[:, 1:]
    return [error[..., :3], error[..., 3:9], error[..., 9:], apart], divergence


def loss_and_parts(made, weight=1.0):
    windows = made.windows.spread(B)
    rng = np.random.default_rng(0)
    noise = torch.tensor(rng.standard_normal((B, 5, 6), dtype=np.float32))
    loss = made._loss(made.network, windows, np.random.default_rng(0), weight, CPU)
    with torch.no_grad():
        return loss, *parts_by_hand(made, windows, noise)


@pytest.mark.parametrize("decoder", ["cumulative", "direct"])
@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_the_loss_is_the_bound_by_an_independent_calculation(clips, states, decoder, weight):
    made = trainee(clips, states, replace(TINY, decoder=decoder))
    loss, errors, divergence = loss_and_parts(made, weight)
    total = weight * divergence.sum().item()
    for error, scale in zip(errors, (0.02, 0.1, 0.2, 0.05), strict=True):
        total -= stats.norm.logpdf(error, scale=scale).sum()
    assert loss.item() == pytest.approx(total / B / 5, rel=1e-4)
    assert divergence.min() > 1e-3


def test_unit_scales_are_the_published_squared_errors(clips, states):
    made = trainee(clips, states, replace(TINY, decoder_scale="unit"))
    loss, errors, divergence = loss_and_parts(made)
    squares = sum(float((error**2).sum()) for error in errors)
    # One number learns how far joints are off, for equation 11, and nothing learns from it.
    own = -stats.norm.logpdf(errors[-1], scale=0.05).mean()
    assert loss.item() == pytest.approx(
        (squares / B + own + divergence.mean().item()) / 5, rel=1e-4
    )
    gradients = torch.autograd.grad(loss, [made.network.generative.log_scales], retain_graph=True)
    assert (gradients[0][:3] == 0).all()
    slope = (1 - (errors[-1] ** 2).mean() / 0.05**2) / 5
    assert gradients[0][3].item() == pytest.approx(slope.item(), rel=1e-3)
    weights = [made.network.generative.decoder[-1].weight]
    before = torch.autograd.grad(loss, weights)[0]
    with torch.no_grad():
        made.network.generative.log_scales[3] += 1.0
    again, *_ = loss_and_parts(made)
    torch.testing.assert_close(torch.autograd.grad(again, weights)[0], before)


def test_the_weight_of_the_divergence_rises(clips, states):
    made = trainee(clips, states, annealing=10)
    assert isinstance(made, Anneals)
    losses = []
    for step in (1, 5, 10, 40):
        made.anneal(step)
        losses.append(made.training_loss(made.network, np.random.default_rng(1), B, CPU).item())
    slope = (losses[1] - losses[0]) / 0.4
    assert slope > 0
    assert losses[2] - losses[1] == pytest.approx(0.5 * slope, rel=1e-3)
    assert losses[3] == losses[2]
    # Validation has it in full, always.
    full = validated(made)
    made.anneal(1)
    assert validated(made) == full
    plain = trainee(clips, states)
    plain.anneal(1)
    assert plain._weight == 1.0


def test_standards_and_first_poses_are_those_of_the_windows(clips, states):
    made = trainee(clips, states)
    network, all_windows = made.network, made.windows.spread(10_000)
    x = all_windows.states
    assert len(x) == len(made.windows) == 2 * 7 * (20 - 6 + 1)
    np.testing.assert_allclose(network.state_mean, x.mean(axis=(0, 1)), atol=1e-5)
    deviation = x.std(axis=(0, 1))
    least = 0.05 * np.median(deviation)
    np.testing.assert_allclose(network.state_deviation, deviation.clip(least), rtol=1e-4)
    # p(x₀) has the first poses' mean and, of their variance, all but a thousandth.
    first = x[:, 0]
    np.testing.assert_allclose(network.initial_mean, first.mean(axis=0), atol=1e-5)
    F = network.initial_factor.double().numpy()
    assert F.shape[1] < states.dim
    wanted = np.cov(first.T, bias=True)
    assert 0 <= np.trace(wanted) - np.trace(F @ F.T) <= 1.001e-3 * np.trace(wanted)
    assert abs(F @ F.T - wanted).max() < 1e-3 * np.trace(wanted)


def test_windows_are_the_clips_pieces_and_their_mirror_images(clips, states):
    windows = MotionWindows(clips, states, 6)
    assert len(windows) == 2 * 8 * 15
    found = windows.at(np.arange(len(windows)))
    positions = states.positions(found.states, found.bodies)
    order, flip = list(PERSON.mirrored_order), np.array([-1.0, 1.0, 1.0])
    for number in (0, 14, 15, 8 * 15, 8 * 15 + 16):
        clip, start = divmod(number, 15)
        poses = clips[clip % 8].positions[start : start + 6]
        poses = poses[:, order] * flip if clip >= 8 else poses
        x, _ = states.canonical(states.states(poses, found.bodies[number]))
        np.testing.assert_allclose(found.states[number], x, atol=1e-9)
        moved = poses - poses[0, 0] * [1, 0, 1]
        straight = _turned_onto(moved, positions[number])
        np.testing.assert_allclose(straight, positions[number], atol=2e-4)
    assert len(MotionWindows(clips, states, 6, mirrored=False)) == 8 * 15
    drawn = windows.draw(np.random.default_rng(0), 4000)
    assert drawn.states.shape == (4000, 6, states.dim)
    few = windows.spread(5)
    np.testing.assert_array_equal(few.states, windows.spread(5).states)
    with pytest.raises(ValueError, match="clips has none of 50 frames or more, expected one; the"):
        MotionWindows(clips, states, 50)
    slow = Motion(clips[0].positions, PERSON, 15.0)
    with pytest.raises(
        ValueError, match="expected the skeleton of the states at 30 frames per sec"
    ):
        MotionWindows([clips[0], slow], states, 6)
    with pytest.raises(ValueError, match="validation is at 15 frames per second, expected 30"):
        DVAETrainee(clips, [slow], TINY, states)


def _turned_onto(motion, wanted):
    """The motion turned about the vertical, at the origin, to where it fits best."""
    a, b = motion[..., [0, 2]], wanted[..., [0, 2]]
    sine, cosine = (a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1]).sum(), (a * b).sum()
    return turned_about_vertical(motion, math.atan2(sine, cosine))


SETTINGS = TrainingSettings(
    steps=60, batch=16, learning_rate=3e-3, warmup=5, ema=0.9, checkpoint_every=20
)


def assert_same(folder, other):
    for name, kind in (("model", KIND), ("state", f"{KIND} in training")):
        ours, theirs = (
            load_checkpoint(at / f"{name}.safetensors", kind).tensors for at in (folder, other)
        )
        assert ours.keys() == theirs.keys()
        for key, tensor in ours.items():
            assert torch.equal(tensor, theirs[key]), key


def test_a_run_learns_and_can_be_interrupted(clips, states, tmp_path):
    """In parts, annealing and all, it is the run that was never stopped, bit for bit."""
    settings = replace(SETTINGS, optimiser="adamax", halve_at=(30,))
    made = trainee(clips, states, annealing=30)
    begun = validated(made)
    whole = train(made, settings, tmp_path / "whole", progress=False)
    losses = [row["validation_loss"] for row in whole.history]
    assert losses[-1] < losses[0] < begun

    class Stopped(DVAETrainee):
        def training_loss(self, *arguments):
            if self._step == 33:
                raise KeyboardInterrupt
            return super().training_loss(*arguments)

        def anneal(self, step):
            self._step = step
            super().anneal(step)

    part = trainee(clips, states, annealing=30)
    part.__class__ = Stopped
    with pytest.raises(KeyboardInterrupt):
        train(part, settings, tmp_path / "parts", progress=False)
    later = trainee(clips, states, annealing=30)
    train(later, settings, tmp_path / "parts", progress=False)
    assert_same(tmp_path / "whole", tmp_path / "parts")
    # What it left is a prior.
    prior = MotionDVAE.load(tmp_path / "whole")
    assert (prior.fps, prior.frames, prior.rank) == (30.0, 6, made.network.initial_factor.shape[1])
    drawn = prior.sample(np.random.default_rng(0), 200)
    heights = drawn[:, 0, PERSON.index("pelvis"), 1]
    truth = np.concatenate([clip.positions[:, PERSON.index("pelvis"), 1] for clip in clips])
    assert abs(heights.mean() - truth.mean()) < 0.05
    # Another weight of KL is another run.
    with pytest.raises(ValueError, match="holds a run with annealing 30, expected 0"):
        train(trainee(clips, states), settings, tmp_path / "whole", progress=False)


def test_trust_falls_from_one_to_a_half_at_five_centimetres():
    noise = torch.tensor([0.0, 0.05, 1e6])
    torch.testing.assert_close(trust_in(noise), torch.tensor([1.0, 0.5, 0.0]))


def test_usual_runs_are_as_published():
    settings, annealing = usual_dvae_training("paper")
    # A.4: Adamax, batches of 64, KL annealed over a quarter of the run.
    assert (settings.optimiser, settings.batch, annealing * 4) == ("adamax", 64, settings.steps)
    assert settings.halve_at
    for size in ("tiny", "small"):
        settings, annealing = usual_dvae_training(size)
        assert annealing < settings.steps
    with pytest.raises(ValueError, match="size must be one of tiny, small, paper, got 'huge'"):
        usual_dvae_training("huge")
