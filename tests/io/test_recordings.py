"""Multi-camera recordings: a synthetic one with known joints and a real one."""

import numpy as np
import pytest

from probmotion import Cameras, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.errors import MotionFileError
from probmotion.io.recordings import read_recording, triangulate_seen

PERSON = Skeleton.preset("person14")
Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
LENS = np.array([-0.05, 0.02, 0.003, -0.002])


def film(path):
    """Write a synthetic recording of four cameras with lenses, Z up, at 60 fps."""
    motion = make_gait("walk", frames=21, fps=60.0)
    cameras = Cameras.ring(4, elevation=0.1, distance=5.0, perspective=True)
    flat = Cameras(cameras.rotation, cameras.translation, np.ones(4), orthographic=False)
    x, y = np.moveaxis(flat.project(motion.positions), -1, 0)
    square = x**2 + y**2
    k1, k2, p1, p2 = LENS
    radial = 1 + k1 * square + k2 * square**2
    u = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2)
    v = y * radial + 2 * p2 * x * y + p1 * (square + 2 * y**2)
    matrix = np.array([[1500.0, 0.0, 540.0], [0.0, 1510.0, 960.0], [0.0, 0.0, 1.0]])
    keypoints = np.stack([u, v], axis=-1) * [1500.0, 1510.0] + [540.0, 960.0]
    confidence = np.full(keypoints.shape[:-1], 0.8)
    confidence[:, 4, 3] = [0.9, 0.0, 0.0, 0.0]  # a single view
    confidence[:, 6, 5] = [0.9, 0.9, 0.2, 0.0]
    keypoints[2, 6, 5] += 300.0  # an outlier of low confidence
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


def test_synthetic_recording_is_recovered(tmp_path):
    motion = film(tmp_path / "made.npz")
    recording = read_recording(tmp_path / "made.npz", motion.skeleton, None)
    assert (recording.fps, recording.name, recording.skeleton) == (60.0, "made", motion.skeleton)
    assert np.argwhere(~recording.seen).tolist() == [[4, 3]]
    seen = recording.seen
    np.testing.assert_allclose(recording.joints[seen], motion.positions[seen], atol=1e-5)
    offset = recording.filtered - motion.positions
    np.testing.assert_allclose(offset, np.broadcast_to([0.01, 0.01, -0.01], offset.shape))
    doubtful = read_recording(tmp_path / "made.npz", motion.skeleton, None, threshold=0.1)
    assert np.linalg.norm(doubtful.joints[6, 5] - motion.positions[6, 5]) > 0.05


def test_recording_on_the_prior_s_skeleton_and_rate(tmp_path):
    motion = film(tmp_path / "made.npz")
    recording = read_recording(tmp_path / "made.npz")
    wanted = motion.retarget(PERSON).positions[::2]
    assert (recording.skeleton, recording.fps, recording.joints.shape) == (
        PERSON,
        30.0,
        (11, 14, 3),
    )
    ankle = PERSON.index("right_ankle")  # h36m17's joint 3; frame 4 at 60 fps
    assert np.argwhere(~recording.seen).tolist() == [[2, ankle]]
    np.testing.assert_allclose(recording.joints[recording.seen], wanted[recording.seen], atol=1e-5)


def test_joints_in_fewer_than_two_views_are_nan():
    cameras = Cameras.ring(3, perspective=True)
    motion = make_gait("walk", frames=4)
    keypoints = cameras.project(motion.positions)
    weights = np.ones(keypoints.shape[:-1])
    weights[1:, 2, 0] = weights[:, 3, 1] = 0.0
    keypoints[weights == 0] = np.nan
    points = triangulate_seen(keypoints, cameras, weights)
    wanted = motion.positions.copy()
    wanted[[2, 3], [0, 1]] = np.nan
    np.testing.assert_allclose(points, wanted, atol=1e-9)
    assert np.isnan(triangulate_seen(keypoints, cameras, np.zeros_like(weights))).all()


@pytest.mark.parametrize("threshold", [np.nan, -0.1, 1.5, "half"])
def test_invalid_thresholds_are_refused(tmp_path, threshold):
    with pytest.raises(ValueError, match="threshold must be between 0 and 1, got"):
        read_recording(tmp_path / "made.npz", threshold=threshold)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("confidence", lambda x: x * np.nan, "confidence must contain numbers, got only NaN"),
        ("keypoints", lambda x: x * np.nan, "NaN at view 0, frame 0, joint 0 with confidence 0.8"),
        ("K", lambda x: x[0], r"K must have shape \(4, 3, 3\), got \(3, 3\)"),
        ("K", lambda x: x * np.nan, "K must be finite, got 36 values that are NaN"),
        ("K", lambda x: -x, "focal must be a finite number above 0, got -1505.0"),
        ("R", lambda x: 2 * x, "rotation must be orthonormal to 1e-6, got a deviation of 3"),
        ("t", lambda x: x[..., None], r"t must have shape \(4, 3\), got \(4, 3, 1\)"),
        ("distortion", lambda x: x[:, :2], r"distortion must have shape \(4, 4\), got \(4, 2\)"),
        ("keypoints", None, "expected the key keypoints"),
    ],
)
def test_defects_are_reported(tmp_path, key, change, message):
    path = tmp_path / "made.npz"
    film(path)
    with np.load(path) as archive:
        arrays = dict(archive)
    changed = {} if change is None else {key: change(arrays[key])}
    del arrays[key]
    np.savez(path, **arrays, **changed)
    with pytest.raises(MotionFileError, match=message) as error:
        read_recording(path)
    assert "made.npz" in str(error.value)


def test_real_recording_agrees_with_its_dlt(real_data):
    """The file's ``positions_dlt`` minimise another sum than that of squared pixels."""
    path = real_data / "pose2sim_multiview" / "S00_P00_T01_BalancingTrial_multiview.npz"
    recording = read_recording(path, Skeleton.preset("body25b"), None)
    with np.load(path) as archive:
        dlt = archive["positions_dlt"]
    np.testing.assert_array_equal(recording.seen, np.isfinite(dlt).all(axis=-1))
    distance = np.linalg.norm(recording.joints @ Z_UP_FROM_Y_UP.T - dlt, axis=-1)[recording.seen]
    assert np.median(distance) < 0.005
    assert np.quantile(distance, 0.9) < 0.012
