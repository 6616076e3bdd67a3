"""Lines of ASF and AMC files (Acclaim's formats)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from probmotion.io.errors import MotionFileError, decoded_lines, is_number, read_bytes, shortened

__all__ = ["AcclaimText", "Line"]

Line = tuple[int, list[str]]
"""A line's number in the file, from 1, and its words."""


@dataclass(frozen=True)
class AcclaimText:
    """Nonblank lines of a text file without comments, and the number of its last line."""

    file: str
    lines: list[Line]
    length: int

    @classmethod
    def of(cls, path: Path) -> AcclaimText:
        """Read a file."""
        raw = decoded_lines(read_bytes(path).rstrip(b"\r\n"))
        split = ((number, line.partition("#")[0].split()) for number, line in enumerate(raw, 1))
        found = cls(str(path), [(number, words) for number, words in split if words], len(raw))
        if not found.lines:
            found.fail(found.length, "expected a line that begins with ':', got nothing")
        return found

    def fail(self, number: int, problem: str) -> NoReturn:
        """Raise a :class:`MotionFileError` for a line."""
        raise MotionFileError(f"{self.file}, line {number}: {problem}")

    def numbers(self, number: int, what: str, words: list[str], count: int) -> list[float]:
        """Return ``count`` finite numbers of moderate size from ``words``."""
        if len(words) != count:
            self.fail(number, f"{what}: expected {count} values, got {len(words)}")
        for word in words:
            if not is_number(word):
                self.fail(
                    number,
                    f"{what}: expected a number between -1e9 and 1e9, got {shortened(word)}",
                )
        return [float(word) for word in words]
