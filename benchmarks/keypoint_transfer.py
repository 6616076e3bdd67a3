"""Keypoints of one image that a reconstructed surface transfers to another one (PCK)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from probmotion.models.images.category import vertex_normals
from probmotion.models.images.surface import Surface

NEAR = 0.04  # distance below which one point can hide another, of the image
SAME = 0.03  # depth of what counts as the same surface, metres


class View(NamedTuple):
    """True keypoints in an image, and a reconstructed surface.

    ``keypoints`` (J, 2) and ``vertices`` (V, 2) are in units of the image's width; ``annotated``
    (J,) and ``visible`` (V,) tell which can be seen.
    """

    keypoints: np.ndarray
    annotated: np.ndarray
    vertices: np.ndarray
    visible: np.ndarray

    @classmethod
    def of(
        cls,
        joints: np.ndarray,
        truth: np.ndarray,
        estimate: Surface,
        mask: np.ndarray,
        tangent: float,
    ) -> View:
        """Return the view of joints (J, 3), true vertices (V, 3) and a reconstructed surface.

        Axes are those of the camera, y down and z forward. Joints are not annotated where another
        limb hides them or the mask (S, S) is NaN.
        """
        keypoints, vertices = projected(joints, tangent), projected(estimate.vertices, tangent)
        # A joint is inside its limb.
        inside = cdist(joints, truth).min(axis=1)
        annotated = unhidden(joints, truth, tangent, 2 * inside)
        column, row = (keypoints.T * len(mask)).astype(int).clip(0, len(mask) - 1)
        annotated &= np.isfinite(mask[row, column])
        facing = (vertex_normals(estimate) * estimate.vertices).sum(axis=1) < 0
        visible = facing & unhidden(estimate.vertices, estimate.vertices, tangent, SAME)
        return cls(keypoints, annotated, vertices, visible)

    def transferred(self, other: View) -> float:
        """Return the share of keypoints that are transferred to the right place.

        As in *Ponymation* (section 4.2.2), a keypoint is mapped to the closest visible vertex, and
        this vertex is projected to the other image. It is right within a tenth of the body's size.
        NaN if no keypoint is annotated in both images.
        """
        both = self.annotated & other.annotated
        if not both.any():
            return float("nan")
        places = np.where(self.visible[:, None], self.vertices, np.inf)
        vertices = cdist(self.keypoints[both], places).argmin(axis=1)
        errors = np.linalg.norm(other.vertices[vertices] - other.keypoints[both], axis=1)
        return float((errors < 0.1 * np.ptp(other.keypoints, axis=0).max()).mean())


def projected(points: np.ndarray, tangent: float) -> np.ndarray:
    """Return the places of points (n, 3) in the image, (n, 2), in units of its width."""
    return np.asarray(0.5 * (1 + points[:, :2] / (points[:, 2:] * tangent)))


def unhidden(
    points: np.ndarray, surface: np.ndarray, tangent: float, slack: np.ndarray | float
) -> np.ndarray:
    """Return which points (n, 3) are at most ``slack`` behind the vertices (V, 3) near them."""
    near = cdist(projected(points, tangent), projected(surface, tangent)) < NEAR
    first = np.where(near, surface[:, 2], np.inf).min(axis=1)
    return np.asarray(points[:, 2] - first < slack)
