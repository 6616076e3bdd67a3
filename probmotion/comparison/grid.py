"""`compare`: the grid problem × sampler × seed."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from probmotion.checks import check_count
from probmotion.comparison.cells import Cell, forget_unfinished
from probmotion.comparison.fingerprint import fingerprint
from probmotion.comparison.result import Comparison, Plan
from probmotion.comparison.workers import run_cells
from probmotion.draws import library_versions
from probmotion.posterior import MotionPosterior
from probmotion.problems import Problem, load_problem, problem_names
from probmotion.sampling import Sampler, load_sampler, sampler_names

__all__ = ["compare"]

_FEWEST_DRAWS = 10
_NAME = re.compile(r"\w[\w.,=+() -]*")

AnyProblem = str | Problem | MotionPosterior
AnySampler = str | Sampler


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
        Processes; 1 runs in this one.
    executor : concurrent.futures.Executor, optional
        Run the cells there; it must see the same ``out``.
    progress : bool
        Show bars, of cells and (with one worker) of draws.

    Raises
    ------
    ValueError
        If a problem or sampler is unknown, two have one name, a number is out of range, or
        ``out`` holds finished cells of the same names that were made with other settings.
    OSError
        If ``out`` cannot be written to; said before anything is computed.
    KeyboardInterrupt
        At Ctrl-C; the message says how many cells are finished and where.
    """
    check_count("draws", draws, least=_FEWEST_DRAWS)
    check_count("chains", chains)
    check_count("seeds", seeds)
    check_count("workers", workers)
    if draws % chains:
        raise ValueError(f"draws is {draws}, expected a multiple of chains, {chains}")
    chosen = _named_problems(problems)
    used = _named_samplers(samplers)
    folder = Path(tempfile.mkdtemp(prefix="probmotion-")) if out is None else _writable(Path(out))
    plan = Plan.of(chosen, used, draws, chains, seeds)
    cells = _cells(folder, plan, chosen, used)
    if taken := [cell for cell in cells if cell.taken()]:
        first = taken[0]
        raise ValueError(
            f"out is {folder}, which holds {len(taken)} finished cells made with other settings, "
            f"evidence or library versions, the first {first.problem}/{first.sampler}/{first.seed};"
            " expected a folder of its own for another comparison"
        )
    forget_unfinished(folder / "cells")
    plan.save(folder)
    missing = [cell for cell in cells if not cell.finished()]
    try:
        run_cells(missing, workers, executor, progress)
    except KeyboardInterrupt:
        finished = sum(cell.finished() for cell in cells)
        raise KeyboardInterrupt(
            f"interrupted with {finished} of {len(cells)} cells finished, which are kept in "
            f"{folder}; the same command with that folder runs the others"
        ) from None
    comparison = Comparison.load(folder, temporary=out is None)
    comparison.write(folder)
    return comparison


def _cells(
    folder: Path, plan: Plan, problems: Mapping[str, Any], samplers: Mapping[str, Sampler]
) -> list[Cell]:
    """The grid, all samplers of one problem and seed in a row: they share exact draws."""
    asked = {
        name: fingerprint(load_problem(source) if isinstance(source, str) else source)
        for name, source in problems.items()
    }
    settings = {name: fingerprint(sampler) for name, sampler in samplers.items()}
    versions = library_versions()
    return [
        Cell(
            folder=plan.cell_folder(folder, problem, sampler, seed),
            problem=problem,
            sampler=sampler,
            seed=seed,
            source=problems[problem],
            with_sampler=samplers[sampler],
            draws=plan.draws,
            chains=plan.chains,
            fingerprint=fingerprint(
                [
                    *(problem, asked[problem], sampler, settings[sampler], seed),
                    *(plan.draws, plan.chains, versions),
                ]
            ),
        )
        for problem, sampler, seed in plan.cells()
    ]


def _named_problems(problems: Any) -> dict[str, str | Problem]:
    """The problems by what the table calls them; a registered name stands for itself."""
    found: dict[str, str | Problem] = {}
    for label, given in _labelled(problems, AnyProblem):
        if isinstance(given, str):
            load_problem(given)
            _add("problems", found, label or given, given)
        elif isinstance(given, Problem):
            _add("problems", found, label or given.name, _registered_name(given) or given)
        elif isinstance(given, MotionPosterior):
            name = label or "posterior"
            _add("problems", found, name, Problem(name, "a posterior of the caller's", given))
        else:
            raise ValueError(
                f"problems has a {type(given).__name__}, expected names, Problem or "
                "MotionPosterior objects"
            )
    return found


def _registered_name(problem: Problem) -> str | None:
    """A registered problem travels by its name: a process then makes it once for all cells."""
    name = problem.name
    return name if name in problem_names() and load_problem(name) is problem else None


def _named_samplers(samplers: Any) -> dict[str, Sampler]:
    found: dict[str, Sampler] = {}
    for label, given in _labelled(sampler_names() if samplers is None else samplers, AnySampler):
        if isinstance(given, str):
            _add("samplers", found, label or given, load_sampler(given)())
        elif isinstance(given, Sampler) and not isinstance(given, type):
            _add("samplers", found, label or given.name, given)
        else:
            what = given.__name__ if isinstance(given, type) else type(given).__name__
            raise ValueError(
                f"samplers has {what}, expected names or objects with name, requires and sample()"
            )
    return found


def _labelled(given: Any, one: Any) -> list[tuple[str | None, Any]]:
    if isinstance(given, Mapping):
        return list(given.items())
    if isinstance(given, one) or not isinstance(given, Iterable):
        return [(None, given)]
    return [(None, item) for item in given]


def _add(argument: str, found: dict[str, Any], name: str, value: Any) -> None:
    if name in found:
        raise ValueError(
            f"{argument} has two called {name!r}, expected different names; give a mapping, such "
            f"as {{'{name}-a': …, '{name}-b': …}}"
        )
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{argument} has the name {name!r}, expected letters, digits and . , = + ( ) - _ that "
            "make a folder's name"
        )
    found[name] = value


def _writable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"out is {str(folder)!r}, {reason}; expected a writable folder") from error
    return folder
