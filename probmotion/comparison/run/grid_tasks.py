"""Tasks of an experiment grid: base class, and pilots that choose sampler settings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from probmotion import seeds
from probmotion.comparison.results.budgets import Budget, affordable
from probmotion.comparison.results.failures import Failure, ResultNotWritten, read_failure
from probmotion.comparison.results.run_results import RunResult
from probmotion.comparison.run.time_limits import time_limit
from probmotion.files import read_json, write_json
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem
from probmotion.threads import one_thread
from probmotion.validation import check_types

__all__ = ["GridTask", "Pilot", "PilotResult"]


@dataclass(frozen=True)
class PilotResult:
    """Result of a pilot: sampler settings that fit the budget, or the failure.

    ``settings`` is empty after a failure and if the sampler has no effort setting.
    """

    fingerprint: str
    settings: dict[str, int]
    failure: Failure | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class GridTask:
    """Task that runs one sampler on one problem, with seeds derived from their names.

    ``path`` is the file or folder of the result, ``source`` the problem or its registered name,
    ``with_sampler`` the sampler, and ``limit`` the time limit in seconds after loading.
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
        """Return the stored result, which may belong to other inputs, or None."""
        raise NotImplementedError

    def has_result(self) -> bool:
        """Whether a result or failure for the same inputs is stored."""
        result = self.result()
        return result is not None and result.fingerprint == self.fingerprint

    def finished(self) -> bool:
        """Whether a result for the same inputs is stored and needs no retry."""
        result = self.result()
        if result is None or not self.has_result():
            return False
        return result.failure is None or result.failure.unsupported

    def conflicts(self) -> bool:
        """Whether a result for other inputs is stored, which must not be replaced."""
        result = self.result()
        return result is not None and result.failure is None and not self.has_result()

    def run(self) -> None:
        """Run and store the result or the failure."""
        raise NotImplementedError

    def fail(self, error: BaseException) -> None:
        """Store an error as the failure of the task."""
        raise NotImplementedError

    def load(self) -> Problem:
        """Return the problem; load it if ``source`` is a name."""
        return load_problem(self.source) if isinstance(self.source, str) else self.source

    def prepare(self) -> None:
        """Load the problem before the time limit starts."""
        self.load()

    def sample(self, sampler: Sampler, posterior: MotionPosterior, seed: int) -> MotionDraws:
        """Return ``draws`` draws of a sampler, divided equally among the chains."""
        draws = self.draws // self.chains
        return sampler.sample(posterior, draws=draws, chains=self.chains, seed=seed, progress=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class Pilot(GridTask):
    """Pilot task that chooses the settings of a sampler on a problem for all seeds."""

    def __str__(self) -> str:
        return f"{self.problem}/{self.sampler}"

    def result(self) -> PilotResult | None:
        try:
            stored = read_json(self.path)
            failure = stored.pop("failure")
            result = PilotResult(
                **stored, failure=None if failure is None else read_failure(failure)
            )
            check_types(result)
            return result
        except (
            FileNotFoundError, NotADirectoryError, AttributeError, ValueError, KeyError, TypeError
        ):  # fmt: skip
            return None

    def fail(self, error: BaseException) -> None:
        self._store(PilotResult(self.fingerprint, {}, Failure.of(error)))

    def run(self) -> None:
        assert self.budget is not None
        try:
            with one_thread():
                problem = self.load()
                with time_limit(self.limit):
                    settings = affordable(
                        self.budget, self.with_sampler, partial(self._cost, problem)
                    )
        except (Exception, SystemExit) as error:
            self.fail(error)
        else:
            self._store(PilotResult(self.fingerprint, settings))

    def _cost(self, problem: Problem, sampler: Sampler) -> float:
        assert self.budget is not None
        seed = seeds.integer(0, "pilot", self.problem, self.sampler)
        return self.budget.spent(self.sample(sampler, problem.posterior, seed))

    def _store(self, result: PilotResult) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self.path, asdict(result))
        except OSError as error:
            raise ResultNotWritten(str(error)) from error
