"""A clip at another frame rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from probmotion.checks import check_positive
from probmotion.motion import Motion
from probmotion.rotations import slerp

__all__ = ["resample_motion"]

# New frames by which a clip may miss a whole number and still get its last one: files round their
# frame times (0.0083333 s), which would cost the last frame of every clip.
_HIGHEST_FPS = 10_000
_ROUNDING = 1e-3


def resample_motion(motion: Motion, fps: float) -> Motion:
    """Return the clip at another frame rate.

    The first frame stays; the last is the last one of the new rate that is not after the clip's
    end, so that nothing is extrapolated and the duration is kept to within one new frame. (One
    that is later by less than a thousandth of a frame is the clip's last.)
    Positions are interpolated linearly and local rotations along the geodesic; where both are
    given, the positions of a frame between two old ones are those of the joints' straight paths.

    Parameters
    ----------
    motion : Motion
        The clip. One of a single frame keeps that frame.
    fps : float
        Frames per second.

    Raises
    ------
    ValueError
        If ``fps`` is not a number above 0 and at most 10 000.
    """
    check_positive("fps", fps)
    if fps > _HIGHEST_FPS:
        raise ValueError(f"fps is {fps:g}, expected at most {_HIGHEST_FPS} frames per second")
    if fps == motion.fps:
        return motion
    frames = int(np.floor(motion.duration * fps + _ROUNDING)) + 1
    time = np.minimum(np.arange(frames) * (motion.fps / fps), motion.frames - 1.0)
    before = np.minimum(time.astype(int), max(motion.frames - 2, 0))
    after = np.minimum(before + 1, motion.frames - 1)
    fraction = time - before
    weight = fraction[:, None, None]
    positions = (1 - weight) * motion.positions[before] + weight * motion.positions[after]
    rotations = motion.rotations
    if rotations is not None:
        rotations = slerp(rotations[before], rotations[after], fraction[:, None])
    return replace(motion, positions=positions, fps=float(fps), rotations=rotations)
