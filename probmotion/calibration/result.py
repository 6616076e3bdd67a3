"""Calibration results: ranks of simulated truths, stored in a folder."""

from __future__ import annotations

import json
import math
import shutil
import weakref
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import RunResult, read_result, used_of_budget
from probmotion.files import written_whole

if TYPE_CHECKING:
    import pandas as pd

    from probmotion.calibration.table import CalibrationRanks, CalibrationTable

__all__ = ["Calibration"]

_TABLE, _FAILURES, _FIGURE = "table.csv", "failures.json", "ranks.png"


class Calibration:
    """Ranks of simulated truths among the draws of every sampler on every problem.

    Parameters
    ----------
    folder : Path
        Folder of the runs; unfinished ones are skipped.
    plan : Plan
        Plan of the grid; its ``seeds`` is the number of simulations.
    temporary : bool
        Whether to delete the parent of ``folder`` when this object is garbage-collected.
    """

    # Subfolder of ``out`` in calibrate().
    FOLDER = "calibration"

    def __init__(self, folder: Path, plan: Plan, temporary: bool = False) -> None:
        self.folder = folder
        self.plan = plan
        results = [read_result(plan.run_folder(folder, *address)) for address in plan.runs()]
        self.results: list[RunResult] = [result for result in results if result is not None]
        if temporary:
            weakref.finalize(self, shutil.rmtree, folder.parent, True)

    @classmethod
    def load(cls, out: str | Path, temporary: bool = False) -> Calibration:
        """Return the calibration in a folder, possibly unfinished."""
        folder = Path(out) / cls.FOLDER
        return cls(folder, Plan.load(folder), temporary)

    @property
    def failures(self) -> list[RunResult]:
        """Runs without ranks: unsupported or failed."""
        return [result for result in self.results if result.failure is not None]

    def runs(self, problem: str, sampler: str) -> list[RunResult]:
        """Return the finished runs of a sampler on a problem, in the order of simulations."""
        for kind, name, names in (
            ("problem", problem, self.plan.problems),
            ("sampler", sampler, self.plan.samplers),
        ):
            if name not in names:
                raise ValueError(f"{kind} must be one of {', '.join(names)}, got {name!r}")
        pair = (problem, sampler)
        return [result for result in self.results if (result.problem, result.sampler) == pair]

    def ranks(self, problem: str, sampler: str) -> dict[str, np.ndarray]:
        """Return the ranks of the n successful simulations' truths in [0, 1] by quantity, (n,)."""
        return self._values(problem, sampler, "rank ")

    def ranked_among(self, problem: str, sampler: str) -> dict[str, np.ndarray]:
        """Return the number of draws compared with each truth, by quantity."""
        return self._values(problem, sampler, "draws ")

    def _values(self, problem: str, sampler: str, kind: str) -> dict[str, np.ndarray]:
        """Return the values of a kind by quantity, for quantities of all successful simulations."""
        rows = self._successful(problem, sampler)
        shared = [name for name in (rows[0] if rows else ()) if all(name in row for row in rows)]
        names = [name.removeprefix(kind) for name in shared if name.startswith(kind)]
        return {name: np.array([row[kind + name] for row in rows]) for name in names}

    def _successful(self, problem: str, sampler: str) -> list[dict[str, float]]:
        """Return the metrics of successful simulations."""
        return [run.metrics for run in self.runs(problem, sampler) if run.failure is None]

    def _partial(self, problem: str, sampler: str) -> list[str]:
        """Return the quantities that are missing in at least one successful simulation."""
        rows = self._successful(problem, sampler)
        names = {name for row in rows for name in row if name.startswith("rank ")}
        names = {name.removeprefix("rank ") for name in names}
        return sorted(names - set(self.ranks(problem, sampler)))

    @property
    def ranked(self) -> bool:
        """Whether any sampler has ranks to plot."""
        return bool(self._blocks(self.plan.problems))

    def _blocks(self, problems: Iterable[str]) -> dict[str, dict[str, np.ndarray]]:
        """Return the ranks of samplers with at least two ranked simulations, keyed by verdict."""
        blocks = {}
        for problem, sampler in product(problems, self.plan.samplers):
            ranks = self.ranks(problem, sampler)
            if any(len(values) > 1 for values in ranks.values()):
                blocks[self.verdict(problem, sampler)] = ranks
        return blocks

    @property
    def notes(self) -> list[str]:
        """Notes on budget, failures, unfinished simulations and thinning."""
        notes = [*self.plan.notes]
        pairs = list(product(self.plan.problems, self.plan.samplers))
        if used := used_of_budget(result for pair in pairs for result in self.runs(*pair)):
            notes.append(f"used per simulation: {', '.join(used)}")
        counted = Counter(
            f"{result.sampler} on {result.problem}: {result.failure.message}"
            for result in self.failures
            if result.failure is not None
        )
        for sentence, times in counted.items():
            notes.append(f"{sentence} ({times} of {self.plan.seeds} simulations)")
        for problem, sampler in pairs:
            where = f"{sampler} on {problem}"
            if (done := len(self.runs(problem, sampler))) < self.plan.seeds:
                notes.append(f"{where}: {done} of {self.plan.seeds} simulations finished")
            if partial := self._partial(problem, sampler):
                notes.append(f"{where}: {', '.join(partial)} skipped, not in all simulations")
            among = self.ranked_among(problem, sampler)
            fewest = min((float(np.median(sizes)) for sizes in among.values()), default=math.inf)
            if fewest < self.plan.draws:
                notes.append(
                    f"{where}: about {fewest:.0f} of {self.plan.draws} draws are independent for "
                    "the slowest quantity"
                )
        return notes

    def table(self) -> CalibrationTable:
        """Return a data frame with a row per problem, sampler and quantity, printed as a summary.

        The row "all" combines the quantities as stated in parentheses. ``p_value``: p-value of
        uniform ranks (smallest, Holm-adjusted); ``coverage_90``: coverage of 90 % credible sets
        (mean over central intervals); ``coverage_error``: mean abs(coverage − level) (mean);
        ``simulations`` and ``failed``: numbers of successful and failed simulations.
        """
        from probmotion.calibration.table import CalibrationTable

        pairs = product(self.plan.problems, self.plan.samplers)
        return CalibrationTable.of([self._ranked(*pair) for pair in pairs], self.notes)

    def coverage(self, problem: str, sampler: str) -> pd.DataFrame:
        """Return the coverage of credible sets by quantity and level.

        Columns: quantity, level, coverage and its 95 % interval, lower to upper. Credible sets are
        those of :func:`~probmotion.metrics.uniformity.credible_level`.
        """
        from probmotion.calibration.table import coverage_frame

        return coverage_frame(self.ranks(problem, sampler))

    def _ranked(self, problem: str, sampler: str) -> CalibrationRanks:
        from probmotion.calibration.table import CalibrationRanks

        runs = self.runs(problem, sampler)
        failures = [run.failure for run in runs if run.failure is not None]
        ranks = self.ranks(problem, sampler)
        return CalibrationRanks(problem, sampler, ranks, failures, len(runs), self.plan.seeds)

    def verdict(self, problem: str, sampler: str) -> str:
        """Return a one-sentence verdict on a sampler's calibration."""
        from probmotion.calibration.table import verdict

        return verdict(self._ranked(problem, sampler))

    def plot(self, path: str | Path | None = None, problem: str | None = None) -> Path:
        """Plot ranks and coverage of one or all problems, one block per sampler; return the path.

        The path ends in .png, .pdf or .svg. Raises ``ValueError`` if the problem is unknown or
        there are no ranks.
        """
        from probmotion.plots.ranks import draw_ranks

        target = self.folder / _FIGURE if path is None else Path(path)
        draw_ranks(self._blocks(self.plan.problems if problem is None else [problem]), target)
        return target

    def write(self) -> None:
        """Write ``table.csv`` and ``failures.json`` to the folder."""
        with written_whole(self.folder / _TABLE) as unfinished:
            self.table().to_csv(unfinished, index=False)
        failures = [
            {"problem": result.problem, "sampler": result.sampler, "simulation": result.seed}
            | asdict(result.failure)
            for result in self.failures
            if result.failure is not None
        ]
        with written_whole(self.folder / _FAILURES) as unfinished:
            unfinished.write_text(json.dumps(failures, indent=1), encoding="utf-8")

    def __repr__(self) -> str:
        return str(self.table())
