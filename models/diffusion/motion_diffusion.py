"""Prior over 3D motion learnt from 2D tracks only (MAS, sections 4.1 and 6.2).

The prior is a denoiser of single 2D views, which samplers such as `mas` combine into 3D motion.
Diffusion runs in normalised units (metres divided by ``scale``). Only the input and output of the
network are standardised per joint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from probmotion.arrays import Array
from probmotion.extras import torch
from probmotion.geometry.cameras import Cameras
from probmotion.models.diffusion.motion_transformer import MotionTransformer
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.training.checkpoints import Checkpoint, load_weights, save_checkpoint
from probmotion.models.training.devices import batch_tokens, inference
from probmotion.models.training.standardisation import Standards
from probmotion.models.training.track_network import TrackNetwork, load_track_checkpoint
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import NotConjugate
from probmotion.validation import check_count, check_finite, check_shape

if TYPE_CHECKING:
    from probmotion.posteriors.protocols import Likelihood

__all__ = ["KIND", "MotionDiffusion"]

KIND = "motion-diffusion"
# Rounding depends on the shape of a batch, so on the CPU chunks have a fixed shape: at most this
# many tokens, or one motion. Kernels treat the remainder of blocks of four rows differently, so
# chunks have 1, 4, 8, 16, … motions.
_TOKENS = 512
# Maximum deviation of an observed root from the origin, in standard deviations of its noise.
_ROOT_DEVIATIONS = 6.0


class MotionDiffusion(TrackNetwork):
    """Motion prior that denoises views with a 2D motion diffusion model.

    Parameters are those of :class:`~probmotion.models.training.track_network.TrackNetwork` and
    ``frames``, the length L of the prior's motions, by default the maximum of the network.
    """

    settings: DiffusionSettings

    def __init__(
        self,
        network: MotionTransformer,
        settings: DiffusionSettings,
        standards: Standards,
        skeleton: Skeleton,
        fps: float,
        *,
        frames: int | None = None,
        **options: Any,
    ) -> None:
        self.frames = settings.frames if frames is None else frames
        check_count("frames", self.frames, least=2)
        if self.frames > settings.frames:
            raise ValueError(
                f"frames must be at most {settings.frames}, the network's longest motion, got "
                f"{self.frames}"
            )
        super().__init__(network, settings, standards, skeleton, fps, **options)
        self._mean = (standards.mean / self.scale).astype(np.float32)
        self._deviation = (standards.deviation / self.scale).astype(np.float32)

    @classmethod
    def load(
        cls, source: str | Path = "walk2d", *, frames: int | None = None, device: str = "cpu"
    ) -> MotionDiffusion:
        """Return a trained prior.

        Parameters
        ----------
        source : str or Path
            A checkpoint, the folder of a training run, or the name of a shipped prior.
        frames, device
            As in :class:`MotionDiffusion`.

        Raises
        ------
        CheckpointError
            If the file is damaged or not a motion diffusion model of this version.
        FileNotFoundError
            If there is no such file or name.
        """
        checkpoint, settings, standards, skeleton, fps = load_track_checkpoint(
            source, KIND, DiffusionSettings
        )
        network = settings.network(skeleton.n_joints)
        load_weights(network, checkpoint.tensors, KIND)
        data = (network, settings, standards, skeleton, fps)
        return cls(*data, frames=frames, device=device, card=checkpoint.settings)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the prior as a checkpoint, optionally in half precision.

        Raises
        ------
        ValueError
            If the prior was neither trained nor loaded.
        OSError
            If the file cannot be written.
        """
        if "network" not in self.card:
            raise ValueError("card must describe a trained network, got an untrained prior")
        save_checkpoint(path, Checkpoint(KIND, self.card, self._network.state_dict()), half=half)

    def of_length(self, frames: int) -> MotionDiffusion:
        """Return the prior of motions of another length, 2 to ``settings.frames``."""
        data = (self._network, self.settings, self.standards, self.skeleton, self.fps)
        return MotionDiffusion(*data, frames=frames, device=self._device, card=self.card)

    @property
    def dim(self) -> int:
        """Length of θ, which contains all positions."""
        return self.frames * self.skeleton.n_joints * 3

    @property
    def scale(self) -> float:
        """Metres per normalised unit."""
        return self.standards.scale

    @property
    def view_elevation(self) -> float:
        """Elevation of the views in which the prior denoises, radians; that of MAS."""
        return math.pi / 16

    def motion(self, theta: Array) -> Array:
        """Return the joint positions in θ: ``(…, dim) → (…, L, J, 3)``, metres."""
        check_shape("theta", theta, ("…", self.dim))
        return theta.reshape(*theta.shape[:-1], self.frames, self.skeleton.n_joints, 3)

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return the network's estimate of E[x₀ | x_t] for each view.

        Arrays are (B, V, L, J, 2) in normalised units, L at most ``settings.frames``. ``cameras``
        is ignored, as the network was trained on views of unknown cameras.

        Raises
        ------
        ValueError
            If the shape is wrong, a value is not finite, or ᾱ is above 1 or below the network's
            last level.
        """
        self._check(x_t)
        if alpha_bar == 1:
            return x_t.copy()
        level = self.settings.level(alpha_bar)
        standardised = self._standardised(x_t, alpha_bar)
        clean = np.empty_like(standardised)
        for rows, motions, levels in self._chunks(standardised, level):
            with inference(self._device):
                denoised = self._network(motions, levels)
            clean[rows] = _numbers(denoised, clean[rows])
        clean *= self._deviation
        clean += self._mean
        return clean.astype(x_t.dtype)

    def view_covariance(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return v ↦ (1−ᾱ)/√ᾱ Dᵀ v, D the Jacobian of :meth:`denoise`; arrays (B, V, L, J, 2).

        For the exact denoiser, the product is Cov[x₀ | x_t] v (Tweedie). The Jacobian of a network
        is only approximately symmetric. Raises as :meth:`denoise`.
        """
        self._check(x_t)
        if alpha_bar == 1:
            return np.zeros_like
        level = self.settings.level(alpha_bar)
        standardised = self._standardised(x_t, alpha_bar)
        factor = (1 - alpha_bar) / math.sqrt(alpha_bar) / self._spread(alpha_bar)

        def product(vectors: np.ndarray) -> np.ndarray:
            check_shape("vectors", vectors, x_t.shape)
            out = np.empty_like(standardised)
            # Evaluate the network again for each product: activations of all chunks are gigabytes.
            chunks = zip(
                self._chunks(standardised, level),
                self._chunks(self._deviation * vectors.astype(np.float32), level),
                strict=True,
            )
            for (rows, motions, levels), (_, vector, _) in chunks:
                with torch.enable_grad():
                    clean = self._network(motions.requires_grad_(), levels)
                    (pulled,) = torch.autograd.grad(clean, motions, vector)
                out[rows] = _numbers(pulled, out[rows])
            return (factor * out).astype(vectors.dtype)

        return product

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if observed roots are off the origin but the prior's root is not.

        A prior trained on root-centred tracks has its root at the origin.
        """
        root = self.skeleton.roots[0]
        if (self.standards.deviation[root] > 0).any() or not hasattr(likelihood, "linear"):
            return
        try:
            _, target, precision = likelihood.linear()
        except NotConjugate:
            return
        away = np.linalg.norm(target[:, :, root], axis=-1) * np.sqrt(precision[:, :, root])
        if away.max(initial=0.0) > _ROOT_DEVIATIONS:
            raise ValueError(
                f"likelihood must have the {self.skeleton.joint_names[root]} at the origin, as in "
                f"the prior's training data, got up to {away.max():.0f} standard deviations from "
                "it; use probmotion.data.projections.centre_motion"
            )

    def _check(self, x_t: np.ndarray) -> None:
        check_shape("x_t", x_t, ("B", "V", "L", self.skeleton.n_joints, 2))
        check_finite("x_t", x_t)
        if x_t.shape[2] > self.settings.frames:
            raise ValueError(
                f"x_t must have at most {self.settings.frames} frames, got {x_t.shape[2]}"
            )

    def _spread(self, alpha_bar: float) -> np.ndarray:
        """Return the standard deviations of noisy views (J, 2) at a noise level."""
        alpha_bar = float(alpha_bar)  # NumPy's scalars would not keep single precision
        return np.sqrt(alpha_bar * self._deviation**2 + (1 - alpha_bar))

    def _standardised(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        """Return the network's input, in single precision."""
        shift = math.sqrt(alpha_bar) * self._mean
        return (x_t.astype(np.float32) - shift) / self._spread(alpha_bar)

    def _chunks(
        self, views: np.ndarray, level: float
    ) -> Iterator[tuple[slice, torch.Tensor, torch.Tensor]]:
        """Yield slices of n motions, with all their views (n V, L, 2 J) and noise levels (n V,)."""
        B, V, L = views.shape[:3]
        cpu = self._device == "cpu"
        n = max(1, batch_tokens(self._device, _TOKENS) // (V * (L + 1)))
        if cpu:
            n = 1 if n < 4 else 1 << (n.bit_length() - 1)
        for start in range(0, B, n):
            chunk = views[start : start + n]
            rows = slice(start, start + len(chunk))
            if cpu and len(chunk) < n:
                chunk = np.pad(chunk, [(0, n - len(chunk)), *[(0, 0)] * (chunk.ndim - 1)])
            motions = self._tensor(chunk.reshape(len(chunk) * V, L, -1))
            yield rows, motions, self._tensor(np.full(len(motions), level, np.float32))

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values).to(self._device)


def _numbers(views: torch.Tensor, like: np.ndarray) -> np.ndarray:
    """Return the outputs of the first motions of a chunk, in the shape of ``like``.

    The others are padding.
    """
    return views.cpu().numpy().reshape(-1, *like.shape[1:])[: len(like)]
