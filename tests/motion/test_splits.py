"""Splits by clip: disjoint, complete, seeded, and the same for every order of the names."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import clip_of, name_within_clip, split_clips, tracks_of_clips

CLIPS = [f"set/walk{number:02}" for number in range(40)]
VIEWS = [f"{clip}/{view}" for clip in CLIPS for view in ("left", "right 0", "right 1")]


def test_parts_are_disjoint_complete_and_of_the_asked_sizes() -> None:
    split = split_clips(VIEWS, validation=0.1, test=0.25, seed=0)
    assert [len(part) for part in (split.train, split.validation, split.test)] == [26, 4, 10]
    assert sorted(split.train + split.validation + split.test) == CLIPS
    assert list(split.train) == sorted(split.train)


def test_the_order_and_repeats_of_names_do_not_matter_and_the_seed_does() -> None:
    split = split_clips(VIEWS, seed=3)
    shuffled = np.random.default_rng(0).permutation(VIEWS).tolist()
    assert split_clips(iter(shuffled + VIEWS), seed=3) == split
    assert split_clips(VIEWS, seed=4) != split


def test_every_clip_may_be_held_out() -> None:
    tested = {clip for seed in range(60) for clip in split_clips(VIEWS, seed=seed).test}
    assert tested == set(CLIPS)  # a clip is missed with probability 0.9^60 = 0.002


def test_what_is_made_of_a_track_stays_in_its_clip() -> None:
    assert clip_of("a/b/c") == "a/b"
    assert clip_of("walk") == "walk"
    assert name_within_clip("walk/left", "2") == "walk/left 2"
    assert name_within_clip("walk", "2") == "walk/2"
    for name in ("a/b/c", "walk", "walk/left"):
        made = name_within_clip(name_within_clip(name, "2"), "mirrored")
        assert clip_of(made) == clip_of(name)


def test_tracks_are_chosen_by_clip_in_their_order() -> None:
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
    with pytest.raises(ValueError, match="clips has 'set/run', which names no clip of the 120"):
        tracks_of_clips(tracks, ["set/run"])


def test_bad_input_is_one_sentence() -> None:
    with pytest.raises(ValueError, match="validation must be a finite number above 0, got 0"):
        split_clips(VIEWS, validation=0, seed=0)
    with pytest.raises(ValueError, match=r"validation and test are 0.5 and 0.5, expected a sum"):
        split_clips(VIEWS, validation=0.5, test=0.5, seed=0)
    with pytest.raises(
        ValueError, match="2 clips, of which train, validation and test would get 2"
    ):
        split_clips(["a/1", "a/2", "b/1"], seed=0)
    with pytest.raises(ValueError, match="names has 0 clips"):
        split_clips([], seed=0)
    with pytest.raises(ValueError, match="names must be several names, got 'walk'"):
        split_clips("walk", seed=0)
    with pytest.raises(ValueError, match="seed is -1"):
        split_clips(VIEWS, seed=-1)
