"""`Calibration`: the ranks of simulated truths, in a folder, and what they say."""

from __future__ import annotations

import json
import math
import shutil
import weakref
from collections.abc import Iterable
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from probmotion.comparison.results.cell_results import CellResult, read_result, used_of_budget
from probmotion.comparison.results.plan import Plan
from probmotion.files import written_whole

if TYPE_CHECKING:
    import pandas as pd

    from probmotion.calibration.table import CalibrationTable, Ranked

__all__ = ["Calibration"]

_TABLE, _FAILURES, _PICTURE = "table.csv", "failures.json", "ranks.png"


class Calibration:
    """Where simulated truths stand among the draws of every sampler, on every problem.

    Parameters
    ----------
    folder : Path
        Where the cells are.
    plan : Plan
        What was asked for; its ``seeds`` are simulations. Those not finished are left out.
    temporary : bool
        Remove the folder with this object.
    """

    FOLDER = "calibration"
    """Below what :func:`~probmotion.calibration.grid.calibrate` was given."""

    def __init__(self, folder: Path, plan: Plan, temporary: bool = False) -> None:
        self.folder = folder
        self.plan = plan
        found = [read_result(plan.cell_folder(folder, *address)) for address in plan.cells()]
        self.results: list[CellResult] = [result for result in found if result is not None]
        if temporary:
            weakref.finalize(self, shutil.rmtree, folder.parent, True)

    @classmethod
    def load(cls, out: str | Path, temporary: bool = False) -> Calibration:
        """Return the calibration in a folder, as far as it is finished.

        Raises
        ------
        ValueError
            If the folder is none that :func:`~probmotion.calibration.grid.calibrate` wrote.
        """
        folder = Path(out) / cls.FOLDER
        return cls(folder, Plan.load(folder), temporary)

    @property
    def failures(self) -> list[CellResult]:
        """The simulations without ranks: samplers that do not fit a problem, or failed on it."""
        return [result for result in self.results if result.failure is not None]

    def cells(self, problem: str, sampler: str) -> list[CellResult]:
        """Return what is finished of a sampler on a problem, in the order of simulations.

        Raises
        ------
        ValueError
            If one of the names is unknown; the message lists the known ones.
        """
        for what, name, known in (
            ("problem", problem, self.plan.problems),
            ("sampler", sampler, self.plan.samplers),
        ):
            if name not in known:
                raise ValueError(f"{what} must be one of {', '.join(known)}, got {name!r}")
        return [
            result
            for result in self.results
            if (result.problem, result.sampler) == (problem, sampler)
        ]

    def ranks(self, problem: str, sampler: str) -> dict[str, np.ndarray]:
        """Return the truth's ranks in [0, 1] by quantity, (n,), one per simulation that worked."""
        return self._kept(problem, sampler, "rank ")

    def ranked_among(self, problem: str, sampler: str) -> dict[str, np.ndarray]:
        """Return by quantity among how many draws, about independent, each truth was ranked."""
        return self._kept(problem, sampler, "draws ")

    def _kept(self, problem: str, sampler: str, kind: str) -> dict[str, np.ndarray]:
        worked = [cell.metrics for cell in self.cells(problem, sampler) if cell.failure is None]
        # Where a caller's own simulations differ in kind, what all of them have can be judged.
        names = [
            name
            for name in (worked[0] if worked else ())
            if name.startswith(kind) and all(name in metrics for metrics in worked)
        ]
        return {
            name.removeprefix(kind): np.array([metrics[name] for metrics in worked])
            for name in names
        }

    def _of_some(self, problem: str, sampler: str) -> list[str]:
        """Return the quantities that some simulations have and others have not."""
        cells = self.cells(problem, sampler)
        worked = [cell.metrics for cell in cells if cell.failure is None]
        names = {name for metrics in worked for name in metrics if name.startswith("rank ")}
        some = [name for name in names if not all(name in metrics for metrics in worked)]
        return sorted(name.removeprefix("rank ") for name in some)

    @property
    def ranked(self) -> bool:
        """Whether any sampler has ranks to draw."""
        return bool(self._blocks(self.plan.problems))

    def _blocks(self, problems: Iterable[str]) -> dict[str, dict[str, np.ndarray]]:
        """Return the ranks of every sampler that has more than one, by its verdict."""
        found = {}
        for problem, sampler in product(problems, self.plan.samplers):
            ranks = self.ranks(problem, sampler)
            if any(len(values) > 1 for values in ranks.values()):
                found[self.verdict(problem, sampler)] = ranks
        return found

    @property
    def notes(self) -> list[str]:
        """Sentences to read with the table: budget, failures, simulations, and thinning."""
        notes = [*self.plan.notes]
        places = product(self.plan.problems, self.plan.samplers)
        if used := used_of_budget(result for place in places for result in self.cells(*place)):
            notes.append(f"used per simulation: {', '.join(used)}")
        counted: dict[str, int] = {}
        for result in self.failures:
            assert result.failure is not None
            sentence = f"{result.sampler} on {result.problem}: {result.failure.message}"
            counted[sentence] = counted.get(sentence, 0) + 1
        for sentence, times in counted.items():
            notes.append(f"{sentence} ({times} of {self.plan.seeds} simulations)")
        for problem in self.plan.problems:
            for sampler in self.plan.samplers:
                if (done := len(self.cells(problem, sampler))) < self.plan.seeds:
                    notes.append(
                        f"{sampler} on {problem}: {done} of {self.plan.seeds} simulations are "
                        "finished"
                    )
                if only := self._of_some(problem, sampler):
                    notes.append(
                        f"{sampler} on {problem}: {', '.join(only)} is left out, which not all "
                        "simulations have"
                    )
                among = self.ranked_among(problem, sampler)
                fewest = min(
                    (float(np.median(sizes)) for sizes in among.values()), default=math.inf
                )
                if fewest < self.plan.draws:
                    notes.append(
                        f"{sampler} on {problem}: of {self.plan.draws} draws about {fewest:.0f} "
                        "are independent for the quantity that moves slowest; ranks are among those"
                    )
        return notes

    def table(self) -> CalibrationTable:
        """Return the tidy data frame, a row per problem, sampler and quantity.

        ``quantity`` "all" is the sampler as a whole. Columns: ``p_value`` that ranks are uniform
        (all: the least of those adjusted by Holm's method), ``coverage_90`` of 90 % credible sets
        (all: mean over quantities whose sets are central intervals), ``coverage_error`` mean
        |coverage − level| (all: mean over quantities), ``simulations`` that worked and ``failed``
        ones. It prints a line per sampler and its verdict.
        """
        from probmotion.calibration.table import CalibrationTable

        places = product(self.plan.problems, self.plan.samplers)
        return CalibrationTable.of([self._ranked(*place) for place in places], self.notes)

    def coverage(self, problem: str, sampler: str) -> pd.DataFrame:
        """Return by quantity and level the share of truths that credible sets hold.

        Columns quantity, level, coverage, and ``lower``, ``upper``, a 95 % interval of it. Sets of
        the log density are those of highest density, of the distance balls about random motions
        (TARP), of other quantities central intervals.
        """
        from probmotion.calibration.table import coverage_frame

        return coverage_frame(self.ranks(problem, sampler))

    def _ranked(self, problem: str, sampler: str) -> Ranked:
        from probmotion.calibration.table import Ranked

        cells = self.cells(problem, sampler)
        failures = [cell.failure for cell in cells if cell.failure is not None]
        ranks = self.ranks(problem, sampler)
        return Ranked(problem, sampler, ranks, failures, len(cells), self.plan.seeds)

    def verdict(self, problem: str, sampler: str) -> str:
        """Return in one sentence whether a sampler is calibrated, and how it is not."""
        from probmotion.calibration.table import verdict

        return verdict(self._ranked(problem, sampler))

    def plot(self, path: str | Path | None = None, problem: str | None = None) -> Path:
        """Draw ranks and coverage and return where; beside the cells by default.

        A block per sampler, of one problem or of all of them.

        Raises
        ------
        ValueError
            If the problem is unknown, or nothing was ranked.
        """
        from probmotion.plots.ranks import draw_ranks

        target = self.folder / _PICTURE if path is None else Path(path)
        draw_ranks(self._blocks(self.plan.problems if problem is None else [problem]), target)
        return target

    def write(self) -> None:
        """Write ``table.csv`` and ``failures.json`` beside the cells."""
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
