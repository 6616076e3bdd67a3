"""Capsules of people and animals: they do not depend on size and direction of the body."""

import numpy as np
import pytest

from probmotion.data.synthetic.animals import synthetic_animals
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.body_mesh import body_parts
from probmotion.motion.inverse_kinematics import rigid_motion


def animal():
    """A dog facing +Z, its left at +X."""
    (motion,) = synthetic_animals(1, 30)
    return motion.skeleton, motion.positions[0]


def test_animals_have_head_tail_and_a_deep_chest():
    skeleton, rest = animal()
    parts = body_parts(skeleton, rest)
    points = np.array([end for part in parts for end in (part.start, part.end)])
    assert points[:, 2].max() > rest[skeleton.index("head"), 2] + 0.1  # the snout
    assert points[:, 2].min() < rest[skeleton.index("tail"), 2] - 0.1
    (ribs,) = (p for p in parts if p.owner == skeleton.index("chest") and p.after < 0)
    assert ribs.end[1] < rest[skeleton.index("neck"), 1] - 0.05
    legs = [max(p.radii) for p in parts if "wrist" in skeleton.joint_names[p.after]]
    assert max(legs) < 0.5 * min(ribs.radii)
    for joint in ("chest", "neck"):
        (trunk,) = (p for p in parts if p.after == skeleton.index(joint))
        assert trunk.flat[0] < trunk.flat[1]  # width and depth


@pytest.mark.parametrize("angle", [0.5, 2.0, 4.0])
def test_capsules_turn_and_grow_with_the_animal(angle):
    skeleton, rest = animal()
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    for one, other in zip(
        body_parts(skeleton, rest), body_parts(skeleton, 1.3 * rest @ turn.T), strict=True
    ):
        assert one[:3] == other[:3]
        np.testing.assert_allclose(other.start, 1.3 * turn @ one.start, atol=1e-9)
        np.testing.assert_allclose(other.end, 1.3 * turn @ one.end, atol=1e-9)
        np.testing.assert_allclose(other.radii, 1.3 * np.array(one.radii))
        if one.flat != (1.0, 1.0):  # the width of the trunk is horizontal in both
            np.testing.assert_allclose(np.abs(other.axes[0] @ turn @ one.axes[0]), 1, atol=2e-3)


def test_hands_continue_forearms():
    motion = rigid_motion(make_gait("walk", frames=5))
    skeleton, rest = motion.skeleton, motion.positions[0]  # arms hang
    for side in ("left", "right"):
        wrist, elbow = skeleton.index(f"{side}_wrist"), skeleton.index(f"{side}_elbow")
        (hand,) = (p for p in body_parts(skeleton, rest) if p.owner == wrist)
        forearm = (rest[wrist] - rest[elbow]) / np.linalg.norm(rest[wrist] - rest[elbow])
        np.testing.assert_allclose(hand.axes[2], forearm, atol=1e-9)
        assert (hand.start - rest[wrist]) @ forearm > 0
