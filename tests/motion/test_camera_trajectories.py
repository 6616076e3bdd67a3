"""SPIN-t: recovery of known trajectories from local poses and detections."""

import numpy as np
import pytest
from scipy.optimize import check_grad

from probmotion import Cameras, Skeleton
from probmotion.geometry.rotations import geodesic_angle, vector_to_matrix
from probmotion.motion import camera_trajectories
from probmotion.motion.camera_trajectories import _Objective, fit_trajectory
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
    """Positions of a body that walks an arc of 3 m and waves, metres, (L, J, 3)."""
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


def mean_error(result, truth):
    """Mean distance, metres."""
    return np.linalg.norm(result.positions - truth, axis=-1).mean()


def track_of(keypoints, confidence=None):
    confidence = np.ones(keypoints.shape[:2]) if confidence is None else confidence
    return KeypointTrack(keypoints, confidence, SKELETON, 30.0)


def test_exact_detections_recover_the_trajectory(truth, camera):
    local = local_of(truth, camera)
    track = track_of(camera.project(truth)[0])
    exact = fit_trajectory(local, track, camera, smoothness_weight=0.01)
    assert exact.converged
    assert np.abs(exact.positions - truth).max() < 1e-3
    origin = truth[:, 0] @ camera.rotation[0].T + camera.translation[0]
    np.testing.assert_allclose(exact.translations, origin, atol=1e-3)
    np.testing.assert_allclose(exact.orientations, 0, atol=1e-3)
    # Smoothing affects mainly the ends.
    default = fit_trajectory(local, track, camera)
    assert mean_error(default, truth) < 0.02
    assert np.abs(default.positions - truth)[8:-8].max() < 0.02
    # The defaults scale with the image unit.
    unit = Cameras(
        camera.rotation, camera.translation, np.ones(1), camera.centre / FOCAL, orthographic=False
    )
    slopes = fit_trajectory(local, track_of(unit.project(truth)[0]), unit)
    np.testing.assert_allclose(slopes.positions, default.positions, atol=1e-6)
    assert slopes.cost == pytest.approx(default.cost / FOCAL**2, rel=1e-6)
    assert not fit_trajectory(local, track, camera, max_iterations=1).converged


def outliers(keypoints, rng, fraction):
    """Move a fraction of the detections by up to 500 pixels to one side of the image."""
    chosen = rng.random(keypoints.shape[:2]) < fraction
    moved = keypoints.copy()
    moved[chosen] += rng.uniform(100, 500, size=(chosen.sum(), 2))
    return moved


def test_scale_schedule_avoids_local_minima(truth, camera, rng, monkeypatch):
    turns = vector_to_matrix(0.3 * rng.normal(size=(L, 3)))
    local = np.einsum("lab,ljb->lja", turns, local_of(truth, camera))
    track = track_of(outliers(camera.project(truth)[0], rng, 0.3))
    scheduled = fit_trajectory(local, track, camera, scale=15.0)
    monkeypatch.setattr(camera_trajectories, "_SCHEDULE", (1.0,))
    direct = fit_trajectory(local, track, camera, scale=15.0)
    assert mean_error(scheduled, truth) < 0.05
    assert scheduled.cost < direct.cost
    assert mean_error(direct, truth) > 0.5


def test_orientations_are_corrected(truth, camera, rng):
    local = local_of(truth, camera)
    turns = vector_to_matrix(0.25 * rng.normal(size=(L, 3)))
    noisy = np.einsum("lab,ljb->lja", turns, local)
    keypoints = camera.project(truth)[0] + 2 * rng.normal(size=(L, J, 2))
    result = fit_trajectory(noisy, track_of(keypoints), camera)
    before = np.linalg.norm(noisy - local, axis=-1).mean()
    after = result.positions - result.positions[:, :1] - (truth - truth[:, :1])
    assert np.linalg.norm(after, axis=-1).mean() < before / 4
    remaining = geodesic_angle(vector_to_matrix(result.orientations), np.swapaxes(turns, -1, -2))
    assert np.median(remaining) < 0.1


