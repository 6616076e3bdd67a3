"""Clips for training denoisers: held-out clips are not excerpts of training clips."""

import numpy as np
import pytest

from probmotion import Skeleton
from probmotion.data.denoising_clips import (
    DENOISING_CLIPS,
    denoising_clips,
    synthetic_denoising_clips,
)
from probmotion.data.face_points import with_face_points
from probmotion.io.files import load
from probmotion.motion.distances import windows, yaw_aligned_distances

PERSON = Skeleton.preset("person14")


def nearest(queries, others, stride, step):
    """Return distances of 30-frame windows or their mirror images to the closest of others, m."""
    these, those = (
        np.concatenate([windows(clip.positions, 30, by) for clip in clips])
        for clips, by in ((queries, stride), (others, step))
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
    paths = [*real_data.glob("cmu_single/*.npz"), *real_data.glob("deepmimic_human/*.npz")]
    all_clips = {f"{path.parent.name}/{path.stem}" for path in paths}
    excluded = {f"deepmimic_human/humanoid3d_{name}" for name in ("jog", "walk", "zombie_walk")}
    assert all_clips - set(names) == excluded
    assert load(real_data / "deepmimic_human" / "humanoid3d_jog.npz").frames < 30


def test_recorded_clips(clips):
    assert list(clips) == ["train", "validation", "test"]
    all_clips = [clip for part in clips.values() for clip in part]
    assert {(clip.skeleton, clip.fps) for clip in all_clips} == {(PERSON, 30.0)}
    assert min(clip.frames for clip in all_clips) >= 30
    assert [sum(clip.frames for clip in part) for part in clips.values()] == [16349, 1333, 2441]
    assert len({clip.name for clip in all_clips}) == len(all_clips)
    assert sum(clip.name[-2:] in ("-0", "-1") for clip in all_clips) >= 3
    for clip in all_clips:
        # Marker jumps exceed 9 m/s; without flips, joints of these subjects are slower.
        speed = np.linalg.norm(np.diff(clip.positions, axis=0), axis=-1).max() * 30
        assert speed < 6 or not clip.name.startswith("cmu"), clip.name


def test_held_out_clips_are_not_excerpts(clips):
    seen = {"validation": clips["train"], "test": clips["train"] + clips["validation"]}
    for part, others in seen.items():
        for clip in clips[part]:
            result = nearest([clip], others, 75, 5)
            # Repetitions by the same person are at 3 to 10 cm, excerpts at most at 2.3 cm.
            assert result.min() > 0.035, clip.name
            assert np.median(result) > 0.04, clip.name
            if part == "test":  # only one test clip differs from all training clips
                getup = clip.name == "humanoid3d_getup_faceup"
                assert (np.median(result) > 0.3) == getup, clip.name


def test_segments_between_suspect_frames(tmp_path, monkeypatch):
    (synthetic,) = synthetic_denoising_clips(1, seconds=4)["train"]
    suspect = np.zeros(synthetic.frames, bool)
    suspect[[0, 40, 41, 60]] = True  # 1-39, 42-59 (too short), 61-119

    with pytest.raises(FileNotFoundError, match=r"cmu_01_01\.npz"):
        denoising_clips(tmp_path)

    def write(marks):
        np.savez(
            tmp_path / "clip.npz",
            positions=synthetic.positions,
            fps=30.0,
            joint_names=np.array(PERSON.joint_names),
            parents=np.array(PERSON.parents),
            suspect=marks,
        )

    monkeypatch.setattr("probmotion.data.denoising_clips.DENOISING_CLIPS", {"train": ("clip",)})
    write(suspect)
    first, second = denoising_clips(tmp_path)["train"]
    assert (first.name, second.name) == ("clip-0", "clip-1")
    np.testing.assert_array_equal(first.positions, synthetic.positions[1:40])
    np.testing.assert_array_equal(second.positions, synthetic.positions[61:])
    faces = denoising_clips(tmp_path, with_face_points)["train"]
    assert [(face.name, face.frames) for face in faces] == [("clip-0", 39), ("clip-1", 59)]
    assert {face.skeleton for face in faces} == {Skeleton.preset("coco17")}
    write(np.zeros(3, bool))
    with pytest.raises(ValueError, match=r"suspect must be bool of shape \(120,\)"):
        denoising_clips(tmp_path)


def test_synthetic_parts_have_all_styles_and_are_distinct():
    parts = synthetic_denoising_clips(15, seconds=2)
    assert [len(clips) for clips in parts.values()] == [15, 3, 3]
    all_clips = [clip for clips in parts.values() for clip in clips]
    assert len({clip.name for clip in all_clips}) == 21
    assert {(clip.frames, clip.fps, clip.skeleton) for clip in all_clips} == {(60, 30.0, PERSON)}
    for clips in parts.values():
        assert {clip.name.partition("-")[0] for clip in clips} == {"walk", "run", "march"}
    again = synthetic_denoising_clips(15, seconds=2)
    np.testing.assert_array_equal(again["test"][0].positions, parts["test"][0].positions)
    other = synthetic_denoising_clips(15, seconds=2, seed=1)
    assert abs(other["test"][0].positions - parts["test"][0].positions).max() > 0.01
    assert nearest(parts["test"], parts["train"], 10, 1).min() > 0.01
