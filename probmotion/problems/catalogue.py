"""Catalogue of test problems for comparing samplers."""

from __future__ import annotations

import ast
import re
from collections.abc import Hashable
from dataclasses import replace
from functools import cache
from typing import Any

from probmotion.posteriors.problem import Problem
from probmotion.problems.clips import CLIP_PROBLEMS
from probmotion.problems.denoising import DENOISING_PROBLEMS
from probmotion.problems.gait import GAIT_OUTLIER_PROBLEMS, GAIT_PROBLEMS
from probmotion.problems.learnt import LEARNT_PROBLEMS
from probmotion.problems.pairs import PAIR_PROBLEMS
from probmotion.problems.real_motion import REAL_MOTION_PROBLEMS
from probmotion.problems.references.store import find_reference
from probmotion.threads import one_thread
from probmotion.validation import did_you_mean

__all__ = [
    "available_problems",
    "load_problem",
    "problem_descriptions",
    "problem_names",
    "problem_without_reference",
]

_GAITS = {**GAIT_PROBLEMS, **GAIT_OUTLIER_PROBLEMS}
_OTHER_PROBLEMS = {
    **CLIP_PROBLEMS,
    **PAIR_PROBLEMS,
    **LEARNT_PROBLEMS,
    **DENOISING_PROBLEMS,
    **REAL_MOTION_PROBLEMS,
}
_SCALED = re.compile(r"(?P<name>[^()]+)\((?P<scale>[^()]*)\)")  # e.g. gait(frames=20)


def problem_names() -> list[str]:
    """Return the names of all problems."""
    return [*_GAITS, *_OTHER_PROBLEMS]


def available_problems() -> tuple[list[str], dict[str, str]]:
    """Return the names of loadable problems, and the error message of each other problem."""
    missing = {}
    for name in problem_names():
        try:
            load_problem(name)
        except (FileNotFoundError, ModuleNotFoundError) as error:
            missing[name] = str(error)
    return [name for name in problem_names() if name not in missing], missing


def problem_descriptions() -> dict[str, str]:
    """Return one-sentence descriptions of all problems by name, without loading them."""
    gaits = {name: problem.description for name, problem in _GAITS.items()}
    return gaits | {name: description for name, (description, _) in _OTHER_PROBLEMS.items()}


def load_problem(name: str, **scale: Any) -> Problem:
    """Load a problem by name; cached per process.

    Parameters
    ----------
    name : str
        One of :func:`problem_names`, or such a name with parameters, as in
        ``"gait-monocular(frames=20, noise=0.05)"``.
    **scale
        Parameters of gait problems: ``frames`` and ``components`` and, with observations,
        ``joints``, ``noise``, ``hidden`` and ``seed``; see :mod:`probmotion.problems.gait`.

    Raises
    ------
    ValueError
        If the problem or a parameter is unknown, or the stored reference draws belong to
        another posterior.
    FileNotFoundError
        If the problem's data are missing; the message explains how to obtain them.
    ModuleNotFoundError
        If the problem requires an extra of this package; the message names it.
    """
    return _load(*_resolve(name, scale))


def problem_without_reference(name: str) -> Problem:
    """Load a problem without its stored reference draws."""
    return _load_without_reference(*_resolve(name, {}))


Scale = tuple[tuple[str, Any], ...]  # changed parameters of a problem


def _resolve(name: str, scale: dict[str, Any]) -> tuple[str, Scale]:
    """Return the name and the parameters that differ from the defaults: the cache key."""
    if scaled := _SCALED.fullmatch(name):
        name, scale = scaled["name"], _parse(scaled["scale"]) | scale
    if name not in problem_names():
        known = problem_names()
        similar = did_you_mean(name, known)
        raise ValueError(f"problem must be one of {', '.join(known)}, got {name[:80]!r}{similar}")
    defaults = _GAITS[name].defaults if name in _GAITS else {}
    for key, value in scale.items():
        if key not in defaults:
            allowed = f"be one of {', '.join(defaults)}" if defaults else "not be set"
            raise ValueError(f"parameters of {name} must {allowed}, got {key[:80]!r}")
        if not isinstance(value, Hashable):
            raise ValueError(f"{key} must be a number such as {defaults[key]!r}, got {value!r:.80}")
    changed = {key for key, value in scale.items() if value != defaults[key]}
    return name, tuple((key, scale[key]) for key in defaults if key in changed)


def _parse(text: str) -> dict[str, Any]:
    try:
        call = ast.parse(f"f({text})", mode="eval").body
        assert isinstance(call, ast.Call)
        assert not call.args
        return {str(item.arg): ast.literal_eval(item.value) for item in call.keywords}
    except (
        AssertionError, MemoryError, RecursionError, SyntaxError, TypeError, ValueError
    ) as error:  # fmt: skip
        raise ValueError(
            f"parameters must be given as in (frames=20, noise=0.05), got ({text[:80]})"
        ) from error


@cache
def _load(name: str, scale: Scale) -> Problem:
    problem = _load_without_reference(name, scale)
    # Exact problems need no stored draws.
    stored = None if problem.has_reference else find_reference(problem.name)
    return problem if stored is None else replace(problem, stored=stored)


@cache
def _load_without_reference(name: str, scale: Scale) -> Problem:
    # A single thread makes problems bit-identical across processes of a comparison.
    with one_thread():
        if name not in _GAITS:
            return _OTHER_PROBLEMS[name][1]()
        if not scale:
            return _GAITS[name]()
        parameters = ", ".join(f"{key}={value}" for key, value in scale)
        problem = _GAITS[name](f"{name}({parameters})", **dict(scale))
        return replace(problem, description=f"{problem.description}, but with {parameters}")
