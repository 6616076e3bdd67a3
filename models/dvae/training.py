"""Learning a Motion-DVAE from clean motion (A.3, A.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from probmotion import seeds
from probmotion.models.bodies.body_states import BodyStates
from probmotion.models.dvae.latent_rollouts import Rollout, rollout
from probmotion.models.dvae.motion_dvae import KIND, MotionDVAE, description_of
from probmotion.models.dvae.motion_windows import MotionWindows, Windows
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.variational_terms import log_normal
from probmotion.models.training.settings import TrainingSettings
from probmotion.motion.motion import Motion

__all__ = ["DVAETrainee", "refit_joint_scale", "usual_dvae_training"]

_VALIDATION_BATCH = 256
_LOOKED_AT = 4000
_VARIANCE_KEPT = 0.999


class DVAETrainee:
    """What :func:`~probmotion.models.training.trainer.train` needs to learn a Motion-DVAE.

    The loss is −log p(x | z, x₀) + KL(q ‖ p) + the error of joints' positions, per frame. With
    decoder scales that are learnt, the three errors are Gaussian and each has its own; with unit
    scales they are squared errors, as published.

    Parameters
    ----------
    clips : sequence of Motion
        Clean motion of one skeleton and frame rate, metres.
    validation : sequence of Motion
        Clips that are not among them.
    size : DVAESettings
        The networks'.
    states : BodyStates
        How a pose becomes numbers.
    annealing : int
        Steps over which the weight of KL rises from 0 to 1.
    seed : int
        Of the first weights and the validation's noise.

    Raises
    ------
    ValueError
        If no clip is as long as a window, or they differ in skeleton or frame rate.
    """

    kind = KIND

    def __init__(
        self,
        clips: Sequence[Motion],
        validation: Sequence[Motion],
        size: DVAESettings,
        states: BodyStates,
        *,
        annealing: int = 0,
        seed: int = 0,
    ) -> None:
        self.size = size
        self.states = states
        self.annealing = annealing
        self.windows = MotionWindows(clips, states, size.frames)
        self.held_out = MotionWindows(validation, states, size.frames)
        if self.held_out.fps != self.windows.fps:
            raise ValueError(
                f"validation is at {self.held_out.fps:g} frames per second, expected "
                f"{self.windows.fps:g}"
            )
        looked_at = self.windows.spread(_LOOKED_AT)
        factor = _first_poses(looked_at.states[:, 0])
        self.network = DVAEModel(size, states.dim, states.skeleton.n_joints, factor.shape[1], seed)
        self._learn_standards(looked_at, factor)
        self._seed = seed
        self._weight = 1.0
        self.settings: Mapping[str, Any] = {
            **description_of(size, states, self.windows.fps, factor.shape[1]),
            "annealing": annealing,
            "data": _description(clips, len(self.windows)),
            "validation_data": _description(validation, len(self.held_out)),
        }

    def anneal(self, step: int) -> None:
        """Set the weight of KL at a step."""
        self._weight = min(1.0, step / self.annealing) if self.annealing else 1.0

    def training_loss(
        self, network: nn.Module, rng: np.random.Generator, batch: int, device: torch.device
    ) -> torch.Tensor:
        """Return the loss of fresh windows."""
        return self._loss(network, self.windows.draw(rng, batch), rng, self._weight, device)

    def validation_loss(self, network: nn.Module, device: torch.device) -> float:
        """Return the loss on held-out windows, KL in full, with noise that never changes."""
        rng = seeds.generator(self._seed, "validation")
        windows = self.held_out.spread(_VALIDATION_BATCH)
        return float(self._loss(network, windows, rng, 1.0, device))

    def _learn_standards(self, looked_at: Windows, factor: np.ndarray) -> None:
        states = looked_at.states
        joints = self.states.positions(states, looked_at.bodies)
        found = {
            "state_mean": states.mean(axis=(0, 1)),
            "state_deviation": np.maximum(states.std(axis=(0, 1)), _least(states)),
            "joint_mean": joints.mean(axis=(0, 1)),
            "joint_deviation": np.maximum(joints.std(axis=(0, 1)), 0.05),
            "initial_mean": states[:, 0].mean(axis=0),
            "initial_factor": factor,
        }
        for name, value in found.items():
            getattr(self.network, name).copy_(torch.as_tensor(value))

    def _loss(
        self,
        network: nn.Module,
        windows: Windows,
        rng: np.random.Generator,
        weight: float,
        device: torch.device,
    ) -> torch.Tensor:
        assert isinstance(network, DVAEModel)
        states, joints, found = _reconstruct(network, self.states, windows, rng, device)
        decoded, bodies, rolled = found
        errors = [(decoded - states[:, 1:])[..., first:end] for _, first, end in self.states.groups]
        errors.append(self.states.positions(decoded, bodies) - joints[:, 1:])
        fitted = self._misfit(network, errors)
        return (fitted + weight * rolled.kl.mean()) / (self.size.frames - 1)

    def _misfit(self, network: DVAEModel, errors: list[torch.Tensor]) -> torch.Tensor:
        """Return how far windows are from what is decoded, mean over windows."""
        n = len(errors[0])
        scales = network.generative.log_scales
        if self.size.decoder_scale == "unit":
            squares = sum((error**2).sum() for error in errors) / n
            # Only so that eq. 11 knows how far joints are off: nothing else learns from it.
            own = -log_normal(errors[-1].detach(), torch.exp(scales[-1])).mean()
            return torch.as_tensor(squares + own)
        return -torch.stack(
            [
                log_normal(error, torch.exp(scale)).sum() / n
                for error, scale in zip(errors, scales, strict=True)
            ]
        ).sum()


class _Found(NamedTuple):
    """Decoded states (B, T, D), the bodies (B, J, 3) and what happened on the way."""

    decoded: torch.Tensor
    bodies: torch.Tensor
    rolled: Rollout


def _reconstruct(
    network: DVAEModel,
    body_states: BodyStates,
    windows: Windows,
    rng: np.random.Generator,
    device: torch.device,
) -> tuple[torch.Tensor, torch.Tensor, _Found]:
    """Return states (B, L, D) and joints (B, L, J, 3) of windows, and their reconstruction."""
    states = torch.as_tensor(windows.states, dtype=torch.float32, device=device)
    bodies = torch.as_tensor(windows.bodies, dtype=torch.float32, device=device)
    latent = network.generative.recurrent.input_size
    shape = (len(states), states.shape[1] - 1, latent)
    noise = torch.as_tensor(rng.standard_normal(shape, dtype=np.float32), device=device)
    joints = body_states.positions(states, bodies)
    trusted = torch.ones_like(joints[..., 0])
    tails = torch.zeros_like(trusted[:, 0, 0])
    reading = network.encoder.reading(network.evidence(joints, trusted, tails, body_states, bodies))
    rolled = rollout(network.generative, network.standardised(states[:, 0]), noise, reading)
    return states, joints, _Found(network.decoded(rolled), bodies, rolled)


def refit_joint_scale(prior: MotionDVAE, clips: Sequence[Motion], seed: int = 0) -> float:
    """Set how far joints are from what is decoded to what it is on other clips; return it, metres.

    What was learnt from is decoded better than what is new, and eq. 11 asks how far to believe the
    decoder of something new.

    Parameters
    ----------
    prior : MotionDVAE
        A trained prior, which is changed.
    clips : sequence of Motion
        Clips that were not learnt from.
    seed : int
        Of the draws from the encoder.
    """
    windows = MotionWindows(clips, prior.states, prior.settings.frames).spread(_VALIDATION_BATCH)
    with torch.no_grad():
        _, joints, found = _reconstruct(
            prior.model, prior.states, windows, seeds.generator(seed, "scale"), torch.device("cpu")
        )
        error = prior.states.positions(found.decoded, found.bodies) - joints[:, 1:]
        scale = float((error**2).mean().sqrt())
        prior.model.generative.log_scales[-1] = math.log(scale)
    return scale


def usual_dvae_training(size: str) -> tuple[TrainingSettings, int]:
    """Return how a size is trained, and over how many steps KL is annealed.

    ``paper``: Adamax, batches of 64, 200 epochs, KL annealed over 50 (A.4). An epoch there is of
    AMASS; here it is 1000 steps.

    Raises
    ------
    ValueError
        If the size is unknown.
    """
    known = {
        "tiny": (TrainingSettings(steps=600, batch=32, learning_rate=3e-3, ema=0.98), 200),
        "small": (
            TrainingSettings(
                steps=4500,
                batch=32,
                learning_rate=1e-3,
                ema=0.998,
                weight_decay=0.05,
                halve_at=(2000, 3000, 3800),
                checkpoint_every=250,
                patience=6,
            ),
            1000,
        ),
        "paper": (
            TrainingSettings(
                steps=200_000,
                learning_rate=1e-4,
                optimiser="adamax",
                ema=0.0,
                halve_at=(50_000, 80_000, 140_000),
            ),
            50_000,
        ),
    }
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]


def _first_poses(states: np.ndarray) -> np.ndarray:
    """Return the directions in which first states vary, (D, r), times their deviations."""
    centred = states - states.mean(axis=0)
    _, size, directions = np.linalg.svd(centred, full_matrices=False)
    share = np.cumsum(size**2) / (size**2).sum()
    rank = int(np.searchsorted(share, _VARIANCE_KEPT)) + 1
    return (directions[:rank] * (size[:rank, None] / math.sqrt(len(states)))).T


def _least(states: np.ndarray) -> float:
    # What hardly varies would be blown up into noise: a twentieth of what usually does.
    return 0.05 * float(np.median(states.std(axis=(0, 1)))) or 1.0


def _description(clips: Sequence[Motion], windows: int) -> dict[str, Any]:
    names = sorted(clip.name for clip in clips)
    return {"clips": names, "frames": sum(clip.frames for clip in clips), "windows": windows}
