"""`JointCorrector`: correction of spectral posteriors of joints by a network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from probmotion.extras import nn, torch
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.mixture.spectrum import bands
from probmotion.models.training.checkpoints import (
    Checkpoint,
    load_checkpoint,
    load_weights,
    save_checkpoint,
    valid_settings,
)
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count

__all__ = ["KIND", "Correction", "CorrectorNetwork", "CorrectorSettings", "JointCorrector"]

KIND = "joint-corrector"

_LARGEST = 3.0  # bound of a correction, standard deviations
_INPUT_BOUND = 6.0  # of standardised inputs
_FIRST_BAND = 4  # of the bands whose energies are predicted, from frequency 5 on (1.25 Hz)


@dataclass(frozen=True)
class CorrectorSettings:
    """Size of a corrector.

    Parameters
    ----------
    frames : int
        Number of frames per window.
    width, layers, heads : int
        Width, number of layers and attention heads of the transformer; ``heads`` divides ``width``.
    dropout : float
        Dropout in training.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    frames: int = 60
    width: int = 128
    layers: int = 4
    heads: int = 4
    dropout: float = 0.1

    def __post_init__(self) -> None:
        for name in ("frames", "width", "layers", "heads"):
            check_count(name, getattr(self, name))
        if self.width % self.heads:
            raise ValueError(f"width must be a multiple of heads={self.heads}, got {self.width}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be at least 0 and below 1, got {self.dropout}")


class Correction(NamedTuple):
    """Correction of B windows.

    ``features`` (B, L, width) are those of each frame. ``mean`` (B, L, J, 3), metres, is to be
    added. ``log_energy`` (B, bands, J) is the logarithm of the variance of a DCT coefficient of the
    remaining error, square metres, in bands of high frequencies.
    """

    features: torch.Tensor
    mean: torch.Tensor
    log_energy: torch.Tensor


