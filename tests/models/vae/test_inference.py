"""Motion VAE encoder as inference network: bound, optimisation, draws and samplers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, Skeleton
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.latent.reduced_latent import ReducedLatent
from probmotion.models.vae.inference import VAEEncoder
from probmotion.models.vae.model import MotionVAEModel
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.rigid_paths import RigidPath
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.posteriors.protocols import InferenceNetwork
from probmotion.samplers import DVAEInference, Ensemble, MetropolisHastings
from probmotion.seeds import NormalStreams

ARM = Skeleton(["pelvis", "neck", "left_shoulder", "left_elbow"], [-1, 0, 1, 2])
REST = np.array([[0, 0, 0], [0, 0.5, 0], [0.2, 0, 0], [0.05, -0.3, 0]])
BODY = ArticulatedBody(ARM, REST)
SIZE = replace(MotionVAESettings.tiny(), frames=4, latent=2)
CAMERA = Cameras.around(np.array([0.4]), np.array([0.1]))


def fresh(size=SIZE):
    model = MotionVAEModel.of(size, BODY)
    with torch.no_grad():
        model.vae.bone_decoder.leave.weight.mul_(15)
    rigid = RigidPath.upright(BODY, size.frames)
    return MotionVAE(model.vae, model.pose, size, BODY, 20.0, rigid=rigid)


@pytest.fixture(scope="module")
def prior():
    return fresh()


def seen_of(prior, z=(0.7, -0.5), noise=0.03, camera=CAMERA, **options):
    motion = Motion(prior.motion(np.array(z)), ARM, 20.0)
    return Keypoints2D.observe(motion, camera, noise, seed=1, **options)


def inferred(prior, **options):
    return VAEEncoder().on(prior, seen_of(prior), **options)


def test_encoder_accepts_keypoints_of_one_view(prior):
    encoder = prior.inference_network
    assert isinstance(encoder, VAEEncoder)
    assert isinstance(encoder, InferenceNetwork)
    assert encoder.reads(seen_of(prior))
    assert not encoder.reads(seen_of(prior, camera=Cameras.ring(2)))
    assert not encoder.reads(Joints3D(np.zeros((4, 4, 3)), 0.1))
    assert not encoder.reads(None)


def test_loss_is_minus_the_bound_at_its_draw(prior):
    likelihood, inference = seen_of(prior), inferred(prior)
    mean, deviation = inference.mean.numpy(), np.exp(inference.log_deviation.numpy())
    z = mean + deviation * np.random.default_rng(4).standard_normal(2)
    data = likelihood.log_density(prior.motion(z))
    divergence = 0.5 * (deviation**2 + mean**2 - 1 - np.log(deviation**2)).sum()
    for weight in (0.0, 1.0, 0.5):
        found = inference.loss(np.random.default_rng(4), initial_entropy=True, latent_weight=weight)
        assert float(found) == pytest.approx(weight * divergence - data, rel=1e-10)


class RecordingEncoder(torch.nn.Module):
    """Encoder that records its inputs and returns N(0, 1)."""

    def encode(self, *given):
        self.inputs = [part.numpy() for part in given]
        return torch.zeros(1, 2), torch.zeros(1, 2)


def encoder_inputs(prior, likelihood, rigid):
    placed = prior.placed(rigid)
    placed.model.vae = RecordingEncoder()
    VAEEncoder().on(placed, likelihood)
    return placed.model.vae.inputs


def test_inputs_are_scaled_to_the_subject_s_distance(prior):
    """Inputs do not depend on focal length and distance of the camera."""
    rotation = np.diag([1.0, -1.0, -1.0])[None]
    far = Cameras(
        rotation, np.array([[0, 0, 9.0]]), np.array([700.0]), np.array([[320.0, 240.0]]), False
    )
    path = RigidPath(np.tile(np.eye(3), (4, 1, 1)), np.tile([0.3, 0.1, 4.0], (4, 1)))
    placed = prior.placed(path)
    motion = Motion(placed.motion(np.array([0.7, -0.5])), ARM, 20.0)
    hidden = np.zeros((4, 4), dtype=bool)
    hidden[1, 3] = True
    seen = Keypoints2D.observe(motion, far, 1e-6, seed=0, hidden=hidden)
    keypoints, confidence, rest = encoder_inputs(prior, seen, path)
    depth = 9.0 - motion.positions[..., 2:]
    slopes = motion.positions[..., :2] * [1, -1] / depth
    want = 5.0 * (slopes - slopes[:, :1])
    want[1, 3] = 0
    np.testing.assert_allclose(keypoints[0], want, atol=1e-5)
    np.testing.assert_array_equal(confidence[0], 1.0 - hidden)
    np.testing.assert_allclose(rest, BODY.rest_positions, atol=1e-6)


def test_joints_of_low_confidence_are_masked(prior):
    confidence = np.ones((1, 4, 4))
    confidence[0, 2, 1], confidence[0, 2, 2] = 0.2, 0.4
    sure = replace(seen_of(prior), confidence=confidence)
    for factor in (1.0, 3.0):
        some = replace(sure, confidence=factor * confidence)
        shown = encoder_inputs(prior, some, prior.rigid)[1]
        np.testing.assert_array_equal(shown[0], (confidence[0] > 0.3).astype(float))


def test_draws_follow_q_and_do_not_depend_on_the_batch(prior):
    inference = inferred(prior)

    def drawn(numbers):
        streams = NormalStreams.of_draws(0, [(0, number) for number in numbers])
        return inference.draw(streams, len(numbers))

    positions, theta = drawn(range(70))
    assert (positions.shape, theta.shape) == ((70, 4, 4, 3), (70, 2))
    np.testing.assert_allclose(positions, prior.motion(theta), atol=1e-12)
    some, some_theta = drawn([67, 3])
    np.testing.assert_array_equal(some_theta, theta[[67, 3]])
    np.testing.assert_array_equal(some, positions[[67, 3]])
    many = inference.draw(np.random.default_rng(0), 20_000)[1]
    deviation = np.exp(inference.log_deviation.numpy())
    error = 5 * deviation / math.sqrt(20_000)
    assert (np.abs(many.mean(axis=0) - inference.mean.numpy()) < error).all()
    assert (np.abs(many.std(axis=0) - deviation) < error).all()


def test_prediction_is_the_motion_at_the_mean_or_the_mean_motion(prior):
    inference = inferred(prior)
    still = inference.predict(np.random.default_rng(0), average=False)
    np.testing.assert_allclose(still, prior.motion(inference.mean.numpy()))
    mean = inference.predict(np.random.default_rng(0), average=True)
    draws = inference.draw(np.random.default_rng(0), 64)[0]
    np.testing.assert_allclose(mean, draws.mean(axis=0))


def test_optimisation_lowers_the_loss_and_leaves_the_prior_unchanged(prior):
    before = {name: value.clone() for name, value in prior.model.state_dict().items()}
    inference, untouched = inferred(prior), inferred(prior)

    def mean_loss():
        with torch.no_grad():
            return np.mean([float(inference.loss(np.random.default_rng(i))) for i in range(20)])

    # Start far from the encoder's estimate, which may be close to the optimum.
    with torch.no_grad():
        inference.mean += 2.0
    begun = mean_loss()
    adam = torch.optim.Adam(inference.parameters(), lr=0.05)
    for step in range(60):
        adam.zero_grad()
        inference.loss(np.random.default_rng(step)).backward()
        adam.step()
    assert mean_loss() < begun - 1
    for name, value in prior.model.state_dict().items():
        assert torch.equal(value, before[name])
    torch.testing.assert_close(inferred(prior).mean, untouched.mean, rtol=0, atol=0)


def test_optimisation_agrees_with_the_posterior(prior):
    """With informative observations the posterior is nearly Gaussian."""
    posterior = MotionPosterior(prior, seen_of(prior))
    fit = DVAEInference(mode="optimization", iterations=150, learning_rate=0.05)
    found = fit.sample(posterior, draws=500, chains=1, seed=0, progress=False)
    exact = on_a_grid(posterior)
    theta = found.dataset["theta"].values.reshape(-1, 2)
    np.testing.assert_allclose(theta.mean(axis=0), exact[0], atol=0.35 * exact[1].min())
    assert (theta.std(axis=0) < 1.25 * exact[1]).all()
    assert (theta.std(axis=0) > 0.3 * exact[1]).all()


@pytest.mark.slow
def test_ensemble_and_mh_agree_with_the_reduced_posterior():
    """Two of five dimensions are kept."""
    whole = fresh(replace(SIZE, latent=5))
    reduced = ReducedLatent(whole, 2)
    posterior = MotionPosterior(reduced, seen_of(reduced))
    mean, deviation = on_a_grid(posterior)
    # The posterior is much narrower than the prior.
    assert deviation.max() < 0.5
    for sampler in (
        Ensemble(walkers=16, warmup=200, thin=10, candidates=16),
        MetropolisHastings(warmup=200, thin=5, candidates=16),
    ):
        draws = sampler.sample(posterior, draws=300, chains=2, seed=0, progress=False)
        theta = draws.dataset["theta"].values.reshape(-1, 2)
        np.testing.assert_allclose(draws.flat(), whole.motion(reduced.latent(theta)), atol=1e-12)
        np.testing.assert_allclose(theta.mean(axis=0), mean, atol=0.3 * deviation.min())
        np.testing.assert_allclose(theta.std(axis=0), deviation, rtol=0.3)


def on_a_grid(posterior):
    """Return mean and standard deviation of a 2D posterior by summation over a grid."""
    axis = np.linspace(-2.5, 2.5, 61)
    z = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    log_density = posterior.log_density(z)
    weight = np.exp(log_density - log_density.max())
    mean = np.average(z, axis=0, weights=weight)
    return mean, np.sqrt(np.average((z - mean) ** 2, axis=0, weights=weight))


def test_unsuitable_inputs_are_rejected(prior):
    hidden = np.zeros((4, 4), dtype=bool)
    hidden[3] = True
    longer = Motion(np.zeros((5, 4, 3)), ARM, 20.0)
    for given, likelihood, message in (
        ("prior", seen_of(prior), "prior must be a MotionVAE, got str"),
        (prior, seen_of(prior, hidden=hidden), "likelihood must have a visible joint per frame"),
        (prior, Keypoints2D.observe(longer, CAMERA, 0.1, seed=0), "the prior's 4 frames, got 5"),
    ):
        with pytest.raises(ValueError, match=message):
            VAEEncoder().on(given, likelihood)
