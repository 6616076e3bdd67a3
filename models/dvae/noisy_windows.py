"""Overlapping windows of noisy joints and their stitching into full motions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from probmotion.extras import torch
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D

__all__ = ["NoisyWindows", "Stitching", "rough_placement"]

_PLACEMENT_FRAMES = 5  # Maximum number of frames for the estimate of a placement.


@dataclass(frozen=True)
class NoisyWindows:
    """B windows of noisy joints in world coordinates with an approximate initial placement.

    ``joints`` (B, L, J, 3): y, metres, 0 where occluded; ``noise`` (B, L, J): standard deviation
    (Student-t: scale), metres, 1 where occluded; ``seen`` (B, L, J): visibility; ``tails`` (B,):
    reciprocal degrees of freedom, 0 for Gaussian noise; ``heading`` (B,), radians, and ``ground``
    (B, 2), metres: initial placement; ``bodies`` (B, J, 3): rest offsets, metres.
    """

    joints: torch.Tensor
    noise: torch.Tensor
    seen: torch.Tensor
    tails: torch.Tensor
    heading: torch.Tensor
    ground: torch.Tensor
    bodies: torch.Tensor

    @classmethod
    def of(
        cls,
        joints: np.ndarray,
        noise: np.ndarray,
        seen: np.ndarray,
        tails: np.ndarray,
        bodies: np.ndarray,
        skeleton: Skeleton,
    ) -> NoisyWindows:
        """Return windows from arrays with the shapes of the fields; estimate the placement."""
        heading, ground = rough_placement(joints, seen, skeleton)
        joints, noise = np.where(seen[..., None], joints, 0.0), np.where(seen, noise, 1.0)
        single = partial(torch.tensor, dtype=torch.float32)
        placement = map(single, (tails, heading, ground, bodies))
        return cls(single(joints), single(noise), torch.tensor(seen), *placement)

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.joints)

    def to(self, device: torch.device) -> NoisyWindows:
        """Return a copy on a device."""
        return NoisyWindows(*(getattr(self, name).to(device) for name in self.__annotations__))

    def repeated(self, n: int) -> NoisyWindows:
        """Return n consecutive copies of all windows."""
        parts = (getattr(self, name) for name in self.__annotations__)
        return NoisyWindows(*(part.repeat(n, *[1] * (part.ndim - 1)) for part in parts))

    def in_frame(self, heading: torch.Tensor, ground: torch.Tensor) -> torch.Tensor:
        """Return joints in a canonical frame, (B, L, J, 3); undefined where occluded."""
        centred = self.joints - on_ground(ground)[:, None, None, :]
        return turned_about_vertical(centred, -heading)


def on_ground(ground: torch.Tensor) -> torch.Tensor:
    """Return ground points (X, Z) as points (X, 0, Z), ``(…, 2) → (…, 3)``."""
    x, z = ground[..., 0], ground[..., 1]
    return torch.stack([x, torch.zeros_like(x), z], dim=-1)


def rough_placement(
    joints: np.ndarray, seen: np.ndarray, skeleton: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate headings (B,), radians, and ground points (B, 2), metres, of B windows.

    The heading is estimated from left-right joint pairs in the first frames with a visible pair,
    the ground point from the first visible roots, or mean visible joints if the root is occluded.
    Arguments are world positions (B, L, J, 3), ignored where occluded, and visibility (B, L, J).
    Raises ``ValueError`` for a window without a visible joint.
    """
    empty = np.flatnonzero(~seen.any(axis=(1, 2)))
    if len(empty):
        raise ValueError(
            f"every window of joints must have a visible joint, got none in window {empty[0]} of "
            f"{len(joints)}"
        )
    left, right = (list(side) for side in zip(*skeleton.mirrored_pairs, strict=True))
    paired = seen[:, :, left] & seen[:, :, right]
    offsets = np.where(paired[..., None], joints[:, :, left] - joints[:, :, right], 0.0).sum(axis=2)
    across = _first_valid(offsets, paired.any(axis=2)).sum(axis=1)
    heading = np.arctan2(-across[:, 2], across[:, 0])
    root = skeleton.roots[0]
    count = seen.sum(axis=2)
    visible = np.where(seen[..., None], joints, 0.0).sum(axis=2) / np.maximum(count, 1)[..., None]
    root_seen = seen[:, :, root].sum(axis=1) > 0
    points = np.where(root_seen[:, None, None], np.nan_to_num(joints[:, :, root]), visible)
    valid = np.where(root_seen[:, None], seen[:, :, root], count > 0)
    first = _first_valid(np.ones_like(valid, dtype=float)[..., None], valid)
    ground = (first * points).sum(axis=1) / first.sum(axis=1)
    return heading, ground[:, [0, 2]]


