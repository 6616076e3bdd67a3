"""The walks that ``walk2d`` is about: what is held out is no copy of what is learnt from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.walks import WALK_CLIPS, synthetic_walks, walk_clips
from probmotion.data.tracks.learning import body_sizes, film_clips
from probmotion.io.files import load_motion
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")


def poses(motion: Motion, mirrored: bool = False) -> np.ndarray:
    """Every pose about its pelvis, (L, 13, 3) metres; mirrored: seen in a mirror."""
    body = motion.retarget(PERSON).positions
    body = body - body[:, :1]
    if mirrored:
        order = np.arange(14)
        for left, right in PERSON.mirrored_pairs:
            order[[left, right]] = right, left
        body = body[:, order] * np.array([-1.0, 1.0, 1.0])
    return body[:, 1:]


def nearest(some: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Root mean square distance of joints from each pose to the nearest of others, metres.

    After the best turn about the vertical: with z = x + i y of the ground plane, the turn's share
    of |z − e^{iφ} w|² is −2 |z̄·w| at its least.
    """
    ground, ground_others = (body[..., 0] + 1j * body[..., 2] for body in (some, others))
    shared = abs(ground.conj() @ ground_others.T) + some[..., 1] @ others[..., 1].T
    squares = (some**2).sum(axis=(1, 2))[:, None] + (others**2).sum(axis=(1, 2)) - 2 * shared
    return np.sqrt(np.maximum(squares, 0).min(axis=1) / some.shape[1])


@pytest.fixture(scope="module")
def walks(real_data: Path) -> dict[str, list[Motion]]:
    return walk_clips(real_data)


def test_the_distance_is_the_least_over_turns(walks: dict[str, list[Motion]]) -> None:
    some, others = (poses(walks["train"][number])[::100] for number in (0, 1))
    found = nearest(some, others)
    wanted = np.full(found.shape, np.inf)
    for angle in np.linspace(0, 2 * np.pi, 721):
        c, s = np.cos(angle), np.sin(angle)
        turned = others @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        off = np.sqrt(((some[:, None] - turned) ** 2).sum(axis=-1).mean(axis=-1))
        wanted = np.minimum(wanted, off.min(axis=1))
    np.testing.assert_allclose(found, wanted, atol=1e-3)
    clip = walks["train"][0]
    np.testing.assert_allclose(nearest(poses(clip.turned(2.0))[:9], poses(clip)), 0, atol=1e-6)


def test_the_parts_are_of_different_clips(walks: dict[str, list[Motion]]) -> None:
    names = [name for part in WALK_CLIPS.values() for name in part]
    assert len(set(names)) == len(names)
    assert list(walks) == list(WALK_CLIPS) == ["train", "validation", "test"]
    assert [clip.name for part in walks.values() for clip in part] == [
        name.rpartition("/")[2] for name in names
    ]
    clips = [clip for part in walks.values() for clip in part]
    assert {clip.fps for clip in clips} == {30.0}
    assert sum(clip.frames for clip in clips) == 3352  # as the docstring says


@pytest.mark.parametrize("mirrored", [False, True])
def test_no_held_out_clip_is_a_copy_or_an_excerpt(
    walks: dict[str, list[Motion]], mirrored: bool
) -> None:
    learnt = np.concatenate([poses(clip, mirrored) for clip in walks["train"]])
    for part in ("validation", "test"):
        for clip in walks[part]:
            # Half of a clip within 2 cm would be the same steps.
            assert np.median(nearest(poses(clip), learnt)) > 0.02, clip.name
    # Test clips are not what early stopping and settings were chosen by either.
    watched = np.concatenate([poses(clip, mirrored) for clip in walks["validation"]])
    for clip in walks["test"]:
        assert np.median(nearest(poses(clip), watched)) > 0.02


