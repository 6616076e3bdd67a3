"""`MotionDiffusion`: a prior over 3D motion learnt from 2D tracks alone (MAS, sections 4.1, 6.2).

It knows what one view of a motion looks like, whoever filmed it: a 2D denoiser, which samplers
such as `mas` turn into 3D motion. Diffusion runs in metres over one ``scale``, as for the exact
prior; data are standardised, joint by joint, only at the network's door.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from probmotion.arrays import Array
from probmotion.geometry.cameras import Cameras
from probmotion.models.diffusion.motion_transformer import MotionTransformer
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.training.checkpoints import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from probmotion.models.training.standardisation import Standards
from probmotion.models.training.trainer import check_device
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import NotConjugate
from probmotion.validation import check_count, check_finite, check_positive, check_shape

if TYPE_CHECKING:
    from probmotion.posteriors.protocols import Likelihood

__all__ = ["KIND", "MotionDiffusion"]

KIND = "motion-diffusion"
# On the CPU a chunk has at most this many tokens or one motion, and always the same shape: the bits
# of a row depend on the shape of what it is computed with, so draws must not choose it. They also
# depend on whether the row is among those left over by blocks of four, so a chunk of several
# motions has 4, 8, 16, …
_TOKENS = 512
# Evidence that is centred on a root that was detected errs by its noise, and seldom by more.
_ROOT_DEVIATIONS = 6.0
# On a GPU a chunk has as many tokens as fit a card of 8 GiB at the paper's size.
_GPU_TOKENS = 200_000


class MotionDiffusion:
    """A 2D motion diffusion model as a prior: what it can do is denoise views.

    Parameters
    ----------
    network : MotionTransformer
        Predicts clean motions in standardised units.
    settings : DiffusionSettings
        Its size and noise levels.
    standards : Standards
        Of the data that it learnt.
    skeleton : Skeleton
        The J joints.
    fps : float
        Frames per second.
    frames : int, optional
        Frames L of the prior's motions, up to what the network was trained on, which is the
        default; see :meth:`of_length`.
    device : str
        ``cpu`` or ``cuda``.
    card : mapping, optional
        What is known of its training.

    Raises
    ------
    ValueError
        If shapes disagree, a number is out of range or the device is not there.
    """

    def __init__(
        self,
        network: MotionTransformer,
        settings: DiffusionSettings,
        standards: Standards,
        skeleton: Skeleton,
        fps: float,
        *,
        frames: int | None = None,
        device: str = "cpu",
        card: Mapping[str, Any] | None = None,
    ) -> None:
        check_shape("standards", standards.mean, (skeleton.n_joints, 2))
        check_positive("fps", fps)
        self.settings = settings
        self.standards = standards
        self.card = dict(card or {})
        self._skeleton = skeleton
        self._fps = float(fps)
        self._frames = settings.frames if frames is None else frames
        check_count("frames", self._frames, least=2)
        if self._frames > settings.frames:
            raise ValueError(
                f"frames is {self._frames}, expected at most {settings.frames}, the longest motion "
                "that the network was trained on"
            )
        self._device = check_device(device).type
        self._network = network.to(self._device).eval().requires_grad_(False)

    @classmethod
    def load(
        cls, source: str | Path = "walk2d", *, frames: int | None = None, device: str = "cpu"
    ) -> MotionDiffusion:
        """Return a trained prior.

        Parameters
        ----------
        source : str or Path
            A checkpoint's file, the folder of a training run, or the name of a prior that comes
            with the package.
        frames, device
            As above.

        Raises
        ------
        CheckpointError
            If the file is damaged, of another version or no motion diffusion model.
        FileNotFoundError
            If there is no such file and no such name.
        """
        checkpoint = load_checkpoint(source, KIND)
        try:
            kept = checkpoint.settings["network"]
            settings = DiffusionSettings(**kept["size"])
            skeleton = Skeleton(kept["joint_names"], kept["parents"])
            standards = Standards(np.array(kept["mean"]), np.array(kept["deviation"]))
            fps = kept["fps"]
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(
                f"{source} has settings that are no motion diffusion model's: {error}"
            ) from error
        network = settings.network(skeleton.n_joints)
        load_weights(network, checkpoint.tensors)
        return cls(
            network,
            settings,
            standards,
            skeleton,
            fps,
            frames=frames,
            device=device,
            card=checkpoint.settings,
        )

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Write the prior as a checkpoint, which :meth:`load` reads.

        Parameters
        ----------
        path : str or Path
            The file, ``.safetensors``.
        half : bool
            Store half-precision weights: half the size.

        Raises
        ------
        ValueError
            If the prior has no card to rebuild it by: only trained ones have.
        OSError
            If the file cannot be written.
        """
        if "network" not in self.card:
            raise ValueError("the prior has no card, expected one that was trained or loaded")
        save_checkpoint(path, Checkpoint(KIND, self.card, self._network.state_dict()), half=half)

    def of_length(self, frames: int) -> MotionDiffusion:
        """Return the same prior over motions of another length, 2 to ``settings.frames``."""
        other = copy.copy(self)
        MotionDiffusion.__init__(
            other,
            self._network,
            self.settings,
            self.standards,
            self._skeleton,
            self._fps,
            frames=frames,
            device=self._device,
            card=self.card,
        )
        return other

    @property
    def skeleton(self) -> Skeleton:
        """The J joints."""
        return self._skeleton

    @property
    def frames(self) -> int:
        """Number of frames L."""
        return self._frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self._fps

    @property
    def dim(self) -> int:
        """Length of θ: the coordinates of all joints in all frames."""
        return self._frames * self._skeleton.n_joints * 3

    @property
    def scale(self) -> float:
        """Metres per normalised unit."""
        return self.standards.scale

    def motion(self, theta: Array) -> Array:
        """Return θ as positions: ``(…, dim) → (…, L, J, 3)``, metres."""
        check_shape("theta", theta, ("…", self.dim))
        return theta.reshape(*theta.shape[:-1], self._frames, self._skeleton.n_joints, 3)

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """Return the network's estimate of E[x₀ | x_t], view by view.

        Parameters
        ----------
        x_t : ndarray, (B, V, L, J, 2)
            Normalised units; L may be any up to ``settings.frames``.
        alpha_bar : float
            ᾱ, one that the network has learnt.
        cameras : Cameras
            Ignored: the network learnt views of unknown cameras.

        Raises
        ------
        ValueError
            If the shape is another, a number is not finite or ᾱ is not above 0 and at most 1.
        """
        self._check(x_t)
        if alpha_bar == 1:
            return x_t.copy()  # without noise there is nothing to estimate
        network, enter, leave = self._door(alpha_bar)
        clean = np.empty_like(x_t)
        for rows, chunk in self._chunks(x_t):
            with torch.inference_mode():
                found = leave(network(enter(chunk)))
            clean[rows] = _numbers(found, x_t)[: len(clean[rows])]
        return clean

    def view_covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras, vectors: np.ndarray
    ) -> np.ndarray:
        """Return (1−ᾱ)/√ᾱ Jᵀ v, J the Jacobian of :meth:`denoise`; all arrays (B, V, L, J, 2).

        For the exact denoiser that is Cov[x₀ | x_t] v (Tweedie); a network's J is symmetric only
        as far as it has learnt.
        """
        self._check(x_t)
        check_shape("vectors", vectors, x_t.shape)
        network, enter, leave = self._door(alpha_bar)
        factor = (1 - alpha_bar) / math.sqrt(alpha_bar)
        product = np.empty_like(vectors)
        along = self._chunks(vectors)
        for (rows, chunk), (_, given) in zip(self._chunks(x_t), along, strict=True):
            with torch.enable_grad():
                point = chunk.requires_grad_()
                clean = leave(network(enter(point)))
                (pulled,) = torch.autograd.grad(clean, point, given)
            product[rows] = factor * _numbers(pulled, vectors)[: len(product[rows])]
        return product

    def check_observations(self, likelihood: Likelihood) -> None:
        """Raise ``ValueError`` if evidence is of a motion that the prior cannot have.

        A prior of pictures that were centred on the root in every frame has its root at the origin.
        """
        root = self._skeleton.roots[0]
        if (self.standards.deviation[root] > 0).any() or not hasattr(likelihood, "linear"):
            return
        try:
            _, target, precision = likelihood.linear()
        except NotConjugate:
            return
        away = np.linalg.norm(target[:, :, root], axis=-1) * np.sqrt(precision[:, :, root])
        if away.max(initial=0.0) > _ROOT_DEVIATIONS:
            raise ValueError(
                f"likelihood has the {self._skeleton.joint_names[root]} up to {away.max():.0f} "
                "standard deviations off the origin, expected it there in every frame, as in the "
                "pictures that the prior has learnt; see probmotion.data.projections.centre_motion"
            )

    def _check(self, x_t: np.ndarray) -> None:
        check_shape("x_t", x_t, ("B", "V", "L", self._skeleton.n_joints, 2))
        check_finite("x_t", x_t)
        if x_t.shape[2] > self.settings.frames:
            raise ValueError(
                f"x_t has {x_t.shape[2]} frames, expected at most {self.settings.frames}"
            )

    def _door(self, alpha_bar: float) -> tuple[Any, Any, Any]:
        """What the network does at a level, how noisy motions enter and clean ones leave it."""
        level = self.settings.level(alpha_bar)
        scale = self.scale
        mean = self._tensor(self.standards.mean / scale)
        deviation = self._tensor(self.standards.deviation / scale)
        signal = math.sqrt(alpha_bar)
        spread = torch.sqrt(alpha_bar * deviation**2 + (1 - alpha_bar))

        def network(motions: torch.Tensor) -> torch.Tensor:
            levels = torch.full((len(motions),), level, device=self._device)
            return self._network(motions.flatten(2), levels).unflatten(2, (-1, 2))

        def enter(noisy: torch.Tensor) -> torch.Tensor:
            return (noisy - signal * mean) / spread

        def leave(standardised: torch.Tensor) -> torch.Tensor:
            return mean + deviation * standardised

        return network, enter, leave

    def _chunks(self, views: np.ndarray) -> Iterator[tuple[slice, torch.Tensor]]:
        """Yield rows of motions and their views as one batch, (n V, L, J, 2)."""
        B, V, L = views.shape[:3]
        cpu = self._device == "cpu"
        n = max(1, (_TOKENS if cpu else _GPU_TOKENS) // (V * (L + 1)))
        if cpu:
            n = 1 if n < 4 else 1 << (n.bit_length() - 1)
        for start in range(0, B, n):
            some = views[start : start + n]
            if cpu and len(some) < n:
                filler = np.zeros((n - len(some), *some.shape[1:]))
                padded = np.concatenate([some, filler])
            else:
                padded = some
            yield slice(start, start + len(some)), self._tensor(padded).flatten(0, 1)

    def _tensor(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self._device)


def _numbers(found: torch.Tensor, like: np.ndarray) -> np.ndarray:
    """Return a chunk's views as an array (n, V, L, J, 2) of the caller's precision."""
    return found.unflatten(0, (-1, like.shape[1])).cpu().numpy().astype(like.dtype)
