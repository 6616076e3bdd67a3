"""Calibration of samplers on simulated observations.

Computes simulation-based calibration (Talts et al. 2018) and expected coverage (Hermans et al.
2022; Lemos et al. 2023) of any sampler on any problem that can be simulated.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from probmotion import seeds
from probmotion.calibration.ranks import ranks_of_truth
from probmotion.calibration.result import Calibration
from probmotion.comparison.results.budgets import Budget
from probmotion.comparison.results.naming import (
    AnyProblem,
    AnySampler,
    named_problems,
    named_samplers,
)
from probmotion.comparison.results.plan import Plan
from probmotion.comparison.run.grid_runs import GridRun
from probmotion.comparison.run.locks import locked, plan_locked
from probmotion.comparison.run.tasks import (
    Grid,
    check_grid_options,
    refuse_other_settings,
    run_grid,
)
from probmotion.files import writable_folder
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.problem import Problem
from probmotion.problems.catalogue import load_problem
from probmotion.validation import check_count

__all__ = ["calibrate"]

FEWEST_SIMULATIONS = 10
# Offset from a simulation's number to that of another one, whose truth is its reference point.
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

    A simulation is a truth from the prior and observations of it. If a sampler is correct, the
    truth is exchangeable with its draws. Each simulation is stored as a run of
    :func:`~probmotion.comparison.compare`, with ranks instead of draws and its number as seed.
    Repeat the call to resume an interrupted calibration; increase ``simulations`` to extend it.

    Parameters
    ----------
    problems, samplers
        As for :func:`~probmotion.comparison.compare`; problems must define ``simulate``,
        posteriors must have a prior that can be sampled, and finished draws are not accepted.
    simulations : int
        Number of simulations per problem, at least 10.
    draws : int
        Total number of draws per simulation; correlated draws are thinned.
    chains : int
        Number of chains.
    out : str or Path, optional
        Parent of the folder ``calibration`` with ranks, ``table.csv`` and ``failures.json``; may be
        the folder of a comparison. Temporary by default.
    workers, executor, time_limit, progress
        As for :func:`~probmotion.comparison.compare`.
    budget : Budget, optional
        Budget of each sampler per simulation; pilots sample the problem, not a simulation.

    Raises
    ------
    ValueError
        If an argument is invalid, a problem cannot be simulated, or ``out`` contains ranks of the
        same problems and samplers with other settings.
    OSError
        If ``out`` is not writable.
    KeyboardInterrupt
        On Ctrl-C; the message reports finished simulations and their folder.
    """
    check_count("simulations", simulations, least=FEWEST_SIMULATIONS)
    check_grid_options(draws, chains, workers, budget, time_limit)
    chosen = named_problems(problems)
    used = named_samplers(samplers)
    for name, sampler in used.items():
        if getattr(sampler, "finished", False):
            raise ValueError(f"samplers must sample every simulation, got finished draws, {name}")
    for name, source in chosen.items():
        problem = load_problem(source) if isinstance(source, str) else source
        if problem.simulate is None:
            raise ValueError(
                f"problems must have simulate, got {name!r} without it; define it with "
                "posteriors.problem.simulated() if the prior can be sampled"
            )
    # Workers may have another working directory.
    parent = Path(tempfile.mkdtemp(prefix="probmotion-") if out is None else out).absolute()
    folder = writable_folder(parent / Calibration.FOLDER)
    plan = Plan.of(chosen, used, draws, chains, simulations, budget, per="simulation")
    plan.union(folder)  # raises before anything is written
    with locked(folder, chosen):
        grid = CalibrationGrid(folder, plan, chosen, used, budget, time_limit)
        refuse_other_settings(folder, [*grid.pilots(), *grid.runs()])
        with plan_locked(folder):
            plan.union(folder).save(folder)
        run_grid(grid, workers, executor, progress, label="simulations")
        # Grids of other problems may have extended the plan.
        with plan_locked(folder):
            calibration = Calibration(folder, Plan.load(folder), temporary=out is None)
            calibration.write()
    return calibration


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibrationRun(GridRun):
    """Run of one sampler on simulation number ``seed``; its metrics are the ranks."""

    stores_draws: ClassVar[bool] = False

    def _measure(self, problem: Problem) -> tuple[MotionDraws, dict[str, float], None]:
        assert problem.simulate is not None
        simulation = problem.simulate(self.seed)
        draws = self._draw(
            simulation.posterior,
            seeds.integer(self.seed, "calibration", self.problem, self.sampler),
        )
        ranks = ranks_of_truth(
            problem,
            simulation,
            draws,
            problem.simulate(_ELSEWHERE + self.seed),
            seeds.integer(self.seed, "ranks", self.problem, self.sampler),
        )
        values: dict[str, float] = {}
        for name, rank in ranks.items():
            values |= {f"rank {name}": rank.value, f"draws {name}": float(rank.draws)}
        return draws, values, None


class CalibrationGrid(Grid):
    """Grid with one run per simulation instead of per seed."""

    run_class: ClassVar[type[GridRun]] = CalibrationRun
