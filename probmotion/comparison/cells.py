"""One cell of the grid: a sampler on a problem with a seed, run once and kept in a folder.

A cell's folder is whole or absent: it is filled under another name and renamed.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from probmotion import seeds
from probmotion.draws import MotionDraws
from probmotion.problems import Problem, load_problem
from probmotion.sampling import Sampler, UnsupportedPosterior
from probmotion.threads import one_thread

__all__ = ["Cell", "CellResult", "Failure", "forget_unfinished", "read_result", "run_cell"]

_DRAWS, _RESULT = "draws.nc", "cell.json"
_UNFINISHED = ".unfinished-"


@dataclass(frozen=True)
class Failure:
    """Why a cell has no draws: one word for the table, one sentence, and where it happened."""

    word: str
    message: str
    unsupported: bool
    traceback: str = ""


@dataclass(frozen=True)
class CellResult:
    """What is kept of a finished cell beside its draws."""

    problem: str
    sampler: str
    seed: int
    fingerprint: str
    metrics: dict[str, float]
    failure: Failure | None = None


@dataclass(frozen=True, eq=False)
class Cell:
    """One independent task of the grid.

    Parameters
    ----------
    folder : Path
        Where its draws and result go.
    problem, sampler : str
        What the table calls them; with ``seed`` they address the cell's random numbers.
    seed : int
        Number of the replicate.
    source : str or Problem
        The problem, or the registered name to load it by where the cell runs.
    with_sampler : Sampler
        The sampler.
    draws, chains : int
        ``draws`` in all, spread evenly over ``chains``.
    fingerprint : str
        Digest of all that decides the result.
    """

    folder: Path
    problem: str
    sampler: str
    seed: int
    source: str | Problem
    with_sampler: Sampler
    draws: int
    chains: int
    fingerprint: str

    def finished(self) -> bool:
        """Whether its result is there, made with the same settings, and no accident."""
        result = read_result(self.folder)
        if result is None or result.fingerprint != self.fingerprint:
            return False
        return result.failure is None or result.failure.unsupported

    def taken(self) -> bool:
        """Whether its folder holds draws made with other settings, which it must not replace."""
        result = read_result(self.folder)
        return (
            result is not None and result.failure is None and result.fingerprint != self.fingerprint
        )

    def fail(self, error: BaseException) -> None:
        """Keep an error as the cell's result."""
        self._keep({}, None, _failure(error))

    def run(self, progress: bool) -> None:
        """Draw, measure and keep; an error of the sampler's is kept as the cell's result."""
        from probmotion.metrics import measure

        try:
            with one_thread():
                problem = load_problem(self.source) if isinstance(self.source, str) else self.source
                draws = self.with_sampler.sample(
                    problem.posterior,
                    draws=self.draws // self.chains,
                    chains=self.chains,
                    seed=seeds.integer(self.seed, "cell", self.problem, self.sampler),
                    progress=progress,
                )
                n = draws.positions.sizes["chain"] * draws.positions.sizes["draw"]
                if n != self.draws:
                    raise ValueError(f"{self.sampler} returned {n} draws, expected {self.draws}")
                # All samplers of a problem and seed are judged by the same exact draws.
                metrics = measure(problem, draws, seeds.integer(self.seed, "exact", self.problem))
        except Exception as error:
            self.fail(error)
        else:
            self._keep(metrics, draws, None)

    def _keep(
        self, metrics: dict[str, float], draws: MotionDraws | None, failure: Failure | None
    ) -> None:
        result = CellResult(
            self.problem, self.sampler, self.seed, self.fingerprint, metrics, failure
        )
        place = self.folder.parent
        unfinished = place / f"{_UNFINISHED}{self.folder.name}-{os.getpid()}"
        unfinished.mkdir(parents=True, exist_ok=True)
        if draws is not None:
            draws.save(unfinished / _DRAWS)
        with open(unfinished / _RESULT, "w", encoding="utf-8") as file:
            json.dump(_without_nan(asdict(result)), file, indent=1)
        if self.folder.exists():
            shutil.rmtree(self.folder)
        unfinished.rename(self.folder)


def run_cell(cell: Cell, progress: bool = False) -> None:
    """Run a cell; what an executor is given."""
    cell.run(progress)


def read_result(folder: Path) -> CellResult | None:
    """Return the result kept in a cell's folder, or None where there is none."""
    try:
        with open(folder / _RESULT, encoding="utf-8") as file:
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
    return MotionDraws.load(folder / _DRAWS)


def forget_unfinished(cells: Path) -> None:
    """Remove what cells of a killed run left half-written below ``cells``."""
    for left in cells.glob(f"*/*/{_UNFINISHED}*"):
        shutil.rmtree(left, ignore_errors=True)


def _failure(error: BaseException) -> Failure:
    message = " ".join(str(error).split()) or type(error).__name__
    trace = "".join(traceback.format_exception(error))
    if isinstance(error, UnsupportedPosterior):
        return Failure(error.word, message, unsupported=True, traceback=trace)
    return Failure(type(error).__name__, message, unsupported=False, traceback=trace)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: write null."""
    if isinstance(value, dict):
        return {name: _without_nan(held) for name, held in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
