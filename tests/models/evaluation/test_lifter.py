"""The unsupervised lifter: its geometry is exact, each loss is what it says, and it learns."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from probmotion import seeds
from probmotion.data.projections import Filming, centre_motion, project_clips
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.geometry.cameras import Cameras
from probmotion.io.files import load_motion
from probmotion.models.evaluation import lifter_training
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
from probmotion.models.training.checkpoints import Checkpoint, CheckpointError, save_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
N, DISTANCE = 6, 7.0


def walks(n: int, frames: int = 40) -> list[Motion]:
    clips = make_gaits(n, styles={"walk": 1}, frames=frames, fps=20.0, seed=1)
    return [clip.retarget(PERSON) for clip in clips]


WALKS = walks(8, 20)
TRACKS = project_clips(WALKS[:6], views=4)
HELD_OUT = project_clips(WALKS[6:], views=4)


def fresh_lifter(size: float = 0.3) -> PoseLifter:
    """A lifter that says something about every pose, though nothing sensible."""
    network = LifterNetwork(LifterSettings.tiny(), 14, 0)
    generator = seeds.torch_generator(0, "shaken")
    with torch.no_grad():
        for weight in network.parameters():
            weight += size * torch.randn(weight.shape, generator=generator)
    return PoseLifter(network, PERSON)


def views(n: int = 3, frames: int = 5) -> np.ndarray:
    return 0.4 * seeds.generator(0, "views").normal(size=(n, frames, 14, 2))


def bodies() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Root-centred poses in the world, and azimuth and elevation of a camera for each."""
    rng = seeds.generator(0, "bodies")
    motion = centre_motion(WALKS[0])
    points = motion.positions[rng.integers(motion.frames, size=N)]
    numbers = (points, rng.uniform(0, 6.0, N), rng.uniform(0.05, 0.7, N))
    return tuple(torch.from_numpy(part) for part in numbers)  # type: ignore[return-value]


def seen_by(points: torch.Tensor, azimuth: torch.Tensor, elevation: torch.Tensor) -> torch.Tensor:
    """Pictures by the package's own cameras, one for each pose."""
    cameras = Cameras.around(
        azimuth.numpy(), elevation.numpy(), distance=DISTANCE, perspective=True
    )
    every = cameras.project(points[:, None].numpy())[:, :, 0]
    return torch.from_numpy(every[np.arange(len(points)), np.arange(len(points))])


def depths(points: torch.Tensor, azimuth: torch.Tensor, elevation: torch.Tensor) -> torch.Tensor:
    cameras = Cameras.around(azimuth.numpy(), elevation.numpy(), distance=DISTANCE)
    forward = torch.from_numpy(cameras.rotation[:, 2])
    return torch.einsum("njx,nx->nj", points, forward)


