"""Triangulation: agreement with SciPy and between array libraries, errors and warnings."""

import warnings

import numpy as np
import pytest
from scipy.optimize import least_squares

from probmotion import Cameras, triangulate

RINGS = {
    "orthographic": Cameras.ring(5, elevation=0.3),
    "perspective": Cameras.ring(5, elevation=0.3, perspective=True),
    "pixels": Cameras(
        rotation=Cameras.ring(3, elevation=0.3).rotation,
        translation=np.array([[0.1, -0.2, 4.0], [0.3, 0.0, 6.0], [-0.2, 0.1, 5.0]]),
        focal=np.array([900.0, 1100.0, 1000.0]),
        centre=np.array([[640.0, 360.0], [500.0, 300.0], [0.0, 10.0]]),
        orthographic=False,
    ),
}


def motion(*shape, seed=0):
    return 0.4 * np.random.default_rng(seed).normal(size=(*shape, 3))


@pytest.fixture(params=RINGS)
def cameras(request):
    return RINGS[request.param]


def test_exact_projections_recover_the_points(cameras, library):
    points = motion(2, 1, 4, 3)
    if library.dtype == "float32" and cameras.focal[0] > 100:
        pytest.skip("single precision does not resolve micrometres in pixels")
    run = library.compiled(lambda keypoints: triangulate(keypoints, cameras))
    library.assert_close(run(library.array(cameras.project(points))), points)


def test_libraries_agree_on_noisy_weighted_keypoints(cameras, library):
    points = motion(6, 4)
    rng = np.random.default_rng(1)
    noise = 0.05 * cameras.focal[0] / (1 if cameras.orthographic else 7)
    seen = cameras.project(points) + noise * rng.normal(size=(cameras.n_views, 6, 4, 2))
    weights = rng.uniform(0.2, 2, size=seen.shape[:-1])
    start = points + 0.05 * rng.normal(size=points.shape)
    expected = triangulate(seen, cameras, weights, start, iterations=3)

    def run(images, weight, initial):
        return triangulate(images, cameras, weight, initial, iterations=3)

    got = library.compiled(run)(*(library.array(x) for x in (seen, weights, start)))
    # In single precision, metres from hundreds of pixels are less accurate.
    tolerance = 1e-3 if library.dtype == "float32" and noise > 1 else library.tolerance
    library.assert_close(got, expected, tolerance)


def scipy_solution(seen, cameras, weights):
    """Return argmin_X Σ_v w_v ‖p(X, v) − x_v‖² for one joint, by SciPy."""
    root = np.sqrt(weights)[:, None]

    def residual(x):
        return (root * (cameras.project(x.reshape(1, 1, 3))[:, 0, 0] - seen)).ravel()

    return least_squares(residual, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15).x


def test_result_is_the_least_squares_solution(cameras):
    rng = np.random.default_rng(2)
    points = motion(3, 2)
    noise = 0.05 * cameras.focal[0] / (1 if cameras.orthographic else 5)
    seen = cameras.project(points) + noise * rng.normal(size=(cameras.n_views, 3, 2, 2))
    weights = rng.uniform(0.2, 2, size=seen.shape[:-1])
    result = triangulate(seen, cameras, weights, iterations=30)
    for frame, joint in np.ndindex(3, 2):
        expected = scipy_solution(seen[:, frame, joint], cameras, weights[:, frame, joint])
        np.testing.assert_allclose(result[frame, joint], expected, atol=2e-7)
        assert np.linalg.norm(expected - points[frame, joint]) > 1e-3


@pytest.mark.parametrize("initial", [True, False])
def test_two_iterations_suffice_from_5_cm(initial):
    rng = np.random.default_rng(3)
    cameras = Cameras.ring(5, elevation=0.2, perspective=True)
    points = motion(180, 16)
    seen = cameras.project(points) + 0.02 * rng.normal(size=(5, 180, 16, 2))
    start = points + 0.05 * rng.normal(size=points.shape) if initial else None
    best = triangulate(seen, cameras, initial=start, iterations=50)
    one, two = (triangulate(seen, cameras, initial=start, iterations=n) - best for n in (1, 2))
    assert np.sqrt((two**2).mean()) < 7e-6
    assert np.sqrt((two**2).mean()) < np.sqrt((one**2).mean()) / 20


def test_weight_two_equals_a_repeated_view(cameras):
    rng = np.random.default_rng(4)
    seen = cameras.project(motion(3, 2)) * (1 + 0.01 * rng.normal(size=(cameras.n_views, 3, 2, 1)))
    twice = [0, *range(cameras.n_views)]
    parts = (cameras.rotation, cameras.translation, cameras.focal, cameras.centre)
    doubled = Cameras(*(part[twice] for part in parts), cameras.orthographic)
    expected = triangulate(seen[twice], doubled, iterations=20)
    weights = np.ones(cameras.n_views)
    weights[0] = 2
    full = np.broadcast_to(weights[:, None, None], seen.shape[:-1])
    for shaped in (weights, np.stack([weights] * 2), np.stack([full] * 2)):
        got = triangulate(np.stack([seen, seen + 0.01]), cameras, shaped, iterations=20)
        np.testing.assert_allclose(got[0], expected, atol=1e-9)


