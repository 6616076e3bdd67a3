"""The Motion Chamfer Distance: by hand, against a plain double loop, and what changes nothing."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.metrics.motion_chamfer import motion_chamfer_distance


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def pair_error(generated: np.ndarray, real: np.ndarray, visible: np.ndarray) -> float:
    """The mean, over frames that have a visible keypoint, of the mean square over those."""
    in_frames = []
    for frame in range(len(real)):
        squares = [
            float(((generated[frame, joint] - real[frame, joint]) ** 2).sum())
            for joint in range(real.shape[1])
            if visible[frame, joint]
        ]
        if squares:
            in_frames.append(sum(squares) / len(squares))
    return sum(in_frames) / len(in_frames)


def plain(generated: np.ndarray, real: np.ndarray, visible: np.ndarray) -> tuple[float, float]:
    errors = np.array(
        [[pair_error(g, r, v) for r, v in zip(real, visible, strict=True)] for g in generated]
    )
    return errors.min(axis=1).mean(), errors.min(axis=0).mean()


def test_by_hand() -> None:
    # One frame, one joint: generated at 0 and 10, real at 1, 4 and 10 on a line.
    generated = np.array([0.0, 10.0]).reshape(2, 1, 1, 1) * [1, 0]
    real = np.array([1.0, 4.0, 10.0]).reshape(3, 1, 1, 1) * [1, 0]
    found = motion_chamfer_distance(generated, real, frames=1)
    # Nearest to the generated: 1² and 0. To the real ones: 1², 4² and 0.
    assert found.of_generated == pytest.approx((1 + 0) / 2)
    assert found.of_real == pytest.approx((1 + 16 + 0) / 3)
    assert found.mean == pytest.approx((1 / 2 + 17 / 3) / 2)


def test_frames_count_alike_whatever_is_visible() -> None:
    # Two frames of two joints; errors² 9 and 1 in the first, 4 and (hidden) 100 in the second.
    generated = np.zeros((1, 2, 2, 2))
    real = np.array([[[[3, 0], [0, 1]], [[0, 2], [10, 0]]]], float)
    visible = np.array([[[True, True], [True, False]]])
    real[0, 1, 1] = np.nan
    found = motion_chamfer_distance(generated, real, visible=visible, frames=2)
    assert found.mean == found.of_real == found.of_generated == pytest.approx((5 + 4) / 2)
    # A frame in which nothing is visible does not count.
    visible[0, 1] = False
    found = motion_chamfer_distance(generated, real, visible=visible, frames=2)
    assert found.mean == pytest.approx(5)


def test_a_plain_double_loop_says_the_same(rng: np.random.Generator) -> None:
    generated, real = rng.normal(size=(14, 10, 3, 2)), rng.normal(size=(9, 10, 3, 2))
    visible = rng.random((9, 10, 3)) < 0.5
    unseen = np.where(visible[..., None], real, np.nan)
    found = motion_chamfer_distance(generated, unseen, visible=visible)
    np.testing.assert_allclose(found, plain(generated, real, visible), rtol=1e-12)
    found = motion_chamfer_distance(generated, real)
    np.testing.assert_allclose(found, plain(generated, real, np.ones_like(visible)), rtol=1e-12)


def test_blocks_change_nothing(rng: np.random.Generator) -> None:
    generated, real = rng.normal(size=(300, 2, 2, 2)), rng.normal(size=(270, 2, 2, 2))
    errors = ((generated[:, None] - real) ** 2).sum(axis=-1).mean(axis=(-2, -1))
    found = motion_chamfer_distance(generated, real, frames=2)
    np.testing.assert_allclose(found, (errors.min(axis=1).mean(), errors.min(axis=0).mean()))


def test_copies_are_at_no_distance_and_need_not_cover(rng: np.random.Generator) -> None:
    real = rng.normal(size=(6, 10, 4, 2))
    assert motion_chamfer_distance(real[::-1], real).mean == pytest.approx(0, abs=1e-12)
    one = motion_chamfer_distance(real[[0, 0, 0]], real)
    assert one.of_generated == pytest.approx(0, abs=1e-12)
    assert one.of_real > 1


def test_orders_and_place_change_nothing_and_scale_its_square(rng: np.random.Generator) -> None:
    generated, real = rng.normal(size=(14, 10, 3, 2)), rng.normal(size=(9, 10, 3, 2))
    found = motion_chamfer_distance(generated, real)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s], [s, c]])
    again = motion_chamfer_distance(generated[::-1] @ turn + 4, real[::-1] @ turn + 4)
    np.testing.assert_allclose(again, found)
    np.testing.assert_allclose(
        motion_chamfer_distance(3 * generated, 3 * real), np.array(found) * 9
    )
    # Exchanged sets exchange the directions.
    np.testing.assert_allclose(motion_chamfer_distance(real, generated), found[::-1])


def test_worse_is_worse(rng: np.random.Generator) -> None:
    phases = rng.uniform(0, 2 * np.pi, size=(40, 1, 1, 1))
    time = np.arange(10).reshape(10, 1, 1) / 10
    walks = np.sin(2 * np.pi * time + phases + np.arange(4).reshape(2, 2))
    real, generated = walks[:20], walks[20:]
    good = motion_chamfer_distance(generated, real)
    noisy = motion_chamfer_distance(generated + 0.3 * rng.normal(size=generated.shape), real)
    backwards = motion_chamfer_distance(generated[:, ::-1], real)
    still = motion_chamfer_distance(generated[:, :1].repeat(10, axis=1), real)
    for bad in (noisy, backwards, still):
        assert bad.of_generated > 2 * good.of_generated
        assert bad.mean > good.mean


def test_longer_sequences_are_cut(rng: np.random.Generator) -> None:
    generated, real = rng.normal(size=(5, 9, 2, 2)), rng.normal(size=(4, 6, 2, 2))
    pieces = real.reshape(8, 3, 2, 2)  # all windows of the real ones are one set
    seen = np.ones((8, 3, 2), bool)
    places = [plain(generated[:, start : start + 3], pieces, seen) for start in (0, 3, 6)]
    found = motion_chamfer_distance(generated, real, frames=3)
    np.testing.assert_allclose(found, np.mean(places, axis=0))


def test_bad_input(rng: np.random.Generator) -> None:
    motions = rng.normal(size=(3, 10, 2, 2))
    with pytest.raises(ValueError, match="generated has sequences of 10 frames, expected a mult"):
        motion_chamfer_distance(motions, motions, frames=4)
    with pytest.raises(ValueError, match="real has sequences of 9 frames, expected a multiple"):
        motion_chamfer_distance(motions, motions[:, 1:])
    with pytest.raises(ValueError, match=r"real has shape \(3, 10, 1, 2\), expected"):
        motion_chamfer_distance(motions, motions[:, :, 1:])
    with pytest.raises(
        ValueError, match=r"generated must have shape at least, got \(0, 10, 2, 2\)"
    ):
        motion_chamfer_distance(motions[:0], motions)
    broken = motions.copy()
    broken[0, 0, 0, 0] = np.nan
    with pytest.raises(
        ValueError, match="generated must be finite, got 1 values that are NaN or infinite"
    ):
        motion_chamfer_distance(broken, motions)
    seen = np.ones((3, 10, 2), bool)
    with pytest.raises(ValueError, match="visible has entries of int64, expected truth values"):
        motion_chamfer_distance(motions, motions, visible=seen.astype(int))
    seen[1] = False
    with pytest.raises(ValueError, match="visible has nothing in window 1 of the real sequences"):
        motion_chamfer_distance(motions, motions, visible=seen)
