"""Data sets to learn from: clips are filmed, files are read, and no clip is on two sides."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Cameras, Motion, Skeleton
from probmotion.data.projections import DetectorNoise, Filming, project_clips
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.tracks.learning import (
    body_sizes,
    certain,
    film_clips,
    film_windows,
    read_tracks,
    split_tracks,
    synthetic_walks,
)
from probmotion.io.keypoint_layouts import keypoint_skeleton
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")
COCO = Skeleton.preset("coco17")
PIXELS = 183.0  # per metre


@pytest.fixture(scope="module")
def clips() -> list[Motion]:
    """People who walk for two seconds, far from the origin and from each other."""
    return [
        replace(
            clip,
            positions=clip.positions + np.array([4.0 * number, 1.0, -3.0]),
            rotations=None,
            rest_offsets=None,
        )
        for number, clip in enumerate(synthetic_walks(4, seconds=2.0))
    ]


def by_name(tracks: Sequence[KeypointTrack]) -> dict[str, KeypointTrack]:
    return {track.name: track for track in tracks}


# --- clips that are filmed ----------------------------------------------------------------------


def test_filmed_clips_are_a_data_set(clips: list[Motion]) -> None:
    filmed = film_clips(clips, PERSON, 20.0, views=5, seed=1)
    assert [track.name for track in filmed.tracks] == [
        f"{clip.name}/{view}" for clip in clips for view in range(5)
    ]
    for track in filmed.tracks:
        assert (track.skeleton, track.fps, track.frames) == (PERSON, 20.0, 40)
        np.testing.assert_array_equal(track.keypoints[track.confidence[:, 0] > 0, 0], 0.0)
        # Nothing is known of a frame whose root was not found.
        assert not track.confidence[track.confidence[:, 0] == 0].any()
    changed = {report.step: report.entries_changed for report in filmed.reports[:-1]}
    for step in ("uncertain", "gaps", "smooth"):
        assert changed[step] > 0
    assert "scale" not in changed  # pictures are in metres as they are


def test_cameras_about_one_clip_are_no_crowd(clips: list[Motion]) -> None:
    # They lie over each other; and what stands before a space would elsewhere name the video.
    clip = replace(clips[0], name="my walk")
    filmed = film_clips([clip], PERSON, 20.0, views=12)
    assert len(filmed.tracks) == 12
    assert all(report.tracks_dropped == 0 for report in filmed.reports)


def test_without_errors_filmed_clips_are_smoothed_projections(clips: list[Motion]) -> None:
    exact = DetectorNoise.none()
    filmed = by_name(film_clips(clips, PERSON, 30.0, views=3, seed=2, noise=exact).tracks)
    moved = [clip.retarget(PERSON) for clip in clips]
    for track in project_clips(moved, views=3, seed=2, noise=exact):
        off = filmed[track.name].keypoints - track.keypoints
        # A parabola over a quarter of a second is within millimetres of a walking foot.
        assert np.linalg.norm(off, axis=-1).max() < 0.03
        assert np.linalg.norm(off, axis=-1).mean() < 0.003


def test_the_path_stays_where_sequences_are_centred(clips: list[Motion]) -> None:
    filming = Filming(centre="sequence", perspective=False)
    still = film_clips(clips[:1], PERSON, 20.0, views=4, filming=filming)
    for track in still.tracks:
        np.testing.assert_allclose(np.nanmean(track.keypoints[:, 0], axis=0), 0.0, atol=1e-9)
    assert max(np.nanmax(np.ptp(track.keypoints[:, 0], axis=0)) for track in still.tracks) > 0.5


def test_of_certain_tracks_joints_count_whole_or_not_at_all(clips: list[Motion]) -> None:
    tracks = film_clips(clips, clips[0].skeleton, 10.0, views=2).tracks
    edge = np.where(tracks[0].confidence > 0, 0.3, 0.0)
    edge[0] = np.minimum(edge[0], 0.29)
    low = replace(tracks[0], confidence=edge)
    counted = certain([*tracks, low])
    for before, after in zip([*tracks, low], counted, strict=True):
        np.testing.assert_array_equal(after.confidence, before.confidence >= 0.3)
        np.testing.assert_array_equal(after.keypoints, before.keypoints)
    assert counted[-1].confidence[1:].sum() == (edge[1:] > 0).sum()
    assert not counted[-1].confidence[0].any()


def test_a_clip_is_filmed_alike_in_any_company(clips: list[Motion]) -> None:
    together = by_name(film_clips(clips, PERSON, 20.0, views=2, seed=5).tracks)
    for some in (clips[::-1], clips[2:3]):
        for name, track in by_name(film_clips(some, PERSON, 20.0, views=2, seed=5).tracks).items():
            np.testing.assert_array_equal(track.keypoints, together[name].keypoints)
            np.testing.assert_array_equal(track.confidence, together[name].confidence)
    other = film_clips(clips, PERSON, 20.0, views=2, seed=6).tracks
    for track in other:
        seen = (track.confidence > 0) & (together[track.name].confidence > 0)
        seen[:, 0] = False  # the root is at the origin in both
        assert (track.keypoints[seen] != together[track.name].keypoints[seen]).all()


# --- windows of what was filmed -----------------------------------------------------------------


def test_windows_are_whole_pieces_of_filmed_clips(clips: list[Motion]) -> None:
    windows = film_windows(clips, PERSON, 20.0, 15, 200, seed=3)
    assert windows.shape == (200, 15, 14, 2)
    assert np.isfinite(windows).all()
    np.testing.assert_array_equal(windows[:, :, 0], 0.0)
    noise = DetectorNoise(share=0.0)
    filmed = film_clips(clips, PERSON, 20.0, views=64, seed=3, noise=noise).tracks
    # Windows that may be one have the same numbers in their first pose: a key into all poses.
    starts: dict[bytes, list[tuple[int, int]]] = {}
    for number, track in enumerate(filmed):
        for frame in range(track.frames - 14):
            starts.setdefault(track.keypoints[frame].tobytes(), []).append((number, frame))
    used, mirrored = set(), 0
    for window in windows:
        if window[0].tobytes() not in starts:
            mirrored += 1
            window = window[:, list(PERSON.mirrored_order)] * np.array([-1.0, 1.0]) + 0.0
        ((number, frame),) = starts[window[0].tobytes()]
        used.add((number, frame))
        np.testing.assert_array_equal(window, filmed[number].keypoints[frame : frame + 15])
    assert len(used) == 200  # none twice while there are others
    assert 100 - 4 * math.sqrt(50) < mirrored < 100 + 4 * math.sqrt(50)
    assert {clip_of(filmed[number].name) for number, _ in used} == {clip.name for clip in clips}
    frames = np.array([frame for _, frame in used])
    # Frames of windows are uniform over 0 … 25.
    assert frames.mean() == pytest.approx(12.5, abs=5 * math.sqrt((26**2 - 1) / 12 / 200))


def test_windows_depend_on_the_seed_and_repeat_only_where_there_are_too_few(
    clips: list[Motion],
) -> None:
    some = film_windows(clips[:1], PERSON, 20.0, 40, 10, seed=0)
    np.testing.assert_array_equal(film_windows(clips[:1], PERSON, 20.0, 40, 10, seed=0), some)
    assert (film_windows(clips[:1], PERSON, 20.0, 40, 10, seed=1) != some).any()
    assert len({window.tobytes() for window in some}) == 10
    many = film_windows(clips[:1], PERSON, 20.0, 40, 100, seed=0)  # of 64 at most
    assert 30 < len({window.tobytes() for window in many}) <= 64


def test_windows_have_no_holes(clips: list[Motion]) -> None:
    # A wrist that leaps in the first frame is hidden there, and nothing is extrapolated.
    positions = clips[0].positions.copy()
    positions[0, clips[0].skeleton.index("left_wrist")] += 1.0
    leaps = [replace(clips[0], positions=positions)]
    assert np.isfinite(film_windows(leaps, PERSON, 30.0, 59, 64, seed=0)).all()
    with pytest.raises(ValueError, match=r"expected frames=60 without a hole in one"):
        film_windows(leaps, PERSON, 30.0, 60, 1, seed=0)


def test_no_clip_as_long_as_a_window_is_one_sentence(clips: list[Motion]) -> None:
    sentence = (
        r"^motions has clips of at most 40 frames at 20 frames per second, expected frames=41 "
        r"without a hole in one$"
    )
    with pytest.raises(ValueError, match=sentence):
        film_windows(clips, PERSON, 20.0, 41, 5, seed=0)


# --- tracks from files --------------------------------------------------------------------------


def filmed_person(number: int, seconds: float = 4.0) -> KeypointTrack:
    """A walk as a detector of COCO's keypoints gives it at 30 frames per second, pixels."""
    motion = make_gait("walk", number, frames=round(30 * seconds))
    flat = motion.retarget(PERSON)
    camera = Cameras.around(np.array([1.2]), np.array([0.2]), distance=7.0, perspective=True)
    root = flat.positions[:, :1]
    body = camera.project(flat.positions - root)[0]
    way = camera.project(0.1 * (root - root.mean(axis=0)))[0]
    rng = np.random.default_rng(number)
    points = PIXELS * (body + way) + 500 + rng.normal(scale=1.0, size=body.shape)
    # No pelvis and no neck: these come back from hips and shoulders; eyes and ears nobody wants.
    keypoints = np.full((motion.frames, 17, 2), np.nan)
    for joint, name in enumerate(COCO.canonical_names):
        if name in PERSON.canonical_names:
            keypoints[:, joint] = points[:, PERSON.canonical_names.index(name)]
    confidence = np.where(np.isfinite(keypoints[..., 0]), 0.9, 0.0)
    return KeypointTrack(keypoints, confidence, COCO, 30.0, f"walk{number}")


