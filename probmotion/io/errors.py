"""Errors, warnings and text helpers of the file readers."""

from __future__ import annotations

import csv
import io
import re
import reprlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = [
    "LARGEST",
    "MotionFileError",
    "MotionFileWarning",
    "csv_rows",
    "decoded_lines",
    "errors_in",
    "number",
    "read_bytes",
    "shortened",
]

LARGEST = 1e9
"""Largest accepted magnitude of a number in a motion file."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class MotionFileError(ValueError):
    """Error for a damaged file or a wrong format; the message names the file and line or key."""

    def __init__(self, message: str) -> None:
        super().__init__(_on_one_line(message))


class MotionFileWarning(UserWarning):
    """Warning about an assumption made while reading a file."""

    def __init__(self, message: str) -> None:
        super().__init__(_on_one_line(message))


def _on_one_line(message: str) -> str:
    """Escape unprintable characters, such as newlines in joint names of damaged files."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in message)


@contextmanager
def errors_in(where: object) -> Iterator[None]:
    """Convert a ``ValueError`` of the block to a :class:`MotionFileError` about ``where``."""
    try:
        yield
    except MotionFileError:
        raise
    except ValueError as error:
        raise MotionFileError(f"{where}: {error}") from error


def read_bytes(path: Path) -> bytes:
    """Return a file's content; raise :class:`MotionFileError` if it exists but is unreadable."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise MotionFileError(
            f"{path}: expected a readable motion file ({error.strerror})"
        ) from error


def decoded_lines(content: bytes) -> list[str]:
    """Return the lines of a text in UTF-8 (or else Latin-1) with any line endings."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def csv_rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return the line numbers and cells of the nonempty rows of a CSV table."""
    try:
        text = read_bytes(path).decode("utf-8-sig")
        reader = csv.reader(io.StringIO(text, newline=""), strict=True)
        return [(reader.line_num, row) for row in reader if any(row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise MotionFileError(f"{path}: expected a CSV table ({str(error)[:80]})") from error


def number(word: str, where: str) -> float:
    """Parse a decimal number between -1e9 and 1e9; ``where`` is its location in the error."""
    if _NUMBER.fullmatch(word) is None or abs(float(word)) > LARGEST:
        raise MotionFileError(
            f"{where}: expected a number between -1e9 and 1e9, got {shortened(word)}"
        )
    return float(word)


_short = reprlib.Repr()
_short.maxlevel = 2
_short.maxstring = _short.maxother = 60
_short.maxlist = _short.maxtuple = _short.maxdict = 3


def shortened(value: object) -> str:
    """Return ``repr(value)`` truncated for an error message."""
    return _short.repr(value)
