"""Settings of a training run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from probmotion.validation import check_count, check_not_negative, check_positive

__all__ = ["TrainingSettings"]


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training run: optimiser, learning-rate schedule, checkpoints and stopping.

    Parameters
    ----------
    steps : int
        Number of gradient steps.
    batch : int
        Number of sequences per step.
    learning_rate : float
        Learning rate of the optimiser.
    warmup : int
        Initial steps over which the learning rate rises linearly from 0.
    weight_decay : float
        Weight decay of the optimiser.
    ema : float
        Decay of the moving average of the weights, which is validated and saved; 0 disables it.
    clip : float
        Maximum norm of the gradient; ``inf`` disables clipping.
    checkpoint_every : int
        Steps between checkpoints; a validation loss is computed at each.
    seed : int
        Seed of weights, batches and noise.
    optimiser : {"adamw", "adamax"}
        AdamW or Adamax.
    halve_at : tuple of int
        Steps after which the learning rate is halved.
    patience : int
        Early stopping: number of checkpoints without a lower validation loss, after which the run
        ends with the best model. 0 disables it; the last model is then saved.

    Raises
    ------
    ValueError
        If a parameter is out of range.
    """

    steps: int = 10_000
    batch: int = 64
    learning_rate: float = 1e-4
    warmup: int = 100
    weight_decay: float = 0.01
    ema: float = 0.999
    clip: float = 1.0
    checkpoint_every: int = 500
    seed: int = 0
    optimiser: Literal["adamw", "adamax"] = "adamw"
    halve_at: tuple[int, ...] = ()
    patience: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "checkpoint_every"):
            check_count(name, getattr(self, name))
        for name in ("warmup", "seed", "patience"):
            check_count(name, getattr(self, name), least=0)
        for step in self.halve_at:
            check_count("halve_at", step)
        if self.optimiser not in ("adamw", "adamax"):
            raise ValueError(f"optimiser must be adamw or adamax, got {self.optimiser!r}")
        check_positive("learning_rate", self.learning_rate)
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema must be at least 0 and below 1, got {self.ema}")
        if not self.clip > 0:
            raise ValueError(f"clip must be above 0, or inf to disable clipping, got {self.clip}")
        check_not_negative("weight_decay", self.weight_decay)

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, counted from 1."""
        halvings = sum(step > last for last in self.halve_at)
        return self.learning_rate * 0.5**halvings * min(1.0, step / max(1, self.warmup))

    def decay(self, step: int) -> float:
        """Return the average's decay at step k: min(ema, (1 + k)/(10 + k)), as in TensorFlow."""
        return min(self.ema, (1 + step) / (10 + step))
