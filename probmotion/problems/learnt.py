"""Problems with priors learnt from 2D tracks.

Generation is scored against held-out 2D motion. In problems with observations, the truth is a
draw from the prior.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion import models, seeds
from probmotion.files import read_arrays
from probmotion.metrics.generation import GenerationReference
from probmotion.motion.motion import Motion
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, simulated
from probmotion.posteriors.protocols import Samplable
from probmotion.problems.observations import observe

if TYPE_CHECKING:
    from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
    from probmotion.models.vae.motion_vae import MotionVAE

__all__ = ["LEARNT_PROBLEMS", "learnt_problem", "observed_draw_problem"]

_NOISE = 0.02  # standard deviation of keypoints, metres


def learnt_problem(name: str, description: str, kind: str) -> Problem:
    """Return the generation problem of a shipped prior of class ``kind``.

    The class is given by name, so that importing this module loads no networks. The evaluator is
    ``<name>-evaluator``; ``<name>-features.npz`` contains features of held-out and training motion.
    """
    from probmotion.models.evaluation.evaluator import TrackEvaluator

    weights = Path(models.__file__).parent / "weights"
    evaluator = TrackEvaluator.load(f"{name}-evaluator")
    features = read_arrays(weights / f"{name}-features.npz")
    held_out, learnt = (features[part].astype(np.float64) for part in ("held_out", "learnt"))
    elevation, distance = float(features["elevation"]), float(features["distance"])
    reference = GenerationReference(evaluator, held_out, learnt, elevation, distance)
    prior: MotionDiffusion | MotionVAE = getattr(models, kind).load(name)
    problem = Problem(name, description, MotionPosterior(prior), generation=reference)
    return simulated(problem) if isinstance(prior, Samplable) else problem


def observed_draw_problem(name: str, description: str, prior: str, how: str) -> Problem:
    """Return the problem of recovering a draw of a shipped motion VAE from one camera.

    ``how`` is as for :func:`~probmotion.problems.observations.observe`.
    """
    # Codes are from N(0, I), as published, not from the mixture fitted to codes of real motion.
    vae = models.MotionVAE.load(prior, codes=None)
    # Treat the prior's rigid path as known instead of estimating it from the keypoints.
    vae = vae.placed(vae.rigid)
    truth = vae.motion(vae.initial(seeds.generator(0, name), 1))[0]
    likelihood = observe(Motion(truth, vae.skeleton, vae.fps, name=name), how, _NOISE, 0)
    return simulated(Problem(name, description, MotionPosterior(vae, likelihood), truth=truth))


LEARNT_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = {
    name: (description, partial(make, name, description, *options))
    for make, name, description, *options in (
        (
            learnt_problem,
            "walk2d",
            "walking people, diffusion prior learnt from 2D tracks alone: generation",
            "MotionDiffusion",
        ),
        (
            learnt_problem,
            "motion2d",
            "walking, running and jumping, diffusion prior learnt from 2D tracks alone: generation",
            "MotionDiffusion",
        ),
        (
            learnt_problem,
            "walk-vae",
            "walking people, motion VAE learnt from 2D tracks alone: generation",
            "MotionVAE",
        ),
        (
            learnt_problem,
            "animal-vae",
            "four-legged animals, motion VAE learnt from 2D tracks alone: generation",
            "MotionVAE",
        ),
        (
            observed_draw_problem,
            "walk-vae-monocular",
            "a draw of walk-vae, 2D keypoints of one camera (σ 2 cm)",
            "walk-vae",
            "monocular",
        ),
    )
}
"""Description and factory of each problem, by name."""
