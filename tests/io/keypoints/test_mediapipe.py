"""MediaPipe landmarks in JSON and CSV: layouts, image size, frame rate and defects."""

import json

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.files import open_keypoints, read_keypoints
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

NAMES = PRESETS["mediapipe33"].joint_names
RNG = np.random.default_rng(6)
POINTS = RNG.uniform(-0.2, 1.2, size=(3, 33, 2)).round(4)  # may be outside the image
VISIBLE = RNG.uniform(0.1, 1, size=(3, 33)).round(3)
SIZE = (640, 480)


def landmarks(frame):
    return [
        {"x": x, "y": y, "z": 0.1, "visibility": v}
        for (x, y), v in zip(POINTS[frame].tolist(), VISIBLE[frame].tolist(), strict=True)
    ]


def rows(frame):
    return np.c_[POINTS[frame], np.zeros(33), VISIBLE[frame]].tolist()


def written(folder, content, name="clip.json"):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def wide(header, *first):
    columns = [header(k, axis) for k in range(33) for axis in ("x", "y", "z", "visibility")]
    lines = [",".join([*first, *columns])]
    for frame in range(3):
        cells = [str(frame)] * len(first)
        lines.append(",".join([*cells, *(f"{v:g}" for row in rows(frame) for v in row)]))
    return "\n".join(lines) + "\n"


def long(keys):
    lines = ["timestamp,landmark_id,x,y,z,visibility"]
    for frame in range(3):
        for k, (x, y, z, v) in enumerate(rows(frame)):
            lines.append(f"{frame * 40},{keys[k]},{x:g},{y:g},{z:g},{v:g}")
    return "\n".join(lines) + "\n"


def scored(frame):
    """Return landmarks with other names of the visibility."""
    key = ("score", "vis", "confidence")[frame]
    return [{key: p["visibility"], "x": p["x"], "y": p["y"]} for p in landmarks(frame)]


FRAMES = [{"pose_landmarks": landmarks(k)} for k in range(3)]
JSONS = {
    "frames": FRAMES,
    "people": [{"pose_landmarks": [landmarks(k)]} for k in range(3)],
    "wrapped": {"metadata": {"name": "a"}, "frames": FRAMES},
    "arrays": {"landmarks": [{"frame": k, "poseLandmarks": rows(k)} for k in range(3)]},
    "bare": [landmarks(k) for k in range(3)],
    "poses of all frames": {"frameRate": 25, "poses": [landmarks(k) for k in range(3)]},
    "keypoints": [{"frame_id": k, "keypoints": scored(k)} for k in range(3)],
    "protocol buffers": [{"pose_landmarks": {"landmark": landmarks(k)}} for k in range(3)],
    "names": [
        {"landmarks": {n.upper(): p for n, p in zip(NAMES, landmarks(k), strict=True)}}
        for k in range(3)
    ],
}
TABLES = {
    "names": wide(lambda k, axis: f"{NAMES[k].upper()}_{axis}", "frame"),
    "from 1": wide(lambda k, axis: f"{axis[0]}{k + 1}", "class"),
    "from 0": wide(lambda k, axis: f"landmark_{k}_{axis}"),
    "short names": wide(lambda k, axis: f"lm_{k}_{axis[:3]}", "label"),
    "long": long(range(33)),
    "long, scores": long(range(33)).replace("visibility", "score"),
    "long names": long(NAMES),
}


@pytest.mark.parametrize(
    ("content", "name"),
    [(content, "clip.json") for content in JSONS.values()]
    + [(content, "clip.csv") for content in TABLES.values()],
    ids=[*JSONS, *(f"table, {name}" for name in TABLES)],
)
def test_layouts_are_recognised(tmp_path, content, name):
    path = written(tmp_path, content, name)
    file = open_keypoints(path, image_size=SIZE)
    assert file.format == "MediaPipe Pose"
    (track,) = file.tracks
    assert track.skeleton == Skeleton.preset("mediapipe33")
    np.testing.assert_allclose(track.keypoints, POINTS * SIZE, rtol=1e-12)
    np.testing.assert_array_equal(track.confidence, VISIBLE)
    with pytest.raises(MotionFileError, match=r"image_size must be given .* \(--image-size WIDTH"):
        open_keypoints(path)


def test_size_and_frame_rate_of_the_file(tmp_path):
    content = {"fps": 50, "width": 640, "height": 480, "frames": FRAMES}
    file = open_keypoints(written(tmp_path, content))
    assert file.fps == 50
    np.testing.assert_allclose(file.tracks[0].keypoints, POINTS * SIZE)
    assert read_keypoints(written(tmp_path, content), fps=24)[0].fps == 24
    with pytest.raises(MotionFileError, match="width must be a number above 0, got -1"):
        read_keypoints(written(tmp_path, content | {"width": -1}))


