"""Noisy joints of a motion as overlapping windows, and one motion made of windows again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D

__all__ = ["NoisyWindows", "Stitching", "rough_placement"]

_FIRST = 5


@dataclass(frozen=True)
class NoisyWindows:
    """B windows of noisy joints, in the world, and roughly where each begins.

    Parameters
    ----------
    joints : Tensor, (B, L, J, 3)
        y, metres; 0 where hidden.
    noise : Tensor, (B, L, J)
        Standard deviation (Student-t: scale) of a coordinate, metres; 1 where hidden.
    seen : Tensor of bool, (B, L, J)
        What was observed.
    tails : Tensor, (B,)
        One over the degrees of freedom of the noise, 0 where it is Gaussian.
    heading : Tensor, (B,)
        Of the first frame, radians, roughly.
    ground : Tensor, (B, 2)
        X and Z of the first frame's root, metres, roughly.
    bodies : Tensor, (B, J, 3)
        Rest offsets of who moves, metres.
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
        """Return windows of arrays in the shapes above, with their rough placement."""
        heading, ground = rough_placement(joints, seen, skeleton)

        def single(values: np.ndarray) -> torch.Tensor:
            return torch.tensor(values, dtype=torch.float32)

        return cls(
            single(np.where(seen[..., None], joints, 0.0)),
            single(np.where(seen, noise, 1.0)),
            torch.tensor(seen),
            single(tails),
            single(heading),
            single(ground),
            single(bodies),
        )

    def __len__(self) -> int:
        """Number of windows."""
        return len(self.joints)

    def to(self, device: torch.device) -> NoisyWindows:
        """Return the same on a device."""
        return NoisyWindows(*(getattr(self, name).to(device) for name in self.__annotations__))

    def repeated(self, n: int) -> NoisyWindows:
        """Return n copies of all windows, one after the other."""

        def copies(values: torch.Tensor) -> torch.Tensor:
            return values.repeat(n, *(1 for _ in values.shape[1:]))

        return NoisyWindows(*(copies(getattr(self, name)) for name in self.__annotations__))

    def in_frame(self, heading: torch.Tensor, ground: torch.Tensor) -> torch.Tensor:
        """Return the joints in canonical frames, (B, L, J, 3); hidden ones are of no meaning."""
        moved = self.joints - on_ground(ground)[:, None, None, :]
        return turned_about_vertical(moved, -heading)


def on_ground(ground: torch.Tensor) -> torch.Tensor:
    """Return points of the ground in space, ``(…, 2) → (…, 3)``."""
    x, z = ground[..., 0], ground[..., 1]
    return torch.stack([x, torch.zeros_like(x), z], dim=-1)


def rough_placement(
    joints: np.ndarray, seen: np.ndarray, skeleton: Skeleton
) -> tuple[np.ndarray, np.ndarray]:
    """Return where windows roughly begin: headings (B,), radians, and ground points (B, 2), metres.

    The heading is that of left-right pairs in the first frames that show one; the ground point is
    the root's in the first frames that show it, or the mean of what they show.

    Parameters
    ----------
    joints : ndarray, (B, L, J, 3)
        World positions; not read where hidden.
    seen : ndarray of bool, (B, L, J)
        What was observed.
    skeleton : Skeleton
        J joints.

    Raises
    ------
    ValueError
        If a window shows nothing at all.
    """
    blind = np.flatnonzero(seen.sum(axis=(1, 2)) == 0)
    if len(blind):
        raise ValueError(
            f"joints has window {blind[0]} of {len(joints)} with every joint hidden, expected at "
            "least one joint in one frame of each"
        )
    left, right = (list(side) for side in zip(*skeleton.mirrored_pairs, strict=True))
    both = seen[:, :, left] & seen[:, :, right]
    apart = np.where(both[..., None], joints[:, :, left] - joints[:, :, right], 0.0).sum(axis=2)
    across = _over_first(apart, both.any(axis=2)).sum(axis=1)
    heading = np.arctan2(-across[:, 2], across[:, 0])
    root = skeleton.roots[0]
    count = seen.sum(axis=2)
    shown = np.where(seen[..., None], joints, 0.0).sum(axis=2) / np.maximum(count, 1)[..., None]
    rooted = seen[:, :, root].sum(axis=1) > 0
    points = np.where(rooted[:, None, None], np.nan_to_num(joints[:, :, root]), shown)
    there = np.where(rooted[:, None], seen[:, :, root], count > 0)
    first = _over_first(np.ones_like(there, dtype=float)[..., None], there)
    ground = (first * points).sum(axis=1) / first.sum(axis=1)
    return heading, ground[:, [0, 2]]


