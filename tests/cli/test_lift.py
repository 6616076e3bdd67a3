import json

import numpy as np
import pytest

from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.geometry.rotations import matrix_to_vector
from probmotion.io.conventions import Z_UP_TO_Y_UP
from probmotion.io.files import load, save
from probmotion.lifting import result
from probmotion.motion.presets import PRESETS
from probmotion.motion.skeleton import Skeleton

NAMES = ["lift.bvh", "lift.glb", "lift.html", "lift.npz", "lift.smpl22.npz", "summary.json"]


@pytest.fixture(scope="module")
def detections(tmp_path_factory):
    """Write COCO results of two people in one video, and return the path."""
    results = []
    for person, azimuth in enumerate((0.8, 2.0)):
        track = film(make_gait("walk", person + 1, frames=45), person, azimuth=azimuth).track
        points = np.nan_to_num(track.keypoints)
        for frame, (rows, confidence) in enumerate(zip(points, track.confidence, strict=True)):
            values = np.column_stack([rows, confidence]).ravel().tolist()
            results.append({"image_id": f"{frame}.jpg", "idx": person, "keypoints": values})
    path = tmp_path_factory.mktemp("video") / "keypoints.json"
    path.write_text(json.dumps(results), encoding="utf-8")
    return path


SIZE = ["--image-size", "1000", "1000"]


def test_every_person_has_a_folder(capsys, detections, tmp_path):
    words = ["lift", str(detections), "--fps", "30", *SIZE, "--draws", "4", "--out", str(tmp_path)]
    assert main(words) == 0
    text = capsys.readouterr().out
    for person in range(2):
        folder = tmp_path / f"person-{person}"
        assert sorted(path.name for path in folder.iterdir()) == NAMES
        assert load(folder / "lift.bvh").frames == 45
    assert text.count("The camera is") == 2


