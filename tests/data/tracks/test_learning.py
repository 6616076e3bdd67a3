"""Training data of 2D tracks: projected clips, random windows and splits by clip."""

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.projections import DetectorNoise, Filming, project_clips
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.data.tracks.learning import certain, film_clips, film_windows, split_tracks
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")


@pytest.fixture(scope="module")
def clips():
    """Walks of two seconds, away from the origin and from each other."""
    return [
        replace(clip, positions=np.add(clip.positions, [4.0 * number, 1.0, -3.0]), rotations=None)
        for number, clip in enumerate(synthetic_walks(4, seconds=2.0))
    ]


def by_name(tracks):
    return {track.name: track for track in tracks}


def test_projected_clips_are_a_data_set(clips):
    filmed = film_clips(clips, PERSON, 20.0, views=5, seed=1)
    assert [t.name for t in filmed.tracks] == [f"{c.name}/{v}" for c in clips for v in range(5)]
    for track in filmed.tracks:
        assert (track.skeleton, track.fps, track.frames) == (PERSON, 20.0, 40)
        rooted = track.confidence[:, 0] > 0
        np.testing.assert_array_equal(track.keypoints[rooted, 0], 0.0)
        assert not track.confidence[~rooted].any()
    changed = {report.step: report.entries_changed for report in filmed.reports[:-1]}
    for step in ("uncertain", "gaps", "smooth"):
        assert changed[step] > 0
    assert "scale" not in changed  # projections are in metres


def test_overlapping_views_of_a_clip_are_no_crowd(clips):
    # The name before a space would elsewhere identify a common video.
    filmed = film_clips([replace(clips[0], name="my walk")], PERSON, 20.0, views=12)
    assert len(filmed.tracks) == 12
    assert all(report.tracks_dropped == 0 for report in filmed.reports)


def test_without_errors_tracks_are_smoothed_projections(clips):
    exact = DetectorNoise.none()
    filmed = by_name(film_clips(clips, PERSON, 30.0, views=3, seed=2, noise=exact).tracks)
    moved = [clip.retarget(PERSON) for clip in clips]
    for track in project_clips(moved, views=3, seed=2, noise=exact):
        off = np.linalg.norm(filmed[track.name].keypoints - track.keypoints, axis=-1)
        # Parabolas over 0.25 s approximate a walking foot within millimetres.
        assert off.max() < 0.03
        assert off.mean() < 0.003


def test_centred_sequences_keep_the_path(clips):
    filming = Filming(centre="sequence", perspective=False)
    tracks = film_clips(clips[:1], PERSON, 20.0, views=4, filming=filming).tracks
    for track in tracks:
        np.testing.assert_allclose(np.nanmean(track.keypoints[:, 0], axis=0), 0.0, atol=1e-9)
    assert max(np.nanmax(np.ptp(track.keypoints[:, 0], axis=0)) for track in tracks) > 0.5


def test_certain_thresholds_confidences():
    confidence = np.array([[0.0, 0.29, 0.3, 1.0]])
    track = KeypointTrack(np.zeros((1, 4, 2)), confidence, Skeleton([*"abcd"], [-1] * 4), 20.0)
    (counted,) = certain([track])
    np.testing.assert_array_equal(counted.confidence, [[0, 0, 1, 1]])


# Windows.


def test_windows_are_uniform_over_the_complete_windows_of_clips(clips):
    windows = film_windows(clips[:2], PERSON, 20.0, 15, 200, seed=3)
    assert windows.shape == (200, 15, 14, 2)
    assert np.isfinite(windows).all()
    np.testing.assert_array_equal(windows[:, :, 0], 0.0)
    noise = DetectorNoise(share=0.0)
    filmed = film_clips(clips[:2], PERSON, 20.0, views=64, seed=3, noise=noise).tracks
    # The first pose identifies a window.
    starts = {}
    for number, track in enumerate(filmed):
        for frame in range(track.frames - 14):
            starts.setdefault(track.keypoints[frame].tobytes(), []).append((number, frame))
    used, mirrored = set(), 0
    for window in windows:
        if window[0].tobytes() not in starts:
            mirrored += 1
            window = window[:, list(PERSON.mirrored_order)] * np.array([-1.0, 1.0]) + 0.0
        ((number, frame),) = starts[window[0].tobytes()]
        used.add((number, frame))
        np.testing.assert_array_equal(window, filmed[number].keypoints[frame : frame + 15])
    assert len(used) == 200  # without replacement
    assert 100 - 4 * math.sqrt(50) < mirrored < 100 + 4 * math.sqrt(50)
    assert {clip_of(filmed[n].name) for n, _ in used} == {clip.name for clip in clips[:2]}
    frames = np.array([frame for _, frame in used])
    # Start frames are uniform over 0 … 25.
    assert frames.mean() == pytest.approx(12.5, abs=5 * math.sqrt((26**2 - 1) / 12 / 200))


