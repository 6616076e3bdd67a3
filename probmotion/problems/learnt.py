"""Problems whose prior was learnt from 2D tracks: no one knows the posterior, but what it films
like can be compared with real 2D motion that was held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from probmotion import models
from probmotion.metrics.generation import GenerationReference
from probmotion.models.evaluator import TrackEvaluator
from probmotion.models.motion_diffusion import MotionDiffusion
from probmotion.posterior import MotionPosterior
from probmotion.problems.problem import Problem

__all__ = ["LEARNT_PROBLEMS", "learnt_problem"]


def learnt_problem(name: str, description: str) -> Problem:
    """Return the generation problem of a prior that comes with the package.

    Beside the prior's weights lie those of the evaluator, ``<name>-evaluator``, and the features
    of real 2D motion, held out and learnt from, ``<name>-features.npz``; the motion itself is not.

    Raises
    ------
    FileNotFoundError
        If the package has no such prior.
    """
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
    posterior = MotionPosterior(MotionDiffusion.load(name))
    return Problem(name, description, posterior, generation=reference)


def _named(name: str, description: str) -> tuple[str, tuple[str, Callable[[], Problem]]]:
    return name, (description, partial(learnt_problem, name, description))


LEARNT_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = dict(
    [_named("walk2d", "people who walk, a prior learnt from 2D tracks alone: generation")]
)
"""What each problem is, and the function that makes it, by name."""
