"""Where a body is and how it is turned in every frame: what a motion VAE's latent code leaves out.

The rigid pose ξ_{t,1} has a network of its own (Ponymation, section 3.3), which sees it in
pictures, relative to the camera; the camera says where that is in the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.losses import best_guess, guess_terms, weighted_sum
from probmotion.models.vae.observed_views import ObservedView, picture_of
from probmotion.models.vae.pose_network import PoseGuesses, PoseNetwork
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["RigidPath", "SeenBody", "see_body"]

_OFF_ORTHONORMAL = 1e-4
_PASSES = 3
"""Distance and pose are found in turn; the first distance is already near."""


@dataclass(frozen=True, eq=False)
class RigidPath:
    """A root's rotation and place in every frame, in the world.

    Parameters
    ----------
    rotations : ndarray, (L, 3, 3)
        From the body's frame (Y up, its front at +Z, its left at +X) to the world.
    translations : ndarray, (L, 3)
        Of the root, metres.

    Raises
    ------
    ValueError
        If shapes disagree, a number is not finite or a rotation is none.
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
        gap = float(np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max())
        if gap > _OFF_ORTHONORMAL or (np.linalg.det(rotations) < 0).any():
            raise ValueError(
                f"rotations is off orthonormal matrices of determinant 1 by {gap:.2g}, expected at "
                f"most {_OFF_ORTHONORMAL:g}"
            )
        object.__setattr__(self, "rotations", rotations)
        object.__setattr__(self, "translations", translations)

    @classmethod
    def upright(cls, body: ArticulatedBody, frames: int) -> RigidPath:
        """Return the path of a body that stands at the origin and looks along +Z.

        The root is so high that the lowest joint of the rest pose is on the floor, Y = 0.
        """
        check_count("frames", frames)
        still, rest = np.eye(3)[None], np.zeros((1, len(body.bones), 3))
        pose = body.positions(rest, still, np.zeros((1, 3)))
        root = np.array([0.0, -pose[..., 1].min(), 0.0])
        return cls(np.tile(np.eye(3), (frames, 1, 1)), np.tile(root, (frames, 1)))

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return len(self.rotations)


@dataclass(frozen=True, eq=False)
class SeenBody:
    """What a pose network sees in one track: its best view hypothesis, and how good each is.

    Parameters
    ----------
    path : RigidPath
        In the world.
    turns : ndarray, (L, bones, 3)
        Rotation vectors of the bones, in their parents' frames.
    log_lengths : ndarray, (G,)
        Of the body's bones, relative to the rest pose's.
    losses : ndarray, (H,)
        By which the hypotheses are compared; the least is the best's.
    distance : float or None
        From a perspective camera to the root, metres.
    """

    path: RigidPath
    turns: np.ndarray
    log_lengths: np.ndarray
    losses: np.ndarray
    distance: float | None


def see_body(
    network: PoseNetwork,
    settings: MotionVAESettings,
    body: ArticulatedBody,
    likelihood: Keypoints2D,
) -> SeenBody:
    """Return the body that a pose network sees in one known camera, in the world.

    Of the H view hypotheses it is the one of the least loss, weighed as in training: how far its
    picture is from the evidence, how far bones leave their ranges, stretch and jump.

    An orthographic camera does not see the root's depth: it is that of the world's origin. In a
    perspective one the subject is at the distance at which the body of the rest pose's size, posed
    as it is seen, is as large as in the picture: one distance for all frames, since a frame's own
    would be noise of the pose. A body that is larger than the rest pose's is placed nearer than it
    is, with the same picture.

    Parameters
    ----------
    network : PoseNetwork
        Trained on pictures of such bodies.
    settings : MotionVAESettings
        With the weights of its losses.
    body : ArticulatedBody
        Whose joints the evidence shows.
    likelihood : Keypoints2D
        One view.

    Raises
    ------
    ValueError
        If the evidence has several views, other joints, or a frame that shows none; or the body
        would be beside or behind the camera.
    """
    picture = picture_of(likelihood, body.skeleton)
    if picture.distance is not None:
        picture = picture.at(_first_distance(picture, body))
        for _ in range(_PASSES):
            assert picture.distance is not None
            best, _ = _best_guess(network, settings, body, picture)
            picture = picture.at(picture.distance * _size_ratio(best, body, picture))
    best, losses = _best_guess(network, settings, body, picture)
    rotation, place, turns, log_lengths = (
        part[0].double().numpy()
        for part in (best.rotation, best.translation, best.turns, best.log_lengths)
    )
    path = RigidPath(picture.world_rotations(rotation), picture.world_roots(place))
    return SeenBody(path, turns, log_lengths, losses, picture.distance)


def _best_guess(
    network: PoseNetwork,
    settings: MotionVAESettings,
    body: ArticulatedBody,
    picture: ObservedView,
) -> tuple[PoseGuesses, np.ndarray]:
    """Return the best hypothesis of one track, and all hypotheses' losses (H,)."""

    def tensor(values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=torch.float32)

    keypoints, confidence = tensor(picture.keypoints)[None], tensor(picture.confidence)[None]
    with torch.no_grad():
        guesses = network(keypoints, confidence, tensor(body.rest_positions))
        terms = guess_terms(body, guesses, keypoints, confidence, picture.distance)
        losses = weighted_sum(terms, settings)
    return best_guess(guesses, losses), losses[0].double().numpy()


def _first_distance(picture: ObservedView, body: ArticulatedBody) -> float:
    """Return a distance from bones' lengths: seen from anywhere they show π/4 of them on average.

    Raises
    ------
    ValueError
        If no bone is seen from end to end.
    """
    joints, parents = (list(side) for side in zip(*body.skeleton.bones, strict=True))
    shown = (picture.confidence[:, joints] > 0) & (picture.confidence[:, parents] > 0)
    bones = np.linalg.norm(picture.keypoints[:, joints] - picture.keypoints[:, parents], axis=-1)
    lengths = np.linalg.norm(body.rest[joints], axis=-1)
    seen = (shown * bones).sum()
    if not seen > 0:
        raise ValueError("likelihood shows no bone from end to end, expected some: they give scale")
    assert picture.distance is not None
    return float(math.pi / 4 * (shown * lengths).sum() / seen * picture.distance)


def _size_ratio(best: PoseGuesses, body: ArticulatedBody, picture: ObservedView) -> float:
    """Return how much larger the rest pose's body, posed as it is seen, is than the picture."""
    place = torch.nn.functional.pad(best.translation, (0, 1))
    # Of its own lengths a body would fit whatever distance they were guessed at.
    posed = body.positions(best.turns, best.rotation, place)[0].double().numpy()
    weight = picture.confidence[..., None]
    across = (weight * picture.keypoints * picture.seen(posed)).sum()
    size = (weight * picture.keypoints**2).sum()
    if not across > 0:
        raise ValueError(
            "likelihood shows nothing like the body that the network sees, expected its keypoints"
        )
    return float(across / size)
