"""`Grid`: what there is to run: cells, and before them pilots where there is a budget."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from probmotion.comparison.results.budgets import Budget
from probmotion.comparison.results.failures import CellNotKept
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.run.cells import Cell, forget_unfinished
from probmotion.comparison.run.pilots import Pilot
from probmotion.comparison.run.workers import run_tasks
from probmotion.posteriors.draws import library_versions
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem

__all__ = ["Grid", "refuse_taken", "run_grid"]


class Grid:
    """The tasks of a comparison.

    Parameters
    ----------
    folder : Path
        Where their results go.
    plan : Plan
        The names.
    problems, samplers : mapping
        The objects, or the registered names of problems, by name.
    budget : Budget, optional
        What every sampler may spend on a cell.
    limit : float, optional
        Seconds that a task may take.
    """

    def __init__(
        self,
        folder: Path,
        plan: Plan,
        problems: Mapping[str, str | Problem],
        samplers: Mapping[str, Sampler],
        budget: Budget | None = None,
        limit: float | None = None,
    ) -> None:
        self.folder = folder
        self.plan = plan
        self.problems = problems
        self.samplers = samplers
        self.budget = budget
        self.limit = limit
        self._asked = {
            name: _told(name, load_problem(source) if isinstance(source, str) else source)
            for name, source in problems.items()
        }
        for name, sampler in samplers.items():
            _told(name, sampler)
        self._versions = library_versions()

    def pilots(self) -> list[Pilot]:
        """Return the tasks that find out what a budget buys: none without one."""
        if self.budget is None:
            return []
        return [
            self._pilot(problem, sampler, self.budget)
            for problem in self.problems
            for sampler in self.samplers
        ]

    def cells(self) -> list[Cell]:
        """Return the cells, with the settings that the pilots found so far, in the plan's order."""
        return [self._cell(*address) for address in self.plan.cells()]

    def _pilot(self, problem: str, sampler: str, budget: Budget) -> Pilot:
        return Pilot(
            path=self.folder / "pilots" / problem / f"{sampler}.json",
            problem=problem,
            sampler=sampler,
            source=self.problems[problem],
            with_sampler=self.samplers[sampler],
            draws=self.plan.draws,
            chains=self.plan.chains,
            budget=budget,
            limit=self.limit,
            fingerprint=fingerprint(
                [
                    *(problem, self._asked[problem], sampler, self.samplers[sampler]),
                    *(self.plan.draws, self.plan.chains, self._versions, budget),
                ]
            ),
        )

    def _cell(self, problem: str, sampler: str, seed: int) -> Cell:
        with_sampler: Any = self.samplers[sampler]
        pilot = None if self.budget is None else self._pilot(problem, sampler, self.budget)
        found = None if pilot is None or not pilot.answered() else pilot.found()
        if found is not None and found.settings:
            with_sampler = replace(with_sampler, **found.settings)
        question: list[Any] = [
            *(problem, self._asked[problem], sampler, fingerprint(with_sampler), seed),
            *(self.plan.draws, self.plan.chains, self._versions),
        ]
        return Cell(
            folder=self.plan.cell_folder(self.folder, problem, sampler, seed),
            problem=problem,
            sampler=sampler,
            seed=seed,
            source=self.problems[problem],
            with_sampler=with_sampler,
            draws=self.plan.draws,
            chains=self.plan.chains,
            fingerprint=fingerprint(question if self.budget is None else [*question, self.budget]),
            limit=self.limit,
            budget=self.budget,
            settings=None if found is None else found.settings,
            beforehand=None if found is None else found.failure,
        )


def _told(name: str, value: Any) -> str:
    """Return a problem's or sampler's fingerprint; an error says whose it is."""
    try:
        return fingerprint(value)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def run_grid(
    grid: Grid, workers: int, executor: Executor | None, progress: bool, label: str = "cells"
) -> None:
    """Run what is not finished: pilots, then cells; arguments as :func:`run_tasks`'s.

    Raises
    ------
    OSError
        If a result cannot be written.
    KeyboardInterrupt
        At Ctrl-C; the messages of both say what is finished, and that it is kept.
    """
    cells = grid.folder / "cells"
    forget_unfinished(cells, grid.problems)
    try:
        with _finished_kept(grid):
            where = (workers, executor, progress)
            run_tasks(_missing(grid.pilots()), *where, label="pilots")
            run_tasks(_missing(grid.cells()), *where, label=label)
    finally:
        # Of workers killed while they wrote; an executor's may still be at it.
        if executor is None:
            forget_unfinished(cells, grid.problems)


def _missing(tasks: Sequence[Any]) -> list[Any]:
    """Return the tasks that are not finished."""
    return [task for task in tasks if not task.finished()]


def refuse_taken(folder: Path, tasks: Iterable[Cell | Pilot]) -> None:
    """Raise ``ValueError`` if a folder holds results of these names, made with other settings."""
    if taken := [task for task in tasks if task.taken()]:
        cells = [task for task in taken if isinstance(task, Cell)]
        what = f"{len(cells)} finished cells" if cells else f"{len(taken)} pilots of a budget"
        raise ValueError(
            f"out is {folder}, which holds {what} made with other settings, "
            f"evidence or library versions, the first {(cells or taken)[0]};"
            " expected a folder of its own for another comparison"
        )


@contextmanager
def _finished_kept(grid: Grid) -> Iterator[None]:
    """Say what is finished, and that it is kept, when the block is stopped."""
    try:
        yield
    except (KeyboardInterrupt, CellNotKept) as stop:
        cells = grid.cells()
        finished = sum(cell.finished() for cell in cells)
        rest = (
            f"{finished} of {len(cells)} cells finished, which are kept in {grid.folder}; the same "
            "command with that folder runs the others"
        )
        if isinstance(stop, CellNotKept):
            raise OSError(f"out cannot be written to any more, {stop}, with {rest}") from stop
        raise KeyboardInterrupt(f"interrupted with {rest}") from None
