import json

import numpy as np
import pytest

from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.io.files import load

NAMES = ["lift.bvh", "lift.glb", "lift.html", "lift.npz", "summary.json"]


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


def test_people_who_are_hardly_visible_are_named(capsys, detections, tmp_path):
    results = json.loads(detections.read_text(encoding="utf-8"))
    few = [each for each in results if each["idx"] == 0 or int(each["image_id"][:-4]) % 5 == 0]
    path = tmp_path / "few.json"
    path.write_text(json.dumps(few), encoding="utf-8")
    out = tmp_path / "out"
    assert main(["lift", str(path), "--fps", "30", *SIZE, "--draws", "2", "--out", str(out)]) == 0
    assert "person 1 was not lifted: track must show the person" in capsys.readouterr().out
    assert [folder.name for folder in out.iterdir()] == ["person-0"]


def test_errors_are_one_line_and_leave_no_files(fails, detections, tmp_path):
    out = tmp_path / "out"
    base = ["lift", str(detections), "--out", str(out)]
    cases = {
        ("--fps", "30", "--image-size", "100", "100"): "pixels of an image of 100 × 100",
        (*SIZE,): "fps must be given",
        ("--fps", "30", *SIZE, "--person", "5"): "person must be 0 to 1, got 5",
        ("--fps", "30", *SIZE, "--fov", "0"): "fov must be 10 to 150",
    }
    for options, expected in cases.items():
        assert expected in fails(*base, *options), options
        assert not any(out.rglob("*.*"))