@pytest.mark.parametrize(
    ("key", "times", "fps", "numbers"),
    [
        ("timestamp_ms", [0, 40, 80, 120], 25, [0, 1, 2, 3]),
        ("timestamp_ms", [1000, 1040, 1080, 1160], 25, [0, 1, 2, 4]),  # without a person in one
        ("timestamp", [0, 0.02, 0.04, 0.06], 50, [0, 1, 2, 3]),
        ("timestamp", [0, 20, 40, 60], 50, [0, 1, 2, 3]),  # milliseconds
        ("timestamp", ["12:00:01", "12:00:02", "12:00:03", "12:00:04"], None, [0, 1, 2, 3]),
        ("time", [0, 0, 0, 0], None, [0, 1, 2, 3]),
    ],
)
def test_timestamps_define_rate_and_numbers(tmp_path, key, times, fps, numbers):
    content = [frame | {key: time} for frame, time in zip([*FRAMES, FRAMES[0]], times, strict=True)]
    file = open_keypoints(written(tmp_path, content), image_size=SIZE)
    assert file.fps == fps
    (track,) = file.tracks
    assert track.frames == numbers[-1] + 1
    np.testing.assert_allclose(track.keypoints[numbers], POINTS[[0, 1, 2, 0]] * SIZE)
    numbered = [frame | {"frame": 2 * k} for k, frame in enumerate(content)]
    again = open_keypoints(written(tmp_path, numbered), image_size=SIZE)
    assert again.tracks[0].frames == 7
    if fps is not None:
        assert again.fps == pytest.approx(fps * 6 / numbers[-1])


@pytest.mark.parametrize("rate", [25, 29.97, 60, 120])
def test_frame_rate_follows_from_whole_milliseconds(tmp_path, rate):
    numbers = np.setdiff1d(np.arange(400), [7, 8, 200])  # frames without a person
    content = [FRAMES[0] | {"timestamp_ms": int(1000 * k / rate)} for k in numbers]
    file = open_keypoints(written(tmp_path, content), image_size=SIZE)
    (track,) = file.tracks
    assert file.fps == pytest.approx(rate, rel=1e-3)
    np.testing.assert_array_equal(np.flatnonzero(track.confidence[:, 0]), numbers)


def test_missing_people_and_several_people(tmp_path):
    content = [FRAMES[0], {"pose_landmarks": None}, FRAMES[2]]
    (track,) = read_keypoints(written(tmp_path, content), 30, image_size=SIZE)
    assert np.isnan(track.keypoints[1]).all()
    two = [{"pose_landmarks": [landmarks(0), landmarks(1)]} for _ in range(2)]
    path = written(tmp_path, two)
    with pytest.raises(MotionFileError, match="two people without track ids"):
        read_keypoints(path, 30, image_size=SIZE)
    assert len(read_keypoints(path, 30, people=2, image_size=SIZE)) == 2


@pytest.mark.parametrize("key", ["pose_landmarks", "poseLandmarks", "landmarks"])
def test_lists_of_points_are_people_of_one_image(tmp_path, key):
    path = written(tmp_path, {key: [landmarks(0), landmarks(1)]})
    tracks = read_keypoints(path, 30, people=2, image_size=SIZE)
    assert [track.frames for track in tracks] == [1, 1]


def test_pixels_and_landmarks_without_visibility(tmp_path):
    points = [{"x": 100 + k, "y": 200} for k in range(33)]
    path = written(tmp_path, [{"pose_landmarks": points}])
    (track,) = read_keypoints(path, 30)
    assert track.keypoints[0, 5].tolist() == [105, 200]
    assert (track.confidence == 1).all()
    (same,) = read_keypoints(path, 30, image_size=SIZE)
    assert np.array_equal(same.keypoints, track.keypoints)


@pytest.mark.parametrize(
    ("content", "name", "message"),
    [
        (
            [{"pose_landmarks": landmarks(0)[:5]}],
            "a.json",
            "person 0: expected 33 landmarks, got 5",
        ),
        ([{"pose_landmarks": "x"}], "a.json", "person 0: expected landmarks, got 'x'"),
        ([{"pose_landmarks": [None]}], "a.json", "person 0: expected landmarks, got None"),
        ([{"pose_landmarks": [{"x": 0, "y": "1"}] * 33}], "a.json", "expected numbers between"),
        (
            [{"pose_landmarks": [{"x": 0, "y": 0, "conf": 95}] * 33}],
            "a.json",
            "person 0: expected visibility of at most 1, got 95",
        ),
        ([FRAMES[0], 3], "a.json", "frame 1 must be an object, got 3"),
        ([{"pose_landmarks": []}], "a.json", "expected at least one person, got none"),
        ("", "a.csv", r"columns x and y of MediaPipe's 33 landmarks, got \[\]"),
        ("speed,x1,y1\n0,1,2\n", "a.csv", r"scorer, .* 33 landmarks, got \['speed', 'x1', 'y1'\]"),
        (TABLES["names"].partition("\n")[0], "a.csv", "expected at least one person, got none"),
        (
            TABLES["names"] + "1,2\n",
            "a.csv",
            "line 5: expected 133 cells as in the first row, got 2",
        ),
        (TABLES["names"].replace("\n1,", "\n1,o"), "a.csv", "line 3: expected a number between"),
        (TABLES["long"] + "90,40,0,0,0,1\n", "a.csv", "expected one of 33 landmarks, got '40'"),
    ],
)
def test_defects_are_reported(tmp_path, content, name, message):
    with pytest.raises(MotionFileError, match=message):
        read_keypoints(written(tmp_path, content, name), 30, image_size=SIZE)
