"""`PoseFlow`: the density of 2D poses, learnt by a normalising flow.

An unsupervised lifter asks it how likely a pose is that nobody has filmed: its own 3D pose, seen
from elsewhere (Wandt, Little and Rhodin, "ElePose", CVPR 2022). Joints depend on each other so
closely that a flow over their coordinates is nearly singular. As there, it works on the leading
principal components; what they leave over is a Gaussian here rather than nothing, so that the
density is one of whole poses and a pose off their plane is unlikely.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.training.checkpoints import load_checkpoint, load_weights
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_shape

__all__ = ["KIND", "CouplingFlow", "FlowSettings", "PoseFlow"]

KIND = "pose-flow"
# Couplings scale by at most e to this, either way, so that a step can never explode.
_MOST = 1.5


@dataclass(frozen=True)
class FlowSettings:
    """Size of the flow and what it takes for a pose.

    Parameters
    ----------
    couplings : int
        Affine coupling layers.
    width : int
        Of each coupling's network.
    share : float
        Share of the variance that the principal components hold, above 0 and at most 1.
    blur : float
        Standard deviation of the noise added to every coordinate in training, metres: the density
        is that of slightly blurred poses, whose slopes reach further.

    Raises
    ------
    ValueError
        If a number is out of range.
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
            raise ValueError(f"blur must be a number of at least 0, got {self.blur}")

    @classmethod
    def tiny(cls) -> FlowSettings:
        """Return the size for tests."""
        return cls(couplings=4, width=32)

    @classmethod
    def small(cls) -> FlowSettings:
        """Return the size that one core trains in a minute."""
        return cls()


