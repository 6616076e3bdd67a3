"""Problems on procedural gaits: an exact prior, and the posterior after what is seen of one draw.

The truth of a problem with evidence is a draw from the prior itself, so that the prior is right
about it and an honest posterior covers it as often as it says. How hard a problem is, is a matter
of a few numbers (:data:`GAIT_PROBLEMS` says which a problem knows):

- ``frames``: L, of the motions and so of the prior
- ``components``: of the mixture, styles × azimuths; as few as there are styles or fewer leave that
  many styles, which are not turned
- ``joints``: how many joints the evidence shows, the nearest to the root
- ``noise``: standard deviation (Student-t: scale) of the evidence, metres
- ``hidden``: share of the frames, the middle ones, in which the longest limb is hidden
- ``seed``: of the truth and its evidence
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
from probmotion.problems.observations import in_one_camera, limb_hidden, nearest_joints, one_frame
from probmotion.validation import check_count, check_positive

__all__ = ["GAIT_OUTLIER_PROBLEMS", "GAIT_PROBLEMS", "GaitProblem"]

_PEOPLE = {"walk": 0.5, "run": 0.3, "march": 0.2}
_QUADRUPEDS = {"quadruped-walk": 0.6, "quadruped-trot": 0.4}
_RANK, _SEED = 10, 0
_AZIMUTHS = 36
_FREEDOM = 3.0

Coordinates = Literal["latent", "positions"]


@dataclass(frozen=True)
class GaitProblem:
    """How a problem on gaits is made; the numbers are those of the module's list.

    Parameters
    ----------
    name, description : str
        As in tables.
    sees : {"nothing", "keypoints", "one frame", "joints"}
        What the evidence is: 2D keypoints of one camera, in all frames or in the middle one alone,
        or noisy 3D joints with outliers (Student-t noise with 3 degrees of freedom).
    quadruped : bool
        Quadrupeds in place of people.
    defaults : mapping
        The numbers that the problem knows, and their values unless others are asked for.
    """

    name: str
    description: str
    sees: Literal["nothing", "keypoints", "one frame", "joints"]
    quadruped: bool
    defaults: Mapping[str, Any]

    def __call__(self, name: str | None = None, **scale: Any) -> Problem:
        """Return the problem, called ``name``, with other numbers where ``scale`` has them."""
        asked = {**self.defaults, **scale}
        check_count("frames", asked["frames"], least=2)
        coordinates: Coordinates = "positions" if self.sees == "joints" else "latent"
        prior = _prior(self.quadruped, asked["frames"], asked["components"], coordinates)
        called = name or self.name
        if self.sees == "nothing":
            return simulated(Problem(called, self.description, MotionPosterior(prior)))
        drawn = prior.sample(seeds.generator(asked["seed"], "truth"), 1)[0]
        truth = Motion(drawn, prior.skeleton, prior.fps, name=called)
        evidence = self._evidence(truth, asked)
        posterior = MotionPosterior(prior, evidence)
        return simulated(Problem(called, self.description, posterior, truth.positions))

    def _evidence(self, truth: Motion, asked: Mapping[str, Any]) -> Keypoints2D | Joints3D:
        noise, seed = asked["noise"], asked["seed"]
        check_positive("noise", noise)
        shown = nearest_joints(truth.skeleton, asked["joints"])
        hidden = np.ones(truth.positions.shape[:2], dtype=bool)
        hidden[:, shown] = False
        if self.sees == "one frame":
            hidden |= ~one_frame(truth)
            return in_one_camera(truth, noise, seed, hidden)
        hidden |= limb_hidden(truth, asked["hidden"])
        if self.sees == "joints":
            return Joints3D.observe(truth, noise, seed, hidden=hidden, degrees_of_freedom=_FREEDOM)
        return in_one_camera(truth, noise, seed, hidden)


@cache
def _prior(
    quadruped: bool, frames: int, components: int, coordinates: Coordinates
) -> GaussianMixtureMotion:
    shares = _QUADRUPEDS if quadruped else _PEOPLE
    check_count("components", components)
    K = len(shares)
    if components > K and components % K:
        raise ValueError(
            f"components is {components}, expected a multiple of the {K} styles, or as many or "
            "fewer"
        )
    fitted = _fitted(quadruped, frames)
    kept = min(components, K)
    weights = fitted.weights
    if kept < K:
        weights = weights[:kept] / weights[:kept].sum()
    azimuths = max(1, components // K)
    if (kept, azimuths, coordinates) == (K, fitted.azimuths, fitted.coordinates):
        return fitted
    return replace(
        fitted,
        means=fitted.means[:kept],
        factors=fitted.factors[:kept],
        weights=weights,
        styles=fitted.styles[:kept],
        azimuths=azimuths,
        coordinates=coordinates,
    )


@cache
def _fitted(quadruped: bool, frames: int) -> GaussianMixtureMotion:
    shares = _QUADRUPEDS if quadruped else _PEOPLE
    clips = make_gaits(300, styles=shares, frames=frames, seed=_SEED)
    labels = [clip.name.rsplit("-", 1)[0] for clip in clips]
    weights = [shares[style] for style in sorted(shares)]
    return GaussianMixtureMotion.fit(
        clips, frames, rank=_RANK, styles=labels, weights=weights, azimuths=_AZIMUTHS
    )


def _named(
    name: str, description: str, sees: Any, quadruped: bool = False, **defaults: Any
) -> tuple[str, GaitProblem]:
    own: dict[str, Any] = {"frames": 30, "components": _AZIMUTHS * (2 if quadruped else 3)}
    known = own | defaults | ({} if sees == "nothing" else {"seed": _SEED})
    return name, GaitProblem(name, description, sees, quadruped, known)


GAIT_PROBLEMS: Mapping[str, GaitProblem] = dict(
    [
        _named("gait", "people who walk, run and march, with no evidence: generation", "nothing"),
        _named(
            "gait-monocular",
            "the same, 2D keypoints of one camera (σ 2 cm)",
            "keypoints",
            joints=17,
            noise=0.02,
            hidden=0.0,
        ),
        _named(
            "gait-occluded",
            "the same as gait-monocular, one leg hidden for half of the frames",
            "keypoints",
            joints=17,
            noise=0.02,
            hidden=0.5,
        ),
        _named(
            "gait-sparse",
            "the same gaits, six joints in one frame of one camera (σ 5 cm): many modes",
            "one frame",
            joints=6,
            noise=0.05,
        ),
        _named("quadruped", "quadrupeds that walk and trot, with no evidence", "nothing", True),
        _named(
            "quadruped-monocular",
            "the same quadrupeds, 2D keypoints of one camera (σ 2 cm)",
            "keypoints",
            True,
            joints=17,
            noise=0.02,
            hidden=0.0,
        ),
    ]
)
"""How each exact problem is made, by name."""

GAIT_OUTLIER_PROBLEMS: Mapping[str, GaitProblem] = dict(
    [
        _named(
            "gait-noisy3d",
            "a third of a second of the same gaits, noisy 3D joints with outliers (Student-t, 3 "
            "degrees of freedom, scale 3 cm)",
            "joints",
            frames=10,
            joints=17,
            noise=0.03,
            hidden=0.0,
        )
    ]
)
"""How each problem with outliers is made, by name: its reference is a long run."""