def test_people_who_are_hardly_visible_are_named(capsys, fails, detections, tmp_path):
    results = json.loads(detections.read_text(encoding="utf-8"))
    few = [each for each in results if each["idx"] == 0 or int(each["image_id"][:-4]) % 5 == 0]
    for each in few:
        each["image_id"] = f"{int(each['image_id'][:-4]) + 22}.jpg"
    path = tmp_path / "few.json"
    path.write_text(json.dumps(few), encoding="utf-8")
    out = tmp_path / "out"
    assert main(["lift", str(path), "--fps", "30", *SIZE, "--draws", "2", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "person 1 was not lifted: track must show the person" in text
    assert text.count("Frame 0 of the motion is frame 22 of the video") == 1
    assert [folder.name for folder in out.iterdir()] == ["person-0"]
    strict = ["--strict", "--draws", "2", "--out", str(tmp_path / "strict")]
    assert "track must show the person" in fails("lift", str(path), "--fps", "30", *SIZE, *strict)


@pytest.fixture(scope="module")
def landmarks(tmp_path_factory):
    """Write a walk as MediaPipe's normalised landmarks with rate and size; return the path."""
    track = film(make_gait("walk", 1, frames=45), 0, azimuth=0.8).track
    names = PRESETS["mediapipe33"].joint_names
    values = np.zeros((track.frames, len(names), 4))  # x, y, z and visibility
    for joint, name in enumerate(track.skeleton.joint_names):
        place = names.index(name)
        values[:, place, :2] = np.nan_to_num(track.keypoints[:, joint]) / 1000
        values[:, place, 3] = track.confidence[:, joint]
    frames = [{"pose_landmarks": points} for points in values.tolist()]
    path = tmp_path_factory.mktemp("mediapipe") / "walk.json"
    content = {"fps": 30, "width": 1000, "height": 1000, "frames": frames}
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_rate_and_size_of_the_file_are_used_and_must_not_be_contradicted(
    fails, landmarks, tmp_path
):
    out = tmp_path / "out"
    words = ["lift", str(landmarks), "--draws", "2", "--out", str(out)]
    assert "--fps must be the frame rate of" in fails(*words, "--fps", "31")
    assert "fps must be a finite number above 0, got 0" in fails(*words, "--fps", "0")
    message = fails(*words, "--image-size", "1920", "1080")
    assert "walk.json, (1000, 1000), got (1920, 1080); leave it out" in message
    assert not out.exists()
    assert main([*words, "--fps", "29.97"]) == 0
    assert load(out / "lift.bvh").fps == pytest.approx(29.97)


def test_an_interrupted_lift_leaves_whole_folders_alone(capsys, monkeypatch, detections, tmp_path):
    saved = []

    def interrupted(motion, path):
        save(motion, path)
        saved.append(path)
        if len(saved) == 4:  # lift.bvh of the second person
            raise KeyboardInterrupt

    monkeypatch.setattr(result, "save", interrupted)
    out = tmp_path / "out"
    words = ["lift", str(detections), "--fps", "30", *SIZE, "--draws", "2", "--out", str(out)]
    assert main(words) == 130
    assert "interrupted; nothing more was written" in capsys.readouterr().err
    assert [folder.name for folder in out.iterdir()] == ["person-0"]
    assert sorted(path.name for path in (out / "person-0").iterdir()) == NAMES


def test_keypoints_with_y_up_are_flipped(fails, landmarks, tmp_path):
    content = json.loads(landmarks.read_text(encoding="utf-8"))
    for frame in content["frames"]:
        for landmark in frame["pose_landmarks"]:
            landmark[1] = 1 - landmark[1]
    path = tmp_path / "y_up.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    out = ["--draws", "2", "--out", str(tmp_path / "out")]
    assert "flip them: --flip y of probmotion lift" in fails("lift", str(path), *out)
    assert main(["lift", str(path), *out, "--flip", "y"]) == 0
    assert json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["trusted"]


def test_strict_fails_for_motion_that_is_not_trusted(fails, detections, tmp_path):
    results = json.loads(detections.read_text(encoding="utf-8"))
    rng = np.random.default_rng(0)
    for each in results:
        points = rng.uniform(200, 800, (17, 2))
        each["keypoints"] = np.column_stack([points, np.ones(17)]).ravel().tolist()
    path = tmp_path / "random.json"
    path.write_text(json.dumps(results), encoding="utf-8")
    words = ["lift", str(path), "--fps", "30", *SIZE, "--person", "0", "--draws", "2", "--strict"]
    message = fails(*words, "--out", str(tmp_path / "out"))
    assert "motions must pass all checks with --strict" in message


def test_errors_are_one_line_and_leave_no_files(fails, detections, tmp_path):
    out = tmp_path / "out"
    base = ["lift", str(detections), "--out", str(out)]
    cases = {
        ("--fps", "30", "--image-size", "100", "100"): "pixels of an image of 100 × 100",
        (*SIZE,): "--fps 30 is a video of 30 frames per second",
        ("--fps", "30", *SIZE, "--person", "5"): "--person must be 0 to 1, got 5",
        ("--fps", "30", *SIZE, "--fov", "0"): "fov must be 10 to 150",
    }
    for options, expected in cases.items():
        assert expected in fails(*base, *options), options
        assert not out.exists()


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    """Write a trial of Pose2Sim with two cameras; return its folder and the true positions."""
    folder = tmp_path_factory.mktemp("trial")
    clip = make_gait("walk", 3, frames=40)
    toml = "[metadata]\nerror = 0.0\n"
    for number, azimuth in ((2, 0.8), (10, 2.4)):
        video = film(clip, number, azimuth=azimuth)
        frames = folder / "pose-associated" / f"cam{number}_json"
        frames.mkdir(parents=True)
        values = np.nan_to_num(np.dstack([video.track.keypoints, video.track.confidence]))
        for frame, points in enumerate(values):
            people = [{"pose_keypoints_2d": points.ravel().tolist()}]
            path = frames / f"cam{number}.{frame:03d}.json"
            path.write_text(json.dumps({"people": people}), encoding="utf-8")
        camera = video.camera
        (x, y), focal = camera.centre[0], camera.focal[0]
        vector = matrix_to_vector(camera.rotation[0] @ Z_UP_TO_Y_UP)
        toml += f"[cam_{number}]\nname = 'cam_{number}'\nsize = {list(video.size)}\n"
        toml += f"matrix = [[{focal}, 0.0, {x}], [0.0, {focal}, {y}], [0.0, 0.0, 1.0]]\n"
        toml += f"distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = {vector.tolist()}\n"
        toml += f"translation = {camera.translation[0].tolist()}\nfisheye = false\n"
    (folder / "Calib.toml").write_text(toml, encoding="utf-8")
    return folder, clip.retarget(Skeleton.preset("person14")).positions


def test_a_trial_of_calibrated_cameras_is_lifted_in_their_world(capsys, trial, tmp_path):
    folder, truth = trial
    words = ["lift", str(folder), "--camera", str(folder / "Calib.toml"), "--fps", "30"]
    assert main([*words, "--draws", "2", "--out", str(tmp_path)]) == 0
    assert "the 2 cameras (cam_2, cam_10)" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == NAMES
    distance = np.linalg.norm(load(tmp_path / "lift.npz").positions - truth, axis=-1)[:, 2:]
    assert distance.mean() < 0.04
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert [camera["name"] for camera in summary["cameras"]] == ["cam_2", "cam_10"]
    assert "3D motion from 2 cameras" in (tmp_path / "lift.html").read_text(encoding="utf-8")


def test_one_of_the_calibrated_cameras_is_found_by_its_name(capsys, trial, tmp_path):
    folder, truth = trial
    one = folder / "pose-associated" / "cam10_json"
    words = ["lift", str(one), "--camera", str(folder / "Calib.toml"), "--fps", "30"]
    assert main([*words, "--draws", "2", "--out", str(tmp_path)]) == 0
    assert "the 1 camera (cam_10)" in capsys.readouterr().out
    distance = np.linalg.norm(load(tmp_path / "lift.npz").positions - truth, axis=-1)[:, 2:]
    assert distance.mean() < 0.4


def test_keypoints_of_a_calibrated_camera_with_y_up_are_flipped(fails, trial, tmp_path):
    folder, truth = trial
    flipped = tmp_path / "cam10_json"
    flipped.mkdir()
    for path in (folder / "pose-associated" / "cam10_json").iterdir():
        points = np.reshape(json.loads(path.read_text())["people"][0]["pose_keypoints_2d"], (-1, 3))
        points[:, 1] = 1000 - points[:, 1]
        people = [{"pose_keypoints_2d": points.ravel().tolist()}]
        (flipped / path.name).write_text(json.dumps({"people": people}), encoding="utf-8")
    words = ["lift", str(flipped), "--camera", str(folder / "Calib.toml"), "--fps", "30"]
    words += ["--draws", "2", "--out", str(tmp_path / "out")]
    assert "keypoints must show a person upright" in fails(*words)
    assert not (tmp_path / "out").exists()
    assert main([*words, "--flip", "y"]) == 0
    distance = np.linalg.norm(load(tmp_path / "out" / "lift.npz").positions - truth, axis=-1)
    assert distance[:, 2:].mean() < 0.4


def test_wrong_cameras_are_named(fails, trial, detections, tmp_path):
    folder, _ = trial
    toml, out = folder / "Calib.toml", tmp_path / "out"
    one = folder / "pose-associated" / "cam2_json"
    cases = {
        (detections, "--camera", toml): "must be named after the calibrated cameras cam_2, cam_10",
        (detections, one, "--camera", toml): "must be of one person, got 2 in",
        (one, one, *SIZE): "--camera must be given for several files, got 2 files",
        (one,): "--image-size or --camera must be given",
        (folder, "--camera", toml, "--person", "0"): "--person must not be given with several",
        (one, "--camera", one / "cam2.000.json"): "expected TOML",
        (one, "--camera", toml, "--image-size", "9", "9"): "that of the calibration, 1000 × 1000",
    }
    for words, expected in cases.items():
        assert expected in fails("lift", *words, "--fps", "30", "--out", out), words
        assert not out.exists()