def test_what_is_left_out_is_an_excerpt(real_data: Path, walks: dict[str, list[Motion]]) -> None:
    folder = real_data / "deepmimic_human"
    (long_walk,) = (clip for clip in walks["train"] if clip.name == "humanoid3d_long_walk1")
    excerpt = load_motion(folder / "humanoid3d_walk.npz")
    assert np.median(nearest(poses(excerpt), poses(long_walk))) < 0.011
    zombie = load_motion(folder / "humanoid3d_zombie_walk.npz")
    whole = load_motion(folder / "humanoid3d_long_zombie.npz")
    assert nearest(poses(zombie), poses(whole)).max() < 0.011
    # The zombie is no walk of the others' kind: nothing of it is learnt.
    learnt = np.concatenate([poses(clip) for clip in walks["train"]])
    assert nearest(poses(whole), learnt).min() > 0.1


def test_held_out_clips_are_of_the_styles_that_are_learnt(walks: dict[str, list[Motion]]) -> None:
    learnt = np.concatenate([poses(clip) for clip in walks["train"]])
    for part in ("validation", "test"):
        for clip in walks[part]:
            assert np.median(nearest(poses(clip), learnt)) < 0.10, clip.name


def test_every_part_is_filmed(walks: dict[str, list[Motion]]) -> None:
    for part, clips in walks.items():
        filmed = film_clips(clips, PERSON, 20.0, views=1)
        assert len(filmed.tracks) == len(clips), part
        for track, clip in zip(filmed.tracks, clips, strict=True):
            assert track.frames == pytest.approx(clip.frames * 20 / clip.fps, abs=1)


def test_every_real_clip_of_one_person_is_filmed(real_data: Path) -> None:
    files = [
        file
        for folder in ("cmu_single", "deepmimic_human")
        for file in sorted((real_data / folder).glob("*.npz"))
    ]
    clips = [load_motion(file) for file in files]
    assert len(clips) == 48
    filmed = film_clips(clips, PERSON, 20.0, views=1)
    # Dropped is what lasts less than a second, and nothing else.
    assert {clip_of(track.name) for track in filmed.tracks} == {
        clip.name for clip in clips if clip.frames >= clip.fps
    }
    for track in filmed.tracks:
        np.testing.assert_array_equal(track.keypoints[track.confidence[:, 0] > 0, 0], 0.0)
        assert np.nanmax(abs(track.keypoints)) < 2.5
    # All are in metres: bones are those of people, on any of the skeletons.
    sizes = body_sizes(PERSON)
    for clip in clips:
        body = clip.retarget(PERSON)
        lengths = [
            np.linalg.norm(body.positions[0, joint] - body.positions[0, parent])
            / sizes[PERSON.joint_names[joint]]
            for joint, parent in PERSON.bones
        ]
        assert 0.7 < np.median(lengths) < 1.4, clip.name


def test_a_missing_clip_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"humanoid3d_long_walk1\.npz"):
        walk_clips(tmp_path)


def test_made_walks_are_the_same_for_all() -> None:
    walks = synthetic_walks(3, seconds=2.5, fps=20.0)
    assert [(clip.name, clip.frames, clip.fps) for clip in walks] == [
        (f"walk-{number}", 50, 20.0) for number in range(3)
    ]
    for clip, again in zip(walks, synthetic_walks(5, seconds=2.5, fps=20.0), strict=False):
        np.testing.assert_array_equal(clip.positions, again.positions)
    bodies = [poses(clip) for clip in walks]
    # No two are one: half a walk is more than a centimetre from all of another.
    for number, body in enumerate(bodies):
        for other in bodies[:number] + bodies[number + 1 :]:
            assert np.median(nearest(body, other)) > 0.01


def test_quadrupeds_walk_where_their_joints_are_asked_for() -> None:
    horse = Skeleton.preset("apt36k17")
    (clip,) = synthetic_walks(1, horse, seconds=1)
    assert clip.name.startswith("quadruped-walk")
    assert set(body_sizes(horse)) == {
        horse.joint_names[joint] for joint, parent in enumerate(horse.parents) if parent >= 0
    }
    with pytest.raises(ValueError, match="expected those of a person or a quadruped"):
        synthetic_walks(1, Skeleton(["hub", "rim"], [-1, 0]))
