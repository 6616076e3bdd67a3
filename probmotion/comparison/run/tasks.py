"""Tasks of an experiment grid: the runs and, with a budget, the pilots that precede them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from probmotion.comparison.results.budgets import Budget
from probmotion.comparison.results.failures import ResultNotWritten
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.run.grid_runs import GridRun, forget_unfinished
from probmotion.comparison.run.grid_tasks import GridTask, Pilot
from probmotion.comparison.run.workers import run_tasks
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.validation import check_count, check_positive

__all__ = ["Grid", "check_grid_options", "refuse_other_settings", "run_grid"]

_FEWEST_DRAWS = 10  # minimum number of draws per run


def check_grid_options(
    draws: int, chains: int, workers: int, budget: Budget | None, time_limit: float | None
) -> None:
    """Raise ``ValueError`` unless the options of a grid are in range."""
    check_count("draws", draws, least=_FEWEST_DRAWS)
    check_count("chains", chains)
    check_count("workers", workers, least=0)
    if draws % chains:
        raise ValueError(f"draws must be a multiple of chains, {chains}, got {draws}")
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    if budget is not None and not isinstance(budget, Budget):
        raise ValueError(f"budget must be a Budget, got {budget!r}")


@dataclass(eq=False)
class Grid:
    """Experiment grid: the tasks of a comparison, with results in ``folder``.

    ``budget`` is the budget of each run, ``limit`` the time limit of each task in seconds.
    """

    run_class: ClassVar[type[GridRun]] = GridRun

    folder: Path
    plan: Plan
    problems: Mapping[str, str | Problem]
    samplers: Mapping[str, Sampler]
    budget: Budget | None = None
    limit: float | None = None

    def pilots(self) -> list[Pilot]:
        """Return the pilots, an empty list without a budget."""
        if self.budget is None:
            return []
        return [
            self._pilot(problem, sampler) for problem in self.problems for sampler in self.samplers
        ]

    def runs(self) -> list[GridRun]:
        """Return the runs in the plan's order, with the settings of the finished pilots."""
        return [self._grid_run(*address) for address in self.plan.runs()]

    def _pilot(self, problem: str, sampler: str) -> Pilot:
        inputs = [
            *(problem, self._content(problem), sampler, self.samplers[sampler]),
            *(self.plan.draws, self.plan.chains, self.plan.versions, self.budget),
        ]
        return Pilot(
            path=self.folder / "pilots" / problem / f"{sampler}.json",
            with_sampler=self.samplers[sampler],
            fingerprint=fingerprint(inputs),
            **self._common(problem, sampler),
        )

    def _grid_run(self, problem: str, sampler: str, seed: int) -> GridRun:
        with_sampler: Any = self.samplers[sampler]
        pilot = None if self.budget is None else self._pilot(problem, sampler)
        result = pilot.result() if pilot is not None and pilot.has_result() else None
        if result is not None and result.settings:
            with_sampler = replace(with_sampler, **result.settings)
        inputs: list[Any] = [
            *(problem, self._content(problem), sampler, fingerprint(with_sampler), seed),
            *(self.plan.draws, self.plan.chains, self.plan.versions),
        ]
        return self.run_class(
            path=self.plan.run_folder(self.folder, problem, sampler, seed),
            seed=seed,
            with_sampler=with_sampler,
            fingerprint=fingerprint(inputs if self.budget is None else [*inputs, self.budget]),
            settings=None if result is None else result.settings,
            pilot_failure=None if result is None else result.failure,
            **self._common(problem, sampler),
        )

    def _content(self, problem: str) -> str:
        return self.plan.fingerprints["problem"][problem]

    def _common(self, problem: str, sampler: str) -> dict[str, Any]:
        return {
            "problem": problem,
            "sampler": sampler,
            "source": self.problems[problem],
            "draws": self.plan.draws,
            "chains": self.plan.chains,
            "limit": self.limit,
            "budget": self.budget,
        }


def run_grid(
    grid: Grid, workers: int, executor: Executor | None, progress: bool, label: str = "runs"
) -> None:
    """Run the unfinished pilots and runs of a grid; other arguments as in :func:`run_tasks`.

    Raises
    ------
    OSError
        If a result cannot be written.
    KeyboardInterrupt
        If the user presses Ctrl-C. Both messages state how many runs are finished and stored.
    """
    forget_unfinished(grid.folder, grid.problems)
    options = (workers, executor, progress)
    try:
        with _reporting_finished(grid):
            pilots = [pilot for pilot in grid.pilots() if not pilot.finished()]
            run_tasks(pilots, *options, label="pilots")
            run_tasks([run for run in grid.runs() if not run.finished()], *options, label=label)
    finally:
        # Killed workers may leave incomplete files; workers of an executor may still be writing.
        if executor is None:
            forget_unfinished(grid.folder, grid.problems)


def refuse_other_settings(folder: Path, tasks: Iterable[GridTask]) -> None:
    """Raise ``ValueError`` if a folder contains results of tasks made with other inputs."""
    if conflicting := [task for task in tasks if task.conflicts()]:
        runs = [task for task in conflicting if isinstance(task, GridRun)]
        what = f"{len(runs)} finished runs" if runs else f"{len(conflicting)} pilots of a budget"
        raise ValueError(
            f"out must be a new folder, got {folder}, which contains {what} made with other "
            f"settings, observations or library versions, the first {(runs or conflicting)[0]}"
        )


@contextmanager
def _reporting_finished(grid: Grid) -> Iterator[None]:
    """Add the number of finished runs to the message of an interruption or write error."""
    try:
        yield
    except (KeyboardInterrupt, ResultNotWritten) as stop:
        runs = grid.runs()
        finished = (
            f"{sum(run.finished() for run in runs)} of {len(runs)} runs finished and stored in "
            f"{grid.folder}; run the command again with this folder to resume"
        )
        if isinstance(stop, ResultNotWritten):
            raise OSError(f"cannot write to out, {stop}, with {finished}") from stop
        raise KeyboardInterrupt(f"interrupted with {finished}") from None
