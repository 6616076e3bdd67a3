"""Split of all clips of one person: complete, disjoint, and without the test clips of others."""

import csv
from pathlib import Path

import numpy as np
import pytest

from probmotion.data import person_clips
from probmotion.data.denoising_clips import DENOISING_CLIPS
from probmotion.data.person_clips import LEARNT_PARTS, action_clips, clips_of_actions, moving_clips
from probmotion.data.synthetic.walks import WALK_CLIPS
from probmotion.motion.skeleton import Skeleton


@pytest.fixture(scope="module")
def rows():
    path = Path(person_clips.__file__).with_suffix(".csv")
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def of_part(rows, *parts):
    return {row["clip"] for row in rows if row["part"] in parts}


def test_earlier_test_clips_stay_test_clips(rows):
    earlier = {*WALK_CLIPS["test"], *DENOISING_CLIPS["test"]}
    assert earlier <= of_part(rows, "test")
    assert {*DENOISING_CLIPS["validation"]} <= of_part(rows, "validation", "test")
    assert {*DENOISING_CLIPS["train"]} <= of_part(rows, "train")


def test_one_action_is_in_no_other_part_and_others_have_every_fifth_clip_as_test(rows):
    unseen = {row["action"] for row in rows if row["part"] == "unseen"}
    assert unseen == {"soccer"}
    assert not unseen & {row["action"] for row in rows if row["part"] in LEARNT_PARTS}
    parts = {0: "test", 4: "validation"}
    for row in rows:
        if row["clip"].startswith("cmu_actions/") and row["action"] not in unseen:
            number = int(row["clip"].rpartition("_")[2])
            assert row["part"] == parts.get(number % 5, "train"), row["clip"]
    for action in ("walking", "running", "jumping"):
        clips = clips_of_actions(action)
        assert tuple(clips) == LEARNT_PARTS
        assert all(clips.values()), action
    with pytest.raises(ValueError, match=r"actions must be of .*, got 'soccer'"):
        clips_of_actions("walking", "soccer")


def test_every_recording_of_one_person_is_listed_once(rows, real_data):
    names = [row["clip"] for row in rows]
    folders = ("cmu_single", "cmu_actions", "deepmimic_human")
    files = [path for folder in folders for path in real_data.glob(f"{folder}/*.npz")]
    assert sorted(names) == sorted(f"{path.parent.name}/{path.stem}" for path in files)


def test_moving_clips_have_no_marker_jumps(real_data):
    clips = moving_clips(real_data)
    assert [len(part) for part in clips.values()] == [44, 14, 16]
    everything = [clip for part in clips.values() for clip in part]
    assert {(clip.skeleton, clip.fps) for clip in everything} == {(Skeleton.preset("person14"), 30)}
    assert len({clip.name for clip in everything}) == len(everything)
    for clip in everything:
        speed = np.linalg.norm(np.diff(clip.positions, axis=0), axis=-1).max() * clip.fps
        assert speed < 9, clip.name


def test_actions_of_the_corrector_are_split_and_soccer_is_kept_out(real_data):
    parts = action_clips(real_data)
    assert {part for part in parts for clip in parts[part] if "soccer" in clip.name} == {"soccer"}
    assert {(clip.skeleton, clip.fps) for part in parts.values() for clip in part} == {
        (Skeleton.preset("person14"), 30.0)
    }
    frames = {part: sum(clip.frames for clip in clips) for part, clips in parts.items()}
    assert frames == {"train": 8629, "validation": 2727, "test": 1353, "soccer": 689}
