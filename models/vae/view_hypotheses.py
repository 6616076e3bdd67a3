"""Accuracy of view hypotheses against known 3D motion (*Ponymation*, section 3.1).

A projection is ambiguous up to reflection in depth. Joint ranges, perspective and camera height
resolve this ambiguity. The 3D truth is used only for evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.data.projections import DetectorNoise, Filming, centre_motion
from probmotion.extras import torch
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.vae.losses import predicted_hypotheses
from probmotion.models.vae.pose_network import PoseNetwork
from probmotion.models.vae.settings import CONFIDENCE_THRESHOLD, MotionVAESettings
from probmotion.motion.distances import windows
from probmotion.motion.motion import Motion
from probmotion.validation import check_count

__all__ = ["HypothesisAccuracy", "evaluate_hypotheses"]

# A hypothesis counts as correct up to this multiple of the smallest error.
_MAX_ERROR_RATIO = 1.2
_TO_Y_UP = np.array([1.0, -1.0, -1.0])  # from OpenCV axes to y up, z towards the camera


@dataclass(frozen=True)
class HypothesisAccuracy:
    """Accuracy of the selected view hypotheses.

    Parameters
    ----------
    right : float
        Proportion of sequences whose selected hypothesis has at most 1.2 times the smallest error.
    depth_right : float
        Proportion of selected hypotheses closer to the truth than their mirror image in depth.
    error : float
        Mean joint error of the selected hypothesis, relative to the root, metres.
    least_error : float
        Mean joint error of the hypothesis closest to the truth, metres.
    proportions : tuple of float
        Selection frequency of each hypothesis.
    """

    right: float
    depth_right: float
    error: float
    least_error: float
    proportions: tuple[float, ...]


def evaluate_hypotheses(
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
) -> HypothesisAccuracy:
    """Evaluate the selection of view hypotheses on clips with known 3D motion.

    Parameters
    ----------
    network : PoseNetwork
        Trained pose network.
    settings : MotionVAESettings
        Settings of the network, with the loss weights that select a hypothesis.
    body : ArticulatedBody
        Body of the network.
    clips : sequence of Motion
        3D clips with the body's joints.
    n : int
        Number of random sequences, each with a random view.
    fps : float
        Frame rate of the network.
    filming : Filming, optional
        Distribution of cameras.
    noise : DetectorNoise, optional
        Model of detector errors; by default without missing joints.
    seed : int
        Seed of sequences, cameras and errors.

    Raises
    ------
    ValueError
        If all clips are shorter than a sequence.
    """
    check_count("n", n)
    filming, noise = filming or Filming(), noise or DetectorNoise(share=0.0)
    rng = seeds.generator(seed, "hypotheses")
    sequences = _sequences(clips, body, fps, settings.frames)
    chosen = sequences[rng.integers(0, len(sequences), n)]
    cameras = filming.cameras(rng, n)
    detected = [noise.detect(rng, cameras.view(i).project(x)[0]) for i, x in enumerate(chosen)]
    keypoints, confidence = (np.stack(part) for part in zip(*detected, strict=True))
    keypoints = np.nan_to_num(keypoints)
    hypotheses, losses = predicted_hypotheses(
        network.eval(),
        settings,
        body,
        (keypoints - keypoints[:, :, [body.skeleton.roots[0]]]).astype(np.float32),
        # As in training, network inputs contain visibility rather than confidence.
        (confidence >= CONFIDENCE_THRESHOLD).astype(np.float32),
        filming.distance if filming.perspective else None,
    )
    origin = torch.zeros_like(hypotheses.rotation[..., 0])
    estimates = body.positions(
        hypotheses.turns, hypotheses.rotation, origin, hypotheses.log_lengths
    ).numpy()
    truth = np.einsum("nij,nlkj->nlki", cameras.rotation, chosen) * _TO_Y_UP
    errors = np.linalg.norm(estimates - truth[:, None], axis=-1).mean(axis=(2, 3))
    mirrored = np.linalg.norm(estimates * [1, 1, -1] - truth[:, None], axis=-1).mean(axis=(2, 3))
    rows, best = np.arange(n), losses.numpy().argmin(axis=1)
    selected = errors[rows, best]
    return HypothesisAccuracy(
        right=float((selected <= _MAX_ERROR_RATIO * errors.min(axis=1)).mean()),
        depth_right=float((selected < mirrored[rows, best]).mean()),
        error=float(selected.mean()),
        least_error=float(errors.min(axis=1).mean()),
        proportions=tuple((np.bincount(best, minlength=errors.shape[1]) / n).tolist()),
    )


def _sequences(
    clips: Sequence[Motion], body: ArticulatedBody, fps: float, frames: int
) -> np.ndarray:
    """Return all sequences of the clips relative to the root, (N, frames, J, 3), metres."""
    motions = [clip.retarget(body.skeleton).resample(fps) for clip in clips]
    long = [centre_motion(motion).positions for motion in motions if motion.frames >= frames]
    if not long:
        raise ValueError(
            f"clips must include one of at least {frames} frames at {fps:g} fps, got none"
        )
    return np.concatenate([windows(positions, frames) for positions in long])
