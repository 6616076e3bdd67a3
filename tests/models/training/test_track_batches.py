"""Batches of 2D tracks: visibility, sampling, augmentation and standards."""

from __future__ import annotations

import math
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
POINT = Skeleton(["point"], [-1])
NONE = Augmentation.none()
ROOT = PERSON.roots[0]


def track(frames=30, seed=0, name="clip/0", skeleton=PERSON, fps=20.0, **confidences):
    """A track with its root at the origin; confidences of joints by name, 1 by default."""
    rng = np.random.default_rng(seed)
    keypoints = rng.normal(size=(frames, skeleton.n_joints, 2)) + np.array([0.3, -0.2])
    keypoints[:, skeleton.roots[0]] = 0
    confidence = np.ones(keypoints.shape[:2])
    for joint, value in confidences.items():
        confidence[:, skeleton.index(joint)] = value
    return KeypointTrack(keypoints, confidence, skeleton, fps, name)


def numbered(frames, start=1.0):
    """A track with all coordinates equal to the number of the frame."""
    shape = (frames, PERSON.n_joints, 2)
    keypoints = np.broadcast_to((start + np.arange(frames))[:, None, None], shape)
    return KeypointTrack(keypoints, np.ones(shape[:2]), PERSON, 20.0, "clip/0")


def batches(*tracks, frames=30, threshold=0.3, augmentation=NONE):
    return TrackBatches(tracks, frames, threshold, augmentation)


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
    assert (batch.keypoints[0, 12:] == 0).all()
    np.testing.assert_allclose(batch.keypoints[0, :12], short.keypoints, atol=1e-6)


def test_joints_below_the_threshold_have_no_effect():
    given = track()
    confidence = given.confidence.copy()
    confidence[3:9, 4] = 0.29
    confidence[5, 6] = 0.3
    low = replace(given, confidence=confidence)
    variants = [low]
    for value in (1e6, np.nan):
        keypoints = given.keypoints.copy()
        keypoints[3:9, 4] = value
        variants.append(replace(low, keypoints=keypoints) if value == 1e6 else replace(
            low, keypoints=keypoints, confidence=np.where(confidence < 0.3, 0, confidence)
        ))  # fmt: skip
    sources = [batches(one, augmentation=Augmentation()) for one in variants]
    for other in sources[1:]:
        for ours, theirs in zip(draw(sources[0], 20), draw(other, 20), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(other.standards.mean, sources[0].standards.mean)
        np.testing.assert_array_equal(other.standards.deviation, sources[0].standards.deviation)
    whole = draw(batches(low))
    assert not whole.seen[0, 3:9, 4].any()
    np.testing.assert_array_equal(whole.confidence[0, 5, 5:7], np.float32([1.0, 0.3]))
    assert whole.seen.sum() == whole.seen.size - 6
    # Confidence 0 is never visible.
    assert not draw(batches(variants[2], threshold=0.0)).seen[0, 3:9, 4].any()


def test_windows_have_uniform_lengths_and_lie_inside_the_track():
    source = batches(numbered(50), frames=20, augmentation=replace(NONE, shortest=0.5))
    batch = draw(source, 2000)
    lengths = batch.valid.sum(axis=1)
    assert set(lengths) == set(range(10, 21))
    # 2000/11 of each length, Poisson deviation 13.
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
    # Two degrees of freedom: above 18 once in 8000 times.
    assert ((counts - expected) ** 2 / expected).sum() < 18
    seen = batch.keypoints[..., 0, 0][batch.valid].astype(int)
    middle = np.bincount(seen[seen <= 400])[20:381]
    expected = n * (20 / 22) * 20 / 381
    np.testing.assert_allclose(middle.mean(), expected, rtol=0.03)
    assert abs((seen > 2000).sum() / 5 - expected) < 5 * np.sqrt(expected)


def test_mirroring_exchanges_left_and_right():
    given = track()
    confidence = given.confidence.copy()
    left, right = PERSON.index("left_wrist"), PERSON.index("right_wrist")
    confidence[7, left] = 0
    source = batches(replace(given, confidence=confidence), augmentation=replace(NONE, mirror=True))
    batch = draw(source, 400)
    turned = ~batch.seen[:, 7, right]
    # 400 fair coins: deviation 10.
    assert abs(turned.sum() - 200) < 50
    assert (batch.seen[:, 7, left] == turned).all()
    swap = {"left": "right", "right": "left"}
    names = [
        "_".join(swap.get(word, word) for word in name.split("_")) for name in PERSON.joint_names
    ]
    order = [PERSON.index(name) for name in names]
    image = given.keypoints[:, order] * [-1, 1]
    image[7, right] = 0
    np.testing.assert_allclose(batch.keypoints[turned][0], image, atol=1e-6)
    standards = source.standards
    np.testing.assert_allclose(standards.mean[order] * [-1, 1], standards.mean, atol=1e-12)
    np.testing.assert_allclose(standards.deviation[order], standards.deviation, atol=1e-12)


def test_scale_and_shift_apply_to_all_frames():
    given = track()
    batch = draw(batches(given, augmentation=replace(NONE, scale=0.2)), 500)
    factor = batch.keypoints[:, 0, 3, 0] / given.keypoints[0, 3, 0]
    wanted = factor[:, None, None, None] * given.keypoints
    np.testing.assert_allclose(batch.keypoints, wanted, atol=1e-5)
    assert 0.8 <= factor.min() < 0.81
    assert 1.19 < factor.max() <= 1.2
    batch = draw(batches(given, augmentation=replace(NONE, shift=0.5)), 500)
    moved = batch.keypoints - given.keypoints
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:, :1, :1], moved.shape), atol=1e-6)
    assert -0.5 <= moved.min() < -0.49
    assert 0.49 < moved.max() <= 0.5


