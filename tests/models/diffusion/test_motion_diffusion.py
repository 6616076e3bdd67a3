"""2D motion diffusion prior: standardisation, noise levels, Jacobian, checkpoints and accuracy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from probmotion import Cameras, NoiseSchedule
from probmotion.models.diffusion.motion_diffusion import KIND, MotionDiffusion
from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.training.checkpoints import Checkpoint, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.standardisation import Standards
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.problems import load_problem

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
TINY = DiffusionSettings.tiny(frames=12)
CAMERA = Cameras.ring(1, elevation=math.pi / 16)


def untrained(size=TINY, seed=0, **options):
    """Return an untrained prior with a fixed root."""
    rng = np.random.default_rng(seed)
    deviation = rng.uniform(0.1, 0.5, (4, 2))
    deviation[0] = 0
    standards = Standards(rng.normal(size=(4, 2)) * 0.3, deviation)
    return MotionDiffusion(size.network(4, seed), size, standards, BODY, 20.0, **options)


def noisy(prior, B=3, V=2, L=None, seed=1):
    shape = (B, V, prior.frames if L is None else L, prior.skeleton.n_joints, 2)
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.fixture(scope="module")
def prior():
    return untrained()


def standard_units(prior):
    """Return the mean and standard deviation of the joints in normalised units."""
    return prior.standards.mean / prior.scale, prior.standards.deviation / prior.scale


def test_theta_contains_positions_and_the_scale_is_that_of_moving_joints(prior):
    assert (prior.frames, prior.fps, prior.dim) == (12, 20.0, 12 * 4 * 3)
    theta = np.arange(2.0 * prior.dim).reshape(2, -1)
    np.testing.assert_array_equal(prior.motion(theta).reshape(2, -1), theta)
    moving = prior.standards.deviation[1:]
    assert prior.scale == pytest.approx(np.sqrt((moving**2).mean()))


@pytest.mark.parametrize("level", [1, 40, 100])
def test_denoise_evaluates_the_network_in_standardised_units(prior, level):
    x_t = noisy(prior)
    alpha_bar = TINY.schedule.alpha_bar[level]
    mean, deviation = standard_units(prior)
    unit = (x_t - math.sqrt(alpha_bar) * mean) / np.sqrt(alpha_bar * deviation**2 + 1 - alpha_bar)
    network = TINY.network(4, 0).eval()
    with torch.no_grad():
        flat = torch.tensor(unit.reshape(6, 12, 8), dtype=torch.float32)
        result = network(flat, torch.full((6,), float(level))).numpy().reshape(x_t.shape)
    got = prior.denoise(x_t, alpha_bar, Cameras.ring(2))
    assert got.dtype == x_t.dtype
    np.testing.assert_allclose(got, mean + deviation * result, atol=2e-5)
    # A fixed root stays at its mean.
    np.testing.assert_allclose(got[..., 0, :], np.broadcast_to(mean[0], got[..., 0, :].shape))


@pytest.mark.parametrize("power", [2, 4])
def test_levels_invert_the_schedule(power):
    size = replace(TINY, schedule_power=power)
    schedule = NoiseSchedule.cosine(100, power=power)
    result = [size.level(alpha_bar) for alpha_bar in schedule.alpha_bar]
    np.testing.assert_allclose(result, np.arange(101), atol=1e-9)
    for steps in (7, 20, 50):
        strided = schedule.strided(steps)
        result = [size.level(alpha_bar) for alpha_bar in strided.alpha_bar]
        np.testing.assert_allclose(result, strided.times, atol=1e-9)
    tenth = 1 / (1 + (0.1 * schedule.sigma(1)) ** 2)  # halfway from .01 to 1 σ₁ in log noise
    assert size.level(tenth) == pytest.approx(0.5)
    levels = [size.level(alpha_bar) for alpha_bar in np.linspace(1, schedule.alpha_bar[-1], 500)]
    assert (np.diff(levels) >= 0).all()
    with pytest.raises(ValueError, match=r"noise levels must be at most .*, got .*; use levels=C"):
        size.level(0.9 * schedule.alpha_bar[-1])
    for wrong in (1.1, 0.0, float("nan")):
        with pytest.raises(ValueError, match=r"alpha_bar must be above 0 and at most 1, got .*"):
            size.level(wrong)


@pytest.mark.parametrize("alpha_bar", [-0.5, 0.0, 1.1, 1e-9])
def test_levels_are_checked_first(prior, alpha_bar):
    x_t = np.zeros((1, 1, 4, prior.skeleton.n_joints, 2))
    for method in (prior.denoise, prior.view_covariance):
        with pytest.raises(ValueError, match=r"(alpha_bar|noise levels) must be"):
            method(x_t, alpha_bar, Cameras.ring(1))
    assert (prior.view_covariance(x_t, 1.0, Cameras.ring(1))(x_t + 1) == 0).all()


def test_results_do_not_depend_on_batch_threads_or_cameras(prior):
    x_t, vectors = noisy(prior, B=40, V=3), noisy(prior, B=40, V=3, seed=2)
    cameras = Cameras.ring(3, elevation=1.0, perspective=True)
    batch = prior.denoise(x_t, 0.4, cameras)
    given = x_t.copy()
    covariance = prior.view_covariance(given, 0.4, cameras)
    given[:] = 0
    product = covariance(vectors)
    for rows in (slice(0, 1), slice(17, 18), slice(3, 31)):
        part = prior.denoise(x_t[rows], 0.4, Cameras.ring(3))
        np.testing.assert_array_equal(part, batch[rows])
        part = prior.view_covariance(x_t[rows], 0.4, cameras)(vectors[rows])
        np.testing.assert_array_equal(part, product[rows])
    swapped = prior.denoise(np.ascontiguousarray(x_t[:, [2, 0, 1]]), 0.4, cameras)
    np.testing.assert_array_equal(swapped, batch[:, [2, 0, 1]])
    torch.set_num_threads(2)
    try:
        np.testing.assert_array_equal(prior.denoise(x_t, 0.4, cameras), batch)
    finally:
        torch.set_num_threads(1)
    single = prior.denoise(x_t.astype(np.float32), 0.4, cameras)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, batch, atol=1e-5)
    np.testing.assert_array_equal(prior.denoise(x_t, 1.0, cameras), x_t)


def test_padding_has_no_effect():
    network = replace(TINY, dropout=0.3).network(4).eval()
    rng = np.random.default_rng(0)
    motions = torch.tensor(rng.normal(size=(3, 12, 8)), dtype=torch.float32)
    levels = torch.tensor([3.0, 50.0, 99.5])
    valid = torch.arange(12)[None] < torch.tensor([[12], [7], [2]])
    with torch.no_grad():
        expected = network(motions, levels, valid)
        other = torch.where(valid[..., None], motions, 1e3)
        torch.testing.assert_close(network(other, levels, valid)[valid], expected[valid])
        # Padded motions give the same result as shorter ones.
        for row, length in enumerate((12, 7, 2)):
            part = network(motions[row : row + 1, :length], levels[row : row + 1])
            torch.testing.assert_close(part[0], expected[row, :length], rtol=1e-4, atol=1e-5)
        # Without a mask the values matter.
        assert (network(other, levels)[1, :7] - expected[1, :7]).abs().max() > 1e-3


def test_network_depends_on_time_and_level(prior):
    x_t, cameras = noisy(prior, V=1), Cameras.ring(1)
    backwards = prior.denoise(np.ascontiguousarray(x_t[:, :, ::-1]), 0.4, cameras)[:, :, ::-1]
    assert abs(backwards - prior.denoise(x_t, 0.4, cameras)).max() > 1e-3
    angles = 2.5 * 10_000.0 ** (-np.arange(0, 6, 2) / 6)
    expected = np.stack([np.sin(angles), np.cos(angles)], axis=-1).ravel()
    result = sinusoids(torch.tensor([0.0, 2.5]), 6)
    np.testing.assert_allclose(result, [[0, 1, 0, 1, 0, 1], expected], atol=1e-6)


class Linear(nn.Module):
    """Network that multiplies all coordinates of a motion by a matrix."""

    def __init__(self, matrix):
        super().__init__()
        self.matrix = nn.Parameter(torch.tensor(matrix, dtype=torch.float32))

    def forward(self, motions, levels):
        return (motions.flatten(1) @ self.matrix.T).unflatten(1, motions.shape[1:])


def test_covariance_product_of_a_linear_network():
    # For J = D W / spread with diagonal D and spread, Jᵀ v = Wᵀ (D v) / spread.
    matrix = np.random.default_rng(4).normal(size=(96, 96)) / 10
    prior = MotionDiffusion(Linear(matrix), TINY, untrained().standards, BODY, 20.0)
    alpha_bar, cameras = 0.6, Cameras.ring(2)
    x_t, v = noisy(prior, B=3), noisy(prior, B=3, seed=2)
    _, deviation = standard_units(prior)
    spread = np.sqrt(alpha_bar * deviation**2 + 1 - alpha_bar)
    expected = ((deviation * v).reshape(3, 2, 96) @ matrix).reshape(v.shape) / spread
    expected *= (1 - alpha_bar) / math.sqrt(alpha_bar)
    with torch.no_grad():
        product = prior.view_covariance(x_t, alpha_bar, cameras)(v)
    np.testing.assert_allclose(product, expected, atol=1e-5)


def test_sizes_match_the_publication():
    def parameters(size, joints):
        return sum(value.numel() for value in size.network(joints).parameters())

    width, forward = 512, 1024
    layer = 4 * (width**2 + width) + 2 * width * forward + width + forward + 4 * width
    ends = (32 * width + width) + (32 * width + 32) + 2 * (width**2 + width)
    assert parameters(DiffusionSettings.paper(), 16) == 6 * layer + ends
    # The authors' released code has 17.4 million parameters for 16 joints.
    result = parameters(DiffusionSettings.reference_code(), 16)
    assert result == 8 * layer + ends
    assert result == pytest.approx(17.4e6, rel=0.01)
    assert DiffusionSettings.reference_code().schedule_power == 4


@pytest.fixture(scope="module")
def trainee():
    keypoints = 0.3 * np.random.default_rng(0).normal(size=(30, 4, 2))
    keypoints[:, 0] = 0
    track = KeypointTrack(keypoints, np.ones((30, 4)), BODY, 20.0, "clip/0")
    return DiffusionTrainee([track], [track], TINY)


def test_trained_priors_are_loaded_from_folder_and_file(trainee, tmp_path):
    result = train(trainee, TrainingSettings(steps=2, batch=2), tmp_path, progress=False)
    prior = MotionDiffusion.load(tmp_path)
    assert prior.card["step"] == 2
    assert prior.skeleton == BODY
    x_t = noisy(prior)
    expected = prior.denoise(x_t, 0.4, Cameras.ring(2))
    again = MotionDiffusion.load(result.model, frames=7)
    assert again.frames == 7
    np.testing.assert_array_equal(again.denoise(x_t, 0.4, Cameras.ring(2)), expected)
    again.save(tmp_path / "saved.safetensors")
    saved = MotionDiffusion.load(tmp_path / "saved.safetensors")
    np.testing.assert_array_equal(saved.denoise(x_t, 0.4, Cameras.ring(2)), expected)


@pytest.mark.parametrize(
    ("kind", "change", "options", "message"),
    [
        ("evaluator", {}, {}, "must contain a motion-diffusion, got a evaluator"),
        (KIND, {"size": vars(TINY) | {"width": 64}}, {}, "weights must match the checkpoint"),
        (KIND, {"parents": None}, {}, "must contain valid motion-diffusion settings"),
        (KIND, {}, {"frames": 99}, "frames must be at most 12, the network's longest motion, got"),
        (KIND, {}, {"frames": 1}, "frames must be an integer of at least 2, got 1"),
        (KIND, {}, {"device": "tpu"}, "device must be auto, cpu or cuda, got 'tpu'"),
    ],
)
def test_unusable_checkpoints_are_rejected(trainee, tmp_path, kind, change, options, message):
    path = tmp_path / "a.safetensors"
    settings = {"network": {**trainee.settings, **change}}
    save_checkpoint(path, Checkpoint(kind, settings, trainee.network.state_dict()))
    with pytest.raises(ValueError, match=message):
        MotionDiffusion.load(path, **options)


def test_invalid_input_is_rejected(prior):
    x_t = noisy(prior)
    for values, message in (
        (noisy(prior, L=13), "x_t must have at most 12 frames, got 13"),
        (x_t[0], r"x_t must have shape .*got \(2, 12, 4, 2\)"),
        (np.nan * x_t, "x_t must be finite"),
    ):
        with pytest.raises(ValueError, match=message):
            prior.denoise(values, 0.4, CAMERA)
    with pytest.raises(ValueError, match="vectors must have shape"):
        prior.view_covariance(x_t, 0.4, CAMERA)(x_t[:2])
    with pytest.raises(ValueError, match="card must describe a trained network"):
        prior.save("no.safetensors")
    for name, value in (("steps", 1), ("dropout", 1.0), ("width", 9)):
        with pytest.raises(ValueError, match=f"^{name} must be"):
            replace(TINY, **{name: value})


def projections(gait, n, seed):
    """Return projections of n draws of the exact prior, metres."""
    motions = gait.sample(np.random.default_rng(seed), n)
    return CAMERA.project(motions.reshape(n, -1, 3))[0].reshape(*motions.shape[:-1], 2)


@pytest.fixture(scope="module")
def gait():
    """Return the exact prior of gaits."""
    return load_problem("gait").posterior.prior


@pytest.fixture(scope="module")
def learnt(gait, tmp_path_factory):
    """Train a tiny network on 2000 projections in about ten seconds."""
    confidence = np.ones((gait.frames, gait.skeleton.n_joints))
    tracks = [
        KeypointTrack(keypoints, confidence, gait.skeleton, gait.fps, f"{number}/0")
        for number, keypoints in enumerate(projections(gait, 2050, 1))
    ]
    size = DiffusionSettings.tiny(gait.frames)
    trainee = DiffusionTrainee(tracks[50:], tracks[:50], size, augmentation=Augmentation.none())
    settings = TrainingSettings(
        steps=600, batch=32, learning_rate=4e-3, warmup=50, ema=0.99, checkpoint_every=600
    )
    result = train(trainee, settings, tmp_path_factory.mktemp("gait"), progress=False)
    return MotionDiffusion.load(result.model)


@pytest.mark.slow
def test_a_trained_network_approaches_the_exact_denoiser(gait, learnt):
    seen, clean = projections(gait, 500, 4), projections(gait, 60, 3)
    frames = seen.reshape(len(seen) * gait.frames, -1)
    mean, covariance = frames.mean(axis=0), np.cov(frames.T)
    for level, ratio in ((30, 0.9), (50, 0.65), (70, 0.55), (80, 0.55)):
        alpha_bar = float(learnt.settings.schedule.alpha_bar[level])
        noise = np.random.default_rng(level).standard_normal(clean.shape)
        x_t = math.sqrt(alpha_bar) * clean / learnt.scale + math.sqrt(1 - alpha_bar) * noise
        result = learnt.denoise(x_t[:, None], alpha_bar, CAMERA)[:, 0] * learnt.scale
        # Express the same noise in the unit of the exact prior.
        deviation = math.sqrt((1 - alpha_bar) / alpha_bar) * learnt.scale
        abar = 1 / (1 + (deviation / gait.scale) ** 2)
        observed = x_t / math.sqrt(alpha_bar) * learnt.scale
        exact = gait.denoise(math.sqrt(abar) * observed[:, None] / gait.scale, abar, CAMERA)[:, 0]
        exact *= gait.scale
        # Compute the best linear estimate of each frame from that frame alone.
        gain = np.linalg.solve(covariance + deviation**2 * np.eye(len(mean)), covariance)
        linear = mean + (observed.reshape(-1, len(mean)) - mean) @ gain
        error = np.sqrt(((result - exact) ** 2).mean())
        assert error < 0.3 * np.sqrt(((seen.mean(axis=0) - exact) ** 2).mean())
        assert error < ratio * np.sqrt(((linear.reshape(exact.shape) - exact) ** 2).mean())
