"""Keypoints from a known camera in the normalised format of the motion VAE's training tracks.

Training tracks are in metres at the subject's distance, x right and y down, with the root at the
origin of every frame. The root position in the camera is stored separately.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.models.vae.settings import CONFIDENCE_THRESHOLD
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.validation import check_positive, check_shape

__all__ = ["ObservedView", "observed_view"]

_TO_OPENCV = np.array([1.0, -1.0, -1.0])
"""Conversion between axes with y up and z towards the camera and OpenCV camera axes."""


@dataclass(frozen=True, eq=False)
class ObservedView:
    """Normalised keypoints of one view.

    ``keypoints`` (L, J, 2): relative to the root, metres at the subject's distance, x right and y
    down, 0 where occluded; ``confidence`` (L, J): 1, or 0 where occluded; ``root`` (L, 2): root
    keypoint relative to the camera axis, in the same units; ``distance``: depth of the subject,
    metres, ``None`` for an orthographic camera.
    """

    keypoints: np.ndarray
    confidence: np.ndarray
    root: np.ndarray
    camera: Cameras
    distance: float | None

    def at(self, distance: float) -> ObservedView:
        """Return the view of a perspective camera rescaled to another subject distance, metres."""
        if self.distance is None:
            raise ValueError("camera must be perspective to change the distance, got orthographic")
        check_positive("distance", distance)
        ratio = distance / self.distance
        keypoints, root = ratio * self.keypoints, ratio * self.root
        return replace(self, keypoints=keypoints, root=root, distance=distance)

    def seen(self, offsets: np.ndarray) -> np.ndarray:
        """Project points relative to the root, ``(…, L, J, 3) → (…, L, J, 2)``.

        u = (X, −Y) d/(d − Z), with y up and z towards the camera; d → ∞ for an orthographic camera.
        Raises ``ValueError`` if a point is beside or behind the camera.
        """
        plane = offsets[..., :2] * _TO_OPENCV[:2]
        if self.distance is None:
            return plane
        depth = self.distance - offsets[..., 2:]
        if not depth.min() > 0:
            nearest = f"{depth.min():.3g} m"
            raise ValueError(f"offsets must have positive depth in the camera, got {nearest}")
        return plane * self.distance / depth

    def world_rotations(self, rotations: np.ndarray) -> np.ndarray:
        """Convert camera-relative rotations to world rotations, (…, 3, 3)."""
        return self.camera.rotation[0].T @ (_TO_OPENCV[:, None] * rotations)

    def world_roots(self, image_offsets: np.ndarray) -> np.ndarray:
        """Return root positions in the world, ``(L, 2) → (L, 3)``, metres.

        ``image_offsets`` (L, 2) are relative to the root keypoint, metres, x right and y up. The
        depth is the subject's distance; for an orthographic camera, that of the world origin.
        """
        translation = self.camera.translation[0]
        depth = translation[2] if self.distance is None else self.distance
        plane = self.root + image_offsets * _TO_OPENCV[:2]
        in_camera = np.concatenate([plane, np.full((len(plane), 1), depth)], axis=-1)
        return (in_camera - translation) @ self.camera.rotation[0]


def observed_view(
    likelihood: Keypoints2D, skeleton: Skeleton, *, distance: float | None = None
) -> ObservedView:
    """Convert observations of one view to the normalised format of the networks.

    Joints below .3 of the largest confidence are masked. An occluded root is interpolated in time.
    ``distance`` is the depth of the subject in a perspective camera, metres, 1 by default. Raises
    ``ValueError`` for several views, joints other than the skeleton's, a frame without a visible
    joint, or a root that is never visible.
    """
    _check_observations(likelihood, skeleton)
    camera, root = likelihood.cameras, skeleton.roots[0]
    assert camera.centre is not None
    visible = _visibility(likelihood)
    slopes = (likelihood.keypoints[0] - camera.centre[0]) / camera.focal[0]
    length = None if camera.orthographic else 1.0 if distance is None else float(distance)
    if length is not None:
        check_positive("distance", length)
    plane = slopes if length is None else length * slopes
    centre = _interpolated(plane[:, root], visible[:, root])
    centred = np.where(visible[..., None], plane - centre[:, None], 0.0)
    return ObservedView(centred, visible.astype(np.float64), centre, camera, length)


def _check_observations(likelihood: Keypoints2D, skeleton: Skeleton) -> None:
    if likelihood.cameras.n_views != 1:
        raise ValueError(f"likelihood must have one view, got {likelihood.cameras.n_views}")
    check_shape("likelihood", likelihood.keypoints, (1, "L", skeleton.n_joints, 2))
    visible = _visibility(likelihood)
    if (empty := ~visible.any(axis=1)).any():
        raise ValueError(
            f"likelihood must have a visible joint per frame, got none in frame {np.argmax(empty)}"
        )
    root = skeleton.roots[0]
    if not visible[:, root].any():
        name = skeleton.joint_names[root]
        raise ValueError(f"likelihood must show the root {name} in at least one frame, got none")


def _visibility(likelihood: Keypoints2D) -> np.ndarray:
    """Return the mask of joints that the network treats as visible, (L, J).

    The confidence scale is arbitrary, so only ratios of confidences are meaningful.
    """
    confidence = likelihood.entries.confidence[0]
    return (confidence > 0) & (confidence >= CONFIDENCE_THRESHOLD * confidence.max())


def _interpolated(track: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Interpolate a track (L, 2) linearly in time, constant beyond its ends."""
    times = np.arange(len(track))
    columns = [np.interp(times, times[visible], column[visible]) for column in track.T]
    return np.stack(columns, axis=-1)
