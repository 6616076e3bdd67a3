"""`MotionDenoiser`: amortised inference of motion from noisy joints with a Motion-DVAE."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import torch
from probmotion.models.dvae.inference import Bound, Denoiser, DenoisingNetworks, InferenceDraw
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.noisy_windows import NoisyWindows, Stitching, windows_of
from probmotion.models.training.checkpoints import (
    Checkpoint,
    CheckpointError,
    load_checkpoint,
    load_weights,
    save_checkpoint,
    valid_settings,
    weights_digest,
)
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.protocols import Likelihood
from probmotion.seeds import RandomNumbers
from probmotion.validation import check_count

__all__ = ["KIND", "MotionDenoiser", "NoisyMotion"]

KIND = "motion-denoiser"

_ROWS = 64  # Maximum number of windows per batch of draws.
_AVERAGED_DRAWS = 8  # Draws averaged by `NoisyMotion.predict`.
_DRAWS_FOR_MEANS = 64  # Draws per window for the mean of q.


class MotionDenoiser:
    """Inference networks for one Motion-DVAE; ``card`` is the record of their training."""

    def __init__(
        self, networks: DenoisingNetworks, prior: MotionDVAE, card: Mapping[str, Any] | None = None
    ) -> None:
        self.networks = networks.eval().requires_grad_(False)
        self.prior = prior
        self.card = dict(card or {})

    def __repr__(self) -> str:
        """Return a summary for tables and stored draws."""
        numbers = sum(value.numel() for value in self.networks.parameters())
        return f"{type(self).__name__}({self.prior.skeleton.n_joints} joints, {numbers} numbers)"

    @classmethod
    def load(cls, source: str | Path, prior: MotionDVAE) -> MotionDenoiser:
        """Load a trained denoiser of a prior from a file, a run folder or a shipped name.

        Raises ``CheckpointError`` for a damaged file, another kind of network or the denoiser of
        another prior, ``FileNotFoundError`` for a missing file, and ``ValueError`` unless the prior
        is a Motion-DVAE.
        """
        _check_kind(prior)
        checkpoint = load_checkpoint(source, KIND)
        with valid_settings(source, KIND):
            digest = checkpoint.settings["network"]["prior_weights"]
        if digest != (expected := weights_digest(prior.model)):
            raise CheckpointError(
                f"{source} must be a denoiser of prior {expected[:8]}, got one of {digest[:8]}"
            )
        networks = DenoisingNetworks(prior)
        load_weights(networks, checkpoint.tensors, KIND)
        return cls(networks, prior, checkpoint.settings)

    def save(self, path: str | Path, *, half: bool = False) -> None:
        """Save the denoiser as a checkpoint for :meth:`load`, optionally in half precision.

        Raises ``ValueError`` if there is no training record.
        """
        if "network" not in self.card:
            raise ValueError("denoiser must have a training record to be saved, got none")
        save_checkpoint(path, Checkpoint(KIND, self.card, self.networks.state_dict()), half=half)

    def reads(self, likelihood: Likelihood | None) -> bool:
        """Return whether the networks can process the likelihood: noisy 3D joints."""
        return isinstance(likelihood, Joints3D)

    def on(
        self,
        prior: MotionDVAE,
        likelihood: Joints3D,
        *,
        degrees_of_freedom: float | None = None,
        overlap: int = 10,
    ) -> NoisyMotion:
        """Return windowed inference for one recording, with a copy of the networks.

        ``prior`` is this denoiser's prior, of any length and body. ``degrees_of_freedom``
        overrides the likelihood's λ (``inf``: Gaussian noise). ``overlap`` is the number of
        frames shared by successive windows. Raises ``ValueError`` for another prior, a window
        without a visible joint, or an overlap out of range.
        """
        _check_kind(prior)
        same = prior.model is self.prior.model
        if not same and weights_digest(prior.model) != weights_digest(self.prior.model):
            raise ValueError(
                "prior must be the one that the denoiser was trained with, got different weights"
            )
        freedom = degrees_of_freedom
        if freedom is None:
            freedom = likelihood.entries.degrees_of_freedom
        tails = 0.0 if freedom is None or math.isinf(freedom) else 1 / freedom
        window = self.prior.settings.frames
        check_count("overlap", overlap, least=0)
        if overlap >= window:
            raise ValueError(
                f"overlap must be less than the denoiser's window of {window} frames, got {overlap}"
            )
        stitching = Stitching(likelihood.frames, window, overlap)
        windows = windows_of(likelihood, prior.body, prior.skeleton, stitching, tails)
        return NoisyMotion(Denoiser(prior, copy.deepcopy(self.networks)), windows, stitching)


class NoisyMotion:
    """Windowed inference for one recording; its networks can be optimised on the recording."""

    def __init__(self, denoiser: Denoiser, windows: NoisyWindows, stitching: Stitching) -> None:
        self.denoiser = denoiser
        self.windows = windows
        self.stitching = stitching
        self._first, self._shape = denoiser.noise_numbers(stitching.length)
        self._total = self._first + math.prod(self._shape)

    def parameters(self) -> list[torch.nn.Parameter]:
        """Enable gradients and return the trainable parameters."""
        self.denoiser.networks.requires_grad_(True)
        return list(self.denoiser.networks.parameters())

    def bound(self, rng: np.random.Generator, *, initial_entropy: bool = True) -> Bound:
        """Return the terms of the bound at one draw; ``initial_entropy`` adds the KL of q_ω."""
        inferred = self.denoiser.infer(self.windows, *self._numbers(rng, 1))
        return self.denoiser.bound(self.windows, inferred, first=initial_entropy)

    def loss(
        self, rng: np.random.Generator, *, initial_entropy: bool, latent_weight: float
    ) -> torch.Tensor:
        """Return the negative bound, summed over windows, at one draw."""
        return -self.bound(rng, initial_entropy=initial_entropy).total(latent_weight).sum()

    def draw(self, streams: RandomNumbers, n: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return draws (n, L, J, 3), metres, and their θ if there is a single window."""
        count = len(self.windows)
        drawn = streams.standard_normal((n, count, self._total))
        positions, thetas = [], []
        # Fixed batch shapes make the rounding, and so the draws, independent of n.
        batch = max(1, _ROWS // count)
        for at in range(0, n, batch):
            part = drawn[at : at + batch]
            rows = np.zeros((batch, count, self._total), dtype=np.float32)
            rows[: len(part)] = part
            inferred = self._inferred_from(rows)
            positions.append(self._by_window(inferred.positions)[: len(part)])
            if count == 1:
                thetas.append(self._theta(inferred)[: len(part)])
        windows = np.concatenate(positions)
        if count == 1:
            theta = np.concatenate(thetas)
            # The likelihood does not depend on the length of the two heading coordinates.
            length = np.linalg.norm(streams.standard_normal((n, 2)), axis=-1, keepdims=True)
            theta[:, 2:4] *= length
            return windows[:, 0], theta
        return self.stitching.draws(windows, self._mean_of_windows()), None

    @torch.no_grad()
    def predict(self, rng: np.random.Generator, *, average: bool = True) -> np.ndarray:
        """Return the predicted motion, (L, J, 3), metres (D, equation 11).

        The prediction is the average over draws of the precision-weighted mean of observed and
        decoded joints, or of decoded joints where occluded. The first frame of a window, and all
        frames with ``average=False``, are decoded from the means of q instead.
        """
        zeros = np.zeros((1, len(self.windows), self._total), dtype=np.float32)
        decoded = self._by_window(self._inferred_from(zeros).positions)[0]
        if not average:
            return self.stitching.mean(decoded)
        windows = self.windows.repeated(_AVERAGED_DRAWS)
        inferred = self.denoiser.infer(windows, *self._numbers(rng, _AVERAGED_DRAWS))
        square = self.denoiser.prior.joint_scale**2
        v = self.denoiser.drawn_variance(windows, inferred, rng)
        combined = (v * inferred.positions + square * windows.joints) / (v + square)
        seen = windows.seen[..., None]
        mean = self._by_window(torch.where(seen, combined, inferred.positions)).mean(axis=0)
        mean[:, 0] = decoded[:, 0]
        return self.stitching.mean(mean)

    def _numbers(self, rng: np.random.Generator, n: int) -> tuple[torch.Tensor, torch.Tensor]:
        rows = n * len(self.windows)
        return (
            torch.as_tensor(rng.standard_normal((rows, self._first), dtype=np.float32)),
            torch.as_tensor(rng.standard_normal((rows, *self._shape), dtype=np.float32)),
        )

    @torch.no_grad()
    def _inferred_from(self, numbers: np.ndarray) -> InferenceDraw:
        """Return draws of q for standard normal ``numbers`` (n, B, …), without gradients."""
        first, noise = torch.as_tensor(numbers).flatten(0, 1).tensor_split([self._first], dim=1)
        windows = self.windows.repeated(len(numbers))
        return self.denoiser.infer(windows, first, noise.unflatten(1, self._shape))

    def _by_window(self, positions: torch.Tensor) -> np.ndarray:
        """Reshape (n B, …) to (n, B, …) in double precision."""
        result = positions.detach().double().numpy()
        return result.reshape(-1, len(self.windows), *result.shape[1:])

    @torch.no_grad()
    def _mean_of_windows(self) -> np.ndarray:
        numbers = self._numbers(seeds.generator(0, "means of windows"), _DRAWS_FOR_MEANS)
        inferred = self.denoiser.infer(self.windows.repeated(_DRAWS_FOR_MEANS), *numbers)
        return self._by_window(inferred.positions).mean(axis=0)

    def _theta(self, inferred: InferenceDraw) -> np.ndarray:
        parts = (inferred.ground, inferred.heading, inferred.first, inferred.rolled.innovations)
        return self.denoiser.prior.coordinates(*(part.double().numpy() for part in parts))


def _check_kind(prior: Any) -> None:
    if not isinstance(prior, MotionDVAE):
        raise ValueError(f"prior must be the denoiser's Motion-DVAE, got {type(prior).__name__}")
