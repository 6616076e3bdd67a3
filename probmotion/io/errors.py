"""What readers of motion files raise and warn with."""

from __future__ import annotations

import reprlib
from pathlib import Path

__all__ = ["MotionFileError", "MotionFileWarning", "read_bytes", "shortened"]


class MotionFileError(ValueError):
    """A file is no motion, or is damaged: one sentence with the file and the line or key."""

    def __init__(self, message: str) -> None:
        super().__init__(_on_one_line(message))


class MotionFileWarning(UserWarning):
    """A file was read, but something had to be assumed: one sentence that says what."""

    def __init__(self, message: str) -> None:
        super().__init__(_on_one_line(message))


def _on_one_line(message: str) -> str:
    """Escape what cannot be printed: names from a damaged file may hold line ends and worse."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in message)


def read_bytes(path: Path) -> bytes:
    """Return the content of a file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    MotionFileError
        If it is there and cannot be read.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise MotionFileError(
            f"{path} cannot be read ({error.strerror}), expected a motion file"
        ) from error


_short = reprlib.Repr()
_short.maxlevel = 2
_short.maxstring = _short.maxother = 60
_short.maxlist = _short.maxtuple = _short.maxdict = 3


def shortened(value: object) -> str:
    """Return ``repr(value)`` cut to a length and depth that fit an error message."""
    return _short.repr(value)
