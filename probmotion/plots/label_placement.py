"""Where a label goes: beside what it names, where it covers least."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["Box", "place_labels"]

Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""

_AROUND = ((1, 0), (0, -1), (0, 1), (1, -1), (1, 1), (-1, 0), (-1, -1), (-1, 1))
_DISTANCES = (3.0, 16.0, 30.0)


def place_labels(
    marks: Mapping[str, Box], sizes: Mapping[str, tuple[float, float]], room: Box
) -> dict[str, tuple[Box, bool]]:
    """Return each label's box, and whether it is so far from its mark that it needs a line.

    One label after the other takes the first place around its mark that covers least of the marks,
    of the labels before it and of what is outside the room.

    Parameters
    ----------
    marks : mapping of Box
        What the labels name, by label.
    sizes : mapping of (width, height)
        Of the labels.
    room : Box
        Where they may be.
    """
    taken = list(marks.values())
    found = {}
    for name, mark in marks.items():
        width, height = sizes[name]
        places = [
            _beside(mark, across, down, distance, width, height)
            for distance in _DISTANCES
            for across, down in _AROUND
        ]
        covered = [_covered(place, taken, room) for place in places]
        best = covered.index(min(covered))
        taken.append(places[best])
        found[name] = places[best], best >= len(_AROUND)
    return found


def _beside(mark: Box, across: int, down: int, distance: float, width: float, height: float) -> Box:
    x = (mark[0] + mark[2]) / 2 + across * (distance + (mark[2] - mark[0] + width) / 2)
    y = (mark[1] + mark[3]) / 2 + down * (distance + (mark[3] - mark[1] + height) / 2)
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _covered(place: Box, taken: list[Box], room: Box) -> float:
    outside = (place[2] - place[0]) * (place[3] - place[1]) - _overlap(place, room)
    return outside + sum(_overlap(place, other) for other in taken)


def _overlap(one: Box, other: Box) -> float:
    across = min(one[2], other[2]) - max(one[0], other[0])
    down = min(one[3], other[3]) - max(one[1], other[1])
    return max(across, 0.0) * max(down, 0.0)
