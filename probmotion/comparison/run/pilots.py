"""Pilots, which find the settings that spend a budget once per problem and sampler."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

from probmotion import seeds
from probmotion.comparison.results.budgets import affordable
from probmotion.comparison.results.failures import Failure, ResultNotWritten
from probmotion.comparison.run.grid_tasks import GridTask, PilotResult
from probmotion.comparison.run.time_limits import time_limit
from probmotion.files import written_whole
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.threads import one_thread

__all__ = ["Pilot"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Pilot(GridTask):
    """Pilot of a sampler on a problem; runs with all seeds use the settings that it finds."""

    def __str__(self) -> str:
        return f"{self.problem}/{self.sampler}"

    def result(self) -> PilotResult | None:
        """Return the stored result, possibly for other inputs, or None."""
        try:
            stored = json.loads(self.path.read_text(encoding="utf-8"))
            failure = stored.pop("failure")
            return PilotResult(**stored, failure=None if failure is None else Failure(**failure))
        except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
            return None

    def fail(self, error: BaseException) -> None:
        """Store a failure."""
        self._store(PilotResult(self.fingerprint, {}, Failure.of(error)))

    def run(self, progress: bool) -> None:
        """Find the settings and store them."""
        assert self.budget is not None
        try:
            with one_thread():
                problem = self.load()
                with time_limit(self.limit):
                    settings = affordable(
                        self.budget,
                        self.with_sampler,
                        lambda sampler: self._cost(problem, sampler),
                    )
        except (Exception, SystemExit) as error:
            self.fail(error)
        else:
            self._store(PilotResult(self.fingerprint, settings))

    def _cost(self, problem: Problem, sampler: Sampler) -> float:
        assert self.budget is not None
        draws = sampler.sample(
            problem.posterior,
            draws=self.draws // self.chains,
            chains=self.chains,
            seed=seeds.integer(0, "pilot", self.problem, self.sampler),
            progress=False,
        )
        return self.budget.spent(draws)

    def _store(self, result: PilotResult) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(self.path) as unfinished:
                unfinished.write_text(json.dumps(asdict(result), indent=1), encoding="utf-8")
        except OSError as error:
            raise ResultNotWritten(str(error)) from error