def _first_valid(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return values (B, L, …), set to 0 outside the first valid frames of each window."""
    order = np.cumsum(valid, axis=1)
    return np.where((valid & (order <= _PLACEMENT_FRAMES))[..., None], values, 0.0)


@dataclass(frozen=True)
class Stitching:
    """Segmentation of a motion into overlapping windows, and its inverse.

    A motion of ``frames`` frames L is cut into windows of ``window`` frames, or is one window if it
    is shorter. Neighbours overlap by at least ``overlap`` frames; the last window ends at the
    last frame.
    """

    frames: int
    window: int
    overlap: int

    @property
    def length(self) -> int:
        """Number of frames per window."""
        return min(self.window, self.frames)

    @property
    def starts(self) -> list[int]:
        """Index of the first frame of each window."""
        last = self.frames - self.length
        return [*range(0, last, self.window - self.overlap), last]

    @property
    def weights(self) -> np.ndarray:
        """Weight of each window in its frames, (B, length), with a sum of 1 in every frame.

        Weights are sin² ramps over the overlap.
        """
        from_edge = np.minimum(np.arange(self.length), np.arange(self.length)[::-1]) + 1
        ramp = np.sin(0.5 * math.pi * np.minimum(1, from_edge / (self.overlap + 1))) ** 2
        total = self.joined(np.tile(ramp[:, None], (len(self.starts), 1, 1)))[:, 0]
        return np.stack([ramp / total[at : at + self.length] for at in self.starts])

    def cut(self, values: np.ndarray) -> np.ndarray:
        """Return windows of values, ``(L, …) → (B, length, …)``."""
        return np.stack([values[at : at + self.length] for at in self.starts])

    def joined(self, windows: np.ndarray) -> np.ndarray:
        """Return the sum of overlapping windows, ``(…, B, length, D) → (…, L, D)``."""
        out = np.zeros((*windows.shape[:-3], self.frames, windows.shape[-1]))
        for number, at in enumerate(self.starts):
            out[..., at : at + self.length, :] += windows[..., number, :, :]
        return out

    def mean(self, windows: np.ndarray) -> np.ndarray:
        """Return the weighted mean of windows, ``(…, B, length, J, 3) → (…, L, J, 3)``."""
        flat = windows.reshape(*windows.shape[:-2], -1) * self.weights[:, :, None]
        return self.joined(flat).reshape(*windows.shape[:-4], self.frames, *windows.shape[-2:])

    def draws(self, windows: np.ndarray, means: np.ndarray) -> np.ndarray:
        """Return draws of full motions (n, L, J, 3) from independent draws of windows.

        Averaging independent draws reduces their variance. Deviations from the window ``means``
        (B, length, J, 3) are therefore divided by the root of the summed squared weights, which
        restores the variance if it is the same in all windows.
        """
        squares = self.joined(self.weights[..., None] ** 2)[:, 0]
        deviations = self.mean(windows - means) / np.sqrt(squares)[:, None, None]
        return self.mean(means) + deviations


def windows_of(
    likelihood: Joints3D, body: np.ndarray, skeleton: Skeleton, stitching: Stitching, tails: float
) -> NoisyWindows:
    """Return the windows of observed joints; ``tails``: reciprocal degrees of freedom."""
    entries: Any = likelihood.entries
    noise = likelihood.noise / np.sqrt(np.where(entries.visible, entries.confidence, 1.0))
    n = len(stitching.starts)
    return NoisyWindows.of(
        stitching.cut(likelihood.joints),
        stitching.cut(noise),
        stitching.cut(entries.visible),
        np.full(n, tails),
        np.broadcast_to(body, (n, *body.shape)),
        skeleton,
    )
