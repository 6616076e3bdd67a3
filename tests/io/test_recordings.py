"""Recordings of several cameras: against made ones that are known, and the real one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probmotion import Cameras, Motion, Skeleton, seeds
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.errors import MotionFileError
from probmotion.io.recordings import Recording, read_recording, triangulate_seen, undistorted

PERSON = Skeleton.preset("person14")
Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
TRIAL = "pose2sim_multiview/S00_P00_T01_BalancingTrial_multiview.npz"
LENS = np.array([-0.05, 0.02, 0.003, -0.002])


def film(path: Path, pixels: float = 0.0) -> Motion:
    """Write a made recording of four cameras with lenses, in a world with Z up, at 60 fps."""
    motion = make_gait("walk", frames=21, fps=60.0)
    cameras = Cameras.ring(4, elevation=0.1, distance=5.0, perspective=True)
    slopes = Cameras(cameras.rotation, cameras.translation, np.ones(4), orthographic=False).project(
        motion.positions
    )
    x, y = slopes[..., 0], slopes[..., 1]
    square = x**2 + y**2
    k1, k2, p1, p2 = LENS
    radial = 1 + k1 * square + k2 * square**2
    bent = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * radial + 2 * p2 * x * y + p1 * (square + 2 * y**2),
        ],
        axis=-1,
    )
    matrix = np.array([[1500.0, 0.0, 540.0], [0.0, 1510.0, 960.0], [0.0, 0.0, 1.0]])
    keypoints = bent * [1500.0, 1510.0] + [540.0, 960.0]
    keypoints = keypoints + pixels * seeds.generator(0, "film").normal(size=keypoints.shape)
    confidence = np.full(keypoints.shape[:-1], 0.8)
    confidence[:, 4, 3] = [0.9, 0.0, 0.0, 0.0]  # one view: no point
    confidence[:, 6, 5] = [0.9, 0.9, 0.2, 0.0]  # two that count
    confidence[2, 6, 5] = 0.2
    keypoints[2, 6, 5] += 300.0  # and one that is wrong, and says so
    keypoints[confidence == 0] = np.nan
    np.savez(
        path,
        keypoints=keypoints.astype(np.float32),
        confidence=confidence,
        positions=motion.positions @ Z_UP_FROM_Y_UP.T + 0.01,
        K=np.tile(matrix, (4, 1, 1)),
        R=cameras.rotation @ Z_UP_FROM_Y_UP.T,
        t=cameras.translation,
        distortion=np.tile(LENS, (4, 1)),
        fps=60.0,
        joint_names=np.array(motion.skeleton.joint_names),
        parents=np.array(motion.skeleton.parents),
        up_axis="z",
    )
    return motion


def test_a_made_recording_is_where_it_was_made(tmp_path: Path) -> None:
    motion = film(tmp_path / "made.npz")
    found = read_recording(tmp_path / "made.npz", motion.skeleton, None)
    assert (found.fps, found.name, found.skeleton) == (60.0, "made", motion.skeleton)
    hidden = np.zeros((21, 17), bool)
    hidden[4, 3] = True
    np.testing.assert_array_equal(~found.seen, hidden)
    assert np.isnan(found.joints[hidden]).all()
    np.testing.assert_allclose(found.joints[~hidden], motion.positions[~hidden], atol=1e-5)
    # The file's 3D is turned in the same way.
    offset = found.filtered - motion.positions
    np.testing.assert_allclose(offset, np.broadcast_to([0.01, 0.01, -0.01], offset.shape))


def test_a_recording_is_brought_to_the_priors_skeleton_and_rate(tmp_path: Path) -> None:
    motion = film(tmp_path / "made.npz")
    found = read_recording(tmp_path / "made.npz")
    wanted = motion.retarget(PERSON).positions[::2]
    assert (found.skeleton, found.fps, found.joints.shape) == (PERSON, 30.0, (11, 14, 3))
    ankle = PERSON.index("right_ankle")  # h36m17's joint 3; frame 4 is the third of 30 a second
    assert np.argwhere(~found.seen).tolist() == [[2, ankle]]
    np.testing.assert_allclose(found.joints[found.seen], wanted[found.seen], atol=1e-5)
    doubtful = read_recording(tmp_path / "made.npz", motion.skeleton, None, threshold=0.1)
    assert np.linalg.norm(doubtful.joints[6, 5] - motion.positions[6, 5]) > 0.05


def test_errors_of_pixels_are_errors_of_their_size(tmp_path: Path) -> None:
    motion = film(tmp_path / "made.npz", pixels=5.0)
    found = read_recording(tmp_path / "made.npz", motion.skeleton, None)
    error = (found.joints - motion.positions)[found.seen]
    # 5 pixels at 5 m are 1.67 cm; four views around a vertical axis see each horizontal axis
    # twice and the vertical one four times.
    wanted = 5.0 / 1500 * 5.0 / np.sqrt([2.0, 4.0, 2.0])
    np.testing.assert_allclose(error.std(axis=0), wanted, rtol=0.12)
    assert abs(error.mean(axis=0)).max() < 0.002


def test_lenses_are_straightened() -> None:
    cameras = Cameras.ring(2, perspective=True)
    matrix = np.tile(np.diag([7.0, 7.0, 1.0]), (2, 1, 1))
    straight = seeds.generator(0, "lens").uniform(-3.0, 3.0, (2, 5, 6, 2))
    x, y = (straight / 7.0)[..., 0], (straight / 7.0)[..., 1]
    square = x**2 + y**2
    k1, k2, p1, p2 = LENS
    radial = 1 + k1 * square + k2 * square**2
    bent = 7.0 * np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * radial + 2 * p2 * x * y + p1 * (square + 2 * y**2),
        ],
        axis=-1,
    )
    assert abs(bent - straight).max() > 0.05
    found = undistorted(bent, matrix, np.tile(LENS, (2, 1)), cameras)
    np.testing.assert_allclose(found, straight, atol=1e-5)
    np.testing.assert_allclose(undistorted(bent, matrix, np.zeros((2, 4)), cameras), bent)
    for name, arguments in (
        ("keypoints", (bent[0], matrix, np.zeros((2, 4)))),
        ("matrix", (bent, matrix[:1], np.zeros((2, 4)))),
        ("distortion", (bent, matrix, np.zeros(4))),
    ):
        points, matrices, lens = arguments
        with pytest.raises(ValueError, match=f"{name} has shape"):
            undistorted(points, matrices, lens, cameras)


def test_what_fewer_than_two_cameras_see_is_no_point() -> None:
    cameras = Cameras.ring(3, perspective=True)
    motion = make_gait("walk", frames=4)
    keypoints = cameras.project(motion.positions)
    weights = np.ones(keypoints.shape[:-1])
    weights[1:, 2, 0] = 0.0
    weights[:, 3, 1] = 0.0
    keypoints[weights == 0] = np.nan
    found = triangulate_seen(keypoints, cameras, weights)
    assert np.argwhere(np.isnan(found).any(axis=-1)).tolist() == [[2, 0], [3, 1]]
    seen = np.isfinite(found)
    np.testing.assert_allclose(found[seen], motion.positions[seen], atol=1e-9)
    nothing = triangulate_seen(keypoints, cameras, np.zeros_like(weights))
    assert np.isnan(nothing).all()
    with pytest.raises(ValueError, match="weights has shape"):
        triangulate_seen(keypoints, cameras, weights[0])


def test_a_file_that_is_no_recording_is_refused(tmp_path: Path, real_data: Path) -> None:
    with pytest.raises(MotionFileError, match="key keypoints is missing"):
        read_recording(real_data / "cmu_single" / "cmu_02_01.npz")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"none\.npz"):
        read_recording(tmp_path / "none.npz")


@pytest.mark.parametrize("threshold", [np.nan, -0.1, 1.5, "half", None])
def test_thresholds_are_shares(tmp_path: Path, threshold: Any) -> None:
    film(tmp_path / "made.npz")
    with pytest.raises(ValueError, match=r"^threshold must be a confidence, 0 to 1$, got .*"):
        read_recording(tmp_path / "made.npz", threshold=threshold)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("confidence", lambda x: x * np.nan, "confidence has no number that is not NaN, expected"),
        (
            "keypoints",
            lambda x: np.where(np.arange(21)[:, None, None] == 7, np.nan, x),
            "keypoints is NaN at view 0, frame 7, joint 0, where confidence must be conf, got 0.8",
        ),
        ("K", lambda x: x[0], r"K must have shape \(4, 3, 3\), got \(3, 3\)"),
        ("K", lambda x: x * np.nan, "K must be finite, got 36 values that are NaN"),
        ("K", lambda x: -x, "focal must be a finite number above 0, got -1505.0"),
        ("R", lambda x: x[:2], r"R must have shape \(4, 3, 3\), got \(2, 3, 3\)"),
        ("R", lambda x: x * np.nan, "R must be finite, got 36 values that are NaN"),
        ("R", lambda x: 2 * x, "rotation is off an orthonormal matrix by 3"),
        ("t", lambda x: x[..., None], r"t must have shape \(4, 3\), got \(4, 3, 1\)"),
        ("t", lambda x: x * np.nan, "t must be finite, got 12 values that are NaN"),
        ("distortion", lambda x: x[:, :2], r"distortion must have shape \(4, 4\), got \(4, 2\)"),
        (
            "distortion",
            lambda x: x * np.nan,
            "distortion must be finite, got 16 values that are NaN",
        ),
        ("K", None, "key K is missing"),
        ("R", None, "key R is missing"),
        ("t", None, "key t is missing"),
        ("distortion", None, "key distortion is missing"),
    ],
)
def test_an_array_that_does_not_fit_is_named(
    tmp_path: Path, key: str, change: Any, message: str
) -> None:
    path = tmp_path / "made.npz"
    film(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    taken = arrays.pop(key)
    if change is not None:
        arrays[key] = change(taken)
    np.savez(path, **arrays)
    with pytest.raises(MotionFileError, match=message) as error:
        read_recording(path)
    assert "made.npz" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def trial(real_data: Path) -> Recording:
    return read_recording(real_data / TRIAL)


def test_the_real_recording_is_near_its_filtered_joints(trial: Recording) -> None:
    assert (trial.skeleton, trial.fps, trial.joints.shape) == (PERSON, 30.0, (50, 14, 3))
    assert trial.seen.all()  # real detectors see all of these joints from two sides at least
    error = np.linalg.norm(trial.joints - trial.filtered, axis=-1)
    assert 0.010 < np.median(error) < 0.020
    assert error.max() < 0.15
    for found in (trial.joints, trial.filtered):
        height = found[..., 1].mean(axis=0)
        assert height[PERSON.index("neck")] > 1.2 > height[0] > 0.7
        assert height[[10, 13]].min() < 0.25  # one ankle on the floor
    # What filtering is for: the triangulated joints jump.
    jumps = [np.linalg.norm(np.diff(x, 2, axis=0), axis=-1).mean() for x in
             (trial.joints, trial.filtered)]  # fmt: skip
    assert jumps[0] > 2 * jumps[1]


def test_no_real_joint_fits_the_pictures_worse_than_the_direct_linear_one(real_data: Path) -> None:
    """The file's ``positions_dlt`` minimise another sum, which is not of pixels."""
    source = Skeleton.preset("body25b")
    whole = read_recording(real_data / TRIAL, source, None)
    with np.load(real_data / TRIAL) as archive:
        arrays = {key: archive[key].astype(np.float64) for key in
                  ("keypoints", "confidence", "K", "R", "t", "positions_dlt")}  # fmt: skip
    weights = np.where(arrays["confidence"] >= 0.3, arrays["confidence"], 0.0)
    dlt = arrays["positions_dlt"]
    np.testing.assert_array_equal(whole.seen, np.isfinite(dlt).all(axis=-1))

    def misses(points: np.ndarray) -> np.ndarray:
        there = np.einsum("vij,ltj->vlti", arrays["R"], points) + arrays["t"][:, None, None]
        image = np.einsum("vij,vltj->vlti", arrays["K"], there)
        pixels = image[..., :2] / image[..., 2:]
        square = ((pixels - arrays["keypoints"]) ** 2).sum(axis=-1)
        return np.where(weights > 0, weights * square, 0.0).sum(axis=0)

    ours, theirs = misses(whole.joints @ Z_UP_FROM_Y_UP.T), misses(dlt)
    seen = whole.seen
    # The lens, which bends by less than half a pixel, is left out here.
    assert (ours <= 1.01 * theirs + 0.5)[seen].all()
    gap = np.linalg.norm(whole.joints @ Z_UP_FROM_Y_UP.T - dlt, axis=-1)[seen]
    assert np.median(gap) < 0.005
    assert np.quantile(gap, 0.9) < 0.012
