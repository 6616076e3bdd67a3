"""An articulated body: against loops, under rigid moves, and which bends are in range."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import matrix_to_vector, six_numbers_to_matrix
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.bodies.body_states import BodyStates, rest_pose

PERSON = Skeleton.preset("person14")
QUADRUPED = Skeleton.preset("apt36k17")
CHAIN = Skeleton(["a", "b", "c", "d"], [1, -1, 1, 2])
BODIES = pytest.mark.parametrize(
    "skeleton", [PERSON, QUADRUPED, CHAIN], ids=["person", "quadruped", "chain"]
)


def some_rest(skeleton, seed=0):
    """Bones at random, the right side the mirror image of the left."""
    rest = 0.3 * np.random.default_rng(seed).normal(size=(skeleton.n_joints, 3))
    rest[list(skeleton.roots)] = 0
    return (rest + mirrored(skeleton, rest)) / 2


def mirrored(skeleton, offsets):
    return offsets[..., list(skeleton.mirrored_order), :] * np.array([-1.0, 1.0, 1.0])


def some_pose(body, shape=(5,), seed=1):
    rng = np.random.default_rng(seed)
    turns = 0.8 * rng.normal(size=(*shape, len(body.bones), 3))
    rotation = Rotation.random(int(np.prod(shape)), rng=rng).as_matrix().reshape(*shape, 3, 3)
    return turns, rotation, rng.normal(size=(*shape, 3))


def by_a_loop(body, turns, rotation, translation, longer):
    """One frame, joint by joint, after the definition: a trunk's end turns with its own bone."""
    skeleton, which = body.skeleton, {name: at for at, name in enumerate(body.bones)}
    place, turned = {}, {}
    for joint in skeleton.topological_order:
        name, parent = skeleton.joint_names[joint], skeleton.parents[joint]
        if parent < 0:
            place[joint], turned[joint] = translation, rotation
            continue
        over = turned[parent]
        if f"{name} trunk" in which:
            over = over @ Rotation.from_rotvec(turns[which[f"{name} trunk"]]).as_matrix()
        place[joint] = place[parent] + over @ (body.rest[joint] * longer[joint])
        own = np.eye(3)
        if name in which:
            own = Rotation.from_rotvec(turns[which[name]]).as_matrix()
        turned[joint] = over @ own
    return np.stack([place[joint] for joint in range(skeleton.n_joints)])


@BODIES
def test_positions_are_those_of_a_loop(skeleton):
    body = ArticulatedBody(skeleton, some_rest(skeleton))
    turns, rotation, translation = some_pose(body)
    log_lengths = 0.3 * np.random.default_rng(2).normal(size=body.n_groups)
    found = body.positions(turns, rotation, translation, log_lengths)
    longer = np.exp(log_lengths)[list(body.length_groups)]
    for frame in range(5):
        wanted = by_a_loop(body, turns[frame], rotation[frame], translation[frame], longer)
        np.testing.assert_allclose(found[frame], wanted, atol=1e-12)


def test_bones_are_the_joints_that_have_children_and_trunks():
    assert ArticulatedBody(PERSON, some_rest(PERSON)).bones == (
        "neck", "left_shoulder", "left_elbow", "right_shoulder", "right_elbow",
        "left_hip", "left_knee", "right_hip", "right_knee", "neck trunk",
    )  # fmt: skip
    assert ArticulatedBody(CHAIN, some_rest(CHAIN)).bones == ("c",)
    single = ArticulatedBody(Skeleton(["a"], [-1]), np.zeros((1, 3)))
    assert (single.bones, single.lower.shape) == ((), (0, 3))


@BODIES
def test_no_turn_is_the_rest_pose_and_in_range(skeleton):
    rest = some_rest(skeleton)
    body = ArticulatedBody(skeleton, rest)
    still = np.zeros((1, len(body.bones), 3))
    found = body.positions(still, np.eye(3)[None], np.zeros((1, 3)))[0]
    for joint, parent in skeleton.bones:
        np.testing.assert_allclose(found[joint] - found[parent], rest[joint], atol=1e-15)
    assert body.range_excess(still) == 0
    assert body.lower.shape == body.upper.shape == (len(body.bones), 3)


@BODIES
def test_a_body_moves_rigidly_with_its_root(skeleton):
    body = ArticulatedBody(skeleton, some_rest(skeleton))
    turns, rotation, translation = some_pose(body)
    before = body.positions(turns, rotation, translation)
    more, shift = Rotation.from_rotvec([0.4, -1.0, 0.7]).as_matrix(), np.array([1.0, 2.0, -3.0])
    after = body.positions(turns, more @ rotation, translation @ more.T + shift)
    np.testing.assert_allclose(after, before @ more.T + shift, atol=1e-12)
    np.testing.assert_allclose(before[:, skeleton.roots[0]], translation, atol=1e-15)


