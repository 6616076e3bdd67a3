"""Line-by-line reader of ASF and AMC files (Acclaim formats)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from probmotion.io.errors import MotionFileError, decoded_lines, number, read_bytes

__all__ = ["AcclaimText", "Line"]

Line = tuple[int, list[str]]
"""Line number, starting at 1, and words of a line."""


@dataclass(frozen=True)
class AcclaimText:
    """Nonblank ``lines`` of a text file, without comments, and its line count ``length``."""

    file: str
    lines: list[Line]
    length: int

    @classmethod
    def of(cls, path: Path) -> AcclaimText:
        """Read the lines of a file."""
        raw = decoded_lines(read_bytes(path).rstrip(b"\r\n"))
        split = ((line, text.partition("#")[0].split()) for line, text in enumerate(raw, 1))
        text = cls(str(path), [(line, words) for line, words in split if words], len(raw))
        if not text.lines:
            text.fail(text.length, "expected a line starting with ':', got an empty file")
        return text

    def fail(self, line: int, problem: str) -> NoReturn:
        """Raise a :class:`MotionFileError` for a line."""
        raise MotionFileError(f"{self.file}, line {line}: {problem}")

    def numbers(self, line: int, name: str, words: list[str], count: int) -> list[float]:
        """Parse ``words`` as ``count`` numbers between -1e9 and 1e9."""
        if len(words) != count:
            self.fail(line, f"{name}: expected {count} values, got {len(words)}")
        where = f"{self.file}, line {line}: {name}"
        return [number(word, where) for word in words]
