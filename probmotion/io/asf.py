"""Reader of ASF skeleton files.

A bone extends from its parent's end along a world direction in the rest pose and rotates about its
own axes: the world axes rotated by C. A joint is the end of the bone with the same name. The
joint ``root`` is at the origin. Files are Y up, right-handed.

Source: M. Meredith and S. Maddock, "Motion capture file formats explained" (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from probmotion.geometry.rotations import euler_to_matrix
from probmotion.io.errors import (
    MotionFileError,
    decoded_lines,
    errors_in,
    number,
    read_bytes,
    shortened,
)
from probmotion.motion.skeleton import Skeleton

__all__ = ["AcclaimSkeleton", "AcclaimText", "Line", "read_asf"]

_INCH = 0.0254  # metres
_ROOT = "root"
_ROTATIONS = ("RX", "RY", "RZ")
_TRANSLATIONS = ("TX", "TY", "TZ")
_LENGTHS = (1e-3, 1e3)  # valid range of ``length`` in ``:units``
_ENTRIES = ("id", "name", "direction", "length", "axis", "dof", "limits", "bodymass", "cofmass")

Line = tuple[int, list[str]]
"""Line number, starting at 1, and words of a line."""


@dataclass(frozen=True)
class AcclaimText:
    """Nonblank ``lines`` of an ASF or AMC file, without comments, and its line count ``length``."""

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


@dataclass(frozen=True, eq=False)
class AcclaimSkeleton:
    """Content of an ASF file with J joints, ``root`` first.

    Attributes
    ----------
    skeleton : Skeleton
        Joints in the order of the hierarchy.
    offsets : ndarray, (J, 3)
        Offset from the parent in the rest pose, world axes, metres.
    axes : ndarray, (J, 3, 3)
        C, rotation of each bone's axes relative to the world.
    channels : tuple of tuple of str
        Channels of each joint in the file's order, such as ``("RX", "RZ")``; the root may have
        ``"TX"``, ``"TY"`` and ``"TZ"``.
    unit : float
        Metres per unit of length.
    """

    skeleton: Skeleton
    offsets: np.ndarray
    axes: np.ndarray
    channels: tuple[tuple[str, ...], ...]
    unit: float


@dataclass(frozen=True)
class _Bone:
    """Entry of ``:bonedata``; lengths in the file's unit."""

    line: int
    offset: np.ndarray
    axes: np.ndarray
    channels: tuple[str, ...]


def read_asf(path: str | Path) -> AcclaimSkeleton:
    """Read a skeleton from an ASF file.

    The unit of length is an inch divided by the ``length`` of ``:units``; angles are in degrees;
    keywords are case-insensitive.

    Raises
    ------
    MotionFileError
        If the file is truncated, damaged or of another format, or uses unsupported features:
        radians, a root away from the origin, an axis order other than XYZ, or translating bones.
    """
    text = AcclaimText.of(Path(path))
    sections = _sections(text)
    unit = _unit(text, _entries(text, sections, ":units", ("length", "angle")))
    bones = {_ROOT: _root(text, _entries(text, sections, ":root", ("order",)))}
    _add_bones(text, sections[":bonedata"], bones)
    parents = _parents(text, sections[":hierarchy"], bones)
    names = list(parents)
    indices = [-1 if name == _ROOT else names.index(parents[name]) for name in names]
    with errors_in(path):  # such as a cycle in the hierarchy
        skeleton = Skeleton(names, indices)
    return AcclaimSkeleton(
        skeleton,
        np.array([bones[name].offset for name in names]) * unit,
        np.array([bones[name].axes for name in names]),
        tuple(bones[name].channels for name in names),
        unit,
    )


def _sections(text: AcclaimText) -> dict[str, list[Line]]:
    """Return the lines of each section by its keyword, such as ``:units``."""
    sections: dict[str, list[Line]] = {}
    line, words = text.lines[0]
    if not words[0].startswith(":"):
        text.fail(line, f"expected :version, :name or :units, got {shortened(words[0])}")
    for line, words in text.lines:
        if words[0].startswith(":"):
            keyword = words[0].lower()
            if keyword in sections:
                text.fail(line, f"expected one {shortened(words[0])}, got a second")
            sections[keyword] = []
        else:
            sections[keyword].append((line, words))
    for keyword in (":units", ":root", ":bonedata", ":hierarchy"):
        if keyword not in sections:
            text.fail(text.length, f"expected {keyword}, got the end of the file")
    return sections


def _entries(
    text: AcclaimText, sections: dict[str, list[Line]], section: str, needed: tuple[str, ...]
) -> dict[str, Line]:
    """Return the lines of a section by their first word."""
    lines = sections[section]
    entries = {words[0].lower(): (line, words[1:]) for line, words in lines}
    for name in needed:
        if name not in entries:
            text.fail(lines[-1][0] if lines else text.length, f"expected {name} in {section}")
    return entries


