"""Tracks from files of keypoints: formats, names, crowds and scale."""

import json
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest

from probmotion import Cameras, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.synthetic.walks import shared_skeleton
from probmotion.data.tracks.learning import body_sizes, read_tracks
from probmotion.data.tracks.scales import body_extent, bone_sizes, per_track_scales, scale_to_bones
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")
COCO = Skeleton.preset("coco17")
WORM = Skeleton(["snout", "back", "rump", "tail_tip"], [-1, 0, 1, 2])
PIXELS = 183.0  # per metre


def detected_walk(number, seconds=4.0, skeleton=COCO, pixels=PIXELS):
    """Return detections of a walk at 30 fps, in pixels; joints absent from the walk are unseen."""
    body = make_gait("walk", number, frames=round(30 * seconds))
    camera = Cameras.around(np.array([1.2]), np.array([0.2]), distance=7.0, perspective=True)
    root = body.positions[:, :1]
    image = camera.project(body.positions - root) + camera.project(0.1 * (root - root.mean(axis=0)))
    image = pixels * image[0] + 500
    image = image + np.random.default_rng(number).normal(scale=1.0, size=image.shape)
    keypoints = np.full((body.frames, skeleton.n_joints, 2), np.nan)
    known = body.skeleton.canonical_names
    for joint, name in enumerate(skeleton.canonical_names):
        if name in known and name in PERSON.canonical_names:
            keypoints[:, joint] = image[:, known.index(name)]
    confidence = np.where(np.isfinite(keypoints[..., 0]), 0.9, 0.0)
    return KeypointTrack(keypoints, confidence, skeleton, 30.0, f"walk{number}")


@pytest.fixture(scope="module")
def person():
    return detected_walk(0)


def write_archive(track, folder, name="archive", views=None):
    """Write a track, or one copy per view, to ``<name>.npz`` and return its path."""
    keypoints, confidence = track.keypoints, track.confidence
    if views is not None:
        keypoints, confidence = np.stack([keypoints] * views), np.stack([confidence] * views)
    np.savez(
        folder / f"{name}.npz",
        keypoints=keypoints,
        confidence=confidence,
        fps=track.fps,
        joint_names=np.array(track.skeleton.joint_names),
        parents=np.array(track.skeleton.parents, dtype=np.int32),
    )
    return folder / f"{name}.npz"


def detections(track, video="", **more):
    """Return the frames of a track as entries of a COCO file."""
    values = np.concatenate([track.keypoints, track.confidence[..., None]], axis=-1)
    return [
        {"image_id": f"{video}{frame}.jpg", "keypoints": pose.ravel().tolist()} | more
        for frame, pose in enumerate(np.nan_to_num(values, nan=0.0))
    ]


def write_coco(track, folder, name="coco"):
    (folder / f"{name}.json").write_text(json.dumps(detections(track)))
    return folder / f"{name}.json"


# Formats, names and crowds.


@pytest.mark.parametrize("write", [write_coco, write_archive])
def test_formats_give_the_same_walk_in_metres(person, tmp_path, write):
    path = write(person, tmp_path)
    rate = None if path.suffix == ".npz" else 30.0
    (track,) = read_tracks([path], PERSON, 20.0, file_fps=rate).tracks
    assert track.name.startswith(f"{path.stem}/{path.stem}")
    assert clip_of(track.name) == path.stem
    assert (track.skeleton, track.fps, track.frames) == (PERSON, 20.0, 80)
    assert (track.confidence > 0).all()
    # Every second frame at 20 fps is every third frame of the file.
    truth = (person.keypoints / PIXELS)[::3]
    hips = [COCO.canonical_names.index(f"{side}_hip") for side in ("left", "right")]
    for joint, name in enumerate(PERSON.canonical_names):
        if name in ("pelvis", "neck"):
            continue
        expected = truth[:, COCO.canonical_names.index(name)] - truth[:, hips].mean(axis=1)
        scale = (track.keypoints[::2, joint] * expected).sum() / (expected**2).sum()
        assert scale == pytest.approx(1, abs=0.12)  # reference sizes are those of other people
        np.testing.assert_allclose(track.keypoints[::2, joint], scale * expected, atol=0.03)


