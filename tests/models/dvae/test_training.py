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
STEP = 0.05  # unit of the tracking error, metres
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


def make_trainee(clips, states, size=TINY, **options):
    trainee = DVAETrainee(clips[1:], clips[:1], size, states, **options)
    with torch.no_grad():
        trainee.network.generative.log_scales.copy_(torch.log(torch.tensor([0.02, 0.1, 0.2, 0.05])))
    return trainee


def validated(trainee):
    with torch.no_grad():
        return trainee.validation_loss(trainee.network, CPU)


def parts_by_hand(trainee, windows, noise):
    """Return errors of translation, orientation, rotations and joints, and Σ_t KL, (B, …) each."""
    network, size, positions = trainee.network, trainee.size, trainee.states.positions
    x = torch.tensor(windows.states, dtype=torch.float32)
    bodies = torch.tensor(windows.bodies, dtype=torch.float32)
    joints = positions(x, bodies)
    standardised = (joints - network.joint_mean) / network.joint_deviation
    # All weights are 1, and the noise is Gaussian.
    weights = torch.ones(joints.shape[:-1])
    frames = torch.cat([standardised.flatten(2), weights, 0 * weights[..., :1]], -1)
    standard = (x - network.state_mean) / network.state_deviation
    p, q = network.generative, network.encoder

    def gaussian(parameters):
        mean, raw = parameters.chunk(2, -1)
        return Normal(mean, torch.exp(6 * torch.tanh(raw / 6)))

    def initial_state(starts):
        hidden, cell = starts(standard[:, 0]).chunk(2, -1)
        return torch.tanh(hidden), cell

    cumulative = size.decoder == "cumulative"
    h, motion, divergence, decoded = initial_state(p.starts), standard[:, 0], 0.0, []
    latent_state = None if cumulative else initial_state(q.starts)
    for t in range(1, 6):
        # The state h^data_t summarises y_T, …, y_t.
        _, (data, _) = q.reader(frames[:, t:].flip(1))
        if cumulative:
            current = network.state_mean + network.state_deviation * motion
            difference = (joints[:, t] - positions(current[:, None], bodies)[:, 0]) / STEP
            features = [h[0], data[0], motion, difference.flatten(1), weights[:, t]]
        else:
            features = [latent_state[0], data[0]]
        posterior = gaussian(q.latents(torch.cat(features, -1)))
        divergence = divergence + kl_divergence(posterior, gaussian(p.latent_prior(h[0]))).sum(-1)
        z = posterior.mean + posterior.stddev * noise[:, t - 1]
        h = p.recurrent(z, h)
        if cumulative:
            motion = motion + p.decoder(h[0]) + p.straight(z)
        else:
            motion, latent_state = p.decoder(h[0]), q.recurrent(z, latent_state)
        decoded.append(network.state_mean + network.state_deviation * motion)
    states = torch.stack(decoded, 1)
    error = states - x[:, 1:]
    difference = positions(states, bodies) - joints[:, 1:]
    return [error[..., :3], error[..., 3:9], error[..., 9:], difference], divergence


def loss_and_parts(trainee, weight=1.0):
    windows = trainee.windows.spread(B)
    rng = np.random.default_rng(0)
    noise = torch.tensor(rng.standard_normal((B, 5, 6), dtype=np.float32))
    loss = trainee._loss(trainee.network, windows, np.random.default_rng(0), weight, CPU)
    with torch.no_grad():
        return loss, *parts_by_hand(trainee, windows, noise)


@pytest.mark.parametrize("decoder", ["cumulative", "direct"])
def test_loss_matches_an_explicit_calculation(clips, states, decoder):
    trainee = make_trainee(clips, states, replace(TINY, decoder=decoder))
    loss, errors, divergence = loss_and_parts(trainee, 0.3)
    total = 0.3 * divergence.sum().item()
    for error, scale in zip(errors, (0.02, 0.1, 0.2, 0.05), strict=True):
        total -= stats.norm.logpdf(error, scale=scale).sum()
    assert loss.item() == pytest.approx(total / B / 5, rel=1e-4)
    assert divergence.min() > 1e-3


def test_unit_scales_give_the_published_squared_errors(clips, states):
    trainee = make_trainee(clips, states, replace(TINY, decoder_scale="unit"))
    scales = trainee.network.generative.log_scales
    loss, errors, divergence = loss_and_parts(trainee)
    squares = sum(float((error**2).sum()) for error in errors)
    # The joint scale of equation 11 is trained separately.
    density = stats.norm.logpdf(errors[-1], scale=0.05).mean()
    expected = (squares / B - density + divergence.mean().item()) / 5
    assert loss.item() == pytest.approx(expected, rel=1e-4)
    weight = trainee.network.generative.decoder[-1].weight
    slopes, before = torch.autograd.grad(loss, [scales, weight])
    assert (slopes[:3] == 0).all()
    slope = (1 - (errors[-1] ** 2).mean() / 0.05**2) / 5
    assert slopes[3].item() == pytest.approx(slope.item(), rel=1e-3)
    with torch.no_grad():
        scales[3] += 1.0
    torch.testing.assert_close(torch.autograd.grad(loss_and_parts(trainee)[0], weight)[0], before)


