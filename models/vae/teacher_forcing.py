"""Pseudo-labels of a fixed pose network, computed once per frame."""

from __future__ import annotations

from dataclasses import replace

from probmotion.extras import torch
from probmotion.models.training.devices import half_precision
from probmotion.models.training.track_batches import Batch, TrackBatches
from probmotion.models.vae.layers import FRAMES_AT_ONCE
from probmotion.models.vae.pose_network import PoseHypotheses, PoseNetwork

__all__ = ["TeacherForcedPoses", "scaled"]


class TeacherForcedPoses:
    """Teacher poses of all frames of tracks and of mirror images, under every view hypothesis.

    The teacher is fixed and treats frames independently, so its output for a frame can be reused
    in every window; scaled windows use :func:`scaled`. A stored frame of a person takes about 3 kB
    on the device of the rest pose (J, 3). Raises ``ValueError`` if ``batches`` shifts windows.
    """

    @torch.no_grad()
    def __init__(self, network: PoseNetwork, batches: TrackBatches, rest: torch.Tensor) -> None:
        if batches.augmentation.shift:
            raise ValueError(
                "augmentation of batches must have shift=0 for precomputed teacher poses, got "
                f"{batches.augmentation.shift:g}"
            )
        keypoints, seen = (
            torch.as_tensor(values, dtype=torch.float32, device=rest.device)[:, None]
            for values in batches.all_frames()
        )
        parts = zip(keypoints.split(FRAMES_AT_ONCE), seen.split(FRAMES_AT_ONCE), strict=True)
        network.eval()
        # Full precision, even if the first training step uses autocast.
        with half_precision(rest.device, False):
            outputs = [vars(network(*part, rest)).values() for part in parts]
        rotation, translation, turns, log_lengths = map(torch.cat, zip(*outputs, strict=True))
        self._poses = PoseHypotheses(
            rotation[:, :, 0], translation[:, :, 0], turns[:, :, 0], log_lengths
        )

    def of(self, drawn: Batch) -> PoseHypotheses:
        """Return the teacher poses of drawn windows, before scaling, without padded windows."""
        if padded := int((drawn.frames < 0).any(axis=1).sum()):
            raise ValueError(f"drawn must not contain padded windows, got {padded}")
        frames = torch.as_tensor(drawn.frames, device=self._poses.turns.device)
        poses = self._poses.at(frames)
        return PoseHypotheses(
            poses.rotation.transpose(1, 2),
            poses.translation.transpose(1, 2),
            poses.turns.transpose(1, 2),
            # The network predicts log lengths linearly from the mean over frames.
            poses.log_lengths.mean(dim=1),
        )


def scaled(hypotheses: PoseHypotheses, scale: torch.Tensor) -> PoseHypotheses:
    """Return poses with root positions and bone lengths scaled by ``scale``, (B,).

    This scales orthographic projections exactly. For a perspective camera at 7 m and a scale of
    1.05, the error is 3 mm at a joint .5 m closer than the root.
    """
    factor = scale.reshape(-1, *[1] * (hypotheses.translation.ndim - 1))
    log_factor = scale.log().reshape(-1, *[1] * (hypotheses.log_lengths.ndim - 1))
    return replace(
        hypotheses,
        translation=factor * hypotheses.translation,
        log_lengths=hypotheses.log_lengths + log_factor,
    )
