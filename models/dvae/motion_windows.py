"""Random windows of motion clips as canonical body states, for training."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.geometry.rotations import matrix_to_rotation_6d, rotation_6d_to_matrix
from probmotion.models.bodies.body_states import BodyStates, heading_of
from probmotion.motion.motion import Motion

__all__ = ["VALIDATION_BATCH", "MotionWindows", "WindowTrainee", "Windows", "canonical_windows"]

VALIDATION_BATCH = 256  # Number of held-out windows.
_TEMPO = 1.25  # Maximum tempo; the minimum is its reciprocal.


class Windows(NamedTuple):
    """B windows: canonical states (B, L, D) and rest offsets of the bodies (B, J, 3), metres."""

    states: np.ndarray
    bodies: np.ndarray


class MotionWindows:
    """All windows of ``frames`` frames in motion clips and their mirror images.

    Raises ``ValueError`` if no clip is long enough, or clips differ in skeleton or frame rate.
    """

    def __init__(self, clips: Sequence[Motion], states: BodyStates, frames: int) -> None:
        long = [clip for clip in clips if clip.frames >= frames]
        if not long:
            longest = max((clip.frames for clip in clips), default=0)
            raise ValueError(
                f"clips must contain one of at least {frames} frames, got at most {longest}"
            )
        self.fps = long[0].fps
        for clip in long:
            if clip.skeleton != states.skeleton or clip.fps != self.fps:
                raise ValueError(
                    f"clips must have the skeleton of the states and {self.fps:g} frames per "
                    f"second, got {clip}"
                )
        self.frames = frames
        order = list(states.skeleton.mirrored_order)
        poses = [clip.positions for clip in long]
        poses += [clip[:, order] * np.array([-1.0, 1.0, 1.0]) for clip in poses]
        self._bodies = np.stack([states.body(clip) for clip in poses])
        self._states = list(map(states.states, poses, self._bodies))
        # Index all windows, so that draws are uniform over windows rather than clips.
        counts = [len(clip) - frames + 1 for clip in poses]
        self._clip = np.repeat(np.arange(len(poses)), counts)
        self._start = np.concatenate([np.arange(count) for count in counts])

    def __len__(self) -> int:
        """Number of windows."""
        return len(self._clip)

    def draw(self, rng: np.random.Generator, n: int) -> Windows:
        """Return n windows drawn with replacement, each at a random tempo of 0.8 to 1.25."""
        numbers = rng.integers(0, len(self), n)
        tempo = np.exp(rng.uniform(-1, 1, n) * math.log(_TEMPO))
        clips, segments = self._clip[numbers], []
        for clip, start, factor in zip(clips, self._start[numbers], tempo, strict=True):
            states = self._states[clip]
            last = min(start + factor * (self.frames - 1), len(states) - 1)
            segments.append(_interpolated(states, np.linspace(start, last, self.frames)))
        return Windows(canonical_windows(np.stack(segments)), self._bodies[clips])

    def spread(self, n: int) -> Windows:
        """Return n evenly spaced windows; deterministic."""
        return self.at(np.linspace(0, len(self) - 1, min(n, len(self))).astype(int))

    def at(self, numbers: np.ndarray) -> Windows:
        """Return the windows with given indices, at the original tempo."""
        clips = self._clip[numbers]
        segments = [
            self._states[clip][start : start + self.frames]
            for clip, start in zip(clips, self._start[numbers], strict=True)
        ]
        return Windows(canonical_windows(np.stack(segments)), self._bodies[clips])


def _interpolated(states: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Interpolate states (T, D) linearly at fractional frames."""
    before = np.minimum(times.astype(int), len(states) - 2)
    fraction = (times - before)[:, None]
    return (1 - fraction) * states[before] + fraction * states[before + 1]


def canonical_windows(states: np.ndarray) -> np.ndarray:
    """Return windows that start above the origin with heading 0, (B, L, D)."""
    root = rotation_6d_to_matrix(states[..., 3:9])
    heading = heading_of(root[:, 0])
    cosine, sine = np.cos(heading), np.sin(heading)
    back = np.zeros((len(states), 1, 3, 3))
    back[:, 0, 1, 1] = 1
    back[:, 0, 0, 0] = back[:, 0, 2, 2] = cosine
    back[:, 0, 0, 2], back[:, 0, 2, 0] = -sine, sine
    canonical = states.copy()
    canonical[..., [0, 2]] -= states[:, :1, [0, 2]]
    canonical[..., :3] = (back @ canonical[..., :3, None])[..., 0]
    canonical[..., 3:9] = matrix_to_rotation_6d(back @ root)
    return canonical


class WindowTrainee:
    """Base class of trainees on windows of clips, with an annealed loss weight."""

    _loss: Callable[..., torch.Tensor]

    def __init__(
        self,
        clips: Sequence[Motion],
        validation: Sequence[Motion],
        states: BodyStates,
        frames: int,
        weight: float,
        annealing: int,
        seed: int,
    ) -> None:
        self.windows = MotionWindows(clips, states, frames)
        self.held_out = MotionWindows(validation, states, frames)
        if self.held_out.fps != self.windows.fps:
            expected, got = self.windows.fps, self.held_out.fps
            raise ValueError(f"validation must have {expected:g} frames per second, got {got:g}")
        self.annealing, self._seed = annealing, seed
        self._full_weight = self._weight = weight

    def anneal(self, step: int) -> None:
        """Set the loss weight for a training step."""
        self._weight = self._full_weight * min(1.0, step / max(1, self.annealing))

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of random windows."""
        return self._loss(network, self.windows.draw(rng, batch), rng, self._weight, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss of held-out windows with fixed noise and the full weight."""
        rng = seeds.generator(self._seed, "validation")
        windows = self.held_out.spread(VALIDATION_BATCH)
        return float(self._loss(network, windows, rng, self._full_weight, device))
