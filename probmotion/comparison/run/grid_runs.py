"""Runs of an experiment grid, each of one sampler on one problem with one seed.

A folder is written under a temporary name and then renamed, so that it is always complete.
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
from probmotion.comparison.results.failures import Failure, NonFiniteDraws, ResultNotWritten
from probmotion.comparison.results.run_results import (
    DRAWS,
    FARTHEST,
    RESULT,
    RunResult,
    read_result,
)
from probmotion.comparison.run.grid_tasks import GridTask
from probmotion.comparison.run.memory import watched_memory
from probmotion.comparison.run.time_limits import time_limit
from probmotion.files import forget_killed, write_json
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.threads import one_thread

__all__ = ["GridRun", "forget_unfinished"]

_UNFINISHED = ".unfinished-"


@dataclass(frozen=True, eq=False, kw_only=True)
class GridRun(GridTask):
    """Run of one sampler on one problem with one seed; ``path`` is the folder of its result.

    With a budget, ``settings`` are those chosen by the pilot, or ``pilot_failure`` is its failure.
    """

    stores_draws: ClassVar[bool] = True

    seed: int
    settings: dict[str, int] | None = None
    pilot_failure: Failure | None = None

    def __str__(self) -> str:
        return f"{self.problem}/{self.sampler}/{self.seed}"

    def result(self) -> RunResult | None:
        return read_result(self.path)

    def finished(self) -> bool:
        """Whether a result for the same inputs is stored, with complete draws."""
        result = self.result()
        if result is None or not super().finished():
            return False
        if result.failure is not None or not self.stores_draws:
            return True
        draws = self.path / DRAWS
        return draws.exists() and result.draws_bytes in (None, draws.stat().st_size)

    def prepare(self) -> None:
        from probmotion.metrics.measures import load_libraries

        load_libraries()
        super().prepare()

    def fail(self, error: BaseException) -> None:
        self._store({}, None, Failure.of(error))

    def run(self) -> None:
        """Draw, measure and store the result; errors of the sampler are stored as failures.

        Raises
        ------
        ResultNotWritten
            If the result cannot be written.
        """
        if self.pilot_failure is not None:
            self._store({}, None, self.pilot_failure)
            return
        try:
            with one_thread():
                self.prepare()
                problem = self.load()
                with time_limit(self.limit):
                    draws, metrics, statistics = self._measure(problem)
        # A sampler that calls sys.exit() must not end the grid.
        except (Exception, SystemExit) as error:
            self.fail(error)
        else:
            self._store(metrics, draws, None, statistics)

    def _measure(
        self, problem: Problem
    ) -> tuple[MotionDraws, dict[str, float], dict[str, Any] | None]:
        from probmotion.metrics.measures import measure
        from probmotion.metrics.run_statistics import draw_statistics

        # Changing "cell" would change all draws.
        seed = seeds.integer(self.seed, "cell", self.problem, self.sampler)
        with watched_memory() as peak:
            draws = self._draw(problem.posterior, seed)
        # All samplers are measured against the same reference draws.
        reference = seeds.integer(self.seed, "exact", self.problem)
        metrics = measure(problem, draws, reference)
        statistics = None
        if problem.has_reference:
            statistics = draw_statistics(problem, draws, reference, metrics).to_json()
        if peak.mebibytes is not None:
            metrics["peak_memory_mib"] = peak.mebibytes
        return draws, metrics, statistics

    def _draw(self, posterior: MotionPosterior, seed: int) -> MotionDraws:
        """Return the sampler's draws after checking their number and values."""
        draws = self.sample(self.with_sampler, posterior, seed)
        if not isinstance(draws, MotionDraws):
            raise TypeError(f"{self.sampler} must return MotionDraws, got {type(draws).__name__}")
        if draws.skeleton != posterior.skeleton:
            raise ValueError(f"{self.sampler} must return draws of the posterior's skeleton")
        returned = tuple(draws.positions.sizes[axis] for axis in ("chain", "draw"))
        expected = (self.chains, self.draws // self.chains)
        if returned != expected and not getattr(self.with_sampler, "finished", False):
            raise ValueError(
                f"{self.sampler} must return {expected[0]} chains of {expected[1]} draws, got "
                f"{returned[0]} of {returned[1]}"
            )
        if not (math.isfinite(draws.seconds) and draws.seconds >= 0):
            raise ValueError(
                f"{self.sampler} must return draws with their run time, got seconds={draws.seconds}"
            )
        # Metrics sum squares of positions, which must not overflow.
        if bad := int((~(np.abs(draws.positions.values) < FARTHEST)).sum()):
            raise NonFiniteDraws(
                f"{self.sampler} returned {bad} positions that are not finite or beyond "
                f"{FARTHEST:g} metres"
            )
        return draws

    def _store(
        self,
        metrics: dict[str, float],
        draws: MotionDraws | None,
        failure: Failure | None,
        statistics: dict[str, Any] | None = None,
    ) -> None:
        budget = None
        if self.budget is not None:
            used = None if draws is None else self.budget.spent(draws)
            budget = {"allowed": str(self.budget), "settings": self.settings, "used": used}
            if used is not None:
                chosen = {f"set_{name}": float(n) for name, n in (self.settings or {}).items()}
                metrics = {**metrics, "budget_used": used, **chosen}
        _remove_unfinished(self.path.parent, self.path.name)
        unfinished = self.path.parent / f"{_UNFINISHED}{self.path.name}-{os.getpid()}"
        try:
            unfinished.mkdir(parents=True, exist_ok=True)
            size = None
            if draws is not None and self.stores_draws:
                draws.save(unfinished / DRAWS)
                size = (unfinished / DRAWS).stat().st_size
            address = (self.problem, self.sampler, self.seed)
            result = RunResult(
                *address, self.fingerprint, metrics, failure, budget, size, statistics
            )
            write_json(unfinished / RESULT, _without_nan(asdict(result)))
            if self.path.exists():
                shutil.rmtree(self.path)
            unfinished.rename(self.path)
        except OSError as error:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise ResultNotWritten(error.strerror or str(error)) from error
        except Exception as error:
            # Record a failure, because the draws of the sampler cannot be saved.
            shutil.rmtree(unfinished, ignore_errors=True)
            if draws is None:
                raise
            self.fail(error)


def forget_unfinished(folder: Path, problems: Iterable[str]) -> None:
    """Remove incomplete files and folders of killed processes from a grid's folder."""
    for problem in problems:
        for runs in (folder / "runs" / problem).glob("*/"):
            _remove_unfinished(runs, "*")
        for kind in ("pilots", "problems"):
            forget_killed(folder / kind / problem)
    forget_killed(folder)


def _remove_unfinished(folder: Path, seed: str) -> None:
    for path in folder.glob(f"{_UNFINISHED}{seed}-*"):
        shutil.rmtree(path, ignore_errors=True)


def _without_nan(stored: dict[str, Any]) -> dict[str, Any]:
    """Replace NaN and infinite values, which JSON does not allow, by None."""
    without: dict[str, Any] = json.loads(json.dumps(stored), parse_constant=lambda _: None)
    return without
