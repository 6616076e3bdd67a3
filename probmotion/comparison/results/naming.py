"""What a caller calls problems and samplers: names, objects, or a mapping of either."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import Sampler, default_sampler, importable_samplers
from probmotion.problems.catalogue import load_problem, problem_names

__all__ = ["AnyProblem", "AnySampler", "named_problems", "named_samplers"]

_NAME = re.compile(r"\w[\w.,=+() -]*")
# Bytes of a folder's name, and what stands around it while it is written.
_LONGEST = 200

AnyProblem = str | Problem | MotionPosterior
AnySampler = str | Sampler


def named_problems(problems: Any) -> dict[str, str | Problem]:
    """Return the problems by what the table calls them; a registered one by its name in full."""
    found: dict[str, str | Problem] = {}
    for label, given in _labelled(problems, AnyProblem):
        if isinstance(given, str):
            _add("problems", found, label or load_problem(given).name, given)
        elif isinstance(given, Problem):
            _add("problems", found, label or given.name, _registered_name(given) or given)
        elif isinstance(given, MotionPosterior):
            name = label or "posterior"
            _add("problems", found, name, Problem(name, "a posterior of the caller's", given))
        else:
            raise ValueError(
                f"problems has a {type(given).__name__}, expected names, Problem or "
                "MotionPosterior objects"
            )
    if not found:
        raise ValueError("problems must contain at least one, got none")
    return found


def _registered_name(problem: Problem) -> str | None:
    """A registered problem travels by its name: a process then makes it once for all cells."""
    name = problem.name
    if name.partition("(")[0] not in problem_names():
        return None
    try:
        return name if load_problem(name) is problem else None
    except (ValueError, FileNotFoundError):
        # What cannot be made by that name is the caller's own, such as "gait(mine)".
        return None


def named_samplers(samplers: Any) -> dict[str, Sampler]:
    """Return the samplers by what the table calls them; all registered ones for None."""
    found: dict[str, Sampler] = {}
    for label, given in _labelled(
        list(importable_samplers()) if samplers is None else samplers, AnySampler
    ):
        if isinstance(given, str):
            _add("samplers", found, label or given, default_sampler(given))
        elif isinstance(given, Sampler) and not isinstance(given, type):
            _add("samplers", found, label or given.name, given)
        else:
            what = given.__name__ if isinstance(given, type) else type(given).__name__
            raise ValueError(
                f"samplers has {what}, expected names or objects with name, requires and sample()"
            )
    if not found:
        raise ValueError("samplers must contain at least one, got none")
    return found


def _labelled(given: Any, one: Any) -> list[tuple[str | None, Any]]:
    if isinstance(given, Mapping):
        return list(given.items())
    if isinstance(given, one) or not isinstance(given, Iterable):
        return [(None, given)]
    return [(None, item) for item in given]


def _add(argument: str, found: dict[str, Any], name: str, value: Any) -> None:
    if name in found:
        raise ValueError(
            f"{argument} has two called {name!r}, expected different names; give a mapping, such "
            f"as {{'{name}-a': …, '{name}-b': …}}"
        )
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"{argument} has the name {name!r}, expected letters, digits and . , = + ( ) - _ that "
            "make a folder's name"
        )
    if (long := len(name.encode())) > _LONGEST:
        raise ValueError(
            f"{argument} has a name of {long} bytes, {name[:20]}…, expected at most {_LONGEST}, "
            "which a folder's name may have"
        )
    found[name] = value
