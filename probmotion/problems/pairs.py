"""Problems on close interaction: annotated 2D pairs and one 3D seed.

The posterior has no closed form. Samplers are scored by how well their draws cover the 3D pose
pairs of held-out clips. The annotations and the 3D seed are from the other clips.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from probmotion.motion.motion import Motion
from probmotion.posteriors.problem import Problem

if TYPE_CHECKING:
    from probmotion.models.pose_pairs.pair_posterior import PairSettings

__all__ = ["PAIR_PROBLEMS", "pairs_problem"]

_VIEW = 0.0, np.pi / 12  # azimuth and elevation of the camera of `salsa-physical`, radians


def pairs_problem(
    motions: Sequence[Motion],
    held_out: Sequence[str],
    *,
    n_annotations: int = 6000,
    n_held_out: int = 300,
    settings: PairSettings | None = None,
    seed: int = 0,
    name: str = "pairs",
    description: str = "",
) -> Problem:
    """Return the problem of covering the pose pairs of held-out clips.

    Dance frames of the other clips are annotated in random views; the medoid 3D pose is the seed.

    Parameters
    ----------
    motions : sequence of Motion
        Clips with the skeleton ``pair17``.
    held_out : sequence of str
        Names of the held-out clips.
    n_annotations : int
        Maximum number of annotated frames.
    n_held_out : int
        Maximum number of evenly spaced pose pairs of the held-out clips to cover.
    settings : PairSettings, optional
        Settings of the posterior.
    seed : int
        Random seed of annotated frames, their views and the likelihood's views.
    name, description : str
        Name and description of the problem in tables.
    """
    # Import compiled code lazily.
    from probmotion.data.pair_sets import choose_seed, dance_frames, ground_truth, hold_out
    from probmotion.interaction.annotations.sources import draw_annotations
    from probmotion.models.pose_pairs.pair_posterior import pair_posterior

    training, test = hold_out(motions, held_out)
    frames = [dance_frames(motion) for motion in training]
    poses, test_poses = ground_truth(training)[0], ground_truth(test)[0]
    n = min(n_annotations, len(poses))
    annotations = draw_annotations(training, n, seed, frames=frames).annotations
    pose = poses[choose_seed(poses)]
    posterior = pair_posterior(pose, annotations, settings, fps=training[0].fps, view_seed=seed)
    covered, _, _ = ground_truth(test, min(n_held_out, len(test_poses)))
    return Problem(name, description, posterior, held_out=covered[:, None], aligned_to=pose[None])


_DANCE = "two synthetic dancers, 300 annotated 2D pairs and one 3D seed: coverage"
_SALSA = "salsa (CMU 60 and 61), 5599 annotated 2D pairs of 7 clips and one 3D seed: coverage"


def _dance() -> Problem:
    from probmotion.data.synthetic.dances import synthetic_dances
    from probmotion.models.pose_pairs.pair_posterior import PairSettings

    return pairs_problem(
        synthetic_dances(8, seed=0),
        ["dance-6", "dance-7"],
        n_annotations=300,
        n_held_out=60,
        settings=PairSettings(n_views=16, n_near=16),
        name="dance-pairs",
        description=_DANCE,
    )


def _salsa(name: str, description: str, paper: bool = False) -> Problem:
    from probmotion.data.downloads import salsa_pairs
    from probmotion.data.pair_sets import SALSA_HELD_OUT
    from probmotion.models.pose_pairs.pair_posterior import PairSettings

    return pairs_problem(
        salsa_pairs(),
        SALSA_HELD_OUT,
        settings=PairSettings.paper() if paper else None,
        name=name,
        description=description,
    )


_PHYSICAL = (
    "salsa pair of a held-out clip lifted from one 2D annotation (σ 3 cm, unknown view), with a "
    "prior learnt from annotations and the physical prior"
)


def _physical_lift() -> Problem:
    from pathlib import Path

    from probmotion import models, seeds
    from probmotion.data.downloads import salsa_pairs
    from probmotion.data.pair_sets import choose_seed, ground_truth, hold_out
    from probmotion.interaction.annotations.sources import world_axes
    from probmotion.models.pose_pairs import PosePairPrior
    from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
    from probmotion.models.unseen_depth.physical_lift import PhysicalLift
    from probmotion.posteriors.posterior import MotionPosterior

    training, test = hold_out(salsa_pairs())
    learnt = AnnotationPrior.load(Path(models.__file__).parent / "weights" / "salsa-pairs.npz")
    poses = ground_truth(training)[0]
    physics = PosePairPrior(poses[choose_seed(poses)], training[0].skeleton, training[0].fps)
    # The middle frame of the held-out clips, in the axes of the camera.
    pose = ground_truth(test, 1)[0][0] @ world_axes(np.array([_VIEW]))[0].T
    pose = pose - pose.mean(axis=0)
    noise = learnt.noise * seeds.generator(0, "annotation").standard_normal((len(pose), 2))
    posterior = MotionPosterior(PhysicalLift(learnt, pose[:, :2] + noise, physics))
    return Problem("salsa-physical", _PHYSICAL, posterior, truth=pose[None])


_PAPER = "salsa-pairs with the density truncated at 100 times the seed's, as published"

PAIR_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = {
    "dance-pairs": (_DANCE, _dance),
    "salsa-pairs": (_SALSA, partial(_salsa, "salsa-pairs", _SALSA)),
    "salsa-pairs-paper": (_PAPER, partial(_salsa, "salsa-pairs-paper", _PAPER, paper=True)),
    "salsa-physical": (_PHYSICAL, _physical_lift),
}
"""Description and factory of each problem, by name."""
