"""Poses as numbers: there and back, canonical frames, and what a bow does to the hips."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import six_numbers_to_matrix
from probmotion.models.bodies.body_states import (
    BodyStates,
    Placement,
    heading_of,
    rest_pose,
    turned_about_vertical,
)
from probmotion.models.dvae.motion_windows import canonical_windows
from probmotion.motion.kinematics import forward_kinematics

PERSON = Skeleton.preset("person14")
# Its root is not its first joint, and two joints are at the end of trunks.
QUADRUPED = Skeleton.preset("apt36k17")
BODIES = pytest.mark.parametrize("skeleton", [PERSON, QUADRUPED], ids=["person", "quadruped"])


def at(name):
    return PERSON.index(name)


def some_rest(skeleton, seed=0):
    rest = 0.3 * np.random.default_rng(seed).normal(size=(skeleton.n_joints, 3))
    rest[list(skeleton.roots)] = 0
    return rest


def rigid(skeleton, body, frames=7, seed=1, spread=np.inf):
    """A rigid body's motion by forward kinematics of random rotations."""
    rng = np.random.default_rng(seed)
    shape = (frames, skeleton.n_joints)
    turns = Rotation.random(int(np.prod(shape)), rng=rng)
    if np.isfinite(spread):
        turns = Rotation.from_rotvec(spread * rng.normal(size=(int(np.prod(shape)), 3)))
    matrices = turns.as_matrix().reshape(*shape, 3, 3)
    return forward_kinematics(skeleton, matrices, rng.normal(size=(frames, 1, 3)), body)[0]


def gaits(style, n=4, frames=40):
    clips = [make_gait(style, number, frames=frames) for number in range(n)]
    if "quadruped" in style:
        return clips
    return [clip.retarget(PERSON) for clip in clips]


@pytest.fixture(scope="module")
def walkers():
    """Walks, and the states of such bodies."""
    clips = gaits("walk")
    return BodyStates(PERSON, rest_pose(PERSON, [clip.positions for clip in clips])), clips


@BODIES
@pytest.mark.parametrize("spread", [0.0, 0.5, np.inf])
@pytest.mark.parametrize("sizes", ["usual", "smaller", "each bone its own"])
def test_rigid_bodies_come_back_exactly(skeleton, spread, sizes):
    states = BodyStates(skeleton, some_rest(skeleton))
    own = np.random.default_rng(2).uniform(0.6, 1.4, (skeleton.n_joints, 1))
    body = states.rest * {"usual": 1.0, "smaller": 0.6, "each bone its own": own}[sizes]
    positions = rigid(skeleton, body, spread=spread)
    found = states.body(positions)
    np.testing.assert_allclose(found, body, atol=1e-9)
    x = states.states(positions, found)
    assert x.shape == (7, states.dim)
    np.testing.assert_allclose(states.positions(x, found), positions, atol=1e-9)
    # And the states of what came back are the same states.
    np.testing.assert_allclose(states.states(states.positions(x, body), body), x, atol=1e-6)


@BODIES
def test_any_states_are_positions_of_the_body(skeleton):
    """Bones are as long as the body's, whatever six numbers a network gives."""
    states = BodyStates(skeleton, some_rest(skeleton))
    x = np.random.default_rng(3).normal(size=(5, states.dim))
    positions = states.positions(x, states.rest)
    np.testing.assert_allclose(positions[:, skeleton.roots[0]], x[:, :3], atol=1e-12)
    for joint, parent in skeleton.bones:
        found = np.linalg.norm(positions[:, joint] - positions[:, parent], axis=-1)
        np.testing.assert_allclose(found, np.linalg.norm(states.rest[joint]), atol=1e-12)


