"""Predictive checks of a lift: does a person who moves like the prior explain the keypoints?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import PERSON, PersonKeypoints
from probmotion.lifting.window_posterior import WindowPosterior

__all__ = ["MEDIAN", "Check", "Evidence", "checked"]

MEDIAN = 1.66
"""Median of squared residuals of a keypoint under Student-t noise with 4 degrees of freedom."""


@dataclass(frozen=True)
class Check:
    """Result of a predictive check.

    Parameters
    ----------
    name : str
        Name of the quantity.
    value, limit : float
        Its value, and the largest value of lifts that can be trusted.
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
    """Keypoints, camera, noise (pixels), mean (L, J, 3) and posteriors of the windows.

    ``mirrored`` is the log evidence per window of keypoints with exchanged sides, minus that of the
    given ones.
    """

    keypoints: PersonKeypoints
    camera: LevelCamera
    noise: float
    mean: np.ndarray
    posteriors: Sequence[WindowPosterior]
    mirrored: float


_FEWEST, _SHARE = 10, 0.1  # visible frames of the joints whose residuals are checked
# Limits were chosen on made videos of training and validation clips.
_LIMITS = {
    "noise": (0.04, "the keypoints' noise is more than 4 cm at the person's distance"),
    "residual": (
        1.35,
        "keypoints of a joint do not follow a body before a still camera (does the camera move?)",
    ),
    "surprise": (1.5, "the motion is unlike those from which the prior was learnt"),
    "proportions": (3.0, "the body has unusual proportions (another animal, swapped joints?)"),
    "mirrored": (
        80.0,
        "the motion is more likely with left and right exchanged (is the video mirrored?)",
    ),
}


def checked(evidence: Evidence) -> tuple[Check, ...]:
    """Return all checks.

    ``noise``: that of keypoints, in metres at the person's distance. ``residual``: largest ratio of
    a joint's robust residuals to the noise. ``surprise`` and ``proportions``: mean
    squares of standardised coefficients of the motion and of bone lengths. ``mirrored``: log
    evidence per window of exchanged sides.
    """
    points, weight, _ = evidence.keypoints
    residual = np.linalg.norm(points - evidence.camera.pixels(evidence.mean), axis=-1)
    standardised = residual * np.sqrt(weight) / evidence.noise
    joints = [
        float(np.sqrt(np.median(values[values > 0] ** 2) / MEDIAN))
        for values in standardised.T
        if (values > 0).sum() >= max(_FEWEST, _SHARE * len(values))
    ]
    depth = evidence.camera.depth(evidence.mean).mean()
    bones = PERSON.n_joints - 1
    bests = [posterior.best for posterior in evidence.posteriors]
    surprise = [best.scale * (best.mean[:-bones] ** 2).mean() for best in bests]
    proportions = [(best.mean[-bones:] ** 2).mean() for best in bests]
    values = {
        "noise": evidence.noise * depth / evidence.camera.focal,
        "residual": max(joints),
        "surprise": np.median(surprise),
        "proportions": np.median(proportions),
        "mirrored": evidence.mirrored,
    }
    return tuple(
        Check(name, float(values[name]), limit, problem)
        for name, (limit, problem) in _LIMITS.items()
    )
