"""Made videos of clips."""

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import PERSON


@pytest.mark.parametrize("fov", [40.0, 90.0])
def test_a_video_shows_the_motion_at_its_field_of_view(fov):
    video = film(make_gait("walk", 0, frames=30), 0, azimuth=0.5, height=2.0, fov=fov)
    pitch = -float(video.camera.elevation[0])
    camera = LevelCamera(500 / np.tan(np.radians(fov / 2)), (500.0, 500.0), pitch)
    names = video.track.skeleton.joint_names
    both = [name for name in PERSON.joint_names if name in names]
    pixels = camera.pixels(video.motion.positions[:, [PERSON.joint_names.index(n) for n in both]])
    seen = video.track.keypoints[:, [names.index(n) for n in both]]
    # Noise of 4 pixels in either direction; outliers and gaps are few.
    assert np.nanmedian(np.linalg.norm(seen - pixels, axis=-1)) == pytest.approx(4.7, abs=1)
    assert np.isfinite(seen).mean() > 0.85
