"""Training data of 2D tracks: projected clips, random windows and splits by clip."""

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.projections import DetectorNoise, Filming, project_clips
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.data.tracks import learning
from probmotion.data.tracks.learning import certain, film_clips, film_windows, split_tracks
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")


@pytest.fixture(scope="module")
def clips():
    """Return walks of two seconds, away from the origin and from each other."""
    return [
        replace(clip, positions=np.add(clip.positions, [4.0 * number, 1.0, -3.0]), rotations=None)
        for number, clip in enumerate(synthetic_walks(4, seconds=2.0))
    ]


def test_projected_clips_are_prepared_tracks(clips):
    filmed = film_clips(clips, PERSON, 20.0, views=5, seed=1)
    assert [t.name for t in filmed.tracks] == [f"{c.name}/{v}" for c in clips for v in range(5)]
    for track in filmed.tracks:
        assert (track.skeleton, track.fps, track.frames) == (PERSON, 20.0, 40)
        rooted = track.confidence[:, 0] > 0
        np.testing.assert_array_equal(track.keypoints[rooted, 0], 0.0)
        assert not track.confidence[~rooted].any()
    changed = {report.step: report.entries_changed for report in filmed.reports[:-1]}
    assert min(changed[step] for step in ("uncertain", "gaps", "smooth")) > 0
    assert "scale" not in changed  # projections are in metres


def test_without_errors_tracks_are_smoothed_projections(clips):
    exact = DetectorNoise.none()
    result = film_clips(clips, PERSON, 30.0, views=3, seed=2, noise=exact).tracks
    projected = project_clips([c.retarget(PERSON) for c in clips], views=3, seed=2, noise=exact)
    for track, expected in zip(result, projected, strict=True):
        error = np.linalg.norm(track.keypoints - expected.keypoints, axis=-1)
        # Parabolas over 0.25 s approximate a walking foot within millimetres.
        assert error.max() < 0.03
        assert error.mean() < 0.003


def test_centred_sequences_preserve_the_path_and_views_are_not_dropped_as_a_crowd(clips):
    filming = Filming(centre="sequence", perspective=False)
    # Elsewhere, tracks of one video share the name before the first space and may be a crowd.
    clip = replace(clips[0], name="my walk")
    tracks = film_clips([clip], PERSON, 20.0, views=12, filming=filming).tracks
    assert len(tracks) == 12
    paths = np.stack([track.keypoints[:, 0] for track in tracks])
    np.testing.assert_allclose(np.nanmean(paths, axis=1), 0.0, atol=1e-9)
    assert (np.nanmax(paths, axis=1) - np.nanmin(paths, axis=1)).max() > 0.5


def test_certain_applies_a_threshold_to_confidences():
    confidence = np.array([[0.0, 0.29, 0.3, 1.0]])
    track = KeypointTrack(np.zeros((1, 4, 2)), confidence, Skeleton([*"abcd"], [-1] * 4), 20.0)
    (counted,) = certain([track])
    np.testing.assert_array_equal(counted.confidence, [[0, 0, 1, 1]])


# Windows.


@pytest.fixture(scope="module")
def filmed(clips):
    noise = DetectorNoise(share=0.0)
    return film_clips(clips[:2], PERSON, 20.0, views=64, seed=3, noise=noise)


