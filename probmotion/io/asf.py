"""Reading skeletons from ASF files: bones, their own axes and what turns about them.

A bone reaches from its parent's end in a direction of the world, in the rest pose, and moves about
axes of its own, which the rest pose turns by C against the world. A joint is the END of its bone
and bears its name; ``root`` is the origin of all. Files are Y up, right-handed.

Source: M. Meredith and S. Maddock, "Motion capture file formats explained" (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probmotion.geometry.rotations import euler_to_matrix
from probmotion.io.acclaim_text import AcclaimText, Line
from probmotion.io.errors import MotionFileError, shortened
from probmotion.motion.skeleton import Skeleton

__all__ = ["AcclaimSkeleton", "read_asf"]

_INCH = 0.0254
_ROOT = "root"
_TURNS = ("RX", "RY", "RZ")
_SHIFTS = ("TX", "TY", "TZ")
_LENGTHS = (1e-3, 1e3)  # of the unit; outside, the file is damaged
_ENTRIES = ("id", "name", "direction", "length", "axis", "dof", "limits", "bodymass", "cofmass")


@dataclass(frozen=True, eq=False)
class AcclaimSkeleton:
    """What an ASF file says of the J joints, ``root`` first.

    Attributes
    ----------
    skeleton : Skeleton
        In the order in which the hierarchy names them.
    offsets : ndarray, (J, 3)
        From the parent's joint to this one in the rest pose, along the axes of the world, metres.
    axes : ndarray, (J, 3, 3)
        C of each bone: what it turns about, against the axes of the world.
    channels : tuple of tuple of str
        What moves each joint in the file's order, such as ``("RX", "RZ")``; the root's may have
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
    """An entry of ``:bonedata``; lengths in the file's unit."""

    line: int
    offset: np.ndarray
    axes: np.ndarray
    channels: tuple[str, ...]


def read_asf(path: str | Path) -> AcclaimSkeleton:
    """Read a skeleton from an ASF file.

    Parameters
    ----------
    path : str or Path
        The file. Its lengths are multiples of an inch divided by the ``length`` of its
        ``:units``, and its angles degrees; keywords are read in any case.

    Raises
    ------
    MotionFileError
        If the file is truncated, damaged or none of this format, or has what is not read: angles
        in radians, a root that rests elsewhere than in the origin, axes in another order than XYZ,
        bones that grow. The message names the line.
    FileNotFoundError
        If there is no such file.
    """
    text = AcclaimText.of(Path(path))
    sections = _sections(text)
    unit = _unit(text, sections[":units"])
    bones = {_ROOT: _root(text, sections[":root"])}
    _add_bones(text, sections[":bonedata"], bones)
    parents = _parents(text, sections[":hierarchy"], bones)
    names = list(parents)
    try:
        skeleton = Skeleton(
            names, [names.index(parents[name]) if name != _ROOT else -1 for name in names]
        )
    except ValueError as error:  # a cycle: every bone has a parent, and one only
        raise MotionFileError(f"{path}: {error}") from error
    return AcclaimSkeleton(
        skeleton,
        np.array([bones[name].offset for name in names]) * unit,
        np.array([bones[name].axes for name in names]),
        tuple(bones[name].channels for name in names),
        unit,
    )


def _sections(text: AcclaimText) -> dict[str, list[Line]]:
    """Return the lines below each keyword that begins with a colon."""
    sections: dict[str, list[Line]] = {}
    number, words = text.lines[0]
    if not words[0].startswith(":"):
        text.fail(number, f"{shortened(words[0])} came, expected :version, :name or :units")
    for number, words in text.lines:
        if words[0].startswith(":"):
            keyword = words[0].lower()
            if keyword in sections:
                text.fail(number, f"{shortened(words[0])} came again, expected it once")
            sections[keyword] = []
        else:
            sections[keyword].append((number, words))
    for keyword in (":units", ":root", ":bonedata", ":hierarchy"):
        if keyword not in sections:
            text.fail(text.length, f"the file ends without {keyword}, expected all of a skeleton")
    return sections


def _unit(text: AcclaimText, lines: list[Line]) -> float:
    """Return metres per unit of length."""
    entries = {words[0].lower(): (number, words[1:]) for number, words in lines}
    for name in ("length", "angle"):
        if name not in entries:
            text.fail(lines[-1][0] if lines else text.length, f":units has no {name}, expected one")
    number, words = entries["angle"]
    if [word.lower() for word in words] not in (["deg"], ["degrees"]):
        text.fail(number, f"angle must be deg, got {shortened(' '.join(words))}")
    number, words = entries["length"]
    (length,) = text.numbers(number, "length", words, 1)
    least, most = _LENGTHS
    if not least <= length <= most:
        text.fail(number, f"length is {length:g}, expected between {least:g} and {most:g}")
    return _INCH / length


