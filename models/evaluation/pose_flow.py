"""Normalising flow over 2D poses.

The flow is the pose prior of an unsupervised lifter (Wandt, Little and Rhodin, "ElePose", CVPR
2022). As in the paper, it acts on the leading principal components, since joints are so strongly
correlated that a flow over their coordinates would be almost singular. Unlike in the paper, the
other components are Gaussian, so that the density covers all coordinates.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.training.checkpoints import load_checkpoint, load_weights
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_shape

__all__ = ["KIND", "CouplingFlow", "FlowSettings", "PoseFlow"]

KIND = "pose-flow"
# Maximum absolute log scale of a coupling, for stability.
_MAX_LOG_SCALE = 1.5


@dataclass(frozen=True)
class FlowSettings:
    """Size of a pose flow and preparation of its training poses.

    Parameters
    ----------
    couplings : int
        Number of affine coupling layers.
    width : int
        Width of each coupling's network.
    share : float
        Proportion of the variance explained by the leading principal components, in (0, 1].
    blur : float
        Standard deviation of the noise added to coordinates in training, metres. It smooths the
        density so that its gradients are useful further from the data.
    """

    couplings: int = 8
    width: int = 128
    share: float = 0.99
    blur: float = 0.02

    def __post_init__(self) -> None:
        for name in ("couplings", "width"):
            check_count(name, getattr(self, name))
        if not 0 < self.share <= 1:
            raise ValueError(f"share must be above 0 and at most 1, got {self.share}")
        if not 0 <= self.blur < math.inf:
            raise ValueError(f"blur must be finite and at least 0, got {self.blur}")

    @classmethod
    def tiny(cls) -> FlowSettings:
        """Return a size for tests."""
        return cls(couplings=4, width=32)

    @classmethod
    def small(cls) -> FlowSettings:
        """Return a size that trains in a minute on one core."""
        return cls()


class CouplingFlow(nn.Module):
    """Invertible map x ↦ z of R^D by affine couplings, with standard normal z.

    A coupling scales and shifts half of the coordinates by a function of the others (Dinh,
    Sohl-Dickstein and Bengio, "Density estimation using Real NVP", 2017), after a fixed
    permutation. The initial map is the identity up to permutations.
    """

    def __init__(self, dimensions: int, couplings: int, width: int, seed: int = 0) -> None:
        super().__init__()
        check_count("dimensions", dimensions, least=2)
        self.fixed = dimensions // 2
        changed = dimensions - self.fixed
        rng = seeds.generator(seed, "permutations")
        # Every second permutation swaps the halves, so that two couplings change all coordinates.
        swap = np.roll(np.arange(dimensions), -self.fixed)
        orders = [swap if n % 2 else rng.permutation(dimensions) for n in range(couplings)]
        self.register_buffer("orders", torch.tensor(np.array(orders)))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.networks = nn.ModuleList(
                nn.Sequential(
                    nn.Linear(self.fixed, width), nn.SiLU(),
                    nn.Linear(width, width), nn.SiLU(),
                    nn.Linear(width, 2 * changed),
                )
                for _ in range(couplings)
            )  # fmt: skip
        for network in self.networks:
            last: Any = network[-1]
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return z and ``log |det dz/dx|``: ``(N, D) → (N, D), (N,)``."""
        log_determinant = x.new_zeros(len(x))
        for order, network in zip(self.orders, self.networks, strict=True):
            fixed, changed = x[:, order].split([self.fixed, x.shape[1] - self.fixed], dim=1)
            log_scale, shift = network(fixed).chunk(2, dim=1)
            log_scale = _MAX_LOG_SCALE * torch.tanh(log_scale / _MAX_LOG_SCALE)
            x = torch.cat([fixed, changed * log_scale.exp() + shift], dim=1)
            log_determinant = log_determinant + log_scale.sum(dim=1)
        return x, log_determinant


class PoseFlow(nn.Module):
    """Density model of root-centred 2D poses.

    The flow acts on the ``components`` leading principal components, at least 2. The root is at the
    origin and not part of the density.
    """

    mean: torch.Tensor
    basis: torch.Tensor
    deviation: torch.Tensor

    def __init__(
        self, skeleton: Skeleton, settings: FlowSettings, components: int, seed: int = 0
    ) -> None:
        super().__init__()
        self.skeleton = skeleton
        self.settings = settings
        self.components = components
        self.joints = [joint for joint in range(skeleton.n_joints) if joint != skeleton.roots[0]]
        D = 2 * len(self.joints)
        self.register_buffer("mean", torch.zeros(D))
        self.register_buffer("basis", torch.eye(D))
        self.register_buffer("deviation", torch.ones(D))
        self.flow = CouplingFlow(components, settings.couplings, settings.width, seed)

    @classmethod
    def of_poses(
        cls, skeleton: Skeleton, settings: FlowSettings, poses: np.ndarray, seed: int = 0
    ) -> PoseFlow:
        """Return an untrained flow with the principal components of poses, (N, J, 2), metres."""
        flat = np.delete(poses, skeleton.roots[0], axis=1).reshape(len(poses), -1)
        mean = flat.mean(axis=0)
        covariance = np.cov(flat, rowvar=False, bias=True)
        covariance = covariance + settings.blur**2 * np.eye(len(covariance))
        variance, basis = np.linalg.eigh(covariance)
        variance, basis = variance[::-1], basis[:, ::-1]
        if not variance[-1] > 1e-12:
            raise ValueError(f"blur must be larger for poses in a subspace, got {settings.blur:g}")
        explained = np.cumsum(variance) / variance.sum()
        components = max(2, min(len(variance), 1 + int((explained < settings.share).sum())))
        flow = cls(skeleton, settings, components, seed)
        flow.mean.copy_(torch.from_numpy(mean))
        flow.basis.copy_(torch.from_numpy(basis.copy()))
        flow.deviation.copy_(torch.from_numpy(np.sqrt(variance)))
        return flow

    @classmethod
    def load(cls, source: str | Path) -> PoseFlow:
        """Return a trained flow from a checkpoint or the folder of a training run.

        Raises
        ------
        CheckpointError
            If the file is damaged or not a pose flow of this version.
        FileNotFoundError
            If there is no such file.
        """
        checkpoint = load_checkpoint(source, KIND)
        stored = checkpoint.settings["network"]
        skeleton = Skeleton(stored["joint_names"], stored["parents"])
        flow = cls(skeleton, FlowSettings(**stored["size"]), stored["components"])
        load_weights(flow, checkpoint.tensors, KIND)
        return flow.eval().requires_grad_(False)

    @property
    def digest(self) -> str:
        """SHA-256 of the weights."""
        digest = hashlib.sha256()
        for name, tensor in sorted(self.state_dict().items()):
            digest.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def log_density(self, poses: torch.Tensor) -> torch.Tensor:
        """Return the log density of root-centred poses per metre^(2(J−1)): ``(N, J, 2) → (N,)``."""
        check_shape("poses", poses, ("N", self.skeleton.n_joints, 2))
        flat = poses[:, self.joints].flatten(1)
        standard = (flat - self.mean) @ self.basis / self.deviation
        leading, rest = standard[:, : self.components], standard[:, self.components :]
        z, log_determinant = self.flow(leading)
        squares = (z**2).sum(dim=1) + (rest**2).sum(dim=1)
        constant = 0.5 * flat.shape[1] * math.log(2 * math.pi) + self.deviation.log().sum()
        return log_determinant - 0.5 * squares - constant
