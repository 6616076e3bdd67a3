"""The flow of 2D poses: its density is exact, whole, and that of what it learnt from."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion import seeds
from probmotion.models.evaluation.pose_flow import CouplingFlow, FlowSettings, PoseFlow
from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee, whole_poses
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
# One joint beside the root: a density over the plane.
POINT = Skeleton(["root", "tip"], [-1, 0])
SPOTS = np.array([[1.0, 0.5], [-1.0, 0.5], [0.4, -0.8], [-0.4, -0.8]])
SPREAD = 0.25


def shaken(flow: torch.nn.Module, size: float = 0.3) -> torch.nn.Module:
    """The flow with random weights in double precision: far from the identity it begins as."""
    generator = seeds.torch_generator(0, "shaken")
    with torch.no_grad():
        for weight in flow.parameters():
            weight += size * torch.randn(weight.shape, generator=generator)
    return flow.double()


def normal(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=seeds.torch_generator(1, "x"), dtype=torch.float64)


@pytest.mark.parametrize("dimensions", [2, 3, 7])
def test_the_log_determinant_is_the_jacobians(dimensions: int) -> None:
    flow = shaken(CouplingFlow(dimensions, couplings=5, width=8))
    x = normal(4, dimensions)
    _, found = flow(x)
    for point, value in zip(x, found, strict=True):
        jacobian = torch.autograd.functional.jacobian(lambda p: flow(p[None])[0][0], point)
        assert abs(torch.linalg.slogdet(jacobian).logabsdet - value) < 1e-10
    assert found.abs().min() > 1e-3


@pytest.mark.parametrize("dimensions", [2, 3, 7])
def test_the_inverse_comes_back(dimensions: int) -> None:
    flow = shaken(CouplingFlow(dimensions, couplings=5, width=8))
    x = normal(50, dimensions)
    z, _ = flow(x)
    assert (z - x).abs().max() > 0.5
    torch.testing.assert_close(flow.inverse(z), x, rtol=0, atol=1e-10)


@pytest.mark.parametrize("dimensions", [2, 3, 7])
def test_every_coordinate_depends_on_every_other(dimensions: int) -> None:
    """Couplings keep half of the coordinates; the permutations make all of them meet."""
    flow = shaken(CouplingFlow(dimensions, couplings=8, width=8))
    jacobian = torch.autograd.functional.jacobian(lambda p: flow(p[None])[0][0], normal(dimensions))
    assert jacobian.abs().min() > 0


def grid(n: int = 400, most: float = 4.0) -> tuple[torch.Tensor, float]:
    """Points of a square and the area of each."""
    axis = torch.linspace(-most, most, n, dtype=torch.float64)
    points = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(-1, 2)
    return points, float(axis[1] - axis[0]) ** 2


def poses_of(points: torch.Tensor) -> torch.Tensor:
    return torch.stack([torch.zeros_like(points), points], dim=1)


def test_the_density_integrates_to_one() -> None:
    data = seeds.generator(0, "data").normal([0.2, -0.1], [0.6, 0.3], (500, 2))
    flow = PoseFlow.of_poses(POINT, FlowSettings.tiny(), poses_of(torch.from_numpy(data)).numpy())
    shaken(flow, 0.15)
    points, area = grid(most=6.0)
    with torch.no_grad():
        density = flow.log_density(poses_of(points)).exp()
    assert abs(float(density.sum()) * area - 1) < 1e-3


def test_untrained_it_is_the_datas_gaussian_whatever_share_the_flow_has() -> None:
    """What the components leave over counts too: the density is one of whole poses."""
    rng = seeds.generator(0, "poses")
    poses = rng.normal(size=(400, 26)) @ (0.1 * rng.normal(size=(26, 26)))
    poses = np.insert(poses.reshape(400, 13, 2), 0, 0.0, axis=1)
    flat = poses[:, 1:].reshape(400, -1)
    for share in (0.5, 0.9, 1.0):
        settings = replace(FlowSettings.tiny(), share=share)
        flow = PoseFlow.of_poses(PERSON, settings, poses).double()
        covariance = np.cov(flat, rowvar=False, bias=True) + settings.blur**2 * np.eye(26)
        wanted = stats.multivariate_normal(flat.mean(0), covariance).logpdf(flat[:20])
        found = flow.log_density(torch.from_numpy(poses[:20])).detach()
        # The standards are kept in single precision.
        np.testing.assert_allclose(found, wanted, atol=1e-3)
    assert flow.components == 26


def mixture_tracks(seed: int, frames: int = 3000) -> list[KeypointTrack]:
    """Tracks whose tip is at one of four spots, a picture and its mirror image alike."""
    rng = seeds.generator(seed, "mixture")
    tip = SPOTS[rng.integers(4, size=frames)] + SPREAD * rng.normal(size=(frames, 2))
    keypoints = np.stack([np.zeros_like(tip), tip], axis=1)
    return [KeypointTrack(keypoints, np.ones((frames, 2)), POINT, 20.0, f"spots-{seed}/0")]


def mixture_log_density(tip: np.ndarray, spread: float) -> np.ndarray:
    parts = [stats.multivariate_normal(spot, spread**2).pdf(tip) for spot in SPOTS]
    return np.log(np.mean(parts, axis=0))


def test_it_learns_a_mixture(tmp_path: Path) -> None:
    """Divergence from the exact density: an untrained flow has 4 times as much."""
    settings = FlowSettings(couplings=5, width=32, blur=0.05)
    trainee = PoseFlowTrainee(mixture_tracks(0), mixture_tracks(1, 500), settings)
    blurred = math.hypot(SPREAD, settings.blur)
    rng = seeds.generator(2, "test")
    tip = mixture_tracks(3)[0].keypoints[:, 1] + settings.blur * rng.normal(size=(3000, 2))
    poses = poses_of(torch.from_numpy(tip).float())

    def divergence(flow: PoseFlow) -> float:
        with torch.no_grad():
            return float(
                (mixture_log_density(tip, blurred) - flow.log_density(poses).numpy()).mean()
            )

    before = divergence(trainee.network)
    run = TrainingSettings(
        steps=350, batch=128, learning_rate=5e-3, warmup=20, weight_decay=0.0, ema=0.98, clip=10.0
    )
    result = train(trainee, run, tmp_path, progress=False)
    flow = PoseFlow.load(result.model)
    assert before > 0.4
    assert -0.02 < divergence(flow) < before / 4
    points, area = grid()
    density = flow.log_density(poses_of(points.float())).exp().double()
    assert abs(float(density.sum()) * area - 1) < 1e-3
    # What was validated is what is loaded: blurred held-out poses, per coordinate.
    wanted = -float(mixture_log_density(tip, blurred).mean()) / 2
    assert abs(result.history[-1]["validation_loss"] - wanted) < 0.1


def test_whole_poses_are_centred_and_mirrored() -> None:
    rng = seeds.generator(0, "track")
    keypoints = rng.normal(size=(5, 14, 2))
    confidence = np.full((5, 14), 0.9)
    confidence[1, 3], confidence[2, 7], keypoints[2, 7] = 0.2, 0.0, np.nan
    track = KeypointTrack(keypoints, confidence, PERSON, 20.0, "a/0")
    poses = whole_poses([track], 0.3)
    assert poses.shape == (6, 14, 2)
    np.testing.assert_allclose(poses[:3], (keypoints - keypoints[:, :1])[[0, 3, 4]])
    assert (poses[:, 0] == 0).all()
    left, right = PERSON.index("left_knee"), PERSON.index("right_knee")
    np.testing.assert_array_equal(poses[3:, left], poses[:3, right] * [-1, 1])
    np.testing.assert_array_equal(poses[3:, 1], poses[:3, 1] * [-1, 1])
    assert len(whole_poses([track], 0.3, mirror=False)) == 3
    assert len(whole_poses([track], 0.0, mirror=False)) == 4


def test_losses_are_addressed_by_their_generator() -> None:
    trainee = PoseFlowTrainee(mixture_tracks(0, 100), mixture_tracks(1, 100), FlowSettings.tiny())
    cpu = torch.device("cpu")
    one, again, other = (
        trainee.training_loss(trainee.network, seeds.generator(0, k), 8, cpu).detach().item()
        for k in (1, 1, 2)
    )
    assert one == again != other
    assert trainee.validation_loss(trainee.network, cpu) == trainee.validation_loss(
        trainee.network, cpu
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"couplings": 0}, "couplings is 0"),
        ({"width": 1.5}, "width is 1.5"),
        ({"share": 0.0}, "share must be above 0 and at most 1, got 0.0"),
        ({"blur": -1.0}, "blur must be a number of at least 0, got -1.0"),
    ],
)
def test_bad_settings(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(FlowSettings(), **changes)


def test_bad_tracks(tmp_path: Path) -> None:
    good = mixture_tracks(0, 20)
    blind = [KeypointTrack(np.zeros((3, 2, 2)), np.full((3, 2), 0.1), POINT, 20.0, "dark")]
    other = [KeypointTrack(np.zeros((3, 14, 2)), np.ones((3, 14)), PERSON, 20.0, "person")]
    still = [KeypointTrack(np.zeros((3, 2, 2)), np.ones((3, 2)), POINT, 20.0, "still")]
    tiny = FlowSettings.tiny()
    for tracks, message in (
        ([], "tracks is empty"),
        (blind, "no frame with every joint at confidence 0.3 or more"),
        (good + other, "'person' with other joints, expected one skeleton"),
    ):
        with pytest.raises(ValueError, match=message):
            PoseFlowTrainee(tracks, good, tiny)
    with pytest.raises(ValueError, match="validation has another skeleton"):
        PoseFlowTrainee(good, other, tiny)
    with pytest.raises(ValueError, match="blur is 0"):
        PoseFlowTrainee(still, still, replace(tiny, blur=0.0))
    flow = PoseFlowTrainee(good, good, tiny).network
    with pytest.raises(ValueError, match=r"poses has shape \(2, 14, 2\)"):
        flow.log_density(torch.zeros(2, 14, 2))


def test_bad_checkpoints(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        PoseFlow.load(tmp_path / "missing.safetensors")
    trainee = PoseFlowTrainee(mixture_tracks(0, 20), mixture_tracks(1, 20), FlowSettings.tiny())
    path, weights = tmp_path / "flow.safetensors", trainee.network.state_dict()
    save_checkpoint(path, Checkpoint("other", {}, weights))
    with pytest.raises(CheckpointError, match="holds a other, expected a pose-flow"):
        PoseFlow.load(path)
    card = {"network": dict(trainee.settings) | {"size": {"couplings": 3, "width": 32}}}
    save_checkpoint(path, Checkpoint("pose-flow", card, weights))
    with pytest.raises(CheckpointError, match="weights of another network"):
        PoseFlow.load(path)
