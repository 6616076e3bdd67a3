"""Stored results of runs: metrics, failures and draws."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.comparison.results.failures import Failure, read_failure
from probmotion.files import read_json
from probmotion.metrics.run_statistics import DrawStatistics
from probmotion.posteriors.draws import MotionDraws
from probmotion.validation import check_types

__all__ = [
    "DRAWS",
    "FARTHEST",
    "RESULT",
    "RunResult",
    "read_draws",
    "read_result",
    "used_of_budget",
]

DRAWS, RESULT = "draws.nc", "run.json"
"""Files in a run's folder."""

FARTHEST = 1e100
"""Largest coordinate of draws, metres."""


@dataclass(frozen=True)
class RunResult:
    """Result of a finished run.

    ``budget`` contains the budget as text, the chosen settings and the amount used;
    ``draws_bytes`` is the size of the draws file, and ``statistics`` are those of a verdict
    (:class:`~probmotion.metrics.DrawStatistics`), absent without reference draws.
    """

    problem: str
    sampler: str
    seed: int
    fingerprint: str
    metrics: dict[str, float]
    failure: Failure | None = None
    budget: dict[str, Any] | None = None
    draws_bytes: int | None = None
    statistics: dict[str, Any] | None = None


def read_result(folder: Path) -> RunResult | None:
    """Return the result in a run's folder, or None if it is missing or damaged."""
    try:
        stored = read_json(folder / RESULT)
        failure = stored.pop("failure")
        metrics = {
            name: math.nan if value is None else value
            for name, value in stored.pop("metrics").items()
        }
        result = RunResult(
            **stored, metrics=metrics, failure=None if failure is None else read_failure(failure)
        )
        check_types(result)
        if folder.parts[-3:] != (result.problem, result.sampler, str(result.seed)):
            raise ValueError(f"{RESULT} must be in the folder of its run, got {folder}")
        if result.budget is not None:
            _check_budget(result.budget)
        if result.statistics is not None:
            _check_statistics(DrawStatistics(**result.statistics))
        return result
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (AttributeError, ValueError, KeyError, TypeError, OverflowError):
        return None


def _check_budget(budget: dict[str, Any]) -> None:
    """Raise ``ValueError`` or ``KeyError`` unless a stored budget has the keys of a run."""
    used, settings = budget["used"], budget["settings"]
    if not isinstance(used, int | float | None) or not isinstance(settings, dict | None):
        raise ValueError(f"budget must have an amount and settings, got {budget!r:.80}")


def _check_statistics(stored: DrawStatistics) -> None:
    """Raise an error of arithmetic, types or values unless stored statistics fit each other."""
    k, n_modes = len(stored.mean), len(stored.modes)
    for name, value, shapes in (
        ("n", stored.n, [()]),
        ("m", stored.m, [()]),
        ("mean", stored.mean, [(k,)]),
        ("spread", stored.spread, [(k, k)]),
        ("ratios", [*stored.ratios.values()], [(len(stored.ratios), 2)]),
        ("modes", [*stored.modes.values()], [(n_modes, 2), (0,)]),
        ("modes_spread", stored.modes_spread, [(n_modes, n_modes), (0,)]),
        ("classifier", stored.classifier, [(2,), (0,)]),
        ("distance", stored.distance, [(2,), (0,)]),
        ("rhat", stored.rhat or 0.0, [()]),
        ("rhat_by_chance", stored.rhat_by_chance, [()]),
    ):
        # NaN is stored as null.
        if np.array(value, dtype=np.float64).shape not in shapes:
            raise ValueError(f"{name} must have shape {shapes[0]}, got {value!r:.80}")
    np.linalg.inv(stored.spread)  # singular ones raise
    if not stored.n > 0:
        raise ValueError(f"n must be above 0, got {stored.n!r:.80}")
    if stored.classifier and stored.classifier[1] == 0:
        raise ValueError("classifier must have a standard deviation above 0, got 0")


def read_draws(folder: Path) -> MotionDraws:
    """Return the draws in a run's folder; raise ``ValueError`` if they are damaged."""
    draws = MotionDraws.load(folder / DRAWS)
    if not (np.abs(draws.positions.values) < FARTHEST).all():
        raise ValueError(f"{folder / DRAWS} is damaged: positions must be below {FARTHEST:g} m")
    return draws


def used_of_budget(results: Iterable[RunResult]) -> list[str]:
    """Return the minimum and maximum cost of each sampler's runs, as text."""
    used: dict[str, list[float]] = {}
    for result in results:
        if result.budget is not None and result.budget["used"] is not None:
            used.setdefault(result.sampler, []).append(result.budget["used"])
    return [
        f"{sampler} {min(amounts):.3g} to {max(amounts):.3g}" for sampler, amounts in used.items()
    ]
