"""A real recording to denoise: one person before several calibrated cameras, triangulated.

The detections are real and so are their errors, which differ between joints and frames; beside
them is the 3D that the recording's authors made of the same detections and filtered. It is a
comparison and no truth: none is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from pathlib import Path

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.triangulation import triangulate
from probmotion.io.npz import Archive
from probmotion.motion.occlusion import joints_at_rate, joints_on_skeleton
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_finite, check_shape

__all__ = ["Recording", "read_recording", "triangulate_seen", "undistorted"]

_FIXED_POINT_STEPS = 5


@dataclass(frozen=True, eq=False)
class Recording:
    """Noisy joints of a recording, and filtered ones.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Triangulated frame by frame, metres, world Y up; NaN where hidden.
    filtered : ndarray, (L, J, 3)
        The authors' 3D; NaN where they have none.
    skeleton : Skeleton
        The J joints.
    fps : float
        Frames per second.
    name : str
        What to call the recording.
    """

    joints: np.ndarray
    filtered: np.ndarray
    skeleton: Skeleton
    fps: float
    name: str

    @property
    def seen(self) -> np.ndarray:
        """Where a joint is triangulated, (L, J). Detectors' confidence says no more: in the real
        recording it has no correlation (-.02) with how far a joint is from the filtered one."""
        return np.isfinite(self.joints).all(axis=-1)


def read_recording(
    path: str | Path,
    skeleton: Skeleton | None = None,
    fps: float | None = 30.0,
    *,
    threshold: float = 0.3,
) -> Recording:
    """Return the triangulated and the filtered joints of a recording of several cameras.

    Parameters
    ----------
    path : str or Path
        An ``.npz`` with ``keypoints`` (V, L, J, 2), ``confidence`` (V, L, J), ``positions`` and the
        cameras' ``K``, ``R``, ``t`` and ``distortion``.
    skeleton : Skeleton, optional
        The joints to return, ``person14`` by default; a pelvis or neck that the recording lacks is
        midway between its hips or shoulders.
    fps : float, optional
        Frames per second to return, those of the file where it is None.
    threshold : float
        Least confidence of a detection that counts.

    Raises
    ------
    MotionFileError
        If the file is damaged, a key is missing, or an array is not of the shape above or NaN
        where it is read.
    FileNotFoundError
        If there is no such file.
    ValueError
        If a joint of ``skeleton`` cannot be had, the threshold is no share, or shapes do not fit.
    """
    if not (isinstance(threshold, Real) and 0 <= threshold <= 1):
        raise ValueError(f"threshold must be a confidence, 0 to 1, got {threshold!r}")
    archive = Archive(Path(path))
    keypoints, confidence = archive.numbers("keypoints"), archive.numbers("confidence")
    check_shape("keypoints", keypoints, ("V", "L", "J", 2))
    check_shape("confidence", confidence, keypoints.shape[:-1])
    filtered = archive.numbers("positions")
    check_shape("positions", filtered, (*keypoints.shape[1:3], 3))
    source = archive.skeleton(keypoints.shape[2])
    target = Skeleton.preset("person14") if skeleton is None else skeleton
    weights = _weights(archive, keypoints, confidence, threshold)
    cameras, matrix, distortion = _calibration(archive, len(keypoints))
    pixels = undistorted(keypoints, matrix, distortion, cameras)
    joints = triangulate_seen(pixels, cameras, weights)
    turn = archive.turn_to_y_up()
    if turn is not None:
        joints, filtered = joints @ turn.T, filtered @ turn.T
    rate = archive.frame_rate()
    wanted = rate if fps is None else float(fps)
    return Recording(
        _brought(joints, source, target, rate, wanted),
        _brought(filtered, source, target, rate, wanted),
        target,
        wanted,
        archive.word("name", archive.path.stem),
    )


def _weights(
    archive: Archive, keypoints: np.ndarray, confidence: np.ndarray, threshold: float
) -> np.ndarray:
    """Return the confidences that count, (V, L, J), 0 elsewhere; a NaN one does not."""
    if not np.isfinite(confidence).any():
        archive.fail("confidence has no number that is not NaN, expected some to be numbers")
    weights = np.where(confidence >= threshold, confidence, 0.0)
    lost = np.isnan(keypoints).any(axis=-1) & (weights > 0)
    if lost.any():
        view, frame, joint = np.argwhere(lost)[0]
        archive.fail(
            f"keypoints is NaN at view {view}, frame {frame}, joint {joint}, where confidence is "
            f"{weights[view, frame, joint]:g}, expected confidence 0 where nothing is detected"
        )
    return weights


def _calibration(archive: Archive, n_views: int) -> tuple[Cameras, np.ndarray, np.ndarray]:
    """Return the cameras, K and distortion."""
    shapes = {"K": (3, 3), "R": (3, 3), "t": (3,), "distortion": (4,)}
    found = {key: archive.numbers(key) for key in shapes}
    try:
        for key, array in found.items():
            check_shape(key, array, (n_views, *shapes[key]))
            check_finite(key, array)
        matrix = found["K"]
        focal, centre = matrix[:, [0, 1], [0, 1]].mean(axis=1), matrix[:, :2, 2]
        cameras = Cameras(found["R"], found["t"], focal, centre, orthographic=False)
    except ValueError as error:
        archive.fail(f"K, R, t and distortion are no cameras': {error}")
    return cameras, matrix, found["distortion"]


def triangulate_seen(keypoints: np.ndarray, cameras: Cameras, weights: np.ndarray) -> np.ndarray:
    """Return the points that at least two cameras see, NaN elsewhere.

    Parameters
    ----------
    keypoints : ndarray, (V, L, J, 2)
        Image units; not read where the weight is 0.
    cameras : Cameras
        The V cameras.
    weights : ndarray, (V, L, J)
        Of squared errors in the image (:func:`~probmotion.geometry.triangulation.triangulate`).

    Returns
    -------
    ndarray, (L, J, 3)
        Metres.

    Raises
    ------
    ValueError
        If shapes do not fit, or cameras that see a joint are parallel.
    """
    check_shape("keypoints", keypoints, (cameras.n_views, "L", "J", 2))
    check_shape("weights", weights, keypoints.shape[:-1])
    seen = (weights > 0).sum(axis=0) >= 2
    found = np.full((*seen.shape, 3), np.nan)
    if seen.any():
        # Joints of all frames side by side, as one frame of as many joints.
        points = triangulate(keypoints[:, None, seen], cameras, weights[:, None, seen])
        found[seen] = points[0]
    return found


def undistorted(
    keypoints: np.ndarray, matrix: np.ndarray, distortion: np.ndarray, cameras: Cameras
) -> np.ndarray:
    """Return keypoints as pinhole cameras of one focal length would show them.

    A lens moves the slopes (x, y), with r² = x² + y², to

        x (1 + k₁ r² + k₂ r⁴) + 2 p₁ x y + p₂ (r² + 2 x²), and with y and x, p₁ and p₂ exchanged,

    which is undone by fixed-point steps. (Source: the OpenCV documentation of its pinhole model.)

    Parameters
    ----------
    keypoints : ndarray, (V, L, J, 2)
        Pixels.
    matrix : ndarray, (V, 3, 3)
        K: focal lengths and principal points of the lenses, without skew.
    distortion : ndarray, (V, 4)
        k₁, k₂, p₁, p₂.
    cameras : Cameras
        Their focal lengths and centres are those of the result.

    Returns
    -------
    ndarray, (V, L, J, 2)
        Pixels; NaN where a keypoint is.

    Raises
    ------
    ValueError
        If shapes do not fit.
    """
    V = cameras.n_views
    check_shape("keypoints", keypoints, (V, "L", "J", 2))
    check_shape("matrix", matrix, (V, 3, 3))
    check_shape("distortion", distortion, (V, 4))
    assert cameras.centre is not None
    focal, centre = matrix[:, None, None, [0, 1], [0, 1]], matrix[:, None, None, :2, 2]
    bent = (keypoints - centre) / focal
    k1, k2, p1, p2 = distortion.T[:, :, None, None]
    straight = bent
    for _ in range(_FIXED_POINT_STEPS):
        x, y = straight[..., 0], straight[..., 1]
        square = x**2 + y**2
        aside = np.stack(
            [
                2 * p1 * x * y + p2 * (square + 2 * x**2),
                2 * p2 * x * y + p1 * (square + 2 * y**2),
            ],
            axis=-1,
        )
        straight = (bent - aside) / (1 + k1 * square + k2 * square**2)[..., None]
    return straight * cameras.focal[:, None, None, None] + cameras.centre[:, None, None, :]


def _brought(
    joints: np.ndarray, source: Skeleton, target: Skeleton, rate: float, wanted: float
) -> np.ndarray:
    """Return joints (L, J, 3), NaN where hidden, on another skeleton and at another rate."""
    shown = np.isfinite(joints).all(axis=-1).astype(np.float64)
    joints, shown = joints_on_skeleton(joints, shown, source, target)
    return joints if wanted == rate else joints_at_rate(joints, shown, rate, wanted)[0]
