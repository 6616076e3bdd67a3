"""Articulated body: positions against a loop over joints, rigid moves and joint ranges."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import matrix_to_vector, rotation_6d_to_matrix
from probmotion.io.files import load
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.bodies.body_states import BodyStates, rest_pose

PERSON = Skeleton.preset("person14")
QUADRUPED = Skeleton.preset("apt36k17")
CHAIN = Skeleton(["a", "b", "c", "d"], [1, -1, 1, 2])
SIDES = pytest.mark.parametrize("side", ["left", "right"])
FLIP = np.array([-1.0, 1.0, 1.0])


def random_rest(skeleton):
    """Return random bones of which the right side mirrors the left."""
    rest = 0.3 * np.random.default_rng(0).normal(size=(skeleton.n_joints, 3))
    rest[list(skeleton.roots)] = 0
    return (rest + mirrored(skeleton, rest)) / 2


def mirrored(skeleton, offsets):
    return offsets[..., list(skeleton.mirrored_order), :] * FLIP


@pytest.fixture(params=[PERSON, QUADRUPED, CHAIN], ids=["person", "quadruped", "chain"])
def body(request):
    return ArticulatedBody(request.param, random_rest(request.param))


def random_pose(body, shape=(5,)):
    rng = np.random.default_rng(1)
    turns = 0.8 * rng.normal(size=(*shape, len(body.bones), 3))
    rotation = Rotation.random(int(np.prod(shape)), rng=rng).as_matrix().reshape(*shape, 3, 3)
    return turns, rotation, rng.normal(size=(*shape, 3))


def positions_by_loop(body, turns, rotation, translation, factors):
    """Return one frame, computed joint by joint; a trunk's end rotates with its own bone."""
    skeleton = body.skeleton
    matrices = dict(zip(body.bones, Rotation.from_rotvec(turns).as_matrix(), strict=True))
    position, orientation = {}, {}
    for joint in skeleton.topological_order:
        name, parent = skeleton.joint_names[joint], skeleton.parents[joint]
        if parent < 0:
            position[joint], orientation[joint] = translation, rotation
            continue
        above = orientation[parent] @ matrices.get(f"{name} trunk", np.eye(3))
        position[joint] = position[parent] + above @ (body.rest[joint] * factors[joint])
        orientation[joint] = above @ matrices.get(name, np.eye(3))
    return np.stack([position[joint] for joint in range(skeleton.n_joints)])


def test_positions_match_a_loop_over_joints(body):
    pose = random_pose(body)
    log_lengths = 0.3 * np.random.default_rng(2).normal(size=body.n_groups)
    joints = body.positions(*pose, log_lengths)
    factors = np.exp(log_lengths)[list(body.length_groups)]
    expected = [positions_by_loop(body, *frame, factors) for frame in zip(*pose, strict=True)]
    np.testing.assert_allclose(joints, expected, atol=1e-12)


def test_bones_are_joints_with_children_and_trunks():
    assert ArticulatedBody(PERSON, random_rest(PERSON)).bones == (
        "neck", "left_shoulder", "left_elbow", "right_shoulder", "right_elbow",
        "left_hip", "left_knee", "right_hip", "right_knee", "neck trunk",
    )  # fmt: skip
    chain = ArticulatedBody(CHAIN, random_rest(CHAIN))
    assert chain.bones == ("c",)
    # Joints of unknown name rotate about every axis.
    np.testing.assert_array_equal(np.stack([chain.lower, -chain.upper]), -1.2)
    single = ArticulatedBody(Skeleton(["a"], [-1]), np.zeros((1, 3)))
    assert (single.bones, single.lower.shape) == ((), (0, 3))


def test_mirrored_rotations_give_the_mirrored_motion(body):
    """Mirrored bones also have mirrored ranges."""
    turns, rotation, translation = random_pose(body)
    swap = {"left": "right", "right": "left"}
    names = ["_".join(swap.get(word, word) for word in name.split("_")) for name in body.bones]
    other = turns[:, [body.bones.index(name) for name in names]] * -FLIP
    joints = body.positions(other, rotation * np.outer(FLIP, FLIP), translation * FLIP)
    expected = mirrored(body.skeleton, body.positions(turns, rotation, translation))
    np.testing.assert_allclose(joints, expected, atol=1e-12)
    np.testing.assert_allclose(body.range_excess(other), body.range_excess(turns), atol=1e-12)
    assert (body.range_excess(3 * turns) > 0).all()


def test_bone_lengths_are_shared_with_mirror_images(body):
    pairs = set(body.skeleton.mirrored_pairs)
    assert body.symmetric == bool(pairs)
    assert body.n_groups == body.skeleton.n_joints - len(pairs)
    assert set(body.length_groups) == set(range(body.n_groups))
    assert all(body.length_groups[left] == body.length_groups[right] for left, right in pairs)
    names = ["root", "left_hip", "right_hip", "left_knee", "right_knee"]
    skeleton = Skeleton(names, [-1, 0, 0, 1, 0])
    asymmetric = ArticulatedBody(skeleton, random_rest(skeleton))
    assert (asymmetric.symmetric, asymmetric.n_groups) == (False, 5)


