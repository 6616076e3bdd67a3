"""`GridResults`: the stored results of an experiment grid."""

from __future__ import annotations

import json
import shutil
import weakref
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Self

from probmotion.comparison.results.cell_results import (
    CellResult,
    read_draws,
    read_result,
    used_of_budget,
)
from probmotion.comparison.results.plan import Plan
from probmotion.files import written_whole
from probmotion.posteriors.draws import MotionDraws

if TYPE_CHECKING:
    from probmotion.comparison.results.table import ComparisonTable

__all__ = ["GridResults"]

_TABLE, _FAILURES = "table.csv", "failures.json"
_PROBLEMS, _PILOTS = "problems", "pilots"


class GridResults:
    """What every sampler drew on every problem, and what was measured of it.

    Parameters
    ----------
    folder : Path
        Where the cells are.
    plan : Plan
        The grid; cells that are not finished are left out.
    temporary : bool
        Remove the folder with this object.
    """

    def __init__(self, folder: Path, plan: Plan, temporary: bool = False) -> None:
        self.folder = folder
        self.plan = plan
        found = [read_result(plan.cell_folder(folder, *address)) for address in plan.cells()]
        self.results: list[CellResult] = [result for result in found if result is not None]
        if temporary:
            weakref.finalize(self, shutil.rmtree, folder, True)

    @classmethod
    def load(cls, folder: str | Path, temporary: bool = False) -> Self:
        """Return the comparison in a folder, as far as it is finished.

        Raises
        ------
        ValueError
            If the folder is none that :func:`~probmotion.comparison.compare` wrote.
        """
        return cls(Path(folder), Plan.load(Path(folder)), temporary)

    @property
    def failures(self) -> list[CellResult]:
        """The cells without draws: samplers that do not fit a problem, or that failed on it."""
        return [result for result in self.results if result.failure is not None]

    @property
    def notes(self) -> list[str]:
        """Sentences to read with the table: budget, long runs, settings not defaults, failures."""
        notes = [*self.plan.notes, *self.plan.references]
        if used := used_of_budget(self.results):
            notes.append(
                f"used per cell (budget_used; set_…: settings that it bought): {', '.join(used)}"
            )
        bought = {
            (result.sampler, name)
            for result in self.results
            for name in (result.budget or {}).get("settings") or {}
        }
        for sampler, given in self.plan.samplers.items():
            # What a budget has bought stands in the table.
            settings = {
                name: value for name, value in given.items() if (sampler, name) not in bought
            }
            if settings:
                listed = ", ".join(f"{name}={value}" for name, value in settings.items())
                notes.append(f"{sampler} ran with {listed}; its other settings are its defaults")
        seeds: dict[str, list[int]] = {}
        for result in self.failures:
            assert result.failure is not None
            where = f"{result.sampler} on {result.problem}"
            seeds.setdefault(f"{where}: {result.failure.message}", []).append(result.seed)
        for sentence, failed in seeds.items():
            # Where some seeds worked, the table shows a mean of fewer than it seems.
            some = f" (seeds {', '.join(map(str, failed))} of {self.plan.seeds})"
            notes.append(sentence + (some if len(failed) < self.plan.seeds else ""))
        return notes

    def table(self) -> ComparisonTable:
        """Return the tidy data frame: columns problem, sampler, seed, metric, value.

        It prints as mean ± standard deviation over seeds, a block per problem. A cell without
        draws has the one metric ``unsupported`` or ``failed``, 1.
        """
        from probmotion.comparison.results.table import ComparisonTable

        rows: list[tuple[str, str, int, str, float]] = []
        words: dict[tuple[str, str], str] = {}
        for result in self.results:
            metrics = result.metrics
            if result.failure is not None:
                words[result.problem, result.sampler] = result.failure.word
                metrics = {"unsupported" if result.failure.unsupported else "failed": 1.0}
            address = (result.problem, result.sampler, result.seed)
            rows += [(*address, name, float(value)) for name, value in metrics.items()]
        table = ComparisonTable(rows, columns=["problem", "sampler", "seed", "metric", "value"])
        table.attrs = {
            "problems": self.plan.problems,
            "words": {f"{problem}/{sampler}": word for (problem, sampler), word in words.items()},
            "notes": self.notes,
            "draws": self.plan.draws,
        }
        return table

    def draws(self, problem: str, sampler: str, seed: int = 0) -> MotionDraws:
        """Return the draws of one cell.

        Raises
        ------
        ValueError
            If there is no such cell, or it failed; the message says which there are, or why.
        """
        for result in self.results:
            if (result.problem, result.sampler, result.seed) == (problem, sampler, seed):
                if result.failure is not None:
                    raise ValueError(
                        f"{sampler} has no draws of {problem}: {result.failure.message}"
                    )
                return read_draws(self.plan.cell_folder(self.folder, problem, sampler, seed))
        raise ValueError(
            f"there is no cell of problem {problem!r}, sampler {sampler!r}, seed {seed!r}; "
            f"expected one of {', '.join(self.plan.problems)}, of "
            f"{', '.join(self.plan.samplers)}, and a seed below {self.plan.seeds}"
        )

    def write(self, folder: str | Path) -> None:
        """Write ``table.csv`` and ``failures.json``; into another folder, the cells as well."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        if folder.resolve() != self.folder.resolve():
            for result in self.results:
                address = (result.problem, result.sampler, result.seed)
                shutil.copytree(
                    self.plan.cell_folder(self.folder, *address),
                    self.plan.cell_folder(folder, *address),
                    dirs_exist_ok=True,
                )
            for problem in self.plan.problems:
                for kept in (Path(_PROBLEMS) / problem, Path(_PILOTS) / problem):
                    if (self.folder / kept).exists():
                        shutil.copytree(self.folder / kept, folder / kept, dirs_exist_ok=True)
            self.plan.save(folder)
        with written_whole(folder / _TABLE) as unfinished:
            self.table().to_csv(unfinished, index=False)
        failures = [
            {"problem": result.problem, "sampler": result.sampler, "seed": result.seed}
            | asdict(result.failure)
            for result in self.failures
            if result.failure is not None
        ]
        with written_whole(folder / _FAILURES) as unfinished:
            unfinished.write_text(json.dumps(failures, indent=1), encoding="utf-8")

    def __repr__(self) -> str:
        return str(self.table())
