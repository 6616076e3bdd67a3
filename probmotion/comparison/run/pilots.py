"""A pilot: finds, once per problem and sampler, the settings that spend a budget, and keeps them.

Cells of all seeds use the same settings, and a later run those that were found by the first.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from probmotion import seeds
from probmotion.comparison.results.budgets import Budget, affordable
from probmotion.comparison.results.failures import CellNotKept, Failure
from probmotion.comparison.run.time_limits import time_limit
from probmotion.files import written_whole
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem
from probmotion.threads import one_thread

__all__ = ["Found", "Pilot"]


@dataclass(frozen=True)
class Found:
    """What a pilot found.

    Parameters
    ----------
    fingerprint : str
        Digest of the question.
    settings : dict of int
        The settings that spend the budget; none where the sampler has no such setting.
    failure : Failure, optional
        Why there are none.
    """

    fingerprint: str
    settings: dict[str, int]
    failure: Failure | None = None


@dataclass(frozen=True, eq=False)
class Pilot:
    """One task of a grid with a budget, before the cells.

    Parameters
    ----------
    path : Path
        Where what it finds is kept.
    problem, sampler : str
        What the table calls them.
    source : str or Problem
        The problem, or the registered name to load it by.
    with_sampler : Sampler
        The sampler as it was asked for.
    draws, chains : int
        Of a cell.
    budget : Budget
        Of a cell.
    limit : float, optional
        Seconds that the pilot may take.
    fingerprint : str
        Digest of all that decides the result.
    """

    path: Path
    problem: str
    sampler: str
    source: str | Problem
    with_sampler: Sampler
    draws: int
    chains: int
    budget: Budget
    limit: float | None
    fingerprint: str

    def __str__(self) -> str:
        return f"{self.problem}/{self.sampler}"

    def found(self) -> Found | None:
        """Return what was found before, of this question or another, or None."""
        try:
            held = json.loads(self.path.read_text(encoding="utf-8"))
            failure = held.pop("failure")
            return Found(**held, failure=None if failure is None else Failure(**failure))
        except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
            return None

    def answered(self) -> bool:
        """Whether what was found is of this question."""
        found = self.found()
        return found is not None and found.fingerprint == self.fingerprint

    def finished(self) -> bool:
        """Whether the answer is there, and no accident."""
        found = self.found()
        if found is None or not self.answered():
            return False
        return found.failure is None or found.failure.unsupported

    def taken(self) -> bool:
        """Whether the answer to another question is there, which it must not replace."""
        found = self.found()
        return found is not None and found.failure is None and found.fingerprint != self.fingerprint

    def prepare(self) -> None:
        """Load what it needs."""
        if isinstance(self.source, str):
            load_problem(self.source)

    def fail(self, error: BaseException) -> None:
        """Keep an error as the answer."""
        self._keep(Found(self.fingerprint, {}, Failure.of(error)))

    def run(self, progress: bool) -> None:
        """Find the settings and keep them."""
        try:
            with one_thread():
                problem = load_problem(self.source) if isinstance(self.source, str) else self.source
                with time_limit(self.limit):
                    settings = affordable(
                        self.budget,
                        self.with_sampler,
                        lambda sampler: self._spend(problem, sampler),
                    )
        except (Exception, SystemExit) as error:
            self.fail(error)
        else:
            self._keep(Found(self.fingerprint, settings))

    def _spend(self, problem: Problem, sampler: Sampler) -> float:
        drawn = sampler.sample(
            problem.posterior,
            draws=self.draws // self.chains,
            chains=self.chains,
            seed=seeds.integer(0, "pilot", self.problem, self.sampler),
            progress=False,
        )
        return self.budget.spent(drawn)

    def _keep(self, found: Found) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(self.path) as unfinished:
                unfinished.write_text(json.dumps(asdict(found), indent=1), encoding="utf-8")
        except OSError as error:
            raise CellNotKept(str(error)) from error
