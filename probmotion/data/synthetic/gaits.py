"""Procedural gaits: walking, running and marching people, walking and trotting quadrupeds.

Joint angles are smooth functions of a phase; speed, stride, lean, turning and other parameters
vary between clips. Bodies initially face +Z, left side to +X, and have constant bone lengths.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_positive

__all__ = ["GAITS", "make_gait", "make_gaits"]


@dataclass(frozen=True)
class Gait:
    """Parameters of a gait style, each as (mean, standard deviation) over clips.

    Angles are in radians, ``cadence`` in cycles/s, ``bounce`` in metres, ``turning`` in rad/s.
    """

    body: str
    cadence: tuple[float, float]
    stride: tuple[float, float]
    lift: tuple[float, float]
    lean: tuple[float, float]
    swing: tuple[float, float]
    bend: tuple[float, float]
    bounce: tuple[float, float]
    turning: tuple[float, float] = (0.0, 0.25)
    wander: float = 0.09
    """Root mean square of the random variation of each joint angle, radians."""
    footfall: tuple[float, float, float, float] = (0.0, 0.5, 0.75, 0.25)
    """Phases of the left hind, right hind, left fore and right fore leg of quadrupeds, cycles."""


GAITS: Mapping[str, Gait] = {
    "walk": Gait("person", (0.92, 0.06), (0.42, 0.05), (0.9, 0.1), (0.04, 0.03), (0.40, 0.08),
                 (0.3, 0.08), (0.02, 0.004)),
    "run": Gait("person", (1.40, 0.08), (0.70, 0.07), (1.6, 0.15), (0.20, 0.05), (0.65, 0.10),
                (1.5, 0.12), (0.05, 0.008)),
    "march": Gait("person", (0.85, 0.05), (0.55, 0.05), (1.5, 0.12), (-0.03, 0.02), (0.85, 0.10),
                  (0.1, 0.04), (0.02, 0.004)),
    "quadruped-walk": Gait("quadruped", (0.9, 0.07), (0.35, 0.04), (0.6, 0.08), (0.0, 0.03),
                           (0.25, 0.05), (0.2, 0.04), (0.01, 0.003), wander=0.06),
    "quadruped-trot": Gait("quadruped", (1.6, 0.1), (0.50, 0.05), (1.0, 0.1), (0.0, 0.03),
                           (0.15, 0.04), (0.35, 0.05), (0.03, 0.005),
                           wander=0.06, footfall=(0.0, 0.5, 0.5, 0.0)),
}  # fmt: skip
"""Gait styles by name."""


def make_gaits(
    n: int = 300,
    *,
    styles: Mapping[str, float] | None = None,
    frames: int = 30,
    fps: float = 30.0,
    seed: int = 0,
) -> list[Motion]:
    """Return ``n`` clips, up to rounding per style, of ``frames`` frames at ``fps`` frames/s.

    Parameters
    ----------
    n, frames, fps, seed
        Number of clips, frames per clip, frames per second and random seed.
    styles : mapping of str to float, optional
        Relative frequencies of styles with the same body; walk 0.5, run 0.3, march 0.2 by default.

    Raises
    ------
    ValueError
        If a style is unknown or a frequency is not positive.
    """
    check_count("n", n)
    weights = {"walk": 0.5, "run": 0.3, "march": 0.2} if styles is None else dict(styles)
    for style, weight in weights.items():
        check_positive(f"styles[{style!r}]", weight)
    return [
        make_gait(style, number, frames=frames, fps=fps, seed=seed)
        for style, weight in weights.items()
        for number in range(round(n * weight / sum(weights.values())))
    ]


def make_gait(
    style: str, number: int = 0, *, frames: int = 30, fps: float = 30.0, seed: int = 0
) -> Motion:
    """Return clip ``number`` of a style, independent of other clips.

    Raises
    ------
    ValueError
        If the style is unknown.
    """
    if style not in GAITS:
        raise ValueError(f"style must be one of {', '.join(GAITS)}, got {style!r}")
    check_count("frames", frames)
    check_positive("fps", fps)
    gait = GAITS[style]
    rng = seeds.generator(seed, "gait", style, number)
    time = np.arange(frames) / fps
    draw = {
        name: rng.normal(*getattr(gait, name))
        for name in ("cadence", "stride", "lift", "lean", "swing", "bend", "bounce", "turning")
    }
    phase = 2 * np.pi * (rng.random() + draw["cadence"] * time)
    body, leg, layout = _BODIES[gait.body]
    joints = body(phase, draw, gait, lambda: gait.wander * _wander(rng, time))
    heading = draw["turning"] * time
    speed = 4 * leg * np.sin(draw["stride"]) * draw["cadence"]
    c, s = np.cos(heading), np.sin(heading)
    path = np.stack([np.cumsum(s), np.zeros(frames), np.cumsum(c)], axis=-1) * speed / fps
    skeleton = Skeleton.preset(layout)
    flat = np.stack([joints[name] for name in skeleton.canonical_names], axis=1)
    x, y, z = flat[..., 0], flat[..., 1], flat[..., 2]
    rotated = np.stack([c[:, None] * x + s[:, None] * z, y, c[:, None] * z - s[:, None] * x], -1)
    return Motion(rotated + path[:, None], skeleton, fps, name=f"{style}-{number}")


def _direction(angle: np.ndarray) -> np.ndarray:
    """Return the unit vector at ``angle`` (forwards) from straight down, ``(…) → (…, 3)``."""
    return _in_plane(-np.cos(angle), np.sin(angle))


def _in_plane(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return vectors (0, y, z), of shape (…, 3)."""
    return np.stack([np.zeros_like(y), y, z], axis=-1)


