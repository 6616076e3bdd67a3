"""Tracks of bodies that are not made: in metres by bones they share, or in lengths of their own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from probmotion import Cameras, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.synthetic.walks import shared_skeleton
from probmotion.data.tracks.learning import body_sizes, read_tracks
from probmotion.data.tracks.scale_reports import body_extent, per_track_scales
from probmotion.data.tracks.scales import bone_sizes, scale_to_bones
from probmotion.motion.motion import KeypointTrack

PERSON = Skeleton.preset("person14")
WORM = Skeleton(["snout", "back", "rump", "tail_tip"], [-1, 0, 1, 2])


def archive(track: KeypointTrack, folder: Path, name: str) -> Path:
    np.savez(
        folder / f"{name}.npz",
        keypoints=track.keypoints,
        confidence=track.confidence,
        fps=track.fps,
        joint_names=np.array(track.skeleton.joint_names),
        parents=np.array(track.skeleton.parents, dtype=np.int32),
    )
    return folder / f"{name}.npz"


def walk_on(skeleton: Skeleton, number: int, pixels: float) -> KeypointTrack:
    """A person who walks, on the joints that it has; what else there is lies beside the root."""
    body = make_gait("walk", number, frames=60)
    camera = Cameras.around(np.array([1.2]), np.array([0.2]), distance=7.0, perspective=True)
    known = body.skeleton.canonical_names
    points = camera.project(body.positions - body.positions[:, :1])[0]
    keypoints = np.stack(
        [
            points[:, known.index(name)] if name in known else points[:, 0] + 0.1
            for name in skeleton.canonical_names
        ],
        axis=1,
    )
    sure = np.full(keypoints.shape[:2], 0.9)
    return KeypointTrack(pixels * keypoints + 500, sure, skeleton, 30.0, f"walk{number}")


def worm(number: int, pixels: float, stretched: float = 1.0) -> KeypointTrack:
    """An animal that winds, of proportions 3 : 5 : 2."""
    time = np.arange(60) / 30
    angles = 0.4 * np.sin(3 * time[:, None] + np.arange(3) + number)
    lengths = stretched * np.array([3.0, 5.0, 2.0])
    steps = lengths[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = np.concatenate([np.zeros((60, 1, 2)), np.cumsum(steps, axis=1)], axis=1)
    return KeypointTrack(pixels * points + 300, np.full((60, 4), 0.9), WORM, 30.0, f"worm{number}")


def shin(tracks: Sequence[KeypointTrack]) -> list[float]:
    return [bone_sizes([track])["left_ankle"] for track in tracks]


# --- bones that are shared ----------------------------------------------------------------------


def test_a_person_s_bones_are_the_same_on_any_skeleton_that_has_them() -> None:
    whole = body_sizes(PERSON)
    limbs = {f"{side}_{end}" for side in ("left", "right") for end in ("elbow", "knee", "ankle")}
    for name in ("coco17", "body25b", "alphapose16"):
        sizes = body_sizes(Skeleton.preset(name))
        assert limbs <= sizes.keys() <= set(Skeleton.preset(name).joint_names)
        # Roots differ, and with them how far from the camera a limb is.
        for limb in limbs:
            assert sizes[limb] == pytest.approx(whole[limb], rel=0.03), name


def test_what_is_shared_has_both_ends() -> None:
    coco = Skeleton.preset("coco17")
    shared = shared_skeleton(coco)
    assert shared is not None
    assert set(coco.joint_names) - set(shared.joint_names) == {
        f"{side}_{part}" for side in ("left", "right") for part in ("eye", "ear")
    }
    assert len(shared.bones) == 12  # of 16: not those of eyes and ears
    for joint, parent in shared.bones:
        names = shared.joint_names
        assert coco.parents[coco.index(names[joint])] == coco.index(names[parent])
    assert shared_skeleton(PERSON) is PERSON
    horse = Skeleton(["nose", "left_eye", "withers", "neck", "tail"], [-1, 0, 0, 0, 3])
    found = shared_skeleton(horse)
    assert found is not None
    assert found.joint_names == ("nose", "left_eye", "neck", "tail")
    assert found.parents == (-1, 0, 0, 2)
    assert set(body_sizes(horse)) == {"left_eye", "neck", "tail"}
    # A joint alone is no bone.
    assert shared_skeleton(Skeleton(["nose", "back"], [-1, 0])) is None
    assert shared_skeleton(WORM) is None
    assert body_sizes(WORM) == {}


@pytest.mark.parametrize("name", ["body25b", "gymnast-ball"])
def test_people_of_other_joints_come_in_metres(tmp_path: Path, name: str) -> None:
    skeleton = Skeleton.preset(name)
    files = [
        archive(walk_on(skeleton, number, pixels), tmp_path, f"film{number}")
        for number, pixels in enumerate((183.0, 40.0))
    ]
    found = read_tracks(files, skeleton, 20.0)
    true = [walk_on(skeleton, number, 1.0) for number in range(2)]
    assert np.array(shin(found.tracks)) == pytest.approx(np.array(shin(true)), rel=0.12)
    assert [report.step for report in found.reports].count("scale") == 1


def test_sizes_of_some_bones_are_enough(tmp_path: Path) -> None:
    file = archive(walk_on(Skeleton.preset("coco17"), 0, 90.0), tmp_path, "film")
    sizes = {"left_ankle": 0.5}
    (track,) = read_tracks([file], Skeleton.preset("coco17"), 20.0, sizes=sizes).tracks
    assert shin([track]) == pytest.approx([0.5])
    with pytest.raises(
        ValueError, match="sizes must contain the size of at least one bone, got none"
    ):
        read_tracks([file], Skeleton.preset("coco17"), 20.0, sizes={})


# --- a body of its own --------------------------------------------------------------------------


def test_an_animal_of_its_own_comes_in_body_lengths(tmp_path: Path) -> None:
    pixels = (20.0, 3.0, 300.0)
    files = [
        archive(worm(number, scale), tmp_path, f"worm{number}")
        for number, scale in enumerate(pixels)
    ]
    found = read_tracks(files, WORM, 30.0)
    assert np.median([body_extent(track) for track in found.tracks]) == pytest.approx(1)
    for number, track in enumerate(found.tracks):
        truth = worm(number, 1.0).keypoints
        truth = truth - truth[:, :1]
        inner = slice(8, -8)  # smoothing bends the ends
        factor = (track.keypoints * truth)[inner].sum() / (truth**2)[inner].sum()
        assert factor == pytest.approx(0.1, rel=0.1)  # ten long, but for its bends
        np.testing.assert_allclose(track.keypoints[inner], factor * truth[inner], atol=0.01)
    assert found.reports[-1].step == "scale"
    # No frame of reference but their own: the unit of the files is nothing.
    other = [
        archive(worm(number, 7 * scale), tmp_path, f"worm{number}")
        for number, scale in enumerate(pixels)
    ]
    for track, again in zip(found.tracks, read_tracks(other, WORM, 30.0).tracks, strict=True):
        np.testing.assert_allclose(again.keypoints, track.keypoints, atol=1e-9)


def test_own_sizes_are_the_median_track_s_proportions() -> None:
    straight = np.array([[0.0, 0], [3, 0], [8, 0], [10, 0]])
    tracks = [
        KeypointTrack(np.tile(scale * straight, (5, 1, 1)), np.ones((5, 4)), WORM, 30.0)
        for scale in (1.0, 1.0, 70.0)
    ]
    sizes = per_track_scales(tracks)
    assert sizes == pytest.approx({"back": 0.3, "rump": 0.5, "tail_tip": 0.2})
    # Of two bodies each counts alike, however large its pictures are. By hand: 0.3, 0.5, 0.2 and
    # 0.1, 0.8, 0.1 have the median 0.2, 0.65, 0.15, and scaled to it extents of 0.75 and 1.5.
    thick = np.array([[0.0, 0], [1, 0], [9, 0], [10, 0]])
    other = KeypointTrack(np.tile(20 * thick, (5, 1, 1)), np.ones((5, 4)), WORM, 30.0)
    pair = [tracks[0], other]
    wanted = {"back": 0.2 / 1.125, "rump": 0.65 / 1.125, "tail_tip": 0.15 / 1.125}
    assert per_track_scales(pair) == pytest.approx(wanted)
    both, _ = scale_to_bones(pair, per_track_scales(pair))
    assert np.median([body_extent(track) for track in both]) == pytest.approx(1)
    # One whose tail is lost in every frame is a worm all the same.
    confidence = np.ones((5, 4))
    confidence[:, 3] = 0
    docked = KeypointTrack(
        np.where(confidence[..., None] > 0, 4 * straight, np.nan), confidence, WORM, 30.0
    )
    assert body_extent(docked) == pytest.approx(32)
    sizes = per_track_scales([*tracks, docked])
    (scaled,), _ = scale_to_bones([docked], sizes)
    assert bone_sizes([scaled])["back"] == pytest.approx(sizes["back"], rel=0.05)


def test_a_ball_is_no_part_of_the_body() -> None:
    skeleton = Skeleton([*WORM.joint_names, "ball"], [*WORM.parents, -1])
    points = np.tile([[0.0, 0], [3, 0], [8, 0], [10, 0], [1000, 0]], (5, 1, 1))
    assert body_extent(KeypointTrack(points, np.ones((5, 5)), skeleton, 30.0)) == 10


def test_without_a_bone_there_is_no_length(tmp_path: Path) -> None:
    dots = Skeleton(["snout", "back"], [-1, -1])
    points = np.tile([[0.0, 0], [3, 4]], (60, 1, 1))
    file = archive(KeypointTrack(points, np.ones((60, 2)), dots, 30.0), tmp_path, "dots")
    with pytest.raises(
        ValueError, match=r"^tracks never shows a bone, expected some to scale by; or give sizes$"
    ):
        read_tracks([file], dots, 30.0)
