"""Coordinates of poses: round trips, the measure's total, steps that mean what they say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from probmotion.models.pose_pairs.pose_chart import PoseChart
from probmotion.motion.skeleton import Skeleton

PAIR = Skeleton.preset("pair17")
TRIO = Skeleton(
    ["a", "a1", "a2", "b", "b1", "c", "c1", "c2"],
    [-1, 0, 1, -1, 3, -1, 5, 5],
)


def seed_of(skeleton: Skeleton) -> np.ndarray:
    return 0.3 * np.random.default_rng(0).standard_normal((skeleton.n_joints, 3)).cumsum(0)


@pytest.mark.parametrize("skeleton", [PAIR, TRIO], ids=["pair", "trio"])
def test_the_state_has_the_papers_size_and_is_0_at_the_seed(skeleton):
    seed = seed_of(skeleton)
    chart = PoseChart(seed, skeleton)
    trees, joints = len(skeleton.roots), skeleton.n_joints
    assert chart.dim == 2 * 3 * trees + 3 * (joints - trees)
    assert np.allclose(chart.positions(np.zeros(chart.dim)), seed, atol=1e-14)
    if skeleton is PAIR:
        assert chart.dim == 108


@pytest.mark.parametrize("skeleton", [PAIR, TRIO], ids=["pair", "trio"])
def test_coordinates_reproduce_any_pose(skeleton):
    chart = PoseChart(seed_of(skeleton), skeleton)
    poses = np.random.default_rng(1).standard_normal((3, 4, skeleton.n_joints, 3))
    theta = chart.coordinates(poses)
    assert theta.shape == (3, 4, chart.dim)
    assert np.allclose(chart.positions(theta), poses, atol=1e-12)
    # Turns are the short way round, so that the measure gives every pose some density.
    assert np.isfinite(chart.log_measure(theta)).all()


def test_a_bone_turned_right_round_is_reached():
    chart = PoseChart(seed_of(TRIO), TRIO)
    pose = chart.seed.copy()
    pose[4] = 2 * pose[3] - pose[4]  # the only bone of its root, turned by π
    assert np.allclose(chart.positions(chart.coordinates(pose)), pose, atol=1e-12)


def test_a_bones_parameters_turn_it_and_what_hangs_from_it():
    chart = PoseChart(seed_of(PAIR), PAIR)
    elbow, wrist = PAIR.index("person0:left_elbow"), PAIR.index("person0:left_wrist")
    bone = [joint for joint, _ in PAIR.bones].index(elbow)
    theta = np.zeros(chart.dim)
    at = 12 + 3 * bone
    theta[at : at + 2] = 0.3, -0.4
    moved = chart.positions(theta)
    shoulder = PAIR.index("person0:left_shoulder")
    old, new = chart.seed[elbow] - chart.seed[shoulder], moved[elbow] - moved[shoulder]
    angle = np.arccos(old @ new / (np.linalg.norm(old) * np.linalg.norm(new)))
    assert angle == pytest.approx(0.5)
    assert np.linalg.norm(new) == pytest.approx(np.linalg.norm(old))
    turn, _ = Rotation.align_vectors(
        [new, moved[wrist] - moved[elbow]], [old, chart.seed[wrist] - chart.seed[elbow]]
    )
    assert turn.magnitude() == pytest.approx(0.5)
    others = [j for j in range(PAIR.n_joints) if j not in (elbow, wrist)]
    assert np.allclose(moved[others], chart.seed[others])
    theta[:] = 0
    theta[at + 2] = np.log(1.1)
    longer = chart.positions(theta)
    assert np.allclose(longer[elbow] - longer[shoulder], 1.1 * old)
    assert np.allclose(longer[wrist] - longer[elbow], chart.seed[wrist] - chart.seed[elbow])


def test_the_measure_is_normalised_in_each_kind_of_coordinate():
    """Its parts are independent: the integral over one kind, the others at 0, is their density."""
    one = Skeleton(["root", "tip"], [-1, 0])
    chart = PoseChart(np.array([[0.0, 0, 0], [0, 1, 0]]), one, bone_noise=0.2, root_noise=0.7)
    rest = chart.log_measure(np.zeros(chart.dim))

    def density(index, radius):
        theta = np.zeros(chart.dim)
        theta[index] = radius
        return np.exp(chart.log_measure(theta) - rest)

    ball, _ = quad(lambda r: 4 * np.pi * r**2 * density(0, r), 0, np.pi)
    disc, _ = quad(lambda r: 2 * np.pi * r * density(6, r), 0, np.pi)
    place = (0.7 * np.sqrt(2 * np.pi)) ** 3
    stretch = 0.2 * np.sqrt(2 * np.pi)
    assert np.log(ball * disc * place * stretch) == pytest.approx(-rest, abs=1e-8)
    assert density(0, 3.2) == 0
    assert density(6, 3.2) == 0


def test_the_measure_of_roots_is_uniform_over_rotations():
    """Its cosine-like density of the angle is that of SciPy's uniform rotations."""
    one = Skeleton(["root", "tip"], [-1, 0])
    chart = PoseChart(np.array([[0.0, 0, 0], [0, 1, 0]]), one)
    angles = Rotation.random(20_000, rng=np.random.default_rng(0)).magnitude()
    share = (angles < 1.5).mean()
    theta = np.zeros((400, chart.dim))
    theta[:, 0] = (np.arange(400) + 0.5) * np.pi / 400
    weight = theta[:, 0] ** 2 * np.exp(chart.log_measure(theta))
    expected = weight[theta[:, 0] < 1.5].sum() / weight.sum()
    assert abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / 20_000) + 2e-3


def test_torch_and_jax_agree():
    import jax
    import torch

    chart = PoseChart(seed_of(PAIR), PAIR)
    theta = 0.4 * np.random.default_rng(2).standard_normal((5, chart.dim))
    expected = chart.positions(theta)
    assert np.allclose(chart.positions(torch.tensor(theta)).numpy(), expected, atol=1e-12)
    with jax.enable_x64(True):
        jitted = jax.jit(chart.positions)(jax.numpy.asarray(theta))
        assert np.allclose(np.asarray(jitted), expected, atol=1e-12)


def test_speeds_are_those_of_the_quantities_that_coordinates_move():
    chart = PoseChart(seed_of(PAIR), PAIR)
    rng = np.random.default_rng(3)
    turn, stretch = rng.random((2, 7, PAIR.n_joints))
    speeds = chart.speeds(turn, stretch)
    assert speeds.shape == (7, chart.dim)
    root = PAIR.roots[1]
    assert np.array_equal(speeds[:, 3:6], turn[:, [root] * 3])
    assert np.array_equal(speeds[:, 9:12], stretch[:, [root] * 3])
    joint, parent = PAIR.bones[9]
    length = np.linalg.norm(chart.seed[joint] - chart.seed[parent])
    assert np.array_equal(speeds[:, 12 + 27 : 12 + 29], turn[:, [joint] * 2])
    assert np.allclose(speeds[:, 12 + 29], stretch[:, joint] / length**2)


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="seed has the bone to tip of length 0 m"):
        PoseChart(np.zeros((2, 3)), Skeleton(["root", "tip"], [-1, 0]))
    with pytest.raises(ValueError, match="bone_noise is 0"):
        PoseChart(seed_of(TRIO), TRIO, bone_noise=0)
    with pytest.raises(ValueError, match="theta has shape"):
        PoseChart(seed_of(TRIO), TRIO).positions(np.zeros(3))