@BODIES
def test_mirrored_turns_are_the_mirrored_motion(skeleton):
    """And mirrored bones have mirrored ranges: as much of either motion is out of range."""
    body = ArticulatedBody(skeleton, some_rest(skeleton))
    turns, rotation, translation = some_pose(body, seed=3)
    order = [body.bones.index(name) for name in mirrored_names(body.bones)]
    flip = np.array([-1.0, 1.0, 1.0])
    other = turns[:, order] * -flip
    found = body.positions(other, rotation * np.outer(flip, flip), translation * flip)
    wanted = mirrored(skeleton, body.positions(turns, rotation, translation))
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    np.testing.assert_allclose(body.range_excess(other), body.range_excess(turns), atol=1e-12)
    assert (body.range_excess(3 * turns) > 0).all()


def mirrored_names(names):
    swap = {"left": "right", "right": "left"}
    return ["_".join(swap.get(word, word) for word in name.split("_")) for name in names]


@BODIES
def test_a_length_is_that_of_a_bone_and_its_mirror_image(skeleton):
    body = ArticulatedBody(skeleton, some_rest(skeleton))
    turns, rotation, translation = some_pose(body)
    pairs = set(skeleton.mirrored_pairs)
    assert body.symmetric == bool(pairs)
    assert set(body.length_groups) == set(range(body.n_groups))
    assert body.n_groups == skeleton.n_joints - len(pairs)
    for group in range(body.n_groups):
        log_lengths = np.zeros(body.n_groups)
        log_lengths[group] = np.log(1.7)
        found = body.positions(turns, rotation, translation, log_lengths)
        members = [joint for joint, own in enumerate(body.length_groups) if own == group]
        assert len(members) == 1 or tuple(members) in pairs or tuple(members[::-1]) in pairs
        for joint, parent in skeleton.bones:
            length = np.linalg.norm(found[:, joint] - found[:, parent], axis=-1)
            times = 1.7 if joint in members else 1.0
            np.testing.assert_allclose(length, times * np.linalg.norm(body.rest[joint]))


def test_a_lopsided_skeleton_shares_no_lengths():
    lopsided = Skeleton(["root", "left_hip", "right_hip", "left_knee", "right_knee"],
                        [-1, 0, 0, 1, 0])  # fmt: skip
    body = ArticulatedBody(lopsided, some_rest(lopsided))
    assert not body.symmetric
    assert body.n_groups == 5


@BODIES
def test_batch_axes_broadcast_and_libraries_agree(skeleton):
    body = ArticulatedBody(skeleton, some_rest(skeleton))
    turns, rotation, translation = some_pose(body, (2, 3, 4))
    log_lengths = 0.2 * np.random.default_rng(4).normal(size=(3, body.n_groups))
    # A turn for all of two, one rotation for every frame, lengths for three.
    parts = [turns[:1], rotation[..., :1, :, :], translation[0, 0], log_lengths]
    found = body.positions(*parts)
    assert found.shape == (2, 3, 4, skeleton.n_joints, 3)
    for a, b in np.ndindex(2, 3):
        each = [turns[0, b], np.repeat(rotation[a, b, :1], 4, 0), translation[0, 0]]
        np.testing.assert_allclose(found[a, b], body.positions(*each, log_lengths[b]), atol=1e-12)
    tensors = [torch.tensor(part) for part in parts]
    np.testing.assert_allclose(body.positions(*tensors).numpy(), found, atol=1e-12)
    single = body.positions(*(part.float() for part in tensors))
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single.numpy(), found, atol=1e-4)
    excess = body.range_excess(3 * turns)
    assert excess.shape == (2, 3, 4)
    np.testing.assert_allclose(body.range_excess(torch.tensor(3 * turns)).numpy(), excess)
    out = 3 * turns - np.clip(3 * turns, body.lower, body.upper)
    np.testing.assert_allclose(excess, (out**2).sum((-2, -1)), atol=1e-12)


@pytest.mark.parametrize("scale", [0.0, 1e-4, 1.0])
def test_gradients_are_right_also_where_nothing_is_turned(scale):
    body = ArticulatedBody(PERSON, some_rest(PERSON))
    turns, rotation, translation = some_pose(body, (1,))
    free = [torch.tensor(scale * turns), torch.tensor(translation), torch.zeros(body.n_groups)]
    free = [part.double().requires_grad_() for part in free]

    def positions(turns, translation, log_lengths):
        return body.positions(turns, torch.tensor(rotation), translation, log_lengths)

    assert torch.autograd.gradcheck(positions, free)
    far = torch.tensor(4 * turns, requires_grad=True)
    assert torch.autograd.gradcheck(body.range_excess, far)