def test_kl_weight_is_annealed(clips, states):
    trainee = make_trainee(clips, states, annealing=10)
    assert isinstance(trainee, Anneals)
    full, losses, rng = validated(trainee), [], np.random.default_rng
    for step in (40, 10, 5, 1):
        trainee.anneal(step)
        losses.append(trainee.training_loss(trainee.network, rng(1), B, CPU).item())
    slope = (losses[2] - losses[3]) / 0.4
    assert slope > 0
    assert losses[1] - losses[2] == pytest.approx(0.5 * slope, rel=1e-3)
    assert losses[0] == losses[1]
    # Validation always uses the full weight.
    assert validated(trainee) == full
    constant = make_trainee(clips, states)
    constant.anneal(1)
    assert constant._weight == 1.0


def test_standardisation_and_first_poses_match_the_windows(clips, states):
    trainee = make_trainee(clips, states)
    network, all_windows = trainee.network, trainee.windows.spread(10_000)
    x = all_windows.states
    assert len(x) == len(trainee.windows) == 2 * 7 * (20 - 6 + 1)
    np.testing.assert_allclose(network.state_mean, x.mean(axis=(0, 1)), atol=1e-5)
    deviation = x.std(axis=(0, 1))
    minimum = 0.05 * np.median(deviation)
    np.testing.assert_allclose(network.state_deviation, deviation.clip(minimum), rtol=1e-4)
    # p(x₀) has the mean of first poses and 99.9 % of their variance.
    first = x[:, 0]
    np.testing.assert_allclose(network.initial_mean, first.mean(axis=0), atol=1e-5)
    F = network.initial_factor.double().numpy()
    assert F.shape[1] < states.dim
    expected = np.cov(first.T, bias=True)
    assert 0 <= np.trace(expected) - np.trace(F @ F.T) <= 1.001e-3 * np.trace(expected)
    assert abs(F @ F.T - expected).max() < 1e-3 * np.trace(expected)


def test_windows_are_segments_of_clips_and_mirrored_clips(clips, states):
    windows = MotionWindows(clips, states, 6)
    assert len(windows) == 2 * 8 * 15
    batch = windows.at(np.arange(len(windows)))
    order, flip = list(PERSON.mirrored_order), np.array([-1.0, 1.0, 1.0])
    for number in (0, 14, 15, 8 * 15, 8 * 15 + 16):
        clip, start = divmod(number, 15)
        poses = clips[clip % 8].positions[start : start + 6]
        poses = poses[:, order] * flip if clip >= 8 else poses
        x = canonical_windows(states.states(poses, batch.bodies[number])[None])[0]
        np.testing.assert_allclose(batch.states[number], x, atol=1e-9)


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
    trainee = make_trainee(clips, states, annealing=12)
    initial = validated(trainee)
    result = train(trainee, settings, tmp_path, progress=False)
    losses = [row["validation_loss"] for row in result.history]
    assert losses[-1] < losses[0] < initial
    prior = MotionDVAE.load(tmp_path)
    assert (prior.fps, prior.frames) == (30.0, 6)
    assert prior.rank == trainee.network.initial_factor.shape[1]
    pelvis = PERSON.index("pelvis")
    heights = prior.sample(np.random.default_rng(0), 200)[:, 0, pelvis, 1]
    truth = np.concatenate([clip.positions[:, pelvis, 1] for clip in clips])
    assert abs(heights.mean() - truth.mean()) < 0.05
    with pytest.raises(ValueError, match=r"annealing must be 12 to resume .*, got 0"):
        train(make_trainee(clips, states), settings, tmp_path, progress=False)
    # The joint scale is refitted to the validation error.
    scale = refit_joint_scale(prior, clips[:1])
    assert prior.joint_scale == pytest.approx(scale)
    windows = MotionWindows(clips[:1], states, 6).spread(256)
    noise = seeds.generator(0, "scale").standard_normal((len(windows.states), 5, 6), np.float32)
    trainee.network = prior.model
    (*_, errors), _ = parts_by_hand(trainee, windows, torch.tensor(noise))
    assert scale == pytest.approx(float((errors**2).mean().sqrt()), rel=1e-4)
