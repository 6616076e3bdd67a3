"""The clips that denoising is learnt from: what is held out is no copy of what is learnt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.denoising_clips import (
    DENOISING_CLIPS,
    denoising_clips,
    synthetic_denoising_clips,
)
from probmotion.io.files import load_motion
from probmotion.motion.distances import windows, yaw_aligned_distances

PERSON = Skeleton.preset("person14")


def nearest(some: list[Motion], others: list[Motion], stride: int, step: int) -> np.ndarray:
    """Distance of each window of 30 frames to the nearest of others, in a mirror too, metres."""
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
def clips(real_data: Path) -> dict[str, list[Motion]]:
    return denoising_clips(real_data)


def test_the_parts_are_of_different_clips_and_leave_out_three(real_data: Path) -> None:
    names = [name for part in DENOISING_CLIPS.values() for name in part]
    assert len(set(names)) == len(names) == 45
    every = {
        f"{folder}/{path.stem}"
        for folder in ("cmu_single", "deepmimic_human")
        for path in (real_data / folder).glob("*.npz")
    }
    assert every - set(names) == {
        f"deepmimic_human/humanoid3d_{name}" for name in ("jog", "walk", "zombie_walk")
    }
    jog = load_motion(real_data / "deepmimic_human" / "humanoid3d_jog.npz")
    assert jog.frames < 30


def test_clips_are_on_one_skeleton_at_one_rate(clips: dict[str, list[Motion]]) -> None:
    assert list(clips) == ["train", "validation", "test"]
    every = [clip for part in clips.values() for clip in part]
    assert {clip.skeleton for clip in every} == {PERSON}
    assert {clip.fps for clip in every} == {30.0}
    assert min(clip.frames for clip in every) >= 30
    assert [sum(clip.frames for clip in part) for part in clips.values()] == [16349, 1333, 2441]
    assert len({clip.name for clip in every}) == len(every)


def test_no_window_holds_a_suspect_frame(real_data: Path, clips: dict[str, list[Motion]]) -> None:
    kept = {clip.name: clip for part in clips.values() for clip in part}
    found = 0
    for names in DENOISING_CLIPS.values():
        for name in names:
            stem = name.rpartition("/")[2]
            with np.load(real_data / f"{name}.npz") as archive:
                suspect = archive["suspect"] if "suspect" in archive.files else None
            whole = load_motion(real_data / f"{name}.npz").retarget(PERSON)
            if suspect is None or not suspect.any():
                np.testing.assert_array_equal(kept[stem].positions, whole.positions)
                continue
            found += 1
            good = np.split(np.arange(whole.frames), np.flatnonzero(suspect))
            pieces = [part[~suspect[part]] for part in good]
            pieces = [part for part in pieces if len(part) >= 30]
            for number, part in enumerate(pieces):
                piece = kept[f"{stem}-{number}"].positions
                np.testing.assert_array_equal(piece, whole.positions[part])
            assert f"{stem}-{len(pieces)}" not in kept
    assert found == 3
    # Markers jump at over 9 m/s; of people who do no flips, no joint is as fast.
    for name, clip in kept.items():
        if name.startswith("cmu"):
            speed = np.linalg.norm(np.diff(clip.positions, axis=0), axis=-1).max() * 30
            assert speed < 6, name


def test_no_held_out_clip_is_a_copy_or_an_excerpt(clips: dict[str, list[Motion]]) -> None:
    seen = {"validation": clips["train"], "test": clips["train"] + clips["validation"]}
    for part, others in seen.items():
        for clip in clips[part]:
            found = nearest([clip], others, 20, 4)
            # What the same person does again is 3 to 10 cm away; excerpts are at 2.3 cm or less.
            assert found.min() > 0.035, clip.name
            assert np.median(found) > 0.04, clip.name


def test_what_is_left_out_is_an_excerpt(real_data: Path, clips: dict[str, list[Motion]]) -> None:
    by_name = {clip.name: clip for clip in clips["train"]}
    for name, whole, distance in (
        ("walk", "long_walk1", 0.023),
        ("zombie_walk", "long_zombie", 0.0005),
    ):
        excerpt = load_motion(real_data / "deepmimic_human" / f"humanoid3d_{name}.npz")
        found = nearest([excerpt.retarget(PERSON)], [by_name[f"humanoid3d_{whole}"]], 1, 1)
        assert np.median(found) < distance


def test_the_hard_clip_is_like_nothing_learnt_and_others_are(
    clips: dict[str, list[Motion]],
) -> None:
    for clip in clips["test"]:
        found = np.median(nearest([clip], clips["train"], 25, 5))
        assert (found > 0.3) == (clip.name == "humanoid3d_getup_faceup"), clip.name


def test_a_missing_clip_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"cmu_01_01\.npz"):
        denoising_clips(tmp_path)


def test_pieces_between_suspect_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (made,) = synthetic_denoising_clips(1, seconds=4)["train"]
    suspect = np.zeros(made.frames, bool)
    suspect[[0, 40, 41, 60]] = True  # 1-39, 42-59 (too short), 61-119

    def written(marks: np.ndarray) -> None:
        np.savez(
            tmp_path / "clip.npz",
            positions=made.positions,
            fps=30.0,
            joint_names=np.array(PERSON.joint_names),
            parents=np.array(PERSON.parents),
            suspect=marks,
        )

    monkeypatch.setattr("probmotion.data.denoising_clips.DENOISING_CLIPS", {"train": ("clip",)})
    written(suspect)
    first, second = denoising_clips(tmp_path)["train"]
    assert (first.name, second.name) == ("clip-0", "clip-1")
    np.testing.assert_array_equal(first.positions, made.positions[1:40])
    np.testing.assert_array_equal(second.positions, made.positions[61:])
    written(np.zeros(3, bool))
    with pytest.raises(ValueError, match=r"suspect of bool and shape \(3,\), expected 120"):
        denoising_clips(tmp_path)


def test_made_clips_have_every_style_in_every_part() -> None:
    parts = synthetic_denoising_clips(15, seconds=2)
    assert {part: len(made) for part, made in parts.items()} == {
        "train": 15,
        "validation": 3,
        "test": 3,
    }
    every = [clip for made in parts.values() for clip in made]
    assert len({clip.name for clip in every}) == 21
    for made in parts.values():
        assert {clip.name.partition("-")[0] for clip in made} == {"walk", "run", "march"}
        for clip in made:
            assert (clip.frames, clip.fps, clip.skeleton) == (60, 30.0, PERSON)
    again = synthetic_denoising_clips(15, seconds=2)
    np.testing.assert_array_equal(again["test"][0].positions, parts["test"][0].positions)
    other = synthetic_denoising_clips(15, seconds=2, seed=1)
    assert abs(other["test"][0].positions - parts["test"][0].positions).max() > 0.01
    assert nearest(parts["test"], parts["train"], 10, 1).min() > 0.01
