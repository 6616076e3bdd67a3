"""Checkpoint file of a long Markov chain."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from probmotion.files import check_format, read_arrays, written_whole

__all__ = ["StoredChain"]

_SECONDS = 30.0  # minimum time between checkpoints


class StoredChain:
    """Periodic, atomic checkpoints of a chain's state in ``path``, an ``.npz`` file without pickle.

    Resumed chains produce bit-identical draws. Without a path, nothing is written.
    """

    def __init__(self, path: Path | None) -> None:
        self.path, self._written = path, time.monotonic()

    def load(self) -> Mapping[str, np.ndarray] | None:
        """Return the last checkpoint, or None; raise ``ValueError`` if the file is corrupt."""
        if self.path is None or not self.path.is_file():
            return None
        try:
            state = read_arrays(self.path)
            check_format(state)
        except (ValueError, OSError) as error:
            raise ValueError(
                f"{self.path} must contain a stored chain, got {str(error)[:200]}; "
                "delete it to restart"
            ) from error
        return state

    def save(self, state: Callable[[], Mapping[str, np.ndarray]]) -> None:
        """Write the state if 30 s have passed since the last checkpoint; warn if writing fails."""
        if self.path is None or time.monotonic() < self._written + _SECONDS:
            return
        try:
            with written_whole(self.path) as unfinished:
                np.savez(unfinished, allow_pickle=False, format=np.array(1), **state())
        except OSError as error:
            warnings.warn(f"checkpoint was not written: {error}; sampling continues", stacklevel=2)
        self._written = time.monotonic()
