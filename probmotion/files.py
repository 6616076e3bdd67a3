"""Writing files so that a reader never meets half of one."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["writable_folder", "written_whole"]


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` once the block succeeds.

    Raises
    ------
    OSError
        If the folder does not exist or cannot be written to; the message names it.
    """
    path = Path(path)
    # The ending is kept last, because writers choose a format or append a suffix by it.
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}.unfinished{path.suffix}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(
            f"cannot write {path}: {reason}; expected a folder that is writable"
        ) from error
    finally:
        # Where the folder is none, this fails as the writing did, and must not hide its message.
        with suppress(OSError):
            unfinished.unlink()


def writable_folder(folder: Path) -> Path:
    """Return ``out``, made where it is missing, once it is known that it can be written to.

    Raises
    ------
    OSError
        If it cannot.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"out is {str(folder)!r}, {reason}; expected a writable folder") from error
    return folder
