"""Posteriors with an answer: what a comparison of samplers is made on."""

from __future__ import annotations

from functools import cache

from probmotion.problems.clips import clips_problem
from probmotion.problems.denoising import DENOISING_PROBLEMS
from probmotion.problems.gait import GAIT_PROBLEMS
from probmotion.problems.learnt import LEARNT_PROBLEMS
from probmotion.problems.pairs import PAIR_PROBLEMS, pairs_problem
from probmotion.problems.problem import Problem
from probmotion.threads import one_thread

__all__ = [
    "Problem",
    "clips_problem",
    "load_problem",
    "pairs_problem",
    "problem_descriptions",
    "problem_names",
]

_PROBLEMS = {**GAIT_PROBLEMS, **PAIR_PROBLEMS, **LEARNT_PROBLEMS, **DENOISING_PROBLEMS}


def problem_names() -> list[str]:
    """Return the names of all problems that :func:`load_problem` knows."""
    return list(_PROBLEMS)


def problem_descriptions() -> dict[str, str]:
    """Return one sentence on each problem, by name; none is made for it."""
    return {name: description for name, (description, _) in _PROBLEMS.items()}


def load_problem(name: str) -> Problem:
    """Return a problem by name; it is made once per process.

    Raises
    ------
    ValueError
        If no problem has that name; the message lists the known ones.
    FileNotFoundError
        If it is made from data that is not there; the message says how to get it.
    """
    if name not in _PROBLEMS:
        raise ValueError(f"problem is {name!r}, expected one of {', '.join(_PROBLEMS)}")
    return _made(name)


@cache
def _made(name: str) -> Problem:
    # Every process of a comparison must make the same problem to the last bit.
    with one_thread():
        return _PROBLEMS[name][1]()
