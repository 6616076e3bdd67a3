"""Mean and deviation of 2D data, by which they are standardised at a network's door."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probmotion.validation import check_finite, check_shape

__all__ = ["Standards"]


@dataclass(frozen=True, eq=False)
class Standards:
    """Mean and deviation of every joint's coordinates in the data, metres, (J, 2) each.

    A coordinate that never varies, such as those of a root that pictures are centred on, has
    deviation 0 and is given back as its mean.
    """

    mean: np.ndarray
    deviation: np.ndarray

    def __post_init__(self) -> None:
        check_shape("mean", self.mean, ("J", 2))
        check_shape("deviation", self.deviation, self.mean.shape)
        check_finite("mean", self.mean)
        check_finite("deviation", self.deviation)
        if self.deviation.min() < 0:
            raise ValueError(
                f"deviation is {self.deviation.min():g} at its least, expected 0 or more"
            )
        if not (self.deviation > 0).any():
            raise ValueError("deviation is 0 everywhere, expected keypoints that move")

    @property
    def scale(self) -> float:
        """Root mean square of the deviations that are not 0, metres."""
        moving = self.deviation[self.deviation > 0]
        return float(np.sqrt((moving**2).mean()))
