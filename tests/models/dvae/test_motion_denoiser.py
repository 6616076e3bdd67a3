"""Inference from noisy joints with random networks: bounds, invariances and predictions."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.denoiser_training import DenoiserTrainee, usual_denoiser_training
from probmotion.models.dvae.inference import DenoisingNetworks
from probmotion.models.dvae.joint_noise import NoisyJoints
from probmotion.models.dvae.motion_denoiser import KIND, MotionDenoiser
from probmotion.models.dvae.motion_windows import Windows
from probmotion.models.dvae.noisy_windows import Stitching
from probmotion.models.training.checkpoints import (
    Checkpoint,
    CheckpointError,
    save_checkpoint,
    weights_digest,
)
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import Motion
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.seeds import NormalStreams

RANK, L, J = 4, 8, 6


@pytest.fixture(scope="module")
def prior(make_prior):
    return make_prior(frames=L)


class TinyDenoiser(MotionDenoiser):
    """Denoiser with an overlap below its window of 8 frames by default."""

    def on(self, prior, likelihood, *, overlap=3, **options):
        return super().on(prior, likelihood, overlap=overlap, **options)


@pytest.fixture(scope="module")
def denoiser(prior):
    networks = DenoisingNetworks(prior, 1)
    # Increase the influence of the inputs on random networks.
    with torch.no_grad():
        for part in (networks.first, networks.noise, networks.encoder.latents):
            part[-1].weight.mul_(2.0)
    card = {"network": {"prior_weights": weights_digest(prior.model)}}
    return TinyDenoiser(networks, prior, card)


def observed(prior, freedom=None, frames=L, noise=0.05, transform=None):
    """Return noisy joints of a draw, some occluded (NaN), after ``transform``."""
    rng = np.random.default_rng(2)
    clip = prior.of(frames=frames).sample(np.random.default_rng(2), 1)[0]
    joints = clip + noise * rng.normal(size=(frames, J, 3))
    confidence = rng.choice([0.0, 0.5, 1.0, 2.0], (frames, J))
    joints = joints if transform is None else transform(joints)
    joints[confidence == 0] = np.nan
    return Joints3D(joints, noise, confidence, freedom, prior.skeleton, 30.0)


def normals(inference, n=1, seed=3):
    first, shape = inference.denoiser.noise_numbers(inference.stitching.length)
    rng = np.random.default_rng(seed)
    rows = n * len(inference.windows)
    drawn = rng.standard_normal((rows, first)), rng.standard_normal((rows, *shape))
    return [torch.tensor(part, dtype=torch.float32) for part in drawn]


def bound_of(inference, n=1):
    windows = inference.windows.repeated(n)
    with torch.no_grad():
        inferred = inference.denoiser.infer(windows, *normals(inference, n))
        return inference.denoiser.bound(windows, inferred, first=True), inferred


def streams(n, start=0):
    return NormalStreams.of_draws(7, [(0, draw) for draw in range(start, start + n)])


@pytest.mark.parametrize("freedom", [None, 1e5])
def test_data_term_is_the_likelihood_for_gaussian_noise(prior, denoiser, freedom):
    likelihood = observed(prior)
    bound, inferred = bound_of(denoiser.on(prior, likelihood, degrees_of_freedom=freedom), 5)
    expected = likelihood.log_density(inferred.positions.double())
    torch.testing.assert_close(bound.data.double(), expected, rtol=1e-4, atol=1e-2)
    assert torch.equal(bound.noise, torch.zeros(5))
    assert expected.std() > 1


@pytest.mark.parametrize("freedom", [2.0, 50.0])
def test_noise_bound_is_at_most_the_student_t_likelihood(prior, denoiser, freedom):
    likelihood = observed(prior, freedom)
    bound, inferred = bound_of(denoiser.on(prior, likelihood), 5)
    expected = likelihood.log_density(inferred.positions.double())
    assert (bound.noise > 0).all()
    torch.testing.assert_close((bound.data - bound.noise).double(), expected, rtol=1e-4, atol=1e-2)
    # With another network output, q_γ is not the exact conditional.
    other = denoiser.on(prior, likelihood)
    with torch.no_grad():
        other.denoiser.networks.noise[-1].bias.normal_(0, 0.3, generator=torch.Generator())
    lower, _ = bound_of(other, 5)
    assert (lower.data - lower.noise < expected - 1).all()
    # The argument overrides the likelihood's λ.
    other, _ = bound_of(denoiser.on(prior, observed(prior), degrees_of_freedom=freedom), 5)
    torch.testing.assert_close(other.data, bound.data)
    torch.testing.assert_close(other.noise, bound.noise)


def test_initial_divergence_matches_monte_carlo_in_world_coordinates(prior, denoiser):
    """The reference is E_q[log q − log p] of ground, heading and pose."""
    inference, n = denoiser.on(prior, observed(prior)), 4000
    windows = inference.windows
    bound, inferred = bound_of(inference, n)
    first_noise = normals(inference, n)[0].double().numpy()
    model = prior.model
    trust = torch.where(windows.seen, 1 / (1 + (windows.noise / 0.05) ** 2), 0.0)
    read = model.observed(windows.in_frame(windows.heading, windows.ground), trust, windows.tails)
    with torch.no_grad():
        _, log_scale = denoiser.networks.first_state(read)
    log_q = stats.norm.logpdf(first_noise) - log_scale.double().numpy()
    log_q[:, :2] -= math.log(0.1)
    log_q[:, 2] -= math.log(0.3)
    ground, pose = inferred.ground.numpy(), inferred.first.numpy()
    log_p = stats.norm.logpdf(ground, scale=prior.spread).sum(-1) - math.log(2 * math.pi)
    ratio = log_q.sum(-1) - log_p - stats.norm.logpdf(pose).sum(-1)
    error = ratio.std() / math.sqrt(n)
    assert float(bound.first[0]) == pytest.approx(ratio.mean(), abs=5 * error)
    assert bound.first.std() < 1e-5


@pytest.mark.parametrize(("freedom", "angle"), [(None, 2.1), (4.0, math.pi)])
def test_inference_is_equivariant(prior, denoiser, freedom, angle):
    """Student-t noise is per world axis and only invariant to half turns."""

    def transform(joints):
        return turned_about_vertical(joints, angle) + np.array([4.0, 0.0, -7.0])

    original = denoiser.on(prior, observed(prior, freedom))
    rotated = denoiser.on(prior, observed(prior, freedom, transform=transform))
    (before, _), (after, _) = bound_of(original, 5), bound_of(rotated, 5)
    torch.testing.assert_close(after.latents, before.latents, rtol=1e-3, atol=2e-3)
    torch.testing.assert_close(after.data, before.data, rtol=1e-3, atol=2e-3)
    draws, other = (inference.draw(streams(3), 3)[0] for inference in (original, rotated))
    np.testing.assert_allclose(other, transform(draws), atol=2e-5)
    for average in (True, False):
        predicted, other = (
            inference.predict(np.random.default_rng(1), average=average)
            for inference in (original, rotated)
        )
        np.testing.assert_allclose(other, transform(predicted), atol=1e-4)


def test_occluded_values_have_no_effect(prior, denoiser):
    inference, other = (denoiser.on(prior, observed(prior, 4.0)) for _ in range(2))
    windows = inference.windows
    other.windows = replace(
        windows,
        joints=torch.where(windows.seen[..., None], windows.joints, 1e6),
        noise=torch.where(windows.seen, windows.noise, 7.0),
    )
    results = []
    for run in (inference, other):
        weights = run.parameters()
        loss = run.loss(np.random.default_rng(0), initial_entropy=True, latent_weight=1.0)
        gradients = torch.autograd.grad(loss, weights)
        assert all(torch.isfinite(part).all() for part in gradients)
        draws, prediction = run.draw(streams(3), 3)[0], run.predict(np.random.default_rng(1))
        results.append([loss, *gradients, torch.tensor(draws), torch.tensor(prediction)])
    for one, same in zip(*results, strict=True):
        torch.testing.assert_close(one, same, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("frames", [L, 20])
def test_draws_do_not_depend_on_the_batch(prior, denoiser, frames):
    inference = denoiser.on(prior, observed(prior, 4.0, frames))
    batch, theta = inference.draw(streams(70), 70)
    assert batch.shape == (70, frames, J, 3)
    before = torch.get_num_threads()
    try:
        for start, n, threads in ((0, 1, 1), (3, 1, 2), (60, 10, 1)):
            torch.set_num_threads(threads)
            part, part_theta = inference.draw(streams(n, start), n)
            np.testing.assert_array_equal(part, batch[start : start + n])
            if theta is not None:
                np.testing.assert_array_equal(part_theta, theta[start : start + n])
    finally:
        torch.set_num_threads(before)
    assert abs(batch[0] - batch[1]).max() > 1e-3


def test_theta_reproduces_the_draw(prior, denoiser):
    positions, theta = denoiser.on(prior, observed(prior)).draw(streams(6), 6)
    assert theta.shape == (6, prior.dim)
    np.testing.assert_allclose(prior.motion(theta), positions, atol=2e-5)
    assert np.linalg.norm(theta[:, 2:4], axis=-1).std() > 0.1
    long = denoiser.on(prior.of(frames=20), observed(prior, frames=20))
    assert long.draw(streams(2), 2)[1] is None


def test_prediction_is_equation_11(prior, denoiser):
    """Mean of (v M_β(μ_x) + s² y)/(v + s²); M_β(μ_x) if occluded; M_β(μ_ω) in frame 0."""
    likelihood = observed(prior)
    inference = denoiser.on(prior, likelihood)
    rng = np.random.default_rng(4)
    drawn = [
        torch.tensor(rng.standard_normal(shape, dtype=np.float32))
        for shape in ((8, 3 + RANK), (8, L - 1, 3))
    ]
    with torch.no_grad():
        inferred = inference.denoiser.infer(inference.windows.repeated(8), *drawn)
    M, s = inferred.positions.double().numpy(), prior.joint_scale
    seen = likelihood.confidence > 0
    v = (likelihood.noise**2 / likelihood.confidence.clip(0.1))[..., None]
    y = np.where(seen[..., None], likelihood.joints, 0.0)
    expected = np.where(seen[..., None], (v * M + s**2 * y) / (v + s**2), M).mean(axis=0)
    expected[0] = inference.predict(rng, average=False)[0]
    np.testing.assert_allclose(inference.predict(np.random.default_rng(4)), expected, atol=1e-5)
    # Without noise the prediction equals the observed joints.
    inference.windows = replace(inference.windows, noise=1e-6 * inference.windows.noise)
    exact = inference.predict(np.random.default_rng(4))
    seen[0] = False
    np.testing.assert_allclose(exact[seen], likelihood.joints[seen], atol=1e-5)
    # Without averaging, the prediction decodes the means of q in every window.
    inference = denoiser.on(prior, observed(prior, frames=20))
    with torch.no_grad():
        zeros = (torch.zeros_like(part) for part in normals(inference))
        means = inference.denoiser.infer(inference.windows, *zeros).positions
    decoded = inference.predict(np.random.default_rng(0), average=False)
    np.testing.assert_array_equal(decoded, Stitching(20, L, 3).mean(means.double().numpy()))


def test_variances_follow_the_predicted_inverse_gamma(prior, denoiser):
    inference = denoiser.on(prior, observed(prior, 4.0))
    windows = inference.windows.repeated(2000)
    with torch.no_grad():
        once = inference.denoiser.infer(inference.windows, *normals(inference))
        residual = inference.windows.joints - once.positions
        squares = (residual / inference.windows.noise[..., None]) ** 2
        shape = inference.denoiser.networks.noise_shape(
            once.hidden, once.observed, torch.tensor([2.0]), squares
        )
        alpha, beta = (part[0, 3, 2, 1].item() for part in shape)
        same = [part.repeat(2000, *[1] * (part.ndim - 1)) for part in normals(inference)]
        inferred = inference.denoiser.infer(windows, *same)
        v = inference.denoiser.drawn_variance(windows, inferred, np.random.default_rng(0))
    unit = v[:, 3, 2, 1] / windows.noise[:, 3, 2] ** 2
    assert stats.kstest(unit, stats.invgamma(alpha, scale=beta).cdf).pvalue > 1e-4
    gaussian = denoiser.on(prior, observed(prior)).windows
    with torch.no_grad():
        v = inference.denoiser.drawn_variance(gaussian, once, np.random.default_rng(0))
    torch.testing.assert_close(v, (gaussian.noise**2)[..., None].expand(1, L, J, 3))


@pytest.fixture(scope="module")
def clips(prior):
    motions = prior.of(frames=12).sample(np.random.default_rng(5), 12)
    return [
        Motion(clip, prior.skeleton, 30.0, name=str(number)) for number, clip in enumerate(motions)
    ]


def test_training_loss_depends_only_on_noisy_joints(prior, clips):
    """Loss and gradients are bit-identical for other clean motion with the same noisy joints."""
    likelihood = observed(prior, noise=0.02)
    seen = np.stack([likelihood.confidence > 0] * 3)
    noisy = NoisyJoints(
        np.stack([likelihood.joints] * 3), 0.02 + 0 * seen, seen, np.zeros(3) + 0.25
    )
    trainee = DenoiserTrainee(clips, clips, prior, seed=3)
    trainee.noise = SimpleNamespace(apply=lambda rng, joints, skeleton: noisy)
    bodies = np.broadcast_to(prior.states.rest, (3, J, 3))
    weights = list(trainee.network.parameters())
    losses = []
    for states in np.random.default_rng(7).normal(size=(2, 3, L, prior.states.dim)):
        given = (Windows(states, bodies), np.random.default_rng(8), 0.7, torch.device("cpu"))
        loss = trainee._loss(trainee.network, *given)
        losses.append([loss, *torch.autograd.grad(loss, weights)])
    for one, other in zip(*losses, strict=True):
        assert torch.equal(one, other)


def test_training_lowers_the_loss_and_checkpoints_round_trip(prior, clips, tmp_path):
    trainee = DenoiserTrainee(clips[2:], clips[:2], prior, annealing=20, seed=3)
    weights = {name: value.clone() for name, value in prior.model.state_dict().items()}
    settings = TrainingSettings(
        steps=20, batch=16, learning_rate=5e-3, warmup=2, ema=0.8, checkpoint_every=20
    )
    with torch.no_grad():
        initial = trainee.validation_loss(trainee.network, torch.device("cpu"))
    result = train(trainee, settings, tmp_path, progress=False)
    assert result.history[-1]["validation_loss"] < 0.7 * initial
    for name, value in prior.model.state_dict().items():
        assert torch.equal(value, weights[name])
    loaded = MotionDenoiser.load(tmp_path, prior)
    loaded.save(tmp_path / "half.safetensors", half=True)
    half = MotionDenoiser.load(tmp_path / "half.safetensors", prior)
    draws = [
        net.on(prior, observed(prior), overlap=3).draw(streams(2), 2)[0] for net in (loaded, half)
    ]
    np.testing.assert_allclose(*draws, atol=0.02)
    trainee.anneal(5)
    assert trainee._weight == pytest.approx(0.25)
    with pytest.raises(ValueError, match="size must be one of tiny, small, paper, got 'huge'"):
        usual_denoiser_training("huge")


def test_invalid_inputs_are_rejected(prior, make_prior, denoiser, tmp_path):
    likelihood = observed(prior)
    assert denoiser.reads(likelihood)
    assert not denoiser.reads(None)
    other = make_prior(frames=L, seed=5)
    confidence = observed(prior, frames=30).confidence.copy()
    confidence[5:20] = 0
    empty = replace(observed(prior, frames=30), confidence=confidence)
    for given, seen, overlap, message in (
        (other, likelihood, 3, "prior must be the one that the denoiser was"),
        (None, likelihood, 3, "prior must be the denoiser's Motion-DVAE, got NoneType"),
        (prior, likelihood, 8, "overlap must be less than the denoiser's window of 8 frames"),
        (prior, likelihood, -1, "overlap must be an integer of at least 0, got -1"),
        (prior.of(frames=30), empty, 3, "every window of joints must have a visible joint"),
    ):
        with pytest.raises(ValueError, match=message):
            denoiser.on(given, seen, overlap=overlap)
    path = tmp_path / "a.safetensors"
    denoiser.save(path)
    with pytest.raises(CheckpointError, match="must be a denoiser of prior "):
        MotionDenoiser.load(path, other)
    weights = denoiser.networks.state_dict()
    save_checkpoint(path, Checkpoint(KIND, {"network": {}}, weights))
    with pytest.raises(CheckpointError, match="must contain valid motion-denoiser settings"):
        MotionDenoiser.load(path, prior)
    with pytest.raises(ValueError, match="denoiser must have a training record to be saved"):
        MotionDenoiser(denoiser.networks, prior).save(path)
