"""Reader of 3D motions predicted by another program, from ``.npz`` archives.

=================  =========================  =====================================================
key                shape                      meaning
=================  =========================  =====================================================
``positions``      (N, L, J, 3), (L, J, 3)    metres; N motions of L frames
``joint_names``    (J,)                       strings
``fps``            ()                         frames per second
``up_axis``        (), optional               ``"y"`` (default) or ``"z"``
=================  =========================  =====================================================
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probmotion.io.errors import errors_in
from probmotion.io.npz import Archive
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_positive

__all__ = ["read_predictions"]


def read_predictions(
    path: str | Path, skeleton: Skeleton, frames: int | None = None, fps: float | None = None
) -> np.ndarray:
    """Read 3D motions predicted by another program, such as a lifter.

    Parameters
    ----------
    path : str or Path
        An ``.npz`` archive with the keys listed in the module docstring.
    skeleton : Skeleton
        Skeleton of the J joints to return, matched by name or canonical name.
    frames : int, optional
        Length of the windows into which motions are split; the remainder is dropped. By default,
        motions are not split.
    fps : float, optional
        Frames per second to resample to before splitting; the file's rate by default.

    Returns
    -------
    ndarray, (N, L, J, 3)
        Joint positions, metres, Y up, with the first root at the origin in every frame.

    Raises
    ------
    MotionFileError
        If the file has another format, is damaged, lacks a joint or has too few frames.
    ValueError
        If ``frames`` or ``fps`` is out of range.
    """
    if frames is not None:
        check_count("frames", frames)
    if fps is not None:
        check_positive("fps", fps)
    archive = Archive(Path(path))
    with errors_in(archive.path):
        motions = [motion.retarget(skeleton) for motion in _motions(archive)]
    positions = np.stack([(m if fps is None else m.resample(fps)).positions for m in motions])
    root = skeleton.roots[0]
    positions = positions - positions[:, :, root : root + 1]
    if frames is None:
        return positions
    windows = positions.shape[1] // frames
    if windows == 0:
        at_rate = "" if fps is None else f" at {fps:g} frames per second"
        archive.fail(
            f"positions must have at least {frames} frames, got {positions.shape[1]}{at_rate}"
        )
    return positions[:, : windows * frames].reshape(-1, frames, *positions.shape[2:])


def _motions(archive: Archive) -> list[Motion]:
    """Return the motions of the file, Y up, on a skeleton without bones."""
    positions = archive.points("positions", "(L, J, 3) or (N, L, J, 3)")
    n_joints = positions.shape[-2]
    boneless = Skeleton(archive.names("joint_names", None, n_joints), [-1] * n_joints)
    rate = archive.frame_rate()
    turn = archive.turn_to_y_up()
    check_finite("positions", positions)
    if turn is not None:
        positions = positions @ turn.T
    return [Motion(clip, boneless, rate) for clip in positions.reshape(-1, *positions.shape[-3:])]