def test_several_files_and_patterns(person, tmp_path):
    for name in ("b", "a"):
        write_archive(person, tmp_path, name)
    paths = [str(tmp_path / "*.npz"), write_coco(person, tmp_path, "c")]
    result = read_tracks(paths, PERSON, 20.0, file_fps=60.0).tracks
    # Archives contain their frame rate, 30 fps.
    described = [(clip_of(track.name), track.frames) for track in result]
    assert described == [("a", 80), ("b", 80), ("c", 40)]
    with pytest.raises(FileNotFoundError):
        read_tracks([str(tmp_path / "*.bvh")], PERSON, 20.0)
    with pytest.raises(ValueError, match="fps"):
        read_tracks(paths, PERSON, 20.0)
    (tmp_path / "other").mkdir()
    duplicate = write_archive(person, tmp_path / "other", "a")
    for paths in ([tmp_path / "a.npz", duplicate], [duplicate, duplicate]):
        with pytest.raises(ValueError, match=r"files must have unique names, got .*a\.npz and"):
            read_tracks(paths, PERSON, 20.0)


def test_only_people_in_one_video_may_be_dropped_as_a_crowd(person, tmp_path):
    tracks = read_tracks([write_archive(person, tmp_path, "rig", views=4)], PERSON, 20.0).tracks
    assert len({track.name for track in tracks}) == 4
    assert {clip_of(track.name) for track in tracks} == {"rig"}

    def read(*people):
        (tmp_path / "people.json").write_text(json.dumps([*chain(*people)]))
        return read_tracks([tmp_path / "people.json"], PERSON, 20.0, file_fps=30.0).tracks

    def pair(shift):
        other = replace(person, keypoints=np.add(person.keypoints, [shift, 0]))
        return detections(person, idx=0), detections(other, idx=1)

    assert [track.name[-9:] for track in read(*pair(800))] == ["/people 0", "/people 1"]
    with pytest.raises(ValueError, match="no track remains after step crowds"):
        read(*pair(5))
    result = read(detections(person, "a/")[:60], detections(person, "b/")[:90])
    assert [track.frames for track in result] == [40, 60]
    # The clip is named after the file even if image names contain a slash.
    assert {clip_of(track.name) for track in result} == {"people"}


# Scale of people.


def shin(track):
    return bone_sizes([track])["left_ankle"]


@pytest.mark.parametrize("name", ["coco17", "gymnast-ball"])
def test_people_on_other_skeletons_are_scaled_to_metres(tmp_path, name):
    skeleton = Skeleton.preset(name)
    walks = [detected_walk(k, skeleton=skeleton, pixels=p) for k, p in enumerate((183.0, 60.0))]
    for walk in walks:
        walk.keypoints[..., :] = np.nan_to_num(walk.keypoints, nan=520.0)
        walk.confidence[:] = 0.9
    files = [write_archive(walk, tmp_path, walk.name) for walk in walks]
    result = read_tracks(files, skeleton, 20.0)
    for track, walk, pixels in zip(result.tracks, walks, (183.0, 60.0), strict=True):
        assert shin(track) == pytest.approx(shin(walk) / pixels, rel=0.12)
    assert [report.step for report in result.reports].count("scale") == 1


def test_scale_depends_on_the_given_sizes_and_not_on_the_unit(person, tmp_path):
    file = write_archive(person, tmp_path)
    (expected,) = read_tracks([file], PERSON, 20.0).tracks
    other = write_archive(replace(person, keypoints=1e-3 * person.keypoints), tmp_path, "other")
    double = {name: 2 * size for name, size in body_sizes(PERSON).items()}
    for path, sizes, factor in ((other, None, 1), (file, double, 2)):
        (track,) = read_tracks([path], PERSON, 20.0, sizes=sizes).tracks
        np.testing.assert_allclose(track.keypoints, factor * expected.keypoints, atol=1e-9)
    (track,) = read_tracks([file], PERSON, 20.0, sizes={"left_ankle": 0.5}).tracks
    assert shin(track) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="sizes must contain the size of at least one bone"):
        read_tracks([file], PERSON, 20.0, sizes={})


def test_body_sizes_are_close_to_bone_lengths_on_any_skeleton():
    sizes = body_sizes(PERSON)
    assert set(sizes) == set(PERSON.joint_names) - {"pelvis"}
    body = make_gait("walk").retarget(PERSON).positions[0]
    for joint, parent in PERSON.bones:
        length = np.linalg.norm(body[joint] - body[parent])
        assert 0.8 * length < sizes[PERSON.joint_names[joint]] < 1.1 * length
    other = body_sizes(COCO)
    for limb in ("left_elbow", "right_elbow", "left_ankle", "right_ankle"):
        assert other[limb] == pytest.approx(sizes[limb], rel=0.03)
    assert body_sizes(WORM) == {}