@pytest.fixture(scope="module")
def person() -> KeypointTrack:
    return filmed_person(0)


@pytest.fixture(scope="module")
def sizes() -> dict[str, float]:
    """What read_tracks takes by default."""
    return body_sizes(PERSON)


def flat(values: np.ndarray) -> list[float]:
    """x, y, confidence of each keypoint; zeros where it was not seen."""
    return np.nan_to_num(values, nan=0.0).ravel().tolist()


def values_of(track: KeypointTrack) -> np.ndarray:
    return np.concatenate([track.keypoints, track.confidence[..., None]], axis=-1)


def as_coco(track: KeypointTrack, folder: Path) -> Path:
    content = [
        {"image_id": f"{frame}.jpg", "keypoints": flat(values), "score": 2.0}
        for frame, values in enumerate(values_of(track))
    ]
    (folder / "coco.json").write_text(json.dumps(content))
    return folder / "coco.json"


def as_alphapose(track: KeypointTrack, folder: Path) -> Path:
    content = {
        f"{frame}.jpg": {"people": [{"pose_keypoints_2d": flat(values), "idx": 1}]}
        for frame, values in enumerate(values_of(track))
    }
    (folder / "alphapose.json").write_text(json.dumps(content))
    return folder / "alphapose.json"


def as_openpose(track: KeypointTrack, folder: Path) -> Path:
    """A folder with a file for each frame, of OpenPose's 18 keypoints."""
    layout = keypoint_skeleton("openpose18")
    values = np.zeros((track.frames, 18, 3))
    for joint, name in enumerate(layout.canonical_names):
        sources = ("left_shoulder", "right_shoulder") if name == "neck" else (name,)
        columns = [COCO.canonical_names.index(source) for source in sources]
        values[:, joint] = values_of(track)[:, columns].mean(axis=1)
    (folder / "openpose").mkdir()
    for frame, pose in enumerate(values):
        content = {"people": [{"pose_keypoints_2d": flat(pose)}]}
        (folder / "openpose" / f"{frame:06}_keypoints.json").write_text(json.dumps(content))
    return folder / "openpose"


