"""Why a cell has no draws: one word for the table, one sentence, and where it happened."""

from __future__ import annotations

import traceback
from dataclasses import dataclass

from probmotion.posteriors.sampling import UnsupportedPosterior

__all__ = ["CellNotKept", "Failure", "NotFinite", "TimeIsUp", "WorkerDied"]

# What libraries say where memory ends, if they do not raise a MemoryError.
_MEMORY_KINDS = ("OutOfMemoryError",)
_MEMORY_SIGNS = ("RESOURCE_EXHAUSTED", "can't allocate memory", "Unable to allocate")
_NAN_SIGN = "NaN or infinite"


class CellNotKept(OSError):  # noqa: N818 (it says what happened)
    """A finished cell could not be written; what was finished before it is there."""


class NotFinite(ValueError):  # noqa: N818
    """Draws are NaN or infinite."""


class TimeIsUp(RuntimeError):  # noqa: N818
    """A cell took longer than its limit.

    Parameters
    ----------
    seconds : float
        The limit.
    """

    def __init__(self, seconds: float) -> None:
        super().__init__(f"took longer than time_limit, {seconds:g} seconds")
        self.seconds = seconds

    def __reduce__(self) -> tuple[type[TimeIsUp], tuple[float]]:
        return TimeIsUp, (self.seconds,)


class WorkerDied(RuntimeError):  # noqa: N818
    """The process that ran a cell ended; ``killed`` says whether from outside, as when memory ends.

    Parameters
    ----------
    killed : bool
        Whether by the signal that cannot be refused.
    """

    def __init__(self, killed: bool) -> None:
        super().__init__(
            "a worker process died while this cell ran, perhaps for want of memory; "
            "expected it to finish"
        )
        self.killed = killed


@dataclass(frozen=True)
class Failure:
    """What a cell holds in place of draws.

    Parameters
    ----------
    word : str
        ``memory``, ``time``, ``nan``, ``died``; what an
        :class:`~probmotion.posteriors.sampling.UnsupportedPosterior` says, ``budget`` among them;
        else the error's class.
    message : str
        One sentence.
    unsupported : bool
        Whether it would be the same another time; an accident is tried again by the next run.
    traceback : str
        Where it happened.
    """

    word: str
    message: str
    unsupported: bool
    traceback: str = ""

    def __str__(self) -> str:
        return f"{self.word}: {self.message}"

    @classmethod
    def of(cls, error: BaseException) -> Failure:
        """Return what an error amounts to."""
        message = " ".join(str(error).split()) or type(error).__name__
        trace = "".join(traceback.format_exception(error))
        unsupported = isinstance(error, UnsupportedPosterior)
        return cls(_word(error, message), message, unsupported, trace)


def _word(error: BaseException, message: str) -> str:
    if isinstance(error, UnsupportedPosterior):
        return error.word
    if isinstance(error, TimeIsUp):
        return "time"
    if _for_want_of_memory(error, message):
        return "memory"
    if isinstance(error, WorkerDied):
        return "died"
    if isinstance(error, NotFinite | FloatingPointError):
        return "nan"
    # What MotionDraws, densities and gradients say of a sampler's numbers.
    if isinstance(error, ValueError) and _NAN_SIGN in message:
        return "nan"
    return type(error).__name__


def _for_want_of_memory(error: BaseException, message: str) -> bool:
    if isinstance(error, MemoryError) or (isinstance(error, WorkerDied) and error.killed):
        return True
    kind = type(error).__name__
    return kind in _MEMORY_KINDS or any(sign in message for sign in _MEMORY_SIGNS)