def test_shared_skeleton_has_both_ends_of_its_bones():
    shared = shared_skeleton(COCO)
    dropped = {f"{side}_{part}" for side in ("left", "right") for part in ("eye", "ear")}
    assert set(COCO.joint_names) - set(shared.joint_names) == dropped
    assert len(shared.bones) == 12
    assert shared_skeleton(PERSON) is PERSON
    horse = Skeleton(["nose", "left_eye", "withers", "neck", "tail"], [-1, 0, 0, 0, 3])
    result = shared_skeleton(horse)
    assert result.joint_names == ("nose", "left_eye", "neck", "tail")
    assert result.parents == (-1, 0, 0, 2)
    for boneless in (Skeleton(["nose", "back"], [-1, 0]), WORM):
        assert shared_skeleton(boneless) is None


# Scale of unknown bodies.


def worm(number, pixels):
    """Return a winding animal with proportions 3 : 5 : 2."""
    angles = 0.4 * np.sin(np.arange(60)[:, None] / 10 + np.arange(3) + number)
    steps = np.array([[3.0], [5.0], [2.0]]) * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = np.concatenate([np.zeros((60, 1, 2)), np.cumsum(steps, axis=1)], axis=1)
    return KeypointTrack(pixels * points + 300, np.full((60, 4), 0.9), WORM, 30.0, f"worm{number}")


def test_unknown_bodies_are_scaled_to_body_lengths(tmp_path):
    def read(unit):
        worms = [worm(number, unit * scale) for number, scale in enumerate((20.0, 3.0, 300.0))]
        return read_tracks([write_archive(w, tmp_path, w.name) for w in worms], WORM, 30.0)

    result = read(1.0)
    assert np.median([body_extent(track) for track in result.tracks]) == pytest.approx(1)
    for number, track in enumerate(result.tracks):
        truth = worm(number, 1.0).keypoints
        truth = truth - truth[:, :1]
        inner = slice(8, -8)  # smoothing bends the ends
        factor = (track.keypoints * truth)[inner].sum() / (truth**2)[inner].sum()
        assert factor == pytest.approx(0.1, rel=0.1)  # the animal is ten units long
        np.testing.assert_allclose(track.keypoints[inner], factor * truth[inner], atol=0.01)
    assert result.reports[-1].step == "scale"
    for track, again in zip(result.tracks, read(7.0).tracks, strict=True):
        np.testing.assert_allclose(again.keypoints, track.keypoints, atol=1e-9)


def straight(scale, x=(0, 3, 8, 10), skeleton=WORM):
    points = np.stack([scale * np.array(x), np.zeros(len(x))], axis=-1)
    return KeypointTrack(np.tile(points, (5, 1, 1)), np.ones((5, len(x))), skeleton, 30.0)


def test_per_track_scales_are_median_proportions():
    tracks = [straight(scale) for scale in (1.0, 1.0, 70.0)]
    assert per_track_scales(tracks) == pytest.approx({"back": 0.3, "rump": 0.5, "tail_tip": 0.2})
    # The proportions 0.3, 0.5, 0.2 and 0.1, 0.8, 0.1 have the medians 0.2, 0.65, 0.15; scaled to
    # these, the extents are 0.75 and 1.5.
    pair = [tracks[0], straight(20.0, (0, 1, 9, 10))]
    expected = {"back": 0.2 / 1.125, "rump": 0.65 / 1.125, "tail_tip": 0.15 / 1.125}
    assert per_track_scales(pair) == pytest.approx(expected)
    # A body without a visible tail is scaled by its other bones.
    tailless = straight(4.0)
    tailless.confidence[:, 3], tailless.keypoints[:, 3] = 0, np.nan
    assert body_extent(tailless) == pytest.approx(32)
    sizes = per_track_scales([*tracks, tailless])
    (scaled,), _ = scale_to_bones([tailless], sizes)
    assert bone_sizes([scaled])["back"] == pytest.approx(sizes["back"], rel=0.05)


def test_body_extent_ignores_joints_without_bones():
    with_ball = Skeleton([*WORM.joint_names, "ball"], [*WORM.parents, -1])
    assert body_extent(straight(1.0, (0, 3, 8, 10, 1000), with_ball)) == 10
    with pytest.raises(ValueError, match="tracks must show at least one bone"):
        per_track_scales([straight(0.0, (1, 1), Skeleton(["snout", "back"], [-1, -1]))])
