"""Frame-by-frame lifting of 2D poses to 3D poses, trained on 2D poses only.

The network estimates the depth of each joint and the elevation of the camera (Wandt, Little and
Rhodin, "ElePose", CVPR 2022). A joint at p in the image and z metres behind the root is at
(p (1 + z/d), z) in camera coordinates, where d is both the distance and the focal length of the
camera. A lifted pose therefore projects exactly onto its 2D pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.training.checkpoints import load_checkpoint, load_weights
from probmotion.models.training.devices import check_device, inference
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = [
    "KIND", "LifterNetwork", "LifterSettings", "PoseLifter", "project_points", "raise_points",
]  # fmt: skip

KIND = "pose-lifter"
# Fixed number of poses per chunk, as rounding depends on the shape of a batch.
_CHUNK = 256


@dataclass(frozen=True)
class LifterSettings:
    """Size of the lifter network and assumptions about cameras.

    Parameters
    ----------
    width : int
        Width of every layer.
    blocks : int
        Number of residual blocks in each of the two branches.
    deepest : float
        Maximum depth of a joint relative to the root, metres, less than ``distance``.
    steepest : float
        Maximum camera elevation, radians. The minimum is 0, because a motion and its reflection
        seen from below have nearly the same 2D projection.
    distance : float
        Distance from the camera to the root, metres.
    """

    width: int = 256
    blocks: int = 2
    deepest: float = 2.0
    steepest: float = math.pi / 4
    distance: float = 7.0

    def __post_init__(self) -> None:
        for name in ("width", "blocks"):
            check_count(name, getattr(self, name))
        for name in ("deepest", "steepest", "distance"):
            check_positive(name, getattr(self, name))
        if not self.deepest < self.distance:
            raise ValueError(f"deepest must be below distance={self.distance}, got {self.deepest}")
        if not self.steepest < math.pi / 2:
            raise ValueError(f"steepest must be below pi/2, got {self.steepest}")

    @classmethod
    def tiny(cls) -> LifterSettings:
        """Return a size for tests."""
        return cls(width=64, blocks=1)

    @classmethod
    def small(cls) -> LifterSettings:
        """Return a size that trains in minutes on one core."""
        return cls()


class LifterNetwork(nn.Module):
    """Network that estimates joint depths and camera elevation from a root-centred 2D pose."""

    mean: torch.Tensor
    deviation: torch.Tensor

    def __init__(self, settings: LifterSettings, n_joints: int, root: int, seed: int = 0) -> None:
        super().__init__()
        self.settings = settings
        self.joints = [joint for joint in range(n_joints) if joint != root]
        D = 2 * len(self.joints)
        self.register_buffer("mean", torch.zeros(D))
        self.register_buffer("deviation", torch.ones(D))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seeds.integer(seed, "weights"))
            self.entry = nn.Linear(D, settings.width)
            self.depth = _branch(settings, len(self.joints))
            self.elevation = _branch(settings, 1)

    def forward(self, poses: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return depths, 0 for the root, and elevations, radians: ``(N, J, 2) → (N, J), (N,)``."""
        flat = (poses[:, self.joints].flatten(1) - self.mean) / self.deviation
        hidden = self.entry(flat)
        deepest = self.settings.deepest
        depth = poses.new_zeros(poses.shape[:2])
        depth[:, self.joints] = deepest * torch.tanh(self.depth(hidden) / deepest)
        # The initial elevation is half of the maximum.
        elevation = self.settings.steepest * torch.sigmoid(self.elevation(hidden)[:, 0])
        return depth, elevation


