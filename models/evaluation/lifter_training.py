"""Training of the lifter on 2D poses only (Wandt, Little and Rhodin, "ElePose", CVPR 2022).

Each 2D pose is lifted, rotated to a random azimuth and projected at the camera elevation estimated
for another pose. The loss is low if a normalising flow of 2D poses assigns the projection a
high density and the pose lifted from the projection equals the first 3D pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.evaluation.lifter import (
    KIND,
    LifterNetwork,
    LifterSettings,
    project_points,
    raise_points,
)
from probmotion.models.evaluation.pose_flow import PoseFlow
from probmotion.models.evaluation.pose_flow_training import PoseTrainee
from probmotion.models.training.devices import half_precision
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_not_negative

__all__ = ["LifterTrainee", "LossWeights", "bone_sizes", "lifting_losses"]

# Quantile of a bone's 2D lengths, as an estimate of its 3D length: most bones are parallel to the
# image in some frames, and the largest 2D lengths are detection errors.
_QUANTILE = 0.9


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss terms.

    Parameters
    ----------
    likelihood : float
        Weight of the negative log density of the new projections, nats per coordinate.
    points : float
        Weight of the squared distance between the lifted poses of input and projection, metres².
    picture : float
        Weight of the squared distance between the input and the final projection, metres².
    bones : float
        Weight of the squared relative error of bone lengths.
    """

    likelihood: float = 1.0
    points: float = 10.0
    picture: float = 10.0
    bones: float = 10.0

    def __post_init__(self) -> None:
        for name, weight in asdict(self).items():
            check_not_negative(name, weight)


def bone_sizes(skeleton: Skeleton, poses: np.ndarray) -> np.ndarray:
    """Return the lengths of K bones from 2D poses, equal for mirrored bones: (K,), metres.

    The 2D length of a bone is at most its length. The 90 % quantile over the data replaces the body
    proportions that ElePose estimates from 3D data.
    """
    lengths = {
        (joint, parent): np.linalg.norm(poses[:, joint] - poses[:, parent], axis=-1)
        for joint, parent in skeleton.bones
    }
    mirror = skeleton.mirrored_order
    sizes = []
    for joint, parent in skeleton.bones:
        mirrored = lengths.get((mirror[joint], mirror[parent]), lengths[joint, parent])
        sizes.append(np.quantile(np.concatenate([lengths[joint, parent], mirrored]), _QUANTILE))
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
    """Return the terms of the loss, named as in :class:`LossWeights`.

    The lifter maps root-centred poses (N, J, 2) to depths (N, J) and elevations (N,). ``azimuth``
    (N,): azimuths of the new cameras relative to the original ones; ``order`` (N,): permutation of
    the estimated elevations for the new cameras; ``sizes`` (K,): bone lengths, metres.
    """
    bones = torch.tensor(flow.skeleton.bones, device=poses.device)
    zero = torch.zeros_like(azimuth)
    depth, elevation = network(poses)
    points = raise_points(poses, depth, zero, elevation, distance)
    projections = project_points(points, azimuth, elevation[order], distance)
    depth_again, elevation_again = network(projections)
    lifted_again = raise_points(projections, depth_again, azimuth, elevation_again, distance)
    final = project_points(lifted_again, zero, elevation, distance)
    lengths = torch.linalg.norm(points[:, bones[:, 0]] - points[:, bones[:, 1]], dim=-1)
    return {
        "likelihood": -flow.log_density(projections).mean() / (2 * len(flow.joints)),
        "points": ((lifted_again - points) ** 2).sum(dim=-1).mean(),
        "picture": ((final - poses) ** 2).sum(dim=-1).mean(),
        "bones": ((lengths / sizes - 1) ** 2).mean(),
    }


class LifterTrainee(PoseTrainee):
    """Trainee of a lifter for :func:`~probmotion.models.training.trainer.train`.

    Parameters are those of :class:`~probmotion.models.evaluation.pose_flow_training.PoseTrainee`,
    plus ``flow``, trained on similar tracks, and ``weights`` of the loss terms.
    """

    kind = KIND
    size: LifterSettings
    _validation_poses = 1024

    def __init__(
        self,
        tracks: Sequence[KeypointTrack],
        validation: Sequence[KeypointTrack],
        flow: PoseFlow,
        size: LifterSettings,
        *,
        weights: LossWeights | None = None,
        **options: Any,
    ) -> None:
        super().__init__(tracks, validation, size, **options)
        if flow.skeleton != self.skeleton:
            names = ", ".join(flow.skeleton.joint_names)
            raise ValueError(f"flow must have the skeleton of tracks, got joints {names}")
        self.weights = LossWeights() if weights is None else weights
        self.sizes = bone_sizes(self.skeleton, self.poses.astype(np.float64))
        root = self.skeleton.roots[0]
        self.network = LifterNetwork(size, self.skeleton.n_joints, root, self._seed)
        flat = self.poses[:, self.network.joints].reshape(len(self.poses), -1).astype(np.float64)
        self.network.mean.copy_(torch.from_numpy(flat.mean(axis=0)))
        self.network.deviation.copy_(torch.from_numpy(np.maximum(flat.std(axis=0), 1e-3)))
        self.flow = flow.eval().requires_grad_(False)
        self.settings = {
            **self.settings,
            "weights": asdict(self.weights),
            "bone_sizes": self.sizes.tolist(),
            "flow": flow.digest,
        }

    def _loss(
        self, network: nn.Module, poses: np.ndarray, rng: np.random.Generator, device: torch.device
    ) -> torch.Tensor:
        azimuth = torch.as_tensor(rng.uniform(0, 2 * np.pi, len(poses)), dtype=torch.float32)
        order = torch.as_tensor(rng.permutation(len(poses)))
        # Densities require single precision.
        with half_precision(device, False):
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
