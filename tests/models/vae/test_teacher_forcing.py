"""Precomputed teacher poses equal those of the network on every window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion.data.projections import DetectorNoise
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.tracks.learning import film_clips
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.training.track_batches import Augmentation, TrackBatches
from probmotion.models.vae.losses import project_to_image
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.teacher_forcing import TeacherForcedPoses, scaled
from probmotion.models.vae.training import MotionVAETrainee
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
SIZE = replace(MotionVAESettings.tiny(), frames=8, mixed_precision=True)


@pytest.fixture(scope="module")
def tracks():
    """Walks with missing detections."""
    clips = make_gaits(3, styles={"walk": 1.0}, frames=90, seed=1)
    return film_clips(clips, PERSON, 10.0, views=1, noise=DetectorNoise(share=0.1)).tracks


@pytest.fixture(scope="module")
def body(tracks):
    return ArticulatedBody(PERSON, estimate_rest_pose(tracks))


@pytest.fixture(scope="module")
def rest(body):
    return torch.as_tensor(body.rest_positions, dtype=torch.float32)


@pytest.fixture(scope="module")
def network(body):
    found = PoseNetwork(SIZE, PERSON.n_joints, len(body.bones), body.n_groups)
    with torch.no_grad():
        # Poses that vary between frames and views.
        found.bone_decoder.leave.weight.mul_(20)
        found.rigid[-1].weight.mul_(20)
        found.log_lengths.weight.mul_(10)
    return found


def batches_of(tracks, **augmentation):
    return TrackBatches(tracks, SIZE.frames, 0.3, replace(Augmentation.none(), **augmentation))


@pytest.mark.parametrize("mirror", [False, True])
def test_poses_match_the_network_on_windows(tracks, network, rest, mirror):
    batches = batches_of(tracks, mirror=mirror)
    drawn = batches.draw(np.random.default_rng(0), 12)
    # In training mode the network would use bfloat16.
    found = TeacherForcedPoses(network.train(), batches, rest).of(drawn)
    seen = torch.as_tensor(drawn.seen, dtype=torch.float32)
    with torch.no_grad():
        direct = network.eval()(torch.as_tensor(drawn.keypoints), seen, rest)
    for name in ("rotation", "translation", "turns", "log_lengths"):
        torch.testing.assert_close(
            getattr(found, name), getattr(direct, name), rtol=1e-4, atol=1e-5, msg=name
        )
    assert direct.log_lengths.std() > 0.01


@pytest.mark.parametrize(("distance", "tolerance"), [(None, 1e-6), (7.0, 0.02)])
def test_scaled_poses_have_scaled_projections(tracks, network, rest, body, distance, tolerance):
    batches = batches_of(tracks, scale=0.4)
    drawn = batches.draw(np.random.default_rng(0), 12)
    every = TeacherForcedPoses(network, batches, rest).of(drawn)
    scale = torch.as_tensor(drawn.scale)
    assert scale.std() > 0.1
    projections = []
    for poses in (scaled(every, scale), every):
        moved = torch.nn.functional.pad(poses.translation, (0, 1))
        positions = body.positions(poses.turns, poses.rotation, moved, poses.log_lengths)
        projections.append(project_to_image(positions, distance))
    wanted = scale[:, None, None, None, None] * projections[1]
    size = wanted.abs().mean()
    assert (projections[0] - wanted).abs().mean() < tolerance * size


@pytest.mark.parametrize("lengths", [0.0, 100.0])
def test_selected_view_does_not_depend_on_scale(tracks, network, body, lengths):
    size = replace(SIZE, lengths=lengths, smoothness=0.0, ranges=0.0)
    trainee = MotionVAETrainee(tracks, tracks, size, body, network, distance=7.0)
    batches = batches_of(tracks)
    drawn = batches.draw(np.random.default_rng(0), 40)
    keypoints, seen, rest = trainee._inputs(drawn, torch.device("cpu"))
    plain = trainee._teacher_poses(batches, drawn, keypoints, seen, rest)
    larger = np.geomspace(0.05, 20, 40, dtype=np.float32)
    shown = keypoints * torch.as_tensor(larger)[:, None, None, None]
    found = trainee._teacher_poses(batches, drawn._replace(scale=larger), shown, seen, rest)
    torch.testing.assert_close(found.turns, plain.turns)
    torch.testing.assert_close(found.rotation, plain.rotation)
    torch.testing.assert_close(
        found.log_lengths, plain.log_lengths + torch.as_tensor(larger).log()[:, None]
    )


def test_loss_ignores_the_trainer_s_autocast(tracks, network, body):
    size = replace(SIZE, mixed_precision=False)
    trainee = MotionVAETrainee(tracks, tracks, size, body, network, distance=7.0)
    learner, n, device = trainee.network, 8, torch.device("cpu")
    plain = trainee._loss(learner, trainee.batches, np.random.default_rng(0), n, device)
    with torch.autocast("cpu", torch.bfloat16):
        direct = trainee.training_loss(learner, np.random.default_rng(0), n, device)
    torch.testing.assert_close(direct, plain, rtol=0, atol=0)


def test_teacher_is_evaluated_once_per_frame(tracks, network, body):
    trainee = MotionVAETrainee(tracks, tracks, SIZE, body, network, distance=7.0)
    direct = []
    network.register_forward_hook(lambda _, given, __: direct.append(len(given[0])))
    for step in range(3):
        rng = np.random.default_rng(step)
        trainee.training_loss(trainee.network, rng, 4, torch.device("cpu"))
        with torch.no_grad():
            trainee.validation_loss(trainee.network, torch.device("cpu"))
    assert sum(direct) == sum(
        len(batches.all_frames()[0]) for batches in (trainee.batches, trainee.held_out)
    )


def test_shifted_or_padded_windows_are_rejected(tracks, network, rest):
    long = TrackBatches(tracks, 99, 0.3, Augmentation.none())
    with pytest.raises(ValueError, match="drawn must not contain padded windows"):
        TeacherForcedPoses(network, long, rest).of(long.draw(np.random.default_rng(0), 2))
    with pytest.raises(ValueError, match=r"must have shift=0 .* got 0\.1"):
        TeacherForcedPoses(network, batches_of(tracks, shift=0.1), rest)
