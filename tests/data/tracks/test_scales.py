"""Bone sizes and metres: recovered from pictures of any scale."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.tracks.scales import bone_sizes, scale_to_bones
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

CHAIN = Skeleton(["root", "knee", "ankle"], [-1, 0, 1])


def chain(thighs: np.ndarray, shins: np.ndarray, scale: float = 1.0) -> KeypointTrack:
    """A leg that hangs down with the lengths of each frame."""
    zero = np.zeros_like(thighs)
    y = np.stack([zero, thighs, thighs + shins], axis=-1) * scale
    keypoints = np.stack([np.zeros_like(y), y], axis=-1)
    return KeypointTrack(keypoints, np.ones(y.shape), CHAIN, 30, "leg")


def test_sizes_are_the_ninety_percent_quantile_over_seen_frames() -> None:
    track = chain(np.arange(11.0), np.full(11, 2.0))
    assert bone_sizes([track]) == pytest.approx({"knee": 9.0, "ankle": 2.0})
    confidence, keypoints = track.confidence.copy(), track.keypoints.copy()
    confidence[9:, 1], keypoints[9:, 1] = 0, np.nan  # thighs of 0 to 8 are left
    hidden = KeypointTrack(keypoints, confidence, CHAIN, 30)
    assert bone_sizes([hidden])["knee"] == pytest.approx(7.2)
    assert bone_sizes([track, hidden])["knee"] == pytest.approx(
        np.quantile([*range(11), *range(9)], 0.9)
    )
    confidence[:, 2], keypoints[:, 2] = 0, np.nan
    assert list(bone_sizes([KeypointTrack(keypoints, confidence, CHAIN, 30)])) == ["knee"]


def test_the_factor_is_the_median_over_bones() -> None:
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
    keypoints = np.tile([[0.0, 0], [2, 0], [0, 4], [8, 0]], (5, 1, 1))
    track = KeypointTrack(keypoints, np.ones((5, 4)), skeleton, 30)
    sizes = {"b": 1.0, "c": 1.0, "d": 80.0, "tail": 3.0}  # factors 1/2, 1/4 and 10
    (scaled,), report = scale_to_bones([track], sizes)
    np.testing.assert_allclose(scaled.keypoints, 0.5 * keypoints)
    assert "by 0.5 to 0.5" in report.why


def pictures(motion: Motion, scale: float, offset: float) -> KeypointTrack:
    """The motion as seen from +z without perspective, in pixels."""
    keypoints = scale * motion.positions[..., :2] * [1, -1] + offset
    return KeypointTrack(
        keypoints, np.ones(keypoints.shape[:2]), motion.skeleton, motion.fps, motion.name
    )


def test_pictures_of_any_scale_come_back_in_metres() -> None:
    motions = [
        motion.turned(yaw)
        for yaw, motion in zip(np.linspace(0, 3, 12), make_gaits(12, frames=60), strict=True)
    ]
    metric = [pictures(motion, 1.0, 0.0) for motion in motions]
    sizes = bone_sizes(metric)
    scales = np.geomspace(20, 500, 12)
    pixels = [pictures(m, s, 700.0) for m, s in zip(motions, scales, strict=True)]
    scaled, report = scale_to_bones(pixels, sizes)
    assert (report.tracks_dropped, report.frames_dropped) == (0, 0)
    for own, truth in zip(scaled, metric, strict=True):
        ratio = np.ptp(own.keypoints) / np.ptp(truth.keypoints)
        assert ratio == pytest.approx(1, abs=0.15)
    again, _ = scale_to_bones(scaled, sizes)
    np.testing.assert_allclose(again[3].keypoints, scaled[3].keypoints, rtol=1e-9)


def test_tracks_without_a_bone_are_dropped_and_reported() -> None:
    one = np.ones(4)
    shown = chain(one, one)
    points = np.full((4, 3, 2), np.nan)
    points[:, 0] = 1.0
    rootless = KeypointTrack(points, np.isfinite(points[..., 0]).astype(float), CHAIN, 30)
    flat = chain(0 * one, 0 * one)
    kept, report = scale_to_bones([rootless, shown, flat], {"knee": 0.4})
    np.testing.assert_allclose(kept[0].keypoints, 0.4 * shown.keypoints)
    assert (report.tracks_dropped, report.frames_dropped, len(kept)) == (2, 8, 1)
    assert scale_to_bones([], {"knee": 0.4})[0] == []


def test_bad_input_is_one_sentence() -> None:
    track = chain(np.ones(3), np.ones(3))
    other = KeypointTrack(
        track.keypoints, track.confidence, Skeleton(["a", "b", "c"], [-1] * 3), 30
    )
    with pytest.raises(ValueError, match="tracks must contain at least one, got none"):
        bone_sizes([])
    with pytest.raises(ValueError, match=r"tracks\[1\] has another skeleton than tracks\[0\]"):
        bone_sizes([track, other])
    with pytest.raises(
        ValueError, match="sizes must contain the size of at least one bone, got none"
    ):
        scale_to_bones([track], {})
    with pytest.raises(ValueError, match=r"sizes\['knee'\] is 0.0, expected"):
        scale_to_bones([track], {"knee": 0.0})
    with pytest.raises(ValueError, match="has none, expected some of ankle, knee"):
        scale_to_bones([track], {"tail": 1.0})
    with pytest.raises(
        ValueError, match="has none, expected some of none: its joints are all roots"
    ):
        scale_to_bones([other], {"knee": 1.0})