class _Block(nn.Module):
    def __init__(self, size: CorrectorSettings) -> None:
        super().__init__()
        width = size.width
        self.heads = size.heads
        self.n1, self.n2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.drop = nn.Dropout(size.dropout)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the features of frames after attention and perceptron, (B, L, width)."""
        parts = self.qkv(self.n1(x)).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        attended = nn.functional.scaled_dot_product_attention(*parts)
        x = x + self.drop(self.out(attended.transpose(1, 2).flatten(2)))
        out: torch.Tensor = x + self.drop(self.down(nn.functional.gelu(self.up(self.n2(x)))))
        return out


class CorrectorNetwork(nn.Module):
    """Transformer over the frames of a window of posterior means and standard deviations.

    Corrections are initially 0.
    """

    def __init__(self, size: CorrectorSettings, skeleton: Skeleton) -> None:
        super().__init__()
        J, width = skeleton.n_joints, size.width
        self.child = [j for j, parent in enumerate(skeleton.parents) if parent >= 0]
        self.parent = [skeleton.parents[j] for j in self.child]
        self.left, self.right = (list(side) for side in zip(*skeleton.mirrored_pairs, strict=True))
        self.root = skeleton.roots[0]
        self.middle = slice(size.frames // 2 - 5, size.frames // 2 + 5)
        n = 7 * J + 3 + len(self.child)
        n_bands = int(bands(size.frames)[-1]) + 1 - _FIRST_BAND
        for name, value in (
            ("centre", torch.zeros(n)),
            ("spread", torch.ones(n)),
            ("log_energy", torch.zeros(n_bands, J)),
        ):
            self.register_buffer(name, value)
        self.inp = nn.Linear(n, width)
        self.place = nn.Parameter(0.02 * torch.randn(size.frames, width))
        self.blocks = nn.ModuleList(_Block(size) for _ in range(size.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, 3 * J)
        self.energy = nn.Linear(width, n_bands)
        for last in (self.head, self.energy):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def heading(self, mean: torch.Tensor) -> torch.Tensor:
        """Return the angle that turns windows (B, L, J, 3) to face +Z in their middle, (B,)."""
        middle = mean[:, self.middle]
        side = (middle[:, :, self.right] - middle[:, :, self.left]).mean(dim=(1, 2))
        return torch.atan2(-side[:, 2], -side[:, 0])

    def features(self, mean: torch.Tensor, sd: torch.Tensor) -> torch.Tensor:
        """Return the inputs of each frame, (B, L, n)."""
        root = mean[:, :, self.root]
        start = root.mean(dim=1, keepdim=True) * root.new_tensor([1.0, 0.0, 1.0])
        velocity = torch.cat([mean[:, 1:2] - mean[:, :1], mean[:, 1:] - mean[:, :-1]], dim=1)
        bones = (mean[:, :, self.child] - mean[:, :, self.parent]).norm(dim=-1)
        local = (mean - root[:, :, None]).flatten(2)
        parts = [local, root - start, 30 * velocity.flatten(2), sd.log(), bones]
        return torch.cat(parts, dim=-1)

    def read(self, mean: torch.Tensor, sd: torch.Tensor) -> torch.Tensor:
        """Return the features of each frame, (B, L, width)."""
        x = (self.features(mean, sd) - self.centre) / self.spread
        x = self.inp(x.clamp(-_INPUT_BOUND, _INPUT_BOUND)) + self.place
        for block in self.blocks:
            x = block(x)
        read: torch.Tensor = self.norm(x)
        return read

    def forward(self, mean: torch.Tensor, sd: torch.Tensor) -> Correction:
        """Return the correction of windows that face +Z: mean (B, L, J, 3), sd (B, L, J)."""
        x = self.read(mean, sd)
        shift = _LARGEST * torch.tanh(self.head(x).unflatten(2, (-1, 3)) / _LARGEST)
        energy = self.energy(x.mean(dim=1))[:, :, None]
        return Correction(x, sd[..., None] * shift, self.log_energy + energy)


class JointCorrector:
    """Trained corrector of posteriors under a spectral prior; ``card`` is its training record."""

    def __init__(
        self,
        network: CorrectorNetwork,
        settings: CorrectorSettings,
        skeleton: Skeleton,
        fps: float,
        card: Mapping[str, Any] | None = None,
    ) -> None:
        self.network = network.eval().requires_grad_(False)
        self.settings, self.skeleton, self.fps = settings, skeleton, fps
        self.card = dict(card or {})

    @classmethod
    def load(cls, source: str | Path) -> JointCorrector:
        """Load a corrector from a file or a shipped name.

        Raises ``CheckpointError`` for a damaged file or another kind of network, and
        ``FileNotFoundError`` for a missing file.
        """
        checkpoint = load_checkpoint(source, KIND)
        with valid_settings(source, KIND):
            record = checkpoint.settings["network"]
            size = CorrectorSettings(**record["size"])
            skeleton = Skeleton(tuple(record["joint_names"]), tuple(record["parents"]))
            fps = float(record["fps"])
        network = CorrectorNetwork(size, skeleton)
        load_weights(network, checkpoint.tensors, KIND)
        return cls(network, size, skeleton, fps, checkpoint.settings)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Save the corrector as a checkpoint for :meth:`load`, optionally in half precision."""
        network = {
            "size": asdict(self.settings),
            "joint_names": list(self.skeleton.joint_names),
            "parents": list(self.skeleton.parents),
            "fps": self.fps,
        }
        settings = self.card | {"network": self.card.get("network", {}) | network}
        save_checkpoint(path, Checkpoint(KIND, settings, self.network.state_dict()), half=half)

    @property
    def band_edges(self) -> np.ndarray:
        """Lowest frequency of each band of high frequencies, half cycles per window."""
        band = bands(self.settings.frames)
        return np.array([(band < b).sum() for b in range(_FIRST_BAND, band[-1] + 1)])

    def correct(self, mean: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the correction of windows.

        Parameters
        ----------
        mean : ndarray, (B, L, J, 3)
            Posterior means, metres, +Y up.
        sd : ndarray, (B, L, J)
            Posterior standard deviations, root mean square over axes, metres.

        Returns
        -------
        correction : ndarray, (B, L, J, 3)
            To be added to the means, metres.
        energy : ndarray, (B, bands, J)
            Variance of a DCT coefficient of the remaining error of a coordinate in the bands of
            frequencies that start at ``band_edges``, square metres.
        """
        ground = mean.mean(axis=(1, 2), keepdims=True) * [1.0, 0.0, 1.0]
        centred = torch.as_tensor(mean - ground, dtype=torch.float32)
        with torch.inference_mode():
            angle = self.network.heading(centred)
            found = self.network(
                turned_about_vertical(centred, angle), torch.as_tensor(sd, dtype=torch.float32)
            )
            correction = turned_about_vertical(found.mean, -angle).numpy().astype(float)
        return correction, np.exp(found.log_energy.numpy().astype(float))
