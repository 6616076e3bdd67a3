"""Learning to lift from 2D poses alone (Wandt, Little and Rhodin, "ElePose", CVPR 2022).

A lifted pose is right if it looks like a pose from everywhere else. Each 2D pose is lifted, turned
to a random azimuth, seen from an elevation that another pose's camera is thought to have, and the
picture is asked of a normalising flow. The picture is lifted again, and both 3D poses must agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.evaluation.lifter import (
    KIND,
    LifterNetwork,
    LifterSettings,
    project_points,
    raise_points,
)
from probmotion.models.evaluation.pose_flow import PoseFlow
from probmotion.models.evaluation.pose_flow_training import whole_poses
from probmotion.models.training.track_batches import describe_tracks
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

__all__ = ["LifterTrainee", "LossWeights", "bone_sizes", "lifting_losses"]

_VALIDATION_POSES = 1024
# Quantile of a bone's length in pictures that stands for its length: most bones are now and then
# seen from the side, and the longest pictures of all are errors of the detector.
_QUANTILE = 0.9


@dataclass(frozen=True)
class LossWeights:
    """How much each term counts.

    Parameters
    ----------
    likelihood : float
        Of −log density of the new pictures, nats per coordinate.
    points : float
        Of the squared distance of the twice lifted pose, metres².
    picture : float
        Of the squared distance of its picture from the one given, metres².
    bones : float
        Of the squared relative error of bone lengths.

    Raises
    ------
    ValueError
        If one is below 0.
    """

    likelihood: float = 1.0
    points: float = 10.0
    picture: float = 10.0
    bones: float = 10.0

    def __post_init__(self) -> None:
        for name, weight in asdict(self).items():
            if not 0 <= weight < float("inf"):
                raise ValueError(f"{name} must be a number of at least 0, got {weight}")


def bone_sizes(skeleton: Skeleton, poses: np.ndarray) -> np.ndarray:
    """Return the length of every bone by its pictures, left and right alike: (K,), metres.

    ElePose is given the proportions of bodies; here there is nothing 3D to take them from. A bone's
    picture is as long as the bone where it is seen from the side, and shorter elsewhere: the 90 %
    quantile over the data is a number of 2D poses alone.

    Parameters
    ----------
    skeleton : Skeleton
        The K bones.
    poses : ndarray, (N, J, 2)
        Metres.
    """
    lengths = {
        (joint, parent): np.linalg.norm(poses[:, joint] - poses[:, parent], axis=-1)
        for joint, parent in skeleton.bones
    }
    other = {joint: joint for joint in range(skeleton.n_joints)}
    for left, right in skeleton.mirrored_pairs:
        other[left], other[right] = right, left
    sizes = []
    for joint, parent in skeleton.bones:
        twin = lengths.get((other[joint], other[parent]), lengths[joint, parent])
        sizes.append(np.quantile(np.concatenate([lengths[joint, parent], twin]), _QUANTILE))
    return np.array(sizes)


def lifting_losses(
    network: nn.Module,
    flow: PoseFlow,
    poses: torch.Tensor,
    azimuth: torch.Tensor,
    order: torch.Tensor,
    sizes: torch.Tensor,
    distance: float,
) -> dict[str, torch.Tensor]:
    """Return the terms of the loss, as :class:`LossWeights` names them.

    Parameters
    ----------
    network : Module
        ``(N, J, 2) → (N, J), (N,)``: depths and elevations.
    flow : PoseFlow
        Trained; it is not changed.
    poses : Tensor, (N, J, 2)
        Root-centred, metres.
    azimuth : Tensor, (N,)
        Of each pose's new camera, radians, from the one that it was seen by.
    order : Tensor, (N,)
        Whose camera's elevation the new one has: a permutation, so that new cameras have exactly
        the elevations that the network finds in the data.
    sizes : Tensor, (K,)
        Lengths of the bones.
    distance : float
        Of the cameras, metres.
    """
    bones = torch.tensor(flow.skeleton.bones, device=poses.device)
    here = torch.zeros_like(azimuth)
    depth, elevation = network(poses)
    points = raise_points(poses, depth, here, elevation, distance)
    pictures = project_points(points, azimuth, elevation[order], distance)
    depth_again, elevation_again = network(pictures)
    again = raise_points(pictures, depth_again, azimuth, elevation_again, distance)
    back = project_points(again, here, elevation, distance)
    lengths = torch.linalg.norm(points[:, bones[:, 0]] - points[:, bones[:, 1]], dim=-1)
    return {
        "likelihood": -flow.log_density(pictures).mean() / (2 * len(flow.joints)),
        "points": ((again - points) ** 2).sum(dim=-1).mean(),
        "picture": ((back - poses) ** 2).sum(dim=-1).mean(),
        "bones": ((lengths / sizes - 1) ** 2).mean(),
    }


class LifterTrainee:
    """What :func:`~probmotion.models.training.trainer.train` needs to learn to lift. It sees 2D
    alone.

    Parameters
    ----------
    tracks, validation : sequence of KeypointTrack
        Prepared: metres, of one skeleton; of other clips for validation.
    flow : PoseFlow
        Trained on tracks such as these.
    size : LifterSettings
        The network's.
    weights : LossWeights, optional
        How much each term counts.
    threshold : float
        Least confidence of every joint of a pose that is learnt from.
    seed : int
        Of the first weights and of the validation's views.

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
        flow: PoseFlow,
        size: LifterSettings,
        *,
        weights: LossWeights | None = None,
        threshold: float = 0.3,
        seed: int = 0,
    ) -> None:
        self.poses = whole_poses(tracks, threshold).astype(np.float32)
        self.held_out = whole_poses(validation, threshold).astype(np.float32)
        skeleton = tracks[0].skeleton
        for name, other in (("validation", validation[0].skeleton), ("flow", flow.skeleton)):
            if other != skeleton:
                raise ValueError(f"{name} has another skeleton than tracks, expected the same")
        self.size = size
        self.weights = LossWeights() if weights is None else weights
        self.sizes = bone_sizes(skeleton, self.poses.astype(np.float64))
        self.network = LifterNetwork(size, skeleton.n_joints, skeleton.roots[0], seed)
        flat = self.poses[:, self.network.joints].reshape(len(self.poses), -1).astype(np.float64)
        self.network.mean.copy_(torch.from_numpy(flat.mean(axis=0)))
        self.network.deviation.copy_(torch.from_numpy(np.maximum(flat.std(axis=0), 1e-3)))
        self.flow = flow.eval().requires_grad_(False)
        self._seed = seed
        self.settings: Mapping[str, Any] = {
            "size": asdict(size),
            "weights": asdict(self.weights),
            "joint_names": list(skeleton.joint_names),
            "parents": list(skeleton.parents),
            "threshold": threshold,
            "bone_sizes": self.sizes.tolist(),
            "flow": flow.digest,
            "data": describe_tracks(tracks),
            "validation_data": describe_tracks(validation),
        }

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of fresh poses in fresh views."""
        chosen = self.poses[rng.integers(len(self.poses), size=batch)]
        return self._loss(network, chosen, rng, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out poses in views that never change."""
        rng = seeds.generator(self._seed, "validation")
        chosen = self.held_out[rng.permutation(len(self.held_out))[:_VALIDATION_POSES]]
        return float(self._loss(network, chosen, rng, device).detach())

    def _loss(
        self,
        network: nn.Module,
        poses: np.ndarray,
        rng: np.random.Generator,
        device: torch.device,
    ) -> torch.Tensor:
        azimuth = torch.as_tensor(rng.uniform(0, 2 * np.pi, len(poses)), dtype=torch.float32)
        order = torch.as_tensor(rng.permutation(len(poses)))
        # A density needs single precision, whatever the trainer computes in.
        with torch.autocast(device.type, enabled=False):
            terms = lifting_losses(
                network,
                self.flow.to(device),
                torch.as_tensor(poses, device=device),
                azimuth.to(device),
                order.to(device),
                torch.as_tensor(self.sizes, dtype=torch.float32, device=device),
                self.size.distance,
            )
        weights = asdict(self.weights)
        return torch.stack([weights[name] * term for name, term in terms.items()]).sum()
