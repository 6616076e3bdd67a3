"""Procedural dances: bodies of constant bones, in hold, that bend where people bend."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.pairs import dance_frames, person_height
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.data.synthetic.limbs import bent_limb
from probmotion.motion.skeleton import Skeleton

PAIR = Skeleton.preset("pair17")


@pytest.fixture(scope="module")
def positions():
    """(dance, frame, joint, axis)"""
    return np.stack([dance.positions for dance in synthetic_dances(30, frames=120)])


def joint(positions, name):
    return positions[:, :, PAIR.index(name)]


def length(vectors):
    return np.linalg.norm(vectors, axis=-1)


def body_axes(positions, person, low, high):
    """Left, up and forward of a person's pelvis or chest, from its joints."""
    left = joint(positions, f"person{person}:left_{low}") - joint(
        positions, f"person{person}:right_{low}"
    )
    up = joint(positions, f"person{person}:{high}") - joint(positions, f"person{person}:pelvis")
    left, up = left / length(left)[..., None], up / length(up)[..., None]
    return left, up, np.cross(left, up)


def off_the_line(positions, start, middle, end):
    """From the straight line of a limb to its elbow or knee."""
    start, middle, end = (joint(positions, name) for name in (start, middle, end))
    along = (end - start) / length(end - start)[..., None]
    way = middle - start
    return way - (way * along).sum(axis=-1, keepdims=True) * along


def test_bones_keep_their_lengths(positions):
    child, parent = np.array(PAIR.bones).T
    lengths = length(positions[:, :, child] - positions[:, :, parent])
    assert lengths.min() > 0.05
    np.testing.assert_allclose(lengths, lengths[:, :1].repeat(120, axis=1), rtol=0, atol=1e-9)
    # Left and right are alike.
    for left, right in PAIR.mirrored_pairs:
        bones = [list(child).index(j) for j in (left, right)]
        np.testing.assert_allclose(lengths[..., bones[0]], lengths[..., bones[1]], atol=1e-9)


def test_leader_and_follower_have_their_heights(positions):
    heights = person_height(positions[:, 0], PAIR)
    assert heights.mean(axis=0) == pytest.approx([1.7, 1.6], abs=0.02)
    assert heights.std(axis=0).min() > 0.005


def test_they_move_as_people_can(positions):
    speed = 30 * length(np.diff(positions, axis=1))
    assert speed.max() < 7
    assert 0.1 < np.median(speed) < 1
    assert all(dance_frames(dance).all() for dance in synthetic_dances(5))
    # Feet come down to the floor, never below, and nobody flies.
    for person in range(2):
        ankles = np.stack(
            [joint(positions, f"person{person}:{s}_ankle")[..., 1] for s in ("left", "right")]
        )
        assert ankles.min() > 0.05
        assert ankles.max() < 0.35
        assert ankles.min(axis=0).max() < 0.12


def test_standing_feet_stand_still(positions):
    """One foot of each is in the air at most; a foot on the floor does not slide."""
    for person in range(2):
        moves = np.stack(
            [
                30 * length(np.diff(joint(positions, f"person{person}:{s}_ankle"), axis=1))
                for s in ("left", "right")
            ]
        )
        assert (moves.min(axis=0) < 0.1).mean() > 0.9


def test_they_dance_with_each_other(positions):
    apart = length(positions[:, :, 0] - positions[:, :, 17])
    assert 0.45 < apart.min() < apart.max() < 0.95
    held = length(joint(positions, "person0:left_wrist") - joint(positions, "person1:right_wrist"))
    assert held.max() < 0.2  # two wrists and the hands between them
    # Chests face each other but for turns, in which someone goes all the way round.
    facing = [body_axes(positions, person, "shoulder", "neck")[2] for person in range(2)]
    cosine = (facing[0] * facing[1]).sum(axis=-1)
    assert np.median(cosine) < -0.85
    assert cosine.max() > 0.9
    # Some hand is over a head at some time, in some dance and not in another.
    over = joint(positions, "person0:left_wrist")[..., 1] > joint(positions, "person1:head")[..., 1]
    assert 0.2 < over.any(axis=1).mean() < 1


