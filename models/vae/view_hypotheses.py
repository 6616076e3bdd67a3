"""How often the right view is chosen, where the truth is known (*Ponymation*, section 3.1).

A picture leaves open which way a body looks into depth: turned about the picture's plane it shows
the same. Only joints' ranges, the perspective and the cameras' height tell; the truth in 3D is used
here to count, and nowhere to learn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from probmotion import seeds
from probmotion.data.projections import DetectorNoise, Filming, centre_motion
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.losses import guess_terms, weighted_sum
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import USUAL_THRESHOLD, MotionVAESettings
from probmotion.motion.distances import windows
from probmotion.motion.motion import Motion
from probmotion.validation import check_count

__all__ = ["JudgedHypotheses", "judge_hypotheses"]

# A hypothesis counts as right if its error is at most this much of the least.
_AS_GOOD = 1.2
_TO_Y_UP = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class JudgedHypotheses:
    """What was chosen among view hypotheses, against the truth.

    Parameters
    ----------
    right : float
        Share of sequences whose chosen hypothesis is the one nearest to the truth in 3D, or at most
        a fifth farther.
    depth_right : float
        Share of sequences whose chosen hypothesis is nearer to the truth than its own mirror image
        in depth.
    error : float
        Mean distance of joints from the truth about the root, metres, of the chosen hypothesis.
    least_error : float
        Of the hypothesis nearest to the truth.
    shares : tuple of float
        How often each hypothesis is chosen.
    """

    right: float
    depth_right: float
    error: float
    least_error: float
    shares: tuple[float, ...]


def judge_hypotheses(
    network: PoseNetwork,
    settings: MotionVAESettings,
    body: ArticulatedBody,
    clips: Sequence[Motion],
    *,
    n: int = 1000,
    fps: float = 10.0,
    filming: Filming | None = None,
    noise: DetectorNoise | None = None,
    seed: int = 0,
) -> JudgedHypotheses:
    """Return how often the right view hypothesis wins on clips whose 3D is known.

    Parameters
    ----------
    network : PoseNetwork
        Trained.
    settings : MotionVAESettings
        With the weights by which it was trained, and by which a hypothesis is chosen.
    body : ArticulatedBody
        The network's.
    clips : sequence of Motion
        3D clips, of skeletons that have the body's joints.
    n : int
        Sequences, of random clips and frames, filmed from random sides.
    fps : float
        Frames per second that the network has learnt at.
    filming : Filming, optional
        Where cameras stand; the defaults of :class:`~probmotion.data.projections.Filming`.
    noise : DetectorNoise, optional
        How the detector errs; by default it loses no joint.
    seed : int
        Of sequences, cameras and errors.

    Raises
    ------
    ValueError
        If no clip is as long as a sequence.
    """
    check_count("n", n)
    shot = Filming() if filming is None else filming
    erring = DetectorNoise(share=0.0) if noise is None else noise
    rng = seeds.generator(seed, "hypotheses")
    every = _sequences(clips, body, fps, settings.frames)
    chosen = every[rng.integers(0, len(every), n)]
    cameras = shot.cameras(rng, n)
    # Each sequence has a camera of its own.
    seen = [erring.detect(rng, cameras.view(i).project(some)[0]) for i, some in enumerate(chosen)]
    keypoints = np.nan_to_num(np.stack([one for one, _ in seen]))
    found, losses = _guessed(
        network,
        settings,
        body,
        (keypoints - keypoints[:, :, [body.skeleton.roots[0]]]).astype(np.float32),
        # As in training networks are told which joints are seen, and not how surely.
        (np.stack([one for _, one in seen]) >= USUAL_THRESHOLD).astype(np.float32),
        shot.distance if shot.perspective else None,
    )
    truth = np.einsum("nij,nlkj->nlki", cameras.rotation, chosen) * _TO_Y_UP
    errors = np.linalg.norm(found - truth[:, None], axis=-1).mean(axis=(2, 3))
    mirrored = np.linalg.norm(found * [1, 1, -1] - truth[:, None], axis=-1).mean(axis=(2, 3))
    rows, best = np.arange(n), losses.argmin(axis=1)
    ours = errors[rows, best]
    return JudgedHypotheses(
        right=float((ours <= _AS_GOOD * errors.min(axis=1)).mean()),
        depth_right=float((ours < mirrored[rows, best]).mean()),
        error=float(ours.mean()),
        least_error=float(errors.min(axis=1).mean()),
        shares=tuple((np.bincount(best, minlength=errors.shape[1]) / n).tolist()),
    )


def _sequences(
    clips: Sequence[Motion], body: ArticulatedBody, fps: float, frames: int
) -> np.ndarray:
    """Return every sequence of the clips about the root, (N, frames, J, 3), metres."""
    motions = [clip.retarget(body.skeleton).resample(fps) for clip in clips]
    long = [centre_motion(motion).positions for motion in motions if motion.frames >= frames]
    if not long:
        raise ValueError(
            f"clips has none of {frames} frames or more at {fps:g} frames per second, expected one"
        )
    return np.concatenate([windows(positions, frames) for positions in long])


def _guessed(
    network: PoseNetwork,
    settings: MotionVAESettings,
    body: ArticulatedBody,
    keypoints: np.ndarray,
    confidence: np.ndarray,
    distance: float | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return joints about the root in the camera's axes, (n, H, L, J, 3), and losses (n, H)."""
    rest = torch.as_tensor(body.rest_positions, dtype=torch.float32)
    pictures, seen = torch.as_tensor(keypoints), torch.as_tensor(confidence)
    with torch.no_grad():
        guesses = network.eval()(pictures, seen, rest)
        terms = guess_terms(body, guesses, pictures, (seen > 0).float(), distance)
        still = torch.zeros_like(guesses.translation[..., :1]).expand(*[-1] * 3, 3)
        found = body.positions(guesses.turns, guesses.rotation, still, guesses.log_lengths)
    return found.numpy(), weighted_sum(terms, settings).numpy()
