"""Parser of the BVH grammar: joints and channel values.

Source: M. Meredith and S. Maddock, "Motion capture file formats explained" (2001), section 4.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from typing import NoReturn

import numpy as np

from probmotion.io.errors import LARGEST, MotionFileError, decoded_lines, number, shortened

__all__ = ["FRAME_TIMES", "BVHContent", "BVHJoint", "parse_bvh"]

FRAME_TIMES = (1e-4, 1.0)
"""Valid range of frame times, seconds; other values are usually rates or milliseconds."""

_CHANNEL = re.compile(r"([XYZ])(POSITION|ROTATION)")


@dataclass
class BVHJoint:
    """Joint of a ``ROOT``, ``JOINT`` or ``End Site`` block.

    ``parent`` is an index, -1 for a root; parents precede their children. An End Site is named
    after its parent, such as ``Head_end``, and has no channels. ``channels`` contains the axis and
    kind of each channel in the file's order, such as ``("X", "ROTATION")``.
    """

    name: str
    parent: int
    line: int
    end_site: bool = False
    offset: tuple[float, ...] | None = None
    channels: tuple[tuple[str, str], ...] | None = None


@dataclass(frozen=True)
class BVHContent:
    """Content of a BVH file: joints in file order, channel values (L, C) and frames per second."""

    joints: list[BVHJoint]
    values: np.ndarray
    fps: float


def parse_bvh(content: bytes, file: str) -> BVHContent:
    r"""Parse a BVH file in UTF-8 or else Latin-1; ``file`` is its name in error messages.

    Lines may end in ``\n``, ``\r\n`` or ``\r``. Blank lines are skipped. Keywords are
    case-insensitive. A name extends to the end of the line or a brace.
    """
    return _Parser(content, file).parse()


class _Parser:
    def __init__(self, content: bytes, file: str) -> None:
        self.file, self.lines = file, decoded_lines(content)
        self.joints: list[BVHJoint] = []

    def fail(self, line: int, problem: str) -> NoReturn:
        raise MotionFileError(f"{self.file}, line {line}: {problem}")

    def number(self, line: int, word: str) -> float:
        return number(word, f"{self.file}, line {line}")

    def parse(self) -> BVHContent:
        keywords = [line.strip().upper() for line in self.lines] + ["MOTION"]
        motion_line = keywords.index("MOTION") + 1
        self.parse_hierarchy(motion_line)
        if motion_line > len(self.lines):
            self.fail(len(self.lines), "expected MOTION after the hierarchy, got no such line")
        return BVHContent(self.joints, *self.parse_motion(motion_line))

    def parse_hierarchy(self, motion_line: int) -> None:
        """Parse the lines before ``MOTION``."""
        statements = [
            (line, part.split())
            for line, text in enumerate(self.lines[: motion_line - 1], start=1)
            for part in re.split(r"([{}])", text)
            if part.strip()
        ]
        end = min(motion_line, len(self.lines))
        line, words = statements[0] if statements else (end, [])
        if [word.upper() for word in words] != ["HIERARCHY"]:
            self.fail(line, f"expected HIERARCHY, got {shortened(' '.join(words))}")

        declared: BVHJoint | None = None  # joint whose opening brace is still missing
        blocks: list[BVHJoint] = []  # joints whose brace is open
        for line, words in statements[1:]:
            keyword = words[0].upper()
            if (declared is not None) != (keyword == "{"):
                wanted = "'{'" if declared else "ROOT, JOINT, End Site, OFFSET, CHANNELS or '}'"
                self.fail(line, f"expected {wanted}, got {shortened(words[0])}")
            if declared is not None:
                blocks.append(declared)
                declared = None
            elif keyword == "}":
                if not blocks:
                    self.fail(line, "expected ROOT or MOTION, got '}' without an open brace")
                joint = blocks.pop()
                for part, value in (("OFFSET", joint.offset), ("CHANNELS", joint.channels)):
                    if value is None:
                        self.fail(line, f"expected {part} in {shortened(joint.name)}, got '}}'")
            elif keyword in ("ROOT", "JOINT", "END"):
                declared = self.declare(line, words, blocks)
                self.joints.append(declared)
            elif keyword in ("OFFSET", "CHANNELS"):
                if not blocks:
                    self.fail(line, f"expected ROOT, got {keyword} outside a joint")
                self.describe(line, words, blocks[-1])
            else:
                wanted = "ROOT, JOINT, End Site, OFFSET, CHANNELS, a brace or MOTION"
                self.fail(line, f"expected {wanted}, got {shortened(words[0])}")
        if declared is not None or blocks:
            joint = declared or blocks[-1]
            name = shortened(joint.name)
            self.fail(end, f"expected the closing brace of {name} of line {joint.line}, got none")
        if not self.joints:
            self.fail(end, "expected ROOT in the hierarchy, got none")

    def declare(self, line: int, words: list[str], blocks: list[BVHJoint]) -> BVHJoint:
        """Return the joint of a ``ROOT``, ``JOINT`` or ``End Site`` line."""
        keyword, name, parent = words[0].upper(), " ".join(words[1:]), -1
        if keyword == "ROOT" and blocks:
            outer = shortened(blocks[-1].name)
            self.fail(line, f"expected ROOT outside braces, got one inside {outer}")
        if keyword != "ROOT":
            if not blocks:
                self.fail(line, f"expected ROOT, got {' '.join(words[:2])[:40]} outside a joint")
            if blocks[-1].end_site:
                self.fail(line, f"expected OFFSET or '}}' inside an End Site, got {keyword}")
            parent = next(i for i, joint in enumerate(self.joints) if joint is blocks[-1])
        if keyword == "END":
            if [word.upper() for word in words[1:2]] != ["SITE"]:
                self.fail(line, f"expected End Site, got {shortened(' '.join(words))}")
            return BVHJoint(f"{blocks[-1].name}_end", parent, line, end_site=True, channels=())
        if not name:
            self.fail(line, f"expected a name after {words[0]}, got none")
        for joint in self.joints:
            if joint.name == name and not joint.end_site:
                got = f"{shortened(name)} again, as in line {joint.line}"
                self.fail(line, f"expected unique names, got {got}")
        return BVHJoint(name, parent, line)

    def describe(self, line: int, words: list[str], joint: BVHJoint) -> None:
        """Parse an ``OFFSET`` or ``CHANNELS`` line of ``joint``."""
        keyword = words[0].upper()
        if joint.end_site and keyword == "CHANNELS":
            self.fail(line, "expected OFFSET or '}' inside an End Site, got CHANNELS")
        if (joint.offset if keyword == "OFFSET" else joint.channels) is not None:
            self.fail(line, f"expected one {keyword} of {shortened(joint.name)}, got a second")
        if keyword == "OFFSET":
            joint.offset = tuple(self.number(line, word) for word in words[1:])
            if len(joint.offset) != 3:
                self.fail(line, f"expected 3 values of OFFSET, got {len(joint.offset)}")
        else:
            joint.channels = self.channels(line, words[1:])

    def channels(self, line: int, words: Sequence[str]) -> tuple[tuple[str, str], ...]:
        """Return the axis and kind of each declared channel."""
        count, n_listed = words[0] if words else "", max(len(words) - 1, 0)
        if count != str(n_listed):
            self.fail(line, f"expected {shortened(count)} channels as declared, got {n_listed}")
        channels: list[tuple[str, str]] = []
        for word in words[1:]:
            match = _CHANNEL.fullmatch(word.upper())
            if match is None or match.groups() in channels:
                self.fail(
                    line,
                    "expected channels Xposition, Yposition, Zposition, Xrotation, Yrotation and "
                    f"Zrotation, each at most once, got {shortened(word)}",
                )
            channels.append((match[1], match[2]))
        return tuple(channels)

    def parse_motion(self, motion_line: int) -> tuple[np.ndarray, float]:
        """Return the channel values and the frame rate of the lines after ``MOTION``."""
        rows = [
            (line, text)
            for line, text in enumerate(self.lines[motion_line:], start=motion_line + 1)
            if text.strip()
        ]
        header = []
        for position, key in enumerate(("Frames", "Frame Time")):
            line, text = rows[position] if position < len(rows) else (len(self.lines), "")
            before, colon, value = text.partition(":")
            if " ".join(before.split()).upper() != key.upper() or not colon:
                got = shortened(text.strip()) if text else "the end of the file"
                self.fail(line, f"expected '{key}: …', got {got}")
            header.append((line, value.strip()))
        (line, frames), frame_time = header
        if re.fullmatch(r"[0-9]{1,9}", frames) is None or int(frames) == 0:
            self.fail(line, f"Frames must be an integer of at least 1, got {shortened(frames)}")
        fps = self.frame_rate(*frame_time)
        return self.table(rows[2:], int(frames), line), fps

    def frame_rate(self, line: int, text: str) -> float:
        """Return frames per second.

        A frame time such as 0.033333 s is read as an integer rate if both agree to the last printed
        digit and to 0.15 %.
        """
        frame_time = self.number(line, text)
        least, most = FRAME_TIMES
        if not least <= frame_time <= most:
            self.fail(line, f"Frame Time must be {least:g} to {most:g} seconds, got {text[:40]}")
        rate = round(1 / frame_time)
        last_digit = 10.0 ** float(Decimal(text).as_tuple().exponent)
        if abs(1 / rate - frame_time) <= min(last_digit, 1.5e-3 * frame_time):
            return float(rate)
        return 1 / frame_time

    def table(self, rows: list[tuple[int, str]], frames: int, frames_line: int) -> np.ndarray:
        """Return the channel values, one row per frame."""
        columns = sum(len(joint.channels or ()) for joint in self.joints)
        if columns == 0:
            self.fail(frames_line, "expected at least one channel in the hierarchy, got none")
        if len(rows) != frames:
            line = rows[-1][0] if rows else len(self.lines)
            wanted = f"{frames} lines of values, as declared in line {frames_line}"
            self.fail(line, f"expected {wanted}, got {len(rows)}")
        values = np.full((frames, columns), np.nan)
        for row, (line, text) in zip(values, rows, strict=True):
            words = text.split()
            if len(words) != columns:
                self.fail(line, f"expected {columns} values, one per channel, got {len(words)}")
            with suppress(ValueError):  # the row stays NaN
                row[:] = [float(word) for word in words]
        # float() also accepts nan and 1_0; the slower check rejects them and names the line.
        suspect = ~(np.abs(values) <= LARGEST).all(axis=1)
        suspect |= np.array(["_" in text or not text.isascii() for _, text in rows])
        for frame in np.flatnonzero(suspect):
            line, text = rows[frame]
            for word in text.split():
                self.number(line, word)
        return values
