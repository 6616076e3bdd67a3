"""3D motions, 3D joint tracks with gaps and 2D keypoint tracks of a skeleton."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from probmotion.motion.resampling import resample
from probmotion.motion.retargeting import counterpart, matching_joints
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["JointTrack", "KeypointTrack", "Motion"]

_MAX_CONFIDENCE = 2  # largest COCO visibility flag
_LISTED = 12  # maximum number of names in an error
_FILLED_BY_PRIORS = frozenset(("pelvis", "neck"))  # joints that many marker sets lack


@dataclass(frozen=True, eq=False)
class Motion:
    """3D motion of one clip: joint positions over time.

    Parameters
    ----------
    positions : ndarray, (L, J, 3)
        Joint positions, metres, in right-handed world axes with Y up.
    skeleton : Skeleton
        Names and parents of the J joints.
    fps : float
        Frames per second.
    rotations : ndarray, (L, J, 3, 3), optional
        Local rotation matrices of the joints in their parents' frames, if the source provides them.
    rest_offsets : ndarray, (J, 3), optional
        Offset of each joint from its parent in the rest pose, metres; required with ``rotations``.
    name : str
        Name of the clip in tables; by default, file readers use the stem of the file name.

    Raises
    ------
    ValueError
        If shapes do not match the skeleton, a value is not finite, there are no frames, a rotation
        is not orthonormal, or ``fps`` is not positive.
    """

    positions: np.ndarray
    skeleton: Skeleton
    fps: float
    rotations: np.ndarray | None = None
    rest_offsets: np.ndarray | None = None
    name: str = field(default="")

    def __post_init__(self) -> None:
        positions = np.asarray(self.positions, dtype=np.float64)
        check_shape("positions", positions, ("L", self.skeleton.n_joints, 3))
        if len(positions) == 0:
            raise ValueError("positions must contain at least one frame, got none")
        check_finite("positions", positions)
        check_positive("fps", self.fps)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "fps", float(self.fps))
        if (self.rotations is None) != (self.rest_offsets is None):
            raise ValueError("rotations and rest_offsets must be given together, got only one")
        if self.rotations is not None and self.rest_offsets is not None:
            check_shape("rotations", self.rotations, (*positions.shape[:2], 3, 3))
            check_finite("rotations", self.rotations)
            product = self.rotations @ np.swapaxes(self.rotations, -1, -2)
            error = float(np.abs(product - np.eye(3)).max())
            if error > 1e-3:
                raise ValueError(
                    f"rotations must be orthonormal to 0.001, got a deviation of {error:.2g}"
                )
            check_shape("rest_offsets", self.rest_offsets, (self.skeleton.n_joints, 3))
            check_finite("rest_offsets", self.rest_offsets)

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return len(self.positions)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.frames - 1) / self.fps

    def window(self, start: int, frames: int) -> Motion:
        """Return the ``frames`` frames that begin with frame ``start``."""
        check_count("frames", frames)
        if not 0 <= start <= self.frames - frames:
            raise ValueError(
                f"start must be 0 to {self.frames - frames} for frames={frames}, got {start}"
            )
        stop = start + frames
        rotations = None if self.rotations is None else self.rotations[start:stop]
        return replace(self, positions=self.positions[start:stop], rotations=rotations)

    def resample(self, fps: float) -> Motion:
        """Resample the clip to another frame rate by linear interpolation in time.

        Interpolated local rotations lie on geodesics; see
        :func:`~probmotion.motion.resampling.resample`.

        Raises
        ------
        ValueError
            If ``fps`` is not above 0 and at most 10 000.
        """
        if fps == self.fps:
            return self
        positions, rotations = resample(self.positions, self.rotations, self.fps, fps)
        return replace(self, positions=positions, rotations=rotations, fps=float(fps))

    def centred(self) -> Motion:
        """Return the motion with the first root's mean position at the origin."""
        root = self.skeleton.roots[0]
        positions = self.positions - self.positions[:, root].mean(axis=0)
        return replace(self, positions=positions, rotations=None, rest_offsets=None)

    def turned(self, yaw: float) -> Motion:
        """Return the motion rotated by ``yaw`` radians about the vertical axis."""
        c, s = np.cos(yaw), np.sin(yaw)
        matrix = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return replace(self, positions=self.positions @ matrix.T, rotations=None, rest_offsets=None)

    def retarget(self, skeleton: Skeleton) -> Motion:
        """Retarget the motion to another skeleton by matching joint names.

        Positions are unchanged. Rotations are dropped unless the skeletons are equal.

        Raises
        ------
        ValueError
            If a joint of ``skeleton`` has no counterpart.
        """
        if self.skeleton == skeleton:
            return self
        positions = self.positions[:, matching_joints(self.skeleton, skeleton)]
        return replace(
            self, positions=positions, skeleton=skeleton, rotations=None, rest_offsets=None
        )

    def __repr__(self) -> str:
        return (
            f"Motion({self.name or 'unnamed'}: {self.frames} frames at {self.fps:g} fps, "
            f"{self.skeleton.n_joints} joints)"
        )


