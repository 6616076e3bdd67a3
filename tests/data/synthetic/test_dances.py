"""Procedural dances: constant bones, contacts, holds and anatomical bends."""

import numpy as np
import pytest

from probmotion.data.pair_sets import dance_frames, person_height
from probmotion.data.synthetic.dances import bent_limb, synthetic_dances
from probmotion.motion.skeleton import Skeleton

PAIR = Skeleton.preset("pair17")
SIDES = {"left": 1.0, "right": -1.0}


@pytest.fixture(scope="module")
def positions():
    """Joint positions, (dance, frame, joint, axis)."""
    return np.stack([dance.positions for dance in synthetic_dances(30, frames=120)])


def joint(positions, name):
    return positions[:, :, PAIR.index(name)]


def length(vectors):
    return np.linalg.norm(vectors, axis=-1)


def body_axes(positions, person, low, high):
    """Return the left, up and forward directions of a person's pelvis or chest."""
    sides = [joint(positions, f"person{person}:{side}_{low}") for side in SIDES]
    left = sides[0] - sides[1]
    up = joint(positions, f"person{person}:{high}") - joint(positions, f"person{person}:pelvis")
    left, up = left / length(left)[..., None], up / length(up)[..., None]
    return left, up, np.cross(left, up)


def limb(positions, person, side, names):
    """Return the vector from start to end, and the direction of the bend at elbow or knee."""
    start, middle, end = (joint(positions, f"person{person}:{side}_{name}") for name in names)
    along = (end - start) / length(end - start)[..., None]
    bend = middle - start - ((middle - start) * along).sum(axis=-1, keepdims=True) * along
    assert length(bend).min() > 0.01
    return end - start, bend / length(bend)[..., None]


def test_bones_have_constant_symmetric_lengths(positions):
    child, parent = np.array(PAIR.bones).T
    lengths = length(positions[:, :, child] - positions[:, :, parent])
    assert lengths.min() > 0.05
    np.testing.assert_allclose(lengths, lengths[:, :1].repeat(120, axis=1), rtol=0, atol=1e-9)
    for left, right in PAIR.mirrored_pairs:
        bones = [list(child).index(j) for j in (left, right)]
        np.testing.assert_allclose(lengths[..., bones[0]], lengths[..., bones[1]], atol=1e-9)


def test_heights_speeds_and_feet_are_plausible(positions):
    heights = person_height(positions[:, 0], PAIR)
    assert heights.mean(axis=0) == pytest.approx([1.7, 1.6], abs=0.02)
    assert heights.std(axis=0).min() > 0.005
    speed = 30 * length(np.diff(positions, axis=1))
    assert speed.max() < 7
    assert 0.1 < np.median(speed) < 1
    assert all(dance_frames(dance).all() for dance in synthetic_dances(5))
    for person in range(2):
        # Feet reach the floor, one foot is always close to it, and the stance foot does not slide.
        ankles = np.stack([joint(positions, f"person{person}:{s}_ankle") for s in SIDES])
        heights = ankles[..., 1]
        assert 0.05 < heights.min() < heights.max() < 0.35
        assert heights.min(axis=0).max() < 0.12
        slowest = 30 * length(np.diff(ankles, axis=2)).min(axis=0)
        assert (slowest < 0.1).mean() > 0.9


def test_partners_hold_hands_and_face_each_other(positions):
    distance = length(positions[:, :, 0] - positions[:, :, 17])
    assert 0.45 < distance.min() < distance.max() < 0.95
    gap = length(joint(positions, "person0:left_wrist") - joint(positions, "person1:right_wrist"))
    assert gap.max() < 0.2
    # Chests face each other except in turns.
    facing = [body_axes(positions, person, "shoulder", "neck")[2] for person in range(2)]
    cosine = (facing[0] * facing[1]).sum(axis=-1)
    assert np.median(cosine) < -0.85
    assert cosine.max() > 0.9
    # Hands are raised in some dances.
    wrist, head = (joint(positions, n) for n in ("person0:left_wrist", "person1:head"))
    assert 0.2 < (wrist > head)[..., 1].any(axis=1).mean() < 1


def test_knees_and_elbows_bend_anatomically(positions):
    for person in range(2):
        knees = body_axes(positions, person, "hip", "spine")[2]
        left, up, forward = body_axes(positions, person, "shoulder", "neck")
        for side, sign in SIDES.items():
            _, bend = limb(positions, person, side, ("hip", "knee", "ankle"))
            assert (bend * knees).sum(axis=-1).min() > 0.5
            # Elbows point down, out or back if the hand is low, and not inwards if it is raised.
            reach, bend = limb(positions, person, side, ("shoulder", "elbow", "wrist"))
            height = (reach * up).sum(axis=-1)
            natural = 0.3 * sign * left - up - 0.5 * forward
            assert (bend * natural).sum(axis=-1)[height < 0].min() > 0
            outwards = (bend * (sign * left + 0.5 * forward)).sum(axis=-1)
            assert outwards[height > 0.1].min(initial=1.0) > 0


def test_dance_does_not_depend_on_other_dances():
    two, five = synthetic_dances(2, seed=3), synthetic_dances(5, seed=3)
    np.testing.assert_array_equal(two[1].positions, five[1].positions)
    assert [dance.name for dance in five] == [f"dance-{k}" for k in range(5)]
    for other in (five[2], synthetic_dances(2, seed=4)[1]):
        assert not np.array_equal(two[1].positions, other.positions)
    # Clips of another length or frame rate are samples of the same dance.
    longer = synthetic_dances(2, frames=700, seed=3)[1]
    np.testing.assert_allclose(longer.positions[:90], two[1].positions, atol=1e-12)
    finer = synthetic_dances(2, frames=179, fps=60.0, seed=3)[1]
    np.testing.assert_allclose(finer.positions[::2], two[1].positions, atol=1e-12)


def test_limb_reaches_its_target():
    rng = np.random.default_rng(0)
    start, pole = rng.normal(size=(2, 200, 3))
    direction = rng.normal(size=(200, 3))
    direction /= length(direction)[:, None]
    distance = rng.uniform(0.2, 0.45, size=(200, 1))
    middle, end = bent_limb(start, start + distance * direction, (0.3, 0.25), pole)
    np.testing.assert_allclose(end, start + distance * direction, atol=1e-4)
    np.testing.assert_allclose(length(middle - start), 0.3, atol=1e-12)
    np.testing.assert_allclose(length(end - middle), 0.25, atol=1e-12)
    normal = pole - (pole * direction).sum(-1, keepdims=True) * direction
    assert ((middle - start) * normal).sum(axis=-1).min() > 0
    # Targets out of reach are approached without full extension or flexion.
    for far in (5.0, 1e-3):
        middle, end = bent_limb(start, start + far * direction, (0.3, 0.25), pole)
        np.testing.assert_allclose(length(end - middle), 0.25, atol=1e-12)
        np.testing.assert_allclose(np.cross(end - start, direction), 0, atol=1e-9)
        assert 0.14 < length(end - start).min() <= length(end - start).max() < 0.5451


@pytest.mark.parametrize("options", [{"n": 0}, {"frames": 0}, {"fps": -30.0}])
def test_invalid_options(options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))} must be "):
        synthetic_dances(**options)
