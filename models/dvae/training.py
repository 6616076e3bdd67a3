"""Training of the Motion-DVAE on clean motion (A.3, A.4)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.models.bodies.body_states import BodyStates
from probmotion.models.dvae.latent_rollouts import rollout
from probmotion.models.dvae.motion_dvae import KIND, MotionDVAE, description_of
from probmotion.models.dvae.motion_windows import (
    VALIDATION_BATCH,
    MotionWindows,
    Windows,
    WindowTrainee,
)
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.variational_terms import log_normal
from probmotion.models.training.settings import TrainingSettings
from probmotion.motion.motion import Motion

__all__ = ["DVAETrainee", "refit_joint_scale", "usual_dvae_training"]

_STATISTICS_WINDOWS = 4000  # Maximum number of windows for the standardisation.
_EXPLAINED_VARIANCE = 0.999  # Minimum fraction explained by the first-pose directions.


class DVAETrainee(WindowTrainee):
    """Trainee of a Motion-DVAE for :func:`~probmotion.models.training.trainer.train`.

    The loss is −log p(x | z, x₀) + KL(q ‖ p) + the joint position error, per frame. With learned
    decoder scales, errors have Gaussian densities; with unit scales, they are squared (published).

    Parameters
    ----------
    clips : sequence of Motion
        Clean motion of one skeleton and frame rate, metres.
    validation : sequence of Motion
        Held-out clips.
    size : DVAESettings
        Network size.
    states : BodyStates
        Conversion between poses and state vectors.
    annealing : int
        Number of steps over which the KL weight rises from 0 to 1.
    seed : int
        Seed of the initial weights and the validation noise.

    Raises
    ------
    ValueError
        If no clip is as long as a window, or clips differ in skeleton or frame rate.
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
        super().__init__(clips, validation, states, size.frames, 1.0, annealing, seed)
        self.size, self.states = size, states
        windows = self.windows.spread(_STATISTICS_WINDOWS)
        factor = _first_poses(windows.states[:, 0])
        self.network = DVAEModel(size, states.dim, states.skeleton.n_joints, factor.shape[1], seed)
        self._learn_standards(windows, factor)
        self.settings: Mapping[str, Any] = {
            **description_of(size, states, self.windows.fps, factor.shape[1]),
            "annealing": annealing,
            "data": _description(clips, len(self.windows)),
            "validation_data": _description(validation, len(self.held_out)),
        }

    def _learn_standards(self, windows: Windows, factor: np.ndarray) -> None:
        states = windows.states
        joints = self.states.positions(states, windows.bodies)
        deviation = states.std(axis=(0, 1))
        # Bound deviations below, or standardisation would amplify nearly constant dimensions.
        minimum = 0.05 * float(np.median(deviation)) or 1.0
        statistics = {
            "state_mean": states.mean(axis=(0, 1)),
            "state_deviation": np.maximum(deviation, minimum),
            "joint_mean": joints.mean(axis=(0, 1)),
            "joint_deviation": np.maximum(joints.std(axis=(0, 1)), 0.05),
            "initial_mean": states[:, 0].mean(axis=0),
            "initial_factor": factor,
        }
        for name, value in statistics.items():
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
        state_error, joint_error, kl = _reconstruct(network, self.states, windows, rng, device)
        errors = [state_error[..., first:end] for _, first, end in self.states.groups]
        misfit = self._misfit(network, [*errors, joint_error])
        return (misfit + weight * kl.mean()) / (self.size.frames - 1)

    def _misfit(self, network: DVAEModel, errors: list[torch.Tensor]) -> torch.Tensor:
        """Return the reconstruction error, mean over windows."""
        n, scales = len(errors[0]), torch.exp(network.generative.log_scales)
        if self.size.decoder_scale == "unit":
            squares = sum((error**2).sum() for error in errors) / n
            # Detach the error to train only the joint scale, which eq. 11 requires.
            return squares - log_normal(errors[-1].detach(), scales[-1]).mean()
        densities = [log_normal(*pair).sum() / n for pair in zip(errors, scales, strict=True)]
        return -torch.stack(densities).sum()