class CouplingFlow(nn.Module):
    """Invertible map of R^D by affine couplings: x ↦ z with a standard normal density of z.

    A coupling keeps half of the coordinates, and scales and shifts the others by a function of the
    kept ones (Dinh, Sohl-Dickstein and Bengio, "Density estimation using Real NVP", 2017). A fixed
    permutation stands before each, so that all coordinates meet. It begins as the identity up to
    the permutations.
    """

    def __init__(self, dimensions: int, couplings: int, width: int, seed: int = 0) -> None:
        super().__init__()
        check_count("dimensions", dimensions, least=2)
        self.kept = dimensions // 2
        changed = dimensions - self.kept
        rng = seeds.generator(seed, "permutations")
        # Every other permutation brings what was kept to the end: two couplings change everything.
        turns = np.roll(np.arange(dimensions), -self.kept)
        orders = [turns if n % 2 else rng.permutation(dimensions) for n in range(couplings)]
        self.register_buffer("orders", torch.tensor(np.array(orders)))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.networks = nn.ModuleList(
                nn.Sequential(
                    nn.Linear(self.kept, width),
                    nn.SiLU(),
                    nn.Linear(width, width),
                    nn.SiLU(),
                    nn.Linear(width, 2 * changed),
                )
                for _ in range(couplings)
            )
        for network in self.networks:
            last: Any = network[-1]
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return z and log |det dz/dx|: ``(N, D) → (N, D), (N,)``."""
        log_determinant = x.new_zeros(len(x))
        for order, network in zip(self.orders, self.networks, strict=True):
            kept, changed = x[:, order].split([self.kept, x.shape[1] - self.kept], dim=1)
            log_scale, shift = _scale_and_shift(network, kept)
            x = torch.cat([kept, changed * log_scale.exp() + shift], dim=1)
            log_determinant = log_determinant + log_scale.sum(dim=1)
        return x, log_determinant

    def inverse(self, z: torch.Tensor) -> torch.Tensor:
        """Return the x that :meth:`forward` takes to z."""
        backwards = reversed(list(zip(self.orders, self.networks, strict=True)))
        for order, network in backwards:
            kept, changed = z.split([self.kept, z.shape[1] - self.kept], dim=1)
            log_scale, shift = _scale_and_shift(network, kept)
            z = torch.cat([kept, (changed - shift) * (-log_scale).exp()], dim=1)
            z = z[:, torch.argsort(order)]
        return z


def _scale_and_shift(network: nn.Module, kept: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    log_scale, shift = network(kept).chunk(2, dim=1)
    return _MOST * torch.tanh(log_scale / _MOST), shift


class PoseFlow(nn.Module):
    """Density of root-centred 2D poses.

    Parameters
    ----------
    skeleton : Skeleton
        The J joints; the first root, which is at the origin, has no coordinates of its own.
    settings : FlowSettings
        Size of the flow.
    components : int
        Leading principal components that the flow works on, at least 2.
    seed : int
        Of the first weights and the permutations.
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
        root = skeleton.roots[0]
        self.joints = [joint for joint in range(skeleton.n_joints) if joint != root]
        D = 2 * len(self.joints)
        if not components <= D:
            raise ValueError(f"components must be at most {D}, got {components}")
        self.register_buffer("mean", torch.zeros(D))
        self.register_buffer("basis", torch.eye(D))
        self.register_buffer("deviation", torch.ones(D))
        self.flow = CouplingFlow(components, settings.couplings, settings.width, seed)

    @classmethod
    def of_poses(
        cls, skeleton: Skeleton, settings: FlowSettings, poses: np.ndarray, seed: int = 0
    ) -> PoseFlow:
        """Return an untrained flow with the principal components of poses (N, J, 2), metres."""
        root = skeleton.roots[0]
        flat = np.delete(poses, root, axis=1).reshape(len(poses), -1)
        mean = flat.mean(axis=0)
        covariance = np.cov(flat, rowvar=False, bias=True)
        covariance = covariance + settings.blur**2 * np.eye(len(covariance))
        variance, basis = np.linalg.eigh(covariance)
        variance, basis = variance[::-1], basis[:, ::-1]
        if not variance[-1] > 1e-12:
            raise ValueError("blur is 0 and poses fill no volume, expected blur above 0")
        held = np.cumsum(variance) / variance.sum()
        components = max(2, min(len(variance), 1 + int((held < settings.share).sum())))
        flow = cls(skeleton, settings, components, seed)
        flow.mean.copy_(torch.from_numpy(mean))
        flow.basis.copy_(torch.from_numpy(basis.copy()))
        flow.deviation.copy_(torch.from_numpy(np.sqrt(variance)))
        return flow

    @classmethod
    def load(cls, source: str | Path) -> PoseFlow:
        """Return a trained flow from a checkpoint's file or the folder of a training run.

        Raises
        ------
        CheckpointError
            If the file is damaged, of another version or no pose flow.
        FileNotFoundError
            If there is no such file.
        """
        checkpoint = load_checkpoint(source, KIND)
        kept = checkpoint.settings["network"]
        skeleton = Skeleton(kept["joint_names"], kept["parents"])
        flow = cls(skeleton, FlowSettings(**kept["size"]), kept["components"])
        load_weights(flow, checkpoint.tensors)
        return flow.eval().requires_grad_(False)

    @property
    def digest(self) -> str:
        """SHA-256 of the weights, which says what was asked for densities."""
        found = hashlib.sha256()
        for name, tensor in sorted(self.state_dict().items()):
            found.update(name.encode() + tensor.cpu().contiguous().numpy().tobytes())
        return found.hexdigest()

    def log_density(self, poses: torch.Tensor) -> torch.Tensor:
        """Return the logarithm of the density of poses per metre^2(J−1): ``(N, J, 2) → (N,)``.

        Poses must be centred on the root, whose own coordinates are not looked at.
        """
        check_shape("poses", poses, ("N", self.skeleton.n_joints, 2))
        flat = poses[:, self.joints].flatten(1)
        standard = (flat - self.mean) @ self.basis / self.deviation
        leading, rest = standard[:, : self.components], standard[:, self.components :]
        z, log_determinant = self.flow(leading)
        squares = (z**2).sum(dim=1) + (rest**2).sum(dim=1)
        constant = 0.5 * flat.shape[1] * math.log(2 * math.pi) + self.deviation.log().sum()
        return log_determinant - 0.5 * squares - constant
