"""Experiment grids: every sampler on every problem with every seed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path

from probmotion import seeds as addressed
from probmotion.calibration.result import Calibration
from probmotion.comparison.results.budgets import Budget
from probmotion.comparison.results.grid_results import GridResults
from probmotion.comparison.results.naming import (
    AnyProblem,
    AnySampler,
    named_problems,
    named_samplers,
)
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.stored_problems import store_problem
from probmotion.comparison.run.locks import locked, plan_locked
from probmotion.comparison.run.tasks import (
    Grid,
    check_grid_options,
    refuse_other_settings,
    run_grid,
)
from probmotion.files import writable_folder
from probmotion.plots.quality import plot_quality_against_cost
from probmotion.problems.catalogue import load_problem
from probmotion.report.page import write_report
from probmotion.validation import check_count

__all__ = ["Comparison", "compare"]

_FIGURE = "quality_against_cost.png"


class Comparison(GridResults):
    """Draws and metrics of every sampler on every problem.

    See :class:`~probmotion.comparison.results.grid_results.GridResults` for table and draws.
    """

    def plot(self, path: str | Path | None = None) -> Path:
        """Plot quality against cost and return the path, by default in the folder of the grid.

        ``path`` ends in .png, .pdf or .svg. Markers of samplers that are right are filled.
        """
        target = self.folder / _FIGURE if path is None else Path(path)
        plot_quality_against_cost(self.table(), target, verdicts=self.verdicts())
        return target

    def report(self, path: str | Path, calibration: Calibration | None = None) -> Path:
        """Write a self-contained HTML page with tables, plots and animated draws."""
        return write_report(self, path, calibration)


def compare(
    problems: AnyProblem | Iterable[AnyProblem] | Mapping[str, AnyProblem],
    samplers: AnySampler | Iterable[AnySampler] | Mapping[str, AnySampler] | None = None,
    *,
    draws: int = 200,
    chains: int = 4,
    seeds: int = 1,
    out: str | Path | None = None,
    workers: int = 1,
    executor: Executor | None = None,
    budget: Budget | None = None,
    time_limit: float | None = None,
    progress: bool = True,
) -> Comparison:
    """Run every sampler on every problem and measure its draws.

    The random numbers of a run depend only on its problem, sampler and seed, so the results do not
    depend on ``workers`` or ``executor``. Each run is stored as soon as it is finished; repeat
    the call to resume an interrupted grid. Other problems, samplers and seeds extend a grid in
    ``out``; the result contains all of them.

    Parameters
    ----------
    problems : str, Problem, MotionPosterior, or several
        Names of registered problems, or objects; the keys of a mapping replace their names.
    samplers : str, Sampler, or several, optional
        Names of registered samplers with default settings, or objects; the keys of a mapping
        replace their names. All registered samplers by default.
    draws : int
        Number of draws per run, summed over chains.
    chains : int
        Number of chains per run.
    seeds : int
        Number of replicates per problem and sampler, with seeds 0, 1, …
    out : str or Path, optional
        Folder for the runs, ``table.csv`` and ``failures.json``; temporary by default.
    workers : int
        Number of worker processes. With 0 all runs use this process, which simplifies debugging,
        but a crash of a sampler ends the grid.
    executor : concurrent.futures.Executor, optional
        Executor to use instead of worker processes; its workers must have access to ``out``.
    budget : Budget, optional
        Cost of a run, equal for all samplers. Pilot runs, which cost about as much as a run, choose
        the settings once per problem and sampler. By default settings are not changed.
    time_limit : float, optional
        Time limit of a run in seconds, excluding problem loading; a longer run is recorded as
        failed. Threads of an executor are not interrupted.
    progress : bool
        Show progress bars.

    Raises
    ------
    ValueError
        If a problem or sampler is unknown, names are not unique, a number is out of range,
        ``out`` contains runs made with other draws, chains, budget, settings or versions, or
        another process is running one of the problems in ``out``.
    OSError
        If ``out`` cannot be written to; finished runs remain stored.
    KeyboardInterrupt
        At Ctrl-C; the message states how many runs are finished.
    """
    check_grid_options(draws, chains, workers, budget, time_limit)
    check_count("seeds", seeds)
    can_submit = callable(getattr(executor, "submit", None)) and not isinstance(executor, type)
    if executor is not None and not can_submit:
        raise ValueError(f"executor must be an object with submit(), or None, got {executor!r}")
    chosen = named_problems(problems)
    used = named_samplers(samplers)
    given = Path(tempfile.mkdtemp(prefix="probmotion-") if out is None else out)
    # Workers may have another working directory.
    folder = writable_folder(given).absolute()
    plan = Plan.of(chosen, used, draws, chains, seeds, budget)
    plan.union(folder)  # raises before anything is written
    with locked(folder, chosen):
        grid = Grid(folder, plan, chosen, used, budget, time_limit)
        refuse_other_settings(folder, [*grid.pilots(), *grid.runs()])
        for name, source in chosen.items():
            problem = load_problem(source) if isinstance(source, str) else source
            # Metrics of seed 0 use the same reference draws.
            seed = addressed.integer(0, "exact", name)
            try:
                store_problem(problem, folder / "problems" / name, seed=seed)
            except Exception as error:
                # If reference draws failed, every run of the problem records the same error.
                if isinstance(error, OSError):
                    raise
        with plan_locked(folder):
            plan.union(folder).save(folder)
        run_grid(grid, workers, executor, progress)
        # Grids of other problems may have extended the plan.
        with plan_locked(folder):
            comparison = Comparison(folder, Plan.load(folder), temporary=out is None)
            comparison.write(folder)
    return comparison