@dataclass(frozen=True, eq=False)
class JointTrack:
    """Recorded 3D joints over time, with gaps.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Joint positions, metres, in right-handed world axes with Y up; NaN where missing.
    skeleton : Skeleton
        Names and parents of the J joints.
    fps : float
        Frames per second.
    name : str
        Name of the track.

    Raises
    ------
    ValueError
        If shapes do not match, a joint is infinite or partly NaN, or no joint is observed.
    """

    joints: np.ndarray
    skeleton: Skeleton
    fps: float
    name: str = field(default="")

    def __post_init__(self) -> None:
        joints = np.asarray(self.joints, dtype=np.float64)
        check_shape("joints", joints, ("L", self.skeleton.n_joints, 3))
        if len(joints) == 0:
            raise ValueError("joints must contain at least one frame, got none")
        missing = np.isnan(joints).all(axis=-1)
        invalid = ~np.isfinite(joints).all(axis=-1) & ~missing
        if invalid.any():
            frame, joint = np.argwhere(invalid)[0]
            raise ValueError(
                f"joints must be finite, or NaN in all coordinates where missing, got "
                f"{joints[frame, joint]} at frame {frame}, joint {self.skeleton.joint_names[joint]}"
            )
        if missing.all():
            raise ValueError("joints must be observed in at least one frame, got only gaps")
        check_positive("fps", self.fps)
        object.__setattr__(self, "joints", joints)
        object.__setattr__(self, "fps", float(self.fps))

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return len(self.joints)

    @property
    def seen(self) -> np.ndarray:
        """Mask of observed joints, (L, J)."""
        return np.isfinite(self.joints).all(axis=-1)

    def retarget(self, skeleton: Skeleton) -> JointTrack:
        """Retarget the track to another skeleton by matching joint names.

        A ``pelvis`` or ``neck`` without a counterpart is missing in every frame. The midpoint of
        the hips is no substitute: it is 11 cm from the pelvis of CMU's recordings.

        Raises
        ------
        ValueError
            If another joint of ``skeleton`` has no counterpart; the message lists all of them.
        """
        if self.skeleton == skeleton:
            return self
        joints = np.full((self.frames, skeleton.n_joints, 3), np.nan)
        lacking = []
        pairs = zip(skeleton.joint_names, skeleton.canonical_names, strict=True)
        for joint, (name, canonical) in enumerate(pairs):
            source = counterpart(self.skeleton, name, canonical)
            if source is not None:
                joints[:, joint] = self.joints[:, source]
            elif canonical not in _FILLED_BY_PRIORS:
                lacking.append(name)
        if lacking:
            names = self.skeleton.joint_names
            more = ", …" if len(names) > _LISTED else ""
            raise ValueError(
                f"joints must include {', '.join(lacking)}, got only "
                f"{', '.join(name[:20] for name in names[:_LISTED])}{more}"
            )
        return replace(self, joints=joints, skeleton=skeleton)


@dataclass(frozen=True, eq=False)
class KeypointTrack:
    """2D keypoints of one camera over time.

    Parameters
    ----------
    keypoints : ndarray, (L, J, 2)
        Image coordinates, x right and y down, pixels or the camera's unit. Missing entries are NaN
        with confidence 0.
    confidence : ndarray, (L, J)
        Confidence from 0 (missing) to 1. Values up to 2 are accepted, for heatmap peaks slightly
        above 1 and COCO visibility flags.
    skeleton : Skeleton
        Names and parents of the J joints.
    fps : float
        Frames per second.
    name : str
        Name of the track.
    start : int, optional
        Number of the first frame in the video, for example if the track spans the first to the last
        detection. Synchronised tracks are aligned by it; those without must have all frames.

    Raises
    ------
    ValueError
        If shapes do not match, a confidence is outside 0 to 2 or not finite, or a keypoint with
        confidence above 0 is not finite.
    """

    keypoints: np.ndarray
    confidence: np.ndarray
    skeleton: Skeleton
    fps: float
    name: str = field(default="")
    start: int | None = None

    def __post_init__(self) -> None:
        keypoints = np.asarray(self.keypoints, dtype=np.float64)
        confidence = np.asarray(self.confidence, dtype=np.float64)
        check_shape("keypoints", keypoints, ("L", self.skeleton.n_joints, 2))
        check_shape("confidence", confidence, keypoints.shape[:2])
        if len(keypoints) == 0:
            raise ValueError("keypoints must contain at least one frame, got none")
        check_finite("confidence", confidence)
        for value in (confidence.min(), confidence.max()):
            if not 0 <= value <= _MAX_CONFIDENCE:
                raise ValueError(f"confidence must be 0 to {_MAX_CONFIDENCE}, got {value:g}")
        missing = ~np.isfinite(keypoints).all(axis=-1)
        if (missing & (confidence > 0)).any():
            frame, joint = np.argwhere(missing & (confidence > 0))[0]
            raise ValueError(
                f"keypoints must be finite unless their confidence is 0, got NaN or infinity at "
                f"frame {frame}, joint {joint} with confidence {confidence[frame, joint]:g}"
            )
        check_positive("fps", self.fps)
        if self.start is not None:
            check_count("start", self.start, least=0)
        object.__setattr__(self, "keypoints", keypoints)
        object.__setattr__(self, "confidence", confidence)

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return len(self.keypoints)

    def flipped(self, axes: str, image_size: tuple[int, int]) -> KeypointTrack:
        """Return the track with mirrored image coordinates; joints keep their names.

        Parameters
        ----------
        axes : {"x", "y", "xy"}
            Coordinates that are mirrored: ``"y"`` if y points up, ``"xy"`` if the video is upside
            down.
        image_size : tuple of int
            Width and height of the video, pixels.
        """
        if axes not in ("x", "y", "xy"):
            raise ValueError(f"axes must be 'x', 'y' or 'xy', got {axes!r}")
        flip = [axis in axes for axis in "xy"]
        keypoints = np.where(flip, np.array(image_size) - self.keypoints, self.keypoints)
        return replace(self, keypoints=keypoints)