def bent_rest(skeleton, **bones):
    """A rest pose of given left bones and their mirror images; the others point anywhere."""
    rest = some_rest(skeleton)
    for name, offset in bones.items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            rest[skeleton.index(f"{side}_{name}")] = np.array([sign, 1.0, 1.0]) * offset
    return rest


def excess_of(body, name, *vector):
    turns = np.zeros((len(body.bones), 3))
    turns[body.bones.index(name)] = vector
    return float(body.range_excess(turns))


SHIN = 0.4 * np.array([0.0, -np.cos(0.4), -np.sin(0.4)])
STRAIGHT = np.array([0.0, -0.4, 0.0])


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("skeleton", [PERSON, QUADRUPED], ids=["person", "quadruped"])
def test_knees_bend_back_and_never_beyond_straight(skeleton, side):
    end = "ankle" if skeleton is PERSON else "back_paw"
    body = ArticulatedBody(skeleton, bent_rest(skeleton, knee=STRAIGHT, **{end: SHIN}))
    knee = f"{side}_knee"
    assert excess_of(body, knee, 1.8, 0, 0) == 0
    assert excess_of(body, knee, -0.399, 0, 0) == 0
    assert excess_of(body, knee, -0.6, 0, 0) == pytest.approx(0.2**2)
    assert excess_of(body, knee, 2.5, 0, 0) > 0
    assert excess_of(body, knee, 0, 0, 1.0) > 0
    # What the signs mean: −0.4 is straight, +1.8 has the ankle behind.
    turns = np.zeros((2, len(body.bones), 3))
    turns[:, body.bones.index(knee), 0] = [-0.4, 1.2]
    joints = body.positions(turns, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    shins = joints[:, skeleton.index(f"{side}_{end}")] - joints[:, skeleton.index(knee)]
    np.testing.assert_allclose(shins[0], STRAIGHT, atol=1e-12)
    assert shins[1, 2] < -0.39


@pytest.mark.parametrize("side", ["left", "right"])
def test_elbows_bend_the_way_they_are_bent(side):
    """Forwards in people, and in animals whichever way the rest pose has it."""
    fore = STRAIGHT * 0.5 + np.array([0.05, 0.0, 0.1])
    for skeleton, end, lower, way in (
        (PERSON, "wrist", fore, -1),
        (QUADRUPED, "front_paw", fore, -1),
        (QUADRUPED, "front_paw", fore * [1, 1, -1], 1),
    ):
        body = ArticulatedBody(skeleton, bent_rest(skeleton, elbow=STRAIGHT, **{end: lower}))
        rest = body.rest[skeleton.index(f"{side}_{end}")]
        axis = np.cross(STRAIGHT, rest)
        bent = np.arctan2(np.linalg.norm(axis), STRAIGHT @ rest)
        axis /= np.linalg.norm(axis)
        assert np.sign(axis[0]) == way
        elbow = f"{side}_elbow"
        assert excess_of(body, elbow, *(1.9 * axis)) == 0
        assert excess_of(body, elbow, *(-bent * axis)) == 0
        assert excess_of(body, elbow, *(-(bent + 1.0) * axis)) > 0.2
    # A forearm that is bent inwards turns about Z: the axis is not X for all.
    inwards = bent_rest(PERSON, elbow=STRAIGHT, wrist=STRAIGHT * 0.5 + np.array([-0.2, 0, 0]))
    body = ArticulatedBody(PERSON, inwards)
    sign = 1 if side == "left" else -1
    assert excess_of(body, f"{side}_elbow", 0, 0, -1.5 * sign) == 0
    assert excess_of(body, f"{side}_elbow", 0, 0, 1.5 * sign) > 0.3


def test_limbs_in_line_bend_forwards_or_backwards():
    person = ArticulatedBody(PERSON, bent_rest(
        PERSON, knee=STRAIGHT, ankle=STRAIGHT, elbow=STRAIGHT, wrist=STRAIGHT
    ))  # fmt: skip
    for joint, way in (("left_knee", 1), ("right_knee", 1), ("left_elbow", -1)):
        assert excess_of(person, joint, 2.5 * way, 0, 0) == 0
        assert excess_of(person, joint, -0.3 * way, 0, 0) == pytest.approx(0.09)
    # Arms that are spread bend forwards about the vertical, arms that point ahead bend upwards.
    along = np.array([0.3, 0.0, 0.0])
    person = ArticulatedBody(PERSON, bent_rest(PERSON, elbow=along, wrist=along))
    for joint, way in (("left_elbow", -1), ("right_elbow", 1)):
        assert excess_of(person, joint, 0, 2.5 * way, 0) == 0
        assert excess_of(person, joint, 0, -0.3 * way, 0) == pytest.approx(0.09)
    ahead = np.array([0.0, 0.0, 0.3])
    person = ArticulatedBody(PERSON, bent_rest(PERSON, elbow=ahead, wrist=ahead))
    assert excess_of(person, "left_elbow", -2.5, 0, 0) == 0
    assert excess_of(person, "left_elbow", 0.3, 0, 0) == pytest.approx(0.09)
    animal = ArticulatedBody(QUADRUPED, bent_rest(QUADRUPED, elbow=STRAIGHT, front_paw=STRAIGHT))
    assert excess_of(animal, "left_elbow", 2.5, 0, 0) == 0
    assert excess_of(animal, "left_elbow", -2.5, 0, 0) == 0
    assert excess_of(animal, "left_elbow", 0, 1.0, 0) > 0


def test_legs_go_further_forwards_and_outwards_and_unknown_joints_anywhere():
    body = ArticulatedBody(PERSON, some_rest(PERSON))
    assert excess_of(body, "left_hip", -2.0, 0, 0) == 0 < excess_of(body, "left_hip", 2.0, 0, 0)
    assert excess_of(body, "left_hip", 0, 0, 1.2) == 0 < excess_of(body, "left_hip", 0, 0, -1.2)
    assert excess_of(body, "right_hip", 0, 0, -1.2) == 0 < excess_of(body, "right_hip", 0, 0, 1.2)
    assert excess_of(body, "neck trunk", 1.4, 0, 0) == 0 < excess_of(body, "neck trunk", -1.4, 0, 0)
    chain = ArticulatedBody(CHAIN, some_rest(CHAIN))
    np.testing.assert_array_equal(np.stack([chain.lower, chain.upper]) * [[[1]], [[-1]]], -1.2)


@pytest.mark.parametrize("style", ["walk", "run", "quadruped-walk", "quadruped-trot"])
def test_gaits_are_in_range(style):
    clips = [make_gait(style, number, frames=40) for number in range(6)]
    if "quadruped" not in style:
        clips = [clip.retarget(PERSON) for clip in clips]
    assert out_of_range(clips) < 1e-3


def test_real_walks_and_dances_are_in_range(real_data):
    from probmotion.io.files import load_motion

    names = ("long_walk1", "stealthy_walk", "jog", "dance_a")
    clips = [load_motion(real_data / f"deepmimic_human/humanoid3d_{name}.npz") for name in names]
    assert out_of_range(clips) < 5e-3


def out_of_range(clips):
    """Mean squared radians out of range of motions, from their mean pose."""
    skeleton = clips[0].skeleton
    rest = rest_pose(skeleton, [clip.positions for clip in clips])
    rest = (rest + mirrored(skeleton, rest)) / 2
    states, body = BodyStates(skeleton, rest), ArticulatedBody(skeleton, rest)
    excess = []
    for clip in clips:
        x = states.states(clip.positions, states.body(clip.positions))
        matrices = six_numbers_to_matrix(x[:, 9:].reshape(len(x), -1, 6))
        excess.append(body.range_excess(matrix_to_vector(matrices)).mean())
    return np.mean(excess)


def test_what_is_no_body_is_refused():
    rest = some_rest(PERSON)
    with pytest.raises(ValueError, match="skeleton has 2 roots, expected one"):
        ArticulatedBody(Skeleton.preset("pair17"), np.zeros((34, 3)))
    with pytest.raises(ValueError, match=r"rest must have shape \(14, 3\), got \(13, 3\)"):
        ArticulatedBody(PERSON, rest[1:])
    flat = rest.copy()
    flat[3] = 0
    with pytest.raises(ValueError, match="rest has a bone of no length, to left_elbow, expected"):
        ArticulatedBody(PERSON, flat)
    body = ArticulatedBody(PERSON, rest)
    turns, rotation, translation = some_pose(body)
    with pytest.raises(ValueError, match=r"turns must have shape \(…, L, 10, 3\), got \(5, 9, 3\)"):
        body.positions(turns[:, 1:], rotation, translation)
    with pytest.raises(ValueError, match=r"root_rotation has shape \(5, 3\), expected"):
        body.positions(turns, rotation[..., 0], translation)
    with pytest.raises(ValueError, match=r"root_translation has shape \(5, 2\), expected"):
        body.positions(turns, rotation, translation[:, 1:])
    with pytest.raises(ValueError, match=r"log_lengths must have shape \(…, 8\), got \(14,\)"):
        body.positions(turns, rotation, translation, np.zeros(14))
    with pytest.raises(ValueError, match=r"turns must have shape \(…, 10, 3\), got \(10, 2\)"):
        body.range_excess(np.zeros((10, 2)))
