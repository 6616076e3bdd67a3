"""A limit on the time that a block may take."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from probmotion.comparison.results.failures import TimeIsUp

__all__ = ["time_limit"]


class _Alarm(BaseException):
    """Passes by those who catch every ``Exception``."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Raise :class:`TimeIsUp` where the block takes longer than ``seconds``; None: no limit.

    In the main thread of a system with interval timers the block is ended then, at its next
    step in Python; a long call of compiled code ends first. Elsewhere it is told at its end.
    """
    if seconds is None:
        yield
        return
    start = time.monotonic()
    rung = False
    try:
        with _alarm(seconds):
            yield
    except _Alarm:
        rung = True
    except Exception as error:
        # Some libraries wrap whatever is raised in what they call.
        if time.monotonic() - start > seconds:
            raise TimeIsUp(seconds) from error
        raise
    if rung or time.monotonic() - start > seconds:
        raise TimeIsUp(seconds)


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (in_main_thread and hasattr(signal, "setitimer")):
        yield
        return
    inside = True

    def ring(number: int, frame: FrameType | None) -> None:
        # It may come when the block is just over.
        if inside:
            raise _Alarm

    before = signal.signal(signal.SIGALRM, ring)
    remaining, interval = signal.setitimer(signal.ITIMER_REAL, seconds)
    start = time.monotonic()
    try:
        yield
    finally:
        inside = False
        # A timer of the caller's goes on as if it had not been stopped.
        left = max(remaining - (time.monotonic() - start), 1e-6) if remaining else 0.0
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, left, interval)
