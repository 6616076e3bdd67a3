"""Failures of runs: the word shown in the table, the message and the traceback."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from typing import Any

from probmotion.posteriors.sampling import UnsupportedPosterior
from probmotion.validation import check_types

__all__ = [
    "NOT_INSTALLED", "Failure", "NonFiniteDraws", "ResultNotWritten", "TimeLimitExceeded",
    "WorkerDied", "read_failure",
]  # fmt: skip

NOT_INSTALLED = "not installed"
"""Word of failures for lack of an optional library."""

# Class names and messages of out-of-memory errors other than MemoryError.
_MEMORY_KINDS = ("OutOfMemoryError",)
_MEMORY_SIGNS = ("RESOURCE_EXHAUSTED", "can't allocate memory", "Unable to allocate")
_NAN_SIGN = "NaN or infinite"  # part of the messages of this package


class ResultNotWritten(OSError):  # noqa: N818
    """Error for a result of a run or pilot that could not be written."""


class NonFiniteDraws(ValueError):  # noqa: N818
    """Error for draws that are NaN, infinite or too large for the metrics."""


class TimeLimitExceeded(RuntimeError):  # noqa: N818
    """Error for a run that took longer than ``seconds``."""

    def __init__(self, seconds: float) -> None:
        super().__init__(f"took longer than time_limit, {seconds:g} seconds")
        self.seconds = seconds

    def __reduce__(self) -> tuple[type[TimeLimitExceeded], tuple[float]]:
        return TimeLimitExceeded, (self.seconds,)


class WorkerDied(RuntimeError):  # noqa: N818
    """Error for a worker process that died; ``killed``: by SIGKILL, often for lack of memory."""

    def __init__(self, killed: bool) -> None:
        super().__init__("a worker process died during this run, possibly out of memory")
        self.killed = killed


@dataclass(frozen=True)
class Failure:
    """Reason why a run has no draws.

    Parameters
    ----------
    word : str
        Reason in one or two words: ``memory``, ``time``, ``nan``, ``died``, ``not installed``, the
        word of an :class:`~probmotion.posteriors.sampling.UnsupportedPosterior` such as ``budget``,
        or the class of the error.
    message : str
        Error message on one line.
    unsupported : bool
        Whether the sampler does not support the problem. Other failures are retried.
    traceback : str
        Traceback of the error.
    """

    word: str
    message: str
    unsupported: bool
    traceback: str = ""

    def __str__(self) -> str:
        return f"{self.word}: {self.message}"

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        """Return the failure for an error."""
        message = " ".join(str(error).split()) or type(error).__name__
        trace = "".join(traceback.format_exception(error))
        unsupported = isinstance(error, UnsupportedPosterior)
        return cls(_word(error, message), message, unsupported, trace)


def read_failure(stored: dict[str, Any]) -> Failure:
    """Return the failure of a JSON object; raise ``ValueError`` or ``TypeError`` if invalid."""
    failure = Failure(**stored)
    check_types(failure)
    return failure


def _word(error: BaseException, message: str) -> str:
    if isinstance(error, UnsupportedPosterior):
        return error.word
    if isinstance(error, TimeLimitExceeded):
        return "time"
    if _is_out_of_memory(error, message):
        return "memory"
    if isinstance(error, WorkerDied):
        return "died"
    if isinstance(error, ModuleNotFoundError):
        return NOT_INSTALLED
    if isinstance(error, NonFiniteDraws | FloatingPointError):
        return "nan"
    # Raised by MotionDraws, densities and gradients.
    if isinstance(error, ValueError) and _NAN_SIGN in message:
        return "nan"
    return type(error).__name__


def _is_out_of_memory(error: BaseException, message: str) -> bool:
    if isinstance(error, MemoryError) or (isinstance(error, WorkerDied) and error.killed):
        return True
    return type(error).__name__ in _MEMORY_KINDS or any(sign in message for sign in _MEMORY_SIGNS)
