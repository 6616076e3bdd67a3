"""How much memory a cell takes: what the operating system saw at most, while it ran."""

from __future__ import annotations

import ctypes
import gc
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

    What was freed before is given back to the system first, so that the block has to take it
    anew. What cannot be given back is not seen when the block reuses it: small Python objects'
    free places, free places within a page, pools of libraries' own (torch's on a GPU among them),
    and, where the C library is not glibc, all of its heap. Nor are pages seen that the block
    asks for and never touches, or that the system has swapped out.
    """
    found = PeakMemory()
    before = _begun() if threading.current_thread() is threading.main_thread() else None
    yield found
    if before is not None:
        found.mebibytes = max(0.0, _held("VmHWM") - before) / 1024


def _begun() -> float | None:
    """Forget the process's former peak; return what it holds, kibibytes, or None if unknown."""
    _give_back()
    try:
        _FORGET.write_text("5")
        return _held("VmRSS")
    except (OSError, ValueError):
        return None


def _give_back() -> None:
    """Return freed memory to the system, as far as Python and the C library let it go."""
    gc.collect()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return  # Another C library than glibc.
    trim(ctypes.c_size_t(0))


def _held(name: str) -> float:
    found = re.search(rf"^{name}:\s+(\d+) kB$", _STATUS.read_text(), re.MULTILINE)
    if found is None:
        raise ValueError(f"{_STATUS} does not tell {name}")
    return float(found[1])
