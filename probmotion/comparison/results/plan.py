"""`Plan`: the grid that was asked for, as its folder holds it."""

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
# A folder of another format is not touched.
_FORMAT = 1


@dataclass(frozen=True)
class Plan:
    """The grid that was asked for.

    Parameters
    ----------
    problems : dict of str
        Descriptions by name.
    samplers : dict of dict
        By name: settings that differ from the class's defaults.
    draws, chains, seeds : int
        As given to :func:`~probmotion.comparison.compare`.
    notes : tuple of str
        Sentences to read with the table: the budget, if there was one.
    references : tuple of str
        Sentences on problems whose exact draws are those of long runs.
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
        per: str = "cell",
    ) -> Plan:
        """Return the plan of a grid of these objects; ``per`` says what a budget is for."""
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

    def cells(self) -> Iterator[tuple[str, str, int]]:
        """Yield (problem, sampler, seed): all samplers of one problem and seed in a row."""
        for problem in self.problems:
            for seed in range(self.seeds):
                for sampler in self.samplers:
                    yield problem, sampler, seed

    @staticmethod
    def cell_folder(folder: Path, problem: str, sampler: str, seed: int) -> Path:
        """Return where a cell is kept below ``folder``."""
        return folder / "cells" / problem / sampler / str(seed)

    def save(self, folder: Path) -> None:
        """Write the plan into ``folder``."""
        with written_whole(folder / _PLAN) as unfinished:
            held = {"format": _FORMAT, **asdict(self)}
            unfinished.write_text(json.dumps(held, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Plan:
        """Read the plan in ``folder``."""
        path = folder / _PLAN
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
            _check_format(folder, held)
            sentences = {name: tuple(held.get(name, ())) for name in ("notes", "references")}
            return cls(**held | sentences)
        except OSError as error:
            raise ValueError(
                f"folder is {str(folder)!r}, which holds no {_PLAN}, expected one that compare() "
                "wrote"
            ) from error
        except _OtherVersionError:
            raise
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error

    @staticmethod
    def check_folder(folder: Path) -> None:
        """Raise ``ValueError`` if another version of this package keeps its cells in ``folder``."""
        try:
            held = json.loads((folder / _PLAN).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return
        _check_format(folder, held)


class _OtherVersionError(ValueError):
    """The folder is of another version."""


def _check_format(folder: Path, held: Any) -> None:
    """Take the format out of what a plan's file holds; the first ones had none written."""
    found = held.pop("format", _FORMAT) if isinstance(held, dict) else _FORMAT
    if found != _FORMAT:
        raise _OtherVersionError(
            f"out is {folder}, which another version of probmotion wrote (format {found}, expected "
            f"{_FORMAT}); expected a folder of its own for this one"
        )


def _reference_notes(problems: Mapping[str, Problem]) -> Iterator[str]:
    """Yield what stands for exact draws where there are none."""
    for name, problem in problems.items():
        if problem.kept is not None and problem.most_reference is not None:
            told = problem.kept.certificate
            anywhere = "" if problem.aligned_to is None else ", wherever motions stand"
            mixed = "" if told.get("rhat") is None else f", R-hat {told['rhat']:.3f}"
            yield (
                f"what stands for exact draws of {name} are {problem.kept.n} draws of long runs of "
                f"{told['sampler']}{mixed}{anywhere}"
            )


def _budget_notes(budget: Budget, samplers: Mapping[str, Sampler], per: str) -> tuple[str, ...]:
    notes = [f"every sampler had {budget} per {per}"]
    if free := [name for name, sampler in samplers.items() if not effort_of(sampler)]:
        verb = "has" if len(free) == 1 else "have"
        notes.append(f"{', '.join(free)} {verb} no setting of effort and ran as given")
    return tuple(notes)


def _changed_settings(sampler: Any) -> dict[str, str]:
    """The settings of a dataclass that differ from its class's defaults, as text."""
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
        if usual is None or not _same(getattr(sampler, field.name), getattr(usual, field.name))
    }


def _same(value: Any, usual: Any) -> bool:
    """Whether two settings are equal; those with arrays, which say it by element, by contents."""
    try:
        return bool(value == usual)
    except (ValueError, RuntimeError):
        return fingerprint(value) == fingerprint(usual)
