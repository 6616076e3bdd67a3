"""How much memory a cell takes: what the operating system saw at most, while it ran."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["PeakMemory", "watched_memory"]

_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class PeakMemory:
    """What the block of :func:`watched_memory` took at most."""

    mebibytes: float | None = None
    """More than the process held before, the libraries that it was the first to load among it.
    None where it is not known."""


@contextmanager
def watched_memory() -> Iterator[PeakMemory]:
    """Yield what says, after the block, how much memory it took.

    It is known on Linux, of a main thread: what other threads take would count as the block's.
    """
    found = PeakMemory()
    before = _begun() if threading.current_thread() is threading.main_thread() else None
    yield found
    if before is not None:
        found.mebibytes = max(0.0, _held("VmHWM") - before) / 1024


def _begun() -> float | None:
    """Forget the process's former peak; return what it holds, kibibytes, or None if unknown."""
    try:
        _FORGET.write_text("5")
        return _held("VmRSS")
    except (OSError, ValueError):
        return None


def _held(name: str) -> float:
    found = re.search(rf"^{name}:\s+(\d+) kB$", _STATUS.read_text(), re.MULTILINE)
    if found is None:
        raise ValueError(f"{_STATUS} does not tell {name}")
    return float(found[1])