def test_standards_are_mean_and_deviation_of_visible_joints():
    tracks = [track(frames=30, seed=1), track(frames=8, seed=2)]
    standards = batches(*tracks, frames=20).standards
    together = np.concatenate([one.keypoints for one in tracks])
    np.testing.assert_allclose(standards.mean, together.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(standards.deviation, together.std(axis=0), atol=1e-6)
    np.testing.assert_array_equal(standards.deviation[ROOT], 0)
    moving = np.delete(standards.deviation, ROOT, axis=0)
    assert standards.scale == pytest.approx(np.sqrt((moving**2).mean()))
    occluded, knee = batches(track(left_knee=0.1)).standards, PERSON.index("left_knee")
    np.testing.assert_array_equal([occluded.mean[knee], occluded.deviation[knee]], 0)


def test_standards_include_the_shift():
    given = track(frames=30)
    given.keypoints[:, 3] = 0.7 + 0.002 * given.keypoints[:, 3]  # hardly moves
    still = batches(given).standards.deviation
    source = batches(given, augmentation=replace(NONE, shift=0.1))
    standards = source.standards
    drawn = draw(source, 2000).keypoints.astype(float)
    # The deviation of 2000 uniform numbers has a relative error of 1 %.
    np.testing.assert_allclose(drawn.std(axis=(0, 1)), standards.deviation, rtol=0.05)
    np.testing.assert_allclose(drawn.mean(axis=(0, 1)), standards.mean, atol=0.007)
    wanted = np.sqrt(still**2 + 0.1**2 / 3)
    np.testing.assert_allclose(standards.deviation, wanted, rtol=1e-12)


@pytest.mark.parametrize(
    ("occluded", "threshold", "augmentation", "never"),
    [
        (("neck", "left_ankle"), 0.3, NONE, ("neck", "left_ankle")),
        (("neck", "left_ankle"), 0.2, NONE, ()),
        (("neck", "left_ankle"), 0.3, Augmentation(), ("neck",)),
        (("left_ankle", "right_ankle"), 0.3, Augmentation(), ("left_ankle", "right_ankle")),
    ],
)
def test_joints_that_are_never_visible_are_named(occluded, threshold, augmentation, never):
    low = track(**dict.fromkeys(occluded, 0.2))
    source = batches(low, threshold=threshold, augmentation=augmentation)
    assert source.never_seen == never
    if never:
        with pytest.raises(ValueError, match=f"of 0.3 or more, never got {', '.join(never)}; cho"):
            source.check_all_seen()
    batches(low, track(), augmentation=augmentation).check_all_seen()


def test_batches_depend_on_the_generator_only():
    source = batches(track(), track(seed=1), frames=20, augmentation=Augmentation())
    for ours, theirs in zip(draw(source, 5, seed=4), draw(source, 5, seed=4), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (draw(source, 5, seed=5).keypoints != draw(source, 5, seed=4).keypoints).any()


def test_descriptions_identify_the_data():
    tracks = [track(name="b/0"), track(seed=1, name="b/1"), track(seed=2, name="a/0")]
    description = describe_tracks(tracks)
    assert (description["tracks"], description["frames"], description["clips"]) == (
        3,
        90,
        ["a", "b"],
    )
    assert description == describe_tracks([track(name="b/0"), *tracks[1:]])
    changed = tracks[0].keypoints.copy()
    changed[4, 4, 1] += 1e-9
    other = [replace(tracks[0], keypoints=changed), *tracks[1:]]
    assert describe_tracks(other)["sha256"] != description["sha256"]


def test_windows_without_visible_joints_are_not_drawn():
    paused = track(frames=60)
    confidence = paused.confidence.copy()
    confidence[10:50] = 0
    never = replace(track(), confidence=np.zeros((30, PERSON.n_joints)))
    paused = replace(paused, confidence=confidence)
    source = batches(paused, never, frames=12, augmentation=Augmentation())
    assert draw(source, 300).valid.any(axis=1).all()


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_windows_record_their_frames_and_scale(scale):
    given = [track(frames, seed=frames) for frames in (5, 12, 30)]
    source = batches(*given, frames=8, augmentation=Augmentation(0.5, scale, 0.0, True))
    keypoints, seen = source.all_frames()
    assert len(keypoints) == len(seen) == 2 * 47
    batch = draw(source, 60)
    there = batch.frames >= 0
    np.testing.assert_array_equal(there, batch.valid)
    shown = batch.scale[:, None, None, None] * keypoints[batch.frames]
    np.testing.assert_allclose(batch.keypoints[there], shown[there], rtol=1e-6)
    assert len(np.unique(batch.frames[there])) > 80
    assert np.ptp(batch.scale) == pytest.approx(2 * scale, rel=0.1)


def test_validation_batches_are_not_augmented():
    shown, other = track(), track(seed=1, name="other/0")
    varied = Augmentation(mirror=False, shift=0.5)
    training, held_out = learning_and_held_out([shown], [other], 30, 0.25, varied)
    drawn = draw(held_out, 8)
    np.testing.assert_allclose(drawn.keypoints, np.stack([other.keypoints] * 8), atol=1e-6)
    assert (draw(training, 50).valid.sum(axis=1) < 30).any()
    for one in (training, held_out):
        assert (one.frames, one.threshold, one.fps, one.skeleton) == (30, 0.25, 20.0, PERSON)
    assert held_out.description["clips"] == ["other"]


def test_invalid_tracks_are_rejected():
    point = track(skeleton=POINT, name="b/0")
    for tracks, message in (
        ([], "tracks must contain at least one track, got none"),
        ([track(fps=25.0), track()], "tracks must have one frame rate, got 20 for .* and 25 for"),
        ([track(), point], "tracks must have one skeleton, b/0 differs from clip/0"),
    ):
        with pytest.raises(ValueError, match=message):
            batches(*tracks)
    for other, message in (
        (point, "validation must have the same skeleton as tracks"),
        (track(fps=25.0), "validation must have the frame rate of tracks, 20, got 25"),
    ):
        with pytest.raises(ValueError, match=message):
            learning_and_held_out([track()], [other], 9, 0.3, NONE)
    with pytest.raises(ValueError, match=r"joints with a confidence of 1\.5 or more, got none"):
        batches(track(), threshold=1.5)
    with pytest.raises(ValueError, match="deviation must be above 0"):
        _ = batches(point).standards


@pytest.mark.parametrize("changes", [{"shortest": 0.0}, {"scale": 1.0}, {"shift": -1.0}])
def test_invalid_augmentations_are_rejected(changes):
    with pytest.raises(ValueError, match=f"^{next(iter(changes))} must be .*got"):
        Augmentation(**changes)
    with pytest.raises(ValueError, match=r"^threshold must be .*got nan"):
        batches(track(), threshold=math.nan)
    with pytest.raises(ValueError, match="deviation must be at least 0"):
        Standards(np.zeros((1, 2)), -np.ones((1, 2)))
