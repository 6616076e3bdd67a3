"""Unsupervised lifter: projection geometry, loss terms and learning of depth."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import seeds
from probmotion.data.projections import Filming, centre_motion, project_clips
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.geometry.cameras import Cameras
from probmotion.models.evaluation.lifter import (
    LifterNetwork,
    LifterSettings,
    PoseLifter,
    project_points,
    raise_points,
)
from probmotion.models.evaluation.lifter_training import (
    LifterTrainee,
    LossWeights,
    bone_sizes,
    lifting_losses,
)
from probmotion.models.evaluation.pose_flow import FlowSettings, PoseFlow
from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee
from probmotion.models.training.checkpoints import Checkpoint, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
N, DISTANCE = 6, 7.0
CPU = torch.device("cpu")
TINY = LifterSettings.tiny()
ORDER = torch.arange(N).roll(1)


def walks(n, frames=40):
    clips = make_gaits(n, styles={"walk": 1}, frames=frames, fps=20.0, seed=1)
    return [clip.retarget(PERSON) for clip in clips]


WALKS = walks(8, 20)
TRACKS = project_clips(WALKS[:6], views=4)
HELD_OUT = project_clips(WALKS[6:], views=4)


@pytest.fixture(scope="module")
def flow():
    return PoseFlowTrainee(TRACKS, HELD_OUT, FlowSettings.tiny()).network


@pytest.fixture
def trainee(flow):
    return LifterTrainee(TRACKS, HELD_OUT, flow, LifterSettings.tiny())


@pytest.fixture(scope="module")
def lifter():
    """Lifter with random weights."""
    network = LifterNetwork(TINY, 14, 0)
    generator = seeds.torch_generator(0, "shaken")
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.3 * torch.randn(weight.shape, generator=generator)
    return PoseLifter(network, PERSON)


def views(n=3):
    return 0.4 * seeds.generator(0, "views").normal(size=(n, 5, 14, 2))


def perspective(points, azimuth, elevation):
    """Return projections by the package's cameras, one camera per pose."""
    cameras = Cameras.around(
        azimuth.numpy(), elevation.numpy(), distance=DISTANCE, perspective=True
    )
    projections = cameras.project(points[:, None].numpy())[:, :, 0]
    return torch.from_numpy(projections[np.arange(len(points)), np.arange(len(points))])


def depths(points, azimuth, elevation):
    cameras = Cameras.around(azimuth.numpy(), elevation.numpy(), distance=DISTANCE)
    return torch.einsum("njx,nx->nj", points, torch.from_numpy(cameras.rotation[:, 2]))


@pytest.fixture(scope="module")
def bodies():
    """Return root-centred 3D poses, and the azimuth and elevation of a camera for each."""
    rng = seeds.generator(0, "bodies")
    motion = centre_motion(WALKS[0])
    points = motion.positions[rng.integers(motion.frames, size=N)]
    parts = (points, rng.uniform(0, 6.0, N), rng.uniform(0.05, 0.7, N))
    return tuple(torch.from_numpy(part) for part in parts)


@pytest.fixture
def losses(bodies, flow):
    """Return a function for the loss terms of true outputs, except where replaced."""
    points, azimuth, elevation = bodies
    zero = torch.zeros(N, dtype=torch.float64)
    double = copy.deepcopy(flow).double().requires_grad_(False)
    bones = torch.tensor(PERSON.bones)
    sizes = (points[:, bones[:, 0]] - points[:, bones[:, 1]]).norm(dim=-1).mean(dim=0)

    def terms(first=None, second=None):
        first = first or (depths(points, zero, elevation), elevation)
        second = second or (depths(points, azimuth, elevation[ORDER]), elevation[ORDER])
        poses = perspective(points, zero, elevation)
        outputs = iter((first, second))
        return lifting_losses(
            lambda poses: next(outputs), double, poses, azimuth, ORDER, sizes, DISTANCE
        )

    return terms


def test_projection_matches_the_cameras_and_raising_inverts_it(bodies):
    points, azimuth, elevation = bodies
    poses = project_points(points, azimuth, elevation, DISTANCE)
    expected = perspective(points, azimuth, elevation)
    torch.testing.assert_close(poses, expected, rtol=0, atol=1e-12)
    depth = depths(points, azimuth, elevation)
    again = raise_points(poses, depth, azimuth, elevation, DISTANCE)
    torch.testing.assert_close(again, points, rtol=0, atol=1e-12)


