"""Choreography of procedural couple dances: eight-beat figures and the path of each partner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["HOLDS", "Dance", "Figure", "draw_dance", "level", "rise"]

_FIGURE = 8  # duration of a figure, beats
# Minimum and maximum distance between the partners' roots by hold, metres.
HOLDS = {"open": (0.60, 0.78), "closed": (0.46, 0.56), "one hand": (0.62, 0.85)}
_TURN_DISTANCE = 0.5  # distance between the roots during a turn, metres


@dataclass(frozen=True)
class Figure:
    """Eight-beat figure: hold, distance between the partners (m), displacement (m) and turns."""

    hold: str
    distance: float
    forward: float
    aside: float
    turns: int  # index of the person who turns under the arm; 2: neither
    sense: float  # sense of rotation, -1 or 1


@dataclass(frozen=True)
class Dance:
    """Parameters of one dance; methods are smooth functions of the time (n,), seconds.

    Angles are in radians, ``beat`` is in s, ``start`` in beats, ``turning`` in rad/s, ``sway`` and
    ``hands`` (height offset) in m; ``bend`` is the hip height as a fraction of straight legs.
    """

    figures: tuple[Figure, ...]
    beat: float
    start: float
    heading: float
    turning: float
    heights: np.ndarray  # (2,)
    bend: np.ndarray  # (2,)
    lean: np.ndarray  # (2,)
    sway: float
    twist: float
    hands: float
    waves: np.ndarray  # (channels, 3, 2): sine and cosine of three slow frequencies

    def beats(self, time: np.ndarray) -> np.ndarray:
        """Return the time in beats since the start of the first figure."""
        return self.start + time / self.beat

    def wander(self, channel: int, time: np.ndarray) -> np.ndarray:
        """Return the slow random function of a channel, with mean square 1."""
        angle = 2 * np.pi * np.multiply.outer(time, [0.11, 0.23, 0.41])
        sine, cosine = self.waves[channel].T
        return (np.sin(angle) @ sine + np.cos(angle) @ cosine) / np.sqrt(3)

    def weights(self, time: np.ndarray) -> np.ndarray:
        """Return the weight of each figure, (figures, n); transitions last 1.5 beats."""
        starts = _FIGURE * np.arange(len(self.figures))[:, None]
        started = rise((self.beats(time) - starts + 0.75) / 1.5)
        return started - np.vstack([started[1:], np.zeros_like(started[:1])])

    def raised(self, time: np.ndarray, person: int) -> np.ndarray:
        """Return how far the hands are raised for turns of ``person``, from 0 to 1."""
        turns = self._beats_into_turns(time, person)
        lifts = (rise((x - 0.4) / 1.6) - rise((x - 6.0) / 1.6) for x in turns)
        return sum(lifts, np.zeros_like(time))

    def turn_angle(self, time: np.ndarray, person: int) -> np.ndarray:
        """Return the angle by which ``person`` has turned under the raised hands."""
        angles = [2 * np.pi * figure.sense for figure in self.figures if figure.turns == person]
        turns = zip(angles, self._beats_into_turns(time, person), strict=True)
        return sum((angle * rise((x - 1.9) / 4.2) for angle, x in turns), np.zeros_like(time))

    def _beats_into_turns(self, time: np.ndarray, person: int) -> list[np.ndarray]:
        beats = self.beats(time)
        return [beats - _FIGURE * k for k, f in enumerate(self.figures) if f.turns == person]

    def position_and_yaw(self, time: np.ndarray, person: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the ground position (n, 3) of a person's root, y = 0, and the yaw (n,)."""
        weights = self.weights(time)
        starts = _FIGURE * np.arange(len(self.figures))[:, None]
        elapsed = np.clip(self.beats(time) - starts, 0, _FIGURE)
        excursion = np.sin(np.pi * elapsed / _FIGURE * 2) * np.sin(np.pi * elapsed / _FIGURE) ** 2
        forward = np.array([figure.forward for figure in self.figures]) @ excursion
        aside = np.array([figure.aside for figure in self.figures]) @ excursion
        distance = np.array([figure.distance for figure in self.figures]) @ weights
        raised = self.raised(time, 0) + self.raised(time, 1)
        distance = distance + raised * (_TURN_DISTANCE - distance)
        heading = self.heading + self.turning * time + 0.25 * self.wander(0, time)
        facing = level(heading)
        x, z = self.wander(1, time), self.wander(2, time)
        centre = 0.15 * np.stack([x, np.zeros_like(time), z], axis=-1)
        centre += forward[:, None] * facing + aside[:, None] * level(heading + np.pi / 2)
        # Each partner is offset to the left and sways over the supporting foot.
        closed = np.array([figure.hold == "closed" for figure in self.figures]) @ weights
        left = 0.05 * closed + self.sway * np.sin(np.pi * self.beats(time))
        yaw = heading + np.pi * person
        root = centre - 0.5 * distance[:, None] * level(yaw)
        root = root + left[:, None] * level(yaw + np.pi / 2)
        return root, yaw + 0.12 * self.wander(3 + person, time) + self.turn_angle(time, person)


def draw_dance(rng: np.random.Generator, duration: float) -> Dance:
    """Return a random dance longer than ``duration`` seconds.

    With equally seeded generators, a longer dance starts with the figures of a shorter one.
    """
    beat = rng.uniform(0.44, 0.56)
    style = {
        "start": _FIGURE + rng.uniform(0, _FIGURE),
        "heading": rng.uniform(-np.pi, np.pi),
        "turning": rng.normal(0.0, 0.25),
        "sway": rng.uniform(0.01, 0.03),
        "twist": rng.uniform(0.05, 0.2),
        "hands": rng.normal(0.0, 0.06),
    }
    heights = rng.normal((1.70, 1.60), 0.02)
    bend = rng.uniform(0.955, 0.975, size=2)
    lean = rng.normal((0.03, 0.0), 0.03)
    waves = rng.normal(size=(11, 3, 2))
    # One extra figure at both ends, because foot placement uses earlier and later positions.
    figures = tuple(_draw_figure(rng) for _ in range(int(duration / beat / _FIGURE) + 4))
    return Dance(figures, beat, heights=heights, bend=bend, lean=lean, waves=waves, **style)


def _draw_figure(rng: np.random.Generator) -> Figure:
    turns = int(rng.choice(3, p=[0.1, 0.4, 0.5]))
    holds = [hold for hold in HOLDS if turns == 2 or hold != "closed"]
    hold = holds[rng.integers(len(holds))]
    forward, aside = rng.uniform(-1, 1, size=2) * (0.25, 0.2) * (turns == 2)
    sense = float(rng.choice([-1.0, 1.0]))
    return Figure(hold, rng.uniform(*HOLDS[hold]), forward, aside, turns, sense)


def level(yaw: np.ndarray) -> np.ndarray:
    """Return horizontal unit vectors (n, 3) at the angle ``yaw`` from +Z towards +X."""
    return np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=-1)


def rise(x: np.ndarray) -> np.ndarray:
    """Return a C² step from 0 at x = 0 to 1 at x = 1."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)
