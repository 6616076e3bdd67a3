"""Reader of multi-camera recordings of one person, triangulated for denoising.

Detections and their errors are real, and the ground truth is unknown. For comparison, a recording
contains filtered 3D joints, computed from the same detections.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from pathlib import Path

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.triangulation import triangulate
from probmotion.io.errors import errors_in
from probmotion.io.npz import Archive
from probmotion.motion.occlusion import joints_at_rate, joints_on_skeleton
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["Recording", "read_recording"]

_FIXED_POINT_STEPS = 20  # of the inversion of lens distortion


@dataclass(frozen=True, eq=False)
class Recording:
    """Noisy and filtered joints of a recording.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Joints triangulated frame by frame, metres, world Y up; NaN where occluded.
    filtered : ndarray, (L, J, 3)
        Filtered joints of the recording, metres; NaN where missing.
    skeleton : Skeleton
        Skeleton of the J joints.
    fps : float
        Frames per second.
    name : str
        Name of the recording.
    """

    joints: np.ndarray
    filtered: np.ndarray
    skeleton: Skeleton
    fps: float
    name: str

    @property
    def seen(self) -> np.ndarray:
        """Mask of triangulated joints, (L, J).

        Detection confidence does not indicate the quality of joints: its correlation with the
        distance between triangulated and filtered joints is -0.02.
        """
        return np.isfinite(self.joints).all(axis=-1)


def read_recording(
    path: str | Path,
    skeleton: Skeleton | None = None,
    fps: float | None = 30.0,
    *,
    threshold: float = 0.3,
) -> Recording:
    """Return the triangulated and the filtered joints of a multi-camera recording.

    Parameters
    ----------
    path : str or Path
        An ``.npz`` with ``keypoints`` (V, L, J, 2), ``confidence`` (V, L, J), filtered
        ``positions`` (L, J, 3) and the cameras' parameters ``K``, ``R``, ``t``, ``distortion``.
    skeleton : Skeleton, optional
        Skeleton of the joints to return, ``person14`` by default; the midpoint of the hips or
        shoulders replaces a missing pelvis or neck.
    fps : float, optional
        Frames per second to resample to; None for the file's rate.
    threshold : float
        Minimum confidence of a detection.

    Raises
    ------
    MotionFileError
        If the file is damaged, or a key is missing or has an invalid shape or NaN.
    ValueError
        If a joint of ``skeleton`` is missing, the threshold is out of range, or shapes disagree.
    """
    if not (isinstance(threshold, Real) and 0 <= threshold <= 1):
        raise ValueError(f"threshold must be between 0 and 1, got {threshold!r}")
    archive = Archive(Path(path))
    keypoints, confidence = archive.numbers("keypoints"), archive.numbers("confidence")
    check_shape("keypoints", keypoints, ("V", "L", "J", 2))
    check_shape("confidence", confidence, keypoints.shape[:-1])
    filtered = archive.numbers("positions")
    check_shape("positions", filtered, (*keypoints.shape[1:3], 3))
    source = archive.skeleton(keypoints.shape[2])
    target = Skeleton.preset("person14") if skeleton is None else skeleton
    weights = _weights(archive, keypoints, confidence, threshold)
    cameras, K, distortion = _calibration(archive, len(keypoints))
    pixels = undistorted(keypoints, K, distortion, cameras)
    joints = triangulate_seen(pixels, cameras, weights)
    turn = archive.turn_to_y_up()
    if turn is not None:
        joints, filtered = joints @ turn.T, filtered @ turn.T
    rate = archive.frame_rate()
    new_rate = rate if fps is None else float(fps)
    joints, filtered = (
        _converted(points, source, target, rate, new_rate) for points in (joints, filtered)
    )
    return Recording(joints, filtered, target, new_rate, archive.word("name", archive.path.stem))


def _weights(
    archive: Archive, keypoints: np.ndarray, confidence: np.ndarray, threshold: float
) -> np.ndarray:
    """Return the confidences (V, L, J), with 0 for those below ``threshold``."""
    if not np.isfinite(confidence).any():
        archive.fail("confidence must contain numbers, got only NaN")
    weights = np.where(confidence >= threshold, confidence, 0.0)
    missing = np.isnan(keypoints).any(axis=-1) & (weights > 0)
    if missing.any():
        view, frame, joint = np.argwhere(missing)[0]
        archive.fail(
            f"keypoints must be finite unless their confidence is 0, got NaN at view {view}, frame "
            f"{frame}, joint {joint} with confidence {weights[view, frame, joint]:g}"
        )
    return weights


def _calibration(archive: Archive, n_views: int) -> tuple[Cameras, np.ndarray, np.ndarray]:
    """Return the cameras, the intrinsics K (V, 3, 3) and the distortion (V, 4)."""
    shapes = {"K": (3, 3), "R": (3, 3), "t": (3,), "distortion": (4,)}
    K, R, t, distortion = (archive.numbers(key) for key in shapes)
    with errors_in(f"{archive.path}: K, R, t and distortion must describe cameras"):
        for (key, shape), array in zip(shapes.items(), (K, R, t, distortion), strict=True):
            check_shape(key, array, (n_views, *shape))
            check_finite(key, array)
        focal, centre = K[:, [0, 1], [0, 1]].mean(axis=1), K[:, :2, 2]
        return Cameras(R, t, focal, centre, orthographic=False), K, distortion


def triangulate_seen(keypoints: np.ndarray, cameras: Cameras, weights: np.ndarray) -> np.ndarray:
    """Triangulate keypoints (V, L, J, 2) seen by at least two cameras; other points are NaN.

    Returns points (L, J, 3). Keypoints with weight 0 in ``weights`` (V, L, J) are ignored.
    """
    seen = (weights > 0).sum(axis=0) >= 2
    points = np.full((*seen.shape, 3), np.nan)
    if seen.any():
        # All joints of all frames, as one frame.
        points[seen] = triangulate(keypoints[:, None, seen], cameras, weights[:, None, seen])[0]
    return points


def undistorted(
    keypoints: np.ndarray, K: np.ndarray, distortion: np.ndarray, cameras: Cameras
) -> np.ndarray:
    """Remove lens distortion: return pixels (V, L, J, 2) of the pinhole ``cameras``.

    A lens with coefficients k₁, k₂, p₁, p₂ and, optionally, k₃ (V, 4 or 5) maps normalised x, with
    r² = x² + y², to

        x (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) + 2 p₁ x y + p₂ (r² + 2 x²),

    and likewise y, with p₁ and p₂ exchanged (OpenCV's documentation of the pinhole model).
    Intrinsics ``K`` (V, 3, 3) normalise keypoints; fixed-point iteration inverts the map.
    """
    assert cameras.centre is not None
    focal, centre = K[:, None, None, [0, 1], [0, 1]], K[:, None, None, :2, 2]
    distorted = (keypoints - centre) / focal
    k1, k2, p1, p2 = distortion.T[:4, :, None, None]
    k3 = distortion[:, 4:].sum(axis=1)[:, None, None]
    normalised = distorted
    for _ in range(_FIXED_POINT_STEPS):
        x, y = normalised[..., 0], normalised[..., 1]
        square = x**2 + y**2
        along_x = 2 * p1 * x * y + p2 * (square + 2 * x**2)
        along_y = 2 * p2 * x * y + p1 * (square + 2 * y**2)
        tangential = np.stack([along_x, along_y], axis=-1)
        radial = 1 + k1 * square + k2 * square**2 + k3 * square**3
        normalised = (distorted - tangential) / radial[..., None]
    return normalised * cameras.focal[:, None, None, None] + cameras.centre[:, None, None, :]


def _converted(
    joints: np.ndarray, source: Skeleton, target: Skeleton, rate: float, new_rate: float
) -> np.ndarray:
    """Retarget joints (L, J, 3), NaN where occluded, and resample them to another frame rate."""
    weights = np.isfinite(joints).all(axis=-1).astype(np.float64)
    joints, weights = joints_on_skeleton(joints, weights, source, target)
    return joints if new_rate == rate else joints_at_rate(joints, weights, rate, new_rate)[0]
