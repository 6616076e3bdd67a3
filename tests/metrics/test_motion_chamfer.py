"""Motion Chamfer Distance: hand-computed values, a plain double loop and windows."""

import numpy as np
import pytest

from probmotion.metrics.motion_chamfer import motion_chamfer_distance


def pair_error(generated, real, visible):
    """Return the mean over frames of the mean squared error of visible keypoints."""
    squares = ((generated - real) ** 2).sum(axis=-1)
    return np.mean([squares[t][visible[t]].mean() for t in range(len(real)) if visible[t].any()])


def double_loop(generated, real, visible):
    errors = np.array(
        [[pair_error(g, r, v) for r, v in zip(real, visible, strict=True)] for g in generated]
    )
    return errors.min(axis=1).mean(), errors.min(axis=0).mean()


def test_both_directions_by_hand():
    # One frame of one joint on a line: generated at 0 and 10, real at 1, 4 and 10.
    generated = np.array([0.0, 10.0]).reshape(2, 1, 1, 1) * [1, 0]
    real = np.array([1.0, 4.0, 10.0]).reshape(3, 1, 1, 1) * [1, 0]
    result = motion_chamfer_distance(generated, real, frames=1)
    assert result.of_generated == pytest.approx((1 + 0) / 2)
    assert result.of_real == pytest.approx((1 + 16 + 0) / 3)
    assert result.mean == pytest.approx((1 / 2 + 17 / 3) / 2)


def test_frames_have_equal_weight():
    # The squared errors are 9 and 1 in the first frame, 4 and (occluded) 100 in the second.
    generated = np.zeros((1, 2, 2, 2))
    real = np.array([[[[3, 0], [0, 1]], [[0, 2], [10, 0]]]], float)
    visible = np.array([[[True, True], [True, False]]])
    real[0, 1, 1] = np.nan
    result = motion_chamfer_distance(generated, real, visible=visible, frames=2)
    assert result.mean == result.of_real == result.of_generated == pytest.approx((5 + 4) / 2)
    visible[0, 1] = False  # fully occluded frames are skipped
    result = motion_chamfer_distance(generated, real, visible=visible, frames=2)
    assert result.mean == pytest.approx(5)


@pytest.mark.parametrize(("n", "m"), [(14, 9), (257, 2), (2, 258)])
def test_agreement_with_a_plain_double_loop(rng, n, m):
    generated, real = rng.normal(size=(n, 3, 3, 2)), rng.normal(size=(m, 3, 3, 2))
    visible = rng.random((m, 3, 3)) < 0.5
    visible[:, 0, 0] = True
    masked = np.where(visible[..., None], real, np.nan)
    result = motion_chamfer_distance(generated, masked, visible=visible, frames=3)
    np.testing.assert_allclose(result, double_loop(generated, real, visible), rtol=1e-12)


def test_longer_sequences_are_split_into_windows(rng):
    generated, real = rng.normal(size=(5, 9, 2, 2)), rng.normal(size=(4, 6, 2, 2))
    windows = real.reshape(8, 3, 2, 2)
    seen = np.ones((8, 3, 2), bool)
    results = [double_loop(generated[:, start : start + 3], windows, seen) for start in (0, 3, 6)]
    result = motion_chamfer_distance(generated, real, frames=3)
    np.testing.assert_allclose(result, np.mean(results, axis=0))


GOOD = np.zeros((3, 10, 2, 2))
SEEN = np.arange(3)[:, None, None] != np.ones((10, 2))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 4}, "generated must have a multiple of frames=4 frames, got 10"),
        ({"real": GOOD[:, 1:]}, "real must have a multiple of frames=10 frames, got 9"),
        ({"real": GOOD[:, :, 1:]}, r"real must have shape \(M, L, 2, 2\), got \(3, 10, 1, 2\)"),
        ({"generated": GOOD[:0]}, "generated must contain at least one sequence"),
        ({"generated": GOOD + np.nan}, "generated must be finite, got 120 values"),
        ({"visible": SEEN.astype(int)}, "visible must be boolean, got int64"),
        ({"visible": SEEN}, "visible must contain a keypoint in every real window, .* window 1"),
    ],
)
def test_invalid_arguments(changes, message):
    with pytest.raises(ValueError, match=message):
        motion_chamfer_distance(**({"generated": GOOD, "real": GOOD} | changes))
