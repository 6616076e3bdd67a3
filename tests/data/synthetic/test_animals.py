"""Recorded dogs and synthetic quadrupeds on one skeleton."""

import numpy as np
import pytest

from probmotion.data.synthetic.animals import (
    ANIMAL_SKELETON,
    DOG_CLIPS,
    VARIED_TRUNKS,
    animal_clips,
    dog_clips,
    synthetic_animals,
)
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.files import load

SIDES = ("left", "right")
PAWS = [f"{side}_{end}_paw" for side in SIDES for end in ("front", "back")]
# Pairs of joints of one rigid part without a bone between them.
RIGID = [
    ("left_hip", "right_hip"), ("tail", "left_hip"), ("neck", "left_shoulder"),
    ("left_shoulder", "right_shoulder"),
]  # fmt: skip


def path_of(clip, name):
    return clip.positions[:, clip.skeleton.index(name)]


@pytest.fixture(scope="module")
def dogs(real_data):
    return [clip for part in dog_clips(real_data, seconds=4.0).values() for clip in part]


@pytest.fixture(scope="module")
def synthetic():
    return synthetic_animals(12, frames=120)


def bend(clip, upper, middle, lower):
    """Return the distance of the middle joint in front of the line between the others, metres."""
    top, joint, end = (path_of(clip, name) for name in (upper, middle, lower))
    trunk = path_of(clip, "neck") - path_of(clip, "pelvis")
    forward = trunk * [1.0, 0.0, 1.0] / np.linalg.norm(trunk[:, [0, 2]], axis=-1)[:, None]
    fraction = ((joint - top) * (end - top)).sum(-1) / ((end - top) ** 2).sum(-1)
    return ((joint - top - fraction[:, None] * (end - top)) * forward).sum(axis=-1)


def assert_quadruped(clip):
    assert clip.skeleton == ANIMAL_SKELETON
    names = ANIMAL_SKELETON.joint_names
    pairs = [*((names[joint], names[parent]) for joint, parent in ANIMAL_SKELETON.bones), *RIGID]
    lengths = np.stack(
        [np.linalg.norm(path_of(clip, a) - path_of(clip, b), axis=-1) for a, b in pairs]
    )
    assert lengths.min() > 0.05
    np.testing.assert_allclose(lengths, lengths[:, [0]].repeat(clip.frames, 1), atol=1e-6)
    trunk = path_of(clip, "neck") - path_of(clip, "pelvis")
    assert trunk[0, 2] > 0.4
    assert abs(trunk[0, 0]) < 1e-6
    for part in ("hip", "shoulder"):
        left = path_of(clip, f"left_{part}") - path_of(clip, f"right_{part}")
        assert left[0, 0] > 0.05
        # The vector forward × left points up, so no clip is mirrored or upside down.
        assert (np.cross(trunk, left)[:, 1] > 0).all()
    for paw in PAWS:
        assert -0.08 < path_of(clip, paw)[:, 1].min() < 0.08, paw
    for name in ("left_hip", "right_shoulder"):
        assert path_of(clip, name)[:, 1].min() > 0.3
    for side in SIDES:
        front = [f"{side}_{name}" for name in ("shoulder", "elbow", "wrist", "front_paw")]
        hind = [f"{side}_{name}" for name in ("hip", "knee", "ankle", "back_paw")]
        assert np.median(bend(clip, *front[:3])) < -0.02  # elbows bend backwards
        assert np.median(bend(clip, *hind[:3])) > 0.02  # knees forwards
        assert np.median(bend(clip, *hind[1:])) < -0.02  # hocks backwards


@pytest.mark.parametrize(
    ("clips", "names"),
    [
        ("synthetic", ["quadruped-walk-0", "quadruped-trot-0", "quadruped-walk-1"]),
        ("dogs", ["dog3d_canter", "dog3d_pace", "dog3d_spin", "dog3d_trot"]),
    ],
)
def test_clips_are_quadrupeds(request, clips, names):
    clips = request.getfixturevalue(clips)
    assert [clip.name for clip in clips][: len(names)] == names
    for clip in clips:
        assert_quadruped(clip)
        assert (clip.frames, clip.fps) == (120, 30)


def test_trunk_and_paws_follow_the_gaits(synthetic):
    for clip in synthetic[:4]:
        style, _, number = clip.name.rpartition("-")
        gait = make_gait(style, int(number), frames=120)
        for name in (*PAWS, "neck", "left_hip", "right_hip"):
            np.testing.assert_array_equal(path_of(clip, name), path_of(gait, name))
        np.testing.assert_array_equal(path_of(clip, "pelvis"), path_of(gait, "tail"))
        offset = path_of(clip, "left_shoulder") - path_of(gait, "left_shoulder")
        assert np.linalg.norm(offset, axis=-1).max() < 0.05
        # The angle of the hock grows linearly with the extension of the leg, 0.6 m at most.
        hip, *leg = (path_of(clip, f"left_{name}") for name in ("hip", "knee", "ankle", "back_paw"))
        upper, lower = leg[0] - leg[1], leg[2] - leg[1]
        sine = np.linalg.norm(np.cross(upper, lower), axis=-1)
        angle = np.degrees(np.arctan2(sine, (upper * lower).sum(axis=-1)))
        extension = np.linalg.norm(leg[2] - hip, axis=-1) / 0.6
        np.testing.assert_allclose(angle, 95 + (152 - 95) * extension, atol=1e-6)