def test_positions_and_excess_broadcast_and_agree_across_libraries(body):
    turns, rotation, translation = random_pose(body, (2, 3, 4))
    log_lengths = 0.2 * np.random.default_rng(4).normal(size=(3, body.n_groups))
    parts = [turns[:1], rotation[..., :1, :, :], translation[0, 0], log_lengths]
    joints = body.positions(*parts)
    assert joints.shape == (2, 3, 4, body.skeleton.n_joints, 3)
    for a, b in np.ndindex(2, 3):
        each = [turns[0, b], np.repeat(rotation[a, b, :1], 4, 0), translation[0, 0]]
        np.testing.assert_allclose(joints[a, b], body.positions(*each, log_lengths[b]), atol=1e-12)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 1e-4)):
        got = body.positions(*(torch.tensor(part, dtype=dtype) for part in parts))
        assert got.dtype == dtype
        np.testing.assert_allclose(got.numpy(), joints, atol=tolerance)
    excess = body.range_excess(3 * turns)
    np.testing.assert_allclose(body.range_excess(torch.tensor(3 * turns)).numpy(), excess)
    beyond = 3 * turns - np.clip(3 * turns, body.lower, body.upper)
    np.testing.assert_allclose(excess, (beyond**2).sum((-2, -1)), atol=1e-12)
    assert body.range_excess(0 * turns).max() == 0


@pytest.mark.parametrize("scale", [0.0, 1e-4, 1.0])
def test_gradients_are_correct_at_small_and_large_rotations(scale):
    body = ArticulatedBody(PERSON, random_rest(PERSON))
    turns, rotation, translation = map(torch.tensor, random_pose(body, (1,)))
    free = [scale * turns, translation, torch.zeros(body.n_groups, dtype=torch.float64)]
    free = [part.requires_grad_() for part in free]

    def positions(turns, translation, log_lengths):
        return body.positions(turns, rotation, translation, log_lengths)

    assert torch.autograd.gradcheck(positions, free, fast_mode=True)
    assert torch.autograd.gradcheck(body.range_excess, (4 * turns).requires_grad_())


def body_with(skeleton, **bones):
    """Return a body with given left bones and their mirror images."""
    rest = random_rest(skeleton)
    for name, offset in bones.items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            rest[skeleton.index(f"{side}_{name}")] = np.array([sign, 1.0, 1.0]) * offset
    return ArticulatedBody(skeleton, rest)


def excess_of(body, name, *vector):
    turns = np.zeros((len(body.bones), 3))
    turns[body.bones.index(name)] = vector
    return float(body.range_excess(turns))


SHIN = 0.4 * np.array([0.0, -np.cos(0.4), -np.sin(0.4)])
STRAIGHT = np.array([0.0, -0.4, 0.0])


@SIDES
@pytest.mark.parametrize(("skeleton", "end"), [(PERSON, "ankle"), (QUADRUPED, "back_paw")])
def test_knees_bend_backwards_and_stop_when_straight(skeleton, end, side):
    body = body_with(skeleton, knee=STRAIGHT, **{end: SHIN})
    knee = f"{side}_knee"
    assert excess_of(body, knee, 1.8, 0, 0) == excess_of(body, knee, -0.399, 0, 0) == 0
    assert excess_of(body, knee, -0.6, 0, 0) == pytest.approx(0.2**2)
    assert excess_of(body, knee, 2.5, 0, 0) > 0
    assert excess_of(body, knee, 0, 0, 1.0) > 0
    # The leg is straight at −0.4, and the ankle is behind the knee at +1.2.
    turns = np.zeros((2, len(body.bones), 3))
    turns[:, body.bones.index(knee), 0] = [-0.4, 1.2]
    joints = body.positions(turns, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))
    shins = joints[:, skeleton.index(f"{side}_{end}")] - joints[:, skeleton.index(knee)]
    np.testing.assert_allclose(shins[0], STRAIGHT, atol=1e-12)
    assert shins[1, 2] < -0.39


@SIDES
def test_elbows_bend_further_in_the_direction_of_the_rest_pose(side):
    forearm = STRAIGHT * 0.5 + np.array([0.05, 0.0, 0.1])
    elbow = f"{side}_elbow"
    for skeleton, end, offset, sign in (
        (PERSON, "wrist", forearm, -1),
        (QUADRUPED, "front_paw", forearm, -1),
        (QUADRUPED, "front_paw", forearm * [1, 1, -1], 1),
    ):
        body = body_with(skeleton, elbow=STRAIGHT, **{end: offset})
        rest = body.rest[skeleton.index(f"{side}_{end}")]
        axis = np.cross(STRAIGHT, rest)
        bent = np.arctan2(np.linalg.norm(axis), STRAIGHT @ rest)
        axis /= np.linalg.norm(axis)
        assert np.sign(axis[0]) == sign
        assert excess_of(body, elbow, *(1.9 * axis)) == 0
        assert excess_of(body, elbow, *(-bent * axis)) == 0
        assert excess_of(body, elbow, *(-(bent + 1.0) * axis)) > 0.2
    # A forearm bent inwards rotates about Z.
    body = body_with(PERSON, elbow=STRAIGHT, wrist=STRAIGHT * 0.5 + np.array([-0.2, 0, 0]))
    sign = 1 if side == "left" else -1
    assert excess_of(body, elbow, 0, 0, -1.5 * sign) == 0
    assert excess_of(body, elbow, 0, 0, 1.5 * sign) > 0.3


