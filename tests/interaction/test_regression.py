"""Ridge completion of annotations on data with a known linear structure."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.interaction.regression import ridge_completion

J = 8
VISIBLE = np.array([True] * 6 + [False] * 2)


def annotations(n: int, noise: float, seed: int = 0) -> np.ndarray:
    """Return poses in which the last two joints are linear in the others, at any place."""
    fixed = np.random.default_rng(11)
    base, parts = fixed.normal(size=(J, 2)), 0.1 * fixed.normal(size=(6, J, 2))
    rng = np.random.default_rng(seed)
    poses = base + np.tensordot(rng.normal(size=(n, 6)), parts, 1)
    poses[:, ~VISIBLE] += noise * rng.standard_normal((n, 2, 2))
    return poses


def test_linear_poses_are_completed_at_any_place() -> None:
    poses = annotations(820, 0.0)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    banked = poses[20:] @ turn + np.random.default_rng(1).normal(size=(800, 1, 2))
    errors, spread = [], []
    for pose in poses[:20]:
        result = ridge_completion(pose, VISIBLE, banked, n_nearest=400, ridge=1e-3)
        np.testing.assert_array_equal(result.positions[VISIBLE], pose[VISIBLE])
        errors.append(np.linalg.norm(result.positions - pose, axis=-1)[~VISIBLE].mean())
        spread.append(np.linalg.norm(poses.mean(axis=0) - pose, axis=-1)[~VISIBLE].mean())
    # Rigid alignment makes the relation slightly curved.
    assert np.mean(errors) < 0.1 * np.mean(spread)


def test_occluded_joints_do_not_matter_and_incomplete_annotations_are_left_out() -> None:
    poses = annotations(301, 0.01)
    asked = poses[0].copy()
    asked[~VISIBLE] = np.nan
    incomplete = np.concatenate([poses[1:], np.full((1, J, 2), np.nan)])
    expected = ridge_completion(poses[0], VISIBLE, poses[1:], n_nearest=300)
    result = ridge_completion(asked, VISIBLE, incomplete, n_nearest=300)
    np.testing.assert_array_equal(result.positions, expected.positions)


def test_intervals_hold_nine_in_ten() -> None:
    poses, bank = annotations(150, 0.05, seed=1), annotations(1500, 0.05, seed=2)
    within = []
    for pose in poses:
        result = ridge_completion(pose, VISIBLE, bank, ridge=0.01)
        within.append(np.abs(result.positions - pose)[~VISIBLE] < 1.645 * result.sd[~VISIBLE])
    assert 0.85 < np.mean(within) < 0.95


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_nearest": 500}, r"at least n_nearest \(500\) complete annotations, got 100"),
        ({"ridge": 0.0}, "ridge must be"),
        ({"visible": np.arange(J) < 3}, "at least 4 joints, got 3"),
        ({"keypoints": np.full((J, 2), np.nan)}, "keypoints must be finite"),
        ({"annotated": np.zeros((9, J + 1, 2))}, "annotated must have shape"),
    ],
)
def test_bad_input_is_refused(settings: dict, message: str) -> None:
    poses = annotations(100, 0.01)
    given = {"keypoints": poses[0], "visible": VISIBLE, "annotated": poses, "n_nearest": 50}
    with pytest.raises(ValueError, match=message):
        ridge_completion(**(given | settings))
