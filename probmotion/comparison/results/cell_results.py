"""The stored result of one run, and its draws."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probmotion.comparison.results.failures import Failure
from probmotion.posteriors.draws import MotionDraws

__all__ = ["DRAWS", "RESULT", "CellResult", "read_draws", "read_result", "used_of_budget"]

DRAWS, RESULT = "draws.nc", "cell.json"
"""Files of a run's folder."""


@dataclass(frozen=True)
class CellResult:
    """What is kept of a finished cell beside its draws.

    ``budget`` says what the cell was allowed, in the words of
    :class:`~probmotion.comparison.results.budgets.Budget`, with which settings, and what it used;
    ``draws_bytes`` how long the file of its draws is.
    """

    problem: str
    sampler: str
    seed: int
    fingerprint: str
    metrics: dict[str, float]
    failure: Failure | None = None
    budget: dict[str, Any] | None = None
    draws_bytes: int | None = None


def read_result(folder: Path) -> CellResult | None:
    """Return the result kept in a cell's folder, or None where there is none."""
    try:
        with open(folder / RESULT, encoding="utf-8") as file:
            kept = json.load(file)
        failure = kept.pop("failure")
        metrics = {
            name: math.nan if value is None else value
            for name, value in kept.pop("metrics").items()
        }
        return CellResult(
            **kept, metrics=metrics, failure=None if failure is None else Failure(**failure)
        )
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
        return None


def read_draws(folder: Path) -> MotionDraws:
    """Return the draws kept in a cell's folder."""
    return MotionDraws.load(folder / DRAWS)


def used_of_budget(results: Iterable[CellResult]) -> list[str]:
    """Return what each sampler used of a budget, from the least to the most of a cell, in words."""
    used: dict[str, list[float]] = {}
    for result in results:
        if result.budget is not None and result.budget["used"] is not None:
            used.setdefault(result.sampler, []).append(result.budget["used"])
    return [
        f"{sampler} {min(amounts):.3g} to {max(amounts):.3g}" for sampler, amounts in used.items()
    ]
