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

CPU = torch.device("cpu")
PERSON = Skeleton.preset("person14")
SIZE = replace(MotionVAESettings.tiny(), frames=8, mixed_precision=True)


@pytest.fixture(scope="module")
def tracks():
    """Return tracks of walks with missing detections."""
    clips = make_gaits(3, styles={"walk": 1.0}, frames=90, seed=1)
    return film_clips(clips, PERSON, 10.0, views=1, noise=DetectorNoise(share=0.1)).tracks


@pytest.fixture(scope="module")
def body(tracks):
    return ArticulatedBody(PERSON, estimate_rest_pose(tracks))


@pytest.fixture(scope="module")
def network(body):
    random_network = PoseNetwork(SIZE, PERSON.n_joints, len(body.bones), body.n_groups)
    with torch.no_grad():
        # Make the poses vary between frames and views.
        random_network.bone_decoder.leave.weight.mul_(20)
        random_network.rigid[-1].weight.mul_(20)
        random_network.log_lengths.weight.mul_(10)
    return random_network


@pytest.fixture
def trainee(tracks, network, body):
    return MotionVAETrainee(tracks, tracks, SIZE, body, network, distance=7.0)


def batches_of(tracks, **augmentation):
    return TrackBatches(tracks, SIZE.frames, 0.3, replace(Augmentation.none(), **augmentation))


def teacher_poses(network, body, batches):
    rest = torch.as_tensor(body.rest_positions, dtype=torch.float32)
    return TeacherForcedPoses(network, batches, rest)


@pytest.mark.parametrize("mirror", [False, True])
def test_poses_match_the_network_on_windows(tracks, network, body, mirror):
    batches = batches_of(tracks, mirror=mirror)
    drawn = batches.draw(np.random.default_rng(0), 12)
    # In training mode the network would use bfloat16.
    poses = teacher_poses(network.train(), body, batches).of(drawn)
    seen = torch.as_tensor(drawn.seen, dtype=torch.float32)
    rest = torch.as_tensor(body.rest_positions, dtype=torch.float32)
    with torch.no_grad():
        direct = network.eval()(torch.as_tensor(drawn.keypoints), seen, rest)
    for name, values in vars(direct).items():
        torch.testing.assert_close(getattr(poses, name), values, rtol=1e-4, atol=1e-5, msg=name)
    assert direct.log_lengths.std() > 0.01


@pytest.mark.parametrize(("distance", "tolerance"), [(None, 1e-6), (7.0, 0.02)])
def test_scaled_poses_have_scaled_projections(tracks, network, body, distance, tolerance):
    batches = batches_of(tracks, scale=0.4)
    drawn = batches.draw(np.random.default_rng(0), 12)
    unscaled, scale = teacher_poses(network, body, batches).of(drawn), torch.as_tensor(drawn.scale)
    projections = []
    for poses in (scaled(unscaled, scale), unscaled):
        translation = torch.nn.functional.pad(poses.translation, (0, 1))
        positions = body.positions(poses.turns, poses.rotation, translation, poses.log_lengths)
        projections.append(project_to_image(positions, distance))
    expected = scale[:, None, None, None, None] * projections[1]
    assert (projections[0] - expected).abs().mean() < tolerance * expected.abs().mean()


def test_selected_view_does_not_depend_on_scale(tracks, trainee):
    trainee.size = replace(SIZE, lengths=100.0, smoothness=0.0, ranges=0.0)
    batches = batches_of(tracks)
    drawn = batches.draw(np.random.default_rng(0), 40)
    keypoints, seen, rest = trainee._inputs(drawn, CPU)
    unscaled = trainee._teacher_poses(batches, drawn, keypoints, seen, rest)
    scale = np.geomspace(0.05, 20, 40, dtype=np.float32)
    larger, log_scale = keypoints * torch.as_tensor(scale)[:, None, None, None], np.log(scale)
    poses = trainee._teacher_poses(batches, drawn._replace(scale=scale), larger, seen, rest)
    torch.testing.assert_close(poses.turns, unscaled.turns)
    torch.testing.assert_close(poses.rotation, unscaled.rotation)
    lengths = unscaled.log_lengths + torch.as_tensor(log_scale)[:, None]
    torch.testing.assert_close(poses.log_lengths, lengths)


def test_loss_ignores_autocast_of_the_trainer(trainee):
    networks = trainee.network.eval()
    expected = trainee.training_loss(networks, np.random.default_rng(0), 8, CPU)
    with torch.autocast("cpu", torch.bfloat16):
        direct = trainee.training_loss(networks, np.random.default_rng(0), 8, CPU)
    assert torch.equal(direct, expected)


def test_teacher_is_evaluated_once_per_frame(trainee, network):
    evaluated = []
    hook = network.register_forward_hook(lambda _, given, __: evaluated.append(len(given[0])))
    for step in range(2):
        trainee.training_loss(trainee.network, np.random.default_rng(step), 4, CPU)
        with torch.no_grad():
            trainee.validation_loss(trainee.network, CPU)
    hook.remove()
    frames = [len(batches.all_frames()[0]) for batches in (trainee.batches, trainee.held_out)]
    assert sum(evaluated) == sum(frames)


def test_shifted_or_padded_windows_are_rejected(tracks, network, body):
    long = TrackBatches(tracks, 99, 0.3, Augmentation.none())
    with pytest.raises(ValueError, match="drawn must not contain padded windows"):
        teacher_poses(network, body, long).of(long.draw(np.random.default_rng(0), 2))
    with pytest.raises(ValueError, match=r"must have shift=0 .* got 0\.1"):
        teacher_poses(network, body, batches_of(tracks, shift=0.1))
