"""Bone rotations of an articulated body that reproduce given joint positions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion.extras import torch
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.validation import check_finite, check_shape

__all__ = ["TurnFit", "fit_turns"]

_STEPS, _RATE = 400, 0.05
# Weights relative to squared errors in units of 10 cm: twists about bones are undetermined.
_TWIST, _RANGES, _UNIT = 1e-3, 0.01, 0.1


class TurnFit(NamedTuple):
    """Parameters of :meth:`ArticulatedBody.positions`, and the mean distance of joints, metres.

    ``turns`` (N, L, B, 3); ``rotation`` (N, L, 3, 3); ``translation`` (N, L, 3); ``log_lengths``
    (N, G).
    """

    turns: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    log_lengths: np.ndarray
    error: float


def fit_turns(body: ArticulatedBody, positions: np.ndarray) -> TurnFit:
    """Fit small bone rotations, softly limited by the joint ranges, to motions.

    Bone lengths are constant in each motion (N, L, J, 3), metres, Y up. Adam with a falling
    learning rate, from the rest pose facing as the body's left side implies.
    """
    check_shape("positions", positions, ("N", "L", body.skeleton.n_joints, 3))
    check_finite("positions", positions)
    target = torch.as_tensor(positions, dtype=torch.float64)
    n, frames = positions.shape[:2]
    facing = np.zeros((n, frames, 3))
    facing[..., 1] = _yaw(body, positions)
    parts = [
        torch.zeros(n, frames, len(body.bones), 3, dtype=torch.float64),
        torch.as_tensor(facing),
        target[:, :, body.skeleton.roots[0]].clone(),
        torch.zeros(n, body.n_groups, dtype=torch.float64),
    ]
    turns, root, place, log_lengths = (part.requires_grad_() for part in parts)
    optimiser = torch.optim.Adam(parts, lr=_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, _STEPS)
    for _ in range(_STEPS):
        optimiser.zero_grad()
        joints = body.positions(turns, vector_to_matrix(root), place, log_lengths)
        loss = ((joints - target) / _UNIT).square().sum(dim=-1).mean()
        loss = loss + _TWIST * turns.square().mean() + _RANGES * body.range_excess(turns).mean()
        loss.backward()
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        rotation = vector_to_matrix(root)
        joints = body.positions(turns, rotation, place, log_lengths)
        error = float((joints - target).norm(dim=-1).mean())
    turned, moved, longer = (part.detach().numpy() for part in (turns, place, log_lengths))
    return TurnFit(turned, rotation.numpy(), moved, longer, error)


def _yaw(body: ArticulatedBody, positions: np.ndarray) -> np.ndarray:
    """Return the direction of the front (N, L), radians from +Z, from the body's left side."""
    pairs = body.skeleton.mirrored_pairs
    if not pairs:
        return np.zeros(positions.shape[:2])
    rest, here = np.zeros(3), np.zeros((*positions.shape[:2], 3))
    for one, other in pairs:
        rest = rest + body.rest_positions[one] - body.rest_positions[other]
        here = here + positions[:, :, one] - positions[:, :, other]
    left = here * (1.0 if rest[0] > 0 else -1.0)
    yaw: np.ndarray = np.arctan2(-left[..., 2], left[..., 0])
    return yaw