def test_lifted_motions_project_onto_their_input(lifter):
    poses_2d = views()
    lifted, elevations = lifter.lift(poses_2d), lifter.elevations(poses_2d)
    assert lifted.shape == (3, 5, 14, 3)
    assert (lifted[:, :, 0] == 0).all()
    assert np.ptp(elevations) > 1e-4
    centred = poses_2d - poses_2d[:, :, :1]
    for motion, elevation, expected in zip(lifted, elevations, centred, strict=True):
        camera = Cameras.around(
            np.zeros(1), elevation, distance=lifter.settings.distance, perspective=True
        )
        np.testing.assert_allclose(camera.project(motion)[0], expected, atol=1e-12)
        assert np.abs(motion @ camera.rotation[0, 2]).max() > 0.05
    # The elevation is the mean over frames.
    single = lifter.elevations(poses_2d.reshape(15, 1, 14, 2)).reshape(3, 5)
    np.testing.assert_allclose(elevations, single.mean(axis=1), rtol=1e-12)
    assert 0 < single.min() < single.max() < lifter.settings.steepest


def test_lifting_does_not_depend_on_the_batch(lifter):
    poses_2d = views(80)
    lifted = lifter.lift(poses_2d)
    for row in (0, 41, 79):
        np.testing.assert_array_equal(lifter.lift(poses_2d[row : row + 1])[0], lifted[row])


def test_true_outputs_have_no_loss_except_the_likelihood(bodies, losses, flow):
    terms = losses()
    # Gaits have constant bone lengths.
    for name in ("points", "picture", "bones"):
        assert float(terms[name]) < 1e-24
    points, azimuth, elevation = bodies
    poses = perspective(points, azimuth, elevation[ORDER])
    log_density = copy.deepcopy(flow).double().log_density(poses)
    torch.testing.assert_close(terms["likelihood"], -log_density.detach().mean() / 26)


def test_inconsistent_second_lifting_has_a_loss(bodies, losses):
    points, azimuth, elevation = bodies
    depth = depths(points, azimuth, elevation[ORDER])
    shifted = depth.clone()
    shifted[:, 3] += 0.2
    terms = losses(second=(shifted, elevation[ORDER]))
    # One of 14 joints moves 20 cm in depth, slightly more along its ray.
    assert 0.04 / 14 <= float(terms["points"]) < 1.05 * 0.04 / 14
    assert 0 < float(terms["picture"]) < float(terms["points"])
    tilted = losses(second=(depth, elevation[ORDER] + 0.1))
    assert float(tilted["points"]) > 1e-4
    assert float(tilted["picture"]) > 1e-4


def test_bone_loss_is_the_squared_relative_error(bodies, losses):
    points, _, elevation = bodies
    flat = torch.zeros(N, 14, dtype=torch.float64)
    loss = float(losses(first=(flat, elevation))["bones"])
    plane = perspective(points, torch.zeros_like(elevation), elevation).numpy()
    ratios = []
    for joint, parent in PERSON.bones:
        true = np.linalg.norm(points[0, joint] - points[0, parent])
        ratios.append(np.linalg.norm(plane[:, joint] - plane[:, parent], axis=-1) / true)
    assert abs(loss - np.mean((np.array(ratios) - 1) ** 2)) < 1e-9
    assert loss > 0.02


def test_bone_sizes_are_quantiles_of_2d_lengths():
    """The rods point in all horizontal directions."""
    skeleton = Skeleton(["pelvis", "left_hip", "right_hip"], [-1, 0, 0])
    azimuth = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    rod = np.stack([0.3 * np.cos(azimuth), np.zeros(4000)], axis=-1)
    poses = np.stack([np.zeros_like(rod), rod, np.roll(rod, 7, axis=0)], axis=1)
    np.testing.assert_allclose(bone_sizes(skeleton, poses), 0.3 * np.cos(0.05 * np.pi), rtol=1e-3)
    poses[:, 1] *= 0.5
    left, right = bone_sizes(skeleton, poses)
    assert left == right


@pytest.mark.parametrize("term", ["likelihood", "points", "picture", "bones"])
def test_every_term_is_weighted_and_trains_every_layer(flow, term):
    weights = dict.fromkeys(("likelihood", "points", "picture", "bones"), 0.0)
    values = []
    for weight in (1.0, 2.0):
        loss_weights = LossWeights(**weights | {term: weight})
        trainee = LifterTrainee(TRACKS, HELD_OUT, flow, TINY, weights=loss_weights)
        loss = trainee.training_loss(trainee.network, seeds.generator(0, "step"), 16, CPU)
        loss.backward()
        values.append(loss.detach())
    torch.testing.assert_close(2 * values[0], values[1])
    for name, weight in trainee.network.named_parameters():
        if term != "bones" or not name.startswith("elevation"):
            assert weight.grad is not None, name
            assert weight.grad.abs().max() > 0, name


