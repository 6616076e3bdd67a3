"""Motion VAE encoder as inference network: bound, optimisation, draws and samplers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, Skeleton
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.inference import VAEEncoder
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.network import MotionVAEModel
from probmotion.models.vae.rigid_paths import RigidPath
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.samplers import DVAEInference
from probmotion.seeds import NormalStreams

ARM = Skeleton(["pelvis", "neck", "left_shoulder", "left_elbow"], [-1, 0, 1, 2])
REST = np.array([[0, 0, 0], [0, 0.5, 0], [0.2, 0, 0], [0.05, -0.3, 0]])
BODY = ArticulatedBody(ARM, REST)
SIZE = replace(MotionVAESettings.tiny(), frames=4, latent=2)
CAMERA = Cameras.around(np.array([0.4]), np.array([0.1]))


@pytest.fixture(scope="module")
def prior():
    model = MotionVAEModel.of(SIZE, BODY)
    with torch.no_grad():
        model.vae.bone_decoder.leave.weight.mul_(15)
    rigid = RigidPath.upright(BODY, SIZE.frames)
    return MotionVAE(model.vae, model.pose, SIZE, BODY, 20.0, rigid=rigid)


@pytest.fixture
def inference(prior):
    return VAEEncoder().on(prior, observe(prior))


def observe(prior, z=(0.7, -0.5), noise=0.03, camera=CAMERA, **options):
    motion = Motion(prior.motion(np.array(z)), ARM, 20.0)
    return Keypoints2D.observe(motion, camera, noise, seed=1, **options)


def test_encoder_accepts_keypoints_of_one_view(prior):
    encoder = prior.inference_network
    assert isinstance(encoder, VAEEncoder)
    assert encoder.reads(observe(prior))
    for other in (None, Joints3D(np.zeros((4, 4, 3)), 0.1), observe(prior, camera=Cameras.ring(2))):
        assert not encoder.reads(other)


def test_loss_is_minus_the_bound_at_its_draw(prior, inference):
    mean, deviation = inference.mean.numpy(), np.exp(inference.log_deviation.numpy())
    z = mean + deviation * np.random.default_rng(4).standard_normal(2)
    data = observe(prior).log_density(prior.motion(z))
    divergence = 0.5 * (deviation**2 + mean**2 - 1 - np.log(deviation**2)).sum()
    for weight in (0.0, 1.0, 0.5):
        loss = inference.loss(np.random.default_rng(4), latent_weight=weight)
        assert float(loss) == pytest.approx(weight * divergence - data, rel=1e-10)


class RecordingEncoder(torch.nn.Module):
    """Encoder that records its inputs and returns N(0, 1)."""

    def encode(self, *given):
        self.inputs = [part.numpy() for part in given]
        return torch.zeros(1, 2), torch.zeros(1, 2)


def encoder_inputs(prior, likelihood, rigid):
    """Return keypoints, confidences and rest pose as passed to the encoder."""
    placed = prior.placed(rigid)
    placed.model.vae = RecordingEncoder()
    VAEEncoder().on(placed, likelihood)
    return placed.model.vae.inputs


def test_inputs_are_scaled_to_the_distance_of_the_subject(prior):
    """Inputs do not depend on focal length and distance of the camera."""
    rotation, centre = np.diag([1.0, -1.0, -1.0])[None], np.array([[320.0, 240.0]])
    camera = Cameras(rotation, np.array([[0, 0, 9.0]]), np.array([700.0]), centre, False)
    path = RigidPath(np.tile(np.eye(3), (4, 1, 1)), np.tile([0.3, 0.1, 4.0], (4, 1)))
    hidden = np.zeros((4, 4), dtype=bool)
    hidden[1, 3] = True
    likelihood = observe(prior.placed(path), noise=1e-6, camera=camera, hidden=hidden)
    keypoints, confidence, rest = encoder_inputs(prior, likelihood, path)
    positions = prior.placed(path).motion(np.array([0.7, -0.5]))
    slopes = positions[..., :2] * [1, -1] / (9.0 - positions[..., 2:])
    expected = 5.0 * (slopes - slopes[:, :1])
    expected[1, 3] = 0
    np.testing.assert_allclose(keypoints[0], expected, atol=1e-5)
    np.testing.assert_array_equal(confidence[0], 1.0 - hidden)
    np.testing.assert_allclose(rest, BODY.rest_positions, atol=1e-6)


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_joints_of_low_confidence_are_masked(prior, factor):
    confidence = np.ones((1, 4, 4))
    confidence[0, 2, 1], confidence[0, 2, 2] = 0.2, 0.4
    likelihood = replace(observe(prior), confidence=factor * confidence)
    passed = encoder_inputs(prior, likelihood, prior.rigid)[1]
    np.testing.assert_array_equal(passed[0], (confidence[0] > 0.3).astype(float))


def test_draws_follow_q_and_do_not_depend_on_the_batch(prior, inference):
    def draw(numbers):
        streams = NormalStreams.of_draws(0, [(0, number) for number in numbers])
        return inference.draw(streams, len(numbers))

    positions, theta = draw(range(70))
    np.testing.assert_allclose(positions, prior.motion(theta), atol=1e-12)
    part, part_theta = draw([67, 3])
    np.testing.assert_array_equal(part_theta, theta[[67, 3]])
    np.testing.assert_array_equal(part, positions[[67, 3]])
    draws = inference.draw(np.random.default_rng(0), 5000)[1]
    deviation = np.exp(inference.log_deviation.numpy())
    error = 5 * deviation / math.sqrt(5000)
    assert (np.abs(draws.mean(axis=0) - inference.mean.numpy()) < error).all()
    assert (np.abs(draws.std(axis=0) - deviation) < error).all()


def test_prediction_is_the_motion_at_the_mean_or_the_mean_motion(prior, inference):
    at_mean, mean = (
        inference.predict(np.random.default_rng(0), average=average) for average in (False, True)
    )
    np.testing.assert_allclose(at_mean, prior.motion(inference.mean.numpy()))
    draws = inference.draw(np.random.default_rng(0), 64)[0]
    np.testing.assert_allclose(mean, draws.mean(axis=0))


def test_optimisation_leaves_the_prior_unchanged(prior, inference):
    before = {name: value.clone() for name, value in prior.model.state_dict().items()}
    mean = inference.mean.clone()
    adam = torch.optim.Adam(inference.parameters(), lr=0.05)
    inference.loss(np.random.default_rng(0)).backward()
    adam.step()
    assert not torch.equal(inference.mean, mean)
    for name, value in prior.model.state_dict().items():
        assert torch.equal(value, before[name])
    assert torch.equal(VAEEncoder().on(prior, observe(prior)).mean, mean)


def test_optimisation_agrees_with_the_posterior(prior):
    """With informative observations the posterior is nearly Gaussian."""
    posterior = MotionPosterior(prior, observe(prior))
    sampler = DVAEInference(mode="optimization", iterations=120, learning_rate=0.07)
    draws = sampler.sample(posterior, draws=300, chains=1, seed=0, progress=False)
    mean, deviation = on_a_grid(posterior)
    theta = draws.dataset["theta"].values.reshape(-1, 2)
    np.testing.assert_allclose(theta.mean(axis=0), mean, atol=0.35 * deviation.min())
    assert (theta.std(axis=0) < 1.25 * deviation).all()
    assert (theta.std(axis=0) > 0.3 * deviation).all()


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
        ("prior", observe(prior), "prior must be a MotionVAE, got str"),
        (prior, observe(prior, hidden=hidden), "likelihood must have a visible joint per frame"),
        (prior, Keypoints2D.observe(longer, CAMERA, 0.1, seed=0), "the prior's 4 frames, got 5"),
    ):
        with pytest.raises(ValueError, match=message):
            VAEEncoder().on(given, likelihood)