def test_windows_depend_on_the_seed_and_repeat_only_if_necessary(clips):
    clip = [clips[0].window(0, 31)]  # 64 windows of a second
    some = film_windows(clip, PERSON, 20.0, 21, 10, seed=0)
    assert (film_windows(clip, PERSON, 20.0, 21, 10, seed=1) != some).any()
    many = film_windows(clip, PERSON, 20.0, 21, 100, seed=0)
    assert len({window.tobytes() for window in some}) == 10
    assert 30 < len({window.tobytes() for window in many}) <= 128  # and their mirror images
    with pytest.raises(ValueError, match="a complete window of 41 frames at 20 fps"):
        film_windows(clip, PERSON, 20.0, 41, 5, seed=0)


# Splits.


def tracks_of(*names):
    return [
        KeypointTrack(np.zeros((2, 14, 2)), np.ones((2, 14)), PERSON, 20.0, name) for name in names
    ]


MANY = tracks_of(*[f"clip{number}/{view}" for view in "xyz" for number in range(20)])


def test_random_split_is_disjoint_and_depends_on_names_and_seed_only():
    for seed in range(5):
        result = split_tracks(MANY, seed=seed)
        parts = (result.train, result.validation, result.test)
        assert [len(part) for part in parts] == [48, 6, 6]
        clips = [{clip_of(track.name) for track in part} for part in parts]
        assert [len(names) for names in clips] == [16, 2, 2]
        assert len(set.union(*clips)) == 20
        split = result.split
        assert [tuple(sorted(names)) for names in clips] == [
            split.train, split.validation, split.test,
        ]  # fmt: skip
    assert split_tracks(MANY[::-1], seed=3).split == split_tracks(MANY, seed=3).split
    assert len({split_tracks(MANY, seed=seed).split.test for seed in range(10)}) > 1


def test_named_clips_are_held_out_with_all_their_segments():
    result = split_tracks(MANY, validation=["clip3"], test=["clip12", "clip1"], seed=9)
    assert [track.name for track in result.validation] == ["clip3/x", "clip3/y", "clip3/z"]
    assert {clip_of(track.name) for track in result.test} == {"clip1", "clip12"}
    assert (result.split.validation, result.split.test) == (("clip3",), ("clip1", "clip12"))
    assert len(result.train) == 51
    segments = tracks_of("a/0 0", "a/0 1", "b/0", "c/0", "c/0 mirrored")
    result = split_tracks(segments, validation=["a"], test=["b"])
    assert [track.name for track in result.validation] == ["a/0 0", "a/0 1"]
    assert [track.name for track in result.train] == ["c/0", "c/0 mirrored"]


@pytest.mark.parametrize(
    ("validation", "test", "message"),
    [
        (["clip3"], [], "validation requires test"),
        ([], ["clip3"], "test requires validation"),
        (["clip3", "clip4"], ["clip4"], "validation and test must be disjoint, both have 'clip4'"),
        (["clip3"], ["walk"], "test must name clips among clip0, .*, got 'walk'"),
        (["clip3/x"], ["clip4"], "validation must name clips among clip0, .*, got 'clip3/x'"),
        (
            [f"clip{n}" for n in range(10)],
            [f"clip{n}" for n in range(10, 20)],
            "validation and test must leave training clips",
        ),
    ],
)
def test_invalid_parts(validation, test, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        split_tracks(MANY, validation=validation, test=test)
