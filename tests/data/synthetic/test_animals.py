"""Four-legged animals: real dogs and made ones on one skeleton, whole, upright and facing alike."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.animals import (
    ANIMAL_SKELETON,
    DOG_CLIPS,
    animal_clips,
    dog_clips,
    synthetic_animals,
)
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import load_motion

SIDES = ("left", "right")
PAWS = [f"{side}_{end}_paw" for side in SIDES for end in ("front", "back")]
# Pairs that no bone joins and that are of one rigid piece.
PIECES = [
    ("left_hip", "right_hip"), ("tail", "left_hip"), ("neck", "left_shoulder"),
    ("left_shoulder", "right_shoulder"),
]  # fmt: skip


def path_of(clip: Motion, name: str) -> np.ndarray:
    return clip.positions[:, clip.skeleton.index(name)]


def distances(clip: Motion, pairs: list[tuple[str, str]]) -> np.ndarray:
    return np.stack(
        [np.linalg.norm(path_of(clip, a) - path_of(clip, b), axis=-1) for a, b in pairs]
    )


def bones_of(skeleton: Skeleton) -> list[tuple[str, str]]:
    return [(skeleton.joint_names[j], skeleton.joint_names[p]) for j, p in skeleton.bones]


@pytest.fixture(scope="module")
def dogs(real_data: Path) -> list[Motion]:
    return [clip for part in dog_clips(real_data, seconds=4.0).values() for clip in part]


@pytest.fixture(scope="module")
def made() -> list[Motion]:
    return synthetic_animals(12, frames=120)


def assert_is_an_animal(clip: Motion) -> None:
    """On the skeleton, of constant bones, facing +Z with its left on +X, paws on the ground."""
    assert clip.skeleton == ANIMAL_SKELETON
    for pairs in (bones_of(ANIMAL_SKELETON), PIECES):
        lengths = distances(clip, pairs)
        assert lengths.min() > 0.05
        np.testing.assert_allclose(lengths, lengths[:, [0]].repeat(clip.frames, 1), atol=1e-6)
    trunk = path_of(clip, "neck") - path_of(clip, "pelvis")
    assert trunk[0, 2] > 0.4
    assert abs(trunk[0, 0]) < 1e-6
    for part in ("hip", "shoulder"):
        left = path_of(clip, f"left_{part}") - path_of(clip, f"right_{part}")
        assert left[0, 0] > 0.05
        # forward × left is up in every frame: no clip is a mirror image, none lies on its back.
        assert (np.cross(trunk, left)[:, 1] > 0).all()
    for paw in PAWS:
        # A paw's joint is in its middle, centimetres above the ground it stands on.
        assert -0.08 < path_of(clip, paw)[:, 1].min() < 0.08, paw
    legs = [path_of(clip, name)[:, 1] for name in ("left_hip", "right_shoulder")]
    assert min(legs[0].min(), legs[1].min()) > 0.3


def bend(clip: Motion, upper: str, middle: str, lower: str) -> np.ndarray:
    """How far the middle joint is before the line between the others, metres, for every frame."""
    top, joint, end = (path_of(clip, name) for name in (upper, middle, lower))
    trunk = path_of(clip, "neck") - path_of(clip, "pelvis")
    forward = trunk * [1.0, 0.0, 1.0] / np.linalg.norm(trunk[:, [0, 2]], axis=-1)[:, None]
    share = ((joint - top) * (end - top)).sum(-1) / ((end - top) ** 2).sum(-1)
    return ((joint - top - share[:, None] * (end - top)) * forward).sum(axis=-1)


def assert_bends_like_a_dog(clip: Motion) -> None:
    for side in SIDES:
        front = [f"{side}_{name}" for name in ("shoulder", "elbow", "wrist", "front_paw")]
        hind = [f"{side}_{name}" for name in ("hip", "knee", "ankle", "back_paw")]
        assert np.median(bend(clip, *front[:3])) < -0.02  # elbows bend backwards
        assert np.median(bend(clip, *hind[:3])) > 0.02  # knees forwards
        assert np.median(bend(clip, *hind[1:])) < -0.02  # hocks backwards


def test_the_skeleton_is_one_body_with_sides() -> None:
    assert len(ANIMAL_SKELETON.roots) == 1
    assert len(ANIMAL_SKELETON.mirrored_pairs) == 8
    assert ANIMAL_SKELETON.canonical_names == ANIMAL_SKELETON.joint_names
    order = ANIMAL_SKELETON.mirrored_order
    for joint, parent in ANIMAL_SKELETON.bones:
        assert ANIMAL_SKELETON.parents[order[joint]] == order[parent]
    missing = set(Skeleton.preset("apt36k17").joint_names) - set(ANIMAL_SKELETON.joint_names)
    assert missing == {"nose", "left_eye", "right_eye"}


def test_made_animals_are_animals(made: list[Motion]) -> None:
    for clip in made:
        assert_is_an_animal(clip)
        assert_bends_like_a_dog(clip)
        assert clip.frames == 120
        assert clip.fps == 30
    assert [clip.name for clip in made[:3]] == [
        "quadruped-walk-0",
        "quadruped-trot-0",
        "quadruped-walk-1",
    ]


def test_made_animals_have_the_gaits_trunk_and_paws(made: list[Motion]) -> None:
    for clip in made[:4]:
        style, _, number = clip.name.rpartition("-")
        gait = make_gait(style, int(number), frames=120)
        for name in (*PAWS, "neck", "left_hip", "right_hip"):
            np.testing.assert_array_equal(path_of(clip, name), path_of(gait, name))
        np.testing.assert_array_equal(path_of(clip, "pelvis"), path_of(gait, "tail"))
        # Shoulders lean with the trunk, by millimetres.
        apart = path_of(clip, "left_shoulder") - path_of(gait, "left_shoulder")
        assert np.linalg.norm(apart, axis=-1).max() < 0.05


def test_an_animal_is_the_same_whatever_else_is_made(made: list[Motion]) -> None:
    for clip, again in zip(synthetic_animals(3, frames=60), made, strict=False):
        np.testing.assert_allclose(clip.positions[:, 0], again.positions[:60, 0])
    other = synthetic_animals(1, frames=120, seed=1)[0]
    assert not np.array_equal(other.positions, made[0].positions)


def test_the_parts_are_of_different_animals() -> None:
    parts = animal_clips(n=10, seconds=2.0)
    assert list(parts) == list(DOG_CLIPS) == ["train", "validation", "test"]
    assert [len(clips) for clips in parts.values()] == [10, 2, 2]
    names = [clip.name for clips in parts.values() for clip in clips]
    assert len(set(names)) == len(names) == 14
    for clips in parts.values():  # each has walks and trots
        assert {clip.name.split("-")[1] for clip in clips} == {"walk", "trot"}
        assert all(clip.frames == 60 for clip in clips)


def test_animals_are_filmed_at_ten_frames_a_second(made: list[Motion]) -> None:
    slow = [clip.resample(10.0) for clip in made[:2]]
    for clip, whole in zip(slow, made, strict=False):
        # Every third frame: nothing is interpolated, and bones stay as long as they are.
        np.testing.assert_array_equal(clip.positions, whole.positions[::3])
    tracks = project_clips(slow, views=3, noise=DetectorNoise.none())
    assert len(tracks) == 6
    for track in tracks:
        assert track.frames == 40
        assert track.skeleton == ANIMAL_SKELETON
        np.testing.assert_allclose(track.keypoints[:, 0], 0, atol=1e-12)
        assert abs(track.keypoints).max() < 1.5


class TestDogs:
    def test_dogs_are_animals(self, dogs: list[Motion]) -> None:
        assert [clip.name for clip in dogs] == [
            "dog3d_canter",
            "dog3d_pace",
            "dog3d_spin",
            "dog3d_trot",
        ]
        for clip in dogs:
            assert clip.frames == 120
            assert clip.fps == 30
            assert_is_an_animal(clip)
            assert_bends_like_a_dog(clip)
            np.testing.assert_allclose(clip.positions[0, 0, [0, 2]], 0, atol=1e-12)

    def test_dogs_go_on_as_their_cycles_do(self, dogs: list[Motion], real_data: Path) -> None:
        for clip in dogs:
            source = load_motion(real_data / f"deepmimic_dog/{clip.name}.npz")
            period = source.frames - 1
            went = source.positions[-1, 0] - source.positions[0, 0]
            for number in (0, 1):
                begin, end = clip.positions[[number * period, (number + 1) * period], 0]
                step = np.linalg.norm((end - begin)[[0, 2]])
                assert step == pytest.approx(np.linalg.norm(went[[0, 2]]), abs=1e-6)
            # Where a dog runs, it runs the way it faces, for as long as it runs.
            if clip.name != "dog3d_spin":
                speed = np.linalg.norm(went) / period
                assert clip.positions[-1, 0, 2] > 0.95 * speed * (clip.frames - 1)
            # The first cycle is the file's, turned: what is made up for is centimetres.
            first = clip.positions[: source.frames]
            moved = source.retarget(ANIMAL_SKELETON).positions
            heights = first[..., 1] - moved[..., 1]
            assert np.sqrt((heights**2).mean()) < 0.03

    def test_seams_are_not_visible(self, dogs: list[Motion], real_data: Path) -> None:
        for clip in dogs:
            source = load_motion(real_data / f"deepmimic_dog/{clip.name}.npz")
            cycle = source.retarget(ANIMAL_SKELETON).positions
            within = np.linalg.norm(np.diff(cycle, n=2, axis=0), axis=-1).max()
            bends = np.linalg.norm(np.diff(clip.positions, n=2, axis=0), axis=-1).max(axis=-1)
            seams = np.arange(len(cycle) - 1, clip.frames - 2, len(cycle) - 1)
            for place in (seams - 2, seams - 1, seams):
                assert bends[place].max() <= within, clip.name

    def test_they_join_made_animals(self, real_data: Path) -> None:
        parts = animal_clips(real_data, n=4, seconds=2.0)
        made = animal_clips(n=4, seconds=2.0)
        for part, clips in parts.items():
            names = [name.rpartition("/")[2] for name in DOG_CLIPS[part]]
            assert [clip.name for clip in clips] == names + [clip.name for clip in made[part]]
            assert {clip.frames for clip in clips} == {60}
        held_out = set(DOG_CLIPS["test"] + DOG_CLIPS["validation"])
        assert not held_out & set(DOG_CLIPS["train"])

    def test_a_file_that_is_no_cycle_is_refused(self, real_data: Path, tmp_path: Path) -> None:
        folder = tmp_path / "deepmimic_dog"
        shutil.copytree(real_data / "deepmimic_dog", folder, copy_function=shutil.copyfile)
        folder.chmod(0o755)
        with np.load(real_data / "deepmimic_dog" / "dog3d_pace.npz") as archive:
            arrays = dict(archive)
        np.savez(folder / "dog3d_pace.npz", **{**arrays, "loop": np.array("none")})
        with pytest.raises(ValueError, match=r"folder has dog3d_pace.npz with loop 'none' at 30 "):
            dog_clips(tmp_path)


def test_a_folder_without_dogs_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"folder has no deepmimic_dog/dog3d_canter\.npz"):
        animal_clips(tmp_path, n=2)
    with pytest.raises(ValueError, match="seconds must be a finite number above 0, got 0"):
        animal_clips(seconds=0)
    with pytest.raises(ValueError, match="n must be an integer of at least 1, got 0"):
        synthetic_animals(0)
