"""Batches of 2D tracks: visibility, sampling, augmentation and standards."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from probmotion.models.training.standardisation import Standards
from probmotion.models.training.track_batches import (
    Augmentation,
    TrackBatches,
    describe_tracks,
    learning_and_held_out,
)
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
NONE = Augmentation.none()
ROOT = PERSON.roots[0]


def track(frames=30, seed=0, name="clip/0", skeleton=PERSON, fps=20.0, **confidences):
    """Return a track with its root at the origin; ``confidences`` by joint name, default 1."""
    rng = np.random.default_rng(seed)
    keypoints = rng.normal(size=(frames, skeleton.n_joints, 2)) + np.array([0.3, -0.2])
    keypoints[:, skeleton.roots[0]] = 0
    confidence = np.ones(keypoints.shape[:2])
    for joint, value in confidences.items():
        confidence[:, skeleton.index(joint)] = value
    return KeypointTrack(keypoints, confidence, skeleton, fps, name)


POINT = track(skeleton=Skeleton(["point"], [-1]), name="b/0")


def numbered(frames, start=1.0):
    """Return a track with all coordinates equal to the number of the frame."""
    shape = (frames, PERSON.n_joints, 2)
    keypoints = np.broadcast_to((start + np.arange(frames))[:, None, None], shape)
    return KeypointTrack(keypoints, np.ones(shape[:2]), PERSON, 20.0, "clip/0")


def batches(*tracks, frames=30, threshold=0.3, augmentation=NONE):
    return TrackBatches(tracks, frames, threshold, augmentation)


def held_out(validation):
    return learning_and_held_out([track()], [validation], 9, 0.3, NONE)


def draw(source, n=1, seed=0):
    return source.draw(np.random.default_rng(seed), n)


def test_tracks_are_unchanged_without_augmentation_and_padded():
    given, short = track(), track(frames=12)
    batch = draw(batches(given), 3)
    assert batch.keypoints.dtype == np.float32
    np.testing.assert_allclose(batch.keypoints, np.stack([given.keypoints] * 3), atol=1e-6)
    assert batch.seen.all()
    assert batch.valid.all()
    batch = draw(batches(short))
    assert batch.valid[0].tolist() == [True] * 12 + [False] * 18
    assert not batch.seen[0, 12:].any()
    padded = np.pad(short.keypoints, [(0, 18), (0, 0), (0, 0)])
    np.testing.assert_allclose(batch.keypoints[0], padded, atol=1e-6)


def test_joints_below_the_threshold_have_no_effect():
    confidence = track().confidence
    confidence[3:9, 4], confidence[5, 6] = 0.29, 0.3
    low = replace(track(), confidence=confidence)
    keypoints, zeroed = low.keypoints.copy(), np.where(confidence < 0.3, 0, confidence)
    keypoints[3:9, 4] = np.nan
    occluded = replace(low, keypoints=keypoints, confidence=zeroed)
    first, second = (batches(one, augmentation=Augmentation()) for one in (low, occluded))
    for one, other in zip(draw(first, 20), draw(second, 20), strict=True):
        np.testing.assert_array_equal(one, other)
    for name in ("mean", "deviation"):
        np.testing.assert_array_equal(
            getattr(first.standards, name), getattr(second.standards, name)
        )
    batch = draw(batches(low))
    assert not batch.seen[0, 3:9, 4].any()
    np.testing.assert_array_equal(batch.confidence[0, 5, 5:7], np.float32([1.0, 0.3]))
    assert batch.seen.sum() == batch.seen.size - 6
    # Joints of confidence 0 are never visible.
    assert not draw(batches(occluded, threshold=0.0)).seen[0, 3:9, 4].any()


def test_windows_have_uniform_lengths_and_lie_inside_the_track():
    source = batches(numbered(50), frames=20, augmentation=replace(NONE, shortest=0.5))
    batch = draw(source, 2000)
    lengths = batch.valid.sum(axis=1)
    assert set(lengths) == set(range(10, 21))
    # Each length occurs about 2000/11 times, with Poisson deviation 13.
    assert abs(np.bincount(lengths)[10:] - 2000 / 11).max() < 5 * np.sqrt(2000 / 11)
    first = batch.keypoints[:, 0, 0, 0]
    last = batch.keypoints[np.arange(2000), lengths - 1, 0, 0]
    np.testing.assert_array_equal(last - first, lengths - 1)
    assert (first.min(), last.max()) == (1, 50)


def test_frames_are_equally_likely_across_tracks():
    n = 4000
    batch = draw(batches(numbered(400), numbered(20, 1001.0), numbered(5, 2001.0), frames=20), n)
    counts = np.bincount((batch.keypoints[:, 0, 0, 0] // 1000).astype(int))
    expected = n * np.array([20, 1, 1]) / 22
    # χ² with two degrees of freedom exceeds 18 once in 8000 times.
    assert ((counts - expected) ** 2 / expected).sum() < 18
    seen = batch.keypoints[..., 0, 0][batch.valid].astype(int)
    middle = np.bincount(seen[seen <= 400])[20:381]
    expected = n * (20 / 22) * 20 / 381
    np.testing.assert_allclose(middle.mean(), expected, rtol=0.03)
    assert abs((seen > 2000).sum() / 5 - expected) < 5 * np.sqrt(expected)


def test_mirroring_exchanges_left_and_right():
    given = track()
    left, right = PERSON.index("left_wrist"), PERSON.index("right_wrist")
    given.confidence[7, left] = 0
    source = batches(given, augmentation=replace(NONE, mirror=True))
    batch = draw(source, 400)
    is_mirrored = ~batch.seen[:, 7, right]
    # The number of mirrored windows is binomial with deviation 10.
    assert abs(is_mirrored.sum() - 200) < 50
    assert (batch.seen[:, 7, left] == is_mirrored).all()
    swap = {"left": "right", "right": "left"}
    order = [
        PERSON.index("_".join(swap.get(word, word) for word in name.split("_")))
        for name in PERSON.joint_names
    ]
    image = given.keypoints[:, order] * [-1, 1]
    image[7, right] = 0
    np.testing.assert_allclose(batch.keypoints[is_mirrored][0], image, atol=1e-6)
    standards = source.standards
    np.testing.assert_allclose(standards.mean[order] * [-1, 1], standards.mean, atol=1e-12)
    np.testing.assert_allclose(standards.deviation[order], standards.deviation, atol=1e-12)


def test_scale_and_shift_apply_to_all_frames():
    given = track()
    batch = draw(batches(given, augmentation=replace(NONE, scale=0.2)), 500)
    factor = batch.keypoints[:, 0, 3, 0] / given.keypoints[0, 3, 0]
    expected = factor[:, None, None, None] * given.keypoints
    np.testing.assert_allclose(batch.keypoints, expected, atol=1e-5)
    assert 0.8 <= factor.min() < 0.81
    assert 1.19 < factor.max() <= 1.2
    batch = draw(batches(given, augmentation=replace(NONE, shift=0.5)), 500)
    shift = batch.keypoints - given.keypoints
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1, :1], shift.shape), atol=1e-6)
    assert -0.5 <= shift.min() < -0.49
    assert 0.49 < shift.max() <= 0.5


def test_standards_are_mean_and_deviation_of_visible_joints():
    tracks = [track(frames=30, seed=1, left_knee=0.1), track(frames=8, seed=2)]
    standards, knee = batches(*tracks, frames=20).standards, PERSON.index("left_knee")
    joined = np.concatenate([one.keypoints for one in tracks])
    mean, deviation = joined.mean(axis=0), joined.std(axis=0)
    mean[knee], deviation[knee] = joined[30:, knee].mean(axis=0), joined[30:, knee].std(axis=0)
    np.testing.assert_allclose(standards.mean, mean, atol=1e-6)
    np.testing.assert_allclose(standards.deviation, deviation, atol=1e-6)
    np.testing.assert_array_equal(standards.deviation[ROOT], 0)
    moving = np.delete(standards.deviation, ROOT, axis=0)
    assert standards.scale == pytest.approx(np.sqrt((moving**2).mean()))


def test_standards_include_the_shift():
    unshifted = batches(track()).standards.deviation
    source = batches(track(), augmentation=replace(NONE, shift=1.0))
    drawn = draw(source, 2000).keypoints.astype(float)
    # The deviation of 2000 uniform numbers has a relative error of 1 %.
    np.testing.assert_allclose(drawn.std(axis=(0, 1)), source.standards.deviation, rtol=0.05)
    np.testing.assert_allclose(drawn.mean(axis=(0, 1)), source.standards.mean, atol=0.07)
    np.testing.assert_allclose(source.standards.deviation**2, unshifted**2 + 1 / 3, rtol=1e-12)


@pytest.mark.parametrize(
    ("occluded", "threshold", "augmentation", "missing"),
    [
        (("neck", "left_ankle"), 0.3, NONE, "neck, left_ankle"),
        (("neck", "left_ankle"), 0.2, NONE, None),
        (("neck", "left_ankle"), 0.3, Augmentation(), "neck"),
        (("left_ankle", "right_ankle"), 0.3, Augmentation(), "left_ankle, right_ankle"),
    ],
)
def test_joints_that_are_never_visible_are_named(occluded, threshold, augmentation, missing):
    low = track(**dict.fromkeys(occluded, 0.2))
    source = batches(low, threshold=threshold, augmentation=augmentation)
    with pytest.raises(ValueError, match=f"got none for {missing}; ") if missing else nullcontext():
        source.check_all_seen()
    batches(low, track(), augmentation=augmentation).check_all_seen()


def test_descriptions_identify_the_data():
    tracks = [track(name="b/0"), track(seed=1, name="b/1"), track(seed=2, name="a/0")]
    description = describe_tracks(tracks)
    digest = description.pop("sha256")
    assert description == {"tracks": 3, "frames": 90, "clips": ["a", "b"]}
    tracks[0].keypoints[4, 4, 1] += 1e-9
    assert describe_tracks(tracks)["sha256"] != digest


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_windows_record_their_frames_and_scale(scale):
    """Windows without a visible joint are not drawn."""
    given = [track(frames, seed=frames) for frames in (5, 12, 30)]
    given[2].confidence[10:25] = 0
    given.append(replace(track(frames=9), confidence=np.zeros((9, PERSON.n_joints))))
    source = batches(*given, frames=8, augmentation=Augmentation(0.5, scale, 0.0, True))
    keypoints, seen = source.all_frames()
    assert len(keypoints) == len(seen) == 2 * 56
    batch = draw(source, 100)
    assert batch.valid.any(axis=1).all()
    valid = batch.frames >= 0
    np.testing.assert_array_equal(batch.valid[valid], seen[batch.frames[valid]].any(axis=-1))
    scaled = batch.scale[:, None, None, None] * keypoints[batch.frames]
    np.testing.assert_allclose(batch.keypoints[valid], scaled[valid], rtol=1e-6)
    assert len(np.unique(batch.frames[valid])) > 60
    assert np.ptp(batch.scale) == pytest.approx(2 * scale, rel=0.1)


def test_validation_batches_are_not_augmented():
    first, other = track(), track(seed=1, name="other/0")
    varied = Augmentation(mirror=False, shift=0.5)
    training, held_out = learning_and_held_out([first], [other], 30, 0.25, varied)
    np.testing.assert_allclose(draw(held_out).keypoints[0], other.keypoints, atol=1e-6)
    assert (draw(training, 50).valid.sum(axis=1) < 30).any()
    assert (training.threshold, held_out.threshold) == (0.25, 0.25)


def test_invalid_arguments_are_rejected():
    for call, message in (
        (lambda: batches(), "tracks must contain at least one track, got none"),
        (lambda: batches(track(fps=25.0), track()), "one frame rate, got 20 for .* and 25 for"),
        (lambda: batches(track(), POINT), "one skeleton, got different ones for b/0 and clip/0"),
        (lambda: held_out(POINT), "validation must have the skeleton of tracks"),
        (lambda: held_out(track(fps=25.0)), "the frame rate of tracks, 20, got 25"),
        (lambda: batches(track(), threshold=1.5), r"confidence of at least 1\.5, got none"),
        (lambda: batches(track(), threshold=math.nan), r"^threshold must be .*got nan"),
        (lambda: batches(POINT).standards, "deviation must be above 0"),
        (lambda: Standards(np.zeros((1, 2)), -np.ones((1, 2))), "deviation must be at least 0"),
        (lambda: Augmentation(shortest=0.0), "^shortest must be .*got"),
        (lambda: Augmentation(scale=1.0), "^scale must be .*got"),
        (lambda: Augmentation(shift=-1.0), "^shift must be .*got"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