def as_table(track: KeypointTrack, folder: Path) -> Path:
    """A table of DeepLabCut."""
    names = [name for name in COCO.joint_names for _ in range(3)]
    rows = [
        ["scorer", *["net"] * len(names)],
        ["bodyparts", *names],
        ["coords", *["x", "y", "likelihood"] * 17],
        *([str(frame), *map(str, flat(values))] for frame, values in enumerate(values_of(track))),
    ]
    (folder / "table.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    return folder / "table.csv"


def as_archive(track: KeypointTrack, folder: Path, name: str = "archive") -> Path:
    path = folder / f"{name}.npz"
    np.savez(
        path,
        keypoints=track.keypoints,
        confidence=track.confidence,
        fps=track.fps,
        joint_names=np.array(track.skeleton.joint_names),
        parents=np.array(track.skeleton.parents, dtype=np.int32),
    )
    return path


@pytest.mark.parametrize("written", [as_coco, as_alphapose, as_openpose, as_table, as_archive])
def test_every_format_gives_the_same_walk_in_metres(
    person: KeypointTrack, tmp_path: Path, written, sizes: dict[str, float]
) -> None:
    path = written(person, tmp_path)
    rate = None if path.suffix == ".npz" else 30.0
    (track,) = read_tracks([path], PERSON, 20.0, file_fps=rate, sizes=sizes).tracks
    assert track.name.startswith(f"{path.stem}/{path.stem}")
    assert clip_of(track.name) == path.stem
    assert (track.skeleton, track.fps, track.frames) == (PERSON, 20.0, 80)
    assert (track.confidence > 0).all()
    # Every second frame of 20 a second is every third of the file's.
    truth = (person.keypoints / PIXELS)[::3]
    for joint, name in enumerate(PERSON.canonical_names):
        if name in ("pelvis", "neck"):
            continue
        there = [truth[:, COCO.canonical_names.index(n)] for n in (name, "left_hip", "right_hip")]
        wanted = there[0] - (there[1] + there[2]) / 2
        # The reference's size is that of other people: within a twentieth of this one's.
        scale = (track.keypoints[::2, joint] * wanted).sum() / (wanted**2).sum()
        assert scale == pytest.approx(1, abs=0.12)
        np.testing.assert_allclose(track.keypoints[::2, joint], scale * wanted, atol=0.03)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 40.0])
