"""Atomic file writes and checks of output folders."""

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
    """Return an identifier of this machine or container; host names alone are not unique."""
    parts = [platform.node()]
    with suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii"))
    with suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return f"{zlib.crc32(' '.join(parts).encode()):08x}"


_MACHINE = _machine()
_UNFINISHED = re.compile(rf"\..*\.{_MACHINE}\.(\d+)\.unfinished(\.[^.]*)?")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it to ``path`` once the block succeeds.

    Raises
    ------
    OSError
        If the folder does not exist or is not writable.
    """
    path = Path(path)
    # Writers choose the format by the suffix, so the temporary name has the same suffix.
    owner = f"{_MACHINE}.{os.getpid()}"
    unfinished = path.with_name(f".{path.stem}.{owner}.unfinished{path.suffix}")
    try:
        yield unfinished
        os.replace(unfinished, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"cannot write {path}: {reason}; choose a writable folder") from error
    finally:
        # If the folder is missing, unlink fails too and must not mask the original error.
        with suppress(OSError):
            unfinished.unlink()


def forget_killed(folder: Path) -> None:
    """Remove temporary files in ``folder`` written by killed processes of this machine.

    Files of other machines that share the folder are preserved: their processes may still run.
    """
    # Only POSIX can test for a process without affecting it.
    if os.name != "posix" or not folder.is_dir():
        return
    for path in folder.iterdir():
        match = _UNFINISHED.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            with suppress(OSError):
                path.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # a process of another user
        pass
    return True


def writable_folder(folder: Path) -> Path:
    """Return ``folder``, created if needed; raise ``OSError`` if it is not writable."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"out must be a writable folder, got {str(folder)!r}: {reason}") from error
    return folder
