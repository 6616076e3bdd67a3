"""Coordinates of poses: round trips, the base measure and speeds."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from probmotion.models.pose_pairs.pose_chart import PoseChart
from probmotion.motion.skeleton import Skeleton

PAIR = Skeleton.preset("pair17")
TRIO = Skeleton(["a", "a1", "a2", "b", "b1", "c", "c1", "c2"], [-1, 0, 1, -1, 3, -1, 5, 5])
ROD = Skeleton(["root", "tip"], [-1, 0])
ROD_SEED = np.array([[0.0, 0, 0], [0, 1, 0]])


def chart_of(skeleton):
    rng = np.random.default_rng(0)
    return PoseChart(0.3 * rng.standard_normal((skeleton.n_joints, 3)).cumsum(0), skeleton)


@pytest.mark.parametrize("skeleton", [PAIR, TRIO], ids=["pair", "trio"])
def test_coordinates_reproduce_poses(skeleton):
    chart = chart_of(skeleton)
    assert np.allclose(chart.positions(np.zeros(chart.dim)), chart.seed, atol=1e-14)
    poses = np.random.default_rng(1).standard_normal((3, 4, skeleton.n_joints, 3))
    theta = chart.coordinates(poses)
    assert theta.shape == (3, 4, chart.dim)
    assert np.allclose(chart.positions(theta), poses, atol=1e-12)
    # Rotations are below π, within the support of the measure.
    assert np.isfinite(chart.log_measure(theta)).all()
    pose = chart.seed.copy()
    pose[4] = 2 * pose[3] - pose[4]  # rotated by π
    assert np.allclose(chart.positions(chart.coordinates(pose)), pose, atol=1e-12)


def test_parameters_of_a_bone_rotate_it_with_its_descendants():
    chart = chart_of(PAIR)
    shoulder, elbow, wrist = (
        PAIR.index(f"person0:left_{name}") for name in ("shoulder", "elbow", "wrist")
    )
    theta = np.zeros(chart.dim)
    index = 12 + 3 * [joint for joint, _ in PAIR.bones].index(elbow)
    theta[index : index + 2] = 0.3, -0.4
    posed = chart.positions(theta)
    old, new = chart.seed[elbow] - chart.seed[shoulder], posed[elbow] - posed[shoulder]
    angle = np.arccos(old @ new / (np.linalg.norm(old) * np.linalg.norm(new)))
    assert angle == pytest.approx(0.5)
    assert np.linalg.norm(new) == pytest.approx(np.linalg.norm(old))
    forearm = chart.seed[wrist] - chart.seed[elbow]
    rotation, _ = Rotation.align_vectors([new, posed[wrist] - posed[elbow]], [old, forearm])
    assert rotation.magnitude() == pytest.approx(0.5)
    others = [j for j in range(PAIR.n_joints) if j not in (elbow, wrist)]
    assert np.allclose(posed[others], chart.seed[others])
    theta[:] = 0
    theta[index + 2] = np.log(1.1)
    longer = chart.positions(theta)
    assert np.allclose(longer[elbow] - longer[shoulder], 1.1 * old)
    assert np.allclose(longer[wrist] - longer[elbow], forearm)


def test_measure_is_normalised():
    """The factors are independent, so each is integrated with the others at 0."""
    chart = PoseChart(ROD_SEED, ROD, bone_noise=0.2, root_noise=0.7)
    log_peak = chart.log_measure(np.zeros(chart.dim))

    def density(index, radius):
        theta = np.zeros(chart.dim)
        theta[index] = radius
        return np.exp(chart.log_measure(theta) - log_peak)

    ball, _ = quad(lambda r: 4 * np.pi * r**2 * density(0, r), 0, np.pi)
    disc, _ = quad(lambda r: 2 * np.pi * r * density(6, r), 0, np.pi)
    translation, _ = quad(lambda x: density(3, x), -np.inf, np.inf)
    stretch, _ = quad(lambda x: density(8, x), -np.inf, np.inf)
    assert (translation, stretch) == pytest.approx(np.array([0.7, 0.2]) * np.sqrt(2 * np.pi))
    assert np.log(ball * disc * translation**3 * stretch) == pytest.approx(-log_peak, abs=1e-8)
    assert density(0, 3.2) == density(6, 3.2) == 0


def test_volume_is_that_of_the_positions():
    """For given rotations of the roots, positions are a bijection of the other coordinates."""
    chart = chart_of(PAIR)
    thetas = 0.4 * np.random.default_rng(4).standard_normal((3, chart.dim))
    thetas[0, :6] = 0
    thetas[2, :6] = thetas[1, :6]
    with jax.enable_x64(True):
        slopes = jax.vmap(jax.jacfwd(chart.positions))(jax.numpy.asarray(thetas))
    slopes = np.asarray(slopes).reshape(3, 3 * PAIR.n_joints, chart.dim)[..., 6:]
    ratios = chart.log_volume(thetas) - np.linalg.slogdet(slopes)[1]
    # Uniform densities of 32 directions and, at the identity, of two rotations.
    expected = -32 * np.log(4 * np.pi) - 2 * np.log(8 * np.pi**2)
    assert ratios[0] == pytest.approx(expected, abs=1e-9)
    assert ratios[1] == pytest.approx(ratios[2], abs=1e-9)
    assert chart.log_volume(np.full(chart.dim, 2.0)) == -np.inf


def test_array_libraries_agree():
    chart = chart_of(PAIR)
    theta = 0.4 * np.random.default_rng(2).standard_normal((5, chart.dim))
    expected = chart.positions(theta)
    assert np.allclose(chart.positions(torch.tensor(theta)).numpy(), expected, atol=1e-12)
    with jax.enable_x64(True):
        jitted = jax.jit(chart.positions)(jax.numpy.asarray(theta))
        assert np.allclose(np.asarray(jitted), expected, atol=1e-12)


def test_speeds_are_assigned_to_their_coordinates():
    chart = chart_of(PAIR)
    turn, stretch = np.random.default_rng(3).random((2, 7, PAIR.n_joints))
    speeds = chart.speeds(turn, stretch)
    assert speeds.shape == (7, chart.dim)
    root = PAIR.roots[1]
    assert np.array_equal(speeds[:, 3:6], turn[:, [root] * 3])
    assert np.array_equal(speeds[:, 9:12], stretch[:, [root] * 3])
    joint, parent = PAIR.bones[9]
    length = np.linalg.norm(chart.seed[joint] - chart.seed[parent])
    assert np.array_equal(speeds[:, 12 + 27 : 12 + 29], turn[:, [joint] * 2])
    assert np.allclose(speeds[:, 12 + 29], stretch[:, joint] / length**2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: PoseChart(np.zeros((2, 3)), ROD),
            "seed must have bones longer .*, got 0 m .* tip",
        ),
        (
            lambda: PoseChart(ROD_SEED, ROD).coordinates(np.zeros((2, 3))),
            "positions must have bones",
        ),
        (lambda: PoseChart(ROD_SEED, ROD, bone_noise=0), "bone_noise must be a finite number"),
        (lambda: chart_of(TRIO).positions(np.zeros(3)), "theta must have shape"),
    ],
)
def test_invalid_arguments_are_rejected(call, message):
    with pytest.raises(ValueError, match=message):
        call()
