"""Problems on procedural gaits: an exact prior, and the posterior after what one camera sees.

The truth of a problem with evidence is a draw from the prior itself, so that the prior is right
about it and an honest posterior covers it as often as it says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial

from probmotion import seeds
from probmotion.data.gaits import make_gaits
from probmotion.models import GaussianMixtureMotion
from probmotion.motion import Motion
from probmotion.posterior import MotionPosterior
from probmotion.problems.evidence import observe
from probmotion.problems.problem import Problem

__all__ = ["GAIT_PROBLEMS"]

_PEOPLE = {"walk": 0.5, "run": 0.3, "march": 0.2}
_QUADRUPEDS = {"quadruped-walk": 0.6, "quadruped-trot": 0.4}
_FRAMES, _RANK, _SEED = 30, 10, 0


@cache
def _prior(quadruped: bool) -> GaussianMixtureMotion:
    shares = _QUADRUPEDS if quadruped else _PEOPLE
    clips = make_gaits(300, styles=shares, frames=_FRAMES, seed=_SEED)
    labels = [clip.name.rsplit("-", 1)[0] for clip in clips]
    weights = [shares[style] for style in sorted(shares)]
    return GaussianMixtureMotion.fit(clips, _FRAMES, rank=_RANK, styles=labels, weights=weights)


def _problem(name: str, description: str, how: str, noise: float, quadruped: bool) -> Problem:
    prior = _prior(quadruped)
    if how == "none":
        return Problem(name, description, MotionPosterior(prior))
    drawn = prior.sample(seeds.generator(_SEED, "truth"), 1)[0]
    truth = Motion(drawn, prior.skeleton, prior.fps, name=name)
    evidence = observe(truth, how, noise, _SEED)
    return Problem(name, description, MotionPosterior(prior, evidence), truth.positions)


def _named(
    name: str, description: str, how: str, noise: float = 0.02, quadruped: bool = False
) -> tuple[str, tuple[str, Callable[[], Problem]]]:
    return name, (description, partial(_problem, name, description, how, noise, quadruped))


GAIT_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = dict(
    [
        _named("gait", "people who walk, run and march, with no evidence: generation", "none"),
        _named("gait-monocular", "the same, 2D keypoints of one camera (σ 2 cm)", "monocular"),
        _named(
            "gait-occluded",
            "the same as gait-monocular, one leg hidden for half of the frames",
            "occluded",
        ),
        _named(
            "gait-sparse",
            "the same gaits, six joints in one frame of one camera (σ 5 cm): many modes",
            "sparse",
            0.05,
        ),
        _named(
            "quadruped", "quadrupeds that walk and trot, with no evidence", "none", quadruped=True
        ),
        _named(
            "quadruped-monocular",
            "the same quadrupeds, 2D keypoints of one camera (σ 2 cm)",
            "monocular",
            quadruped=True,
        ),
    ]
)
"""What each problem is, and the function that makes it, by name."""
