"""One run at a time per problem and folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

__all__ = ["locked"]

_LOCK = ".lock"


@contextmanager
def locked(folder: Path, problems: Iterable[str]) -> Iterator[None]:
    """Keep other runs from these problems' cells below ``folder`` during the block.

    Runs of different problems may share a folder, as the tasks of an array job do. The locks are
    the operating system's, on files: they go with the process that holds them, however it ends.

    Raises
    ------
    ValueError
        If another run is at one of the problems.
    OSError
        If the folder's file system has no locks.
    """
    from filelock import FileLock, Timeout

    with ExitStack() as held:
        for problem in problems:
            place = folder / "cells" / problem
            place.mkdir(parents=True, exist_ok=True)
            lock = FileLock(place / _LOCK, blocking=False, fallback_to_soft=False)
            try:
                held.enter_context(lock)
            except Timeout as error:
                raise ValueError(
                    f"out is {folder}, where another run is at work on {problem}; expected it to "
                    "end first, or another folder"
                ) from error
            except OSError as error:
                reason = error.strerror or str(error)
                raise OSError(
                    f"out is {str(folder)!r}, whose files cannot be locked, {reason}; expected a "
                    "folder on another file system"
                ) from error
        yield
