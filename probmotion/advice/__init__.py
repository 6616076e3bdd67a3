"""Which sampler to take for a problem, by what was measured of all of them."""

from __future__ import annotations

from probmotion.advice.advise import Advice, Standing, advise
from probmotion.advice.measured import Measured, keep_measured, measured

__all__ = ["Advice", "Measured", "Standing", "advise", "keep_measured", "measured"]
