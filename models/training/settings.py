"""How a network is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from probmotion.validation import check_count, check_positive

__all__ = ["TrainingSettings"]


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained: at a constant rate after a linear warm-up, halved where asked.

    Parameters
    ----------
    steps : int
        Gradient steps.
    batch : int
        Sequences per step.
    learning_rate : float
        Of the optimiser.
    warmup : int
        Steps over which the rate rises from 0.
    weight_decay : float
        Of the optimiser.
    ema : float
        Decay of the moving average of the weights, which is what is kept and validated; 0: none.
    clip : float
        Greatest norm of the gradient; ``inf``: none.
    checkpoint_every : int
        Steps between two checkpoints, each with a validation loss.
    seed : int
        Of weights, batches and noise.
    optimiser : {"adamw", "adamax"}
        Adam's kind.
    halve_at : tuple of int
        Steps after which the rate is halved.
    patience : int
        Checkpoints without a lower validation loss after which a run ends; the model is then that
        of the lowest. 0: it takes all steps, and the model is the last.

    Raises
    ------
    ValueError
        If a number is out of range.
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
        if self.optimiser not in ("adamw", "adamax"):
            raise ValueError(f"optimiser must be adamw or adamax, got {self.optimiser!r}")
        for step in self.halve_at:
            check_count("halve_at", step)
        for name in ("warmup", "seed", "patience"):
            check_count(name, getattr(self, name), least=0)
        check_positive("learning_rate", self.learning_rate)
        if not 0 <= self.ema < 1:
            raise ValueError(f"ema must be a decay of at least 0 and below 1, got {self.ema}")
        if not self.clip > 0:
            raise ValueError(f"clip must be a number above 0, or inf for none, got {self.clip}")
        if not 0 <= self.weight_decay < math.inf:
            raise ValueError(
                f"weight_decay must be a finite number of at least 0, got {self.weight_decay}"
            )

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, which counts from 1."""
        halved = 0.5 ** sum(step > mark for mark in self.halve_at)
        return self.learning_rate * halved * min(1.0, step / max(1, self.warmup))

    def decay(self, step: int) -> float:
        """Return the moving average's decay after a step: smaller at first, so that it catches up.

        The rule is TensorFlow's, min(decay, (1 + k)/(10 + k)).
        """
        return min(self.ema, (1 + step) / (10 + step))