def test_trunks_vary_but_legs_do_not(synthetic):
    varied = synthetic_animals(12, frames=120, trunks=VARIED_TRUNKS)
    ratios = []
    for clip, usual in zip(varied, synthetic, strict=True):
        assert_quadruped(clip)
        trunk, before = (path_of(one, "neck") - path_of(one, "pelvis") for one in (clip, usual))
        ratio = np.linalg.norm(trunk[0]) / np.linalg.norm(before[0])
        np.testing.assert_allclose(trunk, ratio * before, atol=1e-9)
        for side in SIDES:
            for joint, above in (("elbow", "shoulder"), ("knee", "hip"), ("front_paw", "wrist")):
                bone = path_of(clip, f"{side}_{joint}") - path_of(clip, f"{side}_{above}")
                same = path_of(usual, f"{side}_{joint}") - path_of(usual, f"{side}_{above}")
                np.testing.assert_allclose(bone, same, atol=1e-9)
        ratios.append(ratio)
    assert 0.65 < min(ratios) < max(ratios) < 1.05
    assert np.ptp(ratios) > 0.2


def test_animal_does_not_depend_on_other_animals(synthetic):
    for clip, again in zip(synthetic_animals(3, frames=60), synthetic, strict=False):
        np.testing.assert_allclose(clip.positions[:, 0], again.positions[:60, 0])
    other = synthetic_animals(1, frames=120, seed=1)[0]
    assert not np.array_equal(other.positions, synthetic[0].positions)
    (one,), (again, _), (other,) = (
        synthetic_animals(n, 10, seed=seed, trunks=VARIED_TRUNKS)
        for n, seed in ((1, 0), (2, 0), (1, 1))
    )
    trunks = [
        np.linalg.norm(path_of(clip, "neck")[0] - path_of(clip, "pelvis")[0])
        for clip in (one, again, other)
    ]
    assert trunks[0] == trunks[1] != trunks[2]


def test_dogs_move_as_in_their_cycles(dogs, real_data):
    for clip in dogs:
        np.testing.assert_allclose(clip.positions[0, 0, [0, 2]], 0, atol=1e-12)
        source = load(real_data / f"deepmimic_dog/{clip.name}.npz")
        period = source.frames - 1
        travel = np.linalg.norm((source.positions[-1, 0] - source.positions[0, 0])[[0, 2]])
        for number in (0, 1):
            begin, end = clip.positions[[number * period, (number + 1) * period], 0]
            step = np.linalg.norm((end - begin)[[0, 2]])
            assert step == pytest.approx(travel, abs=1e-6)
        # Dogs run forwards.
        if clip.name != "dog3d_spin":
            assert clip.positions[-1, 0, 2] > 0.95 * travel / period * (clip.frames - 1)
        # The first cycle is that of the file, rotated and corrected by a few centimetres.
        first = clip.positions[: source.frames]
        recorded = source.retarget(ANIMAL_SKELETON).positions
        heights = first[..., 1] - recorded[..., 1]
        assert np.sqrt((heights**2).mean()) < 0.03


def test_parts_are_disjoint_and_have_both_gaits():
    parts = animal_clips(n=10, seconds=2.0)
    assert list(parts) == list(DOG_CLIPS) == ["train", "validation", "test"]
    assert [len(clips) for clips in parts.values()] == [10, 2, 2]
    for clips in parts.values():
        assert {clip.name.split("-")[1] for clip in clips} == {"walk", "trot"}
        assert {clip.frames for clip in clips} == {60}
    assert len({clip.name for clips in parts.values() for clip in clips}) == 14
    varied = animal_clips(n=10, seconds=2.0, trunks=VARIED_TRUNKS)
    expected = synthetic_animals(14, 60, trunks=VARIED_TRUNKS)
    for clip, again in zip((c for clips in varied.values() for c in clips), expected, strict=True):
        np.testing.assert_array_equal(clip.positions, again.positions)


def test_dogs_come_first_and_must_be_cycles(real_data, tmp_path):
    synthetic = animal_clips(n=4, seconds=2.0)
    for part, clips in animal_clips(real_data, n=4, seconds=2.0).items():
        names = [name.rpartition("/")[2] for name in DOG_CLIPS[part]]
        assert [clip.name for clip in clips] == names + [clip.name for clip in synthetic[part]]
        assert {clip.frames for clip in clips} == {60}
    (tmp_path / "deepmimic_dog").mkdir()
    with np.load(real_data / "deepmimic_dog/dog3d_canter.npz") as archive:
        arrays = dict(archive) | {"loop": np.array("none")}
    np.savez(tmp_path / "deepmimic_dog/dog3d_canter.npz", **arrays)
    with pytest.raises(ValueError, match=r"dog3d_canter.npz must be a cycle .* 'none' at 30"):
        dog_clips(tmp_path)


def test_invalid_input(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"folder must contain deepmimic_dog/dog3d_can"):
        animal_clips(tmp_path, n=2)
    with pytest.raises(ValueError, match="seconds must be a finite number above 0, got 0"):
        animal_clips(seconds=0)
    with pytest.raises(ValueError, match="n must be an integer of at least 1, got 0"):
        synthetic_animals(0)
    with pytest.raises(ValueError, match="trunks must be two finite numbers above 0, the first"):
        synthetic_animals(1, trunks=(1.0, 0.5))
