"""Batches of 2D tracks: what is seen, what is not, and how they are varied."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion.models.training.standardisation import Standards
from probmotion.models.training.track_batches import Augmentation, TrackBatches, describe_tracks
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
NONE = Augmentation.none()


def track(frames=30, seed=0, name="clip/0", confidence=1.0, fps=20.0):
    """A track of a person whose root is at the origin."""
    rng = np.random.default_rng(seed)
    keypoints = rng.normal(size=(frames, PERSON.n_joints, 2)) + np.array([0.3, -0.2])
    keypoints[:, PERSON.roots[0]] = 0
    sure = np.full(keypoints.shape[:2], confidence)
    return KeypointTrack(keypoints, sure, PERSON, fps, name)


def numbered(frames, name="clip/0"):
    """A track whose joints stand at the number of the frame."""
    keypoints = np.broadcast_to(
        np.arange(1.0, frames + 1)[:, None, None], (frames, PERSON.n_joints, 2)
    )
    return KeypointTrack(keypoints, np.ones(keypoints.shape[:2]), PERSON, 20.0, name)


def draw(batches, n=1, seed=0):
    return batches.draw(np.random.default_rng(seed), n)


def test_without_augmentation_a_track_of_the_window_s_length_comes_back():
    given = track()
    batch = draw(TrackBatches([given], 30, 0.3, NONE), 3)
    assert batch.keypoints.dtype == np.float32
    np.testing.assert_allclose(batch.keypoints, np.stack([given.keypoints] * 3), atol=1e-6)
    assert batch.seen.all()
    assert batch.valid.all()


def test_short_tracks_are_padded_with_what_counts_nowhere():
    given = track(frames=12)
    batch = draw(TrackBatches([given], 30, 0.3, NONE))
    assert batch.valid[0].tolist() == [True] * 12 + [False] * 18
    assert not batch.seen[0, 12:].any()
    assert (batch.keypoints[0, 12:] == 0).all()
    np.testing.assert_allclose(batch.keypoints[0, :12], given.keypoints, atol=1e-6)


def test_joints_below_the_threshold_are_as_if_they_were_not_there():
    given = track()
    confidence = given.confidence.copy()
    confidence[3:9, 4] = 0.29
    confidence[5, 6] = 0.3
    keypoints = given.keypoints.copy()
    low = replace(given, confidence=confidence)
    keypoints[3:9, 4] = 1e6
    wild = replace(low, keypoints=keypoints)
    keypoints = keypoints.copy()
    keypoints[3:9, 4] = np.nan
    unseen = replace(
        given, keypoints=keypoints, confidence=np.where(confidence < 0.3, 0, confidence)
    )
    drawn = [draw(TrackBatches([one], 30, 0.3, Augmentation()), 20) for one in (low, wild, unseen)]
    for other in drawn[1:]:
        for ours, theirs in zip(drawn[0], other, strict=True):
            np.testing.assert_array_equal(ours, theirs)
    batches = [TrackBatches([one], 30, 0.3, Augmentation()) for one in (low, wild, unseen)]
    for other in batches[1:]:
        np.testing.assert_array_equal(other.standards.mean, batches[0].standards.mean)
        np.testing.assert_array_equal(other.standards.deviation, batches[0].standards.deviation)
    whole = draw(TrackBatches([low], 30, 0.3, NONE))
    assert not whole.seen[0, 3:9, 4].any()
    assert whole.seen[0, 5, 6]
    np.testing.assert_array_equal(whole.confidence[0, 5, 5:7], np.float32([1.0, 0.3]))
    assert whole.seen.sum() == whole.seen.size - 6
    # Even a threshold of 0 does not show what was never seen.
    assert not draw(TrackBatches([unseen], 30, 0.0, NONE)).seen[0, 3:9, 4].any()


def test_windows_are_longer_than_the_share_and_lie_inside_the_track():
    batches = TrackBatches([numbered(50)], 20, 0.3, replace(NONE, shortest=0.5))
    batch = draw(batches, 2000)
    lengths = batch.valid.sum(axis=1)
    assert set(lengths) == set(range(10, 21))
    # Every length is equally likely: 2000/11 each, Poisson deviation 13.
    assert abs(np.bincount(lengths)[10:] - 2000 / 11).max() < 5 * np.sqrt(2000 / 11)
    first = batch.keypoints[:, 0, 0, 0]
    assert first.min() == 1
    last = batch.keypoints[np.arange(2000), lengths - 1, 0, 0]
    np.testing.assert_array_equal(last - first, lengths - 1)
    assert last.max() == 50


def test_a_frame_is_as_likely_whichever_track_it_is_of():
    sizes = {"long": 400, "window": 20, "short": 5}
    offsets = {"long": 0, "window": 1000, "short": 2000}
    tracks = []
    for name, frames in sizes.items():
        one = numbered(frames, f"{name}/0")
        tracks.append(replace(one, keypoints=one.keypoints + offsets[name]))
    n = 4000
    batch = draw(TrackBatches(tracks, 20, 0.3, NONE), n)
    of = batch.keypoints[:, 0, 0, 0] // 1000
    wanted = {"long": 400 / 20, "window": 1, "short": 1}
    total = sum(wanted.values())
    chi_square = 0.0
    for number, name in enumerate(sizes):
        expected = n * wanted[name] / total
        chi_square += ((of == number).sum() - expected) ** 2 / expected
    # Two degrees of freedom: above 18 one time in 8000.
    assert chi_square < 18
    # In frames: each of the 425 is drawn as often as another, but for those near an end.
    seen = batch.keypoints[..., 0, 0][batch.valid].astype(int)
    middle = np.bincount(seen[seen <= 400])[20:381]
    expected = n * (20 / 22) * 20 / 381
    np.testing.assert_allclose(middle.mean(), expected, rtol=0.03)
    assert abs((seen > 2000).sum() / 5 - expected) < 5 * np.sqrt(expected)


def test_mirrored_tracks_exchange_left_and_right():
    given = track()
    confidence = given.confidence.copy()
    left, right = (PERSON.joint_names.index(f"{side}_wrist") for side in ("left", "right"))
    confidence[7, left] = 0
    batches = TrackBatches(
        [replace(given, confidence=confidence)], 30, 0.3, replace(NONE, mirror=True)
    )
    batch = draw(batches, 400)
    turned = ~batch.seen[:, 7, right]
    # 400 fair coins: deviation 10.
    assert abs(turned.sum() - 200) < 50
    assert (batch.seen[~turned, 7, right]).all()
    assert not batch.seen[~turned, 7, left].any()
    partner = {left: right, right: left}
    for joint, name in enumerate(PERSON.joint_names):
        side, _, part = name.partition("_")
        if side in ("left", "right"):
            other = {"left": "right", "right": "left"}[side]
            partner[joint] = PERSON.joint_names.index(f"{other}_{part}")
        else:
            partner[joint] = joint
    order = [partner[joint] for joint in range(PERSON.n_joints)]
    image = given.keypoints[:, order] * [-1, 1]
    image[7, right] = 0
    np.testing.assert_allclose(batch.keypoints[turned][0], image, atol=1e-6)
    # A mirror image's mirror image is the track: the standards are symmetric.
    standards = batches.standards
    np.testing.assert_allclose(standards.mean[order] * [-1, 1], standards.mean, atol=1e-12)
    np.testing.assert_allclose(standards.deviation[order], standards.deviation, atol=1e-12)


def test_scale_and_shift_move_all_frames_alike():
    given = track()
    batch = draw(TrackBatches([given], 30, 0.3, replace(NONE, scale=0.2)), 500)
    factor = batch.keypoints[:, 0, 3, 0] / given.keypoints[0, 3, 0]
    wanted = factor[:, None, None, None] * given.keypoints
    np.testing.assert_allclose(batch.keypoints, wanted, atol=1e-5)
    assert 0.8 <= factor.min() < 0.81
    assert 1.19 < factor.max() <= 1.2
    batch = draw(TrackBatches([given], 30, 0.3, replace(NONE, shift=0.5)), 500)
    moved = batch.keypoints - given.keypoints
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:, :1, :1], moved.shape), atol=1e-6)
    assert -0.5 <= moved.min() < -0.49
    assert 0.49 < moved.max() <= 0.5


def test_standards_are_mean_and_deviation_of_what_is_seen():
    tracks = [track(frames=30, seed=1), track(frames=8, seed=2)]
    standards = TrackBatches(tracks, 20, 0.3, NONE).standards
    together = np.concatenate([one.keypoints for one in tracks])
    np.testing.assert_allclose(standards.mean, together.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(standards.deviation, together.std(axis=0), atol=1e-6)
    root = PERSON.roots[0]
    np.testing.assert_array_equal(standards.deviation[root], 0)
    moving = np.delete(standards.deviation, root, axis=0)
    assert standards.scale == pytest.approx(np.sqrt((moving**2).mean()))


def test_standards_are_those_of_windows_that_are_moved():
    given = track(frames=30)
    given.keypoints[:, 3] = 0.7 + 0.002 * given.keypoints[:, 3]  # hardly moves
    still = TrackBatches([given], 30, 0.3, NONE)
    batches = TrackBatches([given], 30, 0.3, replace(NONE, shift=0.1))
    standards = batches.standards
    drawn = draw(batches, 4000).keypoints.astype(float)
    # 4000 shifts: the deviation of a uniform number is known to 1 %.
    np.testing.assert_allclose(drawn.std(axis=(0, 1)), standards.deviation, rtol=0.03)
    np.testing.assert_allclose(drawn.mean(axis=(0, 1)), standards.mean, atol=0.005)
    wanted = np.sqrt(still.standards.deviation**2 + 0.1**2 / 3)
    np.testing.assert_allclose(standards.deviation, wanted, rtol=1e-12)
    root = PERSON.roots[0]
    np.testing.assert_allclose(standards.deviation[root], 0.1 / np.sqrt(3))
    np.testing.assert_array_equal(still.standards.deviation[root], 0)


def test_joints_that_no_track_shows_are_named():
    given = track()
    confidence = given.confidence.copy()
    left, right = (PERSON.joint_names.index(f"{side}_ankle") for side in ("left", "right"))
    confidence[:, [left, 1]] = 0.2
    low = replace(given, confidence=confidence)
    assert TrackBatches([low], 30, 0.3, NONE).never_seen == ("neck", "left_ankle")
    assert TrackBatches([low], 30, 0.2, NONE).never_seen == ()
    # In a mirror the right ankle is a left one.
    assert TrackBatches([low], 30, 0.3, Augmentation()).never_seen == ("neck",)
    # One track is enough.
    assert TrackBatches([low, track(name="clip/1")], 30, 0.3, NONE).never_seen == ()
    confidence = confidence.copy()
    confidence[:, right] = 0.2
    neither = TrackBatches([replace(given, confidence=confidence)], 30, 0.3, Augmentation())
    assert neither.never_seen == ("neck", "left_ankle", "right_ankle")


def test_a_joint_that_is_never_seen_has_standards():
    given = track()
    confidence = given.confidence.copy()
    confidence[:, 5] = 0.1
    standards = TrackBatches([replace(given, confidence=confidence)], 30, 0.3, NONE).standards
    np.testing.assert_array_equal(standards.mean[5], 0)
    np.testing.assert_array_equal(standards.deviation[5], 0)


def test_batches_depend_on_the_generator_alone():
    batches = TrackBatches([track(), track(seed=1)], 20, 0.3, Augmentation())
    for ours, theirs in zip(draw(batches, 5, seed=4), draw(batches, 5, seed=4), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (draw(batches, 5, seed=5).keypoints != draw(batches, 5, seed=4).keypoints).any()


def test_tracks_are_described_by_what_is_learnt_from():
    tracks = [track(name="b/0"), track(seed=1, name="b/1"), track(seed=2, name="a/0")]
    found = describe_tracks(tracks)
    assert (found["tracks"], found["frames"], found["clips"]) == (3, 90, ["a", "b"])
    again = describe_tracks([track(name="b/0"), *tracks[1:]])
    assert found == again
    nudged = tracks[0].keypoints.copy()
    nudged[4, 4, 1] += 1e-9
    other = [replace(tracks[0], keypoints=nudged), *tracks[1:]]
    assert describe_tracks(other)["sha256"] != found["sha256"]


def test_bad_input_is_refused_in_a_sentence():
    with pytest.raises(ValueError, match="tracks must contain at least one track, got none"):
        TrackBatches([], 20, 0.3, NONE)
    with pytest.raises(ValueError, match="frames must be an integer of at least 2, got 1"):
        TrackBatches([track()], 1, 0.3, NONE)
    with pytest.raises(ValueError, match=r"tracks has no joint of confidence 0.3 or more"):
        TrackBatches([track(confidence=0.2)], 20, 0.3, NONE)
    with pytest.raises(ValueError, match="tracks has b/0 at 25 frames per second and a/0 at 20"):
        TrackBatches([track(name="a/0"), track(name="b/0", fps=25.0)], 20, 0.3, NONE)
    point = Skeleton(["point"], [-1])
    other = KeypointTrack(np.ones((5, 1, 2)), np.ones((5, 1)), point, 20.0, "b/0")
    with pytest.raises(ValueError, match="tracks has b/0 with other joints than clip/0"):
        TrackBatches([track(), other], 20, 0.3, NONE)
    with pytest.raises(ValueError, match="deviation is 0 everywhere"):
        _ = TrackBatches([other], 5, 0.3, NONE).standards
    for name, value in [
        ("shortest", 0.0),
        ("shortest", 1.1),
        ("scale", 1.0),
        ("scale", float("nan")),
        ("shift", -1.0),
        ("shift", float("inf")),
    ]:
        with pytest.raises(ValueError, match=f"^{name} is .*, expected"):
            Augmentation(**{name: value})
    for threshold in (float("nan"), -0.1):
        with pytest.raises(ValueError, match=r"^threshold is .*, expected"):
            TrackBatches([track()], 20, threshold, NONE)
    with pytest.raises(ValueError, match="n must be an integer of at least 1, got 0"):
        draw(TrackBatches([track()], 20, 0.3, NONE), 0)
    with pytest.raises(ValueError, match=r"deviation must have shape \(2, 2\), got \(3, 2\)"):
        Standards(np.zeros((2, 2)), np.ones((3, 2)))
    with pytest.raises(ValueError, match="deviation is -1 at its least, expected 0 or more"):
        Standards(np.zeros((2, 2)), np.array([[1.0, 1.0], [-1.0, 1.0]]))


def test_no_window_is_drawn_in_which_nothing_is_seen():
    """A pause in the middle: attention would have no frame to look at."""
    paused = track(frames=60)
    confidence = paused.confidence.copy()
    confidence[10:50] = 0
    paused = replace(paused, confidence=confidence)
    never = replace(track(frames=30), confidence=np.zeros((30, paused.skeleton.n_joints)))
    batches = TrackBatches([paused, never], 12, 0.3, Augmentation())
    drawn = batches.draw(np.random.default_rng(0), 300)
    assert drawn.valid.any(axis=1).all()


@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_a_window_says_which_frames_it_shows_and_how_large(scale):
    given = [track(frames, seed=frames, name=f"clip/{frames}") for frames in (5, 12, 30)]
    batches = TrackBatches(given, 8, 0.3, Augmentation(0.5, scale, 0.0, True))
    keypoints, seen = batches.all_frames()
    assert len(keypoints) == len(seen) == 2 * 47
    batch = draw(batches, 60)
    there = batch.frames >= 0
    np.testing.assert_array_equal(there, batch.valid)
    shown = batch.scale[:, None, None, None] * keypoints[batch.frames]
    np.testing.assert_allclose(batch.keypoints[there], shown[there], rtol=1e-6)
    # Frames of all tracks, and of their mirror images.
    assert len(np.unique(batch.frames[there])) > 80
    assert np.ptp(batch.scale) == pytest.approx(2 * scale, rel=0.1)
