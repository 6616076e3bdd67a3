"""Reader and writer of motions and keypoint tracks in ``.npz`` archives, without pickles.

Keys of a motion:

======================  ==========================  ================================================
key                     shape                       meaning
======================  ==========================  ================================================
``positions``           (L, J, 3) or (L, P, J, 3)   metres; P people with the same skeleton
``fps``                 ()                          frames per second
``joint_names``         (J,)                        strings
``parents``             (J,)                        integers, -1 for a root
``up_axis``             (), optional                ``"y"`` (default) or ``"z"``
``persons``             (P,), optional              names of the people
``rotations``           (L, J, 3, 3), optional      local rotation matrices
``rest_offsets``        (J, 3), optional            metres, with ``rotations``
``radii``               (J,), optional              metres, bone radii
``name``                (), optional                name of the clip
======================  ==========================  ================================================

Keys of keypoint tracks: ``keypoints`` (L, J, 2) and ``confidence`` (L, J), with a leading axis V
for V ``camera_names``; ``fps``, ``joint_names`` and ``parents``. Other keys are ignored.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from probmotion.files import member_array, open_archive, written_whole
from probmotion.io.conventions import Z_UP_TO_Y_UP, y_up
from probmotion.io.errors import (
    LARGEST,
    MotionFileError,
    MotionFileWarning,
    errors_in,
    read_bytes,
    shortened,
)
from probmotion.motion.motion import JointTrack, KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_shape

__all__ = ["Archive", "read_joint_npz", "read_keypoint_npz", "read_npz", "write_npz"]


def read_npz(path: str | Path, up: str | None = None) -> Motion:
    """Read a motion from an ``.npz`` archive.

    Several people form one skeleton, with one root per person and joints named ``person:joint``.
    Z-up positions are rotated to Y up about the x axis; ``up`` overrides ``up_axis``. Joints
    without a position in any frame are dropped with a :class:`MotionFileWarning`.

    Raises
    ------
    MotionFileError
        If the file has another format or is damaged.
    """
    archive = Archive(Path(path))
    if "positions" not in archive.keys and "keypoints" in archive.keys:
        archive.fail("expected positions, got keypoints; use read_keypoints for 2D")
    positions = archive.points("positions", "(L, J, 3) or (L, P, J, 3)")
    skeleton = archive.skeleton(positions.shape[-2])
    fps = archive.frame_rate()
    turn = archive.turn_to_y_up(up)
    with errors_in(archive.path):
        if positions.ndim == 4:
            skeleton = _crowd(skeleton, archive.names("persons", "person", positions.shape[1]))
            positions = positions.reshape(len(positions), -1, 3)
        positions, skeleton = _without_unseen(positions, skeleton, archive.path)
        rotations, rest_offsets = archive.kinematics(*positions.shape[:2])
        motion = Motion(
            positions,
            skeleton,
            fps,
            rotations=rotations,
            rest_offsets=rest_offsets,
            name=archive.word("name", archive.path.stem),
        )
        return motion if turn is None else y_up(motion)


def read_joint_npz(path: str | Path, up: str | None = None) -> JointTrack:
    """Read the joints of one person from an ``.npz`` archive; NaN positions are gaps.

    Axes are converted as by :func:`read_npz`.

    Raises
    ------
    MotionFileError
        If the file has another format, is damaged, or contains several people.
    """
    archive = Archive(Path(path))
    positions = archive.points("positions", "(L, J, 3) or (L, 1, J, 3)")
    if positions.ndim == 4:
        if positions.shape[1] > 1:
            archive.fail(f"positions must be of one person, got {positions.shape[1]} people")
        positions = positions[:, 0]
    skeleton, turn = archive.skeleton(positions.shape[1]), archive.turn_to_y_up(up)
    joints = positions if turn is None else positions @ turn.T
    fps, name = archive.frame_rate(), archive.word("name", archive.path.stem)
    with errors_in(archive.path):
        return JointTrack(joints, skeleton, fps, name)


def write_npz(motion: Motion, path: str | Path, others: Mapping[str, Any] | None = None) -> None:
    """Write a motion to an ``.npz`` archive, losslessly and atomically.

    ``others`` are further arrays by key, which :func:`read_npz` ignores.
    """
    skeleton = motion.skeleton
    arrays: dict[str, Any] = {
        "positions": motion.positions,
        "fps": np.float64(motion.fps),
        "joint_names": np.array(skeleton.joint_names),
        "parents": np.array(skeleton.parents, dtype=np.int32),
        "up_axis": np.array("y"),
        **(others or {}),
    }
    if motion.name:
        arrays["name"] = np.array(motion.name)
    if motion.rotations is not None and motion.rest_offsets is not None:
        arrays |= {"rotations": motion.rotations, "rest_offsets": motion.rest_offsets}
    if skeleton.radii is not None:
        arrays["radii"] = np.array(skeleton.radii)
    with written_whole(Path(path)) as unfinished, open(unfinished, "wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_keypoint_npz(path: str | Path, fps: float | None = None) -> list[KeypointTrack]:
    """Read the keypoint tracks of an ``.npz`` archive, one per camera.

    ``fps`` overrides the file's frame rate.

    Raises
    ------
    MotionFileError
        If the file has another format or is damaged.
    """
    archive = Archive(Path(path))
    keypoints = archive.points("keypoints", "(L, J, 2) or (V, L, J, 2)")
    confidence = archive.numbers("confidence")
    if confidence.shape != keypoints.shape[:-1]:
        archive.fail(f"confidence must have shape {keypoints.shape[:-1]}, got {confidence.shape}")
    skeleton = archive.skeleton(keypoints.shape[-2])
    rate = archive.frame_rate() if fps is None else fps
    names = [archive.path.stem]
    if keypoints.ndim == 4:
        cameras = archive.names("camera_names", "camera", len(keypoints))
        names = [f"{archive.path.stem} {camera}" for camera in cameras]
    else:
        keypoints, confidence = keypoints[np.newaxis], confidence[np.newaxis]
    with errors_in(archive.path):
        return [
            KeypointTrack(points, weights, skeleton, rate, name=name)
            for points, weights, name in zip(keypoints, confidence, names, strict=True)
        ]


class Archive:
    """Arrays of an ``.npz`` file, read and checked on access."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with errors_in(path):
            self.zip = open_archive(read_bytes(path))
        self.keys = [name.removesuffix(".npy") for name in self.zip.namelist()]

    def fail(self, problem: str, cause: Exception | None = None) -> NoReturn:
        raise MotionFileError(f"{self.path}: {problem}") from cause

    def array(self, key: str) -> np.ndarray:
        try:
            with errors_in(self.path):
                return member_array(self.zip, key)
        except KeyError as error:
            present = ", ".join(name[:40] for name in self.keys[:12]) or "none"
            self.fail(f"expected the key {key}, got {present}", error)

    def numbers(self, key: str) -> np.ndarray:
        """Return an array as float64; NaN is accepted, magnitudes above 1e9 are not."""
        array = self.array(key)
        if array.dtype.kind not in "fiu":
            self.fail(f"{key} must contain real numbers, got {shortened(array.dtype)}")
        array = array.astype(np.float64)
        huge = np.abs(array) > LARGEST
        if huge.any():
            self.fail(f"{key} must be between -1e9 and 1e9, got {array[huge][0]:g}")
        return array

    def points(self, key: str, shapes: str) -> np.ndarray:
        """Return a nonempty array with three or four axes, of one of the two ``shapes``."""
        array = self.numbers(key)
        if array.ndim not in (3, 4) or array.shape[-1] != int(shapes[-2]) or 0 in array.shape:
            self.fail(f"{key} must have nonempty shape {shapes}, got {array.shape}")
        return array

    def names(self, key: str, kind: str | None, count: int) -> list[str]:
        """Return ``count`` names; if the key is missing, ``kind`` followed by 0, 1, …"""
        if kind is not None and key not in self.keys:
            return [f"{kind}{index}" for index in range(count)]
        array = self.array(key)
        if array.dtype.kind != "U" or array.shape != (count,):
            self.fail(f"{key} must be {count} strings, got {array.dtype} of shape {array.shape}")
        return array.tolist()

    def word(self, key: str, default: str) -> str:
        """Return the string of ``key``, or ``default`` if the key is missing."""
        if key not in self.keys:
            return default
        array = self.array(key)
        if array.dtype.kind != "U" or array.shape != ():
            self.fail(f"{key} must be a string, got {array.dtype} of shape {array.shape}")
        return str(array)

    def frame_rate(self) -> float:
        fps = self.numbers("fps")
        if fps.size != 1 or not fps.item() > 0:
            self.fail(f"fps must be one number above 0, got {shortened(fps.tolist())}")
        return fps.item()

    def skeleton(self, n_joints: int) -> Skeleton:
        names = self.names("joint_names", None, n_joints)
        parents = self.numbers("parents")
        if parents.shape != (n_joints,) or (parents != np.round(parents)).any():
            self.fail(f"parents must be {n_joints} integers, got shape {parents.shape}")
        radii = self.numbers("radii").ravel().tolist() if "radii" in self.keys else None
        with errors_in(self.path):
            return Skeleton(names, [int(parent) for parent in parents], radii)

    def turn_to_y_up(self, up: str | None = None) -> np.ndarray | None:
        """Return the rotation from the file's axes to Y up; None for the identity.

        ``up`` overrides the file's ``up_axis``.
        """
        up = self.word("up_axis", "y").lower() if up is None else up
        if up not in ("y", "z"):
            self.fail(f"up_axis must be 'y' or 'z', got {shortened(up)}")
        return Z_UP_TO_Y_UP if up == "z" else None

    def kinematics(self, frames: int, n_joints: int) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Return rotations and rest offsets; both are None if the file has no rotations."""
        if "rotations" not in self.keys:
            return None, None
        rotations, rest_offsets = self.numbers("rotations"), self.numbers("rest_offsets")
        check_shape("rotations", rotations, (frames, n_joints, 3, 3))
        check_shape("rest_offsets", rest_offsets, (n_joints, 3))
        return rotations, rest_offsets


def _crowd(skeleton: Skeleton, persons: list[str]) -> Skeleton:
    """Return the skeleton of several people, with joints named ``person:joint``."""
    names = [f"{person}:{joint}" for person in persons for joint in skeleton.joint_names]
    parents = [
        parent if parent < 0 else parent + number * skeleton.n_joints
        for number in range(len(persons))
        for parent in skeleton.parents
    ]
    radii = None if skeleton.radii is None else skeleton.radii * len(persons)
    return Skeleton(names, parents, radii)


def _without_unseen(
    positions: np.ndarray, skeleton: Skeleton, path: Path
) -> tuple[np.ndarray, Skeleton]:
    """Drop the joints that are NaN in every frame."""
    unseen = np.isnan(positions).all(axis=(0, 2))
    if not unseen.any() or unseen.all():
        return positions, skeleton
    dropped = ", ".join(np.array(skeleton.joint_names)[unseen])
    warnings.warn(
        f"{path}: dropping the joints {dropped}, which have no position in any frame",
        MotionFileWarning,
        stacklevel=4,
    )
    return positions[:, ~unseen], skeleton.subset(np.flatnonzero(~unseen).tolist())
