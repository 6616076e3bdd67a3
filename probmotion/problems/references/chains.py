"""`StoredChain`: where a chain that takes hours is, in a file, so that it goes on if stopped."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from probmotion.files import written_whole

__all__ = ["StoredChain"]

_SECONDS = 30.0


class StoredChain:
    """Arrays that say where a chain is, written from time to time and whole.

    When they are written changes no draw: a chain goes on from them with the same bits.

    Parameters
    ----------
    path : Path, optional
        A file of this chain alone, ``.npz`` without pickle; by default nothing is written.
    """

    def __init__(self, path: Path | None) -> None:
        self.path, self._written = path, time.monotonic()

    def load(self) -> Mapping[str, np.ndarray] | None:
        """Return what was written last; None if nothing was, or nothing is kept.

        Raises
        ------
        ValueError
            If the file is not what :meth:`save` wrote.
        """
        if self.path is None or not self.path.is_file():
            return None
        try:
            with np.load(self.path, allow_pickle=False) as held:
                return dict(held)
        except (ValueError, EOFError, OSError, BadZipFile) as error:
            raise ValueError(
                f"{self.path} holds no chain ({error}), expected one that was kept; without it "
                "the chain is made anew"
            ) from error

    def save(self, held: Callable[[], Mapping[str, np.ndarray]]) -> None:
        """Write what ``held`` returns, if it is time to; a file that fails stops no chain."""
        if self.path is None or time.monotonic() < self._written + _SECONDS:
            return
        try:
            with written_whole(self.path) as unfinished:
                np.savez(unfinished, allow_pickle=False, **held())
        except OSError as error:
            warnings.warn(f"{error}; the chain goes on", stacklevel=2)
        self._written = time.monotonic()