ALONG, AHEAD = np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.0, 0.3])


@pytest.mark.parametrize(
    ("joint", "bone", "axis"),
    [
        ("left_knee", STRAIGHT, [1, 0, 0]),
        ("right_knee", STRAIGHT, [1, 0, 0]),
        ("left_elbow", STRAIGHT, [-1, 0, 0]),
        # Spread arms bend about the vertical axis; arms that point ahead bend upwards.
        ("left_elbow", ALONG, [0, -1, 0]),
        ("right_elbow", ALONG, [0, 1, 0]),
        ("left_elbow", AHEAD, [-1, 0, 0]),
    ],
)
def test_straight_limbs_of_people_bend_one_way(joint, bone, axis):
    body = body_with(PERSON, knee=bone, ankle=bone, elbow=bone, wrist=bone)
    assert excess_of(body, joint, *(2.5 * np.array(axis))) == 0
    assert excess_of(body, joint, *(-0.3 * np.array(axis))) == pytest.approx(0.09)
    # Limbs of animals bend both ways.
    animal = body_with(QUADRUPED, elbow=STRAIGHT, front_paw=STRAIGHT)
    assert excess_of(animal, "left_elbow", 2.5, 0, 0) == 0
    assert excess_of(animal, "left_elbow", -2.5, 0, 0) == 0
    assert excess_of(animal, "left_elbow", 0, 1.0, 0) > 0


@pytest.mark.parametrize(
    ("joint", "inside"),
    [
        ("left_hip", [-2.0, 0, 0]),
        ("left_hip", [0, 0, 1.2]),
        ("right_hip", [0, 0, -1.2]),
        ("neck trunk", [1.4, 0, 0]),
    ],
)
def test_named_ranges_are_asymmetric(joint, inside):
    body = ArticulatedBody(PERSON, random_rest(PERSON))
    assert excess_of(body, joint, *inside) == 0 < excess_of(body, joint, *-np.array(inside))


def mean_excess(clips):
    """Return the mean squared excess over the ranges, radians², from the mean pose."""
    skeleton = clips[0].skeleton
    rest = rest_pose(skeleton, [clip.positions for clip in clips])
    rest = (rest + mirrored(skeleton, rest)) / 2
    states, body = BodyStates(skeleton, rest), ArticulatedBody(skeleton, rest)
    excess = []
    for clip in clips:
        x = states.states(clip.positions, states.body(clip.positions))
        matrices = rotation_6d_to_matrix(x[:, 9:].reshape(len(x), -1, 6))
        excess.append(body.range_excess(matrix_to_vector(matrices)).mean())
    return np.mean(excess)


@pytest.mark.parametrize("style", ["walk", "run", "quadruped-walk", "quadruped-trot"])
def test_synthetic_gaits_are_in_range(style):
    clips = [make_gait(style, number, frames=40) for number in range(6)]
    if "quadruped" not in style:
        clips = [clip.retarget(PERSON) for clip in clips]
    assert mean_excess(clips) < 1e-3


def test_real_walks_and_dances_are_in_range(real_data):
    names = ("long_walk1", "stealthy_walk", "jog", "dance_a")
    clips = [load(real_data / f"deepmimic_human/humanoid3d_{name}.npz") for name in names]
    assert mean_excess(clips) < 5e-3


def test_invalid_bodies_and_shapes_are_rejected():
    body = ArticulatedBody(PERSON, random_rest(PERSON))
    turns, rotation, translation = random_pose(body)
    with pytest.raises(ValueError, match=r"turns must have shape \(…, L, 10, 3\), got \(5, 9, 3\)"):
        body.positions(turns[:, 1:], rotation, translation)
    with pytest.raises(ValueError, match=r"log_lengths must have shape \(…, 8\), got \(14,\)"):
        body.positions(turns, rotation, translation, np.zeros(14))
    for skeleton, rest, message in (
        (Skeleton.preset("pair17"), np.zeros((34, 3)), "skeleton must have one root, got 2"),
        (PERSON, body.rest[1:], r"rest must have shape \(14, 3\), got \(13, 3\)"),
        (PERSON, 0 * body.rest, r"rest must have bones .* got 0 m"),
    ):
        with pytest.raises(ValueError, match=message):
            ArticulatedBody(skeleton, rest)
