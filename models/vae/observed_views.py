"""Keypoints in a known camera as the pictures that a motion VAE has learnt from.

Those are in metres at the subject's distance, x right and y down, with the root at the origin of
every frame. What is lost by that is kept beside them: where the root is in the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.models.vae.settings import USUAL_THRESHOLD
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.validation import check_positive, check_shape

__all__ = ["ObservedView", "picture_of"]

_TO_OPENCV = np.array([1.0, -1.0, -1.0])
"""From a frame with y up and z towards the camera to the cameras' own, and back."""


@dataclass(frozen=True, eq=False)
class ObservedView:
    """Keypoints of one view as a network sees them.

    Parameters
    ----------
    keypoints : ndarray, (L, J, 2)
        About the root, metres at the subject's distance, x right and y down; 0 where hidden.
    confidence : ndarray, (L, J)
        1, or 0 where hidden.
    root : ndarray, (L, 2)
        The root off the camera's axis, metres at the subject's distance, x right and y down.
    camera : Cameras
        The one view.
    distance : float or None
        From the camera to the subject along its axis, metres; ``None`` for an orthographic camera,
        which does not see it.
    """

    keypoints: np.ndarray
    confidence: np.ndarray
    root: np.ndarray
    camera: Cameras
    distance: float | None

    def at(self, distance: float) -> ObservedView:
        """Return what a perspective camera's picture is where the subject is at another distance.

        Raises
        ------
        ValueError
            If the camera is orthographic, or the distance is not above zero.
        """
        if self.distance is None:
            raise ValueError("camera is orthographic, expected a perspective one: it has no scale")
        check_positive("distance", distance)
        grown = distance / self.distance
        return ObservedView(
            grown * self.keypoints, self.confidence, grown * self.root, self.camera, distance
        )

    def seen(self, offsets: np.ndarray) -> np.ndarray:
        """Return where points about the root are in this picture, ``(…, L, J, 3) → (…, L, J, 2)``.

        u = (X, −Y) d/(d − Z) in a frame with y up and z towards the camera, d → ∞ where the camera
        is orthographic.

        Raises
        ------
        ValueError
            If a point is beside or behind the camera.
        """
        plane = offsets[..., :2] * _TO_OPENCV[:2]
        if self.distance is None:
            return plane
        depth = self.distance - offsets[..., 2:]
        if not depth.min() > 0:
            raise ValueError(
                f"offsets has a joint {depth.min():.3g} m in front of the camera, expected every "
                "joint in front of it"
            )
        return plane * self.distance / depth

    def world_rotations(self, rotations: np.ndarray) -> np.ndarray:
        """Return rotations relative to the camera as rotations in the world, (…, 3, 3)."""
        return self.camera.rotation[0].T @ (_TO_OPENCV[:, None] * rotations)

    def world_roots(self, moved: np.ndarray) -> np.ndarray:
        """Return where the root is in the world, ``(L, 2) → (L, 3)``, metres.

        At the subject's distance; for an orthographic camera at the depth of the world's origin.

        Parameters
        ----------
        moved : ndarray, (L, 2)
            Where the root is beside the keypoint that the picture is centred on: metres, x right
            and y up.
        """
        translation = self.camera.translation[0]
        depth = translation[2] if self.distance is None else self.distance
        plane = self.root + moved * _TO_OPENCV[:2]
        here = np.concatenate([plane, np.full((len(plane), 1), depth)], axis=-1)
        return (here - translation) @ self.camera.rotation[0]


def picture_of(
    likelihood: Keypoints2D, skeleton: Skeleton, *, distance: float | None = None
) -> ObservedView:
    """Return the evidence as a network's picture.

    Joints of less than three tenths of the greatest confidence are hidden, as in training by
    default. Where the root is hidden its place is interpolated in time: only pictures' centres
    depend on it.

    Parameters
    ----------
    likelihood : Keypoints2D
        One view.
    skeleton : Skeleton
        Whose joints they are.
    distance : float, optional
        From a perspective camera to the subject along the axis, metres; 1 by default, which leaves
        slopes. An orthographic camera's picture has none.

    Raises
    ------
    ValueError
        If there are several views or other joints, a frame shows no joint, or no frame the root.
    """
    _check_observations(likelihood, skeleton)
    camera, root = likelihood.cameras, skeleton.roots[0]
    assert camera.centre is not None
    shown = _shown(likelihood)
    slopes = (likelihood.keypoints[0] - camera.centre[0]) / camera.focal[0]
    length = None if camera.orthographic else 1.0 if distance is None else float(distance)
    if length is not None:
        check_positive("distance", length)
    plane = slopes if length is None else length * slopes
    middle = _interpolated(plane[:, root], shown[:, root])
    about = np.where(shown[..., None], plane - middle[:, None], 0.0)
    return ObservedView(about, shown.astype(np.float64), middle, camera, length)


def _check_observations(likelihood: Keypoints2D, skeleton: Skeleton) -> None:
    if likelihood.cameras.n_views != 1:
        raise ValueError(
            f"likelihood has {likelihood.cameras.n_views} views, expected one, as the network has "
            "learnt"
        )
    check_shape("likelihood", likelihood.keypoints, (1, "L", skeleton.n_joints, 2))
    shown = _shown(likelihood)
    if (dark := ~shown.any(axis=1)).any():
        raise ValueError(
            f"likelihood shows no joint in frame {int(np.argmax(dark))}, expected some in every "
            "frame"
        )
    root = skeleton.roots[0]
    if not shown[:, root].any():
        raise ValueError(
            f"likelihood never shows the {skeleton.joint_names[root]}, expected it in a frame at "
            "least: pictures are centred on it"
        )


def _shown(likelihood: Keypoints2D) -> np.ndarray:
    """Return which joints a network is shown, (L, J) bool: the less sure ones it never learnt.

    Only ratios of confidences mean anything, since the noise is free.
    """
    confidence = likelihood.entries.confidence[0]
    return (confidence > 0) & (confidence >= USUAL_THRESHOLD * confidence.max())


def _interpolated(track: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Return a track (L, 2) with what is hidden between, or held from, what is shown."""
    times = np.arange(len(track))
    columns = [np.interp(times, times[shown], column[shown]) for column in track.T]
    return np.stack(columns, axis=-1)
