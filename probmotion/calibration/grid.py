"""`calibrate`: does a sampler cover the truth as often as it says, over simulated evidence?

Simulation-based calibration (Talts et al. 2018) and expected coverage (Hermans et al. 2022; Lemos
et al. 2023), of any sampler on any problem that can be simulated.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar

from probmotion import seeds
from probmotion.calibration.ranks import ranks_of_truth
from probmotion.calibration.result import Calibration
from probmotion.comparison.results.budgets import Budget, check_budget
from probmotion.comparison.results.naming import (
    AnyProblem,
    AnySampler,
    named_problems,
    named_samplers,
)
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.run.cells import Cell
from probmotion.comparison.run.locks import locked
from probmotion.comparison.run.tasks import Grid, refuse_taken, run_grid
from probmotion.files import writable_folder
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.problem import Problem
from probmotion.problems.catalogue import load_problem
from probmotion.validation import check_count, check_positive

__all__ = ["calibrate"]

FEWEST_SIMULATIONS, _FEWEST_DRAWS = 10, 10
# Far from the simulations' own numbers: motions that have nothing to do with them.
_ELSEWHERE = 2**32


def calibrate(
    problems: AnyProblem | Iterable[AnyProblem] | Mapping[str, AnyProblem],
    samplers: AnySampler | Iterable[AnySampler] | Mapping[str, AnySampler] | None = None,
    *,
    simulations: int = 150,
    draws: int = 100,
    chains: int = 4,
    out: str | Path | None = None,
    workers: int = 1,
    executor: Executor | None = None,
    budget: Budget | None = None,
    time_limit: float | None = None,
    progress: bool = True,
) -> Calibration:
    """Simulate every problem, run every sampler on each simulation, and rank the truth.

    A simulation is a truth from the prior and evidence of it; where a sampler is right, the truth
    is to the draws as one draw more. Its rank by each of a few quantities is kept as soon as it is
    known, like a cell of :func:`~probmotion.comparison.compare` whose seed is the simulation's
    number: the same call after a run that was killed runs what is missing, and one with more
    simulations goes on. The draws are not kept.

    Parameters
    ----------
    problems, samplers
        As of :func:`~probmotion.comparison.compare`; each problem has ``simulate``.
    simulations : int
        Of each problem.
    draws : int
        Draws per simulation in all. Those of a chain are thinned to about independent ones.
    chains : int
        Chains that they are spread over.
    out : str or Path, optional
        Folder in which ``calibration`` will hold the ranks, ``table.csv`` and ``failures.json``;
        it may be a comparison's. A temporary one by default.
    workers, executor, time_limit, progress
        As of :func:`~probmotion.comparison.compare`.
    budget : Budget, optional
        What every sampler may spend on a simulation, as of
        :func:`~probmotion.comparison.compare`; the pilots run on the problem itself.

    Raises
    ------
    ValueError
        If a problem or sampler is unknown, a problem cannot be simulated, two have one name, a
        number is out of range, or ``out`` holds ranks of the same names that were made with other
        settings.
    OSError
        If ``out`` cannot be written to.
    KeyboardInterrupt
        At Ctrl-C; the message says how many simulations are finished and where.
    """
    check_count("simulations", simulations, least=FEWEST_SIMULATIONS)
    check_count("draws", draws, least=_FEWEST_DRAWS)
    check_count("chains", chains)
    check_count("workers", workers, least=0)
    if draws % chains:
        raise ValueError(f"draws must be a multiple of chains, {chains}, got {draws}")
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    check_budget(budget)
    chosen = named_problems(problems)
    used = named_samplers(samplers)
    for name, source in chosen.items():
        problem = load_problem(source) if isinstance(source, str) else source
        if problem.simulate is None:
            raise ValueError(
                f"problems has {name!r}, which cannot be simulated, expected a Problem with "
                "simulate; problems.problem.simulated() gives it one if its prior can be drawn from"
            )
    # Workers may stand in another folder.
    given = Path(tempfile.mkdtemp(prefix="probmotion-") if out is None else out).absolute()
    folder = writable_folder(given / Calibration.FOLDER)
    Plan.check_folder(folder)
    plan = Plan.of(chosen, used, draws, chains, simulations, budget, per="simulation")
    with locked(folder, chosen):
        grid = CalibrationGrid(folder, plan, chosen, used, budget, time_limit)
        refuse_taken(folder, [*grid.pilots(), *grid.cells()])
        plan.save(folder)
        run_grid(grid, workers, executor, progress, label="simulations")
        # A run of other problems in this folder may have left its own plan.
        plan.save(folder)
        calibration = Calibration(folder, plan, temporary=out is None)
        calibration.write()
    return calibration


class CalibrationGrid(Grid):
    """A comparison's grid, each seed the number of a simulation."""

    def _cell(self, problem: str, sampler: str, seed: int) -> CalibrationCell:
        cell = super()._cell(problem, sampler, seed)
        return CalibrationCell(**{field.name: getattr(cell, field.name) for field in fields(cell)})


@dataclass(frozen=True, eq=False)
class CalibrationCell(Cell):
    """One sampler on one simulation, whose number is ``seed``; its ranks are its metrics."""

    # Draws of hundreds of simulations fill a disk, and nothing more is asked of them.
    keeps_draws: ClassVar[bool] = False

    def _measured(self, problem: Problem, progress: bool) -> tuple[MotionDraws, dict[str, float]]:
        assert problem.simulate is not None
        simulation = problem.simulate(self.seed)
        draws = self._drawn(
            simulation.posterior,
            seeds.integer(self.seed, "calibration", self.problem, self.sampler),
            progress,
        )
        ranks = ranks_of_truth(
            problem,
            simulation,
            draws,
            problem.simulate(_ELSEWHERE + self.seed),
            seeds.integer(self.seed, "ranks", self.problem, self.sampler),
        )
        kept: dict[str, float] = {}
        for name, rank in ranks.items():
            kept |= {f"rank {name}": rank.value, f"draws {name}": float(rank.draws)}
        return draws, kept
