"""One cell of the grid: a sampler on a problem with a seed, run once and kept in a folder.

A cell's folder is whole or absent: it is filled under another name and renamed.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.comparison.results.budgets import Budget
from probmotion.comparison.results.cell_results import DRAWS, RESULT, CellResult, read_result
from probmotion.comparison.results.failures import CellNotKept, Failure, NotFinite
from probmotion.comparison.run.memory import watched_memory
from probmotion.comparison.run.time_limits import time_limit
from probmotion.files import forget_killed
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem
from probmotion.threads import one_thread

__all__ = ["Cell", "forget_unfinished"]

_UNFINISHED = ".unfinished-"
_FARTHEST = 1e100


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
    limit : float, optional
        Seconds that it may take, the making of its problem and what measures import not counted.
    budget : Budget, optional
        What it was allowed.
    settings : dict, optional
        The sampler's settings that spend it.
    beforehand : Failure, optional
        Why it cannot run within it; the cell then has this failure.
    """

    keeps_draws: ClassVar[bool] = True

    folder: Path
    problem: str
    sampler: str
    seed: int
    source: str | Problem
    with_sampler: Sampler
    draws: int
    chains: int
    fingerprint: str
    limit: float | None = None
    budget: Budget | None = None
    settings: dict[str, int] | None = None
    beforehand: Failure | None = None

    def __str__(self) -> str:
        return f"{self.problem}/{self.sampler}/{self.seed}"

    def answered(self) -> bool:
        """Whether its result is there, made with the same settings."""
        result = read_result(self.folder)
        return result is not None and result.fingerprint == self.fingerprint

    def finished(self) -> bool:
        """Whether its result is there, made with the same settings, and no accident."""
        result = read_result(self.folder)
        if result is None or result.fingerprint != self.fingerprint:
            return False
        if result.failure is None and self.keeps_draws:
            return _has_length(self.folder / DRAWS, result.draws_bytes)
        return result.failure is None or result.failure.unsupported

    def taken(self) -> bool:
        """Whether its folder holds draws made with other settings, which it must not replace."""
        result = read_result(self.folder)
        return (
            result is not None and result.failure is None and result.fingerprint != self.fingerprint
        )

    def prepare(self) -> None:
        """Load what it needs."""
        from probmotion.metrics.measures import load_libraries

        load_libraries()
        if isinstance(self.source, str):
            load_problem(self.source)

    def fail(self, error: BaseException) -> None:
        """Keep an error as the cell's result."""
        self._keep({}, None, Failure.of(error))

    def run(self, progress: bool) -> None:
        """Draw, measure and keep; an error of the sampler's is kept as the cell's result.

        Raises
        ------
        CellNotKept
            If it cannot be written; nothing of it is left then.
        """
        if self.beforehand is not None:
            self._keep({}, None, self.beforehand)
            return
        try:
            with one_thread():
                self.prepare()
                problem = load_problem(self.source) if isinstance(self.source, str) else self.source
                with time_limit(self.limit):
                    draws, metrics = self._measured(problem, progress)
        # A sampler that asks the program to end must not end the grid.
        except (Exception, SystemExit) as error:
            self.fail(error)
        else:
            self._keep(metrics, draws, None)

    def _measured(self, problem: Problem, progress: bool) -> tuple[MotionDraws, dict[str, float]]:
        from probmotion.metrics.measures import measure

        seed = seeds.integer(self.seed, "cell", self.problem, self.sampler)
        with watched_memory() as peak:
            draws = self._drawn(problem.posterior, seed, progress)
        # All samplers of a problem and seed are judged by the same exact draws.
        metrics = measure(problem, draws, seeds.integer(self.seed, "exact", self.problem))
        if peak.mebibytes is not None:
            metrics["peak_memory_mib"] = peak.mebibytes
        return draws, metrics

    def _drawn(self, posterior: MotionPosterior, seed: int, progress: bool) -> MotionDraws:
        """Return what the sampler draws: as many as were asked for, all finite."""
        draws = self.with_sampler.sample(
            posterior,
            draws=self.draws // self.chains,
            chains=self.chains,
            seed=seed,
            progress=progress,
        )
        if not isinstance(draws, MotionDraws):
            raise TypeError(f"{self.sampler} returned {type(draws).__name__}, expected MotionDraws")
        if draws.skeleton != posterior.skeleton:
            raise ValueError(
                f"{self.sampler} returned draws of another skeleton, expected the posterior's"
            )
        found = tuple(draws.positions.sizes[axis] for axis in ("chain", "draw"))
        if found != (wanted := (self.chains, self.draws // self.chains)):
            raise ValueError(
                f"{self.sampler} returned {found[0]} chains of {found[1]} draws, expected "
                f"{wanted[0]} of {wanted[1]}"
            )
        if not (math.isfinite(draws.seconds) and draws.seconds >= 0):
            raise ValueError(
                f"{self.sampler} returned draws with seconds={draws.seconds}, expected those that "
                "they took"
            )
        # Measures take squares, and sums of them.
        if bad := int((~(np.abs(draws.positions.values) < _FARTHEST)).sum()):
            raise NotFinite(
                f"{self.sampler} returned draws of which {bad} numbers are not finite or beyond "
                f"{_FARTHEST:g} metres"
            )
        return draws

    def _keep(
        self, metrics: dict[str, float], draws: MotionDraws | None, failure: Failure | None
    ) -> None:
        spent = None
        if self.budget is not None:
            used = None if draws is None else self.budget.spent(draws)
            spent = {"asked": str(self.budget), "settings": self.settings, "used": used}
            if used is not None:
                bought = {f"set_{name}": float(n) for name, n in (self.settings or {}).items()}
                metrics = {**metrics, "budget_used": used, **bought}
        address = (self.problem, self.sampler, self.seed)
        _forget(self.folder.parent, self.folder.name)
        unfinished = self.folder.parent / f"{_UNFINISHED}{self.folder.name}-{os.getpid()}"
        try:
            unfinished.mkdir(parents=True, exist_ok=True)
            length = None
            if draws is not None and self.keeps_draws:
                draws.save(unfinished / DRAWS)
                length = (unfinished / DRAWS).stat().st_size
            result = CellResult(*address, self.fingerprint, metrics, failure, spent, length)
            with open(unfinished / RESULT, "w", encoding="utf-8") as file:
                json.dump(_without_nan(asdict(result)), file, indent=1)
            if self.folder.exists():
                shutil.rmtree(self.folder)
            unfinished.rename(self.folder)
        except OSError as error:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise CellNotKept(error.strerror or str(error)) from error
        except Exception as error:
            # Draws that no file can hold are the sampler's fault.
            shutil.rmtree(unfinished, ignore_errors=True)
            if draws is None:
                raise
            self.fail(error)


def _has_length(file: Path, length: int | None) -> bool:
    """Whether a file is there and whole; of files of unknown length, whether it is there."""
    try:
        return length in (None, file.stat().st_size)
    except OSError:
        return False


def forget_unfinished(cells: Path, problems: Iterable[str]) -> None:
    """Remove what a killed run left half-written, of cells below ``cells`` and of all beside it."""
    for problem in problems:
        for place in (cells / problem).glob("*/"):
            _forget(place, "*")
        for kept in ("pilots", "problems"):
            forget_killed(cells.parent / kept / problem)
    forget_killed(cells.parent)


def _forget(place: Path, seed: str) -> None:
    for left in place.glob(f"{_UNFINISHED}{seed}-*"):
        shutil.rmtree(left, ignore_errors=True)


def _without_nan(value: Any) -> Any:
    """JSON has no NaN: write null."""
    if isinstance(value, dict):
        return {name: _without_nan(held) for name, held in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
