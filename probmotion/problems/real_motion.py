"""Problems on real motion whose posterior is known in closed form.

Priors are the locomotion of the shipped spectral mixture ``cmu-motion``, at fewer frames and
azimuths, and a Gaussian over pose pairs that was learnt from 2D annotations alone
(``salsa-pairs``). Truths are from held-out clips.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from probmotion.data.cmu_clips import cmu_clip
from probmotion.motion.motion import Motion
from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, simulated
from probmotion.problems.denoising import limb_occlusions
from probmotion.problems.observations import observe

if TYPE_CHECKING:
    from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
    from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior
    from probmotion.motion.skeleton import Skeleton

__all__ = ["REAL_MOTION_PROBLEMS", "locomotion_prior", "pose_prior"]

_FRAMES, _FPS = 10, 10.0
_COMPONENTS = 3  # of the largest mean speeds
_AZIMUTHS = 12
_GROUND = 0.05  # standard deviation of the mean ground position, metres
_HELD_OUT = "cmu_02_02"
_PAIR_AZIMUTHS = 24

Observed = Literal["none", "monocular", "occluded", "joints"]


@cache
def locomotion_prior() -> SpectralMixtureMotion:
    """Return the three fastest components of ``cmu-motion``, at its largest scale of variance.

    Motions have 10 frames at 10 fps and 12 azimuths.
    """
    from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion

    prior = SpectralMixtureMotion.load("cmu-motion")
    fastest = np.argsort(-np.linalg.norm(prior.velocities, axis=1), kind="stable")[:_COMPONENTS]
    gaits = replace(
        prior,
        poses=prior.poses[fastest],
        velocities=prior.velocities[fastest],
        directions=prior.directions[fastest],
        variances=prior.variances[fastest],
        weights=prior.weights[fastest] / prior.weights[fastest].sum(),
        # These few components stand for many.
        scales=prior.scales.max(keepdims=True),
        scale_weights=np.ones(1),
        ground=_GROUND,
        azimuths=_AZIMUTHS,
    )
    return gaits.resampled(_FRAMES, _FPS)


def pose_prior(
    learnt: AnnotationPrior, skeleton: Skeleton, azimuths: int, ground: float
) -> SpectralMixtureMotion:
    """Return a prior learnt from annotations as motions of a single frame.

    Parameters
    ----------
    learnt : AnnotationPrior
        Gaussian mixture over centred poses in a canonical heading.
    skeleton : Skeleton
        Skeleton of its J joints.
    azimuths : int
        Number of headings, which are equally probable.
    ground : float
        Standard deviation of the centroid's ground position, metres.
    """
    from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion

    K, J, _ = learnt.means.shape
    along = np.zeros((3 * J, 2))
    along[0::3, 0] = along[2::3, 1] = 1 / np.sqrt(J)
    complement = np.linalg.qr(along, mode="complete")[0][:, 2:]
    variances, axes = np.linalg.eigh(complement.T @ learnt.covariances @ complement)
    translations = np.broadcast_to(along, (K, *along.shape))
    return SpectralMixtureMotion(
        skeleton,
        30.0,
        learnt.means,
        np.zeros((K, 2)),
        np.concatenate([translations, complement @ axes], axis=2)[:, None],
        np.zeros(1, dtype=int),
        # The variances of the translations are set by ``ground``.
        np.concatenate([np.ones((K, 2)), variances], axis=1)[:, None],
        learnt.weights,
        ground=ground,
        azimuths=azimuths,
    )


def _locomotion_problem(name: str, description: str, how: Observed, noise: float) -> Problem:
    prior = locomotion_prior()
    if how == "none":
        return simulated(Problem(name, description, MotionPosterior(prior)))
    clip = cmu_clip(_HELD_OUT).retarget(prior.skeleton).resample(_FPS)
    window = clip.window((clip.frames - _FRAMES) // 2, _FRAMES)
    return _observed(name, description, prior, window.positions, how, noise)


def _lifted_problem(name: str, description: str, noise: float) -> Problem:
    from probmotion import models
    from probmotion.data.downloads import salsa_pairs
    from probmotion.data.pair_sets import ground_truth, hold_out
    from probmotion.models.unseen_depth.annotation_prior import AnnotationPrior

    clips = hold_out(salsa_pairs())[1]
    weights = Path(models.__file__).parent / "weights"
    learnt = AnnotationPrior.load(weights / "salsa-pairs.npz")
    prior = pose_prior(learnt, clips[0].skeleton, _PAIR_AZIMUTHS, _GROUND)
    pose = ground_truth(clips, 1)[0]  # in the middle of the held-out dance
    # Poses of the prior are relative to the mean of their joints.
    pose = pose - pose.mean(axis=1, keepdims=True) * [0.0, 1.0, 0.0]
    return _observed(name, description, prior, pose, "monocular", noise)


def _observed(
    name: str,
    description: str,
    prior: SpectralMixtureMotion,
    positions: np.ndarray,
    how: Observed,
    noise: float,
) -> Problem:
    """Return the problem of recovering positions (L, J, 3) from noisy observations."""
    # As in the prior, the centroid's mean ground position is at the origin.
    ground = positions.mean(axis=(0, 1)) * [1.0, 0.0, 1.0]
    truth = Motion(positions - ground, prior.skeleton, prior.fps, name=name)
    likelihood: Joints3D | Keypoints2D | None
    if how == "joints":
        likelihood = Joints3D.observe(truth, noise, 0, hidden=limb_occlusions(truth))
    else:
        likelihood = observe(truth, how, noise, 0)
    posterior = MotionPosterior(prior, likelihood)
    return simulated(Problem(name, description, posterior, truth.positions))


REAL_MOTION_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = {
    name: (description, partial(make, name, description, *options))
    for make, name, description, *options in (
        (
            _locomotion_problem,
            "cmu-motion",
            "locomotion in motion capture, spectral mixture of a second: generation",
            "none",
            0.0,
        ),
        (
            _locomotion_problem,
            "cmu-motion-monocular",
            f"the same, 2D keypoints of one camera (σ 2 cm) of {_HELD_OUT}, which was held out",
            "monocular",
            0.02,
        ),
        (
            _locomotion_problem,
            "cmu-motion-occluded",
            "the same as cmu-motion-monocular, a limb hidden for half of the frames",
            "occluded",
            0.02,
        ),
        (
            _locomotion_problem,
            "cmu-motion-denoise",
            f"noisy 3D joints (σ 4 cm) of {_HELD_OUT}, an arm and then a leg hidden for a third of "
            "the frames each",
            "joints",
            0.04,
        ),
        (
            _lifted_problem,
            "salsa-lifted",
            "salsa pair of a held-out clip, 2D keypoints of one camera (σ 3 cm); a prior learnt "
            "from 2D annotations alone",
            0.03,
        ),
    )
}
"""Description and factory of each problem, by name."""
