"""Inference from noisy joints on tiny networks: bounds, invariances, predictions, stitching."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion import Skeleton
from probmotion.models.bodies.body_states import BodyStates, turned_about_vertical
from probmotion.models.dvae.denoiser_training import DenoiserTrainee, usual_denoiser_training
from probmotion.models.dvae.inference import Denoiser, DenoisingNetworks
from probmotion.models.dvae.joint_noise import Noisy
from probmotion.models.dvae.motion_denoiser import KIND, MotionDenoiser
from probmotion.models.dvae.motion_dvae import MotionDVAE, description_of
from probmotion.models.dvae.motion_windows import Windows
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.noisy_windows import Stitching, windows_of
from probmotion.models.dvae.settings import DVAESettings
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

BODY = Skeleton(
    ["hips", "chest", "left_hand", "right_hand", "left_foot", "right_foot"], [-1, 0, 1, 1, 0, 0]
)
REST = np.array(
    [[0, 0, 0], [0, 0.5, 0], [0.4, 0.1, 0], [-0.4, 0.1, 0], [0.1, -0.8, 0], [-0.1, -0.8, 0]]
)
TINY = replace(DVAESettings.tiny(), frames=8, latent=3)
RANK, L, J = 4, 8, 6


def made_prior(seed=0):
    """A prior with fresh weights and made standards: bodies that stand, and move a little."""
    states = BodyStates(BODY, REST)
    model = DVAEModel(TINY, states.dim, J, RANK, seed)
    rng = np.random.default_rng(seed)
    mean = np.concatenate([[0, 0.9, 0], np.tile([1.0, 0, 0, 0, 1, 0], len(states.turning))])
    for name, value in (
        ("state_mean", mean),
        ("state_deviation", rng.uniform(0.1, 0.3, states.dim)),
        ("joint_mean", 0.1 * rng.normal(size=(J, 3))),
        ("joint_deviation", rng.uniform(0.2, 0.5, (J, 3))),
        ("initial_mean", mean),
        ("initial_factor", 0.1 * rng.normal(size=(states.dim, RANK))),
    ):
        getattr(model, name).copy_(torch.as_tensor(value))
    card = {"network": description_of(TINY, states, 30.0, RANK)}
    return MotionDVAE(model, TINY, states, 30.0, card=card)


@pytest.fixture(scope="module")
def prior():
    return made_prior()


class TinyDenoiser(MotionDenoiser):
    """Its windows are of 8 frames, fewer than what neighbours share by default."""

    def on(self, prior, likelihood, *, overlap=3, **options):
        return super().on(prior, likelihood, overlap=overlap, **options)


@pytest.fixture(scope="module")
def denoiser(prior):
    networks = DenoisingNetworks(prior, 1)
    # Fresh networks hardly read what they are shown: make it matter.
    with torch.no_grad():
        for part in (networks.first, networks.noise, networks.encoder.latents):
            part[-1].weight.mul_(2.0)
    return TinyDenoiser(
        networks, prior, {"network": {"prior_weights": weights_digest(prior.model)}}
    )


def clip(prior, frames=L, seed=2):
    return prior.of(frames=frames).sample(np.random.default_rng(seed), 1)[0]


def evidence_of(prior, freedom=None, frames=L, noise=0.05, seed=2, hide=0.25, place=None):
    """Noisy joints of a draw, trusted unevenly, some hidden (as NaN); ``place`` moves them."""
    rng = np.random.default_rng(seed)
    joints = clip(prior, frames, seed) + noise * rng.normal(size=(frames, J, 3))
    shares = [hide, *[(1 - hide) / 3] * 3]
    confidence = rng.choice([0.0, 0.5, 1.0, 2.0], (frames, J), p=shares)
    joints = joints if place is None else place(joints)
    joints[confidence == 0] = np.nan
    return Joints3D(joints, noise, confidence, freedom, BODY, 30.0)


def numbers(inference, n=1, seed=3):
    first, shape = inference.denoiser.noise_numbers(inference.stitching.length)
    rng = np.random.default_rng(seed)
    rows = n * len(inference.windows)
    drawn = rng.standard_normal((rows, first)), rng.standard_normal((rows, *shape))
    return [torch.tensor(part, dtype=torch.float32) for part in drawn]


def bound_of(inference, n=1, first=True):
    windows = inference.windows.repeated(n)
    with torch.no_grad():
        inferred = inference.denoiser.infer(windows, *numbers(inference, n))
        return inference.denoiser.bound(windows, inferred, first=first), inferred


def streams(n, start=0):
    return NormalStreams.of_draws(7, [(0, draw) for draw in range(start, start + n)])


@pytest.mark.parametrize("freedom", [None, math.inf, 1e5])
def test_the_data_term_is_the_likelihood_where_noise_is_gaussian(prior, denoiser, freedom):
    evidence = evidence_of(prior)
    bound, inferred = bound_of(denoiser.on(prior, evidence, degrees_of_freedom=freedom), 5)
    wanted = evidence.log_density(inferred.positions.double())
    torch.testing.assert_close(bound.data.double(), wanted, rtol=1e-4, atol=1e-2)
    assert torch.equal(bound.noise, torch.zeros(5))
    assert wanted.std() > 1


@pytest.mark.parametrize("freedom", [2.0, 4.0, 50.0])
def test_data_less_the_divergence_of_noise_is_the_student_t_at_most(prior, denoiser, freedom):
    evidence = evidence_of(prior, freedom)
    bound, inferred = bound_of(denoiser.on(prior, evidence), 5)
    wanted = evidence.log_density(inferred.positions.double())
    assert (bound.noise > 0).all()
    torch.testing.assert_close((bound.data - bound.noise).double(), wanted, rtol=1e-4, atol=1e-2)
    # Where e_b has learnt something else, q_γ is no longer the exact conditional.
    astray = denoiser.on(prior, evidence)
    with torch.no_grad():
        astray.denoiser.networks.noise[-1].bias.normal_(0, 0.3, generator=torch.Generator())
    lower, _ = bound_of(astray, 5)
    assert (lower.data - lower.noise < wanted - 1).all()
    # λ that the caller supposes goes before the evidence's own.
    other, _ = bound_of(denoiser.on(prior, evidence_of(prior), degrees_of_freedom=freedom), 5)
    torch.testing.assert_close(other.data, bound.data)
    torch.testing.assert_close(other.noise, bound.noise)


def test_the_bound_adds_up_and_leaves_out_what_is_asked(prior, denoiser):
    inference = denoiser.on(prior, evidence_of(prior, 4.0))
    bound, inferred = bound_of(inference, 5)
    assert torch.equal(bound.latents, inferred.rolled.kl)
    assert torch.equal(bound.first, inferred.first_kl)
    torch.testing.assert_close(
        bound.total(), bound.data - bound.latents - bound.noise - bound.first
    )
    torch.testing.assert_close(bound.total(0.0), bound.data - bound.noise - bound.first)
    without, _ = bound_of(inference, 5, first=False)
    torch.testing.assert_close(without.total(), bound.total() + bound.first)
    long = denoiser.on(prior, evidence_of(prior, frames=20), overlap=3)
    for entropy, weight in ((True, 1.0), (False, 0.3)):
        options = {"initial_entropy": entropy, "latent_weight": weight}
        parts = long.bound(np.random.default_rng(0), initial_entropy=entropy)
        assert parts.data.shape == (len(long.windows),) == (4,)
        loss = long.loss(np.random.default_rng(0), **options)
        torch.testing.assert_close(loss, -parts.total(weight).sum())


def test_the_first_frame_s_divergence_is_that_in_the_world(prior, denoiser):
    """E_q[log q − log p] of ground, heading and pose, by the change of variables to the world."""
    inference, n = denoiser.on(prior, evidence_of(prior)), 4000
    windows = inference.windows
    bound, inferred = bound_of(inference, n)
    first_noise = numbers(inference, n)[0].double().numpy()
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


@pytest.mark.parametrize(("freedom", "angle"), [(None, 2.1), (4.0, math.pi), (4.0, 2.1)])
def test_turning_and_moving_the_evidence_turns_and_moves_the_draws(prior, denoiser, freedom, angle):
    shift = np.array([4.0, 0.0, -7.0])

    def place(joints):
        return turned_about_vertical(joints, angle) + shift

    here = denoiser.on(prior, evidence_of(prior, freedom))
    there = denoiser.on(prior, evidence_of(prior, freedom, place=place))
    before, _ = bound_of(here, 5)
    after, _ = bound_of(there, 5)
    torch.testing.assert_close(after.latents, before.latents, rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(
        there.draw(streams(3), 3)[0], place(here.draw(streams(3), 3)[0]), atol=2e-5
    )
    # Student-t noise is of the world's axes, one by one: only half turns leave those alike.
    alike = freedom is None or angle == math.pi
    if alike:
        torch.testing.assert_close(after.data, before.data, rtol=1e-3, atol=2e-3)
    for average in (True, False) if alike else (False,):
        predicted = [
            inference.predict(np.random.default_rng(1), average=average)
            for inference in (here, there)
        ]
        np.testing.assert_allclose(predicted[1], place(predicted[0]), atol=1e-4)


@pytest.mark.parametrize("value", [1e6, -3.0])
def test_what_stands_where_joints_hide_does_not_matter(prior, denoiser, value):
    evidence = evidence_of(prior, 4.0)
    inference = denoiser.on(prior, evidence)
    joints = np.where(evidence.confidence[..., None] > 0, evidence.joints, value)
    other = denoiser.on(
        prior, Joints3D(joints, evidence.noise, evidence.confidence, 4.0, BODY, 30.0)
    )
    wanted = inference.draw(streams(3), 3)[0]
    np.testing.assert_array_equal(other.draw(streams(3), 3)[0], wanted)
    # Nor in the windows themselves, to values or gradients.
    seen = inference.windows.seen
    other.windows = replace(
        inference.windows,
        joints=torch.where(seen[..., None], inference.windows.joints, value),
        noise=torch.where(seen, inference.windows.noise, 7.0),
    )
    np.testing.assert_array_equal(other.draw(streams(3), 3)[0], wanted)
    gradients = []
    for some in (inference, other):
        weights = some.parameters()
        loss = some.loss(np.random.default_rng(0), initial_entropy=True, latent_weight=1.0)
        gradients.append([loss, *torch.autograd.grad(loss, weights)])
        assert all(torch.isfinite(part).all() for part in gradients[-1])
    for one, same in zip(*gradients, strict=True):
        torch.testing.assert_close(one, same, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(
        other.predict(np.random.default_rng(1)), inference.predict(np.random.default_rng(1))
    )


@pytest.mark.parametrize("frames", [L, 20])
def test_a_draw_does_not_depend_on_those_beside_it(prior, denoiser, frames):
    inference = denoiser.on(prior, evidence_of(prior, 4.0, frames), overlap=3)
    whole, theta = inference.draw(streams(70), 70)
    assert whole.shape == (70, frames, J, 3)
    before = torch.get_num_threads()
    try:
        for start, n, threads in ((0, 1, 1), (3, 1, 2), (60, 10, 1)):
            torch.set_num_threads(threads)
            some, its = inference.draw(streams(n, start), n)
            np.testing.assert_array_equal(some, whole[start : start + n])
            if theta is not None:
                np.testing.assert_array_equal(its, theta[start : start + n])
    finally:
        torch.set_num_threads(before)
    assert abs(whole[0] - whole[1]).max() > 1e-3


def test_theta_of_a_draw_makes_the_draw(prior, denoiser):
    inference = denoiser.on(prior, evidence_of(prior))
    positions, theta = inference.draw(streams(6), 6)
    assert theta.shape == (6, prior.dim)
    np.testing.assert_allclose(prior.motion(theta), positions, atol=2e-5)
    length = np.linalg.norm(theta[:, 2:4], axis=-1)
    assert length.std() > 0.1
    long = denoiser.on(prior.of(frames=20), evidence_of(prior, frames=20))
    assert long.draw(streams(2), 2)[1] is None


def test_nn_output_decodes_the_means_once(prior, denoiser):
    inference = denoiser.on(prior, evidence_of(prior, frames=20), overlap=3)
    first, noise = (torch.zeros_like(part) for part in numbers(inference))
    with torch.no_grad():
        inferred = inference.denoiser.infer(inference.windows, first, noise)
    wanted = Stitching(20, L, 3).mean(inferred.positions.double().numpy())
    found = inference.predict(np.random.default_rng(0), average=False)
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(
        inference.predict(np.random.default_rng(9), average=False), wanted
    )


def test_the_prediction_is_equation_11(prior, denoiser):
    """(v M_β(μ_x) + s² y)/(v + s²) over draws; M_β(μ_x) where nothing is seen; M_β(μ_ω) first."""
    evidence = evidence_of(prior)
    inference = denoiser.on(prior, evidence)
    rng = np.random.default_rng(4)
    drawn = [
        torch.tensor(rng.standard_normal(shape, dtype=np.float32))
        for shape in ((8, 3 + RANK), (8, L - 1, 3))
    ]
    with torch.no_grad():
        inferred = inference.denoiser.infer(inference.windows.repeated(8), *drawn)
    M = inferred.positions.double().numpy()
    v = np.where(evidence.confidence > 0, evidence.noise**2 / evidence.confidence.clip(1e-9), 1)
    v, s = v[..., None], prior.joint_scale
    y = np.where(evidence.confidence[..., None] > 0, evidence.joints, 0.0)
    between = (v * M + s**2 * y) / (v + s**2)
    wanted = np.where(evidence.confidence[..., None] > 0, between, M).mean(axis=0)
    wanted[0] = inference.predict(rng, average=False)[0]
    found = inference.predict(np.random.default_rng(4))
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    # Exact joints are kept; joints of which nothing is known are the decoder's.
    seen = evidence.confidence > 0
    seen[0] = False
    exact = replace(inference.windows, noise=1e-6 * inference.windows.noise)
    inference.windows = exact
    kept = inference.predict(np.random.default_rng(4))
    np.testing.assert_allclose(kept[seen], evidence.joints[seen], atol=1e-5)


def test_variances_are_drawn_from_what_the_network_says(prior, denoiser):
    inference = denoiser.on(prior, evidence_of(prior, 4.0))
    windows = inference.windows.repeated(2000)
    with torch.no_grad():
        once = inference.denoiser.infer(inference.windows, *numbers(inference))
        residual = inference.windows.joints - once.positions
        squares = (residual / inference.windows.noise[..., None]) ** 2
        shape = inference.denoiser.networks.noise_shape(
            once.hidden, once.observed, torch.tensor([2.0]), squares
        )
        alpha, beta = (part[0, 3, 2, 1].item() for part in shape)
        same = [part.repeat(2000, *[1] * (part.ndim - 1)) for part in numbers(inference)]
        inferred = inference.denoiser.infer(windows, *same)
        v = inference.denoiser.drawn_variance(windows, inferred, np.random.default_rng(0))
    unit = v[:, 3, 2, 1] / windows.noise[:, 3, 2] ** 2
    assert stats.kstest(unit, stats.invgamma(alpha, scale=beta).cdf).pvalue > 1e-4
    gaussian = denoiser.on(prior, evidence_of(prior)).windows
    with torch.no_grad():
        v = inference.denoiser.drawn_variance(gaussian, once, np.random.default_rng(0))
    torch.testing.assert_close(v, (gaussian.noise**2)[..., None].expand(1, L, J, 3))


@pytest.mark.parametrize("frames", [2, 5, 8, 9, 15, 33])
def test_motions_of_any_length(prior, denoiser, frames):
    body = prior.of(frames=frames, body=1.2 * REST)
    inference = denoiser.on(body, evidence_of(prior, 4.0, frames), overlap=3)
    assert len(inference.windows) == len(Stitching(frames, L, 3).starts)
    drawn, _ = inference.draw(streams(2), 2)
    assert drawn.shape == (2, frames, J, 3)
    for average in (True, False):
        found = inference.predict(np.random.default_rng(0), average=average)
        assert found.shape == (frames, J, 3)
        assert np.isfinite(found).all()
    if len(inference.windows) == 1:
        bones = np.linalg.norm(drawn[:, :, 2] - drawn[:, :, 1], axis=-1)
        np.testing.assert_allclose(bones, 1.2 * np.linalg.norm(REST[2]), rtol=1e-4)


def test_fitting_to_one_recording_helps_it_and_changes_no_other(prior, denoiser):
    before = copy.deepcopy(denoiser.networks.state_dict())
    inference = denoiser.on(prior, evidence_of(prior, 4.0))
    optimiser = torch.optim.Adam(inference.parameters(), lr=3e-3)
    options = {"initial_entropy": True, "latent_weight": 1.0}
    losses = []
    for step in range(40):
        loss = inference.loss(np.random.default_rng(step), **options)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert np.mean(losses[-10:]) < np.mean(losses[:10]) - 10
    for name, value in denoiser.networks.state_dict().items():
        assert torch.equal(value, before[name])
    assert not any(value.requires_grad for value in prior.model.parameters())
    assert np.isfinite(inference.predict(np.random.default_rng(0))).all()
    assert inference.draw(streams(2), 2)[0].shape == (2, L, J, 3)


@dataclass
class Recorded:
    """Noise that gives the same noisy joints whatever the clean ones are."""

    noisy: Noisy

    def apply(self, rng, joints, skeleton):
        return self.noisy


def recorded(prior, n=3):
    evidence = [evidence_of(prior, noise=0.02 + 0.02 * i, seed=i) for i in range(n)]
    seen = np.stack([some.confidence > 0 for some in evidence])
    noise = [
        some.noise / np.sqrt(np.where(see, some.confidence, 1.0))
        for some, see in zip(evidence, seen, strict=True)
    ]
    joints = np.stack([some.joints for some in evidence])
    return evidence, Recorded(Noisy(joints, np.stack(noise), seen, np.array([0.0, 0.25, 0.5])))


def test_training_sees_noisy_joints_alone(prior):
    """Other clean motions under the same noisy joints: the same loss and gradients, bit for bit.

    And it is that of an evidence object which knows nothing of clean motion.
    """
    evidence, noise = recorded(prior)
    clips = [Motion(clip(prior, 12, seed), BODY, 30.0, name=str(seed)) for seed in (5, 6)]
    trainee = DenoiserTrainee(clips, clips, prior, noise=noise, seed=3)
    bodies = np.broadcast_to(REST, (3, J, 3))
    rng = np.random.default_rng(7)
    losses = []
    for states in rng.normal(size=(2, 3, L, prior.states.dim)):
        loss = trainee._loss(
            trainee.network,
            Windows(states, bodies),
            np.random.default_rng(8),
            0.7,
            torch.device("cpu"),
        )
        losses.append([loss, *torch.autograd.grad(loss, list(trainee.network.parameters()))])
    for one, other in zip(*losses, strict=True):
        assert torch.equal(one, other)
    own = Denoiser(prior, trainee.network)
    rng = np.random.default_rng(8)
    rng.uniform(size=3), rng.normal(size=(3, 2))  # where the clean ones would have stood
    first = torch.tensor(rng.standard_normal((3, 3 + RANK), dtype=np.float32))
    later = torch.tensor(rng.standard_normal((3, L - 1, 3), dtype=np.float32))
    total = 0.0
    for i, some in enumerate(evidence):
        windows = windows_of(some, REST, BODY, Stitching(L, L, 3), [0.0, 0.25, 0.5][i])
        inferred = own.infer(windows, first[i : i + 1], later[i : i + 1])
        total += own.bound(windows, inferred, first=True).total(0.7)
    torch.testing.assert_close(losses[0][0], -total[0] / 3 / L, rtol=1e-5, atol=1e-5)


def test_noisy_joints_can_be_learnt_from_and_the_denoiser_comes_back(prior, tmp_path):
    clips = [Motion(clip(prior, 12, seed), BODY, 30.0, name=str(seed)) for seed in range(12)]
    trainee = DenoiserTrainee(clips[2:], clips[:2], prior, annealing=20, seed=3)
    kept = {name: value.clone() for name, value in prior.model.state_dict().items()}
    settings = TrainingSettings(
        steps=40, batch=16, learning_rate=3e-3, warmup=5, ema=0.9, checkpoint_every=20
    )
    with torch.no_grad():
        begun = trainee.validation_loss(trainee.network, torch.device("cpu"))
    result = train(trainee, settings, tmp_path, progress=False)
    assert result.history[-1]["validation_loss"] < 0.7 * begun
    for name, value in prior.model.state_dict().items():
        assert torch.equal(value, kept[name])
    found = MotionDenoiser.load(tmp_path, prior)
    found.save(tmp_path / "half.safetensors", half=True)
    half = MotionDenoiser.load(tmp_path / "half.safetensors", prior)
    drawn = [
        some.on(prior, evidence_of(prior), overlap=3).draw(streams(2), 2)[0]
        for some in (found, half)
    ]
    np.testing.assert_allclose(*drawn, atol=0.02)
    trainee.anneal(5)
    assert trainee._weight == pytest.approx(0.25)
    with pytest.raises(ValueError, match="size must be one of tiny, small, paper, got 'huge'"):
        usual_denoiser_training("huge")


def test_what_does_not_fit_is_refused_in_a_sentence(prior, denoiser, tmp_path):
    assert denoiser.reads(evidence_of(prior))
    assert not denoiser.reads(None)
    other = made_prior(seed=5)
    with pytest.raises(ValueError, match="prior is another one than the denoiser was trained besi"):
        denoiser.on(other, evidence_of(prior))
    with pytest.raises(
        ValueError, match=r"^prior must be the Motion-DVAE that the de, got NoneType"
    ):
        MotionDenoiser.load(tmp_path / "a.safetensors", None)
    for overlap, message in ((8, "8, expected less than the 8 frames of a wi"), (-1, "-1, expec")):
        with pytest.raises(ValueError, match=f"^overlap is {message}"):
            denoiser.on(prior, evidence_of(prior), overlap=overlap)
    evidence = evidence_of(prior, frames=30)
    confidence = evidence.confidence.copy()
    confidence[5:20] = 0
    hidden = Joints3D(evidence.joints, 0.05, confidence, None, BODY, 30.0)
    with pytest.raises(ValueError, match="with every joint hidden, expected at least one joint"):
        denoiser.on(prior.of(frames=30), hidden, overlap=3)
    path = tmp_path / "a.safetensors"
    denoiser.save(path)
    with pytest.raises(CheckpointError, match="is the denoiser of another prior than the one give"):
        MotionDenoiser.load(path, other)
    weights = denoiser.networks.state_dict()
    save_checkpoint(path, Checkpoint(KIND, {"network": {}}, weights))
    with pytest.raises(CheckpointError, match="has settings that are no denoiser's"):
        MotionDenoiser.load(path, prior)
    save_checkpoint(path, Checkpoint("motion-dvae", denoiser.card, weights))
    with pytest.raises(CheckpointError, match="holds a motion-dvae, expected a motion-denoiser"):
        MotionDenoiser.load(path, prior)
    nameless = MotionDenoiser(denoiser.networks, prior)
    with pytest.raises(ValueError, match="the denoiser has no card, expected one that was trained"):
        nameless.save(path)
