"""Problems whose prior was learnt from 2D tracks: no one knows the posterior, but what it films
like can be compared with real 2D motion that was held out, and draws from it with what was seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion import models, seeds
from probmotion.metrics.generation import GenerationReference
from probmotion.motion.motion import Motion
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, simulated
from probmotion.posteriors.protocols import Samplable
from probmotion.problems.observations import observe

if TYPE_CHECKING:
    from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
    from probmotion.models.vae.motion_vae import MotionVAE

__all__ = ["LEARNT_PROBLEMS", "learnt_problem", "seen_draw_problem"]

_NOISE = 0.02


def learnt_problem(name: str, description: str, kind: str) -> Problem:
    """Return the generation problem of a prior that comes with the package.

    Its kind is named, so that a process loads no networks but those of the problems it works on.
    Beside the prior's weights lie those of the evaluator, ``<name>-evaluator``, and the features
    of real 2D motion, held out and learnt from, ``<name>-features.npz``; the motion itself is not.

    Raises
    ------
    FileNotFoundError
        If the package has no such prior.
    """
    from probmotion.models.evaluation.evaluator import TrackEvaluator

    weights = Path(models.__file__).parent / "weights"
    evaluator = TrackEvaluator.load(f"{name}-evaluator")
    with np.load(weights / f"{name}-features.npz") as kept:
        reference = GenerationReference(
            evaluator,
            kept["held_out"].astype(np.float64),
            kept["learnt"].astype(np.float64),
            float(kept["elevation"]),
            float(kept["distance"]),
        )
    prior: MotionDiffusion | MotionVAE = getattr(models, kind).load(name)
    problem = Problem(name, description, MotionPosterior(prior), generation=reference)
    return simulated(problem) if isinstance(prior, Samplable) else problem


def seen_draw_problem(
    name: str, description: str, prior: str, how: str, *, seed: int = 0
) -> Problem:
    """Return the problem of a motion VAE's draw that one camera sees; the draw is the truth.

    Parameters
    ----------
    name, description : str
        As in tables.
    prior : str
        A motion VAE that comes with the package.
    how : str
        What is seen; see :func:`~probmotion.problems.observations.observe`.
    seed : int
        Of the draw and its noise.
    """
    vae = models.MotionVAE.load(prior)
    # Where the body stands is known here: the draw and its evidence are of one that stands there.
    vae = vae.placed(vae.rigid)
    truth = vae.motion(vae.initial(seeds.generator(seed, name), 1))[0]
    seen = observe(Motion(truth, vae.skeleton, vae.fps, name=name), how, _NOISE, seed)
    assert isinstance(seen, Keypoints2D)
    return simulated(Problem(name, description, MotionPosterior(vae, seen), truth=truth))


LEARNT_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = {
    name: (description, partial(make, name, description, *more))
    for name, description, make, *more in (
        (
            "walk2d",
            "people who walk, a prior learnt from 2D tracks alone: generation",
            learnt_problem,
            "MotionDiffusion",
        ),
        (
            "walk-vae",
            "people who walk, a motion VAE learnt from 2D tracks alone: generation",
            learnt_problem,
            "MotionVAE",
        ),
        (
            "animal-vae",
            "four-legged animals, a motion VAE learnt from 2D tracks alone: generation",
            learnt_problem,
            "MotionVAE",
        ),
        (
            "walk-vae-monocular",
            "a draw of walk-vae, 2D keypoints of one camera (σ 2 cm)",
            seen_draw_problem,
            "walk-vae",
            "monocular",
        ),
    )
}
"""What each problem is, and the function that makes it, by name."""
