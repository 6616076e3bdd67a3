"""Gait problems: an exact prior on synthetic gaits and simulated observations of a prior draw.

Truths are drawn from the prior, so exact posterior draws are calibrated. The problems have these
parameters, with defaults in :data:`GAIT_PROBLEMS`:

- ``frames``: number of frames L
- ``components``: number of mixture components, styles × azimuths; values up to the number of styles
  select that many styles and a single azimuth
- ``joints``: number of observed joints, counted from the root
- ``noise``: standard deviation (scale of Student-t noise) of the observations, metres
- ``hidden``: proportion of frames, around the middle frame, with the longest limb occluded
- ``seed``: seed of the truth and its observations
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from probmotion import seeds
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.models.mixture.gaussian_mixture import GaussianMixtureMotion
from probmotion.motion.motion import Motion
from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, simulated
from probmotion.problems.observations import (
    limb_occlusion,
    middle_frame,
    nearest_joints,
    one_camera_keypoints,
)
from probmotion.validation import check_count, check_positive

__all__ = ["GAIT_OUTLIER_PROBLEMS", "GAIT_PROBLEMS", "GaitProblem"]

_PEOPLE = {"walk": 0.5, "run": 0.3, "march": 0.2}  # weights of the styles
_QUADRUPEDS = {"quadruped-walk": 0.6, "quadruped-trot": 0.4}  # weights of the styles
_RANK, _SEED = 10, 0  # latent dimensions per style, seed of clips, truth and observations
_AZIMUTHS = 36  # components per style
_FREEDOM = 3.0  # degrees of freedom of Student-t noise
_DENSE = {"joints": 17, "noise": 0.02, "hidden": 0.0}  # all joints in all frames

Coordinates = Literal["latent", "positions"]
Observed = Literal["nothing", "keypoints", "one frame", "joints"]


@dataclass(frozen=True)
class GaitProblem:
    """Factory of a gait problem with the default parameters ``defaults``.

    ``observes`` selects the observations: none, 2D keypoints from one camera in all frames or in
    the middle frame, or 3D joints with Student-t noise (3 degrees of freedom).
    """

    name: str
    description: str
    observes: Observed
    quadruped: bool
    defaults: Mapping[str, Any]

    def __call__(self, name: str | None = None, **scale: Any) -> Problem:
        """Return the problem, renamed to ``name``, with the parameters in ``scale`` changed."""
        parameters = {**self.defaults, **scale}
        check_count("frames", parameters["frames"], least=2)
        coordinates: Coordinates = "positions" if self.observes == "joints" else "latent"
        prior = _prior(self.quadruped, parameters["frames"], parameters["components"], coordinates)
        name = name or self.name
        if self.observes == "nothing":
            return simulated(Problem(name, self.description, MotionPosterior(prior)))
        positions = prior.sample(seeds.generator(parameters["seed"], "truth"), 1)[0]
        truth = Motion(positions, prior.skeleton, prior.fps, name=name)
        posterior = MotionPosterior(prior, self._observe(truth, parameters))
        return simulated(Problem(name, self.description, posterior, truth.positions))

    def _observe(self, truth: Motion, parameters: Mapping[str, Any]) -> Keypoints2D | Joints3D:
        noise, seed = parameters["noise"], parameters["seed"]
        check_positive("noise", noise)
        visible = nearest_joints(truth.skeleton, parameters["joints"])
        hidden = np.ones(truth.positions.shape[:2], dtype=bool)
        hidden[:, visible] = False
        if self.observes == "one frame":
            hidden |= ~middle_frame(truth)
        else:
            hidden |= limb_occlusion(truth, parameters["hidden"])
        if self.observes == "joints":
            return Joints3D.observe(truth, noise, seed, hidden=hidden, degrees_of_freedom=_FREEDOM)
        return one_camera_keypoints(truth, noise, seed, hidden)


@cache
def _prior(
    quadruped: bool, frames: int, components: int, coordinates: Coordinates
) -> GaussianMixtureMotion:
    check_count("components", components)
    fitted = _fitted(quadruped, frames)
    K = len(fitted.styles)
    if components > K and components % K:
        raise ValueError(
            f"components must be at most {K}, the number of styles, or a multiple of it, got "
            f"{components}"
        )
    n_styles, azimuths = min(components, K), max(1, components // K)
    if (n_styles, azimuths, coordinates) == (K, fitted.azimuths, fitted.coordinates):
        return fitted
    weights = fitted.weights[:n_styles]
    return replace(
        fitted,
        means=fitted.means[:n_styles],
        factors=fitted.factors[:n_styles],
        weights=weights / weights.sum() if n_styles < K else weights,
        styles=fitted.styles[:n_styles],
        azimuths=azimuths,
        coordinates=coordinates,
    )


@cache
def _fitted(quadruped: bool, frames: int) -> GaussianMixtureMotion:
    weights_by_style = _QUADRUPEDS if quadruped else _PEOPLE
    clips = make_gaits(300, styles=weights_by_style, frames=frames, seed=_SEED)
    labels = [clip.name.rsplit("-", 1)[0] for clip in clips]
    weights = [weights_by_style[style] for style in sorted(weights_by_style)]
    return GaussianMixtureMotion.fit(
        clips, frames, rank=_RANK, styles=labels, weights=weights, azimuths=_AZIMUTHS
    )


def _problems(
    *rows: tuple[str, str, Observed, Mapping[str, float]], quadruped: bool = False
) -> dict[str, GaitProblem]:
    defaults = {"frames": 30, "components": _AZIMUTHS * (2 if quadruped else 3)}
    return {
        name: GaitProblem(
            name,
            description,
            observes,
            quadruped,
            {**defaults, **parameters, **({} if observes == "nothing" else {"seed": _SEED})},
        )
        for name, description, observes, parameters in rows
    }


GAIT_PROBLEMS: Mapping[str, GaitProblem] = _problems(
    ("gait", "people who walk, run and march, with no likelihood: generation", "nothing", {}),
    ("gait-monocular", "the same, 2D keypoints of one camera (σ 2 cm)", "keypoints", _DENSE),
    (
        "gait-occluded",
        "the same as gait-monocular, one leg hidden for half of the frames",
        "keypoints",
        {**_DENSE, "hidden": 0.5},
    ),
    (
        "gait-sparse",
        "the same gaits, six joints in one frame of one camera (σ 5 cm): many modes",
        "one frame",
        {"joints": 6, "noise": 0.05},
    ),
) | _problems(
    ("quadruped", "quadrupeds that walk and trot, with no likelihood", "nothing", {}),
    (
        "quadruped-monocular",
        "the same quadrupeds, 2D keypoints of one camera (σ 2 cm)",
        "keypoints",
        _DENSE,
    ),
    quadruped=True,
)
"""Factories of the problems with an exact posterior, by name."""

GAIT_OUTLIER_PROBLEMS: Mapping[str, GaitProblem] = _problems(
    (
        "gait-noisy3d",
        "a third of a second of the same gaits, noisy 3D joints with outliers (Student-t, 3 "
        "degrees of freedom, scale 3 cm)",
        "joints",
        {"frames": 10, **_DENSE, "noise": 0.03},
    ),
)
"""Factories of the problems with outliers, by name; the reference is a long Gibbs run."""