def _root(text: AcclaimText, lines: list[Line]) -> _Bone:
    """Return the root, a bone without length at the origin."""
    entries = {words[0].lower(): (number, words[1:]) for number, words in lines}
    if "order" not in entries:
        text.fail(lines[-1][0] if lines else text.length, ":root has no order, expected one")
    for name in ("position", "orientation"):
        # Readers differ in whether a motion counts from there.
        number, words = entries.get(name, (0, ["0"] * 3))
        if any(text.numbers(number, name, words, 3)):
            text.fail(number, f"{name} must be 0 0 0, got {' '.join(words)[:60]}")
    number, words = entries["order"]
    channels = _channels(text, number, words, _SHIFTS + _TURNS)
    return _Bone(number, np.zeros(3), np.eye(3), channels)


def _add_bones(text: AcclaimText, lines: list[Line], bones: dict[str, _Bone]) -> None:
    """Put the bones of ``:bonedata`` beside the root, by name."""
    begun: int | None = None
    entries: dict[str, Line] = {}
    for number, words in lines:
        keyword = words[0].lower()
        if keyword == "begin" and begun is None:
            begun, entries = number, {}
        elif keyword == "end" and begun is not None:
            for needed in ("name", "direction", "length", "axis"):
                if needed not in entries:
                    text.fail(number, f"the bone of line {begun} has no {needed}, expected one")
            name = " ".join(entries["name"][1])
            if not name or name in bones:
                text.fail(entries["name"][0], f"name must be a new one, got {shortened(name)}")
            bones[name] = _bone(text, begun, entries)
            begun = None
        elif begun is None or not (keyword in _ENTRIES or keyword.startswith("(")):
            wanted = "begin" if begun is None else f"{', '.join(_ENTRIES)} or end"
            text.fail(number, f"{shortened(words[0])} came, expected {wanted}")
        elif keyword in entries:
            text.fail(number, f"{keyword} came again in the bone of line {begun}, expected it once")
        elif not keyword.startswith("("):  # those are further limits
            entries[keyword] = (number, words[1:])
    if begun is not None:
        text.fail(lines[-1][0], f":bonedata ends inside the bone of line {begun}, expected its end")


def _bone(text: AcclaimText, begun: int, entries: dict[str, Line]) -> _Bone:
    """Return the bone that begins at a line."""
    number, words = entries["direction"]
    direction = np.array(text.numbers(number, "direction", words, 3))
    (length,) = text.numbers(entries["length"][0], "length", entries["length"][1], 1)
    if length < 0:
        text.fail(entries["length"][0], f"length must be 0 or more, got {length:g}")
    if length > 0 and abs(np.linalg.norm(direction) - 1) > 1e-3:
        text.fail(number, f"direction must be a vector of length 1, got {' '.join(words)[:60]}")
    number, words = entries["axis"]
    if [word.upper() for word in words[3:]] != ["XYZ"]:
        text.fail(number, f"axis must be three angles and XYZ, got {shortened(' '.join(words))}")
    angles = np.deg2rad(text.numbers(number, "axis", words[:3], 3))
    number, words = entries.get("dof", (begun, []))
    channels = _channels(text, number, words, _TURNS)
    # About X first, and about Z last.
    return _Bone(begun, direction * length, euler_to_matrix(angles[::-1], "ZYX"), channels)


def _channels(
    text: AcclaimText, number: int, words: list[str], known: tuple[str, ...]
) -> tuple[str, ...]:
    """Return the channels that a line names."""
    channels = tuple(word.upper() for word in words)
    for place, channel in enumerate(channels):
        if channel not in known or channel in channels[:place]:
            text.fail(
                number,
                f"channel {shortened(words[place])} came, expected each of {', '.join(known)} once "
                "at most",
            )
    return channels


def _parents(text: AcclaimText, lines: list[Line], bones: dict[str, _Bone]) -> dict[str, str]:
    """Return the parent of each joint by name, the root first and its own."""
    for place, wanted in ((0, "begin"), (-1, "end")):
        if not lines or [word.lower() for word in lines[place][1]] != [wanted]:
            number = lines[place][0] if lines else text.length
            text.fail(number, f"{wanted} did not come, expected it around the hierarchy")
    parents = {_ROOT: _ROOT}
    for number, words in lines[1:-1]:
        for name in words:
            if name not in bones:
                text.fail(number, f"{shortened(name)} came, expected a bone of :bonedata")
        for name in words[1:]:
            if name in parents:
                text.fail(number, f"{shortened(name)} has a second parent, expected one")
            parents[name] = words[0]
    for name, bone in bones.items():
        if name not in parents:
            text.fail(
                bone.line, f"bone {shortened(name)} has no parent in the hierarchy, expected one"
            )
    return parents
