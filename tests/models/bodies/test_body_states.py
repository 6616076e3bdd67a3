"""Pose vectors: round trips, rigid moves, headings and the effect of a bow on the hips."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import rotation_6d_to_matrix
from probmotion.models.bodies.body_states import (
    BodyStates,
    heading_of,
    rest_pose,
    to_world,
    turned_about_vertical,
)
from probmotion.models.dvae.motion_windows import canonical_windows
from probmotion.motion.kinematics import forward_kinematics

PERSON = Skeleton.preset("person14")
# The root is not the first joint, and two joints end trunks.
QUADRUPED = Skeleton.preset("apt36k17")


def joint(name):
    return PERSON.index(name)


def random_states(skeleton):
    rest = 0.3 * np.random.default_rng(0).normal(size=(skeleton.n_joints, 3))
    rest[list(skeleton.roots)] = 0
    return BodyStates(skeleton, rest)


@pytest.fixture(params=[PERSON, QUADRUPED], ids=["person", "quadruped"])
def states(request):
    return random_states(request.param)


def rigid(skeleton, body, spread):
    """Return the motion of a rigid body from random joint rotations."""
    rng = np.random.default_rng(1)
    shape = (7, skeleton.n_joints)
    turns = Rotation.from_rotvec(spread * rng.normal(size=(7 * skeleton.n_joints, 3)))
    matrices = turns.as_matrix().reshape(*shape, 3, 3)
    return forward_kinematics(skeleton, matrices, rng.normal(size=(7, 1, 3)), body)[0]


def about_vertical(angles):
    return Rotation.from_rotvec(np.outer(angles, [0, 1, 0])).as_matrix()


def gaits(style):
    clips = [make_gait(style, number, frames=40) for number in range(4)]
    return clips if "quadruped" in style else [clip.retarget(PERSON) for clip in clips]


def fitted(clips):
    skeleton = clips[0].skeleton
    return BodyStates(skeleton, rest_pose(skeleton, [clip.positions for clip in clips]))


@pytest.fixture(scope="module")
def walkers():
    """Return the states of the mean body, and walks."""
    clips = gaits("walk")
    return fitted(clips), clips


@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0])
@pytest.mark.parametrize("sizes", ["mean", "smaller", "per bone"])
def test_rigid_bodies_are_recovered_exactly(states, spread, sizes):
    skeleton = states.skeleton
    each = np.random.default_rng(2).uniform(0.6, 1.4, (skeleton.n_joints, 1))
    body = states.rest * {"mean": 1.0, "smaller": 0.6, "per bone": each}[sizes]
    positions = rigid(skeleton, body, spread)
    np.testing.assert_allclose(states.body(positions), body, atol=1e-9)
    x = states.states(positions, body)
    assert x.shape == (7, states.dim)
    np.testing.assert_allclose(states.positions(x, body), positions, atol=1e-9)
    np.testing.assert_allclose(states.states(states.positions(x, body), body), x, atol=1e-6)


def test_any_state_has_the_bone_lengths_of_the_body(states):
    x = np.random.default_rng(3).normal(size=(5, states.dim))
    lengths = np.random.default_rng(9).uniform(0.1, 0.9, states.skeleton.n_joints)
    body = states.of_lengths(lengths)
    positions = states.positions(x, body)
    np.testing.assert_allclose(positions[:, states.skeleton.roots[0]], x[:, :3], atol=1e-12)
    for joint, parent in states.skeleton.bones:
        bones = np.linalg.norm(positions[:, joint] - positions[:, parent], axis=-1)
        np.testing.assert_allclose(bones, lengths[joint], atol=1e-12)
        np.testing.assert_allclose(np.cross(body[joint], states.rest[joint]), 0, atol=1e-12)
        assert body[joint] @ states.rest[joint] > 0


@pytest.mark.parametrize(
    ("style", "bound"), [("walk", 1e-4), ("run", 1e-4), ("march", 1e-4), ("quadruped-walk", 3e-3)]
)
def test_gaits_are_recovered_closely_and_their_states_are_smooth(style, bound):
    """Trunks bend sideways slightly, which one rotation per joint only approximates."""
    clips = gaits(style)
    states = fitted(clips)
    for clip in clips:
        body = states.body(clip.positions)
        x = states.states(clip.positions, body)
        restored = states.positions(x, body)
        assert np.linalg.norm(restored - clip.positions, axis=-1).max() < bound
        assert style != "walk" or abs(np.diff(x[:, 3:], axis=0)).max() < 0.3


def test_bow_leaves_the_hips_in_place(walkers):
    """With a single rotation for hips and trunk, the hips would tilt as well."""
    rest = walkers[0].rest.copy()
    rest[[joint("left_hip"), joint("right_hip")], 1:] = 0
    states = BodyStates(PERSON, rest)
    identity = np.tile(np.eye(3), (1, PERSON.n_joints, 1, 1))
    upright, _ = forward_kinematics(PERSON, identity, np.zeros((1, 1, 3)), rest)
    upper = [j for j in range(14) if joint("neck") in (j, *PERSON.ancestors(j))]

    def error(turn):
        bowed = upright.copy()
        bowed[:, upper] = upright[:, upper] @ Rotation.from_rotvec(turn).as_matrix().T
        return abs(states.positions(states.states(bowed, rest), rest) - bowed).max()

    assert error([1.2, 0, 0]) < 1e-12
    # In sideways bends, the guide joint moves the hips slightly.
    assert 1e-4 < error([0, 0, 0.6]) < 5e-3


def test_canonical_windows_start_at_the_origin_and_preserve_the_pose(states):
    positions = rigid(states.skeleton, states.rest, 0.7) + np.array([3.0, 0.5, -2.0])
    x = states.states(positions, states.rest)
    canonical = canonical_windows(x[None])[0]
    np.testing.assert_allclose(canonical[0, [0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(canonical[:, 1], x[:, 1], atol=1e-12)
    assert heading_of(rotation_6d_to_matrix(canonical[0, 3:9])) == pytest.approx(0, abs=1e-12)
    np.testing.assert_array_equal(canonical[:, 9:], x[:, 9:])
    heading = heading_of(rotation_6d_to_matrix(x[0, 3:9]))
    world = to_world(states.positions(canonical, states.rest), heading, x[0, [0, 2]])
    np.testing.assert_allclose(world, positions, atol=1e-9)


def test_heading_is_the_closest_rotation_about_the_vertical():
    tilted = Rotation.random(20, rng=4).as_matrix()
    angles = np.linspace(-np.pi, np.pi, 2001)
    overlap = np.einsum("nij,kij->nk", tilted, about_vertical(angles))
    error = heading_of(tilted) - angles[overlap.argmax(1)]
    assert abs((error + np.pi) % (2 * np.pi) - np.pi).max() < 4e-3


def test_rotation_about_the_vertical_matches_scipy():
    rng = np.random.default_rng(5)
    positions, angle, ground = (rng.normal(size=s) for s in ((3, 4, 5, 3), 3, (3, 2)))
    expected = np.einsum("nij,nlkj->nlki", about_vertical(angle), positions)
    np.testing.assert_allclose(turned_about_vertical(positions, angle), expected, atol=1e-12)
    expected[..., [0, 2]] += ground[:, None, None]
    for library in (np.asarray, torch.tensor):
        world = np.asarray(to_world(library(positions), angle, ground))
        np.testing.assert_allclose(world, expected, atol=1e-12)


def test_positions_support_batches_torch_and_single_precision(states):
    rng = np.random.default_rng(6)
    x = rng.normal(size=(3, 5, states.dim))
    bodies = states.rest * rng.uniform(0.5, 1.5, (3, 1, 1))
    batch = states.positions(x, bodies)
    each = [states.positions(*pair) for pair in zip(x, bodies, strict=True)]
    np.testing.assert_allclose(batch, each, atol=1e-12)
    each = [states.positions(one, states.rest) for one in x]
    np.testing.assert_allclose(states.positions(x, states.rest), each)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-4)):
        for body in (bodies, torch.tensor(bodies, dtype=dtype)):
            got = states.positions(torch.tensor(x, dtype=dtype), body)
            assert got.dtype == dtype
            np.testing.assert_allclose(got.numpy(), batch, atol=tolerance)
    # The fast mode checks random projections of the outputs.
    point = torch.tensor(x[0, :1], requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: states.positions(x, states.rest), point, fast_mode=True
    )


def test_groups_locate_translation_orientation_and_rotations(states):
    assert [group[1:] for group in states.groups] == [(0, 3), (3, 9), (9, states.dim)]
    x = np.random.default_rng(8).normal(size=(1, states.dim))
    rotated = x.copy()
    rotation = Rotation.from_rotvec([0.2, 1.0, -0.4]).as_matrix()
    rotated[:, 3:9] = np.concatenate([rotation @ x[0, 3:6], rotation @ x[0, 6:9]])
    expected = (states.positions(x, states.rest) - x[0, :3]) @ rotation.T + x[0, :3]
    np.testing.assert_allclose(states.positions(rotated, states.rest), expected, atol=1e-12)


def test_rest_pose_is_upright_and_independent_of_the_heading(walkers):
    states, clips = walkers
    assert states.rest[joint("left_hip"), 0] > 0 > states.rest[joint("right_hip"), 0]
    assert states.rest[joint("neck"), 1] > 0.3
    assert states.rest[joint("left_knee"), 1] < -0.2
    rotated = [turned_about_vertical(clip.positions, 2.0) for clip in clips]
    np.testing.assert_allclose(rest_pose(PERSON, rotated), states.rest, atol=1e-9)


def test_invalid_bodies_and_motions_are_rejected(walkers):
    rest = walkers[0].rest
    with pytest.raises(ValueError, match="motions must contain at least one motion, got none"):
        rest_pose(PERSON, [])
    with pytest.raises(ValueError, match="skeleton must have left-right pairs"):
        rest_pose(Skeleton(["a", "b"], [-1, 0]), [np.ones((2, 2, 3))])
    with pytest.raises(ValueError, match="skeleton must have one root, got 2"):
        BodyStates(Skeleton.preset("pair17"), np.zeros((34, 3)))
    for factor, message in ((0, "bones .*, got 0 m for"), (99, "at most 3 m, got")):
        with pytest.raises(ValueError, match=message):
            BodyStates(PERSON, factor * rest)
    with pytest.raises(ValueError, match=r"states must have shape \(…, L, 69\), got \(4, 70\)"):
        walkers[0].positions(np.zeros((4, 70)), rest)