def _across(yaw: np.ndarray, lean: np.ndarray) -> np.ndarray:
    """Return the unit vector to the left of a leaning body turned by ``yaw`` about its spine."""
    s = np.sin(yaw)
    return np.stack([np.cos(yaw), s * np.sin(lean), -s * np.cos(lean)], axis=-1)


def _wander(rng: np.random.Generator, time: np.ndarray) -> np.ndarray:
    """Return a smooth random function of time: frequencies 0.5 to 2 Hz, mean square 1."""
    frequency = np.array([0.5, 1.0, 1.5, 2.0])
    amplitude = rng.normal(size=(2, 4)) / 2
    angle = 2 * np.pi * np.outer(time, frequency)
    return np.cos(angle) @ amplitude[0] + np.sin(angle) @ amplitude[1]


def _flexion(phase: np.ndarray, peak: float) -> np.ndarray:
    """Return a smooth bump in [0, 1] around ``peak``: the flexion of a swinging knee."""
    return np.exp(2.0 * (np.cos(phase - peak) - 1.0))


def _person(
    phase: np.ndarray, draw: Mapping[str, float], gait: Gait, jitter: Callable[[], np.ndarray]
) -> dict[str, np.ndarray]:
    joints: dict[str, np.ndarray] = {}
    frames = len(phase)
    lean = draw["lean"] + 0.5 * jitter()
    up = _in_plane(np.cos(lean), np.sin(lean))
    pelvis = np.zeros((frames, 3))
    pelvis[:, 1] = 0.9 + draw["bounce"] * np.cos(2 * phase)
    sway = 0.12 * draw["stride"] / 0.42
    joints["pelvis"] = pelvis
    joints["spine"] = pelvis + 0.24 * up
    joints["neck"] = joints["spine"] + 0.26 * up
    tilt = 0.4 * lean + jitter()
    nod = _in_plane(np.cos(tilt), np.sin(tilt))
    face = _in_plane(-np.sin(tilt), np.cos(tilt))
    joints["nose"] = joints["neck"] + 0.12 * nod + 0.06 * face
    joints["head"] = joints["nose"] + 0.13 * nod - 0.06 * face
    for side, sign, angle in (("left", 1.0, phase), ("right", -1.0, phase + np.pi)):
        hip = draw["stride"] * np.sin(angle) + 0.15 * draw["lift"] * _flexion(angle, 0.6) + jitter()
        knee = 0.12 + 0.75 * draw["lift"] * _flexion(angle, -0.35) + jitter()
        joints[f"{side}_hip"] = pelvis + sign * 0.11 * _across(sway * np.sin(phase), lean)
        joints[f"{side}_knee"] = joints[f"{side}_hip"] + 0.43 * _direction(hip)
        joints[f"{side}_ankle"] = joints[f"{side}_knee"] + 0.42 * _direction(hip - knee)
        arm = -draw["swing"] * np.sin(angle) + 0.5 * lean + jitter()
        shoulder = joints["neck"] - 0.04 * up + sign * 0.17 * _across(-sway * np.sin(phase), lean)
        out = np.array([0.15 * sign, 0.0, 0.0])
        upper = _unit(_direction(arm) + out)
        elbow = draw["bend"] + 0.3 * draw["swing"] * np.cos(angle) + jitter()
        fore = _unit(_direction(arm + elbow) + 0.3 * out)
        joints[f"{side}_shoulder"] = shoulder
        joints[f"{side}_elbow"] = shoulder + 0.29 * upper
        joints[f"{side}_wrist"] = joints[f"{side}_elbow"] + 0.25 * fore
    return joints


