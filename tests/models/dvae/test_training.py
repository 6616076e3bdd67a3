"""Training of the Motion-DVAE: loss, annealing, standardisation and resumed runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Normal, kl_divergence

from probmotion import Skeleton, seeds
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.motion_windows import MotionWindows, canonical_windows
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.training import DVAETrainee, refit_joint_scale, usual_dvae_training
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import Anneals, train
from probmotion.motion.motion import Motion

PERSON = Skeleton.preset("person14")
TINY = replace(DVAESettings.tiny(), frames=6)
# Unit of the tracking error, metres.
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
        made.network.generative.log_scales.copy_(torch.log(torch.tensor([0.02, 0.1, 0.2, 0.05])))
    return made


def validated(made):
    with torch.no_grad():
        return made.validation_loss(made.network, CPU)


def parts_by_hand(made, windows, noise):
    """Return errors of translation, orientation, rotations and joints, and Σ_t KL, (B, …) each."""
    network, size = made.network, made.size
    x = torch.tensor(windows.states, dtype=torch.float32)
    bodies = torch.tensor(windows.bodies, dtype=torch.float32)
    joints = made.states.positions(x, bodies)
    shown = (joints - network.joint_mean) / network.joint_deviation
    # Full weights and Gaussian noise.
    trust = torch.ones(joints.shape[:-1])
    frames = torch.cat([shown.flatten(2), trust, 0 * trust[..., :1]], -1)
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
        # h^data_t summarises y_T, …, y_t.
        _, (data, _) = q.reader(frames[:, t:].flip(1))
        if cumulative:
            now = network.state_mean + network.state_deviation * motion
            apart = (joints[:, t] - made.states.positions(now[:, None], bodies)[:, 0]) / STEP
            seen = [h[0], data[0], motion, apart.flatten(1), trust[:, t]]
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
    states = torch.stack(decoded, 1)
    error = states - x[:, 1:]
    apart = made.states.positions(states, bodies) - joints[:, 1:]
    return [error[..., :3], error[..., 3:9], error[..., 9:], apart], divergence


def loss_and_parts(made, weight=1.0):
    windows = made.windows.spread(B)
    rng = np.random.default_rng(0)
    noise = torch.tensor(rng.standard_normal((B, 5, 6), dtype=np.float32))
    loss = made._loss(made.network, windows, np.random.default_rng(0), weight, CPU)
    with torch.no_grad():
        return loss, *parts_by_hand(made, windows, noise)


@pytest.mark.parametrize("decoder", ["cumulative", "direct"])
def test_loss_matches_an_explicit_calculation(clips, states, decoder):
    made = trainee(clips, states, replace(TINY, decoder=decoder))
    loss, errors, divergence = loss_and_parts(made, 0.3)
    total = 0.3 * divergence.sum().item()
    for error, scale in zip(errors, (0.02, 0.1, 0.2, 0.05), strict=True):
        total -= stats.norm.logpdf(error, scale=scale).sum()
    assert loss.item() == pytest.approx(total / B / 5, rel=1e-4)
    assert divergence.min() > 1e-3


def test_unit_scales_give_the_published_squared_errors(clips, states):
    made = trainee(clips, states, replace(TINY, decoder_scale="unit"))
    scales = made.network.generative.log_scales
    loss, errors, divergence = loss_and_parts(made)
    squares = sum(float((error**2).sum()) for error in errors)
    # The joint scale of equation 11 is trained separately.
    density = stats.norm.logpdf(errors[-1], scale=0.05).mean()
    wanted = (squares / B - density + divergence.mean().item()) / 5
    assert loss.item() == pytest.approx(wanted, rel=1e-4)
    weight = made.network.generative.decoder[-1].weight
    slopes, before = torch.autograd.grad(loss, [scales, weight])
    assert (slopes[:3] == 0).all()
    slope = (1 - (errors[-1] ** 2).mean() / 0.05**2) / 5
    assert slopes[3].item() == pytest.approx(slope.item(), rel=1e-3)
    with torch.no_grad():
        scales[3] += 1.0
    torch.testing.assert_close(torch.autograd.grad(loss_and_parts(made)[0], weight)[0], before)


def test_kl_weight_is_annealed(clips, states):
    made = trainee(clips, states, annealing=10)
    assert isinstance(made, Anneals)
    full, losses = validated(made), []
    for step in (40, 10, 5, 1):
        made.anneal(step)
        losses.append(made.training_loss(made.network, np.random.default_rng(1), B, CPU).item())
    slope = (losses[2] - losses[3]) / 0.4
    assert slope > 0
    assert losses[1] - losses[2] == pytest.approx(0.5 * slope, rel=1e-3)
    assert losses[0] == losses[1]
    # Validation always uses the full weight.
    assert validated(made) == full
    plain = trainee(clips, states)
    plain.anneal(1)
    assert plain._weight == 1.0


def test_standardisation_and_first_poses_match_the_windows(clips, states):
    made = trainee(clips, states)
    network, all_windows = made.network, made.windows.spread(10_000)
    x = all_windows.states
    assert len(x) == len(made.windows) == 2 * 7 * (20 - 6 + 1)
    np.testing.assert_allclose(network.state_mean, x.mean(axis=(0, 1)), atol=1e-5)
    deviation = x.std(axis=(0, 1))
    least = 0.05 * np.median(deviation)
    np.testing.assert_allclose(network.state_deviation, deviation.clip(least), rtol=1e-4)
    # p(x₀) has the mean of first poses and 99.9 % of their variance.
    first = x[:, 0]
    np.testing.assert_allclose(network.initial_mean, first.mean(axis=0), atol=1e-5)
    F = network.initial_factor.double().numpy()
    assert F.shape[1] < states.dim
    wanted = np.cov(first.T, bias=True)
    assert 0 <= np.trace(wanted) - np.trace(F @ F.T) <= 1.001e-3 * np.trace(wanted)
    assert abs(F @ F.T - wanted).max() < 1e-3 * np.trace(wanted)


def test_windows_are_segments_of_clips_and_mirrored_clips(clips, states):
    windows = MotionWindows(clips, states, 6)
    assert len(windows) == 2 * 8 * 15
    every = windows.at(np.arange(len(windows)))
    order, flip = list(PERSON.mirrored_order), np.array([-1.0, 1.0, 1.0])
    for number in (0, 14, 15, 8 * 15, 8 * 15 + 16):
        clip, start = divmod(number, 15)
        poses = clips[clip % 8].positions[start : start + 6]
        poses = poses[:, order] * flip if clip >= 8 else poses
        x = canonical_windows(states.states(poses, every.bodies[number])[None])[0]
        np.testing.assert_allclose(every.states[number], x, atol=1e-9)


def test_drawn_windows_have_a_random_tempo(clips, states):
    """The displacement per frame of a state that is linear in time equals the tempo."""
    windows = MotionWindows(clips, states, 6)
    line = np.zeros((20, states.dim))
    line[:] = states.states(clips[0].positions, windows.at(np.array([0])).bodies[0])[0]
    line[:, 1] = np.arange(20)
    windows._states = [line] * 16
    drawn = windows.draw(np.random.default_rng(0), 4000).states[..., 1]
    np.testing.assert_allclose(np.diff(drawn), np.diff(drawn)[:, :1] + np.zeros(5), atol=1e-9)
    tempo = np.diff(drawn)[:, 0][drawn[:, -1] < 19 - 1e-9]
    assert 0.8 <= tempo.min() < 0.81
    assert 1.24 < tempo.max() <= 1.25


def test_invalid_inputs_are_rejected(clips, states):
    slow = Motion(clips[0].positions, PERSON, 15.0)
    for call, message in (
        (lambda: MotionWindows(clips, states, 50), "one of at least 50 frames, got at most 20"),
        (lambda: MotionWindows([clips[0], slow], states, 6), "skeleton of the states and 30 frame"),
        (
            lambda: DVAETrainee(clips, [slow], TINY, states),
            "must have 30 frames per second",
        ),
        (lambda: usual_dvae_training("huge"), "size must be one of tiny, small, paper, got 'huge'"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_training_lowers_the_loss_and_saves_a_prior(clips, states, tmp_path):
    settings = TrainingSettings(
        steps=24, batch=16, learning_rate=3e-3, warmup=5, ema=0.9, checkpoint_every=12
    )
    made = trainee(clips, states, annealing=12)
    begun = validated(made)
    result = train(made, settings, tmp_path, progress=False)
    losses = [row["validation_loss"] for row in result.history]
    assert losses[-1] < losses[0] < begun
    prior = MotionDVAE.load(tmp_path)
    assert (prior.fps, prior.frames, prior.rank) == (30.0, 6, made.network.initial_factor.shape[1])
    pelvis = PERSON.index("pelvis")
    heights = prior.sample(np.random.default_rng(0), 200)[:, 0, pelvis, 1]
    truth = np.concatenate([clip.positions[:, pelvis, 1] for clip in clips])
    assert abs(heights.mean() - truth.mean()) < 0.05
    with pytest.raises(ValueError, match=r"annealing must be 12 to resume .*, got 0"):
        train(trainee(clips, states), settings, tmp_path, progress=False)
    # The joint scale is refitted to the validation error.
    scale = refit_joint_scale(prior, clips[:1])
    assert prior.joint_scale == pytest.approx(scale)
    windows = MotionWindows(clips[:1], states, 6).spread(256)
    noise = seeds.generator(0, "scale").standard_normal((len(windows.states), 5, 6), np.float32)
    made.network = prior.model
    (*_, errors), _ = parts_by_hand(made, windows, torch.tensor(noise))
    assert scale == pytest.approx(float((errors**2).mean().sqrt()), rel=1e-4)
