"""Locks that allow one grid at a time per problem and folder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

__all__ = ["locked"]


@contextmanager
def locked(folder: Path, problems: Iterable[str]) -> Iterator[None]:
    """Lock the problems of a folder during the block.

    Grids of different problems may share a folder, as the jobs of an array do. The operating
    system releases the locks when the process ends, even if it is killed.

    Raises
    ------
    ValueError
        If another process has locked one of the problems.
    OSError
        If the file system does not support locks.
    """
    from filelock import FileLock, Timeout

    with ExitStack() as stack:
        for problem in problems:
            place = folder / "runs" / problem
            place.mkdir(parents=True, exist_ok=True)
            lock = FileLock(place / ".lock", blocking=False, fallback_to_soft=False)
            try:
                stack.enter_context(lock)
            except Timeout as error:
                raise ValueError(
                    f"out is {folder}, where another process is running {problem}; wait for it to "
                    "end or use another folder"
                ) from error
            except OSError as error:
                raise OSError(
                    f"out is {str(folder)!r}, where files cannot be locked: "
                    f"{error.strerror or error}; use a folder on another file system"
                ) from error
        yield