@pytest.mark.parametrize(
    ("style", "bound"),
    [("walk", 1e-4), ("run", 1e-4), ("march", 1e-4), ("quadruped-walk", 3e-3)],
)
def test_gaits_come_back_almost(style, bound):
    """Their trunks bend sideways a little, which a joint with one rotation shares out."""
    clips = gaits(style)
    skeleton = clips[0].skeleton
    states = BodyStates(skeleton, rest_pose(skeleton, [clip.positions for clip in clips]))
    for clip in clips:
        body = states.body(clip.positions)
        back = states.positions(states.states(clip.positions, body), body)
        assert np.linalg.norm(back - clip.positions, axis=-1).max() < bound


def test_states_of_a_gait_move_smoothly(walkers):
    """No frame jumps to another of the rotations that fit as well."""
    states, clips = walkers
    for clip in clips:
        x = states.states(clip.positions, states.body(clip.positions))
        assert abs(np.diff(x[:, 3:], axis=0)).max() < 0.3


def test_a_mirrored_motion_is_of_the_mirrored_body(walkers):
    states, clips = walkers
    body = states.body(clips[0].positions)
    order, flip = list(PERSON.mirrored_order), np.array([-1.0, 1.0, 1.0])
    mirrored = clips[0].positions[:, order] * flip
    found = BodyStates(PERSON, states.rest[order] * flip).body(mirrored)
    np.testing.assert_allclose(found, body[order] * flip, atol=1e-9)


def test_a_bow_leaves_the_hips_where_they_are(walkers):
    """Why trunks have a rotation of their own: with one for both, the hips would tilt as well."""
    states, _ = walkers
    rest = states.rest.copy()
    rest[[at("left_hip"), at("right_hip")], 1:] = 0
    states = BodyStates(PERSON, rest)
    still = np.tile(np.eye(3), (1, PERSON.n_joints, 1, 1))
    upright, _ = forward_kinematics(PERSON, still, np.zeros((1, 1, 3)), rest)
    upper = [j for j in range(14) if at("neck") in (j, *PERSON.ancestors(j))]
    bowed = upright.copy()
    bowed[:, upper] = upright[:, upper] @ Rotation.from_rotvec([1.2, 0, 0]).as_matrix().T
    back = states.positions(states.states(bowed, rest), rest)
    np.testing.assert_allclose(back, bowed, atol=1e-12)
    # Sideways the guide pulls at the hips, a twentieth of what the trunk does.
    bowed[:, upper] = upright[:, upper] @ Rotation.from_rotvec([0, 0, 0.6]).as_matrix().T
    back = states.positions(states.states(bowed, rest), rest)
    assert 1e-4 < abs(back - bowed).max() < 5e-3
    together = forward_kinematics(
        PERSON,
        np.concatenate([Rotation.from_rotvec([[0, 0, 0.6]]).as_matrix()[:, None], still[:, 1:]], 1),
        np.zeros((1, 1, 3)),
        rest,
    )[0]
    assert abs(together - bowed).max() > 0.05