def test_size_does_not_depend_on_the_unit_of_the_file(
    person: KeypointTrack, tmp_path: Path, scale: float, sizes: dict[str, float]
) -> None:
    other = replace(person, keypoints=scale * person.keypoints)
    (track,) = read_tracks([as_archive(other, tmp_path)], PERSON, 20.0, sizes=sizes).tracks
    (wanted,) = read_tracks([as_archive(person, tmp_path)], PERSON, 20.0, sizes=sizes).tracks
    np.testing.assert_allclose(track.keypoints, wanted.keypoints, atol=1e-9)


def test_made_people_come_back_in_their_size(tmp_path: Path, sizes: dict[str, float]) -> None:
    true = [filmed_person(number) for number in range(6)]
    files = [as_archive(walk, tmp_path, walk.name) for walk in true]
    found = by_name(read_tracks(files, PERSON, 30.0, sizes=sizes).tracks)
    ratios = []
    for walk in true:
        got = found[f"{walk.name}/{walk.name}"].keypoints
        left, right = (
            walk.keypoints[:, COCO.canonical_names.index(name)] / PIXELS
            for name in ("left_ankle", "left_knee")
        )
        index = PERSON.canonical_names.index
        shin = np.linalg.norm(got[:, index("left_ankle")] - got[:, index("left_knee")], axis=-1)
        ratios.append(np.median(shin) / np.median(np.linalg.norm(left - right, axis=-1)))
    assert np.mean(ratios) == pytest.approx(1, abs=0.05)
    assert np.max(np.abs(np.array(ratios) - 1)) < 0.12


def test_sizes_of_people_are_those_of_bones(sizes: dict[str, float]) -> None:
    assert set(sizes) == set(PERSON.joint_names) - {"pelvis"}
    (walker,) = synthetic_walks(1)
    body = walker.retarget(PERSON)
    for joint, parent in PERSON.bones:
        length = np.linalg.norm(body.positions[0, joint] - body.positions[0, parent])
        # Bones lie across the view most of the time, and cameras stand near.
        assert 0.8 * length < sizes[PERSON.joint_names[joint]] < 1.1 * length


