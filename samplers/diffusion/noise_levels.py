"""Noise levels of diffusion samplers, and the base class of samplers with such levels."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import UnionType
from typing import get_args

import numpy as np

from probmotion.posteriors.noise_schedule import NoiseSchedule
from probmotion.validation import check_count, check_positive

__all__ = ["AnyLevels", "Cosine", "Karras", "LogSNR", "NoiseLevels", "check_object"]

_SMALLEST, _LARGEST = 0.004, 80.0  # default noise levels, normalised units
_DEFAULT_RANGE = f"smallest={_SMALLEST:g}, largest={_LARGEST:g}"


@dataclass(frozen=True)
class Cosine:
    """Cosine schedule (Nichol and Dhariwal 2021, equation 17).

    Parameters
    ----------
    power : int
        Power of the cosine: 2 as published, 4 in the code of MAS.
    trained_steps : int, optional
        Number of levels of the schedule from which those of the sampler are selected; the
        sampler's own number by default.
    """

    kind: str = field(default="cosine", init=False)
    power: int = 2
    trained_steps: int | None = None

    def __post_init__(self) -> None:
        check_positive("power", self.power)
        if self.trained_steps is not None:
            check_count("trained_steps", self.trained_steps)

    def schedule(self, steps: int) -> NoiseSchedule:
        """Return the schedule of a number of levels."""
        if self.trained_steps is None:
            return NoiseSchedule.cosine(steps, power=self.power)
        return NoiseSchedule.cosine(self.trained_steps, power=self.power).strided(steps)


@dataclass(frozen=True)
class Karras:
    """Noise levels σ with evenly spaced σ^(1/ρ) (Karras et al. 2022, equation 5), ᾱ = 1/(1+σ²).

    Parameters
    ----------
    smallest, largest : float
        σ of the first and of the last level, normalised units.
    rho : float
        ρ: larger values move levels to low noise.
    """

    kind: str = field(default="karras", init=False)
    smallest: float = _SMALLEST
    largest: float = _LARGEST
    rho: float = 7.0

    def __post_init__(self) -> None:
        _check_range(self.smallest, self.largest)
        check_positive("rho", self.rho)

    def schedule(self, steps: int) -> NoiseSchedule:
        """Return the schedule of a number of levels."""
        check_count("steps", steps, least=2)
        power, ends = 1 / self.rho, np.array([self.smallest, self.largest])
        with np.errstate(over="ignore", invalid="ignore"):  # as rho tends to 0
            first, last = ends**power
            return _of_noise(np.linspace(first, last, steps) ** self.rho)


@dataclass(frozen=True)
class LogSNR:
    """Noise levels with evenly spaced log signal-to-noise ratio −2 log σ.

    Parameters
    ----------
    smallest, largest : float
        σ of the first and of the last level, normalised units.
    """

    kind: str = field(default="log-snr", init=False)
    smallest: float = _SMALLEST
    largest: float = _LARGEST

    def __post_init__(self) -> None:
        _check_range(self.smallest, self.largest)

    def schedule(self, steps: int) -> NoiseSchedule:
        """Return the schedule of a number of levels."""
        check_count("steps", steps, least=2)
        return _of_noise(np.geomspace(self.smallest, self.largest, steps))


AnyLevels = Cosine | Karras | LogSNR


class NoiseLevels:
    """Base class of frozen dataclasses with a number of noise levels and their spacing."""

    steps: int
    levels: AnyLevels
    batch: int

    def __post_init__(self) -> None:
        check_count("batch", self.batch)
        check_object("levels", self.levels, AnyLevels)
        # Creating the schedule validates the other settings.
        check_count("steps", self.schedule.steps)

    @property
    def schedule(self) -> NoiseSchedule:
        """Noise schedule with ``steps`` levels."""
        return self.levels.schedule(self.steps)


def check_object(name: str, value: object, kinds: UnionType) -> None:
    """Raise ``ValueError`` unless ``value`` is an instance of one of the classes of a union."""
    if not isinstance(value, kinds):
        names = [f"{kind.__name__}()" for kind in get_args(kinds)]
        raise ValueError(f"{name} must be {', '.join(names[:-1])} or {names[-1]}, got {value!r}")


def _of_noise(sigma: np.ndarray) -> NoiseSchedule:
    """Return the schedule with ascending noise levels σ_1, …, σ_T."""
    alpha_bar = np.concatenate([[1.0], 1 / (1 + sigma**2)])
    if (np.diff(alpha_bar) >= 0).any():
        raise ValueError(
            f"noise must increase with every level, got {len(sigma)} levels between "
            f"{sigma[0]:g} and {sigma[-1]:g} that rounding or overflow makes equal; "
            f"use {_DEFAULT_RANGE}"
        )
    return NoiseSchedule(alpha_bar)


def _check_range(smallest: float, largest: float) -> None:
    check_positive("smallest", smallest)
    check_positive("largest", largest)
    if smallest >= largest:
        raise ValueError(
            f"smallest must be below largest, {largest:g}, got {smallest:g}; use {_DEFAULT_RANGE}"
        )