def test_losses_depend_on_their_generator_only(trainee):
    with torch.no_grad():
        one, again, other = (
            trainee.training_loss(trainee.network, seeds.generator(0, k), 8, CPU) for k in (1, 1, 2)
        )
        assert one == again != other
        values = [trainee.validation_loss(trainee.network, CPU) for _ in range(2)]
    assert values[0] == values[1]


def depth_error(lifter, motion):
    """Return means over 8 views: errors of lifted and of flat joints, metres, and of the elevation,
    radians; and the proportion of depths above 5 cm with the correct sign."""
    results = []
    cameras = Filming().cameras(seeds.generator(0, "test"), 8)
    points = centre_motion(motion).positions
    poses = cameras.project(points)
    for pose, lifted, elevation, rotation, true_elevation in zip(
        poses, lifter.lift(poses), lifter.elevations(poses), cameras.rotation, cameras.elevation,
        strict=True,
    ):  # fmt: skip
        level, estimated = Cameras.around(np.zeros(2), [true_elevation, elevation]).rotation
        truth = points @ rotation.T @ level
        depth, true_depth = lifted @ estimated[2], truth @ level[2]
        errors = np.stack([lifted, pose @ estimated[:2]]) - truth
        signs = (np.sign(depth) == np.sign(true_depth))[np.abs(true_depth) > 0.05].mean()
        distances = np.linalg.norm(errors, axis=-1).mean(axis=(1, 2))
        results.append((*distances, abs(elevation - true_elevation), signs))
    return np.mean(results, axis=0)


def test_depth_is_learnt_from_2d(tmp_path):
    """The lifter is trained on projections of all clips except the last two."""
    clips = walks(14)
    tracks = project_clips(clips[:-2], views=16)
    validation = project_clips(clips[-2:-1], views=16)
    run = TrainingSettings(
        steps=100, batch=64, weight_decay=0.0, ema=0.98, clip=10.0, warmup=20, learning_rate=2e-3
    )
    flow = PoseFlowTrainee(tracks, validation, FlowSettings(couplings=4, width=64))
    flow = PoseFlow.load(train(flow, run, tmp_path / "flow", progress=False).model)
    trainee = LifterTrainee(tracks, validation, flow, LifterSettings(width=64, blocks=1))
    assert trainee.settings["flow"] == flow.digest
    result = train(trainee, replace(run, steps=200), tmp_path / "lifter", progress=False)
    error, flat, tilt, signs = depth_error(PoseLifter.load(result.model), clips[-1])
    assert flat > 0.1
    assert error < 0.5 * flat
    assert tilt < 0.06
    assert signs > 0.9


POINT = Skeleton(["root", "tip"], [-1, 0])
OTHER = [KeypointTrack(np.ones((3, 2, 2)), np.ones((3, 2)), POINT, 20.0, "point")]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda lifter, flow: replace(TINY, deepest=8.0), "deepest must be below distance=7.0"),
        (lambda lifter, flow: replace(TINY, steepest=1.6), "steepest must be below pi/2, got 1.6"),
        (lambda lifter, flow: LossWeights(bones=-1), "bones must be a finite number of at least 0"),
        (lambda lifter, flow: lifter.lift(views()[0]), r"views must have shape .*got \(5, 14, 2\)"),
        (lambda lifter, flow: lifter.lift(views()[:, :0]), "views must contain a motion and a fr"),
        (lambda lifter, flow: lifter.lift(np.nan * views()), "views must be finite"),
        (lambda _, flow: LifterTrainee(TRACKS, OTHER, flow, TINY), "validation must have the"),
        (lambda _, flow: LifterTrainee(OTHER, OTHER, flow, TINY), "flow must have the skeleton"),
    ],
)
def test_invalid_input_is_rejected(lifter, flow, call, message):
    with pytest.raises(ValueError, match=message):
        call(lifter, flow)


def test_checkpoints_are_restored(trainee, tmp_path):
    path = tmp_path / "lifter.safetensors"
    weights = trainee.network.state_dict()
    save_checkpoint(path, Checkpoint("pose-lifter", {"network": trainee.settings}, weights))
    expected = PoseLifter(trainee.network, PERSON).lift(views())
    np.testing.assert_array_equal(PoseLifter.load(path).lift(views()), expected)
