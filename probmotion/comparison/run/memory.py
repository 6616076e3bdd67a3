"""Measurement of the peak memory of a run as reported by the operating system."""

from __future__ import annotations

import ctypes
import gc
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["PeakMemory", "watched_memory"]

_STATUS, _RESET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class PeakMemory:
    """Peak memory of a block, set by :func:`watched_memory`."""

    mebibytes: float | None = None
    """Peak minus the memory before the block, including newly loaded libraries; None if unknown."""


@contextmanager
def watched_memory() -> Iterator[PeakMemory]:
    """Measure the peak memory of a block, only on Linux and in the main thread.

    Freed memory is first returned to the system, so that it counts if the block reuses it. Memory
    that cannot be returned does not count: free lists of Python, partly used pages, memory pools
    of libraries (such as torch's on a GPU), and the entire heap without glibc.
    """
    peak = PeakMemory()
    before = _begin() if threading.current_thread() is threading.main_thread() else None
    yield peak
    if before is not None:
        peak.mebibytes = max(0.0, _kibibytes("VmHWM") - before) / 1024


def _begin() -> float | None:
    """Reset the peak and return the memory in use in KiB, or None if unknown."""
    _trim()
    try:
        _RESET_PEAK.write_text("5")
        return _kibibytes("VmRSS")
    except (OSError, ValueError):
        return None


def _trim() -> None:
    """Return freed memory to the system as far as Python and the C library allow."""
    gc.collect()
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return  # not glibc
    trim(ctypes.c_size_t(0))


def _kibibytes(name: str) -> float:
    match = re.search(rf"^{name}:\s+(\d+) kB$", _STATUS.read_text(), re.MULTILINE)
    if match is None:
        raise ValueError(f"{_STATUS} has no entry {name}")
    return float(match[1])