@pytest.mark.parametrize("missing", [slice(15, 25), slice(0, 6), slice(34, L)])
def test_missing_frames_are_interpolated_smoothly(truth, camera, missing):
    confidence = np.ones((L, J))
    confidence[missing] = 0
    keypoints = camera.project(truth)[0]
    keypoints[missing] = np.nan
    result = fit_trajectory(local_of(truth, camera), track_of(keypoints, confidence), camera)
    if missing == slice(15, 25):
        errors = np.linalg.norm(result.positions - truth, axis=-1).mean(axis=1)
        assert errors[missing].max() < 0.06
    steps, true_steps = (
        np.linalg.norm(np.diff(positions.mean(axis=1), axis=0), axis=-1)
        for positions in (result.positions, truth)
    )
    assert steps.max() < 1.5 * true_steps.max()
    # Without detections at the ends, the smoothest motion is static there.
    if missing.start == 0:
        assert steps[:4].max() < 0.3 * true_steps[:4].max()


def test_detections_of_confidence_zero_are_ignored(truth, camera):
    keypoints = camera.project(truth)[0]
    confidence = np.ones((L, J))
    confidence[::3, 2] = confidence[:, 5] = 0
    seen = confidence[..., None] > 0
    first, second = (
        fit_trajectory(
            local_of(truth, camera), track_of(np.where(seen, keypoints, other), confidence), camera
        )
        for other in (1e5, np.nan)
    )
    np.testing.assert_array_equal(first.positions, second.positions)
    assert mean_error(first, truth) < 0.02


def test_cost_is_equation_12(truth, camera, rng):
    """Recomputed from the result with the camera's own projection."""
    local = local_of(truth, camera)
    confidence = rng.uniform(0, 1, size=(L, J))
    y = camera.project(truth)[0] + 5 * rng.normal(size=(L, J, 2))
    track = track_of(y, confidence)
    result = fit_trajectory(local, track, camera, scale=8.0, smoothness_weight=300.0)
    turns = vector_to_matrix(result.orientations)
    points = np.einsum("lab,ljb->lja", turns, local) + result.translations[:, None]
    world = np.einsum("ba,ljb->lja", camera.rotation[0], points - camera.translation[0])
    np.testing.assert_allclose(result.positions, world, atol=1e-12)
    error = np.linalg.norm(camera.project(world)[0] - y, axis=-1)
    robust = 8.0**2 * error**2 / (8.0**2 + error**2)
    smooth = (np.linalg.norm(points[1:] - points[:-1], axis=-1) ** 2).sum()
    assert result.cost == pytest.approx((confidence * robust).sum() + 300 * smooth)


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
    translations[2, 2] = -0.5  # some joints are behind the camera
    orientations = size * rng.normal(size=(frames, 3))
    assert (objective.points(translations, orientations)[..., 2] < 0.1).any()
    point = np.concatenate([translations, orientations], axis=1).ravel()
    for scale in (30.0, 1e6):

        def part(index, scale=scale):
            return lambda x: objective.cost_and_gradient(x, scale)[index]

        error = check_grad(part(0), part(1), point, epsilon=1e-7)
        assert error < 2e-5 * np.linalg.norm(part(1)(point))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"local": np.zeros((L, J, 2))}, r"local must have shape \(40, 9, 3\), got \(40, 9, 2\)"),
        ({"local": np.full((L, J, 3), np.inf)}, "local must be finite, got 1080 values"),
        ({"camera": Cameras.ring(1)}, "camera must be perspective"),
        ({"camera": Cameras.ring(2, perspective=True)}, "camera must have one view, got 2"),
        ({"scale": 0.0}, "scale must be a finite number above 0, got 0.0"),
        ({"smoothness_weight": 0.0}, "smoothness_weight must be a finite number above 0, got 0.0"),
        ({"max_iterations": 0}, "max_iterations must be an integer of at least 1, got 0"),
        ({"track": track_of(np.zeros((L, J, 2)), np.zeros((L, J)))}, "in front of the camera in"),
    ],
)
def test_invalid_input_is_refused(truth, camera, change, message):
    arguments = {"local": local_of(truth, camera), "track": track_of(camera.project(truth)[0])}
    with pytest.raises(ValueError, match=message):
        fit_trajectory(**(arguments | {"camera": camera} | change))
    reflected = track_of(2 * camera.centre[0] - camera.project(truth)[0])
    with pytest.raises(ValueError, match="track must determine a position in front of the camera"):
        fit_trajectory(arguments["local"], reflected, camera)
