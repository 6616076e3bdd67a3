"""Training of a pose flow, a density of 2D poses, on fully visible frames of tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.evaluation.pose_flow import KIND, FlowSettings, PoseFlow
from probmotion.models.training.devices import half_precision
from probmotion.models.training.track_batches import describe_tracks
from probmotion.motion.motion import KeypointTrack

__all__ = ["PoseFlowTrainee", "PoseTrainee", "fully_visible_poses"]


def fully_visible_poses(tracks: Sequence[KeypointTrack], threshold: float) -> np.ndarray:
    """Return the fully visible poses and their mirror images, root-centred: (N, J, 2), metres.

    In a fully visible pose, all joints have a confidence of ``threshold`` or more. Raises
    ``ValueError`` if there is no track, skeletons differ, or no frame is fully visible.
    """
    if not tracks:
        raise ValueError("tracks must contain at least one track, got none")
    skeleton = tracks[0].skeleton
    chosen = []
    for track in tracks:
        if track.skeleton != skeleton:
            raise ValueError(f"tracks must share one skeleton, got another in {track.name!r}")
        visible = (track.confidence >= threshold) & (track.confidence > 0)
        chosen.append(track.keypoints[visible.all(axis=1)])
    poses = np.concatenate(chosen)
    if len(poses) == 0:
        raise ValueError(
            f"tracks must contain a frame with every joint at confidence {threshold:g} or more, "
            "got none"
        )
    poses = poses - poses[:, [skeleton.roots[0]]]
    mirrored = poses[:, list(skeleton.mirrored_order)] * np.array([-1.0, 1.0])
    return np.concatenate([poses, mirrored])


class PoseTrainee:
    """Base class of trainees on fully visible 2D poses: data and settings.

    Parameters
    ----------
    tracks, validation : sequence of KeypointTrack
        Prepared tracks of one skeleton, metres; validation tracks are from other clips.
    size : dataclass
        Settings of the network.
    threshold : float
        Minimum confidence of every joint of a pose.
    seed : int
        Seed of initial weights and validation noise.
    """

    _validation_poses: int  # Maximum number of held-out poses in the validation loss.

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: Any,
        *,
        threshold: float = 0.3,
        seed: int = 0,
    ) -> None:
        self.size = size
        self.poses = fully_visible_poses(tracks, threshold).astype(np.float32)
        self.held_out = fully_visible_poses(validation, threshold).astype(np.float32)
        self.skeleton = tracks[0].skeleton
        if validation[0].skeleton != self.skeleton:
            names = ", ".join(validation[0].skeleton.joint_names)
            raise ValueError(f"validation must have the skeleton of tracks, got joints {names}")
        self._seed = seed
        self.settings: Mapping[str, Any] = {
            "size": asdict(size),
            "joint_names": list(self.skeleton.joint_names),
            "parents": list(self.skeleton.parents),
            "threshold": threshold,
            "data": describe_tracks(tracks),
            "validation_data": describe_tracks(validation),
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss on a random batch of poses."""
        chosen = self.poses[rng.integers(len(self.poses), size=batch)]
        return self._loss(network, chosen, rng, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on a fixed batch of held-out poses."""
        rng = seeds.generator(self._seed, "validation")
        chosen = self.held_out[rng.permutation(len(self.held_out))[: self._validation_poses]]
        return float(self._loss(network, chosen, rng, device).detach())

    def _loss(
        self, network: nn.Module, poses: np.ndarray, rng: np.random.Generator, device: torch.device
    ) -> torch.Tensor:
        raise NotImplementedError


class PoseFlowTrainee(PoseTrainee):
    """Trainee of a pose flow for :func:`~probmotion.models.training.trainer.train`.

    The loss is the mean negative log density per coordinate, in nats. Parameters are those of
    :class:`PoseTrainee`.
    """

    kind = KIND
    size: FlowSettings
    _validation_poses = 2048

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        size: FlowSettings,
        **options: Any,
    ) -> None:
        super().__init__(tracks, validation, size, **options)
        poses = self.poses.astype(np.float64)
        self.network = PoseFlow.of_poses(self.skeleton, size, poses, self._seed)
        self.settings = {**self.settings, "components": self.network.components}

    def _loss(
        self, network: nn.Module, poses: np.ndarray, rng: np.random.Generator, device: torch.device
    ) -> torch.Tensor:
        noise = rng.standard_normal(poses.shape, dtype=np.float32)
        blurred = torch.as_tensor(poses + np.float32(self.size.blur) * noise, device=device)
        assert isinstance(network, PoseFlow)
        # Densities require single precision.
        with half_precision(device, False):
            density = network.log_density(blurred)
        return -density.mean() / (2 * len(network.joints))