def test_own_sizes_scale_tracks(
    person: KeypointTrack, tmp_path: Path, sizes: dict[str, float]
) -> None:
    file = as_archive(person, tmp_path)
    double = {name: 2 * size for name, size in sizes.items()}
    (track,) = read_tracks([file], PERSON, 20.0, sizes=double).tracks
    (wanted,) = read_tracks([file], PERSON, 20.0).tracks  # by default, those of people
    np.testing.assert_allclose(track.keypoints, 2 * wanted.keypoints, atol=1e-9)


def test_several_files_and_patterns(
    person: KeypointTrack, tmp_path: Path, sizes: dict[str, float]
) -> None:
    for name in ("c", "a", "b"):
        as_archive(person, tmp_path, name)
    as_table(person, tmp_path)
    alone = read_tracks([tmp_path / "a.npz"], PERSON, 20.0, sizes=sizes).tracks
    paths = [str(tmp_path / "*.npz"), tmp_path / "table.csv"]
    found = read_tracks(paths, PERSON, 20.0, file_fps=30.0, sizes=sizes).tracks
    assert [track.name for track in found] == ["a/a", "b/b", "c/c", "table/table"]
    for track in found[:3]:
        np.testing.assert_array_equal(track.keypoints, alone[0].keypoints)
    with pytest.raises(FileNotFoundError, match=r"matches no file"):
        read_tracks([str(tmp_path / "*.bvh")], PERSON, 20.0, sizes=sizes)
    with pytest.raises(ValueError, match=r"fps must be frames per second, got missing"):
        read_tracks(paths, PERSON, 20.0, sizes=sizes)


def test_a_file_that_holds_its_frame_rate_keeps_it(
    person: KeypointTrack, tmp_path: Path, sizes: dict[str, float]
) -> None:
    file = as_archive(person, tmp_path)
    (wanted,) = read_tracks([file], PERSON, 20.0, sizes=sizes).tracks
    (track,) = read_tracks([file], PERSON, 20.0, file_fps=60.0, sizes=sizes).tracks
    assert track.frames == wanted.frames == 80


def test_cameras_in_one_archive_are_no_crowd(
    person: KeypointTrack, tmp_path: Path, sizes: dict[str, float]
) -> None:
    path = tmp_path / "rig.npz"
    np.savez(
        path,
        keypoints=np.stack([person.keypoints] * 4),
        confidence=np.stack([person.confidence] * 4),
        fps=30.0,
        joint_names=np.array(COCO.joint_names),
        parents=np.array(COCO.parents, dtype=np.int32),
    )
    tracks = read_tracks([path], PERSON, 20.0, sizes=sizes).tracks
    assert len({track.name for track in tracks}) == 4
    assert {clip_of(track.name) for track in tracks} == {"rig"}


def test_people_of_one_video_are_a_crowd_and_videos_are_apart(
    person: KeypointTrack, tmp_path: Path, sizes: dict[str, float]
) -> None:
    values = values_of(person)

    def people(shift: float) -> Path:
        path = tmp_path / f"people{shift:g}.json"
        beside = values + np.array([shift, 0, 0])
        content = [
            {"image_id": f"{frame}.jpg", "keypoints": flat(pose), "idx": who}
            for who, everyone in enumerate((values, beside))
            for frame, pose in enumerate(everyone)
        ]
        path.write_text(json.dumps(content))
        return path

    apart = read_tracks([people(800)], PERSON, 20.0, file_fps=30.0, sizes=sizes)
    assert [track.name[-12:] for track in apart.tracks] == ["/people800 0", "/people800 1"]
    with pytest.raises(ValueError, match=r"none left, .* after crowds"):
        read_tracks([people(5)], PERSON, 20.0, file_fps=30.0, sizes=sizes)
    content = [
        {"image_id": f"{video}/{frame}.jpg", "keypoints": flat(values[frame])}
        for video, frames in (("a", 60), ("b", 90))
        for frame in range(frames)
    ]
    (tmp_path / "videos.json").write_text(json.dumps(content))
    found = read_tracks([tmp_path / "videos.json"], PERSON, 20.0, file_fps=30.0, sizes=sizes).tracks
    assert [track.frames for track in found] == [40, 60]
    # Names of images have a slash, the clip is the file all the same.
    assert {clip_of(track.name) for track in found} == {"videos"}


