"""Enhanced lifting: it projects onto what was annotated and keeps bones, limits and depth."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.views import image_axes, pair_frames, project_to_views
from probmotion.interaction.completion import occluded_joint_error
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.single_pose_lifting import lift_people

PAIR = Skeleton.preset("pair17")
DANCE = synthetic_dances(1)[0].positions
SEED, VIEW = DANCE[10], np.array([0.7, 1.5])
ALL = np.ones(34, dtype=bool)
HIDDEN = np.isin(np.arange(34), [7, 13, 26])


def picture(pose, view=VIEW):
    return project_to_views(pose[None], view[None], PAIR)[0, 0]


def bone_lengths(pose):
    return np.array([np.linalg.norm(pose[j] - pose[parent]) for j, parent in PAIR.bones])


def person(pose):
    return pose[:17]


def test_bones_keep_the_seeds_lengths():
    lifted = lift_people(picture(DANCE[60]), ALL, SEED, PAIR, VIEW)
    np.testing.assert_allclose(bone_lengths(lifted), bone_lengths(SEED), rtol=1e-12)


def test_the_seeds_own_picture_lifts_to_the_seed():
    c, s = np.cos(0.5), np.sin(0.5)
    turned = picture(SEED) @ np.array([[c, s], [-s, c]]) + [2.0, -1.0]
    lifted = lift_people(turned, ALL, SEED, PAIR, VIEW, validity_weight=1e-9)
    np.testing.assert_allclose(lifted[:, :2], turned, atol=1e-6)
    # The third axis is depth: the pose is the seed, seen from elsewhere.
    apart = np.linalg.norm(lifted[:, None] - lifted[None], axis=-1)
    wanted = np.linalg.norm(SEED[:, None] - SEED[None], axis=-1)
    np.testing.assert_allclose(apart, wanted, atol=1e-6)


def test_the_depth_of_the_people_is_the_seeds():
    """No orthographic picture tells it, so nothing may move it, limits neither."""
    for frame in (30, 70):
        lifted = lift_people(picture(DANCE[frame]), ALL, SEED, PAIR, VIEW, validity_weight=1.0)
        right, up = image_axes(pair_frames(SEED[None], PAIR), VIEW[None])[0, :, 0].T
        depths = SEED[list(PAIR.roots)] @ np.cross(right, up)
        np.testing.assert_allclose(lifted[list(PAIR.roots), 2], depths, atol=1e-12)


def test_visible_joints_are_reprojected():
    """Without limits in the way, the annotation of a body of the seed's bones is met."""
    truth = picture(DANCE[30])
    start = np.linalg.norm(picture(SEED) - truth, axis=1).mean()
    lifted = lift_people(truth, ALL, SEED, PAIR, VIEW, validity_weight=1e-6, seed_weight=1e-8)
    assert np.linalg.norm(lifted[:, :2] - truth, axis=1).mean() < 0.02 * start


def test_limits_pull_towards_valid_poses():
    limits = JointLimits.shipped(PAIR)
    target = picture(DANCE[70])
    # A knee bent forward: no leg does this.
    target[16] = target[15] + 0.3 * (target[15] - target[14]) + [0.25, 0.2]

    def invalid(weight):
        pose = lift_people(target, ALL, SEED, PAIR, VIEW, validity_weight=weight)
        return np.linalg.norm(pose - limits.nearest_valid(pose))

    assert invalid(100.0) < 0.5 * invalid(1e-6)


def test_hidden_joints_are_not_read_and_stay_as_the_seed_has_them():
    near = picture(DANCE[12])
    lifted = [
        lift_people(
            np.where(HIDDEN[:, None], wrong, near), ~HIDDEN, SEED, PAIR, VIEW, validity_weight=1e-9
        )
        for wrong in (np.nan, 3.0)
    ]
    np.testing.assert_array_equal(*lifted)
    error = occluded_joint_error(near, lifted[0][:, :2], HIDDEN)
    assert error < 0.1 < occluded_joint_error(near, picture(SEED) + 0.5, HIDDEN)


def test_a_person_does_not_depend_on_the_other_ones_keypoints():
    whole = picture(DANCE[20])
    other = whole.copy()
    # A turn about the first person's middle would show in the common alignment only.
    other[17:] += 0.02 * np.random.default_rng(0).normal(size=(17, 2))
    first, second = (
        person(lift_people(keypoints, ALL, SEED, PAIR, VIEW, seed_weight=1e-8))
        for keypoints in (whole, other)
    )
    np.testing.assert_allclose(first[:, :2], second[:, :2], atol=5e-3)


def test_lifting_is_deterministic():
    twice = [lift_people(picture(DANCE[50]), ALL, SEED, PAIR, VIEW) for _ in range(2)]
    np.testing.assert_array_equal(*twice)


def test_bad_input_is_refused_in_a_sentence():
    seen = picture(SEED)
    with pytest.raises(ValueError, match="visible has 1 joints, expected at least 2"):
        lift_people(seen, np.arange(34) == 0, SEED, PAIR, VIEW)
    with pytest.raises(ValueError, match=r"view must have shape \(2\), got \(3,\)"):
        lift_people(seen, ALL, SEED, PAIR, np.zeros(3))
    with pytest.raises(ValueError, match="seed_weight must be a finite number above 0, got -1"):
        lift_people(seen, ALL, SEED, PAIR, VIEW, seed_weight=-1)
    with pytest.raises(
        ValueError, match="keypoints must be finite, got 2 values that are NaN or infinite"
    ):
        lift_people(np.where(np.arange(34)[:, None] == 5, np.nan, seen), ALL, SEED, PAIR, VIEW)


def test_limits_pull_bones_into_their_range():
    """A picture of knees that bend forwards is met less, and by poses that bodies can take."""
    limits = JointLimits.shipped(PAIR)
    wrong = DANCE[30].copy()
    for name in ("left", "right"):
        knee, ankle = (PAIR.index(f"person0:{name}_{part}") for part in ("knee", "ankle"))
        wrong[ankle] = wrong[knee] + 0.4 * np.array([0.5, 0.8, 0.3])
    seen = picture(wrong)

    def beyond(weight):
        lifted = lift_people(seen, ALL, SEED, PAIR, VIEW, validity_weight=weight)
        return np.linalg.norm(lifted - limits.nearest_valid(lifted))

    assert beyond(1.0) < 0.7 * beyond(1e-6)
