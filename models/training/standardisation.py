"""Mean and standard deviation of 2D data, for standardised network inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.validation import check_finite, check_shape

__all__ = ["Standards"]


@dataclass(frozen=True, eq=False)
class Standards:
    """Mean and standard deviation of joint coordinates, metres, (J, 2) each.

    Constant coordinates, such as those of a centred root, have deviation 0.
    """

    mean: np.ndarray
    deviation: np.ndarray

    def __post_init__(self) -> None:
        check_shape("mean", self.mean, ("J", 2))
        check_shape("deviation", self.deviation, self.mean.shape)
        check_finite("mean", self.mean)
        check_finite("deviation", self.deviation)
        if self.deviation.min() < 0:
            raise ValueError(f"deviation must be at least 0, got {self.deviation.min():g}")
        if not (self.deviation > 0).any():
            raise ValueError("deviation must be above 0 for at least one coordinate, got only 0")

    @property
    def scale(self) -> float:
        """Root mean square of the nonzero deviations, metres."""
        nonzero = self.deviation[self.deviation > 0]
        return float(np.sqrt((nonzero**2).mean()))