def _reconstruct(
    network: DVAEModel,
    body_states: BodyStates,
    windows: Windows,
    rng: np.random.Generator,
    device: torch.device,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return errors of states (B, T, D) and joints (B, T, J, 3), and the KL (B,)."""
    states = torch.as_tensor(windows.states, dtype=torch.float32, device=device)
    bodies = torch.as_tensor(windows.bodies, dtype=torch.float32, device=device)
    shape = (len(states), states.shape[1] - 1, network.generative.recurrent.input_size)
    noise = torch.as_tensor(rng.standard_normal(shape, dtype=np.float32), device=device)
    joints = body_states.positions(states, bodies)
    trusted = torch.ones_like(joints[..., 0])
    tails = torch.zeros_like(trusted[:, 0, 0])
    inputs = network.encoder_inputs(joints, trusted, tails, body_states, bodies)
    encoder = network.encoder.conditioned(inputs)
    rolled = rollout(network.generative, network.standardised(states[:, 0]), noise, encoder)
    decoded = network.decoded(rolled)
    joint_error = body_states.positions(decoded, bodies) - joints[:, 1:]
    return decoded - states[:, 1:], joint_error, rolled.kl


def refit_joint_scale(prior: MotionDVAE, clips: Sequence[Motion], seed: int = 0) -> float:
    """Set the decoder scale of joints to their RMS error on held-out clips and return it, metres.

    The prior is modified in place. The training error underestimates this scale, which weights the
    decoder in eq. 11. ``seed`` seeds the encoder draws.
    """
    windows = MotionWindows(clips, prior.states, prior.settings.frames).spread(VALIDATION_BATCH)
    rng, device = seeds.generator(seed, "scale"), torch.device("cpu")
    with torch.no_grad():
        _, error, _ = _reconstruct(prior.model, prior.states, windows, rng, device)
        scale = float((error**2).mean().sqrt())
        prior.model.generative.log_scales[-1] = math.log(scale)
    return scale


def usual_dvae_training(size: str) -> tuple[TrainingSettings, int]:
    """Return the training settings of a size and the number of its KL annealing steps.

    ``paper``: Adamax, batches of 64, 200 epochs, annealing over 50 (A.4); an epoch is 1000
    steps here. Raises ``ValueError`` for an unknown size.
    """
    tiny = TrainingSettings(steps=600, batch=32, learning_rate=3e-3, ema=0.98)
    small = replace(tiny, steps=4500, learning_rate=1e-3, ema=0.998, halve_at=(2000, 3000, 3800))
    small = replace(small, weight_decay=0.05, checkpoint_every=250, patience=6)
    paper = TrainingSettings(steps=200_000, learning_rate=1e-4, optimiser="adamax", ema=0.0)
    paper = replace(paper, halve_at=(50_000, 80_000, 140_000))
    known = {"tiny": (tiny, 200), "small": (small, 1000), "paper": (paper, 50_000)}
    if size not in known:
        raise ValueError(f"size must be one of {', '.join(known)}, got {size!r}")
    return known[size]


def _first_poses(states: np.ndarray) -> np.ndarray:
    """Return principal directions of first states, scaled by their deviations, (D, r)."""
    _, singular, directions = np.linalg.svd(states - states.mean(axis=0), full_matrices=False)
    explained = np.cumsum(singular**2) / (singular**2).sum()
    rank = int(np.searchsorted(explained, _EXPLAINED_VARIANCE)) + 1
    return (directions[:rank] * (singular[:rank, None] / math.sqrt(len(states)))).T


def _description(clips: Sequence[Motion], windows: int) -> dict[str, Any]:
    names = sorted(clip.name for clip in clips)
    return {"clips": names, "frames": sum(clip.frames for clip in clips), "windows": windows}
