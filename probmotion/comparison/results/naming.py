"""Naming of problems and samplers that are given as names, objects or mappings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from probmotion.comparison.results.folder_names import check_name
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.finished import FinishedDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem, problem_of
from probmotion.posteriors.sampling import Sampler, default_sampler, importable_samplers
from probmotion.problems.catalogue import load_problem, problem_names

__all__ = ["AnyProblem", "AnySampler", "named_problems", "named_samplers"]

AnyProblem = str | Problem | MotionPosterior
AnySampler = Any
"""Name, sampler, finished draws, or function ``(log_density, dim, rng, draws) → θ``."""


def named_problems(problems: Any) -> dict[str, str | Problem]:
    """Return problems by their names in tables, with full names for registered problems."""
    named: dict[str, str | Problem] = {}
    for label, given in _labelled(problems, AnyProblem):
        if isinstance(given, str):
            _add("problems", named, label or load_problem(given).name, given)
        elif isinstance(given, Problem):
            _add("problems", named, label or given.name, _registered_name(given) or given)
        elif isinstance(given, MotionPosterior):
            name = label or "posterior"
            _add("problems", named, name, problem_of(name, given))
        else:
            raise ValueError(
                "problems must be names, Problem or MotionPosterior objects, got "
                f"{type(given).__name__}"
            )
    if not named:
        raise ValueError("problems must contain at least one, got none")
    return named


def _registered_name(problem: Problem) -> str | None:
    """Return the name by which workers load a registered problem; None for other problems."""
    name = problem.name
    if name.partition("(")[0] not in problem_names():
        return None
    try:
        return name if load_problem(name) is problem else None
    except (ValueError, FileNotFoundError):
        # A user-supplied problem with a similar name, such as "gait(mine)".
        return None


def named_samplers(samplers: Any) -> dict[str, Sampler]:
    """Return samplers by their names in tables; all registered samplers for None."""
    named: dict[str, Sampler] = {}
    several = list(importable_samplers()) if samplers is None else samplers
    for label, given in _labelled(several, _ONE_SAMPLER):
        sampler = _sampler(given, label)
        name = given if isinstance(given, str) else sampler.name
        _add("samplers", named, label or name, sampler)
    if not named:
        raise ValueError("samplers must contain at least one, got none")
    return named


# A list contains several samplers; an array or a tree contains the draws of one.
_ONE_SAMPLER = str | Sampler | MotionDraws | np.ndarray | xr.DataTree | Callable


def _sampler(given: Any, label: str | None) -> Sampler:
    """Return a sampler given as a name, object, function or finished draws."""
    if isinstance(given, str):
        return default_sampler(given)
    if isinstance(given, type):
        raise ValueError(
            "samplers must be names, objects with name, requires and sample(), functions or "
            f"finished draws, got the class {given.__name__}"
        )
    if isinstance(given, Sampler):
        return given
    if callable(given):
        from probmotion.samplers.mcmc.function import FunctionSampler

        return FunctionSampler(given)
    return FinishedDraws.of(given, label or "draws")


def _labelled(given: Any, one: Any) -> list[tuple[str | None, Any]]:
    if isinstance(given, Mapping):
        return list(given.items())
    if isinstance(given, one) or not isinstance(given, Iterable):
        return [(None, given)]
    return [(None, item) for item in given]


def _add(argument: str, named: dict[str, Any], name: str, value: Any) -> None:
    if name in named:
        raise ValueError(
            f"{argument} must have different names, got {name!r} twice; pass a mapping, such as "
            f"{{'{name}-a': …, '{name}-b': …}}"
        )
    check_name(argument, name)
    named[name] = value
