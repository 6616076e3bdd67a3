"""Rigid paths of the motion VAE: root rotation and position per frame, not part of its latent code.

The pose network estimates the rigid pose ξ_{t,1} relative to the camera (Ponymation, section 3.3);
the camera converts it to the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from probmotion.extras import torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.losses import best_hypothesis, predicted_hypotheses
from probmotion.models.vae.observed_views import ObservedView, observed_view
from probmotion.models.vae.pose_network import PoseHypotheses, PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["BodyEstimate", "RigidPath", "estimate_body"]

_ROTATION_TOLERANCE = 1e-4  # tolerance for the entries of R Rᵀ − I
_PASSES = 3
"""Number of alternating updates of distance and pose; the initial distance is already close."""


@dataclass(frozen=True, eq=False)
class RigidPath:
    """Rotation and position of the root in every frame, in the world.

    Parameters
    ----------
    rotations : ndarray, (L, 3, 3)
        Rotations from the body's frame (Y up, front +Z, left +X) to the world.
    translations : ndarray, (L, 3)
        Root positions, metres.

    Raises
    ------
    ValueError
        If shapes disagree, an entry is not finite or a matrix is not a rotation.
    """

    rotations: np.ndarray
    translations: np.ndarray

    def __post_init__(self) -> None:
        rotations = np.asarray(self.rotations, dtype=np.float64)
        translations = np.asarray(self.translations, dtype=np.float64)
        check_shape("rotations", rotations, ("L", 3, 3))
        check_shape("translations", translations, (len(rotations), 3))
        check_count("frames", len(rotations))
        check_finite("rotations", rotations)
        check_finite("translations", translations)
        deviation = float(np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max())
        if deviation > _ROTATION_TOLERANCE or (np.linalg.det(rotations) < 0).any():
            raise ValueError(
                "rotations must be orthonormal with determinant 1 within "
                f"{_ROTATION_TOLERANCE:g}, got a deviation of {deviation:.2g}"
            )
        object.__setattr__(self, "rotations", rotations)
        object.__setattr__(self, "translations", translations)

    @classmethod
    def upright(cls, body: ArticulatedBody, frames: int) -> RigidPath:
        """Return the path of a body upright at the origin, facing +Z, its lowest joint at Y = 0."""
        check_count("frames", frames)
        rotation, rest = np.eye(3)[None], np.zeros((1, len(body.bones), 3))
        pose = body.positions(rest, rotation, np.zeros((1, 3)))
        root = np.array([0.0, -pose[..., 1].min(), 0.0])
        return cls(np.tile(np.eye(3), (frames, 1, 1)), np.tile(root, (frames, 1)))

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return len(self.rotations)


@dataclass(frozen=True, eq=False)
class BodyEstimate:
    """Estimate of the body in one track: the best view hypothesis of a pose network.

    ``path``: rigid path in the world; ``turns`` (L, bones, 3): bone rotation vectors;
    ``log_lengths`` (G,): relative to the rest pose; ``losses`` (H,): of all hypotheses;
    ``distance``: from a perspective camera to the root, metres, or None.
    """

    path: RigidPath
    turns: np.ndarray
    log_lengths: np.ndarray
    losses: np.ndarray
    distance: float | None


def estimate_body(
    network: PoseNetwork,
    settings: MotionVAESettings,
    body: ArticulatedBody,
    likelihood: Keypoints2D,
) -> BodyEstimate:
    """Estimate the body in the world from one view with a pose network.

    Selects the view hypothesis with the smallest training loss: reprojection error, joint ranges,
    bone lengths and smoothness.

    With an orthographic camera, the root depth is undetermined and set to that of the world origin.
    With a perspective camera, one distance for all frames is estimated such that the posed body of
    rest-pose size matches the image; distances per frame would be noisy. A larger subject is
    therefore placed too close, with the same projection.

    Raises ``ValueError`` for several views, joints other than the body's or a frame without a
    visible joint, and if the estimated body is beside or behind the camera.
    """
    view = observed_view(likelihood, body.skeleton)
    if view.distance is not None:
        view = view.at(_initial_distance(view, body))
        for _ in range(_PASSES):
            assert view.distance is not None
            best, _ = _best_hypothesis(network, settings, body, view)
            view = view.at(view.distance * _size_ratio(best, body, view))
    best, losses = _best_hypothesis(network, settings, body, view)
    rotation, place, turns, log_lengths = (
        part.double().numpy() for part in vars(best.at(0)).values()
    )
    path = RigidPath(view.world_rotations(rotation), view.world_roots(place))
    return BodyEstimate(path, turns, log_lengths, losses, view.distance)


def _best_hypothesis(
    network: PoseNetwork, settings: MotionVAESettings, body: ArticulatedBody, view: ObservedView
) -> tuple[PoseHypotheses, np.ndarray]:
    """Return the best hypothesis of one track and the losses of all, (H,)."""
    observed = (view.keypoints[None], view.confidence[None], view.distance)
    hypotheses, losses = predicted_hypotheses(network, settings, body, *observed)
    return best_hypothesis(hypotheses, losses), losses[0].double().numpy()


def _initial_distance(view: ObservedView, body: ArticulatedBody) -> float:
    """Estimate the initial distance, as bones project to π/4 of their length on average."""
    joints, parents = (list(side) for side in zip(*body.skeleton.bones, strict=True))
    visible = (view.confidence[:, joints] > 0) & (view.confidence[:, parents] > 0)
    bones = np.linalg.norm(view.keypoints[:, joints] - view.keypoints[:, parents], axis=-1)
    lengths = np.linalg.norm(body.rest[joints], axis=-1)
    projected = (visible * bones).sum()
    if not projected > 0:
        raise ValueError("likelihood must show both ends of at least one bone, got none")
    assert view.distance is not None
    return float(math.pi / 4 * (visible * lengths).sum() / projected * view.distance)


def _size_ratio(best: PoseHypotheses, body: ArticulatedBody, view: ObservedView) -> float:
    """Return the size of the posed body with rest-pose lengths relative to the observation."""
    place = torch.nn.functional.pad(best.translation, (0, 1))
    # Estimated bone lengths could compensate for a wrong distance and are not used.
    posed = body.positions(best.turns, best.rotation, place)[0].double().numpy()
    weight = view.confidence[..., None]
    product = (weight * view.keypoints * view.seen(posed)).sum()
    size = (weight * view.keypoints**2).sum()
    if not product > 0:
        raise ValueError(f"likelihood must correlate with the body, got a product of {product:.2g}")
    return float(product / size)
