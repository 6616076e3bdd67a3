"""The lines of ASF and AMC files (Acclaim's formats), and what is said of one that is wrong."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from probmotion.io.errors import MotionFileError, read_bytes, shortened

__all__ = ["AcclaimText", "Line"]

Line = tuple[int, list[str]]
"""A line's number in the file, from 1, and its words."""

_LARGEST = 1e9
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class AcclaimText:
    """A text file without its comments and blank lines.

    Attributes
    ----------
    file : str
        What to call the file in errors.
    lines : list of (int, list of str)
        Numbers and words of the lines that have some.
    length : int
        Number of the last line.
    """

    file: str
    lines: list[Line]
    length: int

    @classmethod
    def of(cls, path: Path) -> AcclaimText:
        """Read a file: UTF-8, or Latin-1 where it is not valid UTF-8, with any line ends.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        MotionFileError
            If it cannot be read, or holds nothing.
        """
        content = read_bytes(path)
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
        raw = text.replace("\r\n", "\n").replace("\r", "\n").rstrip("\n").split("\n")
        split = ((number, line.partition("#")[0].split()) for number, line in enumerate(raw, 1))
        found = cls(str(path), [(number, words) for number, words in split if words], len(raw))
        if not found.lines:
            found.fail(found.length, "nothing came, expected a line that begins with ':'")
        return found

    def fail(self, number: int, problem: str) -> NoReturn:
        """Raise the error of a line."""
        raise MotionFileError(f"{self.file}, line {number}: {problem}")

    def numbers(self, number: int, what: str, words: list[str], count: int) -> list[float]:
        """Return finite numbers of moderate size, ``count`` of them, which line ``number`` has."""
        if len(words) != count:
            self.fail(number, f"{what} has {len(words)} values, expected {count}")
        for word in words:
            if _NUMBER.fullmatch(word) is None or abs(float(word)) > _LARGEST:
                self.fail(
                    number,
                    f"{what} has {shortened(word)}, expected a number between -1e9 and 1e9",
                )
        return [float(word) for word in words]
