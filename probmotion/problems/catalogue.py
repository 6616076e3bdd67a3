"""Posteriors with an answer: what a comparison of samplers is made on."""

from __future__ import annotations

import ast
import re
from collections.abc import Hashable
from dataclasses import replace
from functools import cache
from typing import Any

from probmotion.posteriors.problem import Problem
from probmotion.posteriors.reference import StoredReference
from probmotion.problems.clips import CLIP_PROBLEMS, clips_problem
from probmotion.problems.denoising import DENOISING_PROBLEMS
from probmotion.problems.gait import GAIT_OUTLIER_PROBLEMS, GAIT_PROBLEMS
from probmotion.problems.learnt import LEARNT_PROBLEMS
from probmotion.problems.pairs import PAIR_PROBLEMS, pairs_problem
from probmotion.problems.references.store import find_reference
from probmotion.threads import one_thread

__all__ = [
    "Problem",
    "StoredReference",
    "clips_problem",
    "load_problem",
    "pairs_problem",
    "problem_descriptions",
    "problem_names",
    "problem_without_reference",
    "problems_at_hand",
]

_GAITS = {**GAIT_PROBLEMS, **GAIT_OUTLIER_PROBLEMS}
_OTHERS = {**CLIP_PROBLEMS, **PAIR_PROBLEMS, **LEARNT_PROBLEMS, **DENOISING_PROBLEMS}
_SCALED = re.compile(r"(?P<name>[^()]+)\((?P<scale>[^()]*)\)")


def problem_names() -> list[str]:
    """Return the names of all problems that :func:`load_problem` knows."""
    return [*_GAITS, *_OTHERS]


def problems_at_hand() -> tuple[list[str], dict[str, str]]:
    """Return the names of the problems whose data is here, and of the others why they are not."""
    found, left_out = [], {}
    for name in problem_names():
        try:
            load_problem(name)
        except FileNotFoundError as error:
            left_out[name] = str(error)
        else:
            found.append(name)
    return found, left_out


def problem_descriptions() -> dict[str, str]:
    """Return one sentence on each problem, by name; none is made for it."""
    gaits = {name: made.description for name, made in _GAITS.items()}
    return gaits | {name: description for name, (description, _) in _OTHERS.items()}


def load_problem(name: str, **scale: Any) -> Problem:
    """Return a problem by name; it is made once per process.

    Parameters
    ----------
    name : str
        One of :func:`problem_names`; or what a problem with other numbers calls itself, such as
        ``"gait-monocular(frames=20, noise=0.05)"``.
    **scale
        Numbers that say how hard it is: problems on gaits know ``frames`` and ``components`` and,
        where there is evidence, ``joints``, ``noise``, ``hidden`` and ``seed``; see
        :mod:`probmotion.problems.gait`.

    Raises
    ------
    ValueError
        If no problem has that name or it does not know a number, with those that are known; or
        the kept reference draws are of another posterior.
    FileNotFoundError
        If it is made from data that is not there; the message says how to get it.
    """
    return _made(*_asked(name, scale))


def problem_without_reference(name: str, **scale: Any) -> Problem:
    """Return a problem as :func:`load_problem` does, but for reference draws that are kept."""
    return _bare(*_asked(name, scale))


Scale = tuple[tuple[str, Any], ...]


def _asked(name: str, scale: dict[str, Any]) -> tuple[str, Scale]:
    """Return the name and what differs from its own numbers, which then address the problem."""
    if scaled := _SCALED.fullmatch(name):
        name, scale = scaled["name"], _read(name, scaled["scale"]) | scale
    if name not in problem_names():
        raise ValueError(f"problem must be one of {', '.join(problem_names())}, got {name!r}")
    known = _GAITS[name].defaults if name in _GAITS else {}
    for number in scale:
        if number not in known:
            raise ValueError(
                f"{name} knows no {number!r}, expected "
                + (f"one of {', '.join(known)}" if known else "no numbers: it has no scale")
            )
        if not isinstance(scale[number], Hashable):
            raise ValueError(
                f"{number} must be a number such as {known[number]!r}, got {scale[number]!r}"
            )
    return name, tuple((n, scale[n]) for n in known if n in scale and scale[n] != known[n])


def _read(name: str, words: str) -> dict[str, Any]:
    try:
        call = ast.parse(f"f({words})", mode="eval").body
        assert isinstance(call, ast.Call)
        assert not call.args
        return {str(word.arg): ast.literal_eval(word.value) for word in call.keywords}
    except (SyntaxError, ValueError, AssertionError) as error:
        raise ValueError(
            f"problem must be numbers such as (frames=20, noise=0.05), got {name!r}"
        ) from error


def _called(name: str, scale: Scale) -> str:
    return f"{name}({', '.join(f'{n}={value}' for n, value in scale)})" if scale else name


@cache
def _made(name: str, scale: Scale) -> Problem:
    problem = _bare(name, scale)
    # Nothing is kept of what is exact.
    kept = None if problem.has_reference else find_reference(problem.name)
    return problem if kept is None else replace(problem, kept=kept)


@cache
def _bare(name: str, scale: Scale) -> Problem:
    # Every process of a comparison must make the same problem to the last bit.
    with one_thread():
        if name in _GAITS:
            problem = _GAITS[name](_called(name, scale), **dict(scale))
            if not scale:
                return problem
            numbers = ", ".join(f"{number}={value}" for number, value in scale)
            return replace(problem, description=f"{problem.description}, but with {numbers}")
        return _OTHERS[name][1]()
