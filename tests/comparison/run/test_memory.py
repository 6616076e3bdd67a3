"""Memory that a cell takes is its own, and nothing is said where it is not known."""

from __future__ import annotations

import platform
import sys
import threading

import numpy as np
import pytest

from probmotion.comparison.run import memory
from probmotion.comparison.run.memory import watched_memory

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process's peak")


def taken(mebibytes: int) -> float | None:
    with watched_memory() as peak:
        np.ones(mebibytes * 2**17).sum()
    return peak.mebibytes


@LINUX
def test_what_a_block_takes_is_known_though_it_gave_it_back():
    taken(1)
    assert taken(200) == pytest.approx(200, abs=20)
    # A greater one before does not count.
    assert taken(50) == pytest.approx(50, abs=20)


def small_blocks(mebibytes: int) -> list[bytearray]:
    return [bytearray(2**16) for _ in range(mebibytes * 16)]


@LINUX
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc's heap is given back")
def test_what_a_block_reuses_of_a_freed_heap_is_its_own():
    blocks = small_blocks(200)
    # A few that stay keep the C library from shrinking its heap by itself.
    kept = blocks[::100]
    del blocks
    with watched_memory() as peak:
        small_blocks(100)
    assert kept
    assert peak.mebibytes is not None
    assert 80 <= peak.mebibytes <= 130


def test_without_glibc_nothing_is_given_back_and_nothing_fails(monkeypatch):
    monkeypatch.setattr(memory.ctypes, "CDLL", lambda name: object())
    memory._give_back()


@LINUX
def test_a_failing_block_fails_as_it_would():
    with pytest.raises(ZeroDivisionError), watched_memory():
        1 / 0  # noqa: B018


def test_on_other_threads_and_systems_nothing_is_known(monkeypatch, tmp_path):
    found = []
    thread = threading.Thread(target=lambda: found.append(taken(1)))
    thread.start()
    thread.join()
    monkeypatch.setattr(memory, "_FORGET", tmp_path / "no such folder" / "clear_refs")
    assert [*found, taken(1)] == [None, None]
