"""2D annotations as arrays with missing joints, and the poses that are lifted from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from probmotion.interaction.annotations.annotations import Annotations
from probmotion.validation import check_shape

__all__ = ["AnnotationLifts", "as_keypoints", "centred_images", "visibility_groups"]

_LEAST_VISIBLE = 2  # a single joint says nothing about the pose, since positions are unknown


@dataclass(frozen=True, eq=False)
class AnnotationLifts:
    """Posterior of the 3D poses of n annotations, in the axes of their cameras.

    Parameters
    ----------
    positions : ndarray, (n, J, 3)
        Posterior means, metres: x right, y up, both in place; z towards the viewer, relative to the
        mean depth of the joints. Joints that are missing in the annotation are completed.
    sd : ndarray, (n, J, 3)
        Posterior standard deviations, metres; with an unknown scale, about the annotation's centre.
    views : ndarray, (n, 2)
        Most probable azimuth and elevation of each camera in the canonical frame, radians.
    scales : ndarray, (n,)
        Posterior means of the metres per unit of the image; 1 if the scale is known.
    """

    positions: np.ndarray
    sd: np.ndarray
    views: np.ndarray
    scales: np.ndarray


def as_keypoints(annotations: Annotations | np.ndarray, n_joints: int) -> np.ndarray:
    """Return checked keypoints (n, J, 2) in which missing joints are NaN."""
    if isinstance(annotations, Annotations):
        annotations = np.where(annotations.visible[..., None], annotations.keypoints, np.nan)
    keypoints = np.array(annotations, dtype=np.float64)
    check_shape("annotations", keypoints, ("n", n_joints, 2))
    if len(keypoints) == 0:
        raise ValueError("annotations must contain at least one annotation, got none")
    if np.isinf(keypoints).any():
        raise ValueError("annotations must be finite, or NaN where a joint is missing, got inf")
    keypoints[np.isnan(keypoints).any(axis=-1)] = np.nan
    visible = ~np.isnan(keypoints[..., 0])
    few = visible.sum(axis=-1) < _LEAST_VISIBLE
    if few.any():
        index = int(np.argmax(few))
        raise ValueError(
            f"annotations must show at least {_LEAST_VISIBLE} joints each, got "
            f"{visible[index].sum()} in annotation {index}: leave such annotations out"
        )
    flat = ~(np.nanmax(keypoints, axis=1) - np.nanmin(keypoints, axis=1)).any(axis=-1)
    if flat.any():
        raise ValueError(
            "annotations must show joints at different places, got all at one point in annotation "
            f"{int(np.argmax(flat))}"
        )
    return keypoints


def centred_images(keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return images (n, 2J), all x before all y, about the mean of the visible joints, (n, 2)."""
    centres = np.nanmean(keypoints, axis=1)
    images = np.swapaxes(keypoints - centres[:, None], 1, 2).reshape(len(keypoints), -1)
    return images, centres


def visibility_groups(images: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the rows (m,) of annotations that show the same joints, and the mask (2J,) of those."""
    patterns, group = np.unique(~np.isnan(images), axis=0, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    ends = np.cumsum(np.bincount(group.reshape(-1)))
    for pattern, rows in zip(patterns, np.split(order, ends[:-1]), strict=True):
        yield rows, pattern