def _unit(text: AcclaimText, entries: dict[str, Line]) -> float:
    """Return metres per unit of length."""
    line, words = entries["angle"]
    if [word.lower() for word in words] not in (["deg"], ["degrees"]):
        text.fail(line, f"angle must be deg, got {shortened(' '.join(words))}")
    line, words = entries["length"]
    (length,) = text.numbers(line, "length", words, 1)
    least, most = _LENGTHS
    if not least <= length <= most:
        text.fail(line, f"length must be between {least:g} and {most:g}, got {length:g}")
    return _INCH / length


def _root(text: AcclaimText, entries: dict[str, Line]) -> _Bone:
    """Return the root as a bone of length 0 at the origin."""
    for name in ("position", "orientation"):
        # Programs disagree on whether motions are relative to the position and orientation.
        line, words = entries.get(name, (0, ["0"] * 3))
        if any(text.numbers(line, name, words, 3)):
            text.fail(line, f"{name} must be 0 0 0, got {' '.join(words)[:60]}")
    line, words = entries["order"]
    channels = _channels(text, line, words, _TRANSLATIONS + _ROTATIONS)
    return _Bone(line, np.zeros(3), np.eye(3), channels)


def _add_bones(text: AcclaimText, lines: list[Line], bones: dict[str, _Bone]) -> None:
    """Add the bones of ``:bonedata`` to ``bones``, by name."""
    begun: int | None = None
    entries: dict[str, Line] = {}
    for line, words in lines:
        keyword = words[0].lower()
        if keyword == "begin" and begun is None:
            begun, entries = line, {}
        elif keyword == "end" and begun is not None:
            for needed in ("name", "direction", "length", "axis"):
                if needed not in entries:
                    text.fail(line, f"expected {needed} in the bone of line {begun}, got end")
            name_line, names = entries["name"]
            name = " ".join(names)
            if not name or name in bones:
                text.fail(name_line, f"name must be nonempty and unique, got {shortened(name)}")
            bones[name] = _bone(text, begun, entries)
            begun = None
        elif begun is None or not (keyword in _ENTRIES or keyword.startswith("(")):
            wanted = "begin" if begun is None else f"{', '.join(_ENTRIES)} or end"
            text.fail(line, f"expected {wanted}, got {shortened(words[0])}")
        elif keyword in entries:
            text.fail(line, f"expected one {keyword} in the bone of line {begun}, got a second")
        elif not keyword.startswith("("):  # further limits are ignored
            entries[keyword] = (line, words[1:])
    if begun is not None:
        text.fail(lines[-1][0], f"expected end of the bone of line {begun}, got none")


def _bone(text: AcclaimText, begun: int, entries: dict[str, Line]) -> _Bone:
    """Return the bone that begins at line ``begun``."""
    line, words = entries["length"]
    (length,) = text.numbers(line, "length", words, 1)
    if length < 0:
        text.fail(line, f"length must be at least 0, got {length:g}")
    line, words = entries["direction"]
    direction = np.array(text.numbers(line, "direction", words, 3))
    if length > 0 and abs(np.linalg.norm(direction) - 1) > 1e-3:
        text.fail(line, f"direction must be a unit vector, got {' '.join(words)[:60]}")
    line, words = entries["axis"]
    if [word.upper() for word in words[3:]] != ["XYZ"]:
        text.fail(line, f"axis must be three angles and XYZ, got {shortened(' '.join(words))}")
    angles = np.deg2rad(text.numbers(line, "axis", words[:3], 3))
    line, words = entries.get("dof", (begun, []))
    channels = _channels(text, line, words, _ROTATIONS)
    # The axes are rotated about X first and about Z last.
    return _Bone(begun, direction * length, euler_to_matrix(angles[::-1], "ZYX"), channels)


def _channels(
    text: AcclaimText, line: int, words: list[str], known: tuple[str, ...]
) -> tuple[str, ...]:
    channels = tuple(word.upper() for word in words)
    for index, channel in enumerate(channels):
        if channel not in known or channel in channels[:index]:
            got = shortened(words[index])
            text.fail(line, f"expected channels {', '.join(known)}, each at most once, got {got}")
    return channels


def _parents(text: AcclaimText, lines: list[Line], bones: dict[str, _Bone]) -> dict[str, str]:
    """Return the name of each joint's parent, root first; the root is its own parent."""
    for index, keyword in ((0, "begin"), (-1, "end")):
        line, words = lines[index] if lines else (text.length, [])
        if [word.lower() for word in words] != [keyword]:
            text.fail(line, f"expected begin and end around the hierarchy, got no {keyword}")
    parents = {_ROOT: _ROOT}
    for line, words in lines[1:-1]:
        for name in words:
            if name not in bones:
                text.fail(line, f"expected a bone of :bonedata, got {shortened(name)}")
        for name in words[1:]:
            if name in parents:
                text.fail(line, f"expected one parent of {shortened(name)}, got a second")
            parents[name] = words[0]
    for name, bone in bones.items():
        if name not in parents:
            text.fail(bone.line, f"expected {shortened(name)} in the hierarchy, got no parent")
    return parents
