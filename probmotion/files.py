"""Writing files so that a reader never meets half of one."""

from __future__ import annotations

import os
import platform
import re
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

__all__ = ["forget_killed", "writable_folder", "written_whole"]


def _machine() -> str:
    """Return what tells processes of this machine from those of another that has the same name."""
    known = [platform.node()]
    with suppress(OSError):
        known.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
    with suppress(OSError):
        known.append(os.readlink("/proc/self/ns/pid"))
    return f"{zlib.crc32(' '.join(known).encode()):08x}"


_MACHINE = _machine()
_UNFINISHED = re.compile(rf"\..*\.{_MACHINE}\.(\d+)\.unfinished(\.[^.]*)?")


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
    whose = f"{_MACHINE}.{os.getpid()}"
    unfinished = path.with_name(f".{path.stem}.{whose}.unfinished{path.suffix}")
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


def forget_killed(folder: Path) -> None:
    """Remove what processes of this machine that were killed had begun to write in ``folder``.

    Other machines may share the folder, and their processes may still be at it.
    """
    # Elsewhere there is no asking whether a process lives that does not disturb it.
    if os.name != "posix" or not folder.is_dir():
        return
    for path in folder.iterdir():
        begun = _UNFINISHED.fullmatch(path.name)
        if begun and not _lives(int(begun[1])):
            # Another user's file may stay.
            with suppress(OSError):
                path.unlink()


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


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