def _over_first(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return values (B, L, …) with 0 but in each window's first frames that are there."""
    order = np.cumsum(there, axis=1)
    return np.where((there & (order <= _FIRST))[..., None], values, 0.0)


@dataclass(frozen=True)
class Stitching:
    """How a motion of ``frames`` is cut into overlapping windows and made whole again.

    Parameters
    ----------
    frames : int
        L, of the motion.
    window : int
        Frames of a window; a shorter motion is one window.
    overlap : int
        Frames that neighbours share, at least; the last window ends with the motion.
    """

    frames: int
    window: int
    overlap: int

    @property
    def length(self) -> int:
        """Frames of every window."""
        return min(self.window, self.frames)

    @property
    def starts(self) -> list[int]:
        """First frames of the windows."""
        last = self.frames - self.length
        return [*range(0, last, self.window - self.overlap), last]

    @property
    def weights(self) -> np.ndarray:
        """Share of each window in each of its frames, (B, length); they add up to 1 in the motion.

        Shares rise and fall smoothly over the overlap, so that no frame jumps.
        """
        from_edge = np.minimum(np.arange(self.length), np.arange(self.length)[::-1]) + 1
        ramp = np.sin(0.5 * math.pi * np.minimum(1, from_edge / (self.overlap + 1))) ** 2
        total = self.joined(np.tile(ramp[:, None], (len(self.starts), 1, 1)))[:, 0]
        return np.stack([ramp / total[at : at + self.length] for at in self.starts])

    def cut(self, values: np.ndarray) -> np.ndarray:
        """Return windows of values, ``(L, …) → (B, length, …)``."""
        return np.stack([values[at : at + self.length] for at in self.starts])

    def joined(self, windows: np.ndarray) -> np.ndarray:
        """Return the sum of windows where they lie, ``(…, B, length, D) → (…, L, D)``."""
        out = np.zeros((*windows.shape[:-3], self.frames, windows.shape[-1]))
        for number, at in enumerate(self.starts):
            out[..., at : at + self.length, :] += windows[..., number, :, :]
        return out

    def mean(self, windows: np.ndarray) -> np.ndarray:
        """Return one motion by shares, ``(…, B, length, J, 3) → (…, L, J, 3)``."""
        flat = windows.reshape(*windows.shape[:-2], -1) * self.weights[:, :, None]
        return self.joined(flat).reshape(*windows.shape[:-4], self.frames, *windows.shape[-2:])

    def draws(self, windows: np.ndarray, means: np.ndarray) -> np.ndarray:
        """Return draws of whole motions from independent draws of windows.

        The mean of two independent draws varies less than either. So what differs from the
        windows' means is divided by the root of the sum of squared shares, which keeps the
        variance where windows agree on it.

        Parameters
        ----------
        windows : ndarray, (n, B, length, J, 3)
            Draws of windows, metres.
        means : ndarray, (B, length, J, 3)
            Their means.
        """
        squares = self.joined(self.weights[..., None] ** 2)[:, 0]
        around = self.mean(windows - means) / np.sqrt(squares)[:, None, None]
        return self.mean(means) + around


def windows_of(
    evidence: Joints3D, body: np.ndarray, skeleton: Skeleton, stitching: Stitching, tails: float
) -> NoisyWindows:
    """Return the windows of some evidence; ``tails`` is one over the degrees of freedom."""
    entries: Any = evidence.entries
    noise = evidence.noise / np.sqrt(np.where(entries.visible, entries.confidence, 1.0))
    n = len(stitching.starts)
    return NoisyWindows.of(
        stitching.cut(evidence.joints),
        stitching.cut(noise),
        stitching.cut(entries.visible),
        np.full(n, tails),
        np.broadcast_to(body, (n, *body.shape)),
        skeleton,
    )