class _Block(nn.Module):
    """Residual block of two layers."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.layers(x)


def _branch(settings: LifterSettings, outputs: int) -> nn.Sequential:
    blocks = [_Block(settings.width) for _ in range(settings.blocks)]
    # Small initial weights: the initial poses are almost flat.
    last = nn.Linear(settings.width, outputs)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*blocks, nn.SiLU(), last)


def raise_points(
    poses: torch.Tensor,
    depth: torch.Tensor,
    azimuth: torch.Tensor,
    elevation: torch.Tensor,
    distance: float,
) -> torch.Tensor:
    """Return the global joint positions of 2D poses, root at the origin: (N, J, 3), metres.

    Poses are (N, J, 2), depths relative to the root (N, J), azimuths and elevations of the cameras
    (N,), as in :meth:`probmotion.geometry.cameras.Cameras.around`.
    """
    plane = poses * (1 + depth[..., None] / distance)
    return torch.cat([plane, depth[..., None]], dim=-1) @ _world_to_camera(azimuth, elevation)


def project_points(
    points: torch.Tensor, azimuth: torch.Tensor, elevation: torch.Tensor, distance: float
) -> torch.Tensor:
    """Return the perspective projections of points (N, J, 3) by N cameras: (N, J, 2), metres."""
    camera = points @ _world_to_camera(azimuth, elevation).mT
    return camera[..., :2] / (1 + camera[..., 2:] / distance)


def _world_to_camera(azimuth: torch.Tensor, elevation: torch.Tensor) -> torch.Tensor:
    """Return rotations from world to camera coordinates, (N, 3, 3)."""
    ca, sa, ce, se = azimuth.cos(), azimuth.sin(), elevation.cos(), elevation.sin()
    zero = torch.zeros_like(ca)
    rows = [ca, zero, -sa, se * sa, -ce, se * ca, -ce * sa, -se, -ce * ca]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


class PoseLifter:
    """Trained lifter of 2D motions of one skeleton, on a device: ``cpu``, ``cuda`` or ``auto``."""

    def __init__(self, network: LifterNetwork, skeleton: Skeleton, *, device: str = "cpu") -> None:
        self.skeleton = skeleton
        self.settings = network.settings
        self._device = check_device(device).type
        self._network = network.to(self._device).eval().requires_grad_(False)

    @classmethod
    def load(cls, source: str | Path, *, device: str = "cpu") -> PoseLifter:
        """Return a trained lifter from a checkpoint or the folder of a training run.

        Raises
        ------
        CheckpointError
            If the file is damaged or not a lifter of this version.
        FileNotFoundError
            If there is no such file.
        """
        checkpoint = load_checkpoint(source, KIND)
        stored = checkpoint.settings["network"]
        skeleton = Skeleton(stored["joint_names"], stored["parents"])
        settings = LifterSettings(**stored["size"])
        network = LifterNetwork(settings, skeleton.n_joints, skeleton.roots[0])
        load_weights(network, checkpoint.tensors, KIND)
        return cls(network, skeleton, device=device)

    def lift(self, views: np.ndarray) -> np.ndarray:
        """Return the 3D motion of each 2D motion: ``(N, L, J, 2) → (N, L, J, 3)``, metres.

        Y is up and the root at the origin. The centred views are exact projections of the result by
        ``Cameras.around([0], [elevation], distance=settings.distance, perspective=True)`` with the
        :meth:`elevations` of the views.

        Parameters
        ----------
        views : ndarray, (N, L, J, 2)
            Metres at the root's distance, x right and y down. Every frame is centred on the root.

        Raises
        ------
        ValueError
            If the shape is wrong or a number is not finite.
        """
        poses, depth, elevation = self._estimates(views)
        tilt = torch.from_numpy(np.repeat(elevation, views.shape[1]))
        inputs = torch.from_numpy(poses), torch.from_numpy(depth)
        points = raise_points(*inputs, 0 * tilt, tilt, self.settings.distance)
        return points.numpy().reshape(*views.shape[:3], 3)

    def elevations(self, views: np.ndarray) -> np.ndarray:
        """Return the camera elevation of each motion, radians: ``(N, L, J, 2) → (N,)``.

        The result is the mean over frames, since the camera is assumed to be static.
        """
        return self._estimates(views)[2]

    def _estimates(self, views: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return centred poses (N L, J, 2), depths (N L, J) and elevations (N,), float64."""
        J = self.skeleton.n_joints
        check_shape("views", views, ("N", "L", J, 2))
        check_finite("views", views)
        if 0 in views.shape:
            raise ValueError(f"views must contain a motion and a frame, got shape {views.shape}")
        poses = np.asarray(views, np.float64).reshape(-1, J, 2)
        poses = poses - poses[:, [self.skeleton.roots[0]]]
        depth, elevation = np.empty(poses.shape[:2]), np.empty(len(poses))
        for start in range(0, len(poses), _CHUNK):
            n = min(_CHUNK, len(poses) - start)
            chunk = slice(start, start + n)
            padded = np.zeros((_CHUNK, J, 2), np.float32)
            padded[:n] = poses[chunk]
            with inference(self._device):
                estimate = self._network(torch.from_numpy(padded).to(self._device))
            depth[chunk], elevation[chunk] = (part.cpu().numpy()[:n] for part in estimate)
        return poses, depth, elevation.reshape(views.shape[:2]).mean(axis=1)
