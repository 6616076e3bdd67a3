"""Plan of an experiment grid: problems, samplers and numbers of draws, chains and seeds."""

from __future__ import annotations

import datetime
import os
import platform
import shlex
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from probmotion.comparison.results.budgets import Budget, effort_of
from probmotion.comparison.results.fingerprint import fingerprint
from probmotion.comparison.results.folder_names import check_name
from probmotion.comparison.results.run_results import read_result
from probmotion.files import read_json, write_json
from probmotion.posteriors.draws import library_versions
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler
from probmotion.problems.catalogue import load_problem
from probmotion.validation import check_count, check_types

__all__ = ["Plan"]

_PLAN = "comparison.json"
# Folders of format 1 stored runs in cells/<problem>/<sampler>/<seed>/cell.json, and those of
# format 2 plans without fingerprints.
_FORMAT = 3
_COMMAND_SEPARATOR = " && "
_MAX_RUNS = 10**7  # of plans in files


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
    budget : str
        Budget, such as ``"6 seconds per run"``; empty without one.
    untuned : tuple of str
        Samplers that the budget does not change.
    references : tuple of str
        Notes on problems whose reference draws come from long runs.
    versions : dict of str
        Library versions by name.
    fingerprints : dict of dict
        Fingerprints by name, of every ``"problem"`` and ``"sampler"``.
    date, machine, command : str
        Date of the last call, cores and Python of its machine, and the command lines of all calls,
        joined by ``&&``; the last is empty outside ``probmotion``.
    """

    problems: dict[str, str]
    samplers: dict[str, dict[str, str]]
    draws: int
    chains: int
    seeds: int
    budget: str = ""
    untuned: tuple[str, ...] = ()
    references: tuple[str, ...] = ()
    versions: dict[str, str] = field(default_factory=dict)
    fingerprints: dict[str, dict[str, str]] = field(default_factory=dict)
    date: str = ""
    machine: str = ""
    command: str = ""

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
        """Return the plan of a grid whose budget is ``per`` run or simulation.

        Raises
        ------
        ValueError
            If the content of a problem or sampler cannot be determined.
        """
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
            budget="" if budget is None else f"{budget} per {per}",
            untuned=tuple(
                name
                for name, sampler in samplers.items()
                if budget is not None and not effort_of(sampler)
            ),
            references=tuple(_reference_notes(loaded)),
            versions=library_versions(),
            fingerprints={"problem": _fingerprints(loaded), "sampler": _fingerprints(samplers)},
            date=datetime.date.today().isoformat(),
            machine=_machine(),
            command=_command(),
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the budget and on metrics without their library."""
        notes: tuple[str, ...] = ()
        if self.budget:
            notes = (f"every sampler had {self.budget}",)
        if self.versions and self.versions.keys().isdisjoint({"torch", "jax"}):
            notes += (
                "KSD² is not measured without gradients; run pip install 'probmotion[torch]'",
            )
        if not self.untuned:
            return notes
        verb = "has" if len(self.untuned) == 1 else "have"
        names = ", ".join(self.untuned)
        return (*notes, f"{names} {verb} no effort setting and ran with the given settings")

    def union(self, folder: Path) -> Plan:
        """Return the union of this plan and the plan stored in ``folder``, if there is one.

        Raises
        ------
        ValueError
            If ``folder`` contains finished runs with other draws, chains, budget or library
            versions, or of another problem or sampler with a name of this plan.
        """
        if not (folder / _PLAN).exists():
            return self
        stored = Plan.load(folder)
        finished = [address[:2] for address in stored.runs() if _has_draws(folder, address)]
        for name, stored_value, new_value in stored._differences(self):
            if not finished:
                return self
            raise ValueError(
                f"out must be a new folder, got {folder}, which contains finished runs with "
                f"{name} {stored_value} instead of {new_value}"
            )
        for pair in finished:
            for kind, name in zip(("problem", "sampler"), pair, strict=True):
                before = stored.fingerprints[kind][name]
                if self.fingerprints[kind].get(name, before) != before:
                    raise ValueError(
                        f"out must be a new folder, got {folder}, which contains finished runs of "
                        f"another {kind} called {name}"
                    )
        commands = dict.fromkeys([*stored.command.split(_COMMAND_SEPARATOR), self.command])
        return replace(
            self,
            problems=stored.problems | self.problems,
            samplers=stored.samplers | self.samplers,
            seeds=max(stored.seeds, self.seeds),
            untuned=tuple(dict.fromkeys(stored.untuned + self.untuned)),
            references=tuple(dict.fromkeys(stored.references + self.references)),
            fingerprints={
                kind: stored.fingerprints[kind] | self.fingerprints[kind]
                for kind in self.fingerprints
            },
            command=_COMMAND_SEPARATOR.join(filter(None, commands)),
        )

    def _differences(self, other: Plan) -> Iterator[tuple[str, Any, Any]]:
        """Yield name and both values of each option that all runs of a folder must share."""
        for name in ("draws", "chains", "budget"):
            if (mine := getattr(self, name)) != (theirs := getattr(other, name)):
                yield name, mine or "none", theirs or "none"
        for name in self.versions | other.versions:
            mine, theirs = (plan.versions.get(name, "none") for plan in (self, other))
            if mine != theirs:
                yield name, mine, theirs

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

    def _check(self) -> None:
        """Raise ``ValueError`` unless a plan from a file is valid; names are folder names."""
        check_types(self)
        for name in ("draws", "chains", "seeds"):
            check_count(name, getattr(self, name))
        for kind, names in (("problem", self.problems), ("sampler", self.samplers)):
            check_count(f"number of {kind}s", len(names))
            for name in names:
                check_name(f"{kind}s", name)
            if names.keys() != self.fingerprints[kind].keys():
                raise ValueError(f"fingerprints must be of every {kind}")
        runs = len(self.problems) * len(self.samplers) * self.seeds
        if runs > _MAX_RUNS:
            raise ValueError(f"runs must be at most {_MAX_RUNS}, got {runs}")

    def save(self, folder: Path) -> None:
        """Write the plan into ``folder``."""
        write_json(folder / _PLAN, {"format": _FORMAT, **asdict(self)})

    @classmethod
    def load(cls, folder: Path) -> Plan:
        """Read the plan in ``folder``.

        Raises
        ------
        ValueError
            If there is none, it is damaged, or another version of this package wrote it.
        """
        path = folder / _PLAN
        try:
            stored = read_json(path)
            version = stored.pop("format", 1)
            if version == _FORMAT:
                sequences = {name: tuple(stored[name]) for name in ("untuned", "references")}
                plan = cls(**stored | sequences)
                plan._check()
                return plan
        except OSError as error:
            raise ValueError(
                f"folder must be written by compare(), got {str(folder)!r} without {_PLAN}"
            ) from error
        except (AttributeError, ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{path} is damaged: {str(error)[:200]}") from error
        raise ValueError(
            f"out must be written by this version of probmotion (format {_FORMAT}), got "
            f"{folder} of format {version}; use another folder"
        )


def _machine() -> str:
    cores = os.cpu_count() or 1
    kind, python = platform.machine(), platform.python_version()
    return f"{cores} core{'s' * (cores != 1)} ({kind}), Python {python}"


def _command() -> str:
    """Return the command line; empty if another program called the package."""
    program, *arguments = sys.argv or [""]
    return shlex.join(["probmotion", *arguments]) if Path(program).stem == "probmotion" else ""


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


def _fingerprints(named: Mapping[str, Any]) -> dict[str, str]:
    """Return the fingerprints of problems or samplers; errors mention their names."""
    fingerprints = {}
    for name, value in named.items():
        try:
            fingerprints[name] = fingerprint(value)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
    return fingerprints


def _has_draws(folder: Path, address: tuple[str, str, int]) -> bool:
    result = read_result(Plan.run_folder(folder, *address))
    return result is not None and result.failure is None


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
        entry.name: repr(getattr(sampler, entry.name))
        for entry in fields(sampler)
        if usual is None or not _equal(getattr(sampler, entry.name), getattr(usual, entry.name))
    }


def _equal(value: Any, usual: Any) -> bool:
    """Whether two settings are equal; arrays are compared by their fingerprints."""
    try:
        return bool(value == usual)
    except (ValueError, RuntimeError):
        return fingerprint(value) == fingerprint(usual)
