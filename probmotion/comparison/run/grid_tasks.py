"""Tasks of a grid: one sampler on one problem, with its inputs and its stored result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from probmotion.comparison.results.budgets import Budget
from probmotion.comparison.results.failures import Failure
from probmotion.comparison.results.run_results import RunResult
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem

__all__ = ["GridTask", "PilotResult"]


@dataclass(frozen=True)
class PilotResult:
    """Settings with which a sampler spends a budget, or the failure to find them.

    ``settings`` are empty if the sampler has no effort setting.
    """

    fingerprint: str
    settings: dict[str, int]
    failure: Failure | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class GridTask:
    """One sampler on one problem; ``problem`` and ``sampler`` select the random numbers.

    ``path`` is the file or folder of the result, ``source`` the problem or the registered name to
    load it by in a worker, and ``limit`` the time limit in seconds after loading.
    """

    path: Path
    problem: str
    sampler: str
    source: str | Problem
    with_sampler: Sampler
    draws: int
    chains: int
    fingerprint: str
    limit: float | None = None
    budget: Budget | None = None

    def result(self) -> RunResult | PilotResult | None:
        """Return the stored result, possibly for other inputs, or None."""
        raise NotImplementedError

    def has_result(self) -> bool:
        """Whether a result or failure for the same inputs is stored."""
        result = self.result()
        return result is not None and result.fingerprint == self.fingerprint

    def finished(self) -> bool:
        """Whether a result for the same inputs is stored that need not be retried."""
        result = self.result()
        if result is None or result.fingerprint != self.fingerprint:
            return False
        return result.failure is None or result.failure.unsupported

    def conflicts(self) -> bool:
        """Whether a result for other inputs is stored, which must not be replaced."""
        result = self.result()
        return (
            result is not None and result.failure is None and result.fingerprint != self.fingerprint
        )

    def run(self, progress: bool) -> None:
        """Run and store the result or the failure."""
        raise NotImplementedError

    def fail(self, error: BaseException) -> None:
        """Store a failure."""
        raise NotImplementedError

    def load(self) -> Problem:
        """Return the problem."""
        return load_problem(self.source) if isinstance(self.source, str) else self.source

    def prepare(self) -> None:
        """Load everything that the time limit does not cover."""
        self.load()
