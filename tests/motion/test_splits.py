"""Splits by clip: disjoint, complete, seeded and independent of the order of names."""

import numpy as np
import pytest

from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import clip_of, name_within_clip, split_clips, tracks_of_clips

CLIPS = [f"set/walk{number:02}" for number in range(40)]
VIEWS = [f"{clip}/{view}" for clip in CLIPS for view in ("left", "right 0", "right 1")]


def test_sets_are_disjoint_and_complete():
    split = split_clips(VIEWS, validation=0.1, test=0.25, seed=0)
    assert [len(part) for part in (split.train, split.validation, split.test)] == [26, 4, 10]
    assert sorted(split.train + split.validation + split.test) == CLIPS
    assert list(split.train) == sorted(split.train)


def test_splits_depend_on_the_seed_only():
    split = split_clips(VIEWS, seed=3)
    shuffled = np.random.default_rng(0).permutation(VIEWS).tolist()
    assert split_clips(iter(shuffled + VIEWS), seed=3) == split
    tested = {clip for seed in range(60) for clip in split_clips(VIEWS, seed=seed).test}
    assert tested == set(CLIPS)  # a clip is missed with probability 0.9^60 = 0.002


def test_derived_names_stay_in_their_clip():
    assert (clip_of("a/b/c"), clip_of("walk")) == ("a/b", "walk")
    assert name_within_clip("walk/left", "2") == "walk/left 2"
    assert name_within_clip("walk", "2") == "walk/2"


def test_tracks_of_clips_preserves_order():
    skeleton = Skeleton(["ball"], [-1])
    tracks = [
        KeypointTrack(np.zeros((1, 1, 2)), np.ones((1, 1)), skeleton, 30, name) for name in VIEWS
    ]
    split = split_clips(VIEWS, seed=1)
    parts = [tracks_of_clips(tracks, part) for part in (split.train, split.validation, split.test)]
    assert [len(part) for part in parts] == [96, 12, 12]
    assert {track.name for part in parts for track in part} == set(VIEWS)
    names = [track.name for track in parts[0]]
    assert names == [name for name in VIEWS if clip_of(name) in split.train]
    with pytest.raises(ValueError, match="at least one of the 120 tracks, got none for 'se"):
        tracks_of_clips(tracks, ["set/run"])


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (VIEWS, {"validation": 0}, "validation must be a finite number above 0, got 0"),
        (VIEWS, {"validation": 0.5, "test": 0.5}, r"validation \+ test must be below 1, got 0.5"),
        (["a/1", "a/2", "b/1"], {}, "at least one clip for each of .* got 2, 0 and 0 from 2"),
        ([], {}, "names must have at least one clip"),
        ("walk", {}, "names must be a sequence of names, got 'walk'"),
        (VIEWS, {"seed": -1}, "seed must be an integer of at least 0, got -1"),
    ],
)
def test_invalid_splits_are_refused(names, options, message):
    with pytest.raises(ValueError, match=message):
        split_clips(names, **({"seed": 0} | options))
