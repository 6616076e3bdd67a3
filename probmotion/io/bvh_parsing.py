"""The grammar of BVH files: text → joints and channel values, every error with its line.

Source: M. Meredith and S. Maddock, "Motion capture file formats explained" (2001), section 4.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import NoReturn

import numpy as np

from probmotion.io.errors import MotionFileError, shortened

__all__ = ["FRAME_TIMES", "BVHContent", "BVHJoint", "parse_bvh"]

FRAME_TIMES = (1e-4, 1.0)
"""Seconds; a frame time outside is an error, most often a rate or milliseconds instead."""

_LARGEST = 1e9
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_CHANNEL = re.compile(r"([XYZ])(POSITION|ROTATION)")


@dataclass
class BVHJoint:
    """One ``ROOT``, ``JOINT`` or ``End Site`` block.

    Attributes
    ----------
    name : str
        The joint's name; an End Site is called after its parent: ``Head_end``.
    parent : int
        Index of the parent, -1 for a root; a parent comes before its children.
    line : int
        Where the block begins.
    end_site : bool
        Whether it is an End Site, which has no channel.
    offset : tuple of float
        Offset from the parent at rest, file units.
    channels : tuple of (str, str)
        Axis and kind of each channel in the file's order, such as ``("X", "ROTATION")``.
    """

    name: str
    parent: int
    line: int
    end_site: bool = False
    offset: tuple[float, ...] | None = None
    channels: tuple[tuple[str, str], ...] | None = None


@dataclass
class BVHContent:
    """What a BVH file says.

    Attributes
    ----------
    joints : list of BVHJoint
        In the order of the file.
    values : ndarray, (L, C)
        One column per channel, joints in order.
    fps : float
        Frames per second; see :func:`_frame_rate`.
    """

    joints: list[BVHJoint] = field(default_factory=list)
    values: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    fps: float = 0.0


def parse_bvh(content: bytes, file: str) -> BVHContent:
    """Parse a BVH file.

    Line ends may be ``\\n``, ``\\r\\n``, ``\\r`` or a mixture, words are separated by any blanks,
    blank lines are skipped and keywords are read in any case. A name is all words up to the
    line's end or brace.

    Parameters
    ----------
    content : bytes
        The file; UTF-8, or Latin-1 where it is not valid UTF-8.
    file : str
        What to call the file in errors.

    Raises
    ------
    MotionFileError
        If the file is truncated, mis-ordered or damaged; the message names the line.
    """
    return _Parser(content, file).parse()


class _Parser:
    def __init__(self, content: bytes, file: str) -> None:
        self.file = file
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
        self.lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        self.content = BVHContent()

    def fail(self, line: int, problem: str) -> NoReturn:
        raise MotionFileError(f"{self.file}, line {line}: {problem}")

    def parse(self) -> BVHContent:
        motion_line = next(
            (
                number
                for number, line in enumerate(self.lines, start=1)
                if line.strip().upper() == "MOTION"
            ),
            len(self.lines) + 1,
        )
        self.parse_hierarchy(motion_line)
        if motion_line > len(self.lines):
            self.fail(len(self.lines), "the file ends, expected MOTION after the hierarchy")
        self.parse_motion(motion_line)
        return self.content

    # --- HIERARCHY -------------------------------------------------------------------------

    def parse_hierarchy(self, motion_line: int) -> None:
        """Parse what stands before the line of ``MOTION``."""
        statements = [
            (number, part.split())
            for number, line in enumerate(self.lines[: motion_line - 1], start=1)
            for part in re.split(r"([{}])", line)
            if part.strip()
        ]
        if not statements:
            came = "MOTION" if motion_line <= len(self.lines) else "nothing"
            self.fail(min(motion_line, len(self.lines)), f"{came} came, expected HIERARCHY")
        number, words = statements[0]
        if [word.upper() for word in words] != ["HIERARCHY"]:
            self.fail(number, f"{shortened(' '.join(words))} came, expected HIERARCHY")

        declared: BVHJoint | None = None  # a joint whose opening brace is still to come
        open_blocks: list[int] = []
        joints = self.content.joints
        for number, words in statements[1:]:
            keyword = words[0].upper()
            if (declared is not None) != (keyword == "{"):
                wanted = "'{'" if declared else "ROOT, JOINT, End Site, OFFSET, CHANNELS or '}'"
                self.fail(number, f"{shortened(words[0])} came, expected {wanted}")
            if keyword == "{":
                open_blocks.append(len(joints) - 1)
                declared = None
            elif keyword == "}":
                self.close_block(number, open_blocks)
            elif keyword in ("ROOT", "JOINT", "END"):
                declared = self.declare(number, words, open_blocks)
                joints.append(declared)
            elif keyword in ("OFFSET", "CHANNELS"):
                if not open_blocks:
                    self.fail(number, f"{keyword} came outside a joint, expected ROOT")
                self.describe(number, words, joints[open_blocks[-1]])
            else:
                self.fail(
                    number,
                    f"{shortened(words[0])} came, expected ROOT, JOINT, End Site, OFFSET, "
                    "CHANNELS, a brace or MOTION",
                )
        if declared is not None or open_blocks:
            unclosed = declared or joints[open_blocks[-1]]
            end = min(motion_line, len(self.lines))
            self.fail(
                end,
                f"the hierarchy ends inside {shortened(unclosed.name)} of line {unclosed.line}, "
                "expected its closing brace",
            )
        if not joints:
            self.fail(
                min(motion_line, len(self.lines)), "the hierarchy must contain ROOT, got none"
            )

    def declare(self, number: int, words: list[str], open_blocks: list[int]) -> BVHJoint:
        """Return the joint that a line ``ROOT``, ``JOINT`` or ``End Site`` begins."""
        keyword = words[0].upper()
        joints = self.content.joints
        if keyword == "ROOT":
            if open_blocks:
                open_name = joints[open_blocks[-1]].name
                self.fail(
                    number, f"ROOT came inside {shortened(open_name)}, expected it outside braces"
                )
            return BVHJoint(self.new_name(number, words), -1, number)
        if not open_blocks:
            self.fail(number, f"{' '.join(words[:2])[:40]} came outside a joint, expected ROOT")
        parent = open_blocks[-1]
        if joints[parent].end_site:
            self.fail(number, f"{keyword} came inside an End Site, expected OFFSET or '}}'")
        if keyword == "JOINT":
            return BVHJoint(self.new_name(number, words), parent, number)
        if len(words) < 2 or words[1].upper() != "SITE":
            self.fail(number, f"{shortened(' '.join(words))} came, expected End Site")
        end = f"{joints[parent].name}_end"
        return BVHJoint(end, parent, number, end_site=True, channels=())

    def new_name(self, number: int, words: list[str]) -> str:
        """Return the name after ``ROOT`` or ``JOINT``."""
        name = " ".join(words[1:])
        if not name:
            self.fail(number, f"{words[0]} has no name, expected one")
        for joint in self.content.joints:
            if joint.name == name and not joint.end_site:
                self.fail(
                    number,
                    f"joint {shortened(name)} came before at line {joint.line}, expected every "
                    "name once",
                )
        return name

    def describe(self, number: int, words: list[str], joint: BVHJoint) -> None:
        """Parse a line ``OFFSET`` or ``CHANNELS`` of ``joint``."""
        keyword = words[0].upper()
        if keyword == "OFFSET":
            if joint.offset is not None:
                self.fail(number, f"{shortened(joint.name)} has a second OFFSET, expected one")
            joint.offset = tuple(self.number(number, word) for word in words[1:])
            if len(joint.offset) != 3:
                self.fail(number, f"OFFSET has {len(joint.offset)} values, expected 3")
        elif joint.end_site:
            self.fail(number, "CHANNELS came inside an End Site, expected OFFSET or '}'")
        elif joint.channels is not None:
            self.fail(number, f"{shortened(joint.name)} has a second CHANNELS, expected one")
        else:
            joint.channels = self.channels(number, words[1:])

    def channels(self, number: int, words: Sequence[str]) -> tuple[tuple[str, str], ...]:
        """Return the axis and kind of each channel that ``words`` declare."""
        count = words[0] if words else ""
        if count != str(len(words) - 1):
            self.fail(
                number,
                f"CHANNELS announces {shortened(count)} channels and names "
                f"{max(len(words) - 1, 0)}, expected as many as announced",
            )
        found = []
        for word in words[1:]:
            match = _CHANNEL.fullmatch(word.upper())
            if match is None or match.groups() in found:
                self.fail(
                    number,
                    f"channel {shortened(word)} came, expected each of Xposition, Yposition, "
                    "Zposition, Xrotation, Yrotation and Zrotation once at most",
                )
            found.append((match[1], match[2]))
        return tuple(found)

    def close_block(self, number: int, open_blocks: list[int]) -> None:
        if not open_blocks:
            self.fail(number, "'}' came without an open brace, expected ROOT or MOTION")
        joint = self.content.joints[open_blocks.pop()]
        for keyword, value in (("OFFSET", joint.offset), ("CHANNELS", joint.channels)):
            if value is None:
                self.fail(number, f"{shortened(joint.name)} closes without {keyword}, expected one")

    # --- MOTION ----------------------------------------------------------------------------

    def parse_motion(self, motion_line: int) -> None:
        """Parse what stands after the line of ``MOTION``."""
        rows = [
            (number, line)
            for number, line in enumerate(self.lines[motion_line:], start=motion_line + 1)
            if line.strip()
        ]
        header = {}
        for position, key in enumerate(("Frames", "Frame Time")):
            number, line = rows[position] if position < len(rows) else (len(self.lines), "")
            found, colon, value = line.partition(":")
            if " ".join(found.split()).upper() != key.upper() or not colon:
                came = shortened(line.strip()) if line else "the end of the file"
                self.fail(number, f"{came} came, expected '{key}: …'")
            header[key] = (number, value.strip())
        number, frames = header["Frames"]
        if re.fullmatch(r"[0-9]{1,9}", frames) is None or int(frames) == 0:
            self.fail(number, f"Frames must be an integer of at least 1, got {shortened(frames)}")
        self.content.fps = self.frame_rate(*header["Frame Time"])
        self.content.values = self.table(rows[2:], int(frames), number)

    def frame_rate(self, number: int, text: str) -> float:
        """Return frames per second.

        A frame time is printed with a few digits: 0.033333 stands for 30 frames per second. The
        integer rate whose frame time agrees to the last printed digit is taken, where one does
        to 0.15 %; otherwise the reciprocal.
        """
        frame_time = self.number(number, text)
        least, most = FRAME_TIMES
        if not least <= frame_time <= most:
            self.fail(
                number,
                f"Frame Time is {text[:40]} s, expected between {least:g} and {most:g} seconds",
            )
        rate = round(1 / frame_time)
        exponent = Decimal(text).as_tuple().exponent
        last_digit = 10.0 ** float(exponent)
        if abs(1 / rate - frame_time) <= min(last_digit, 1.5e-3 * frame_time):
            return float(rate)
        return 1 / frame_time

    def table(self, rows: list[tuple[int, str]], frames: int, frames_line: int) -> np.ndarray:
        """Return the channel values, one row per frame."""
        columns = sum(len(joint.channels or ()) for joint in self.content.joints)
        if columns == 0:
            self.fail(frames_line, "the hierarchy has no channel, expected at least one")
        if len(rows) != frames:
            self.fail(
                rows[-1][0] if rows else len(self.lines),
                f"the file ends after {len(rows)} lines of values, expected {frames}, the Frames "
                f"of line {frames_line}",
            )
        values = np.empty((frames, columns))
        for row, (number, line) in zip(values, rows, strict=True):
            words = line.split()
            if len(words) != columns:
                self.fail(number, f"{len(words)} values came, expected {columns}, one per channel")
            try:
                row[:] = list(map(float, words))
            except ValueError:
                for word in words:
                    self.number(number, word)
                raise
        # Python's float takes more than BVH does (nan, 1_0): the slower check names the line.
        suspect = ~(np.abs(values) <= _LARGEST).all(axis=1)
        suspect |= np.array(["_" in line or not line.isascii() for _, line in rows])
        for frame in np.flatnonzero(suspect):
            for word in rows[frame][1].split():
                self.number(rows[frame][0], word)
        return values

    def number(self, number: int, word: str) -> float:
        """Return a finite number of moderate size."""
        if _NUMBER.fullmatch(word) is None or abs(float(word)) > _LARGEST:
            self.fail(number, f"{shortened(word)} came, expected a number between -1e9 and 1e9")
        return float(word)
