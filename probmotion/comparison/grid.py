"""`compare`: the grid problem × sampler × seed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path

from probmotion import seeds as addressed
from probmotion.comparison.comparison import Comparison
from probmotion.comparison.results.budgets import Budget, check_budget
from probmotion.comparison.results.naming import (
    AnyProblem,
    AnySampler,
    named_problems,
    named_samplers,
)
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.stored_problems import store_problem
from probmotion.comparison.run.locks import locked
from probmotion.comparison.run.tasks import Grid, refuse_taken, run_grid
from probmotion.files import writable_folder
from probmotion.problems.catalogue import load_problem
from probmotion.validation import check_count, check_positive

__all__ = ["compare"]

_FEWEST_DRAWS = 10


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
    """Run every sampler on every problem and measure what it drew.

    Each cell of the grid has its own random numbers, addressed by the names of its problem and
    sampler and its seed, and is kept as soon as it is finished: the same call after a run that
    was killed runs what is missing. The bits do not depend on workers or executor.

    Parameters
    ----------
    problems : str, Problem, MotionPosterior, or several
        Names of registered problems, or objects; a mapping gives them other names.
    samplers : str, Sampler, or several, optional
        Names of registered samplers, which stand for their default settings, or objects; a
        mapping gives them other names. All registered samplers by default.
    draws : int
        Draws per cell in all; every sampler returns as many.
    chains : int
        Chains that they are spread over.
    seeds : int
        Number of replicates.
    out : str or Path, optional
        Folder for cells, ``table.csv`` and ``failures.json``; a temporary one by default.
    workers : int
        Processes that are spawned; what one of them dies of is a row. 0 runs in this one, as a
        debugger wants: where memory ends, all ends.
    executor : concurrent.futures.Executor, optional
        Run the cells there instead; it must see the same ``out``.
    budget : Budget, optional
        What every sampler may spend on a cell, by the setting that it names as its ``effort``;
        pilot runs, once per problem and sampler, find out how much of it that is, and cost about
        as much as a cell. Their own settings by default.
    time_limit : float, optional
        Seconds that a cell may take, the making of its problem not counted; one that takes longer
        is a failure. It is ended in time in processes of our own, and in the main thread of a
        system with interval timers; elsewhere, as on an executor's threads, it runs to its end.
    progress : bool
        Show bars, of cells and (in this process) of draws.

    Raises
    ------
    ValueError
        If a problem or sampler is unknown, two have one name, a number is out of range,
        ``out`` holds finished cells of the same names that were made with other settings, was
        written by another version, or another run is at work on one of the problems there.
    OSError
        If ``out`` cannot be written to, said before anything is computed, or no longer, as when
        the disk is full: finished cells are kept.
    KeyboardInterrupt
        At Ctrl-C; the message says how many cells are finished and where.
    """
    check_count("draws", draws, least=_FEWEST_DRAWS)
    check_count("chains", chains)
    check_count("seeds", seeds)
    check_count("workers", workers, least=0)
    if draws % chains:
        raise ValueError(f"draws must be a multiple of chains, {chains}, got {draws}")
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    check_budget(budget)
    submits = callable(getattr(executor, "submit", None)) and not isinstance(executor, type)
    if executor is not None and not submits:
        raise ValueError(f"executor must be one that has submit(), or None, got {executor!r}")
    chosen = named_problems(problems)
    used = named_samplers(samplers)
    given = Path(tempfile.mkdtemp(prefix="probmotion-") if out is None else out)
    # Workers may stand in another folder.
    folder = writable_folder(given).absolute()
    Plan.check_folder(folder)
    plan = Plan.of(chosen, used, draws, chains, seeds, budget)
    with locked(folder, chosen):
        grid = Grid(folder, plan, chosen, used, budget, time_limit)
        refuse_taken(folder, [*grid.pilots(), *grid.cells()])
        for name, source in chosen.items():
            problem = load_problem(source) if isinstance(source, str) else source
            # Pictures show reference draws that the first seed is measured against.
            seed = addressed.integer(0, "exact", name)
            try:
                store_problem(problem, folder / "problems" / name, seed=seed)
            except OSError:
                raise
            except Exception:
                # A problem whose references cannot be drawn has no pictures; each of its cells
                # meets the same error, and says so in its row.
                continue
        plan.save(folder)
        run_grid(grid, workers, executor, progress)
        # A run of other problems in this folder may have left its own plan.
        plan.save(folder)
        comparison = Comparison(folder, plan, temporary=out is None)
        comparison.write(folder)
    return comparison
