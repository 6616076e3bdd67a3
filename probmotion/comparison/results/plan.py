"""Plan of an experiment grid: problems, samplers and numbers of draws, chains and seeds."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from probmotion.comparison.results.budgets import Budget, effort_of
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.files import written_whole
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem

__all__ = ["Plan"]

_PLAN = "comparison.json"
# Folders of format 1 stored runs in cells/<problem>/<sampler>/<seed>/cell.json.
_FORMAT = 2


@dataclass(frozen=True)
class Plan:
    """Plan of a grid, stored in its folder.

    Parameters
    ----------
    problems : dict of str
        Problem descriptions by name.
    samplers : dict of dict
        Settings that differ from the defaults, by sampler name.
    draws, chains, seeds : int
        Arguments of :func:`~probmotion.comparison.compare`.
    notes : tuple of str
        Notes on the budget.
    references : tuple of str
        Notes on problems whose reference draws come from long runs.
    """

    problems: dict[str, str]
    samplers: dict[str, dict[str, str]]
    draws: int
    chains: int
    seeds: int
    notes: tuple[str, ...] = ()
    references: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        problems: Mapping[str, str | Problem],
        samplers: Mapping[str, Sampler],
        draws: int,
        chains: int,
        seeds: int,
        budget: Budget | None = None,
        per: str = "run",
    ) -> Plan:
        """Return the plan of a grid; notes state the budget ``per`` run or simulation."""
        loaded = {
            name: load_problem(source) if isinstance(source, str) else source
            for name, source in problems.items()
        }
        return cls(
            problems={name: problem.description for name, problem in loaded.items()},
            samplers={name: _changed_settings(sampler) for name, sampler in samplers.items()},
            draws=draws,
            chains=chains,
            seeds=seeds,
            notes=() if budget is None else _budget_notes(budget, samplers, per),
            references=tuple(_reference_notes(loaded)),
        )

    def runs(self) -> Iterator[tuple[str, str, int]]:
        """Yield (problem, sampler, seed) in the order problem, seed, sampler."""
        for problem in self.problems:
            for seed in range(self.seeds):
                for sampler in self.samplers:
                    yield problem, sampler, seed

    @staticmethod
    def run_folder(folder: Path, problem: str, sampler: str, seed: int) -> Path:
        """Return the folder of a run."""
        return folder / "runs" / problem / sampler / str(seed)

    def save(self, folder: Path) -> None:
        """Write the plan into ``folder``."""
        with written_whole(folder / _PLAN) as unfinished:
            stored = {"format": _FORMAT, **asdict(self)}
            unfinished.write_text(json.dumps(stored, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Plan:
        """Read the plan in ``folder``."""
        path = folder / _PLAN
        cls.check_folder(folder)
        try:
            stored = json.loads(path.read_text(encoding="utf-8"))
            del stored["format"]
            return cls(**stored | {name: tuple(stored[name]) for name in ("notes", "references")})
        except OSError as error:
            raise ValueError(
                f"folder must be written by compare(), got {str(folder)!r} without {_PLAN}"
            ) from error
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error

    @staticmethod
    def check_folder(folder: Path) -> None:
        """Raise ``ValueError`` if another version of this package wrote runs into ``folder``."""
        try:
            stored = json.loads((folder / _PLAN).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return
        version = stored.get("format", 1) if isinstance(stored, dict) else _FORMAT
        if version != _FORMAT:
            raise ValueError(
                f"out must be written by this version of probmotion (format {_FORMAT}), got "
                f"{folder} of format {version}; use another folder"
            )


def _reference_notes(problems: Mapping[str, Problem]) -> Iterator[str]:
    """Yield a note for each problem whose reference draws come from long runs."""
    for name, problem in problems.items():
        if problem.stored is not None and problem.max_references is not None:
            certificate = problem.stored.certificate
            aligned = "" if problem.aligned_to is None else ", up to a rigid motion"
            rhat = certificate.get("rhat")
            mixed = "" if rhat is None else f" (R-hat {rhat:.3f})"
            yield (
                f"reference draws of {name} are {problem.stored.n} draws from long runs of "
                f"{certificate['sampler']}{mixed}{aligned}"
            )


def _budget_notes(budget: Budget, samplers: Mapping[str, Sampler], per: str) -> tuple[str, ...]:
    notes = [f"every sampler had {budget} per {per}"]
    if free := [name for name, sampler in samplers.items() if not effort_of(sampler)]:
        verb = "has" if len(free) == 1 else "have"
        notes.append(f"{', '.join(free)} {verb} no effort setting and ran with the given settings")
    return tuple(notes)


def _changed_settings(sampler: Any) -> dict[str, str]:
    """Return the settings of a sampler that differ from the defaults, as text."""
    if not is_dataclass(sampler):
        return {}
    kind: Any = type(sampler)
    try:
        usual = kind()
    except (TypeError, ValueError):  # a setting without a default
        usual = None
    return {
        field.name: repr(getattr(sampler, field.name))
        for field in fields(sampler)
        if usual is None or not _equal(getattr(sampler, field.name), getattr(usual, field.name))
    }


def _equal(value: Any, usual: Any) -> bool:
    """Whether two settings are equal; arrays are compared by their fingerprints."""
    try:
        return bool(value == usual)
    except (ValueError, RuntimeError):
        return fingerprint(value) == fingerprint(usual)