def test_knees_bend_forwards(positions):
    for person in range(2):
        forward = body_axes(positions, person, "hip", "spine")[2]
        for side in ("left", "right"):
            names = [f"person{person}:{side}_{part}" for part in ("hip", "knee", "ankle")]
            off = off_the_line(positions, *names)
            assert length(off).min() > 0.01
            assert ((off * forward).sum(axis=-1) / length(off)).min() > 0.5


def test_elbows_bend_the_natural_way(positions):
    """Down, out or back while the hand is low; never inwards where it is above the shoulder."""
    for person in range(2):
        left, up, forward = body_axes(positions, person, "shoulder", "neck")
        for side, sign in (("left", 1.0), ("right", -1.0)):
            names = [f"person{person}:{side}_{part}" for part in ("shoulder", "elbow", "wrist")]
            off = off_the_line(positions, *names)
            assert length(off).min() > 0.01
            off = off / length(off)[..., None]
            shoulder, wrist = joint(positions, names[0]), joint(positions, names[2])
            low = ((wrist - shoulder) * up).sum(axis=-1) < 0
            natural = 0.3 * sign * left - up - 0.5 * forward
            assert (off * natural).sum(axis=-1)[low].min() > 0
            high = ((wrist - shoulder) * up).sum(axis=-1) > 0.1
            outwards = (off * (sign * left + 0.5 * forward)).sum(axis=-1)
            assert outwards[high].min(initial=1.0) > 0


def test_a_dance_is_the_same_whatever_else_is_made():
    few, many = synthetic_dances(2, seed=3), synthetic_dances(5, seed=3)
    np.testing.assert_array_equal(few[1].positions, many[1].positions)
    assert [dance.name for dance in many] == [f"dance-{k}" for k in range(5)]
    assert not np.array_equal(few[1].positions, many[2].positions)
    assert not np.array_equal(few[1].positions, synthetic_dances(2, seed=4)[1].positions)
    # A longer clip begins with the shorter one; a finer one passes through its frames.
    longer = synthetic_dances(2, frames=700, seed=3)[1]
    np.testing.assert_allclose(longer.positions[:90], few[1].positions, atol=1e-12)
    finer = synthetic_dances(2, frames=179, fps=60.0, seed=3)[1]
    np.testing.assert_allclose(finer.positions[::2], few[1].positions, atol=1e-12)
    assert np.isfinite(longer.positions).all()


def test_a_limb_reaches_where_it_can():
    rng = np.random.default_rng(0)
    start, pole = rng.normal(size=(2, 200, 3))
    way = rng.normal(size=(200, 3))
    way /= length(way)[:, None]
    distance = rng.uniform(0.2, 0.45, size=(200, 1))
    middle, end = bent_limb(start, start + distance * way, (0.3, 0.25), pole)
    np.testing.assert_allclose(end, start + distance * way, atol=1e-4)
    np.testing.assert_allclose(length(middle - start), 0.3, atol=1e-12)
    np.testing.assert_allclose(length(end - middle), 0.25, atol=1e-12)
    assert (((middle - start) * pole).sum(-1) > ((end - start) * pole).sum(-1) * 0.3).any()
    square = pole - (pole * way).sum(-1, keepdims=True) * way
    assert ((middle - start) * square).sum(axis=-1).min() > 0
    # Out of reach it stretches towards the target, and is never quite straight or folded.
    for far in (5.0, 1e-3):
        middle, end = bent_limb(start, start + far * way, (0.3, 0.25), pole)
        np.testing.assert_allclose(length(end - middle), 0.25, atol=1e-12)
        np.testing.assert_allclose(np.cross(end - start, way), 0, atol=1e-9)
        assert 0.14 < length(end - start).min() <= length(end - start).max() < 0.5451


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="n must be an integer of at least 1, got 0"):
        synthetic_dances(0)
    with pytest.raises(ValueError, match="frames must be an integer of at least 1, got 0"):
        synthetic_dances(1, frames=0)
    with pytest.raises(ValueError, match=r"fps must be a finite number above 0, got -30\.0"):
        synthetic_dances(1, fps=-30.0)
