"""Is a sampler right about its own uncertainty? Simulated evidence, of which the truth is known."""

from __future__ import annotations

from probmotion.calibration.grid import FEWEST_SIMULATIONS, calibrate
from probmotion.calibration.negative_control import Overconfident
from probmotion.calibration.result import Calibration

__all__ = ["FEWEST_SIMULATIONS", "Calibration", "Overconfident", "calibrate"]
