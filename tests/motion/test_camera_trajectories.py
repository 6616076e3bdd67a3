"""SPIN-t: recovery of known trajectories from local poses and detections."""

import numpy as np
import pytest
from scipy.optimize import check_grad

from probmotion import Cameras, Skeleton
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.motion import camera_trajectories
from probmotion.motion.camera_trajectories import _Objective, fit_trajectory, geman_mcclure
from probmotion.motion.motion import KeypointTrack

L, J, FOCAL = 40, 9, 1000.0
SKELETON = Skeleton([f"joint {j}" for j in range(J)], [-1, *range(J - 1)])


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def camera():
    """Camera 1.5 m up, looking slightly down along −z, with an off-centre principal point."""
    tilt = vector_to_matrix(np.array([0.2, 0, 0])) @ np.diag([1.0, -1.0, -1.0])
    return Cameras(
        rotation=tilt[None],
        translation=np.array([[0.3, 1.5, 5.0]]),
        focal=np.array([FOCAL]),
        centre=np.array([[500.0, 400.0]]),
        orthographic=False,
    )


@pytest.fixture(scope="module")
def truth():
    """Body half a metre wide that walks an arc of 3 m and waves, world metres, (L, J, 3)."""
    rng = np.random.default_rng(1)
    time = np.linspace(0, 1, L)[:, None, None]
    body = rng.uniform(-0.5, 0.5, size=(J, 3)) * [0.6, 1.6, 0.6]
    body[0] = 0
    waving = 0.05 * np.sin(2 * np.pi * time * 2 + rng.uniform(0, 6, size=(J, 3)))
    waving[:, 0] = 0
    path = np.concatenate([-1.5 + 3 * time, 1 + 0.05 * np.sin(12 * time), time * (1 - time)], -1)
    return body + waving + path


def local_of(truth, camera):
    seen = truth @ camera.rotation[0].T
    return seen - seen[:, :1]


def turned(local, vectors):
    return np.einsum("lab,ljb->lja", vector_to_matrix(vectors), local)


def track_of(keypoints, confidence=None):
    shown = np.ones(keypoints.shape[:2]) if confidence is None else confidence
    return KeypointTrack(keypoints, shown, SKELETON, 30.0)


def error_of(found, truth):
    """Mean distance, metres."""
    return np.linalg.norm(found.positions - truth, axis=-1).mean()


def test_exact_detections_recover_the_trajectory(truth, camera):
    local = local_of(truth, camera)
    track = track_of(camera.project(truth)[0])
    found = fit_trajectory(local, track, camera, smoothness_weight=0.01)
    assert found.converged
    assert np.abs(found.positions - truth).max() < 1e-3
    origin = truth[:, 0] @ camera.rotation[0].T + camera.translation[0]
    np.testing.assert_allclose(found.translations, origin, atol=1e-3)
    np.testing.assert_allclose(found.orientations, 0, atol=1e-3)
    # Smoothing affects mainly the ends.
    default = fit_trajectory(local, track, camera)
    assert error_of(default, truth) < 0.02
    assert np.abs(default.positions - truth)[8:-8].max() < 0.02


def test_defaults_scale_with_the_image_unit(truth, camera):
    unit = Cameras(
        camera.rotation, camera.translation, np.ones(1), camera.centre / FOCAL, orthographic=False
    )
    local = local_of(truth, camera)
    pixels = fit_trajectory(local, track_of(camera.project(truth)[0]), camera)
    slopes = fit_trajectory(local, track_of(unit.project(truth)[0]), unit)
    np.testing.assert_allclose(slopes.positions, pixels.positions, atol=1e-6)
    assert slopes.cost == pytest.approx(pixels.cost / FOCAL**2, rel=1e-6)


def outliers(keypoints, rng, fraction):
    """Move a fraction of the detections by up to 500 pixels to one side of the image."""
    wild = rng.random(keypoints.shape[:2]) < fraction
    moved = keypoints.copy()
    moved[wild] += rng.uniform(100, 500, size=(wild.sum(), 2))
    return moved