def test_two_files_of_one_name_are_refused(
    person: KeypointTrack, tmp_path: Path, sizes: dict[str, float]
) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    files = [as_archive(person, tmp_path / folder, "cam") for folder in "ab"]
    for paths in (files, [files[0], files[0]]):
        with pytest.raises(
            ValueError, match=r"^paths has .*cam\.npz and .*cam\.npz, expected files of other names"
        ):
            read_tracks(paths, PERSON, 20.0, sizes=sizes)


# --- the split ----------------------------------------------------------------------------------


def tracks_of(names: Sequence[str]) -> list[KeypointTrack]:
    sure = np.ones((2, 14))
    return [KeypointTrack(np.zeros((2, 14, 2)), sure, PERSON, 20.0, name) for name in names]


MANY = tracks_of([f"clip{number}/{view}" for view in "xyz" for number in range(20)])


def test_no_clip_is_in_two_parts() -> None:
    for seed in range(5):
        found = split_tracks(MANY, seed=seed)
        parts = (found.train, found.validation, found.test)
        assert [len(part) for part in parts] == [48, 6, 6]
        clips = [{clip_of(track.name) for track in part} for part in parts]
        assert [len(names) for names in clips] == [16, 2, 2]
        assert len(set.union(*clips)) == 20
        for names, split in zip(
            clips, (found.split.train, found.split.validation, found.split.test), strict=True
        ):
            assert tuple(sorted(names)) == split
    assert split_tracks(MANY[::-1], seed=3).split == split_tracks(MANY, seed=3).split
    assert len({split_tracks(MANY, seed=seed).split.test for seed in range(10)}) > 1


def test_clips_that_are_named_are_kept_out() -> None:
    found = split_tracks(MANY, validation=["clip3"], test=["clip12", "clip1"], seed=9)
    assert [track.name for track in found.validation] == ["clip3/x", "clip3/y", "clip3/z"]
    # By their whole name: clip1 is not clip12 nor clip10.
    assert {clip_of(track.name) for track in found.test} == {"clip1", "clip12"}
    assert (found.split.validation, found.split.test) == (("clip3",), ("clip1", "clip12"))
    assert len(found.train) == 51
    assert not set(found.train) & {*found.validation, *found.test}


def test_pieces_of_a_clip_stay_together() -> None:
    pieces = tracks_of(["a/0 0", "a/0 1", "b/0", "c/0", "c/0 mirrored"])
    found = split_tracks(pieces, validation=["a"], test=["b"])
    assert [track.name for track in found.validation] == ["a/0 0", "a/0 1"]
    assert [track.name for track in found.train] == ["c/0", "c/0 mirrored"]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"validation": ["clip3"]}, "validation is given without test, expected clips for both"),
        ({"test": ["clip3"]}, "test is given without validation, expected clips for both"),
        (
            {"validation": ["clip3", "clip4"], "test": ["clip4"]},
            "test has 'clip4', which validation has too, expected other clips",
        ),
        ({"validation": ["clip3"], "test": ["walk"]}, "clips has 'walk', which names no clip"),
        ({"validation": ["clip3/x"], "test": ["clip4"]}, "clips has 'clip3/x', which names no"),
        (
            {
                "validation": [f"clip{n}" for n in range(10)],
                "test": [f"clip{n}" for n in range(10, 20)],
            },
            "validation and test have every clip, expected some to learn from",
        ),
    ],
)
def test_wrong_parts_are_one_sentence(options: dict[str, list[str]], sentence: str) -> None:
    with pytest.raises(ValueError, match=f"^{sentence}"):
        split_tracks(MANY, **options)
