"""3D poses that another program has predicted from 2D ones, as an ``.npz`` archive.

=================  =========================  =====================================================
key                shape                      meaning
=================  =========================  =====================================================
``positions``      (N, L, J, 3), (L, J, 3)    metres; N motions of L frames
``joint_names``    (J,)                       strings
``fps``            ()                         frames per second
``up_axis``        (), optional               ``"y"`` (where absent) or ``"z"``
=================  =========================  =====================================================
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from probmotion.io.errors import MotionFileError
from probmotion.io.npz import Archive
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["read_predictions"]


def read_predictions(
    path: str | Path, skeleton: Skeleton, frames: int | None = None, fps: float | None = None
) -> np.ndarray:
    """Read the 3D motions that another program, a lifter for example, has predicted.

    Parameters
    ----------
    path : str or Path
        The archive; its keys are in this module's description.
    skeleton : Skeleton
        The J joints to have, found among the file's by their (canonical) names; others are left
        out.
    frames : int, optional
        Cut every motion into as many windows of this length as fit, one after the other; what is
        left at its end is dropped. Whole motions by default.
    fps : float, optional
        Resample to this rate, before windows are cut; the file's own rate by default.

    Returns
    -------
    ndarray, (N, L, J, 3)
        Metres, Y up, the first root at the origin in every frame.

    Raises
    ------
    MotionFileError
        If the file is no such archive, is damaged, lacks a joint or has too few frames; the
        message names the key.
    FileNotFoundError
        If there is no such file.
    ValueError
        If ``frames`` or ``fps`` is out of range.
    """
    if frames is not None:
        check_count("frames", frames)
    if fps is not None:
        check_positive("fps", fps)
    archive = Archive(Path(path))
    motions = [_on(motion, skeleton, fps, archive) for motion in _motions(archive)]
    positions = np.stack(motions)
    root = skeleton.roots[0]
    positions = positions - positions[:, :, root : root + 1]
    if frames is None:
        return positions
    windows = positions.shape[1] // frames
    if windows == 0:
        archive.fail(
            f"positions has {positions.shape[1]} frames"
            f"{'' if fps is None else f' at {fps:g} frames per second'}, expected at least {frames}"
        )
    return positions[:, : windows * frames].reshape(-1, frames, *positions.shape[2:])


def _motions(archive: Archive) -> list[Motion]:
    """Return the file's motions, Y up, on a skeleton that has its names and no bones."""
    for key in ("positions", "joint_names", "fps"):
        if key not in archive.keys:
            found = ", ".join(name[:40] for name in archive.keys[:12]) or "none"
            archive.fail(
                f"key {key} is missing, expected positions, joint_names and fps; the keys found "
                f"are {found}"
            )
    positions = archive.numbers("positions")
    if positions.ndim not in (3, 4) or positions.shape[-1] != 3 or 0 in positions.shape:
        archive.fail(
            f"positions has shape {positions.shape}, expected (N, L, J, 3) or (L, J, 3) with at "
            "least one of each"
        )
    missing = ~np.isfinite(positions)
    if missing.any():
        where = tuple(int(index) for index in np.argwhere(missing)[0])
        archive.fail(
            f"positions must be finite, got {missing.sum()} values that are NaN, the first at index {where}, "
            "expected a position for every joint and frame"
        )
    n_joints = positions.shape[-2]
    names = archive.names("joint_names", "joint", n_joints)
    rate = archive.frame_rate()
    turn = archive.turn_to_y_up()
    if turn is not None:
        positions = positions @ turn.T
    try:
        boneless = Skeleton(names, [-1] * n_joints)
        return [
            Motion(clip, boneless, rate) for clip in positions.reshape(-1, *positions.shape[-3:])
        ]
    except ValueError as error:
        raise MotionFileError(f"{archive.path}: {error}") from error


def _on(motion: Motion, skeleton: Skeleton, fps: float | None, archive: Archive) -> np.ndarray:
    """Return a motion's positions on the skeleton asked for, at the rate asked for."""
    try:
        found = motion.retarget(skeleton)
    except ValueError as error:
        raise MotionFileError(f"{archive.path}: {error}") from error
    return (found if fps is None else found.resample(fps)).positions