def test_outliers_affect_the_quadratic_loss_only(truth, camera, rng):
    local = local_of(truth, camera)
    keypoints = camera.project(truth)[0] + 2 * rng.normal(size=(L, J, 2))
    track = track_of(outliers(keypoints, rng, 0.3))
    robust = fit_trajectory(local, track, camera, scale=15.0)
    # For a scale far beyond every error, ρ(e) = e².
    quadratic = fit_trajectory(local, track, camera, scale=1e6)
    assert error_of(robust, truth) < 0.04
    assert error_of(quadratic, truth) > 0.5


def test_scale_schedule_avoids_local_minima(truth, camera, rng, monkeypatch):
    local = turned(local_of(truth, camera), 0.3 * rng.normal(size=(L, 3)))
    track = track_of(outliers(camera.project(truth)[0], rng, 0.3))
    found = fit_trajectory(local, track, camera, scale=15.0)
    monkeypatch.setattr(camera_trajectories, "_SCHEDULE", (1.0,))
    at_once = fit_trajectory(local, track, camera, scale=15.0)
    assert error_of(found, truth) < 0.05
    assert found.cost < at_once.cost
    assert error_of(at_once, truth) > 0.5


def test_orientations_are_corrected(truth, camera, rng):
    local = local_of(truth, camera)
    turns = 0.25 * rng.normal(size=(L, 3))
    noisy = turned(local, turns)
    keypoints = camera.project(truth)[0] + 2 * rng.normal(size=(L, J, 2))
    found = fit_trajectory(noisy, track_of(keypoints), camera)
    before = np.linalg.norm(noisy - local, axis=-1).mean()
    after = found.positions - found.positions[:, :1] - (truth - truth[:, :1])
    assert before > 0.1
    assert np.linalg.norm(after, axis=-1).mean() < before / 4
    left = vector_to_matrix(found.orientations) @ vector_to_matrix(turns)
    angles = np.arccos(np.clip((np.trace(left, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert np.median(angles) < 0.1 < np.median(np.linalg.norm(turns, axis=-1))


@pytest.mark.parametrize("missing", [slice(15, 25), slice(0, 6), slice(34, L)])
def test_missing_frames_are_interpolated_smoothly(truth, camera, missing):
    confidence = np.ones((L, J))
    confidence[missing] = 0
    keypoints = camera.project(truth)[0]
    keypoints[missing] = np.nan
    found = fit_trajectory(local_of(truth, camera), track_of(keypoints, confidence), camera)
    apart = np.linalg.norm(found.positions - truth, axis=-1).mean(axis=1)
    if missing == slice(15, 25):
        assert apart[missing].max() < 0.06
    steps = np.linalg.norm(np.diff(found.positions.mean(axis=1), axis=0), axis=-1)
    true_steps = np.linalg.norm(np.diff(truth.mean(axis=1), axis=0), axis=-1)
    assert steps.max() < 1.5 * true_steps.max()
    # Without detections at the ends, the smoothest motion is static there.
    if missing.start == 0:
        assert steps[:4].max() < 0.3 * true_steps[:4].max()


def test_detections_of_confidence_zero_are_ignored(truth, camera):
    keypoints = camera.project(truth)[0]
    confidence = np.ones((L, J))
    confidence[::3, 2] = confidence[:, 5] = 0
    wild = keypoints + np.where(confidence[..., None] > 0, 0, 1e5)
    absent = np.where(confidence[..., None] > 0, keypoints, np.nan)
    local = local_of(truth, camera)
    first, second = (fit_trajectory(local, track_of(y, confidence), camera) for y in (wild, absent))
    np.testing.assert_array_equal(first.positions, second.positions)
    assert error_of(first, truth) < 0.02


def test_larger_smoothness_weight_gives_smoother_motion(truth, camera, rng):
    track = track_of(camera.project(truth)[0] + 3 * rng.normal(size=(L, J, 2)))
    rough, smooth = (
        np.diff(
            fit_trajectory(
                local_of(truth, camera), track, camera, smoothness_weight=weight
            ).positions,
            axis=0,
        )
        for weight in (500.0, 5e4)
    )
    assert (smooth**2).sum() < (rough**2).sum()


def test_cost_is_equation_12(truth, camera, rng):
    """Recomputed from the result with the camera's own projection."""
    local = local_of(truth, camera)
    confidence = rng.uniform(0, 1, size=(L, J))
    y = camera.project(truth)[0] + 5 * rng.normal(size=(L, J, 2))
    track = track_of(y, confidence)
    found = fit_trajectory(local, track, camera, scale=8.0, smoothness_weight=300.0)
    points = turned(local, found.orientations) + found.translations[:, None]
    world = np.einsum("ba,ljb->lja", camera.rotation[0], points - camera.translation[0])
    np.testing.assert_allclose(found.positions, world, atol=1e-12)
    error = np.linalg.norm(camera.project(world)[0] - y, axis=-1)
    robust = 8.0**2 * error**2 / (8.0**2 + error**2)
    smooth = (np.linalg.norm(points[1:] - points[:-1], axis=-1) ** 2).sum()
    assert found.cost == pytest.approx((confidence * robust).sum() + 300 * smooth)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.02, 0.05, 2.0])
def test_gradient_agrees_with_finite_differences(rng, size):
    frames, joints = 4, 5
    objective = _Objective(
        local=rng.normal(size=(frames, joints, 3)),
        detections=100 * rng.normal(size=(frames, joints, 2)),
        confidence=rng.uniform(0, 1, size=(frames, joints)),
        focal=200.0,
        smoothness_weight=40.0,
    )
    translations = np.array([0, 0, 3.0]) + 0.5 * rng.normal(size=(frames, 3))
    translations[2, 2] = -0.5  # some joints behind the near plane
    orientations = size * rng.normal(size=(frames, 3))
    assert (objective.points(translations, orientations)[..., 2] < 0.1).any()
    point = np.concatenate([translations, orientations], axis=1).ravel()
    for scale in (30.0, 1e6):
        off = check_grad(
            lambda x, c=scale: objective.cost_and_gradient(x, c)[0],
            lambda x, c=scale: objective.cost_and_gradient(x, c)[1],
            point,
            epsilon=1e-7,
        )
        size_of = np.linalg.norm(objective.cost_and_gradient(point, scale)[1])
        assert off < 2e-5 * size_of


def test_geman_mcclure_by_hand():
    value, slope = geman_mcclure(np.array([0.0, 4.0, 9.0, 1e12]), 2.0)
    np.testing.assert_allclose(value, [0, 2, 36 / 13, 4], rtol=1e-9)
    np.testing.assert_allclose(slope, [1, 1 / 4, (4 / 13) ** 2, 0], atol=1e-9)


def test_iteration_limit_is_reported(truth, camera, rng):
    track = track_of(camera.project(truth)[0] + 5 * rng.normal(size=(L, J, 2)))
    found = fit_trajectory(local_of(truth, camera), track, camera, max_iterations=3)
    assert not found.converged
    assert found.iterations == 12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"local": np.zeros((L, J, 2))}, r"local must have shape \(40, 9, 3\), got \(40, 9, 2\)"),
        ({"local": np.full((L, J, 3), np.inf)}, "local must be finite, got 1080 values"),
        ({"camera": Cameras.ring(1)}, "camera must be perspective"),
        ({"camera": Cameras.ring(2, perspective=True)}, "camera must be one view, got 2"),
        ({"scale": 0.0}, "scale must be a finite number above 0, got 0.0"),
        ({"smoothness_weight": 0.0}, "smoothness_weight must be a finite number above 0, got 0.0"),
        ({"max_iterations": 0}, "max_iterations must be an integer of at least 1, got 0"),
        ({"track": track_of(np.zeros((L, J, 2)), np.zeros((L, J)))}, "in front of the camera in"),
    ],
)
def test_invalid_input_is_refused(truth, camera, change, message):
    given = {"local": local_of(truth, camera), "track": track_of(camera.project(truth)[0])}
    with pytest.raises(ValueError, match=message):
        fit_trajectory(**(given | {"camera": camera} | change))


def test_point_reflected_detections_are_refused(truth, camera):
    reflected = 2 * camera.centre[0] - camera.project(truth)[0]
    with pytest.raises(ValueError, match="track must determine a position in front of the camera"):
        fit_trajectory(local_of(truth, camera), track_of(reflected), camera)
