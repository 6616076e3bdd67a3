"""Bone sizes and scaling of tracks to metres."""

import numpy as np
import pytest

from probmotion.data.tracks.scales import bone_sizes, scale_to_bones
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

CHAIN = Skeleton(["root", "knee", "ankle"], [-1, 0, 1])


def leg(thighs, shins):
    """Return a hanging leg with the given lengths in each frame."""
    y = np.stack([np.zeros(len(thighs)), thighs, np.add(thighs, shins)], axis=-1)
    keypoints = np.stack([np.zeros_like(y), y], axis=-1)
    return KeypointTrack(keypoints, np.ones(y.shape), CHAIN, 30, "leg")


def test_sizes_are_90_percent_quantiles_over_seen_frames():
    track = leg(np.arange(11.0), np.full(11, 2.0))
    assert bone_sizes([track]) == pytest.approx({"knee": 9.0, "ankle": 2.0})
    partial = leg(np.arange(11.0), np.full(11, 2.0))
    partial.confidence[9:, 1], partial.keypoints[9:, 1] = 0, np.nan  # thighs of 0 to 8 remain
    assert bone_sizes([partial])["knee"] == pytest.approx(7.2)
    both = np.quantile([*range(11), *range(9)], 0.9)
    assert bone_sizes([track, partial])["knee"] == pytest.approx(both)
    partial.confidence[:, 2], partial.keypoints[:, 2] = 0, np.nan
    assert list(bone_sizes([partial])) == ["knee"]


def test_factor_is_the_median_over_bones():
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
    keypoints = np.tile([[0.0, 0], [2, 0], [0, 4], [8, 0]], (5, 1, 1))
    track = KeypointTrack(keypoints, np.ones((5, 4)), skeleton, 30)
    sizes = {"b": 1.0, "c": 1.0, "d": 80.0, "tail": 3.0}  # factors 1/2, 1/4 and 10
    (scaled,), report = scale_to_bones([track], sizes)
    np.testing.assert_allclose(scaled.keypoints, 0.5 * keypoints)
    assert "by 0.5 to 0.5" in report.why


def test_tracks_without_a_bone_are_dropped():
    shown, flat = leg(np.ones(4), np.ones(4)), leg(np.zeros(4), np.zeros(4))
    root_only = KeypointTrack(np.ones((4, 3, 2)), np.tile([1.0, 0, 0], (4, 1)), CHAIN, 30)
    (scaled,), report = scale_to_bones([root_only, shown, flat], {"knee": 0.4})
    np.testing.assert_allclose(scaled.keypoints, 0.4 * shown.keypoints)
    assert (report.tracks_dropped, report.frames_dropped) == (2, 8)
    assert "; tracks without one: 2" in report.why
    assert scale_to_bones([], {"knee": 0.4})[0] == []


TRACK = leg(np.ones(3), np.ones(3))
DOTS = KeypointTrack(TRACK.keypoints, TRACK.confidence, Skeleton(["a", "b", "c"], [-1] * 3), 30)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bone_sizes([]), "tracks must contain at least one, got none"),
        (lambda: bone_sizes([TRACK, DOTS]), r"tracks must have one skeleton, got another"),
        (lambda: scale_to_bones([TRACK], {}), "sizes must contain the size of at least one bone"),
        (lambda: scale_to_bones([TRACK], {"knee": 0.0}), r"sizes\['knee'\] must be a finite"),
        (lambda: scale_to_bones([TRACK], {"tail": 1.0}), r"track 'leg' \(ankle, knee\), got tail"),
        (lambda: scale_to_bones([DOTS], {"knee": 1.0}), r"\(which has none\), got knee"),
    ],
)
def test_invalid_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()
