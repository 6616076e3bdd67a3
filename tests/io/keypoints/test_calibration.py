"""Calibrations in Pose2Sim's TOML format."""

import numpy as np
import pytest

from probmotion.io.errors import MotionFileError
from probmotion.io.keypoints.calibration import read_calibration, view_folders

CAMERA = """
[cam_{number:02d}]
name = "cam_{number:02d}"
size = [1088.0, 1920.0]
matrix = [[1680.0, 0.0, 530.0], [0.0, 1682.0, 950.0], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.1, 0.001, -0.002]
rotation = [1.2091995761561452, 1.2091995761561452, -1.2091995761561452]
translation = [0.3, 1.0, 3.0]
fisheye = false
"""
FILE = CAMERA.format(number=1) + CAMERA.format(number=2) + "[metadata]\nadjusted = false\n"


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "Calib.toml"
    path.write_text(FILE, encoding="utf-8")
    return path


def test_cameras_are_turned_to_y_up(path):
    calibration = read_calibration(path)
    assert calibration.names == ("cam_01", "cam_02")
    assert calibration.sizes == ((1088, 1920), (1088, 1920))
    # The rotation maps (x, y, z) of the file to (y, -z, -x) of the camera.
    x, y, z = 0.4, -0.7, 1.6
    own = np.array([y + 0.3, 1.0 - z, 3.0 - x])
    pixel = calibration.cameras.project(np.array([[[x, z, -y]]]))[0, 0, 0]
    assert np.allclose(pixel, 1681 * own[:2] / own[2] + [530, 950])


def test_distortion_is_removed(path):
    calibration = read_calibration(path)
    x, y = np.random.default_rng(0).uniform([-0.3, -0.5], [0.3, 0.5], (20, 2)).T
    square = x**2 + y**2
    radial = 1 - 0.3 * square + 0.1 * square**2
    u = x * radial + 0.002 * x * y - 0.002 * (square + 2 * x**2)
    v = y * radial + 0.001 * (square + 2 * y**2) - 0.004 * x * y
    seen = np.stack([1680 * u + 530, 1682 * v + 950], axis=-1)
    pixels = calibration.undistorted(1, seen[None])[0]
    assert np.allclose(pixels, 1681 * np.stack([x, y], axis=-1) + [530, 950], atol=1e-3)


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["cam_02", "cam_01"], [1, 0]),
        (["cam02_json"], [1]),
        (["Cam01.trial", "cam-02"], [0, 1]),
        (["left", "right"], [0, 1]),
    ],
)
def test_recordings_are_matched_by_name_or_else_by_order(path, names, found):
    assert read_calibration(path).matched(names) == found


@pytest.mark.parametrize(
    ("cameras", "names"),
    [
        (("cam_01", "cam_010"), ["cam01_json", "cam010_json"]),
        (("cam1", "cam10"), ["trial_cam1", "trial_cam10"]),
        (("1", "2"), ["20241201_1", "20241201_2"]),
        (("left", "left_up"), ["trial-left", "trial-left-up"]),
        (("cam1", "cam2"), ["Trial_2_cam_1", "cam2_20241201"]),
    ],
)
def test_names_are_matched_to_the_longest_with_whole_numbers(path, cameras, names):
    text = FILE.replace("cam_01", cameras[0]).replace("cam_02", cameras[1])
    path.write_text(text, encoding="utf-8")
    assert read_calibration(path).matched(names) == [0, 1]
    assert read_calibration(path).matched(names[::-1]) == [1, 0]


@pytest.mark.parametrize(
    ("names", "got"),
    [
        (["left"], r"left \(no camera\)"),
        (["cam_02", "left"], r"cam_02 \(cam_02\), left \(no camera\)"),
        (["cam_01", "cam01_json"], r"cam_01 \(cam_01\), cam01_json \(cam_01\)"),
        (["cam_011", "cam_02"], r"cam_011 \(no camera\), cam_02 \(cam_02\)"),
        (["cam", "cam_02"], r"cam \(several cameras\), cam_02 \(cam_02\)"),
        (["cam02_cam01", "cam01_cam02"], r"cam02_cam01 \(several .*, cam01_cam02 \(several .*\)"),
    ],
)
def test_names_of_some_cameras_only_are_refused(path, names, got):
    with pytest.raises(ValueError, match=rf"cameras cam_01, cam_02, or all have .* got {got}$"):
        read_calibration(path).matched(names)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[metadata]", "[metadata", "expected TOML"),
        ("matrix", "K", "expected cameras"),
        ("cam_02", "cam_01", "expected TOML"),
        ('name = "cam_02"', 'name = "cam_01"', "different names"),
        ("fisheye = false", "fisheye = true", "fisheye"),
        ("[1680.0, 0.0", "[1680.0, 2.0", "focal lengths and principal point only"),
        ("[0.3, 1.0, 3.0]", "[0.3, 1.0]", "translation must have shape"),
        ("[0.3, 1.0, 3.0]", '["a", 1.0, 3.0]', "translation must be numbers"),
        ("[0.3, 1.0, 3.0]", f"[{'9' * 400}, 1.0, 3.0]", "translation must be numbers"),
        ("[0.3, 1.0, 3.0]", "[nan, 1.0, 3.0]", "translation must be finite"),
        ("-0.3, 0.1, ", "", "distortions must be 4 or 5"),
        ("1088.0", "0.0", "size must be pixels"),
        ("[1680.0, 0.0", "[-1680.0, 0.0", "focal lengths and principal point"),
        ("[1680.0, 0.0", "[1e9, 0.0", "focal lengths in pixels, got 1e\\+09, a field of view of 0"),
        ("[0.0, 1682.0", "[0.0, 1.6", "focal lengths in pixels, got 1.6"),
    ],
)
def test_defects_are_reported(path, old, new, words):
    path.write_text(FILE.replace(old, new), encoding="utf-8")
    with pytest.raises(MotionFileError, match=words) as error:
        read_calibration(path)
    assert "Calib.toml" in str(error.value)


@pytest.mark.parametrize("stage", ["pose", "pose-sync", "pose-associated"])
def test_a_trial_has_a_folder_of_every_camera(tmp_path, stage):
    for name in ("cam10_json", "cam2_json", "video"):
        (tmp_path / stage / name).mkdir(parents=True)
    for name in ("cam10_json", "cam2_json"):
        (tmp_path / stage / name / "frame_0.json").write_text("{}", encoding="utf-8")
    (tmp_path / "pose").mkdir(exist_ok=True)
    found = view_folders(tmp_path)
    assert [folder.name for folder in found] == ["cam2_json", "cam10_json"]
    assert found[0].parent.name == stage
    assert view_folders(found[0]) == [found[0]]
