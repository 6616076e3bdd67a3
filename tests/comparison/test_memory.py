"""Memory that a cell takes is its own, and nothing is said where it is not known."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest

from probmotion.comparison import memory
from probmotion.comparison.memory import watched_memory

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
