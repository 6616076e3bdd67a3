"""Pose flow: exact normalised densities, and training on a known mixture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion import seeds
from probmotion.models.evaluation.pose_flow import CouplingFlow, FlowSettings, PoseFlow
from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee, fully_visible_poses
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
# With one joint besides the root, the density is that of a point in the plane.
POINT = Skeleton(["root", "tip"], [-1, 0])
CENTRES = np.array([[1.0, 0.5], [-1.0, 0.5], [0.4, -0.8], [-0.4, -0.8]])
SPREAD = 0.25
TINY = FlowSettings.tiny()


def perturbed(flow, size=0.3):
    """Return the flow with random weights in double precision."""
    generator = seeds.torch_generator(0, "shaken")
    with torch.no_grad():
        for weight in flow.parameters():
            weight += size * torch.randn(weight.shape, generator=generator)
    return flow.double()


@pytest.mark.parametrize("dimensions", [2, 3, 7])
def test_log_determinant_is_that_of_the_jacobian(dimensions):
    flow = perturbed(CouplingFlow(dimensions, couplings=8, width=8))
    x = torch.randn(4, dimensions, generator=seeds.torch_generator(1, "x"), dtype=torch.float64)
    _, log_determinant = flow(x)
    for point, value in zip(x, log_determinant, strict=True):
        jacobian = torch.autograd.functional.jacobian(lambda p: flow(p[None])[0][0], point)
        assert abs(torch.linalg.slogdet(jacobian).logabsdet - value) < 1e-10
        # Permutations mix all coordinates.
        assert jacobian.abs().min() > 0
    assert log_determinant.abs().min() > 1e-3


def poses_of(points):
    return torch.stack([torch.zeros_like(points), points], dim=1)


def test_density_integrates_to_one():
    data = seeds.generator(0, "data").normal([0.2, -0.1], [0.6, 0.3], (500, 2))
    flow = PoseFlow.of_poses(POINT, TINY, poses_of(torch.from_numpy(data)).numpy())
    flow = perturbed(flow, 0.15)
    axis = torch.linspace(-6, 6, 300, dtype=torch.float64)
    with torch.no_grad():
        density = flow.log_density(poses_of(torch.cartesian_prod(axis, axis))).exp()
    assert abs(float(density.sum()) * float(axis[1] - axis[0]) ** 2 - 1) < 1e-3


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_untrained_density_is_the_gaussian_of_the_data(share):
    """Principal components outside the flow contribute to the density."""
    rng = seeds.generator(0, "poses")
    poses = rng.normal(size=(400, 26)) @ (0.1 * rng.normal(size=(26, 26)))
    poses = np.insert(poses.reshape(400, 13, 2), 0, 0.0, axis=1)
    flat = poses[:, 1:].reshape(400, -1)
    settings = replace(TINY, share=share)
    flow = PoseFlow.of_poses(PERSON, settings, poses).double()
    covariance = np.cov(flat, rowvar=False, bias=True) + settings.blur**2 * np.eye(26)
    expected = stats.multivariate_normal(flat.mean(0), covariance).logpdf(flat[:20])
    density = flow.log_density(torch.from_numpy(poses[:20])).detach()
    # Buffers have single precision.
    np.testing.assert_allclose(density, expected, atol=1e-3)
    assert (flow.components == 26) == (share == 1.0)


def mixture_tracks(seed, frames=3000):
    """Return tracks with the tip at one of four spots, symmetric under mirroring."""
    rng = seeds.generator(seed, "mixture")
    tip = CENTRES[rng.integers(4, size=frames)] + SPREAD * rng.normal(size=(frames, 2))
    keypoints = np.stack([np.zeros_like(tip), tip], axis=1)
    return [KeypointTrack(keypoints, np.ones((frames, 2)), POINT, 20.0, f"spots-{seed}/0")]


def test_training_recovers_a_mixture(tmp_path):
    """The divergence from the exact density falls to less than a quarter."""
    settings = FlowSettings(couplings=5, width=32, blur=0.05)
    trainee = PoseFlowTrainee(mixture_tracks(0), mixture_tracks(1, 500), settings)
    variance = SPREAD**2 + settings.blur**2
    rng = seeds.generator(2, "test")
    tip = mixture_tracks(3)[0].keypoints[:, 1] + settings.blur * rng.normal(size=(3000, 2))
    parts = [stats.multivariate_normal(centre, variance).pdf(tip) for centre in CENTRES]
    exact = np.log(np.mean(parts, axis=0))
    poses = poses_of(torch.from_numpy(tip).float())

    @torch.no_grad()
    def divergence(flow):
        return float((exact - flow.log_density(poses).numpy()).mean())

    before = divergence(trainee.network)
    run = TrainingSettings(
        steps=300, batch=128, learning_rate=5e-3, warmup=20, weight_decay=0.0, ema=0.98, clip=10.0
    )
    result = train(trainee, run, tmp_path, progress=False)
    flow = PoseFlow.load(result.model)
    assert before > 0.4
    assert -0.02 < divergence(flow) < before / 4
    # The validation loss is the negative log density of blurred poses per coordinate.
    assert abs(result.history[-1]["validation_loss"] + exact.mean() / 2) < 0.1


def test_fully_visible_poses_are_centred_and_mirrored():
    keypoints = seeds.generator(0, "track").normal(size=(5, 14, 2))
    confidence = np.full((5, 14), 0.9)
    confidence[1, 3], confidence[2, 7], keypoints[2, 7] = 0.2, 0.0, np.nan
    track = KeypointTrack(keypoints, confidence, PERSON, 20.0, "a/0")
    poses = fully_visible_poses([track], 0.3)
    assert poses.shape == (6, 14, 2)
    np.testing.assert_allclose(poses[:3], (keypoints - keypoints[:, :1])[[0, 3, 4]])
    left, right = PERSON.index("left_knee"), PERSON.index("right_knee")
    np.testing.assert_array_equal(poses[3:, left], poses[:3, right] * [-1, 1])
    np.testing.assert_array_equal(poses[3:, 1], poses[:3, 1] * [-1, 1])
    assert len(fully_visible_poses([track], 0.0)) == 8


def test_losses_depend_on_their_generator_only():
    trainee = PoseFlowTrainee(mixture_tracks(0, 100), mixture_tracks(1, 100), TINY)
    cpu = torch.device("cpu")
    one, again, other = (
        trainee.training_loss(trainee.network, seeds.generator(0, k), 8, cpu).item()
        for k in (1, 1, 2)
    )
    assert one == again != other
    first, second = (trainee.validation_loss(trainee.network, cpu) for _ in range(2))
    assert first == second
    with pytest.raises(ValueError, match=r"poses must have shape .* got \(2, 14, 2\)"):
        trainee.network.log_density(torch.zeros(2, 14, 2))


GOOD = mixture_tracks(0, 20)
OCCLUDED = [KeypointTrack(np.zeros((3, 2, 2)), np.full((3, 2), 0.1), POINT, 20.0, "dark")]
OTHER = [KeypointTrack(np.zeros((3, 14, 2)), np.ones((3, 14)), PERSON, 20.0, "person")]
STATIC = [KeypointTrack(np.zeros((3, 2, 2)), np.ones((3, 2)), POINT, 20.0, "still")]


@pytest.mark.parametrize(
    ("tracks", "validation", "message"),
    [
        ([], GOOD, "tracks must contain at least one track, got none"),
        (OCCLUDED, GOOD, "a frame with every joint at confidence 0.3 or more, got none"),
        (GOOD + OTHER, GOOD, "tracks must share one skeleton, got another in 'person'"),
        (GOOD, OTHER, "validation must have the skeleton of tracks, got joints"),
        (STATIC, STATIC, "blur must be larger for poses in a subspace, got 0"),
    ],
)
def test_invalid_input_is_rejected(tracks, validation, message):
    with pytest.raises(ValueError, match=message):
        PoseFlowTrainee(tracks, validation, replace(TINY, blur=0.0))
    with pytest.raises(ValueError, match="share must be above 0 and at most 1, got 0"):
        FlowSettings(share=0.0)
    with pytest.raises(ValueError, match="blur must be finite and at least 0, got -1"):
        FlowSettings(blur=-1.0)
