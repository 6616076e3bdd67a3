import numpy as np
import pytest

from probmotion.lifting.camera import LevelCamera


@pytest.fixture
def camera() -> LevelCamera:
    return LevelCamera(900.0, (640.0, 360.0), -0.3)


def test_rays_and_projections_are_inverse(camera):
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(5, 4, 3)) - [0.0, 0.0, 5.0]
    assert np.allclose(camera.points(camera.project(positions), camera.depth(positions)), positions)
    assert np.allclose(camera.normalised(camera.pixels(positions)), camera.project(positions))


def test_linearisation_has_the_derivative_of_the_projection(camera):
    rng = np.random.default_rng(1)
    at = rng.normal(size=(6, 3)) - [0.0, 0.0, 5.0]
    change = 1e-6 * rng.normal(size=at.shape)
    matrix, target = camera.linearised(at, camera.project(at + change))
    assert np.allclose((matrix @ change[..., None])[..., 0], target, atol=1e-11)
    # A X = t holds at the point of linearisation if its projection was observed.
    assert np.allclose((matrix @ at[..., None])[..., 0], 0.0, atol=1e-12)


def test_greater_pitch_looks_up():
    level, up = LevelCamera(900.0, (0.0, 0.0)), LevelCamera(900.0, (0.0, 0.0), 0.2)
    ahead = np.array([0.0, 0.0, -4.0])
    assert level.pixels(ahead)[1] == 0.0
    assert up.pixels(ahead)[1] > 0.0  # below the middle of the image
