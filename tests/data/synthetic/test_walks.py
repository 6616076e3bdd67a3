"""Walking clips for training and evaluation: held-out clips are not excerpts of others."""

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.synthetic.walks import (
    WALK_CLIPS,
    shared_skeleton,
    synthetic_walks,
    walk_clips,
)
from probmotion.io.files import load
from probmotion.motion.distances import yaw_aligned_distances

PERSON = Skeleton.preset("person14")


def nearest(clip, others, mirrored=False):
    """Return the distance of each pose of a clip to the closest pose of others, metres."""
    poses = clip.retarget(PERSON).positions
    those = np.concatenate([motion.retarget(PERSON).positions for motion in others])
    if mirrored:
        poses = poses[:, list(PERSON.mirrored_order)] * np.array([-1.0, 1.0, 1.0])
    return yaw_aligned_distances(poses[:, None], those[:, None]).min(axis=1)


@pytest.fixture(scope="module")
def walks(real_data):
    return walk_clips(real_data)


def test_parts_are_disjoint(walks, tmp_path):
    names = [name for part in WALK_CLIPS.values() for name in part]
    assert len(set(names)) == len(names)
    assert list(walks) == list(WALK_CLIPS) == ["train", "validation", "test"]
    clips = [clip for part in walks.values() for clip in part]
    assert [clip.name for clip in clips] == [name.rpartition("/")[2] for name in names]
    assert {clip.fps for clip in clips} == {30.0}
    assert sum(clip.frames for clip in clips) == 3352
    with pytest.raises(FileNotFoundError, match=r"humanoid3d_long_walk1\.npz"):
        walk_clips(tmp_path)


@pytest.mark.parametrize("mirrored", [False, True])
def test_held_out_clips_resemble_training_clips_but_are_not_excerpts(walks, mirrored):
    for clip in walks["validation"] + walks["test"]:
        distance = np.median(nearest(clip, walks["train"], mirrored))
        assert distance > 0.02, clip.name
        assert mirrored or distance < 0.10, clip.name
    for clip in walks["test"]:
        assert np.median(nearest(clip, walks["validation"], mirrored)) > 0.02


def test_excluded_clips_are_excerpts_or_of_another_style(real_data, walks):
    folder = real_data / "deepmimic_human"
    walk, part, zombie = (
        load(folder / f"humanoid3d_{name}.npz") for name in ("walk", "zombie_walk", "long_zombie")
    )
    assert np.median(nearest(walk, walks["train"][:1])) < 0.011
    assert nearest(part, [zombie]).max() < 0.011
    assert nearest(zombie, walks["train"]).min() > 0.1


def test_synthetic_walks_are_reproducible_and_distinct():
    walks = synthetic_walks(3, seconds=2.5, fps=20.0)
    described = [(clip.name, clip.frames, clip.fps) for clip in walks]
    assert described == [(f"walk-{number}", 50, 20.0) for number in range(3)]
    for clip, again in zip(walks, synthetic_walks(5, seconds=2.5, fps=20.0), strict=False):
        np.testing.assert_array_equal(clip.positions, again.positions)
    for clip in walks:
        others = [other for other in walks if other is not clip]
        assert np.median(nearest(clip, others)) > 0.01


def test_quadruped_skeletons_yield_quadruped_walks():
    horse = Skeleton.preset("apt36k17")
    (clip,) = synthetic_walks(1, horse, seconds=1)
    assert clip.name.startswith("quadruped-walk")
    assert shared_skeleton(horse) is horse
    with pytest.raises(ValueError, match="skeleton must have joints of a person or a quadruped"):
        synthetic_walks(1, Skeleton(["hub", "rim"], [-1, 0]))
