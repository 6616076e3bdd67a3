"""The 2D motion diffusion prior: its door, its levels, its Jacobian, and what it learns."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, NoiseSchedule
from probmotion.models.diffusion.motion_diffusion import KIND, MotionDiffusion
from probmotion.models.diffusion.motion_transformer import sinusoids
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.standardisation import Standards
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import DenoiserCovariance2D, Denoises2D, MotionPrior
from probmotion.problems import load_problem

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
TINY = DiffusionSettings.tiny(frames=12)
CAMERA = Cameras.ring(1, elevation=math.pi / 16)


def fresh(size=TINY, seed=0, **options):
    """A prior with fresh weights, whose root never moves."""
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
    return fresh()


def test_it_is_a_prior_that_denoises_views(prior):
    for protocol in (MotionPrior, Denoises2D, DenoiserCovariance2D):
        assert isinstance(prior, protocol)
    assert (prior.frames, prior.fps, prior.dim) == (12, 20.0, 12 * 4 * 3)
    theta = np.arange(2.0 * prior.dim).reshape(2, -1)
    np.testing.assert_array_equal(prior.motion(theta).reshape(2, -1), theta)
    moving = prior.standards.deviation[1:]
    assert prior.scale == pytest.approx(np.sqrt((moving**2).mean()))


@pytest.mark.parametrize("level", [1, 40, 100])
def test_denoise_is_the_network_in_standardised_units(prior, level):
    x_t = noisy(prior)
    alpha_bar = TINY.schedule.alpha_bar[level]
    mean, deviation = (
        value / prior.scale for value in (prior.standards.mean, prior.standards.deviation)
    )
    unit = (x_t - math.sqrt(alpha_bar) * mean) / np.sqrt(alpha_bar * deviation**2 + 1 - alpha_bar)
    network = TINY.network(4, 0).eval()
    with torch.no_grad():
        flat = torch.tensor(unit.reshape(6, 12, 8), dtype=torch.float32)
        found = network(flat, torch.full((6,), float(level))).numpy().reshape(x_t.shape)
    got = prior.denoise(x_t, alpha_bar, Cameras.ring(2))
    assert got.dtype == x_t.dtype
    np.testing.assert_allclose(got, mean + deviation * found, atol=2e-5)
    # A root that never moved is given back where it was.
    np.testing.assert_allclose(got[..., 0, :], np.broadcast_to(mean[0], got[..., 0, :].shape))


@pytest.mark.parametrize("power", [2, 4])
def test_levels_are_those_of_the_schedule(power):
    size = replace(TINY, schedule_power=power)
    schedule = NoiseSchedule.cosine(100, power=power)
    found = [size.level(alpha_bar) for alpha_bar in schedule.alpha_bar]
    np.testing.assert_allclose(found, np.arange(101), atol=1e-9)
    for steps in (7, 20, 50):
        some = schedule.strided(steps)
        found = [size.level(alpha_bar) for alpha_bar in some.alpha_bar]
        np.testing.assert_allclose(found, some.times, atol=1e-9)
    between = [size.level(alpha_bar) for alpha_bar in np.linspace(1, schedule.alpha_bar[-1], 500)]
    assert (np.diff(between) >= 0).all()
    # Another schedule may begin beyond this one's last level.
    assert size.level(0.1 * schedule.alpha_bar[-1]) == 100
    for wrong in (1.1, 0.0, float("nan")):
        with pytest.raises(ValueError, match=r"alpha_bar must be above 0 and at most 1, got .*"):
            size.level(wrong)


def test_rows_do_not_depend_on_the_batch(prior):
    x_t = noisy(prior, B=40, V=3)
    cameras = Cameras.ring(3)
    whole = prior.denoise(x_t, 0.4, cameras)
    for some in (slice(0, 1), slice(17, 18), slice(3, 31)):
        np.testing.assert_array_equal(prior.denoise(x_t[some], 0.4, cameras), whole[some])
    for order in ([2, 0, 1], [1, 0, 2]):
        turned = prior.denoise(np.ascontiguousarray(x_t[:, order]), 0.4, cameras)
        np.testing.assert_array_equal(turned, whole[:, order])
    vectors = noisy(prior, B=40, V=3, seed=2)
    product = prior.view_covariance_product(x_t, 0.4, cameras, vectors)
    for some in (slice(0, 1), slice(17, 18), slice(3, 31)):
        alone = prior.view_covariance_product(x_t[some], 0.4, cameras, vectors[some])
        np.testing.assert_array_equal(alone, product[some])


def test_rows_do_not_depend_on_the_number_of_threads(prior):
    x_t, cameras = noisy(prior, B=20, V=3), Cameras.ring(3)
    before = torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(prior.denoise(x_t, 0.4, cameras))
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(*found)


def test_views_of_unknown_cameras_are_all_alike(prior):
    x_t = noisy(prior, V=2)
    wanted = prior.denoise(x_t, 0.4, Cameras.ring(2))
    other = Cameras.ring(2, elevation=1.0, perspective=True)
    np.testing.assert_array_equal(prior.denoise(x_t, 0.4, other), wanted)
    single = x_t.astype(np.float32)
    got = prior.denoise(single, 0.4, other)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, wanted, atol=1e-5)


def test_what_stands_in_padding_has_no_influence():
    network = replace(TINY, dropout=0.3).network(4).eval()
    rng = np.random.default_rng(0)
    motions = torch.tensor(rng.normal(size=(3, 12, 8)), dtype=torch.float32)
    levels = torch.tensor([3.0, 50.0, 99.5])
    valid = torch.arange(12)[None] < torch.tensor([[12], [7], [2]])
    with torch.no_grad():
        wanted = network(motions, levels, valid)
        other = torch.where(valid[..., None], motions, 1e3)
        torch.testing.assert_close(network(other, levels, valid)[valid], wanted[valid])
        # Padding is as if the motion were shorter, and a full mask as if there were none.
        for row, length in enumerate((12, 7, 2)):
            alone = network(motions[row : row + 1, :length], levels[row : row + 1])
            torch.testing.assert_close(alone[0], wanted[row, :length], rtol=1e-4, atol=1e-5)
        # What is not masked does matter.
        assert (network(other, levels)[1, :7] - wanted[1, :7]).abs().max() > 1e-3


def test_the_network_knows_time_and_level(prior):
    x_t, cameras = noisy(prior, V=1), Cameras.ring(1)
    backwards = prior.denoise(np.ascontiguousarray(x_t[:, :, ::-1]), 0.4, cameras)[:, :, ::-1]
    assert abs(backwards - prior.denoise(x_t, 0.4, cameras)).max() > 1e-3
    found = sinusoids(torch.tensor([0.0, 2.5]), 6)
    rates = 10_000.0 ** (-np.arange(0, 6, 2) / 6)
    wanted = np.stack([np.sin(2.5 * rates), np.cos(2.5 * rates)], axis=-1).ravel()
    np.testing.assert_allclose(found[1], wanted, atol=1e-6)
    np.testing.assert_allclose(found[0], [0, 1, 0, 1, 0, 1])


def test_covariance_product_is_the_adjoint_of_the_jacobian(prior):
    # ⟨Jᵀ v, u⟩ = ⟨v, J u⟩, J u by finite differences of a network in double precision.
    alpha_bar, cameras = 0.6, Cameras.ring(2)
    x_t, v, u = (noisy(prior, B=2, seed=seed) for seed in (1, 2, 3))
    product = prior.view_covariance_product(x_t, alpha_bar, cameras, v)
    network = TINY.network(4, 0).double().eval()
    mean, deviation = (
        torch.tensor(value / prior.scale)
        for value in (prior.standards.mean, prior.standards.deviation)
    )
    spread = (alpha_bar * deviation**2 + 1 - alpha_bar).sqrt()
    level = torch.full((4,), TINY.level(alpha_bar), dtype=torch.float64)

    def denoise(values):
        unit = (torch.tensor(values).flatten(0, 1) - math.sqrt(alpha_bar) * mean) / spread
        tokens = network.enter(unit.flatten(2))
        first = network.level(sinusoids(level, network.width).double())[:, None]
        tokens = torch.cat([first, tokens], dim=1) + network.places[:13].double()
        found = network.leave(network.encoder(tokens)[:, 1:]).unflatten(2, (4, 2))
        return (mean + deviation * found).unflatten(0, (2, 2)).detach().numpy()

    np.testing.assert_allclose(prior.denoise(x_t, alpha_bar, cameras), denoise(x_t), atol=2e-5)
    step = 1e-6
    along = (denoise(x_t + step * u) - denoise(x_t - step * u)) / (2 * step)
    factor = (1 - alpha_bar) / math.sqrt(alpha_bar)
    axes = (1, 2, 3, 4)
    left, right = (product * u).sum(axis=axes), factor * (v * along).sum(axis=axes)
    np.testing.assert_allclose(left, right, rtol=1e-3)
    # View by view: a view's product knows nothing of the others.
    hidden = v.copy()
    hidden[:, 1] = 0
    alone = prior.view_covariance_product(x_t, alpha_bar, cameras, hidden)
    np.testing.assert_array_equal(alone[:, 1], 0)
    np.testing.assert_allclose(alone[:, 0], product[:, 0], atol=1e-6)
    with torch.no_grad():
        again = prior.view_covariance_product(x_t, alpha_bar, cameras, v)
    np.testing.assert_array_equal(again, product)


def test_other_lengths_share_the_network(prior):
    short = prior.of_length(5)
    assert (short.frames, short.dim, prior.frames) == (5, 60, 12)
    assert (short.fps, short.skeleton, short.scale) == (prior.fps, prior.skeleton, prior.scale)
    x_t = noisy(short)
    wanted = prior.denoise(x_t, 0.4, Cameras.ring(2))
    np.testing.assert_array_equal(short.denoise(x_t, 0.4, Cameras.ring(2)), wanted)
    for wrong in (1, 2.5):
        with pytest.raises(ValueError, match=r"frames must be an integer of at least 2, got .*"):
            prior.of_length(wrong)
    with pytest.raises(ValueError, match="frames must be at most 12, the longest motion, got 13"):
        prior.of_length(13)


def test_sizes_are_as_published():
    def parameters(size, joints):
        return sum(value.numel() for value in size.network(joints).parameters())

    width, forward = 512, 1024
    layer = 4 * (width**2 + width) + 2 * width * forward + width + forward + 4 * width
    ends = (32 * width + width) + (32 * width + 32) + 2 * (width**2 + width)
    assert parameters(DiffusionSettings.paper(), 16) == 6 * layer + ends
    # The authors' released code: 17.4 million for 16 joints.
    found = parameters(DiffusionSettings.reference_code(), 16)
    assert found == 8 * layer + ends
    assert found == pytest.approx(17.4e6, rel=0.01)
    assert DiffusionSettings.reference_code().schedule_power == 4
    assert parameters(DiffusionSettings.small(), 14) < 2e6
    assert parameters(DiffusionSettings.tiny(), 14) < 1e5


def test_fresh_weights_follow_the_seed_and_leave_torch_alone():
    torch.manual_seed(0)
    wanted = torch.rand(2)
    torch.manual_seed(0)
    first, second, other = TINY.network(4, 1), TINY.network(4, 1), TINY.network(4, 2)
    assert torch.equal(torch.rand(2), wanted)
    assert torch.equal(first.enter.weight, second.enter.weight)
    assert not torch.equal(first.enter.weight, other.enter.weight)


def trainee(frames=12, seed=0):
    keypoints = 0.3 * np.random.default_rng(seed).normal(size=(30, 4, 2))
    keypoints[:, 0] = 0
    track = KeypointTrack(keypoints, np.ones((30, 4)), BODY, 20.0, "clip/0")
    return DiffusionTrainee([track], [track], DiffusionSettings.tiny(frames))


def test_a_trained_prior_comes_back_from_its_folder_and_file(tmp_path):
    result = train(trainee(), TrainingSettings(steps=2, batch=2), tmp_path, progress=False)
    prior = MotionDiffusion.load(tmp_path)
    assert prior.card["step"] == 2
    assert prior.skeleton == BODY
    x_t = noisy(prior)
    wanted = prior.denoise(x_t, 0.4, Cameras.ring(2))
    again = MotionDiffusion.load(result.model, frames=7)
    assert again.frames == 7
    np.testing.assert_array_equal(again.denoise(x_t, 0.4, Cameras.ring(2)), wanted)


def test_what_cannot_be_loaded_is_said_in_a_sentence(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no checkpoint nothing, expected a file"):
        MotionDiffusion.load("nothing")
    with pytest.raises(FileNotFoundError, match="there is no checkpoint"):
        MotionDiffusion.load(tmp_path)
    made = trainee()
    tensors = made.network.state_dict()
    path = tmp_path / "a.safetensors"

    def saved(kind=KIND, settings=made.settings, weights=tensors):
        save_checkpoint(path, Checkpoint(kind, {"network": dict(settings)}, weights))

    saved(kind="evaluator")
    with pytest.raises(CheckpointError, match="holds a evaluator, expected a motion-diffusion"):
        MotionDiffusion.load(path)
    wider = made.settings | {"size": made.settings["size"] | {"width": 64}}
    saved(settings=wider)
    with pytest.raises(CheckpointError, match="holds weights of another network than its settings"):
        MotionDiffusion.load(path)
    saved(weights={name: value for name, value in tensors.items() if "enter" not in name})
    with pytest.raises(CheckpointError, match="holds weights of another network than its settings"):
        MotionDiffusion.load(path)
    saved(settings={"size": made.settings["size"]})
    with pytest.raises(CheckpointError, match="has settings that are no motion diffusion model's"):
        MotionDiffusion.load(path)
    saved()
    with pytest.raises(ValueError, match="frames must be at most 12, got 99"):
        MotionDiffusion.load(path, frames=99)
    with pytest.raises(ValueError, match="device must be cpu or cuda, got 'tpu'"):
        MotionDiffusion.load(path, device="tpu")


def test_bad_input_is_refused_in_a_sentence(prior):
    cameras = Cameras.ring(2)
    with pytest.raises(ValueError, match="x_t has 13 frames, expected at most 12"):
        prior.denoise(noisy(prior, L=13), 0.4, cameras)
    with pytest.raises(ValueError, match=r"x_t has shape \(2, 12, 4, 2\), expected"):
        prior.denoise(noisy(prior)[0], 0.4, cameras)
    broken = noisy(prior)
    broken[0, 0, 0, 0, 0] = np.nan
    with pytest.raises(
        ValueError, match="x_t must be finite, got 1 values that are NaN or infinite"
    ):
        prior.denoise(broken, 0.4, cameras)
    with pytest.raises(ValueError, match="vectors has shape"):
        prior.view_covariance_product(noisy(prior), 0.4, cameras, noisy(prior, B=2))
    point = Skeleton(["point"], [-1])
    with pytest.raises(ValueError, match=r"standards must have shape \(1, 2\), got \(4, 2\)"):
        MotionDiffusion(TINY.network(1), TINY, prior.standards, point, 20.0)
    for name, value in [("layers", 0), ("frames", 1), ("steps", 1), ("dropout", 1.0), ("width", 9)]:
        with pytest.raises(ValueError, match=f"^{name} is .*, expected"):
            replace(TINY, **{name: value})


@pytest.fixture(scope="module")
def gait():
    """The exact prior over gaits."""
    return load_problem("gait").posterior.prior


def pictures(gait, n, seed):
    """What the camera sees of n draws of the exact prior, metres."""
    motions = gait.sample(np.random.default_rng(seed), n)
    return CAMERA.project(motions.reshape(n, -1, 3))[0].reshape(*motions.shape[:-1], 2)


@pytest.fixture(scope="module")
def learnt(gait, tmp_path_factory):
    """A tiny network that saw 2000 projections for some ten seconds."""

    def tracks(n, seed):
        sure = np.ones((gait.frames, gait.skeleton.n_joints))
        return [
            KeypointTrack(seen, sure, gait.skeleton, gait.fps, f"{seed}-{number}/0")
            for number, seen in enumerate(pictures(gait, n, seed))
        ]

    made = DiffusionTrainee(
        tracks(2000, 1),
        tracks(50, 2),
        DiffusionSettings.tiny(gait.frames),
        augmentation=Augmentation.none(),
    )
    settings = TrainingSettings(
        steps=600, batch=32, learning_rate=4e-3, warmup=50, ema=0.99, checkpoint_every=600
    )
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = train(made, settings, tmp_path_factory.mktemp("gait"), progress=False)
    finally:
        torch.set_num_threads(before)
    return MotionDiffusion.load(result.model)


def per_frame_linear(seen, observed, deviation):
    """The best linear estimate of every frame from itself, by the moments of ``seen``, metres."""
    J = seen.shape[2]
    frames = seen.reshape(-1, 2 * J)
    mean, covariance = frames.mean(axis=0), np.cov(frames.T)
    gain = np.linalg.solve(covariance + deviation**2 * np.eye(2 * J), covariance)
    flat = observed.reshape(-1, 2 * J)
    return (mean + (flat - mean) @ gain).reshape(observed.shape)


@pytest.mark.slow
@pytest.mark.parametrize(("level", "share"), [(30, 0.9), (50, 0.65), (70, 0.55), (80, 0.55)])
def test_a_trained_network_approaches_the_exact_denoiser(gait, learnt, level, share):
    alpha_bar = float(learnt.settings.schedule.alpha_bar[level])
    clean = pictures(gait, 60, 3)
    noise = np.random.default_rng(level).standard_normal(clean.shape)
    x_t = math.sqrt(alpha_bar) * clean / learnt.scale + math.sqrt(1 - alpha_bar) * noise
    # The same noise in the exact prior's unit, which is another.
    deviation = math.sqrt((1 - alpha_bar) / alpha_bar) * learnt.scale
    same = 1 / (1 + (deviation / gait.scale) ** 2)
    observed = x_t / math.sqrt(alpha_bar) * learnt.scale
    exact = gait.denoise(math.sqrt(same) * observed[:, None] / gait.scale, same, CAMERA)[:, 0]
    exact *= gait.scale
    got = learnt.denoise(x_t[:, None], alpha_bar, CAMERA)[:, 0] * learnt.scale

    def error(estimate):
        return float(np.sqrt(((estimate - exact) ** 2).mean()))

    seen = pictures(gait, 500, 4)
    assert error(got) < 0.3 * error(seen.mean(axis=0))
    assert error(got) < share * error(per_frame_linear(seen, observed, deviation))


def test_without_noise_a_motion_is_its_own_estimate(prior):
    x = np.random.default_rng(0).standard_normal((2, 1, 5, prior.skeleton.n_joints, 2))
    np.testing.assert_array_equal(prior.denoise(x, 1.0, Cameras.ring(1)), x)
