"""Parser of the BVH grammar: joints and channel values.

Source: M. Meredith and S. Maddock, "Motion capture file formats explained" (2001), section 4.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from typing import NoReturn

import numpy as np

from probmotion.io.errors import MotionFileError, decoded_lines, is_number, shortened

__all__ = ["FRAME_TIMES", "BVHContent", "BVHJoint", "parse_bvh"]

FRAME_TIMES = (1e-4, 1.0)
"""Valid frame times in seconds; others are usually rates or milliseconds."""

_CHANNEL = re.compile(r"([XYZ])(POSITION|ROTATION)")


@dataclass
class BVHJoint:
    """``ROOT``, ``JOINT`` or ``End Site`` block.

    The parent is an index, -1 for a root; parents precede their children. An End Site is named
    after
    its parent, such as ``Head_end``, and has no channels. Others have the axis and kind of each
    channel in the file's order, such as ``("X", "ROTATION")``.
    """

    name: str
    parent: int
    line: int
    end_site: bool = False
    offset: tuple[float, ...] | None = None
    channels: tuple[tuple[str, str], ...] | None = None


@dataclass
class BVHContent:
    """Content of a BVH file: joints in file order, channel values (L, C) and frames per second."""

    joints: list[BVHJoint] = field(default_factory=list)
    values: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    fps: float = 0.0


def parse_bvh(content: bytes, file: str) -> BVHContent:
    r"""Parse a BVH file in UTF-8 or else Latin-1; ``file`` is its name in errors.

    Lines may end in ``\\n``, ``\\r\\n`` or ``\\r``, blank lines are skipped and keywords are
    case-insensitive. A name extends to the end of the line or a brace.

    Raises
    ------
    MotionFileError
        If the file is truncated, out of order or damaged.
    """
    return _Parser(content, file).parse()


class _Parser:
    def __init__(self, content: bytes, file: str) -> None:
        self.file = file
        self.lines = decoded_lines(content)
        self.content = BVHContent()

    def fail(self, line: int, problem: str) -> NoReturn:
        raise MotionFileError(f"{self.file}, line {line}: {problem}")

    def parse(self) -> BVHContent:
        keywords = [line.strip().upper() for line in self.lines] + ["MOTION"]
        motion_line = keywords.index("MOTION") + 1
        self.parse_hierarchy(motion_line)
        if motion_line > len(self.lines):
            self.fail(len(self.lines), "expected MOTION after the hierarchy")
        self.parse_motion(motion_line)
        return self.content

    def parse_hierarchy(self, motion_line: int) -> None:
        """Parse the lines before ``MOTION``."""
        statements = [
            (number, part.split())
            for number, line in enumerate(self.lines[: motion_line - 1], start=1)
            for part in re.split(r"([{}])", line)
            if part.strip()
        ]
        end = min(motion_line, len(self.lines))
        number, words = statements[0] if statements else (end, [])
        if [word.upper() for word in words] != ["HIERARCHY"]:
            self.fail(number, f"expected HIERARCHY, got {shortened(' '.join(words))}")

        declared: BVHJoint | None = None  # a joint without its opening brace
        open_blocks: list[int] = []
        joints = self.content.joints
        for number, words in statements[1:]:
            keyword = words[0].upper()
            if (declared is not None) != (keyword == "{"):
                wanted = "'{'" if declared else "ROOT, JOINT, End Site, OFFSET, CHANNELS or '}'"
                self.fail(number, f"expected {wanted}, got {shortened(words[0])}")
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
                    self.fail(number, f"expected ROOT, got {keyword} outside a joint")
                self.describe(number, words, joints[open_blocks[-1]])
            else:
                wanted = "ROOT, JOINT, End Site, OFFSET, CHANNELS, a brace or MOTION"
                self.fail(number, f"expected {wanted}, got {shortened(words[0])}")
        if declared is not None or open_blocks:
            unclosed = declared or joints[open_blocks[-1]]
            name = shortened(unclosed.name)
            self.fail(end, f"expected the closing brace of {name}, line {unclosed.line}")
        if not joints:
            self.fail(end, "expected ROOT in the hierarchy")

    def declare(self, number: int, words: list[str], open_blocks: list[int]) -> BVHJoint:
        """Return the joint of a ``ROOT``, ``JOINT`` or ``End Site`` line."""
        keyword = words[0].upper()
        joints = self.content.joints
        if keyword == "ROOT":
            if open_blocks:
                outer = shortened(joints[open_blocks[-1]].name)
                self.fail(number, f"expected ROOT outside braces, got it inside {outer}")
            return BVHJoint(self.new_name(number, words), -1, number)
        if not open_blocks:
            self.fail(number, f"expected ROOT, got {' '.join(words[:2])[:40]} outside a joint")
        parent = open_blocks[-1]
        if joints[parent].end_site:
            self.fail(number, f"expected OFFSET or '}}' inside an End Site, got {keyword}")
        if keyword == "JOINT":
            return BVHJoint(self.new_name(number, words), parent, number)
        if len(words) < 2 or words[1].upper() != "SITE":
            self.fail(number, f"expected End Site, got {shortened(' '.join(words))}")
        end = f"{joints[parent].name}_end"
        return BVHJoint(end, parent, number, end_site=True, channels=())

    def new_name(self, number: int, words: list[str]) -> str:
        """Return the name after ``ROOT`` or ``JOINT``."""
        name = " ".join(words[1:])
        if not name:
            self.fail(number, f"expected a name after {words[0]}")
        for joint in self.content.joints:
            if joint.name == name and not joint.end_site:
                self.fail(
                    number, f"expected unique names, got {shortened(name)} as in line {joint.line}"
                )
        return name

    def describe(self, number: int, words: list[str], joint: BVHJoint) -> None:
        """Parse an ``OFFSET`` or ``CHANNELS`` line of ``joint``."""
        keyword = words[0].upper()
        if keyword == "OFFSET":
            if joint.offset is not None:
                self.fail(number, f"expected one OFFSET of {shortened(joint.name)}, got a second")
            joint.offset = tuple(self.number(number, word) for word in words[1:])
            if len(joint.offset) != 3:
                self.fail(number, f"expected 3 values of OFFSET, got {len(joint.offset)}")
        elif joint.end_site:
            self.fail(number, "expected OFFSET or '}' inside an End Site, got CHANNELS")
        elif joint.channels is not None:
            self.fail(number, f"expected one CHANNELS of {shortened(joint.name)}, got a second")
        else:
            joint.channels = self.channels(number, words[1:])

    def channels(self, number: int, words: Sequence[str]) -> tuple[tuple[str, str], ...]:
        """Return the axis and kind of each declared channel."""
        count = words[0] if words else ""
        if count != str(len(words) - 1):
            self.fail(
                number,
                f"expected {shortened(count)} channels as declared, got {max(len(words) - 1, 0)}",
            )
        found = []
        for word in words[1:]:
            match = _CHANNEL.fullmatch(word.upper())
            if match is None or match.groups() in found:
                self.fail(
                    number,
                    "expected channels Xposition, Yposition, Zposition, Xrotation, Yrotation and "
                    f"Zrotation, each at most once, got {shortened(word)}",
                )
            found.append((match[1], match[2]))
        return tuple(found)

    def close_block(self, number: int, open_blocks: list[int]) -> None:
        if not open_blocks:
            self.fail(number, "expected ROOT or MOTION, got '}' without an open brace")
        joint = self.content.joints[open_blocks.pop()]
        for keyword, value in (("OFFSET", joint.offset), ("CHANNELS", joint.channels)):
            if value is None:
                self.fail(number, f"expected {keyword} in {shortened(joint.name)}, got '}}'")

    def parse_motion(self, motion_line: int) -> None:
        """Parse the lines after ``MOTION``."""
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
                got = shortened(line.strip()) if line else "the end of the file"
                self.fail(number, f"expected '{key}: …', got {got}")
            header[key] = (number, value.strip())
        number, frames = header["Frames"]
        if re.fullmatch(r"[0-9]{1,9}", frames) is None or int(frames) == 0:
            self.fail(number, f"Frames must be an integer of at least 1, got {shortened(frames)}")
        self.content.fps = self.frame_rate(*header["Frame Time"])
        self.content.values = self.table(rows[2:], int(frames), number)

    def frame_rate(self, number: int, text: str) -> float:
        """Return frames per second.

        A frame time within its last printed digit (and 0.15 %) of an integer rate, such as 0.033333
        s, is
        taken as that rate.
        """
        frame_time = self.number(number, text)
        least, most = FRAME_TIMES
        if not least <= frame_time <= most:
            self.fail(number, f"Frame Time must be {least:g} to {most:g} seconds, got {text[:40]}")
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
            self.fail(frames_line, "expected at least one channel in the hierarchy, got none")
        if len(rows) != frames:
            self.fail(
                rows[-1][0] if rows else len(self.lines),
                f"expected {frames} lines of values as in line {frames_line}, got {len(rows)}",
            )
        values = np.empty((frames, columns))
        for row, (number, line) in zip(values, rows, strict=True):
            words = line.split()
            if len(words) != columns:
                self.fail(number, f"expected {columns} values, one per channel, got {len(words)}")
            try:
                row[:] = list(map(float, words))
            except ValueError:
                for word in words:
                    self.number(number, word)
                raise
        # float() also accepts nan and 1_0; the slower check rejects them and names the line.
        suspect = ~(np.abs(values) <= 1e9).all(axis=1)
        suspect |= np.array(["_" in line or not line.isascii() for _, line in rows])
        for frame in np.flatnonzero(suspect):
            for word in rows[frame][1].split():
                self.number(rows[frame][0], word)
        return values

    def number(self, number: int, word: str) -> float:
        if not is_number(word):
            self.fail(number, f"expected a number between -1e9 and 1e9, got {shortened(word)}")
        return float(word)
