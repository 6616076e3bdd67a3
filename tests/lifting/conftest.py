"""A made video of a marching person, its lift, and the prior of its windows."""

from __future__ import annotations

import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import Video, film
from probmotion.lifting import Lift, lift
from probmotion.lifting.window_prior import WindowPrior
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion


@pytest.fixture(scope="session")
def video() -> Video:
    """Return the video of a person who walks past a camera for three seconds."""
    return film(make_gait("walk", 3, frames=90), 0, azimuth=0.8, height=1.4)


@pytest.fixture(scope="session")
def lifted(video: Video) -> Lift:
    """Return the lift of the video."""
    return lift(video.track, image_size=video.size, progress=False, draws=40)


@pytest.fixture(scope="session")
def window_prior() -> WindowPrior:
    """Return the prior of windows of 20 frames at 10 frames per second."""
    return WindowPrior(SpectralMixtureMotion.load("cmu-motion"), 20, 10.0)
