"""Denoising problems: a held-out motion observed as noisy 3D joints.

The prior is a Motion-DVAE trained on other clips; the body is estimated from the noisy joints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from probmotion.data.cmu_clips import cmu_clip
from probmotion.motion.motion import Motion
from probmotion.posteriors.bone_lengths import bone_lengths
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, simulated

if TYPE_CHECKING:
    from probmotion.models.dvae.motion_dvae import MotionDVAE

__all__ = [
    "DENOISING_PROBLEMS",
    "body_of",
    "body_prior",
    "denoising_problem",
    "gaussian_noise",
    "limb_occlusions",
]

_CLIP = "cmu_02_02"  # held-out clip


def body_prior(name: str = "body-dvae") -> MotionDVAE:
    """Load a shipped Motion-DVAE with its inference network."""
    from probmotion.models.dvae.motion_denoiser import MotionDenoiser
    from probmotion.models.dvae.motion_dvae import MotionDVAE

    prior = MotionDVAE.load(name)
    return prior.of(inference_network=MotionDenoiser.load(f"{name}-denoiser", prior))


def denoising_problem(
    truth: Motion,
    prior: MotionDVAE,
    *,
    noise: float,
    degrees_of_freedom: float | None = None,
    hidden: np.ndarray | None = None,
    seed: int = 0,
    name: str = "denoise",
    description: str = "noisy 3D joints of a motion",
) -> Problem:
    """Return the problem of recovering a motion from its noisy joints.

    Parameters
    ----------
    truth : Motion
        Motion of any length with the prior's skeleton and frame rate, metres.
    prior : MotionDVAE
        Prior, which is adapted to the frames of ``truth`` and to the estimated body.
    noise : float
        Standard deviation (scale of Student-t noise) per coordinate, metres.
    degrees_of_freedom : float, optional
        Degrees of freedom of Student-t noise; Gaussian noise by default.
    hidden : ndarray of bool, (L, J), optional
        Occluded joints.
    seed : int
        Seed of the noise.
    name, description : str
        Name and description of the problem in tables.
    """
    likelihood = Joints3D.observe(
        truth, noise, seed, hidden=hidden, degrees_of_freedom=degrees_of_freedom
    )
    adapted = prior.of(frames=truth.frames, body=body_of(likelihood, prior))
    posterior = MotionPosterior(adapted, likelihood)
    return simulated(Problem(name, description, posterior, truth.positions))


def body_of(likelihood: Joints3D, prior: MotionDVAE) -> np.ndarray:
    """Return the body estimated from noisy joints, as rest offsets (J, 3), metres.

    Bone lengths are estimated from the observations, and bone directions at joints with several
    children from Kalman-smoothed joints. If a joint is never visible, directions are the prior's.
    """
    from probmotion.data.joint_filters import kalman_smooth

    joints, entries = likelihood.joints, likelihood.entries
    lengths = bone_lengths(
        joints,
        entries.confidence,
        prior.skeleton,
        likelihood.noise,
        entries.degrees_of_freedom,
        typical=np.linalg.norm(prior.body, axis=-1),
    )
    if not entries.visible.any(axis=0).all():
        return prior.states.of_lengths(lengths)
    noise = gaussian_noise(likelihood)
    smooth, _ = kalman_smooth(joints, entries.confidence, noise=noise, fps=prior.fps)
    complete = entries.visible.all(axis=1)
    body = prior.states.body(smooth[complete] if complete.any() else smooth)
    bones = np.linalg.norm(body, axis=-1)
    return body * (lengths / np.where(bones > 0, bones, 1.0))[:, None]


def gaussian_noise(likelihood: Joints3D) -> float:
    """Return the standard deviation of the noise for smoothers that assume Gaussian noise, metres.

    For Student-t noise with ν ≤ 2.25 degrees of freedom, return three times the scale instead.
    """
    freedom = likelihood.entries.degrees_of_freedom
    if freedom is None:
        return likelihood.noise
    return likelihood.noise * (math.sqrt(freedom / (freedom - 2)) if freedom > 2.25 else 3.0)


def limb_occlusions(motion: Motion, *, cut_off: bool = False) -> np.ndarray:
    """Return the mask of occluded joints (L, J): right arm, then left leg.

    Each limb is occluded for a third of the frames, between the first and last sixth. With
    ``cut_off``, the arm is occluded in the first half of the frames and the leg in the second half.
    """
    hidden = np.zeros(motion.positions.shape[:2], dtype=bool)
    first, middle, last = (motion.frames * sixth // 6 for sixth in (1, 3, 5))
    if cut_off:
        first, last = 0, motion.frames
    for frames, joints in (
        (slice(first, middle), ("right_elbow", "right_wrist")),
        (slice(middle, last), ("left_knee", "left_ankle")),
    ):
        hidden[frames, [motion.skeleton.index(joint) for joint in joints]] = True
    return hidden


def _problem(
    name: str,
    description: str,
    noise: float,
    degrees_of_freedom: float | None = None,
    occluded: bool = False,
) -> Problem:
    prior = body_prior()
    clip = cmu_clip(_CLIP).retarget(prior.skeleton)
    truth = clip.window((clip.frames - prior.frames) // 2, prior.frames)
    # Centre the clip on the origin; its position carries no information.
    ground = truth.positions[:, prior.skeleton.roots[0]].mean(axis=0) * [1.0, 0.0, 1.0]
    truth = Motion(truth.positions - ground, truth.skeleton, truth.fps, name=name)
    return denoising_problem(
        truth,
        prior,
        noise=noise,
        degrees_of_freedom=degrees_of_freedom,
        hidden=limb_occlusions(truth) if occluded else None,
        name=name,
        description=description,
    )


DENOISING_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = {
    name: (description, partial(_problem, name, description, *options))
    for name, description, *options in (
        (
            "denoise-cmu",
            f"noisy 3D joints (σ 4 cm) of {_CLIP}, which was held out; a prior learnt from motion "
            "capture",
            0.04,
        ),
        (
            "denoise-cmu-outliers",
            "the same, Student-t noise with 3 degrees of freedom (scale 3 cm)",
            0.03,
            3.0,
        ),
        (
            "denoise-cmu-occluded",
            "the same (σ 4 cm), an arm and then a leg hidden for a third of a second each",
            0.04,
            None,
            True,
        ),
    )
}
"""Description and factory of each problem, by name."""
