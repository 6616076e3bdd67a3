"""Lifting of single poses: reprojection, bone lengths, joint limits and depth."""

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
OCCLUDED = np.isin(np.arange(34), [7, 13, 26])


def projection(pose):
    return project_to_views(pose[None], VIEW[None], PAIR)[0, 0]


def lift(keypoints, visible=ALL, view=VIEW, **options):
    return lift_people(keypoints, visible, SEED, PAIR, view, **options)


def bone_lengths(pose):
    return np.array([np.linalg.norm(pose[j] - pose[parent]) for j, parent in PAIR.bones])


def test_bone_lengths_and_depths_of_people_are_those_of_the_seed():
    right, up = image_axes(pair_frames(SEED[None], PAIR), VIEW[None])[0, :, 0].T
    roots = list(PAIR.roots)
    depths = SEED[roots] @ np.cross(right, up)
    for frame in (30, 60):
        lifted = lift(projection(DANCE[frame]), validity_weight=1.0, rounds=2)
        np.testing.assert_allclose(bone_lengths(lifted), bone_lengths(SEED), rtol=1e-12)
        np.testing.assert_allclose(lifted[roots, 2], depths, atol=1e-12)


def test_projection_of_the_seed_is_lifted_to_the_seed():
    c, s = np.cos(0.5), np.sin(0.5)
    rotated = projection(SEED) @ np.array([[c, s], [-s, c]]) + [2.0, -1.0]
    lifted = lift(rotated, validity_weight=1e-9)
    np.testing.assert_allclose(lifted[:, :2], rotated, atol=1e-6)
    distances = (np.linalg.norm(pose[:, None] - pose[None], axis=-1) for pose in (lifted, SEED))
    np.testing.assert_allclose(*distances, atol=1e-6)


def test_visible_joints_are_reprojected():
    truth = projection(DANCE[30])
    start = np.linalg.norm(projection(SEED) - truth, axis=1).mean()
    lifted = lift(truth, validity_weight=1e-6, seed_weight=1e-8)
    assert np.linalg.norm(lifted[:, :2] - truth, axis=1).mean() < 0.02 * start


def test_occluded_joints_are_ignored_and_stay_close_to_the_seed():
    keypoints = projection(DANCE[12])
    lifted = [
        lift(np.where(OCCLUDED[:, None], value, keypoints), ~OCCLUDED, validity_weight=1e-9)
        for value in (np.nan, 3.0)
    ]
    np.testing.assert_array_equal(*lifted)
    error = occluded_joint_error(keypoints, lifted[0][:, :2], OCCLUDED)
    assert error < 0.1 < occluded_joint_error(keypoints, projection(SEED) + 0.5, OCCLUDED)


def test_joint_limits_pull_bones_into_their_range():
    """The keypoints are the projection of a pose with knees bent forwards."""
    limits = JointLimits.shipped(PAIR)
    wrong = DANCE[30].copy()
    for side in ("left", "right"):
        knee, ankle = (PAIR.index(f"person0:{side}_{part}") for part in ("knee", "ankle"))
        wrong[ankle] = wrong[knee] + 0.4 * np.array([0.5, 0.8, 0.3])

    def excess(weight):
        lifted = lift(projection(wrong), validity_weight=weight)
        return np.linalg.norm(lifted - limits.nearest_valid(lifted))

    assert excess(1.0) < 0.7 * excess(1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"visible": np.arange(34) == 0}, "visible must mark at least 2 joints, got 1"),
        ({"view": np.zeros(3)}, r"view must have shape \(2\), got \(3,\)"),
        ({"seed_weight": -1}, "seed_weight must be a finite number above 0, got -1"),
        ({"keypoints": np.full((34, 2), np.nan)}, "keypoints must be finite, got 68 values"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        lift(**{"keypoints": projection(SEED)} | arguments)
