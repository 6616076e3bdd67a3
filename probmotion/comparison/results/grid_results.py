"""Stored results of an experiment grid: table, draws and failures."""

from __future__ import annotations

import json
import shutil
import weakref
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Self

from probmotion.comparison.results.plan import Plan
from probmotion.comparison.results.run_results import (
    RESULT,
    RunResult,
    read_draws,
    read_result,
    used_of_budget,
)
from probmotion.comparison.results.summary import summary, verdict_text
from probmotion.files import writable_folder, written_whole
from probmotion.metrics.run_statistics import DrawStatistics
from probmotion.metrics.verdict import Verdict, judge
from probmotion.posteriors.draws import MotionDraws

if TYPE_CHECKING:
    from probmotion.comparison.results.table import ComparisonTable

__all__ = ["GridResults"]

_TABLE, _TEXT, _FAILURES = "table.csv", "table.txt", "failures.json"


class GridResults:
    """Results of an experiment grid: draws and metrics of every sampler on every problem.

    Parameters
    ----------
    folder : Path
        Folder of the grid.
    plan : Plan
        Plan of the grid; unfinished runs are omitted.
    temporary : bool
        Whether to delete the folder when this object is garbage-collected.
    """

    def __init__(self, folder: Path, plan: Plan, temporary: bool = False) -> None:
        self.folder = folder
        self.plan = plan
        results = [read_result(plan.run_folder(folder, *address)) for address in plan.runs()]
        self.results: list[RunResult] = [result for result in results if result is not None]
        if temporary:
            weakref.finalize(self, shutil.rmtree, folder, True)

    @classmethod
    def load(cls, folder: str | Path) -> Self:
        """Return the results in a folder; the grid may be unfinished.

        Raises
        ------
        ValueError
            If :func:`~probmotion.comparison.compare` did not write the folder.
        """
        return cls(Path(folder), Plan.load(Path(folder)))

    @property
    def failures(self) -> list[RunResult]:
        """Runs without draws, because the sampler failed or does not support the problem."""
        return [result for result in self.results if result.failure is not None]

    @property
    def notes(self) -> list[str]:
        """Notes below the table: budget, long reference runs, changed settings and failures."""
        notes = [*self.plan.notes, *self.plan.references]
        if used := used_of_budget(self.results):
            notes.append(
                "used per run (budget_used; set_…: settings chosen for the budget): "
                + ", ".join(used)
            )
        chosen = {
            (result.sampler, name)
            for result in self.results
            for name in (result.budget or {}).get("settings") or {}
        }
        for sampler, given in self.plan.samplers.items():
            settings = [
                f"{name}={value}" for name, value in given.items() if (sampler, name) not in chosen
            ]
            if settings:
                notes.append(f"{sampler} ran with {', '.join(settings)} and defaults otherwise")
        seeds: dict[str, list[int]] = {}
        for result in self.failures:
            assert result.failure is not None
            where = f"{result.sampler} on {result.problem}"
            seeds.setdefault(f"{where}: {result.failure.message}", []).append(result.seed)
        for sentence, failed in seeds.items():
            # The table averages over the other seeds.
            failed_seeds = f" (seeds {', '.join(map(str, failed))} of {self.plan.seeds})"
            notes.append(sentence + (failed_seeds if len(failed) < self.plan.seeds else ""))
        return notes

    def table(self) -> ComparisonTable:
        """Return the tidy data frame with columns problem, sampler, seed, metric, value.

        A run without draws has a single metric, ``unsupported`` or ``failed``, equal to 1.
        The table prints verdicts and mean ± standard deviation over seeds, with one block per
        problem.
        """
        from probmotion.comparison.results.table import ComparisonTable

        rows: list[tuple[str, str, int, str, float]] = []
        words: dict[str, str] = {}
        for result in self.results:
            metrics = result.metrics
            if result.failure is not None:
                words[f"{result.problem}/{result.sampler}"] = result.failure.word
                metrics = {"unsupported" if result.failure.unsupported else "failed": 1.0}
            address = (result.problem, result.sampler, result.seed)
            rows += [(*address, name, float(value)) for name, value in metrics.items()]
        table = ComparisonTable(rows, columns=["problem", "sampler", "seed", "metric", "value"])
        table.attrs = {
            "problems": self.plan.problems,
            "samplers": list(self.plan.samplers),
            "words": words,
            "verdicts": {
                problem: {
                    sampler: (
                        verdict_text(self, problem, sampler),
                        "" if verdict.word == "failed" else verdict.sentence,
                    )
                    for sampler, verdict in row.items()
                }
                for problem, row in self.verdicts().items()
            },
            "notes": self.notes,
            "draws": self.plan.draws,
        }
        return table

    def verdict(self, problem: str, sampler: str) -> Verdict | None:
        """Return the verdict on a sampler, over all seeds; None without reference draws.

        A sampler without draws in some seed has the word ``failed`` and the reason.
        """
        return self._verdicts.get((problem, sampler))

    def verdicts(self) -> dict[str, dict[str, Verdict]]:
        """Return the verdicts by problem and sampler."""
        return {
            problem: {
                sampler: self._verdicts[problem, sampler]
                for sampler in self.plan.samplers
                if (problem, sampler) in self._verdicts
            }
            for problem in self.plan.problems
        }

    @cached_property
    def _verdicts(self) -> dict[tuple[str, str], Verdict]:
        """Verdicts by problem and sampler."""
        runs: dict[tuple[str, str], list[RunResult]] = {}
        for run in self.results:
            runs.setdefault((run.problem, run.sampler), []).append(run)
        verdicts = {}
        for address, each in runs.items():
            failures = [run.failure for run in each if run.failure is not None]
            statistics = [DrawStatistics(**run.statistics) for run in each if run.statistics]
            if failures:
                verdicts[address] = Verdict("failed", f"failed: {failures[0].message}", 0)
            elif statistics:
                verdicts[address] = judge(statistics)
        return verdicts

    def summary(self) -> str:
        """Return a sentence per problem and a table of verdicts, as text of 100 columns."""
        return summary(self)

    def draws(self, problem: str, sampler: str, seed: int = 0) -> MotionDraws:
        """Return the draws of one run.

        Raises
        ------
        ValueError
            If the run does not exist or failed.
        """
        for result in self.results:
            if (result.problem, result.sampler, result.seed) == (problem, sampler, seed):
                if result.failure is not None:
                    raise ValueError(
                        f"{sampler} has no draws of {problem}: {result.failure.message}"
                    )
                return read_draws(self.plan.run_folder(self.folder, problem, sampler, seed))
        raise ValueError(
            f"the run must exist, got problem {problem!r}, sampler {sampler!r}, seed {seed!r}; "
            f"problem must be one of {', '.join(self.plan.problems)}, sampler one of "
            f"{', '.join(self.plan.samplers)}, and seed below {self.plan.seeds}"
        )

    def write(self, folder: str | Path) -> None:
        """Write ``table.csv``, ``table.txt`` with legends and notes, and ``failures.json``.

        Runs are copied if ``folder`` is another one.
        """
        folder = writable_folder(Path(folder), "folder")
        if folder.resolve() != self.folder.resolve():
            copied = [
                self.plan.run_folder(Path(), result.problem, result.sampler, result.seed)
                for result in self.results
            ]
            copied += [
                Path(kind) / name for kind in ("problems", "pilots") for name in self.plan.problems
            ]
            for part in copied:
                _copy(self.folder / part, folder / part)
            self.plan.save(folder)
        table = self.table()
        with written_whole(folder / _TABLE) as unfinished:
            table.to_csv(unfinished, index=False)
        with written_whole(folder / _TEXT) as unfinished:
            unfinished.write_text(f"{table}\n", encoding="utf-8")
        failures = [
            {"problem": result.problem, "sampler": result.sampler, "seed": result.seed}
            | asdict(result.failure)
            for result in self.failures
            if result.failure is not None
        ]
        with written_whole(folder / _FAILURES) as unfinished:
            unfinished.write_text(json.dumps(failures, indent=1), encoding="utf-8")

    def __repr__(self) -> str:
        return self.summary()


def _copy(source: Path, target: Path) -> None:
    """Copy the files of a folder that may not exist, each atomically, and ``run.json`` last."""
    for path in sorted(source.rglob("[!.]*"), key=lambda path: path.name == RESULT):
        if path.is_file():
            copy = target / path.relative_to(source)
            writable_folder(copy.parent, "folder")
            with written_whole(copy) as unfinished:
                shutil.copyfile(path, unfinished)
