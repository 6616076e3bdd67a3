"""What motion is learnt from where there are only pictures (Ponymation, section 3.2, equation 1).

Cameras look along −Z: X is right in the picture, Y up, Z towards the camera. Pictures have x right
and y down.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.pose_network import PoseGuesses
from probmotion.models.vae.settings import MotionVAESettings

__all__ = [
    "best_guess",
    "guess_terms",
    "pictured",
    "reconstruction",
    "roughness",
    "weighted_sum",
]


def pictured(positions: torch.Tensor, distance: float | None) -> torch.Tensor:
    """Return where a camera sees points, ``(…, 3) → (…, 2)``, metres at the subject's distance.

    Parameters
    ----------
    positions : Tensor, (…, 3)
        In the camera's axes, metres; the subject is at Z = 0.
    distance : float, optional
        Of the camera from there, metres; by default it is so far that all rays are parallel.
    """
    right, up, near = positions.unbind(-1)
    seen = torch.stack([right, -up], dim=-1)
    return seen if distance is None else seen * (distance / (distance - near))[..., None]


def reconstruction(
    positions: torch.Tensor, keypoints: torch.Tensor, weight: torch.Tensor, distance: float | None
) -> torch.Tensor:
    """Return Σ_t Σ_j c ‖p(X) − u‖², ``(…, L, J, 3) → (…)``, m² (design of losses).

    Parameters
    ----------
    positions : Tensor, (…, L, J, 3)
        In the camera's axes.
    keypoints, weight : Tensor, (…, L, J, 2) and (…, L, J)
        What was seen, and how far it counts; an entry of weight 0 may be any finite number.
    distance : float, optional
        As in :func:`pictured`.
    """
    square = ((pictured(positions, distance) - keypoints) ** 2).sum(dim=-1)
    return (weight * square).sum(dim=(-2, -1))


def roughness(
    turns: torch.Tensor, rotation: torch.Tensor, translation: torch.Tensor
) -> torch.Tensor:
    """Return R_temp = Σ_t ‖ξ_t − ξ_{t−1}‖² of rigid poses and bones, ``(…)``.

    Half the squared difference of two rotation matrices is, near one another, their angle squared.

    Parameters
    ----------
    turns : Tensor, (…, L, B, 3)
        Rotation vectors of bones.
    rotation : Tensor, (…, L, 3, 3)
        Of the body.
    translation : Tensor, (…, L, D)
        Of its root, metres.
    """
    bones = turns.diff(dim=-3).square().sum(dim=(-3, -2, -1))
    angles = 0.5 * rotation.diff(dim=-3).square().sum(dim=(-3, -2, -1))
    return bones + angles + translation.diff(dim=-2).square().sum(dim=(-2, -1))


def guess_terms(
    body: ArticulatedBody,
    guesses: PoseGuesses,
    keypoints: torch.Tensor,
    weight: torch.Tensor,
    distance: float | None,
) -> dict[str, torch.Tensor]:
    """Return the parts of the loss for every view hypothesis, each (B, H).

    Parameters
    ----------
    body : ArticulatedBody
        What moves.
    guesses : PoseGuesses
        Of B sequences of L frames.
    keypoints, weight : Tensor, (B, L, J, 2) and (B, L, J)
        As in :func:`reconstruction`.
    distance : float, optional
        As in :func:`pictured`.
    """
    turns = guesses.turns
    translation = torch.nn.functional.pad(guesses.translation, (0, 1))
    positions = body.positions(turns, guesses.rotation, translation, guesses.log_lengths)
    frames = keypoints.shape[-3]
    return {
        "reconstruction": reconstruction(positions, keypoints[:, None], weight[:, None], distance),
        "smoothness": roughness(turns, guesses.rotation, guesses.translation),
        "ranges": body.range_excess(turns).sum(dim=-1),
        "lengths": frames * guesses.log_lengths.square().sum(dim=-1),
    }


def weighted_sum(terms: Mapping[str, torch.Tensor], settings: MotionVAESettings) -> torch.Tensor:
    """Return Σ λ · term, with the settings' weight of each term's name."""
    total = torch.zeros(())
    for name, value in terms.items():
        total = total + getattr(settings, name) * value
    return total


def best_guess(guesses: PoseGuesses, losses: torch.Tensor) -> PoseGuesses:
    """Return, of each sequence, the view hypothesis of least loss, without the axis H.

    Parameters
    ----------
    guesses : PoseGuesses
        Of B sequences under H hypotheses.
    losses : Tensor, (B, H)
        No gradient flows through the choice.
    """
    rows = torch.arange(len(losses), device=losses.device)
    best = losses.detach().argmin(dim=1)
    return PoseGuesses(
        guesses.rotation[rows, best],
        guesses.translation[rows, best],
        guesses.turns[rows, best],
        guesses.log_lengths[rows, best],
    )
