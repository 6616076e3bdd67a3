"""Stored results of runs: metrics, failures and draws."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probmotion.comparison.results.failures import Failure
from probmotion.posteriors.draws import MotionDraws

__all__ = ["DRAWS", "RESULT", "RunResult", "read_draws", "read_result", "used_of_budget"]

DRAWS, RESULT = "draws.nc", "run.json"
"""Files in a run's folder."""


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
        stored = json.loads((folder / RESULT).read_text(encoding="utf-8"))
        failure = stored.pop("failure")
        metrics = {
            name: math.nan if value is None else value
            for name, value in stored.pop("metrics").items()
        }
        return RunResult(
            **stored, metrics=metrics, failure=None if failure is None else Failure(**failure)
        )
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
        return None


def read_draws(folder: Path) -> MotionDraws:
    """Return the draws in a run's folder."""
    return MotionDraws.load(folder / DRAWS)


def used_of_budget(results: Iterable[RunResult]) -> list[str]:
    """Return the minimum and maximum cost of each sampler's runs, as text."""
    used: dict[str, list[float]] = {}
    for result in results:
        if result.budget is not None and result.budget["used"] is not None:
            used.setdefault(result.sampler, []).append(result.budget["used"])
    return [
        f"{sampler} {min(amounts):.3g} to {max(amounts):.3g}" for sampler, amounts in used.items()
    ]