@BODIES
def test_canonical_states_begin_at_the_origin_and_come_back(skeleton):
    states = BodyStates(skeleton, some_rest(skeleton))
    positions = rigid(skeleton, states.rest, spread=0.7) + np.array([3.0, 0.5, -2.0])
    x = states.states(positions, states.rest)
    canonical, place = states.canonical(x)
    np.testing.assert_allclose(canonical[0, [0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(canonical[:, 1], x[:, 1], atol=1e-12)
    assert heading_of(six_numbers_to_matrix(canonical[0, 3:9])) == pytest.approx(0, abs=1e-12)
    # Only where it stands and looks is taken away.
    np.testing.assert_array_equal(canonical[:, 9:], x[:, 9:])
    seen = states.positions(canonical, states.rest)
    np.testing.assert_allclose(place.to_world(seen), positions, atol=1e-9)
    np.testing.assert_allclose(place.to_canonical(positions), seen, atol=1e-9)
    again, nowhere = states.canonical(canonical)
    np.testing.assert_allclose(again, canonical, atol=1e-12)
    np.testing.assert_allclose([nowhere.heading, *nowhere.ground], 0, atol=1e-12)
    # Windows, all at once, are the same.
    both = canonical_windows(np.stack([x, canonical]))
    np.testing.assert_allclose(both, np.stack([canonical, canonical]), atol=1e-12)


def test_a_motion_turned_by_an_angle_looks_that_much_further(walkers):
    states, clips = walkers
    positions = clips[1].positions
    body = states.body(positions)
    canonical, place = states.canonical(states.states(positions, body))
    for angle in (-2.5, 0.3, 1.7, 3.0):
        moved = turned_about_vertical(positions, angle) + np.array([4.0, 0.0, -1.0])
        np.testing.assert_allclose(states.body(moved), body, atol=1e-9)
        same, there = states.canonical(states.states(moved, body))
        np.testing.assert_allclose(same, canonical, atol=1e-8)
        apart = (there.heading - place.heading - angle + np.pi) % (2 * np.pi) - np.pi
        assert apart == pytest.approx(0, abs=1e-8)
    # Gaits set out along +Z, which is heading 0, more or less.
    assert abs(place.heading) < 0.3


def test_heading_is_the_nearest_turn_about_the_vertical():
    rng = np.random.default_rng(4)
    angle = rng.uniform(-np.pi, np.pi, (3, 4))
    upright = Rotation.from_rotvec(np.stack([0 * angle, angle, 0 * angle], -1).reshape(-1, 3))
    matrices = upright.as_matrix().reshape(3, 4, 3, 3)
    np.testing.assert_allclose(heading_of(matrices), angle, atol=1e-12)
    tilted = Rotation.random(20, rng=rng).as_matrix()
    tried = np.linspace(-np.pi, np.pi, 2001)
    turns = Rotation.from_rotvec(np.outer(tried, [0, 1, 0])).as_matrix()
    overlap = np.einsum("nij,kij->nk", tilted, turns)
    apart = heading_of(tilted) - tried[overlap.argmax(1)]
    assert abs((apart + np.pi) % (2 * np.pi) - np.pi).max() < 4e-3


def test_turning_about_the_vertical_is_a_library_s():
    rng = np.random.default_rng(5)
    positions, angle = rng.normal(size=(3, 4, 5, 3)), rng.normal(size=3)
    wanted = np.stack(
        [
            motion @ Rotation.from_rotvec([0, a, 0]).as_matrix().T
            for motion, a in zip(positions, angle, strict=True)
        ]
    )
    np.testing.assert_allclose(turned_about_vertical(positions, angle), wanted, atol=1e-12)
    place = Placement(angle, rng.normal(size=(3, 2)))
    world = place.to_world(positions)
    np.testing.assert_allclose(
        world[..., [0, 2]] - place.ground[:, None, None], wanted[..., [0, 2]]
    )
    np.testing.assert_array_equal(world[..., 1], wanted[..., 1])
    np.testing.assert_allclose(place.to_canonical(world), positions, atol=1e-12)
    other = place.to_world(torch.tensor(positions))
    np.testing.assert_allclose(other.numpy(), world, atol=1e-12)


@BODIES
def test_bodies_are_batched_and_libraries_agree(skeleton):
    states = BodyStates(skeleton, some_rest(skeleton))
    rng = np.random.default_rng(6)
    x = rng.normal(size=(3, 5, states.dim))
    bodies = states.rest * rng.uniform(0.5, 1.5, (3, 1, 1))
    found = states.positions(x, bodies)
    one_by_one = [states.positions(*pair) for pair in zip(x, bodies, strict=True)]
    np.testing.assert_allclose(found, one_by_one, atol=1e-12)
    np.testing.assert_allclose(
        states.positions(x, states.rest), [states.positions(some, states.rest) for some in x]
    )
    for body in (bodies, torch.tensor(bodies)):
        got = states.positions(torch.tensor(x), body)
        assert got.dtype == torch.float64
        np.testing.assert_allclose(got.numpy(), found, atol=1e-12)
    single = states.positions(torch.tensor(x, dtype=torch.float32), bodies)
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), found, atol=1e-4)


def test_positions_have_the_right_gradient():
    states = BodyStates(PERSON, some_rest(PERSON))
    x = torch.tensor(np.random.default_rng(7).normal(size=(2, states.dim)), requires_grad=True)
    assert torch.autograd.gradcheck(lambda value: states.positions(value, states.rest), x)


@BODIES
def test_parts_of_a_state_are_where_they_are_said_to_be(skeleton):
    states = BodyStates(skeleton, some_rest(skeleton))
    (_, *where), (_, *orientation), (_, *rotations) = states.groups
    assert [where, orientation, rotations] == [[0, 3], [3, 9], [9, states.dim]]
    x = np.random.default_rng(8).normal(size=(1, states.dim))
    before = states.positions(x, states.rest)
    moved, turned = x.copy(), x.copy()
    moved[:, :3] += 1.0
    np.testing.assert_allclose(states.positions(moved, states.rest), before + 1.0, atol=1e-12)
    # The whole body turns about its root with the orientation.
    quarter = Rotation.from_rotvec([0.2, 1.0, -0.4]).as_matrix()
    turned[:, 3:9] = np.concatenate([quarter @ x[0, 3:6], quarter @ x[0, 6:9]])
    wanted = (before - x[0, :3]) @ quarter.T + x[0, :3]
    np.testing.assert_allclose(states.positions(turned, states.rest), wanted, atol=1e-12)


def test_bodies_of_given_lengths_point_as_in_the_rest_pose(walkers):
    states, _ = walkers
    lengths = np.random.default_rng(9).uniform(0.1, 0.9, 14)
    body = states.of_lengths(lengths)
    np.testing.assert_allclose(np.linalg.norm(body, axis=-1)[1:], lengths[1:])
    np.testing.assert_allclose(np.cross(body, states.rest), 0, atol=1e-15)
    assert ((body * states.rest).sum(-1)[1:] > 0).all()
    np.testing.assert_array_equal(body[0], 0)


def test_the_rest_pose_stands_and_looks_ahead(walkers):
    states, clips = walkers
    rest = states.rest
    assert rest[at("left_hip"), 0] > 0 > rest[at("right_hip"), 0]
    assert rest[at("neck"), 1] > 0.3
    assert rest[at("left_knee"), 1] < -0.2
    turned = [turned_about_vertical(clip.positions, 2.0) for clip in clips]
    np.testing.assert_allclose(rest_pose(PERSON, turned), rest, atol=1e-9)
    with pytest.raises(ValueError, match="motions must contain at least one, got none"):
        rest_pose(PERSON, [])
    chain = Skeleton(["a", "b"], [-1, 0])
    with pytest.raises(ValueError, match="skeleton has no left-right pairs, expected some"):
        rest_pose(chain, [np.ones((2, 2, 3))])


def test_what_is_no_body_is_refused(walkers):
    states, _ = walkers
    with pytest.raises(ValueError, match="skeleton has 2 roots, expected one"):
        BodyStates(Skeleton.preset("pair17"), np.zeros((34, 3)))
    with pytest.raises(ValueError, match=r"rest must have shape \(14, 3\), got \(13, 3\)"):
        BodyStates(PERSON, states.rest[1:])
    flat = states.rest.copy()
    flat[3] = 0
    with pytest.raises(ValueError, match="rest has a bone of no length, to left_elbow, expected"):
        BodyStates(PERSON, flat)
    flat[3] = np.nan
    with pytest.raises(
        ValueError, match="rest must be finite, got 3 values that are NaN or infinite"
    ):
        BodyStates(PERSON, flat)
    with pytest.raises(ValueError, match=r"states must have shape \(…, L, 69\), got \(4, 70\)"):
        states.positions(np.zeros((4, 70)), states.rest)
    with pytest.raises(ValueError, match=r"states must have shape \(L, 69\), got \(2, 4, 69\)"):
        states.canonical(np.zeros((2, 4, 69)))
    with pytest.raises(ValueError, match=r"lengths must have shape \(14\), got \(3,\)"):
        states.of_lengths(np.ones(3))
