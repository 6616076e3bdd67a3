"""What a prior may know of its own motions: styles, and a manifold they lie near."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

__all__ = ["HasManifold", "HasStyles"]


@runtime_checkable
class HasStyles(Protocol):
    """A prior that tells its styles apart."""

    @property
    def styles(self) -> Sequence[str]:
        """Names of the K styles."""

    def style_responsibilities(self, positions: np.ndarray) -> np.ndarray:
        """Return p(style | X): ``(n, L, J, 3) → (n, K)``."""


@runtime_checkable
class HasManifold(Protocol):
    """A prior whose motions lie near a manifold."""

    def off_manifold(self, positions: np.ndarray) -> np.ndarray:
        """Return the variance off the manifold over its expectation: ``(n, L, J, 3) → (n,)``."""
