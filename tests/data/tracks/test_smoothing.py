"""Gap filling, smoothing and resampling against exact solutions."""

import numpy as np
import pytest

from probmotion.data.tracks.smoothing import fill_gaps, resample_tracks, smooth_tracks
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

BALL = Skeleton(["ball"], [-1])


def ball(path, fps=10.0, gaps=()):
    """Return a track of one joint along ``path`` (L, 2), unseen in the frames ``gaps``."""
    confidence = np.linspace(0.5, 0.9, len(path))[:, None]
    confidence[list(gaps)] = 0
    keypoints = np.where(confidence[..., None] > 0, path[:, None], np.nan)
    return KeypointTrack(keypoints, confidence, BALL, fps, "ball")


def line(frames, fps=10.0):
    time = np.arange(frames) / fps
    return np.stack([3 * time - 1, 2 - time], axis=-1)


def test_gaps_of_straight_paths_are_filled_exactly():
    track = ball(line(20), gaps=(0, 5, 6, 10, 11, 12, 19))
    (filled,), report = fill_gaps([track], longest=0.2)
    np.testing.assert_allclose(filled.keypoints[[5, 6], 0], line(20)[[5, 6]], atol=1e-12)
    unseen = [0, 10, 11, 12, 19]  # the ends, and a gap of .3 s
    np.testing.assert_array_equal(np.flatnonzero(filled.confidence[:, 0] == 0), unseen)
    assert np.isnan(filled.keypoints[unseen]).all()
    assert filled.confidence[5, 0] == filled.confidence[6, 0] == track.confidence[4, 0]
    assert report.entries_changed == 2
    assert fill_gaps([track], longest=0.3)[1].entries_changed == 5
    assert fill_gaps([filled], longest=0.2)[1].entries_changed == 0

    # PCHIP between flat ends does not overshoot: Hermite's 3 s² - 2 s³ at s = 1/3 and 2/3.
    step = np.repeat([[0.0], [1.0]], 6, axis=0) * np.ones(2)
    (filled,), _ = fill_gaps([ball(step, gaps=(5, 6))], longest=0.2)
    np.testing.assert_allclose(filled.keypoints[5:7, 0, 0], [7 / 27, 20 / 27], atol=1e-12)


def test_smoothing_reproduces_parabolas():
    time = np.arange(40) / 10
    path = np.stack([time**2 - 3 * time, 1 - 0.5 * time**2], axis=-1)
    track = ball(path, gaps=(9, 10, 17))
    (smoothed,), report = smooth_tracks([track], window=0.7)
    np.testing.assert_allclose(smoothed.keypoints, track.keypoints, atol=1e-10)
    np.testing.assert_array_equal(smoothed.confidence, track.confidence)
    assert report.entries_changed == 9 + 6 + 22
    # Runs of fewer than five frames are unchanged.
    short = ball(np.random.default_rng(0).normal(size=(9, 2)), gaps=(4,))
    assert smooth_tracks([short], window=0.7)[1].entries_changed == 0
    # The remaining variance of noise is the sum of squared weights, 3 (3 n² - 7) / (4 n (n² - 4)).
    noise = np.random.default_rng(1).normal(size=(4000, 2))
    (smoothed,), _ = smooth_tracks([ball(noise)], window=0.7)
    expected = 3 * (3 * 7**2 - 7) / (4 * 7 * (7**2 - 4))
    assert smoothed.keypoints[10:-10].var() == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize(("old", "new"), [(60, 20), (60, 25), (30, 30), (20, 50), (29.97, 20)])
def test_resampling_straight_paths_is_exact(old, new):
    (track,), report = resample_tracks([ball(line(61, old), old)], fps=new)
    assert track.fps == new
    np.testing.assert_allclose(track.keypoints[:, 0], line(track.frames, new), atol=1e-9)
    assert 0 <= 60 / old - (track.frames - 1) / new + 1e-9 < 1 / new + 1e-9
    confidence = 0.5 + 0.4 * np.arange(track.frames) / new * old / 60
    np.testing.assert_allclose(track.confidence[:, 0], confidence, atol=1e-9)
    assert report.frames_after == track.frames
    assert report.why == f"resampled {old:g} fps to {new:g}"


def test_resampled_frames_are_seen_if_their_neighbours_are():
    track = ball(line(13, 60), 60, gaps=(4, 6))
    (third,), _ = resample_tracks([track], fps=20)  # frames 0 3 6 9 12
    np.testing.assert_array_equal(third.confidence[:, 0] > 0, [True, True, False, True, True])
    np.testing.assert_array_equal(third.keypoints[1], track.keypoints[3])
    assert np.isnan(third.keypoints[2]).all()
    # With rounded frame rates, 3.0000000000000004 old frames per new one count as 3.
    rounded = ball(line(13), 1 / 0.016667, gaps=(4, 8))
    (third,), _ = resample_tracks([rounded], fps=1 / 0.050001)
    np.testing.assert_array_equal(third.confidence[:, 0] > 0, np.ones(5, dtype=bool))
    (doubled,), _ = resample_tracks([track], fps=120)
    unseen = np.flatnonzero(doubled.confidence[:, 0] == 0)
    np.testing.assert_array_equal(unseen, [7, 8, 9, 11, 12, 13])
    single = ball(line(1))
    assert resample_tracks([single], fps=3)[0][0].frames == 1


@pytest.mark.parametrize(
    ("step", "options"),
    [
        (resample_tracks, {"fps": None}),
        (resample_tracks, {"fps": 20000}),
        (fill_gaps, {"longest": 0}),
        (smooth_tracks, {"window": -1}),
    ],
)
def test_invalid_options(step, options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))} must be"):
        step([ball(line(5))], **options)