EAGER = [(name, "float32") for name in ("numpy", "torch", "jax", "strict")]


@pytest.mark.parametrize("library", EAGER, indirect=True, ids="-".join)
def test_keypoints_of_weight_zero_are_ignored(library):
    # Without jit, values are checked in JAX as well.
    cameras = RINGS["perspective"]
    points = motion(3, 2)
    seen = cameras.project(points)
    weights = np.ones(seen.shape[:-1])
    weights[0, 1, 1] = 0
    seen[0, 1, 1] = np.nan
    library.assert_close(triangulate(library.array(seen), cameras, library.array(weights)), points)


def test_gradients_agree_with_finite_differences(differentiable):
    cameras = Cameras.ring(4, elevation=0.4, perspective=True)
    seen = cameras.project(motion(1, 2))
    direction = np.random.default_rng(5).normal(size=seen.shape)

    def total(images):
        result = triangulate(images, cameras, iterations=2)
        return (result * result).sum()

    slope = (differentiable.gradient(total, seen) * direction).sum()
    step = 1e-6
    numerical = (total(seen + step * direction) - total(seen - step * direction)) / (2 * step)
    assert slope == pytest.approx(numerical, rel=1e-6)


def test_empty_batches_yield_empty_results(cameras):
    for *batch, L, J in [(0, 4, 3), (4, 0), (0, 3)]:
        points = triangulate(np.zeros((*batch, cameras.n_views, L, J, 2), np.float32), cameras)
        assert (points.shape, points.dtype) == ((*batch, L, J, 3), np.float32)


@pytest.mark.parametrize("perspective", [False, True])
def test_nearly_parallel_views_warn_with_condition_number(perspective):
    points = motion(2, 2)
    wide, narrow = (
        Cameras.around(np.array([0.0, angle]), np.zeros(2), perspective=perspective)
        for angle in (0.1, 0.02)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        triangulate(wide.project(points), wide)
    with pytest.warns(UserWarning, match="nearly parallel") as caught:
        result = triangulate(narrow.project(points), narrow)
    np.testing.assert_allclose(result, points, atol=1e-9)
    condition = float(str(caught[0].message).split("number ")[1].split(" at")[0])
    if perspective:
        assert 5e3 < condition < 5e4
    else:
        normal = np.einsum("vcx,vcy->xy", narrow.image_axes, narrow.image_axes)
        assert condition == pytest.approx(np.linalg.cond(normal), rel=1e-2)


@pytest.mark.parametrize("angle", [0.0, np.pi])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_parallel_views_are_refused(angle, dtype):
    cameras = Cameras.around(np.array([0.4, 0.4 + angle]), np.array([0.2, -0.2 if angle else 0.2]))
    seen = cameras.project(motion(2, 2)).astype(dtype)
    with pytest.raises(ValueError, match=r"keypoints of joint \d in frame \d do not determine"):
        triangulate(seen, cameras)


def test_error_names_a_joint_seen_in_a_single_view(cameras):
    weights = np.ones((cameras.n_views, 3, 4))
    weights[1:, 2, 3] = 0
    with pytest.raises(ValueError, match="joint 3 in frame 2 do not determine a point"):
        triangulate(cameras.project(motion(3, 4)), cameras, weights)


@pytest.mark.parametrize("initial", [False, True])
def test_nonfinite_keypoints_are_refused(cameras, initial):
    points = motion(3, 4)
    keypoints = cameras.project(points)
    keypoints[1, 2, 3, 0] = np.nan
    with pytest.raises(ValueError, match=r"keypoints must be finite, got 1 .* \(1, 2, 3, 0\)"):
        triangulate(keypoints, cameras, initial=points if initial else None)


POINTS = motion(3, 4)
SEEN = RINGS["perspective"].project(POINTS)
BEHIND = POINTS.copy()
BEHIND[1, 1] = -15 * RINGS["perspective"].rotation[0, 2]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": Cameras.ring(1)}, "cameras must contain at least two views, got 1"),
        ({"keypoints": SEEN[:-1]}, r"keypoints must have shape \(…, 5, L, J, 2\), got"),
        ({"weights": np.ones(7)}, r"weights must have shape \(5, 3, 4\), got \(7,\)"),
        ({"weights": -np.ones(5)}, "weights must be 0 or more, got -1"),
        ({"initial": POINTS[:2]}, r"initial must have shape \(3, 4, 3\), got \(2, 4, 3\)"),
        ({"initial": BEHIND, "iterations": 1}, "got joint 1 of frame 1 behind camera 0"),
        ({"iterations": 0}, "iterations must be an integer of at least 1, got 0"),
    ],
)
def test_invalid_input_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        triangulate(**({"keypoints": SEEN, "cameras": RINGS["perspective"]} | changes))
