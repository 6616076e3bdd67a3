"""Checks of a lift: whether a person before a still camera explains the keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import (
    ANKLES,
    HIPS,
    SHOULDERS,
    BodyPath,
    PersonKeypoints,
    averaged,
    smooth_size,
)
from probmotion.lifting.window_posterior import WindowSummary

__all__ = [
    "MEDIAN", "Check", "Evidence", "check_upright", "checked", "proportions", "uncertain",
]  # fmt: skip

MEDIAN = 1.66
"""Median of squared residuals of a keypoint under Student-t noise with 4 degrees of freedom."""


@dataclass(frozen=True)
class Check:
    """Result of a check.

    Parameters
    ----------
    name : str
        Name of the quantity.
    value, limit : float
        Its value, and the largest one with which the lift is trusted.
    problem : str
        What a larger value says.
    """

    name: str
    value: float
    limit: float
    problem: str

    @property
    def passed(self) -> bool:
        """Whether the value is at most the limit."""
        return self.value <= self.limit


class Evidence(NamedTuple):
    """Keypoints, frame rate, camera, noise (pixels) and mean (L, J, 3).

    ``mirrored`` is the log evidence per window of keypoints with exchanged sides, minus that of the
    given ones; an estimated pitch is that of each.
    """

    keypoints: PersonKeypoints
    fps: float
    camera: LevelCamera
    noise: float
    mean: np.ndarray
    mirrored: float


_STEP, _LAG = 1 / 15, 2  # keypoints are averaged over _STEP seconds and compared _LAG steps apart
# Medians of the absolute value of a standard normal, and of the smaller one of two of them.
_ONE, _TWO = 0.674, 0.376
_FEWEST, _SHARE = 10, 0.1  # visible frames of the joints whose residuals are checked
# Chosen on lifts of clips that a prior and a network had not seen, so that none with an error below
# 100 mm fails if other clips of its kind of motion had been fitted. ``unsteady`` and ``mirrored``
# have to be low enough for moving cameras and mirrored videos.
_LIMITS = {
    "noise": (0.06, "the keypoints' noise is more than 6 cm at the person's distance"),
    "residual": (2.6, "keypoints of a joint do not follow a body before a still camera"),
    "unsteady": (0.28, "feet and body move sideways together (does the camera move?)"),
    "mirrored": (
        20.0,
        "the motion is more likely with left and right exchanged (was the image mirrored after "
        "detection? --flip x)",
    ),
}
_UNCERTAIN = 0.12  # metres; chosen likewise
_PROPORTIONS = (6.0, 3.0)  # of one camera, chosen likewise, and of several
# Height of ankles above shoulders in the image, metres at the person's scale. People who get up or
# crawl, seen from a height of 4 m, reach .61 m.
_UPSIDE_DOWN = 0.7


def check_upright(keypoints: PersonKeypoints, path: BodyPath) -> None:
    """Raise ``ValueError`` for people who are upside down in the image."""
    points, weight, _ = keypoints
    shown = weight > 0
    shoulders, ankles = (
        (shown[:, joints] * points[:, joints, 1]).sum(axis=1)
        / np.maximum(shown[:, joints].sum(axis=1), 1)
        for joints in (SHOULDERS, ANKLES)
    )
    seen = shown[:, SHOULDERS].any(axis=1) & shown[:, ANKLES].any(axis=1)
    below = ((shoulders - ankles) / smooth_size(path.size))[seen]
    enough = min(max(_FEWEST, _SHARE * len(points)), len(points))
    if len(below) >= enough and np.median(below) > _UPSIDE_DOWN:
        raise ValueError(
            f"keypoints must show a person upright, got shoulders {np.median(below):.1f} m below "
            "the ankles; flip them: --flip y of probmotion lift, or KeypointTrack.flipped, if y "
            "points up, --flip xy if the video is upside down"
        )


def checked(evidence: Evidence) -> tuple[Check, ...]:
    """Return the checks of the keypoints of a camera.

    ``noise``: that of keypoints, in metres at the person's distance. ``residual``: largest ratio of
    a joint's robust residuals to the noise. ``unsteady``: the smaller of the slower ankle's speed
    across the image and of the hips' deviation from a velocity that changes linearly, both without
    the contribution of the noise, metres per second. ``mirrored``: score of exchanged sides, minus
    that of the given.
    """
    points, weight, _ = evidence.keypoints
    residual = np.linalg.norm(points - evidence.camera.pixels(evidence.mean), axis=-1)
    standardised = residual * np.sqrt(weight) / evidence.noise
    counts = (standardised > 0).sum(axis=0)
    enough = min(max(_FEWEST, _SHARE * len(points)), counts.max())
    joints = [
        float(np.sqrt(np.median(values[values > 0] ** 2) / MEDIAN))
        for values, count in zip(standardised.T, counts, strict=True)
        if count >= enough
    ]
    depth = evidence.camera.depth(evidence.mean).mean()
    values = {
        "noise": evidence.noise * depth / evidence.camera.focal,
        "residual": max(joints),
        "unsteady": _unsteadiness(evidence),
        "mirrored": evidence.mirrored,
    }
    return tuple(
        Check(name, float(values[name]), limit, problem)
        for name, (limit, problem) in _LIMITS.items()
    )


def uncertain(windows: Sequence[WindowSummary]) -> Check:
    """Return the check of how uncertain the joints' positions are, for one camera.

    ``uncertain``: standard deviation of visible joints relative to the hips, mean over joints,
    median over windows, metres, for a person of 1.7 m and the estimated pitch. It is large for
    motions unlike the clips, such as those of animals or of people who crawl, where standard
    deviations are widened, and for people whose legs are hidden.
    """
    spreads = [window.spread for window in windows]
    return Check(
        "uncertain",
        float(np.nanmedian(spreads)),
        _UNCERTAIN,
        "joints have a standard deviation of more than 12 cm relative to the hips (hidden legs, a "
        "rotated video, motion unlike that of the prior's clips, another animal?)",
    )


def proportions(windows: Sequence[WindowSummary], views: int) -> Check:
    """Return the check of the lengths of bones.

    ``proportions``: mean square of standardised bone lengths, median over windows.
    """
    return Check(
        "proportions",
        float(np.median([window.proportions for window in windows])),
        _PROPORTIONS[views > 1],
        "the body has unusual proportions (another animal, swapped joints?)",
    )


def _unsteadiness(evidence: Evidence) -> float:
    """Return how fast feet and body move to and fro across the image, metres per second.

    It is the smaller of the slower ankle's median speed and of the hips' median deviation from a
    velocity that changes linearly: of people before a still camera, a foot stands still most of the
    time, or they run steadily. The squares of what the keypoints' noise alone would cause are
    subtracted, as if it were independent. Vertical velocities are not used, as people who jump have
    them too.
    """
    step = max(1, round(evidence.fps * _STEP))
    points, weight, _ = averaged(evidence.keypoints, step)
    distance = evidence.camera.depth(evidence.mean).mean(axis=1)[step // 2 :: step][: len(points)]
    scale = distance[_LAG:, None] / evidence.camera.focal * evidence.fps / (_LAG * step)
    velocity = (points[_LAG:, :, 0] - points[:-_LAG, :, 0]) * scale
    seen = ((weight[_LAG:] > 0) & (weight[:-_LAG] > 0))[:, ANKLES + HIPS].all(axis=1)
    if not seen.any():
        return 0.0
    with np.errstate(divide="ignore"):
        sd = evidence.noise * scale * np.sqrt(1 / weight[_LAG:] + 1 / weight[:-_LAG])
    velocity, sd, times = velocity[seen], sd[seen], np.flatnonzero(seen) * step / evidence.fps
    slower = np.median(np.abs(velocity[:, ANKLES]).min(axis=1))
    slower_noise = _TWO * np.median(sd[:, ANKLES])
    hips, line = velocity[:, HIPS].mean(axis=1), np.stack([np.ones(len(times)), times], axis=1)
    hips = np.median(np.abs(hips - line @ np.linalg.lstsq(line, hips)[0]))
    hips_noise = _ONE * np.median(np.linalg.norm(sd[:, HIPS], axis=1) / len(HIPS))
    square = min(slower**2 - slower_noise**2, hips**2 - hips_noise**2)
    return float(np.sqrt(max(square, 0.0)))
