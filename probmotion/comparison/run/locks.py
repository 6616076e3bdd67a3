"""File locks of a results folder: one process runs a problem, one writes plan and table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

__all__ = ["locked", "plan_locked"]


@contextmanager
def locked(folder: Path, problems: Iterable[str]) -> Iterator[None]:
    """Lock ``problems`` in a results folder while the block runs.

    Grids of different problems may share a folder, for example in a job array. The operating
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
            path = folder / "runs" / problem
            path.mkdir(parents=True, exist_ok=True)
            lock = FileLock(path / ".lock", blocking=False, fallback_to_soft=False)
            try:
                stack.enter_context(lock)
            except Timeout as error:
                raise ValueError(
                    f"out must not be in use, got {folder}, where another process is running "
                    f"{problem}; wait for it to end or use another folder"
                ) from error
            except OSError as error:
                raise OSError(
                    f"out must support file locks, got {str(folder)!r}: "
                    f"{error.strerror or error}; use a folder on another file system"
                ) from error
        yield


@contextmanager
def plan_locked(folder: Path) -> Iterator[None]:
    """Lock the plan and the table, so that one process at a time reads and writes them.

    Call it within :func:`locked`, which raises if the folder does not support locks.
    """
    from filelock import FileLock

    with FileLock(folder / ".lock", fallback_to_soft=False):
        yield