def _quadruped(
    phase: np.ndarray, draw: Mapping[str, float], gait: Gait, jitter: Callable[[], np.ndarray]
) -> dict[str, np.ndarray]:
    joints: dict[str, np.ndarray] = {}
    frames = len(phase)
    nod = draw["bend"] + 0.15 * draw["swing"] * np.cos(2 * phase) + jitter()
    tail = np.zeros((frames, 3))
    tail[:, 1] = 0.62 + draw["bounce"] * np.cos(2 * phase)
    tail[:, 2] = -0.35
    slope = draw["lean"] + draw["bounce"] * np.sin(2 * phase) + 0.5 * jitter()
    neck = tail + 0.72 * _in_plane(np.sin(slope), np.cos(slope))
    face = _in_plane(np.cos(nod + 0.8), np.sin(nod + 0.8))
    brow = _in_plane(np.sin(nod + 0.8), -np.cos(nod + 0.8))
    joints["tail"], joints["neck"] = tail, neck
    joints["nose"] = neck + 0.36 * face
    for side, sign, hind, fore in (
        ("left", 1.0, gait.footfall[0], gait.footfall[2]),
        ("right", -1.0, gait.footfall[1], gait.footfall[3]),
    ):
        joints[f"{side}_eye"] = neck + 0.27 * face + 0.04 * brow + np.array([0.035 * sign, 0, 0])
        out = np.array([0.09 * sign, 0.0, 0.0])
        for root, first, second, third, offset, start in (
            (tail, "hip", "knee", "back_paw", hind, 0.1),
            (neck, "shoulder", "elbow", "front_paw", fore, -0.1),
        ):
            angle = phase + 2 * np.pi * offset
            upper = draw["stride"] * np.sin(angle) + 3.0 * start * draw["bend"] + jitter()
            knee = 0.55 * draw["lift"] * _flexion(angle, -0.35) + 4.0 * start * draw["bend"]
            lower = upper - knee + jitter()
            joints[f"{side}_{first}"] = root + out - np.array([0.0, 0.1, 0.4 * start])
            joints[f"{side}_{second}"] = joints[f"{side}_{first}"] + 0.25 * _direction(upper)
            joints[f"{side}_{third}"] = joints[f"{side}_{second}"] + 0.27 * _direction(lower)
    return joints


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


Body = Callable[
    [np.ndarray, Mapping[str, float], Gait, Callable[[], np.ndarray]], dict[str, np.ndarray]
]
_BODIES: Mapping[str, tuple[Body, float, str]] = {  # function, leg length (m), skeleton
    "person": (_person, 0.85, "h36m17"),
    "quadruped": (_quadruped, 0.52, "apt36k17"),
}
