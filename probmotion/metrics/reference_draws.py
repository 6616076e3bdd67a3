"""Reference draws of a problem, shared by its metrics."""

from functools import lru_cache

import numpy as np

from probmotion.posteriors.problem import Problem

__all__ = ["reference_draws"]

_DRAWS = 4000


def reference_draws(problem: Problem, seed: int, at_least: int = 0) -> np.ndarray:
    """Return 4000 reference draws, or ``at_least`` if that is more, (n, L, J, 3), metres.

    There are fewer if fewer are stored.
    """
    n, most = max(_DRAWS, at_least), problem.max_references
    return _drawn(problem, seed, n if most is None else min(n, most))


@lru_cache(maxsize=2)
def _drawn(problem: Problem, seed: int, n: int) -> np.ndarray:
    return problem.reference(seed, n)
