"""Lines of ASF and AMC files (Acclaim's formats)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from probmotion.io.errors import MotionFileError, decoded_lines, number, read_bytes

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
        split = ((line, text.partition("#")[0].split()) for line, text in enumerate(raw, 1))
        text = cls(str(path), [(line, words) for line, words in split if words], len(raw))
        if not text.lines:
            text.fail(text.length, "expected a line that begins with ':', got nothing")
        return text

    def fail(self, line: int, problem: str) -> NoReturn:
        """Raise a :class:`MotionFileError` for a line."""
        raise MotionFileError(f"{self.file}, line {line}: {problem}")

    def numbers(self, line: int, name: str, words: list[str], count: int) -> list[float]:
        """Return ``count`` finite numbers of moderate size from ``words``."""
        if len(words) != count:
            self.fail(line, f"{name}: expected {count} values, got {len(words)}")
        where = f"{self.file}, line {line}: {name}"
        return [number(word, where) for word in words]
