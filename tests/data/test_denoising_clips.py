"""Clips for training denoisers: held-out clips are no copies of training clips."""

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.denoising_clips import (
    DENOISING_CLIPS,
    denoising_clips,
    synthetic_denoising_clips,
)
from probmotion.io.files import load
from probmotion.motion.distances import windows, yaw_aligned_distances

PERSON = Skeleton.preset("person14")


def nearest(some, others, stride, step):
    """Return the distance of windows of 30 frames to the closest of others, metres.

    Minimised over mirror images.
    """
    these, those = (
        np.concatenate([windows(clip.positions, 30, by) for clip in clips])
        for clips, by in ((some, stride), (others, step))
    )
    mirrored = these[:, :, list(PERSON.mirrored_order)] * np.array([-1.0, 1.0, 1.0])
    return np.minimum(
        yaw_aligned_distances(these, those).min(axis=1),
        yaw_aligned_distances(mirrored, those).min(axis=1),
    )


@pytest.fixture(scope="module")
def clips(real_data):
    return denoising_clips(real_data)


def test_parts_are_disjoint_and_exclude_three_clips(real_data):
    names = [name for part in DENOISING_CLIPS.values() for name in part]
    assert len(set(names)) == len(names) == 45
    every = {
        f"{folder}/{path.stem}"
        for folder in ("cmu_single", "deepmimic_human")
        for path in (real_data / folder).glob("*.npz")
    }
    excluded = {f"deepmimic_human/humanoid3d_{name}" for name in ("jog", "walk", "zombie_walk")}
    assert every - set(names) == excluded
    assert load(real_data / "deepmimic_human" / "humanoid3d_jog.npz").frames < 30


def test_recorded_clips_have_no_marker_jumps(clips):
    assert sum(clip.name[-2:] in ("-0", "-1") for part in clips.values() for clip in part) >= 3
    for clip in (clip for part in clips.values() for clip in part if clip.name.startswith("cmu")):
        # Marker jumps exceed 9 m/s, which no joint reaches without flips.
        speed = np.linalg.norm(np.diff(clip.positions, axis=0), axis=-1).max() * 30
        assert speed < 6, clip.name


def test_skeleton_frame_rate_and_sizes(clips):
    assert list(clips) == ["train", "validation", "test"]
    every = [clip for part in clips.values() for clip in part]
    assert {clip.skeleton for clip in every} == {PERSON}
    assert {clip.fps for clip in every} == {30.0}
    assert min(clip.frames for clip in every) >= 30
    assert [sum(clip.frames for clip in part) for part in clips.values()] == [16349, 1333, 2441]
    assert len({clip.name for clip in every}) == len(every)


def test_held_out_clips_are_no_excerpts(clips):
    seen = {"validation": clips["train"], "test": clips["train"] + clips["validation"]}
    for part, others in seen.items():
        for clip in clips[part]:
            result = nearest([clip], others, 60, 4)
            # Repetitions by the same person are at 3 to 10 cm, excerpts at most at 2.3 cm.
            assert result.min() > 0.035, clip.name
            assert np.median(result) > 0.04, clip.name


def test_excluded_clips_are_excerpts(real_data, clips):
    by_name = {clip.name: clip for clip in clips["train"]}
    for name, whole, distance in (
        ("walk", "long_walk1", 0.023),
        ("zombie_walk", "long_zombie", 0.0005),
    ):
        excerpt = load(real_data / "deepmimic_human" / f"humanoid3d_{name}.npz")
        result = nearest([excerpt.retarget(PERSON)], [by_name[f"humanoid3d_{whole}"]], 1, 1)
        assert np.median(result) < distance


def test_only_the_hard_clip_is_unlike_training_clips(clips):
    for clip in clips["test"]:
        result = np.median(nearest([clip], clips["train"], 75, 5))
        assert (result > 0.3) == (clip.name == "humanoid3d_getup_faceup"), clip.name


def test_missing_clip_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"cmu_01_01\.npz"):
        denoising_clips(tmp_path)


def test_segments_between_suspect_frames(tmp_path, monkeypatch):
    (synthetic,) = synthetic_denoising_clips(1, seconds=4)["train"]
    suspect = np.zeros(synthetic.frames, bool)
    suspect[[0, 40, 41, 60]] = True  # 1-39, 42-59 (too short), 61-119

    def written(marks):
        np.savez(
            tmp_path / "clip.npz",
            positions=synthetic.positions,
            fps=30.0,
            joint_names=np.array(PERSON.joint_names),
            parents=np.array(PERSON.parents),
            suspect=marks,
        )

    monkeypatch.setattr("probmotion.data.denoising_clips.DENOISING_CLIPS", {"train": ("clip",)})
    written(suspect)
    first, second = denoising_clips(tmp_path)["train"]
    assert (first.name, second.name) == ("clip-0", "clip-1")
    np.testing.assert_array_equal(first.positions, synthetic.positions[1:40])
    np.testing.assert_array_equal(second.positions, synthetic.positions[61:])
    written(np.zeros(3, bool))
    with pytest.raises(ValueError, match=r"suspect must be bool of shape \(120,\)"):
        denoising_clips(tmp_path)


def test_synthetic_parts_have_all_styles_and_are_distinct():
    parts = synthetic_denoising_clips(15, seconds=2)
    assert [len(parts[part]) for part in ("train", "validation", "test")] == [15, 3, 3]
    every = [clip for synthetic in parts.values() for clip in synthetic]
    assert len({clip.name for clip in every}) == 21
    for synthetic in parts.values():
        assert {clip.name.partition("-")[0] for clip in synthetic} == {"walk", "run", "march"}
        for clip in synthetic:
            assert (clip.frames, clip.fps, clip.skeleton) == (60, 30.0, PERSON)
    again = synthetic_denoising_clips(15, seconds=2)
    np.testing.assert_array_equal(again["test"][0].positions, parts["test"][0].positions)
    other = synthetic_denoising_clips(15, seconds=2, seed=1)
    assert abs(other["test"][0].positions - parts["test"][0].positions).max() > 0.01
    assert nearest(parts["test"], parts["train"], 10, 1).min() > 0.01