def test_windows_are_uniform_over_the_complete_windows_of_clips(clips, filmed):
    windows = film_windows(clips[:2], PERSON, 20.0, 15, 200, seed=3)
    assert windows.shape == (200, 15, 14, 2)
    assert np.isfinite(windows).all()
    np.testing.assert_array_equal(windows[:, :, 0], 0.0)
    # The first pose identifies a window.
    starts = {}
    for number, track in enumerate(filmed.tracks):
        for frame in range(track.frames - 14):
            starts.setdefault(track.keypoints[frame].tobytes(), []).append((number, frame))
    used, mirrored = set(), 0
    for window in windows:
        if window[0].tobytes() not in starts:
            mirrored += 1
            window = window[:, list(PERSON.mirrored_order)] * np.array([-1.0, 1.0]) + 0.0
        ((number, frame),) = starts[window[0].tobytes()]
        used.add((number, frame))
        source = filmed.tracks[number].keypoints[frame : frame + 15]
        np.testing.assert_array_equal(window, source)
    assert len(used) == 200  # without replacement
    assert 100 - 4 * math.sqrt(50) < mirrored < 100 + 4 * math.sqrt(50)
    assert {number // 64 for number, _ in used} == {0, 1}  # both clips
    frames = np.array([frame for _, frame in used])
    # Start frames are uniform over 0 … 25.
    assert frames.mean() == pytest.approx(12.5, abs=5 * math.sqrt((26**2 - 1) / 12 / 200))


def test_windows_repeat_only_if_necessary(clips, filmed, monkeypatch):
    # There are 64 windows of 21 frames, one per view, and their mirror images.
    views = [
        replace(track, keypoints=track.keypoints[:21], confidence=track.confidence[:21])
        for track in filmed.tracks[:64]
    ]
    monkeypatch.setattr(learning, "film_clips", lambda *_, **__: replace(filmed, tracks=views))
    for n, lower, upper in ((10, 10, 10), (100, 31, 128)):
        windows = film_windows(clips, PERSON, 20.0, 21, n, seed=0)
        assert lower <= len({window.tobytes() for window in windows}) <= upper
    with pytest.raises(ValueError, match="a complete window of 41 frames at 20 fps"):
        film_windows(clips, PERSON, 20.0, 41, 5, seed=0)


# Splits.


def tracks_of(*names):
    return [
        KeypointTrack(np.zeros((2, 14, 2)), np.ones((2, 14)), PERSON, 20.0, name) for name in names
    ]


NAMES = [f"clip{number}" for number in range(20)]
TRACKS = tracks_of(*[f"{name}/{view}" for view in "xyz" for name in NAMES])


def test_random_split_is_disjoint_and_depends_on_names_and_seed_only():
    result = split_tracks(TRACKS, seed=3)
    parts = (result.train, result.validation, result.test)
    assert [len(part) for part in parts] == [48, 6, 6]
    clips = [{clip_of(track.name) for track in part} for part in parts]
    assert [len(names) for names in clips] == [16, 2, 2]
    assert len(set.union(*clips)) == 20
    split = result.split
    names = [tuple(sorted(names)) for names in clips]
    assert names == [split.train, split.validation, split.test]
    assert split_tracks(TRACKS[::-1], seed=3).split == split
    assert len({split_tracks(TRACKS, seed=seed).split.test for seed in range(10)}) > 1


def test_named_clips_are_held_out_with_all_their_segments():
    segments = tracks_of("a/0 0", "a/0 1", "d/x", "b/0", "c/0", "c/0 mirrored")
    result = split_tracks(segments, validation=["a"], test=["d", "b"])
    assert [track.name for track in result.validation] == ["a/0 0", "a/0 1"]
    assert [track.name for track in result.train] == ["c/0", "c/0 mirrored"]
    assert {track.name for track in result.test} == {"b/0", "d/x"}
    assert (result.split.validation, result.split.test) == (("a",), ("b", "d"))


@pytest.mark.parametrize(
    ("validation", "test", "message"),
    [
        (["clip3"], [], "validation requires test"),
        ([], ["clip3"], "test requires validation"),
        (["clip3", "clip4"], ["clip4"], "validation and test must be disjoint, got 'clip4'"),
        (["clip3"], ["walk"], "test must name clips among clip0, .*, got 'walk'"),
        (["clip3/x"], ["clip4"], "validation must name clips among clip0, .*, got 'clip3/x'"),
        (NAMES[:10], NAMES[10:], "validation and test must exclude at least one clip"),
    ],
)
def test_invalid_parts(validation, test, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        split_tracks(TRACKS, validation=validation, test=test)
