"""Third phase of the motion VAE: codes of the tracks and an encoder that knows its errors."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from probmotion.data.projections import DetectorNoise
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.tracks.learning import film_clips
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.code_fitting import EncodedWindows, EncoderTrainee, with_learnt_codes
from probmotion.models.vae.motion_vae import MotionVAE
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton

CPU = torch.device("cpu")
PERSON = Skeleton.preset("person14")
SIZE = replace(MotionVAESettings.tiny(), latent=3)


@pytest.fixture(scope="module")
def trainee():
    clips = make_gaits(4, styles={"walk": 1.0}, frames=60, seed=1)
    tracks = film_clips(clips, PERSON, 10.0, views=6, noise=DetectorNoise(share=0.05)).tracks
    body = ArticulatedBody(PERSON, estimate_rest_pose(tracks))
    poses = PoseNetwork(SIZE, PERSON.n_joints, len(body.bones), body.n_groups)
    learner = MotionVAETrainee(tracks, tracks, SIZE, body, poses, distance=7.0)
    with torch.no_grad():
        # Codes that matter, with a spread.
        learner.network.vae.bone_decoder.leave.weight.mul_(60)
        learner.network.vae.time_encoder.mean.weight.mul_(6)
        learner.network.vae.time_encoder.log_variance.bias.fill_(-3.0)
    return learner


@pytest.fixture(scope="module")
def windows(trainee):
    return EncodedWindows.of(trainee, trainee.network)


def test_deviation_is_that_of_decoded_keypoints(trainee, windows):
    assert len(windows.mean) == trainee.batches.description["frames"]
    assert 0.01 < windows.deviation < 1
    scaled = replace(windows, deviation=0.0)
    z, clean, seen = scaled.simulated(trainee.network, trainee.body, 7.0, rng(), 4000)
    other, noisy, _ = windows.simulated(trainee.network, trainee.body, 7.0, rng(), 4000)
    torch.testing.assert_close(z, other)
    apart = (noisy - clean)[seen > 0]
    # Every joint but the root has its own error and that of the root.
    share = 1 - float(seen[..., PERSON.roots[0]].sum() / seen.sum())
    expected = windows.deviation * math.sqrt(2 * share)
    assert float(apart.square().mean().sqrt()) == pytest.approx(expected, rel=0.02)
    assert (clean[seen == 0] == 0).all()
    assert (clean[..., PERSON.roots[0], :] == 0).all()


def rng():
    return np.random.default_rng(0)


def test_calibrated_encoder_covers_the_codes_that_it_is_shown(trainee, windows, tmp_path):
    prior = MotionVAE(
        trainee.network.vae,
        trainee.network.pose,
        SIZE,
        trainee.body,
        10.0,
        card={"network": trainee.settings},
    )
    settings = TrainingSettings(steps=400, batch=64, learning_rate=3e-3, ema=0.97, warmup=20)
    learn = partial(train, progress=False)
    learnt = with_learnt_codes(trainee, prior, settings, tmp_path, learn=learn)
    # The codes that the second calibration is shown, encoded by the first.
    first = EncoderTrainee(trainee, prior.model, windows).learnt(tmp_path / "0")
    windows = EncodedWindows.of(trainee, first)
    z, keypoints, seen = windows.simulated(prior.model, trainee.body, 7.0, rng(), 3000)
    rest = torch.as_tensor(trainee.body.rest_positions, dtype=torch.float32)
    shares, errors = [], []
    with torch.no_grad():
        for one in (prior, learnt):
            mean, log_variance = one.model.vae.encode(keypoints, seen, rest)
            deviation = (0.5 * log_variance).exp()
            shares.append(float(((z - mean).abs() < 1.645 * deviation).float().mean()))
            errors.append(float((z - mean).square().mean()))
    assert abs(shares[1] - 0.9) < 0.04 < abs(shares[0] - 0.9)
    assert errors[1] < errors[0]
    # The decoder is the same, and the mixture has the moments of the codes.
    codes = prior.initial(rng(), 5)
    np.testing.assert_array_equal(learnt.motion(codes), prior.motion(codes))
    drawn = learnt.initial(rng(), 20_000)
    np.testing.assert_allclose(drawn.mean(axis=0), windows.mean.mean(dim=0), atol=0.05)
    variance = windows.mean.var(dim=0) + windows.log_variance.exp().mean(dim=0)
    np.testing.assert_allclose(drawn.var(axis=0), variance, rtol=0.1)


def test_only_the_last_maps_are_learnt(trainee, windows):
    encoder = EncoderTrainee(trainee, trainee.network, windows)
    loss = encoder.training_loss(encoder.network, rng(), 8, CPU)
    loss.backward()
    learnt = {name for name, weights in encoder.network.named_parameters() if weights.requires_grad}
    assert learnt == {
        f"{part}.{name}" for part in ("mean", "log_variance") for name in ("weight", "bias")
    }
    with torch.no_grad():
        losses = [encoder.validation_loss(encoder.network, CPU) for _ in range(2)]
    assert losses[0] == losses[1]
