"""Face points of motion capture: fixed to the head, mirror symmetric, turned with it."""

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.face_points import FACE_POINTS, head_turns, with_face_points
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import vector_to_matrix

COCO = Skeleton.preset("coco17")
PERSON = Skeleton.preset("person14")
FACE = [COCO.index(name) for name in FACE_POINTS]
GAIT = make_gait("walk", frames=20).retarget(PERSON)
RNG = np.random.default_rng(0)
HEAD_ROTATIONS = vector_to_matrix(0.3 * RNG.normal(size=(20, 3)))
TURNS = 0.4 * RNG.normal(size=20)


def with_head_bone(names=("upper_neck", "head"), rotations=HEAD_ROTATIONS, gait=GAIT):
    """Return the gait with a head bone of 10 cm that is rotated from the vertical."""
    neck = PERSON.index("neck")
    base = gait.positions[:, neck] + [0.0, 0.09, 0.0]
    top = base + rotations @ [0.0, 0.1, 0.0]
    positions = np.concatenate([gait.positions, np.stack([base, top], axis=1)], axis=1)
    J = PERSON.n_joints
    skeleton = Skeleton([*PERSON.joint_names, *names], [*PERSON.parents, neck, J])
    return Motion(positions, skeleton, gait.fps)


def mirrored(motion):
    order = list(motion.skeleton.mirrored_order)
    return replace(motion, positions=motion.positions[:, order] * [-1.0, 1.0, 1.0])


def axes_of(positions):
    """Return the directions left, up and front of a face, as rows (L, 3, 3)."""
    nose, ears = positions[:, 0], positions[:, 3:5]
    left = ears[:, 0] - ears[:, 1]
    # The nose is 2.5 cm below the ears and 12 cm in front of them.
    ahead = nose - ears.mean(axis=1)
    normal = np.cross(ahead, left)
    left, ahead, normal = (v / np.linalg.norm(v, axis=1)[:, None] for v in (left, ahead, normal))
    cos, sin = np.array([0.12, 0.025]) / np.hypot(0.12, 0.025)
    return np.stack([left, cos * normal - sin * ahead, cos * ahead + sin * normal], axis=1)


@pytest.mark.parametrize("names", [("upper_neck", "head"), ("Head", "Head_end")])
def test_face_is_fixed_to_the_head_bone(names):
    recording = with_head_bone(names)
    found = with_face_points(recording, TURNS)
    assert found.skeleton == COCO
    face, axes = found.positions[:, FACE], axes_of(found.positions)
    ears = face[:, 3:].mean(axis=1, keepdims=True)
    local = (face - ears) @ axes.swapaxes(1, 2)
    expected = np.array(list(FACE_POINTS.values()))
    np.testing.assert_allclose(local, np.broadcast_to(expected, local.shape), atol=1e-10)
    up = HEAD_ROTATIONS[:, :, 1]
    np.testing.assert_allclose(axes[:, 1], up, atol=1e-10)
    np.testing.assert_allclose(ears[:, 0], recording.positions[:, -1] - 0.03 * up, atol=1e-10)
    limbs = [PERSON.index(name) for name in COCO.joint_names[5:]]
    np.testing.assert_array_equal(found.positions[:, 5:], GAIT.positions[:, limbs])


def test_face_turns_with_the_head():
    """A nod about the shoulders' axis rotates the face by the same angle, and turns are added."""
    across = GAIT.positions[:, PERSON.index("left_shoulder")]
    across = across - GAIT.positions[:, PERSON.index("right_shoulder")]
    across /= np.linalg.norm(across, axis=1)[:, None]
    # Heads at a right angle to the shoulders, which nod about them.
    upright = np.array([0.0, 1.0, 0.0]) - across * across[:, 1:2]
    front = np.cross(across, upright)
    upright, front = (v / np.linalg.norm(v, axis=1)[:, None] for v in (upright, front))
    bases = np.stack([across, upright, front], axis=-1)
    nods = vector_to_matrix(across * np.linspace(-0.5, 0.5, 20)[:, None])
    turns = vector_to_matrix(np.array([[0.0, angle, 0.0] for angle in TURNS]))
    found = with_face_points(with_head_bone(rotations=nods @ bases), TURNS)
    expected = nods @ bases @ turns
    np.testing.assert_allclose(axes_of(found.positions).swapaxes(1, 2), expected, atol=1e-10)


def test_mirror_image_has_opposite_turns():
    recording = with_head_bone()
    image = with_face_points(mirrored(recording), -TURNS)
    expected = mirrored(with_face_points(recording, TURNS))
    np.testing.assert_allclose(image.positions, expected.positions, atol=1e-12)


def test_head_without_a_bone_continues_the_trunk():
    axis = GAIT.positions[:, PERSON.index("neck")] - GAIT.positions[:, PERSON.index("pelvis")]
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    found = with_face_points(GAIT).positions
    ears = found[:, 3:5].mean(axis=1)
    neck, shoulders = GAIT.positions[:, PERSON.index("neck")], found[:, 5:7].mean(axis=1)
    np.testing.assert_allclose(np.cross(ears - neck, axis), 0, atol=1e-12)
    np.testing.assert_allclose(((ears - shoulders) * axis).sum(axis=1), 0.19, atol=1e-12)
    np.testing.assert_allclose(axes_of(found)[:, 1], axis, atol=1e-10)


def test_errors():
    with pytest.raises(ValueError, match="motion must have a joint neck"):
        with_face_points(with_face_points(GAIT))
    recording = with_head_bone()
    side = np.array([PERSON.index("left_shoulder"), PERSON.index("right_shoulder")])
    positions = recording.positions.copy()
    positions[7, side[0]] = positions[7, side[1]] + 2 * (positions[7, -1] - positions[7, -2])
    with pytest.raises(ValueError, match="parallel to the head's axis, got frame 7"):
        with_face_points(replace(recording, positions=positions))
    with pytest.raises(ValueError, match="turns"):
        with_face_points(recording, TURNS[1:])


def test_head_turns_have_the_stated_covariance():
    draws = np.stack([head_turns(np.random.default_rng(i), 16, 30.0) for i in range(4000)])
    lag = 15 / 30 / 0.3
    variance = np.deg2rad(15) ** 2
    # Standard errors of a variance and of a covariance of 4000 draws: at most √(2 / 4000) = 2.2 %.
    np.testing.assert_allclose((draws**2).mean(axis=0), variance, rtol=0.1)
    expected = variance * (1 + lag) * np.exp(-lag)
    assert abs((draws[:, 0] * draws[:, 15]).mean() - expected) < 0.1 * variance
