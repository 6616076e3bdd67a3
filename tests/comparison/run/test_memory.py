"""Peak memory of a block, where the system reports it."""

from __future__ import annotations

import platform
import sys
import threading

import numpy as np
import pytest

from probmotion.comparison.run import memory
from probmotion.comparison.run.memory import watched_memory

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux reports peak memory")


def peak_of(mebibytes: int) -> float | None:
    with watched_memory() as peak:
        np.ones(mebibytes * 2**17).sum()
    return peak.mebibytes


@LINUX
def test_peak_includes_released_memory_but_no_earlier_peak():
    peak_of(1)
    assert peak_of(200) == pytest.approx(200, abs=20)
    assert peak_of(50) == pytest.approx(50, abs=20)


@LINUX
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's heap is trimmed")
def test_reused_heap_counts():
    blocks = [bytearray(2**16) for _ in range(200 * 16)]
    # A few remaining blocks prevent the C library from shrinking its heap.
    remaining = blocks[::100]
    del blocks
    with watched_memory() as peak:
        [bytearray(2**16) for _ in range(100 * 16)]
    assert remaining
    assert 80 <= peak.mebibytes <= 130


def test_other_c_libraries_are_not_trimmed(monkeypatch):
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: object())
    memory._trim()


def test_peak_is_unknown_on_other_threads_and_systems(monkeypatch, tmp_path):
    peaks = []
    thread = threading.Thread(target=lambda: peaks.append(peak_of(1)))
    thread.start()
    thread.join()
    monkeypatch.setattr(memory, "_RESET_PEAK", tmp_path / "missing" / "clear_refs")
    assert [*peaks, peak_of(1)] == [None, None]
