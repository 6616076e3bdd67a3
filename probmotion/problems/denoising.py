"""Problems of denoising: a real motion that was held out, seen as noisy 3D joints.

The prior is a Motion-DVAE that learnt other clips, its body is estimated from the noisy joints:
nothing but the truth's own evidence is known of it.
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
    "limbs_hidden",
]

_CLIP = "cmu_02_02"
_SEED = 0


def body_prior(name: str = "body-dvae") -> MotionDVAE:
    """Return a Motion-DVAE that comes with the package, with its inference network.

    Raises
    ------
    FileNotFoundError
        If the package has no such prior.
    """
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
    """Return the problem of finding a motion from noisy joints of it.

    Parameters
    ----------
    truth : Motion
        The motion, of the prior's skeleton and frame rate, metres; of any length.
    prior : MotionDVAE
        What is believed; it is taken for the truth's length and for the body whose bone lengths
        the evidence shows.
    noise : float
        Standard deviation (Student-t: scale) of a coordinate, metres.
    degrees_of_freedom : float, optional
        Student-t noise with this many; Gaussian by default.
    hidden : ndarray of bool, (L, J), optional
        What is not seen.
    seed : int
        Of the noise.
    name, description : str
        What tables call it, and a sentence.
    """
    evidence = Joints3D.observe(
        truth, noise, seed, hidden=hidden, degrees_of_freedom=degrees_of_freedom
    )
    fitted = prior.of(frames=truth.frames, body=body_of(evidence, prior))
    return simulated(Problem(name, description, MotionPosterior(fitted, evidence), truth.positions))


def body_of(evidence: Joints3D, prior: MotionDVAE) -> np.ndarray:
    """Return the body that noisy joints show, rest offsets (J, 3), metres.

    The design's average of the observed body. Bones are as long as observed. Where a joint has
    several children, such as hips, their directions are those of smoothed joints (Kalman's), which
    say how wide a body is; where a joint is never seen, all are those of the usual body.
    """
    from probmotion.data.joint_filters import kalman_smooth

    seen = evidence.entries.visible
    usual = np.linalg.norm(prior.body, axis=-1)
    lengths = bone_lengths(
        evidence.joints,
        evidence.entries.confidence,
        prior.skeleton,
        evidence.noise,
        evidence.entries.degrees_of_freedom,
        typical=usual,
    )
    if not seen.any(axis=0).all():
        return prior.states.of_lengths(lengths)
    smooth, _ = kalman_smooth(
        evidence.joints, evidence.entries.confidence, noise=gaussian_noise(evidence), fps=prior.fps
    )
    shown = prior.states.body(smooth[seen.all(axis=1)] if seen.all(axis=1).any() else smooth)
    bones = np.linalg.norm(shown, axis=-1)
    return shown * (lengths / np.where(bones > 0, bones, 1.0))[:, None]


def gaussian_noise(evidence: Joints3D) -> float:
    """Return the scale of Gaussian noise for a smoother that knows no other, metres.

    Of Student-t noise it is that of as much variance, or thrice the scale where it has none.
    """
    freedom = evidence.entries.degrees_of_freedom
    if freedom is None:
        return evidence.noise
    return evidence.noise * (math.sqrt(freedom / (freedom - 2)) if freedom > 2.25 else 3.0)


def limbs_hidden(motion: Motion, *, cut_off: bool = False) -> np.ndarray:
    """Return what is hidden (L, J): the right arm for a third of the time, then the left leg.

    A sixth of the time before and after all is seen. With ``cut_off`` the arm hides from the first
    frame for a half, the leg from then to the last, so that nothing is known on the other side.
    """
    hidden = np.zeros(motion.positions.shape[:2], dtype=bool)
    first, middle, last = (motion.frames * share // 6 for share in (1, 3, 5))
    if cut_off:
        first, last = 0, motion.frames
    for frames, joints in (
        (slice(first, middle), ("right_elbow", "right_wrist")),
        (slice(middle, last), ("left_knee", "left_ankle")),
    ):
        hidden[frames, [motion.skeleton.index(joint) for joint in joints]] = True
    return hidden


def _problem(
    name: str, description: str, noise: float, freedom: float | None, hides: bool
) -> Problem:
    prior = body_prior()
    clip = cmu_clip(_CLIP).retarget(prior.skeleton)
    truth = clip.window((clip.frames - prior.frames) // 2, prior.frames)
    # Nothing is known of where it was recorded.
    ground = truth.positions[:, prior.skeleton.roots[0]].mean(axis=0) * [1.0, 0.0, 1.0]
    truth = Motion(truth.positions - ground, truth.skeleton, truth.fps, name=name)
    return denoising_problem(
        truth,
        prior,
        noise=noise,
        degrees_of_freedom=freedom,
        hidden=limbs_hidden(truth) if hides else None,
        seed=_SEED,
        name=name,
        description=description,
    )


def _named(
    name: str, description: str, noise: float, freedom: float | None = None, hides: bool = False
) -> tuple[str, tuple[str, Callable[[], Problem]]]:
    return name, (description, partial(_problem, name, description, noise, freedom, hides))


DENOISING_PROBLEMS: Mapping[str, tuple[str, Callable[[], Problem]]] = dict(
    [
        _named(
            "denoise-cmu",
            f"noisy 3D joints (σ 4 cm) of {_CLIP}, which was held out; a prior learnt from motion "
            "capture",
            0.04,
        ),
        _named(
            "denoise-cmu-outliers",
            "the same, Student-t noise with 3 degrees of freedom (scale 3 cm)",
            0.03,
            3.0,
        ),
        _named(
            "denoise-cmu-occluded",
            "the same (σ 4 cm), an arm and then a leg hidden for a third of a second each",
            0.04,
            hides=True,
        ),
    ]
)
"""What each problem is, and the function that makes it, by name."""
