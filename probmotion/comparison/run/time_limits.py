"""Time limit for a block of code."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from probmotion.comparison.results.failures import TimeLimitExceeded

__all__ = ["time_limit"]


class _Alarm(BaseException):
    """Exception that ends a block; not an ``Exception``, so that samplers do not catch it."""


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Raise :class:`TimeLimitExceeded` if the block takes longer than ``seconds``.

    In the main thread of a system with interval timers the block is interrupted, between two
    Python instructions, and again if it goes on; elsewhere the error is raised at the end of the
    block. None means no limit.
    """
    if seconds is None:
        yield
        return
    start = time.monotonic()
    interrupted = False
    try:
        with _alarm(seconds):
            yield
    except _Alarm:
        interrupted = True
    except Exception as error:
        # Some libraries wrap errors raised in their callbacks.
        if time.monotonic() - start > seconds:
            raise TimeLimitExceeded(seconds) from error
        raise
    if interrupted or time.monotonic() - start > seconds:
        raise TimeLimitExceeded(seconds)


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not (in_main_thread and hasattr(signal, "setitimer")):
        yield
        return
    inside = True

    def interrupt(number: int, frame: FrameType | None) -> None:
        # The signal may arrive just after the end of the block.
        if inside:
            raise _Alarm

    start = time.monotonic()
    remaining, interval = signal.getitimer(signal.ITIMER_REAL)
    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        # Python ignores an exception that is raised in a destructor or in a callback of the garbage
        # collector: the alarm repeats. Clean-up has at least a second.
        signal.setitimer(signal.ITIMER_REAL, seconds, max(seconds, 1.0))
        yield
    finally:
        inside = False
        signal.setitimer(signal.ITIMER_REAL, 0)
        # Resume a timer of the caller.
        rest = max(remaining - (time.monotonic() - start), 1e-6) if remaining else 0.0
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, rest, interval)
