import numpy as np
import pytest

from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.checks import Evidence, check_upright, checked
from probmotion.lifting.keypoints import ANKLES, SHOULDERS, BodyPath, PersonKeypoints

FPS, DEPTH, FOCAL = 30.0, 8.0, 900.0
FAST = 3.0  # of feet, metres per second


def unsteadiness(
    x: np.ndarray, *, feet: float = FAST, noise: float = 0.01, weight: float = 1.0
) -> float:
    """Return the check of a body at x(t), metres, with feet of a speed and noise in pixels."""
    rng, times = np.random.default_rng(0), np.arange(len(x)) / FPS
    positions = np.zeros((len(x), 14, 3))
    positions[..., 0], positions[..., 2] = x[:, None], -DEPTH
    positions[:, ANKLES, 0] = feet * times[:, None]
    points = 500 + FOCAL / DEPTH * positions[..., :2]
    points += noise / np.sqrt(weight) * rng.standard_normal(points.shape)
    keypoints = PersonKeypoints(points, np.full(points.shape[:2], weight), 0.0)
    camera = LevelCamera(FOCAL, (500.0, 500.0))
    checks = checked(Evidence(keypoints, FPS, camera, noise, positions, 0.0))
    return {check.name: check.value for check in checks}["unsteady"]


def test_people_may_run_and_change_their_speed_steadily():
    times = np.arange(150) / FPS
    assert unsteadiness(2 * times + 0.4 * times**2) == pytest.approx(0.0, abs=1e-3)


def test_unsteadiness_is_the_median_deviation_of_velocities():
    swing = 0.08 * np.sin(2 * np.pi * np.arange(900) / FPS)
    # The median of a cosine's absolute value; velocities are mean ones of 2/15 s.
    expected = 0.08 * 2 * np.pi * np.cos(np.pi / 4) * np.sinc(2 / 15)
    assert unsteadiness(swing) == pytest.approx(expected, rel=0.1)
    assert unsteadiness(swing, noise=4.0) == pytest.approx(expected, rel=0.3)
    assert unsteadiness(swing, feet=0.0, noise=4.0) < 0.05


def test_noise_alone_is_not_unsteady():
    assert unsteadiness(np.zeros(900), noise=4.0) < 0.05
    assert unsteadiness(np.zeros(900), noise=2.0, weight=0.25) < 0.05


@pytest.mark.parametrize(
    ("ankles", "frames", "refused"),
    [(1.2, 40, True), (0.6, 40, False), (-1.2, 40, False), (1.2, 4, False)],
)
def test_people_are_upside_down_if_ankles_are_far_above_shoulders(ankles, frames, refused):
    points, weight = np.zeros((40, 14, 2)), np.zeros((40, 14))
    points[:, SHOULDERS, 1], points[:, ANKLES, 1] = 500.0, 500.0 - 100 * ankles
    weight[:, SHOULDERS], weight[:frames, ANKLES[0]] = 1.0, 1.0  # one ankle is never seen
    path = BodyPath(np.zeros((40, 2)), np.full(40, 100.0))
    keypoints = PersonKeypoints(points, weight, 0.0)
    if not refused:
        check_upright(keypoints, path)
        return
    with pytest.raises(ValueError, match=r"shoulders 1\.2 m below the ankles; flip them: --flip y"):
        check_upright(keypoints, path)
