"""Resampling of positions and rotations to another frame rate."""

from __future__ import annotations

import numpy as np

from probmotion.geometry.rotations import slerp
from probmotion.validation import check_positive

__all__ = ["resample"]

_HIGHEST_FPS = 10_000  # highest accepted frame rate
# Tolerance in frames at the end of a clip. Without it, resampling would drop the last frame if the
# frame time is rounded in the file (0.0083333 s).
_ROUNDING = 1e-3


def resample(
    positions: np.ndarray, rotations: np.ndarray | None, old_fps: float, fps: float
) -> tuple[np.ndarray, np.ndarray | None]:
    """Resample positions (L, J, 3) and rotations (L, J, 3, 3) to another frame rate.

    Positions are interpolated linearly and rotations along the geodesic. The first frame is
    unchanged. Nothing is extrapolated, so the clip is shortened by less than one new frame.

    Raises
    ------
    ValueError
        If ``fps`` is not above 0 and at most 10 000.
    """
    check_positive("fps", fps)
    if fps > _HIGHEST_FPS:
        raise ValueError(f"fps must be at most {_HIGHEST_FPS} frames per second, got {fps:g}")
    if fps == old_fps:
        return positions, rotations
    last = len(positions) - 1
    frames = int(np.floor(last / old_fps * fps + _ROUNDING)) + 1
    time = np.minimum(np.arange(frames) * (old_fps / fps), float(last))
    before = np.minimum(time.astype(int), max(last - 1, 0))
    after = np.minimum(before + 1, last)
    fraction = time - before
    weight = fraction[:, None, None]
    resampled = (1 - weight) * positions[before] + weight * positions[after]
    if rotations is not None:
        rotations = slerp(rotations[before], rotations[after], fraction[:, None])
    return resampled, rotations
