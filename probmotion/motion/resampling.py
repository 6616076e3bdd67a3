"""Resampling of positions and rotations to another frame rate."""

from __future__ import annotations

import numpy as np

from probmotion.geometry.rotations import slerp
from probmotion.validation import check_positive

__all__ = ["resample"]

# New frames by which a clip may miss a whole number and still get its last one: files round their
# frame times (0.0083333 s), which would cost the last frame of every clip.
_HIGHEST_FPS = 10_000
_ROUNDING = 1e-3


def resample(
    positions: np.ndarray, rotations: np.ndarray | None, old_fps: float, fps: float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions and rotations at another frame rate.

    The first frame stays; the last is the last one of the new rate that is not after the clip's
    end, so that nothing is extrapolated and the duration is kept to within one new frame. (One
    that is later by less than a thousandth of a frame is the clip's last.)
    Positions are interpolated linearly and local rotations along the geodesic.

    Parameters
    ----------
    positions : ndarray, (L, J, 3)
        Of the clip. One of a single frame keeps that frame.
    rotations : ndarray, (L, J, 3, 3), optional
        Local rotations.
    old_fps, fps : float
        Frames per second, before and after.

    Raises
    ------
    ValueError
        If ``fps`` is not a number above 0 and at most 10 000.
    """
    check_positive("fps", fps)
    if fps > _HIGHEST_FPS:
        raise ValueError(f"fps must be at most {_HIGHEST_FPS} frames per second, got {fps:g}")
    if fps == old_fps:
        return positions, rotations
    last = len(positions) - 1
    # The clip's duration first, then its frames: the order decides the last bit.
    frames = int(np.floor(last / old_fps * fps + _ROUNDING)) + 1
    time = np.minimum(np.arange(frames) * (old_fps / fps), float(last))
    before = np.minimum(time.astype(int), max(last - 1, 0))
    after = np.minimum(before + 1, last)
    fraction = time - before
    weight = fraction[:, None, None]
    between = (1 - weight) * positions[before] + weight * positions[after]
    if rotations is not None:
        rotations = slerp(rotations[before], rotations[after], fraction[:, None])
    return between, rotations
