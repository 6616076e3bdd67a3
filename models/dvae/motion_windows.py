"""Windows of clips as canonical body states, drawn at random for training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from probmotion.geometry.rotations import matrix_to_six_numbers, six_numbers_to_matrix
from probmotion.models.bodies.body_states import BodyStates, heading_of
from probmotion.motion.motion import Motion

__all__ = ["MotionWindows", "Windows"]

_TEMPO = 1.25


class Windows(NamedTuple):
    """B windows: canonical states (B, L, D), and their bodies' rest offsets (B, J, 3), metres."""

    states: np.ndarray
    bodies: np.ndarray


class MotionWindows:
    """All windows of some clips, and of their mirror images.

    Parameters
    ----------
    clips : sequence of Motion
        Of one skeleton and frame rate.
    states : BodyStates
        What they become.
    frames : int
        L, of a window.
    mirrored : bool
        Whether every clip is there mirrored too.

    Raises
    ------
    ValueError
        If no clip is long enough, or a clip has another skeleton or frame rate than the first.
    """

    def __init__(
        self, clips: Sequence[Motion], states: BodyStates, frames: int, mirrored: bool = True
    ) -> None:
        long = [clip for clip in clips if clip.frames >= frames]
        if not long:
            most = max((clip.frames for clip in clips), default=0)
            raise ValueError(
                f"clips has none of {frames} frames or more, expected one; the longest has {most}"
            )
        self.fps = long[0].fps
        for clip in long:
            if clip.skeleton != states.skeleton or clip.fps != self.fps:
                raise ValueError(
                    f"clips has {clip}, expected the skeleton of the states at {self.fps:g} frames "
                    "per second"
                )
        self.frames = frames
        order = list(states.skeleton.mirrored_order)
        poses = [clip.positions for clip in long]
        if mirrored:
            poses += [clip[:, order] * np.array([-1.0, 1.0, 1.0]) for clip in poses]
        self._bodies = np.stack([states.body(clip) for clip in poses])
        self._states = [
            states.states(clip, body) for clip, body in zip(poses, self._bodies, strict=True)
        ]
        # Every window is as likely as every other, whatever the length of its clip.
        counts = [len(clip) - frames + 1 for clip in poses]
        self._clip = np.repeat(np.arange(len(poses)), counts)
        self._start = np.concatenate([np.arange(count) for count in counts])

    def __len__(self) -> int:
        """Number of windows."""
        return len(self._clip)

    def draw(self, rng: np.random.Generator, n: int) -> Windows:
        """Return n windows, any of them more than once, each at a tempo of its own.

        The same is done faster and slower: up to a quarter, as far as the clip goes.
        """
        numbers = rng.integers(0, len(self), n)
        tempo = np.exp(rng.uniform(-1, 1, n) * math.log(_TEMPO))
        pieces = []
        for clip, start, factor in zip(
            self._clip[numbers], self._start[numbers], tempo, strict=True
        ):
            states = self._states[clip]
            last = min(start + factor * (self.frames - 1), len(states) - 1)
            pieces.append(_between(states, np.linspace(start, last, self.frames)))
        return Windows(canonical_windows(np.stack(pieces)), self._bodies[self._clip[numbers]])

    def spread(self, n: int) -> Windows:
        """Return n windows evenly apart over all, the same ones at every call."""
        return self.at(np.linspace(0, len(self) - 1, min(n, len(self))).astype(int))

    def at(self, numbers: np.ndarray) -> Windows:
        """Return windows by their numbers."""
        clips = self._clip[numbers]
        pieces = [
            self._states[clip][start : start + self.frames]
            for clip, start in zip(clips, self._start[numbers], strict=True)
        ]
        return Windows(canonical_windows(np.stack(pieces)), self._bodies[clips])


def _between(states: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return states (T, D) at times between frames; six numbers turn as their matrices would."""
    before = np.minimum(times.astype(int), len(states) - 2)
    share = (times - before)[:, None]
    return (1 - share) * states[before] + share * states[before + 1]


def canonical_windows(states: np.ndarray) -> np.ndarray:
    """Return windows whose first frames stand at the origin with heading 0, (B, L, D)."""
    root = six_numbers_to_matrix(states[..., 3:9])
    heading = heading_of(root[:, 0])
    cosine, sine = np.cos(heading), np.sin(heading)
    back = np.zeros((len(states), 1, 3, 3))
    back[:, 0, 1, 1] = 1
    back[:, 0, 0, 0] = back[:, 0, 2, 2] = cosine
    back[:, 0, 0, 2], back[:, 0, 2, 0] = -sine, sine
    moved = states.copy()
    moved[..., [0, 2]] -= states[:, :1, [0, 2]]
    moved[..., :3] = (back @ moved[..., :3, None])[..., 0]
    moved[..., 3:9] = matrix_to_six_numbers(back @ root)
    return moved