class Knowing(nn.Module):
    """A lifter that is told its answers, one for each time that it is asked."""

    def __init__(self, *answers: tuple[torch.Tensor, torch.Tensor]) -> None:
        super().__init__()
        self.answers = list(answers)

    def forward(self, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.answers.pop(0)


def flow() -> PoseFlow:
    trainee = PoseFlowTrainee(TRACKS, HELD_OUT, FlowSettings.tiny())
    return trainee.network.double().eval().requires_grad_(False)


def losses(
    first: tuple[torch.Tensor, torch.Tensor] | None = None,
    second: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> dict[str, torch.Tensor]:
    """Terms of the loss where a lifter knows the truth, but for the answers that are given."""
    points, azimuth, elevation = bodies()
    here, order = torch.zeros(N, dtype=torch.float64), torch.arange(N).roll(1)
    poses = seen_by(points, here, elevation)
    true = (depths(points, here, elevation), elevation)
    true_again = (depths(points, azimuth, elevation[order]), elevation[order])
    bones = torch.tensor(PERSON.bones)
    sizes = (points[:, bones[:, 0]] - points[:, bones[:, 1]]).norm(dim=-1).mean(dim=0)
    knowing = Knowing(first or true, second or true_again)
    return lifting_losses(knowing, flow(), poses, azimuth, order, sizes, DISTANCE)


def test_projection_is_the_cameras() -> None:
    points, azimuth, elevation = bodies()
    found = project_points(points, azimuth, elevation, DISTANCE)
    torch.testing.assert_close(found, seen_by(points, azimuth, elevation), rtol=0, atol=1e-12)


def test_raising_undoes_projection() -> None:
    points, azimuth, elevation = bodies()
    depth = depths(points, azimuth, elevation)
    pictures = project_points(points, azimuth, elevation, DISTANCE)
    found = raise_points(pictures, depth, azimuth, elevation, DISTANCE)
    torch.testing.assert_close(found, points, rtol=0, atol=1e-12)


def test_a_reflection_seen_from_below_makes_nearly_the_same_pictures() -> None:
    """Why cameras must stand above the horizon: from afar, nothing else tells the two apart."""
    points, azimuth, elevation = bodies()
    reflected = points * torch.tensor([1.0, 1.0, -1.0])
    for distance, least, most in ((1e6, 0.0, 1e-5), (7.0, 0.01, 0.2)):
        above = project_points(points, azimuth, elevation, distance)
        below = project_points(reflected, -azimuth, -elevation, distance)
        assert least <= (above - below).abs().max() < most


def test_a_lifted_motion_projects_onto_what_was_lifted() -> None:
    """Whatever the network says: depth moves joints along their rays alone."""
    lifter, given = fresh_lifter(), views()
    lifted = lifter.lift(given)
    assert lifted.shape == (3, 5, 14, 3)
    assert (lifted[:, :, 0] == 0).all()
    centred = given - given[:, :, :1]
    elevations = lifter.elevations(given)
    assert np.ptp(elevations) > 1e-4
    for motion, elevation, wanted in zip(lifted, elevations, centred, strict=True):
        camera = Cameras.around(
            np.zeros(1), elevation, distance=lifter.settings.distance, perspective=True
        )
        np.testing.assert_allclose(camera.project(motion)[0], wanted, atol=1e-12)
        assert np.abs(motion @ camera.rotation[0, 2]).max() > 0.05


def test_the_elevation_is_the_mean_over_the_frames() -> None:
    lifter, given = fresh_lifter(), views()
    alone = lifter.elevations(given.reshape(15, 1, 14, 2)).reshape(3, 5)
    np.testing.assert_allclose(lifter.elevations(given), alone.mean(axis=1), rtol=1e-12)
    assert alone.min() > 0
    assert alone.max() < lifter.settings.steepest


def test_motions_are_lifted_alike_alone_and_together() -> None:
    lifter, given = fresh_lifter(), views(80)
    together = lifter.lift(given)
    for row in (0, 41, 79):
        np.testing.assert_array_equal(lifter.lift(given[row : row + 1])[0], together[row])


def test_the_truth_costs_nothing() -> None:
    terms = losses()
    assert float(terms["points"]) < 1e-24
    assert float(terms["picture"]) < 1e-24
    # Gaits have constant bones, of one length in every frame.
    assert float(terms["bones"]) < 1e-24


def test_the_likelihood_is_the_flows_of_the_new_pictures() -> None:
    points, azimuth, elevation = bodies()
    pictures = seen_by(points, azimuth, elevation.roll(1))
    wanted = -flow().log_density(pictures).mean() / 26
    torch.testing.assert_close(losses()["likelihood"], wanted)


def test_lifting_otherwise_the_second_time_costs() -> None:
    points, azimuth, elevation = bodies()
    order = torch.arange(N).roll(1)
    depth = depths(points, azimuth, elevation[order])
    moved = depth.clone()
    moved[:, 3] += 0.2
    terms = losses(second=(moved, elevation[order]))
    # One joint of 14, moved 20 cm along its ray, which is a little longer than its depth.
    assert 0.04 / 14 <= float(terms["points"]) < 1.05 * 0.04 / 14
    assert 0 < float(terms["picture"]) < float(terms["points"])
    tilted = losses(second=(depth, elevation[order] + 0.1))
    assert float(tilted["points"]) > 1e-4
    assert float(tilted["picture"]) > 1e-4


def test_other_bones_cost() -> None:
    points, _, elevation = bodies()
    here = torch.zeros_like(elevation)
    flat = torch.zeros_like(depths(points, here, elevation))
    found = float(losses(first=(flat, elevation))["bones"])
    plane = seen_by(points, here, elevation).numpy()
    ratios = []
    for joint, parent in PERSON.bones:
        true = np.linalg.norm(points[0, joint] - points[0, parent])
        ratios.append(np.linalg.norm(plane[:, joint] - plane[:, parent], axis=-1) / true)
    assert abs(found - np.mean((np.array(ratios) - 1) ** 2)) < 1e-9
    assert found > 0.02


def test_bones_are_as_long_as_their_longest_pictures() -> None:
    """Rods that point everywhere on a level circle; the left one is seen half as often."""
    skeleton = Skeleton(["pelvis", "left_hip", "right_hip"], [-1, 0, 0])
    azimuth = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    rod = np.stack([0.3 * np.cos(azimuth), np.zeros(4000)], axis=-1)
    poses = np.stack([np.zeros_like(rod), rod, np.roll(rod, 7, axis=0)], axis=1)
    wanted = 0.3 * np.cos(0.05 * np.pi)
    np.testing.assert_allclose(bone_sizes(skeleton, poses), [wanted, wanted], rtol=1e-3)
    short = poses.copy()
    short[:, 1] *= 0.5
    left, right = bone_sizes(skeleton, short)
    assert left == right


def trainee(**changes: object) -> LifterTrainee:
    return LifterTrainee(TRACKS, HELD_OUT, flow().float(), LifterSettings.tiny(), **changes)


CPU = torch.device("cpu")


@pytest.mark.parametrize("term", ["likelihood", "points", "picture", "bones"])
def test_every_term_teaches(term: str) -> None:
    """With one weight alone, the loss is that term, and gradients reach every layer."""
    none = dict.fromkeys(("likelihood", "points", "picture", "bones"), 0.0)
    one = trainee(weights=LossWeights(**none | {term: 2.0}))
    loss = one.training_loss(one.network, seeds.generator(0, "step"), 16, CPU)
    loss.backward()
    for name, weight in one.network.named_parameters():
        if term != "bones" or not name.startswith("elevation"):
            assert weight.grad is not None, name
            assert weight.grad.abs().max() > 0, name
    half = trainee(weights=LossWeights(**none | {term: 1.0}))
    other = half.training_loss(half.network, seeds.generator(0, "step"), 16, CPU)
    torch.testing.assert_close(loss, 2 * other)


def test_training_sees_nothing_3d(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motions and cameras may break: tracks and a flow of tracks are all it has."""
    parameters = inspect.signature(LifterTrainee).parameters
    data = [name for name, value in parameters.items() if "Track" in str(value.annotation)]
    assert data == ["tracks", "validation"]
    assert not {"Motion", "Cameras"} & set(vars(lifter_training))

    def broken(*arguments: object, **named: object) -> None:
        raise AssertionError("a motion or camera was made in training")

    copies = [
        KeypointTrack(track.keypoints.copy(), track.confidence.copy(), PERSON, 20.0, track.name)
        for track in TRACKS
    ]
    wanted = trainee().training_loss(trainee().network, seeds.generator(0, 1), 16, CPU)
    monkeypatch.setattr(Motion, "__post_init__", broken)
    monkeypatch.setattr(Cameras, "__post_init__", broken)
    blind = LifterTrainee(copies, HELD_OUT, flow().float(), LifterSettings.tiny())
    found = blind.training_loss(blind.network, seeds.generator(0, 1), 16, CPU)
    assert float(found.detach()) == float(wanted.detach())
    assert np.isfinite(blind.validation_loss(blind.network.eval(), CPU))


def test_a_run_cannot_go_on_with_another_flow() -> None:
    other = flow().float()
    with torch.no_grad():
        other.mean += 0.01
    changed = LifterTrainee(TRACKS, HELD_OUT, other, LifterSettings.tiny())
    assert changed.settings["flow"] != trainee().settings["flow"] == trainee().settings["flow"]


def test_losses_are_addressed_by_their_generator() -> None:
    one = trainee()
    with torch.no_grad():
        found = [
            float(one.training_loss(one.network, seeds.generator(0, k), 8, CPU)) for k in (1, 1, 2)
        ]
    assert found[0] == found[1] != found[2]


def depth_error(lifter: PoseLifter, motion: Motion) -> tuple[float, float, float, float]:
    """Mean errors of joints, metres, of a motion lifted from 8 views and of flat ones, of the
    elevation, radians, and the share of depths of at least 5 cm that have the true sign."""
    errors, flat, tilt, signs = [], [], [], []
    cameras = Filming().cameras(seeds.generator(0, "test"), 8)
    points = centre_motion(motion).positions
    pictures = cameras.project(points)
    lifted, elevations = lifter.lift(pictures), lifter.elevations(pictures)
    for view in range(8):
        there = Cameras.around(np.zeros(1), cameras.elevation[view]).rotation[0]
        supposed = Cameras.around(np.zeros(1), elevations[view]).rotation[0]
        truth = points @ cameras.rotation[view].T @ there
        board = pictures[view] @ supposed[:2]
        depth, true_depth = lifted[view] @ supposed[2], truth @ there[2]
        errors.append(np.linalg.norm(lifted[view] - truth, axis=-1).mean())
        flat.append(np.linalg.norm(board - truth, axis=-1).mean())
        tilt.append(abs(elevations[view] - cameras.elevation[view]))
        far = np.abs(true_depth) > 0.05
        signs.append((np.sign(depth) == np.sign(true_depth))[far].mean())
    return tuple(float(np.mean(part)) for part in (errors, flat, tilt, signs))  # type: ignore[return-value]


def learn(clips: list[Motion], folder: Path, steps: tuple[int, int], width: int) -> PoseLifter:
    """A lifter that has seen pictures of all clips but the last."""
    tracks = project_clips(clips[:-2], views=16)
    validation = project_clips(clips[-2:-1], views=16)
    common = {"weight_decay": 0.0, "ema": 0.98, "clip": 10.0, "warmup": 20, "learning_rate": 2e-3}
    learning = PoseFlowTrainee(tracks, validation, FlowSettings(couplings=4, width=width))
    run = TrainingSettings(steps=steps[0], batch=64, **common)
    known = PoseFlow.load(train(learning, run, folder / "flow", progress=False).model)
    lifting = LifterTrainee(tracks, validation, known, LifterSettings(width=width, blocks=1))
    run = TrainingSettings(steps=steps[1], batch=64, **common)
    return PoseLifter.load(train(lifting, run, folder / "lifter", progress=False).model)


def test_it_learns_depth_from_pictures_alone(tmp_path: Path) -> None:
    """A walk that it has not seen, nearer to the truth than a flat one, on the right side."""
    clips = walks(20)
    error, flat, tilt, signs = depth_error(learn(clips, tmp_path, (150, 250), 64), clips[-1])
    assert flat > 0.1
    assert error < 0.5 * flat
    assert tilt < 0.06
    assert signs > 0.9


@pytest.mark.slow
def test_it_learns_real_walks(tmp_path: Path, real_data: Path) -> None:
    """The last walk is of a performer whom it has not seen: both of his clips are held back."""
    paths = sorted((real_data / "deepmimic_human").glob("*walk*.npz"))
    paths += [real_data / "cmu_single" / f"cmu_02_0{take}.npz" for take in (1, 2)]
    clips = [load_motion(path, 20.0).retarget(PERSON) for path in paths]
    error, flat, tilt, signs = depth_error(learn(clips, tmp_path, (1000, 1500), 128), clips[-1])
    assert error < 0.6 * flat
    assert tilt < 0.05
    assert signs > 0.85


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "width is 0"),
        ({"deepest": 8.0}, "deepest must be below distance, 7.0, got 8.0"),
        ({"steepest": 1.6}, "steepest must be below pi/2, got 1.6"),
        ({"distance": -1.0}, "distance is -1.0"),
    ],
)
def test_bad_settings(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(LifterSettings(), **changes)
    with pytest.raises(ValueError, match="bones must be a number of at least 0, got -1"):
        LossWeights(bones=-1)


def test_bad_views_and_tracks() -> None:
    lifter = fresh_lifter()
    with pytest.raises(
        ValueError, match=r"views must have shape \(N, L, 14, 2\), got \(5, 14, 2\)"
    ):
        lifter.lift(views()[0])
    with pytest.raises(ValueError, match=r"views has shape .*, expected a motion and a frame"):
        lifter.lift(views()[:, :0])
    with pytest.raises(ValueError, match="views must be finite, got 1 values that are NaN"):
        lifter.lift(np.where(np.arange(420).reshape(3, 5, 14, 2) == 7, np.nan, views()))
    point = Skeleton(["root", "tip"], [-1, 0])
    other = [KeypointTrack(np.ones((3, 2, 2)), np.ones((3, 2)), point, 20.0, "point")]
    with pytest.raises(ValueError, match="validation has another skeleton"):
        LifterTrainee(TRACKS, other, flow(), LifterSettings.tiny())
    with pytest.raises(ValueError, match="flow has another skeleton"):
        LifterTrainee(other, other, flow(), LifterSettings.tiny())


def test_checkpoints(tmp_path: Path) -> None:
    path = tmp_path / "lifter.safetensors"
    made = trainee()
    card = {"network": dict(made.settings)}
    save_checkpoint(path, Checkpoint("pose-lifter", card, made.network.state_dict()))
    wanted = PoseLifter(made.network, PERSON).lift(views())
    np.testing.assert_array_equal(PoseLifter.load(path).lift(views()), wanted)
    save_checkpoint(path, Checkpoint("pose-flow", card, made.network.state_dict()))
    with pytest.raises(CheckpointError, match="holds a pose-flow, expected a pose-lifter"):
        PoseLifter.load(path)
    card["network"]["size"] = {"width": 32, "blocks": 1}
    save_checkpoint(path, Checkpoint("pose-lifter", card, made.network.state_dict()))
    with pytest.raises(CheckpointError, match="weights of another network"):
        PoseLifter.load(path)
