"""Adam optimiser for NumPy arrays."""

from __future__ import annotations

import numpy as np

__all__ = ["Adam"]


class Adam:
    """Adam optimiser (Kingma and Ba 2015, algorithm 1) that updates ``parameters`` in place."""

    def __init__(self, parameters: np.ndarray, learning_rate: float) -> None:
        self.parameters = parameters
        self.learning_rate = learning_rate
        self.mean = np.zeros_like(parameters)
        self.square = np.zeros_like(parameters)
        self.n_steps = 0

    def descend(self, gradient: np.ndarray) -> None:
        """Update the parameters by one descent step."""
        self.n_steps += 1
        self.mean *= 0.9
        self.mean += 0.1 * gradient
        self.square *= 0.999
        self.square += 0.001 * gradient**2
        # Correct the bias of running moments that start at 0.
        scale = np.sqrt(self.square / (1 - 0.999**self.n_steps))
        scale += 1e-8
        step = self.learning_rate / (1 - 0.9**self.n_steps)
        self.parameters -= step * self.mean / scale
