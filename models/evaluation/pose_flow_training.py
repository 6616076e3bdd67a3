"""Learning the density of 2D poses from the frames of tracks that are seen whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.evaluation.pose_flow import KIND, FlowSettings, PoseFlow
from probmotion.models.training.track_batches import describe_tracks
from probmotion.motion.motion import KeypointTrack

__all__ = ["PoseFlowTrainee", "whole_poses"]

_VALIDATION_POSES = 2048


def whole_poses(
    tracks: Sequence[KeypointTrack], threshold: float, *, mirror: bool = True
) -> np.ndarray:
    """Return the poses that are seen whole, centred on the root: (N, J, 2), metres.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Of one skeleton, metres.
    threshold : float
        Least confidence that every joint of a frame must have for it to count.
    mirror : bool
        Add the mirror images, left and right joints exchanged.

    Raises
    ------
    ValueError
        If there is no track, the skeletons differ, or no frame is seen whole.
    """
    if not tracks:
        raise ValueError("tracks must contain at least one track, got none")
    skeleton = tracks[0].skeleton
    found = []
    for track in tracks:
        if track.skeleton != skeleton:
            raise ValueError(f"tracks has {track.name!r} with other joints, expected one skeleton")
        whole = ((track.confidence >= threshold) & (track.confidence > 0)).all(axis=1)
        found.append(track.keypoints[whole])
    poses = np.concatenate(found)
    if len(poses) == 0:
        raise ValueError(
            f"tracks has no frame with every joint at confidence {threshold:g} or more, expected "
            "whole poses to learn from"
        )
    root = skeleton.roots[0]
    poses = poses - poses[:, root : root + 1]
    if mirror:
        order = np.arange(skeleton.n_joints)
        for left, right in skeleton.mirrored_pairs:
            order[[left, right]] = right, left
        poses = np.concatenate([poses, poses[:, order] * np.array([-1.0, 1.0])])
    return poses


class PoseFlowTrainee:
    """What :func:`~probmotion.models.training.trainer.train` needs to learn the density of 2D
    poses.

    The loss is the mean of −log density over the number of coordinates, in nats.

    Parameters
    ----------
    tracks, validation : sequence of KeypointTrack
        Prepared: metres, of one skeleton; of other clips for validation.
    size : FlowSettings
        The flow's.
    threshold : float
        Least confidence of every joint of a pose that is learnt from.
    seed : int
        Of the first weights, the permutations and the validation's noise.

    Raises
    ------
    ValueError
        If there is no track, skeletons differ, or no frame is seen whole.
    """

    kind = KIND

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: FlowSettings,
        *,
        threshold: float = 0.3,
        seed: int = 0,
    ) -> None:
        self.size = size
        self.poses = whole_poses(tracks, threshold).astype(np.float32)
        self.held_out = whole_poses(validation, threshold).astype(np.float32)
        skeleton = tracks[0].skeleton
        if validation[0].skeleton != skeleton:
            raise ValueError("validation has another skeleton than tracks, expected the same")
        self.network = PoseFlow.of_poses(skeleton, size, self.poses.astype(np.float64), seed)
        self._seed = seed
        self.settings: Mapping[str, Any] = {
            "size": asdict(size),
            "components": self.network.components,
            "joint_names": list(skeleton.joint_names),
            "parents": list(skeleton.parents),
            "threshold": threshold,
            "data": describe_tracks(tracks),
            "validation_data": describe_tracks(validation),
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of fresh poses."""
        return self._loss(
            network, self.poses[rng.integers(len(self.poses), size=batch)], rng, device
        )

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out poses that never change."""
        rng = seeds.generator(self._seed, "validation")
        chosen = rng.permutation(len(self.held_out))[:_VALIDATION_POSES]
        return float(self._loss(network, self.held_out[chosen], rng, device).detach())

    def _loss(
        self,
        network: nn.Module,
        poses: np.ndarray,
        rng: np.random.Generator,
        device: torch.device,
    ) -> torch.Tensor:
        noise = rng.standard_normal(poses.shape, dtype=np.float32)
        blurred = torch.as_tensor(poses + np.float32(self.size.blur) * noise, device=device)
        assert isinstance(network, PoseFlow)
        # A density needs single precision, whatever the trainer computes in.
        with torch.autocast(device.type, enabled=False):
            density = network.log_density(blurred)
        return -density.mean() / (2 * len(network.joints))
