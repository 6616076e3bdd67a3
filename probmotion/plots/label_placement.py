"""Placement of labels beside the markers that they name."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["Box", "place_labels"]

Box = tuple[float, float, float, float]
"""Left, top, right, bottom; or left, bottom, right, top with the vertical axis upwards."""

_AROUND = ((1, 0), (0, -1), (0, 1), (1, -1), (1, 1), (-1, 0), (-1, -1), (-1, 1))
_DISTANCES = (3.0, 16.0, 30.0)


def place_labels(
    markers: Mapping[str, Box], sizes: Mapping[str, tuple[float, float]], room: Box
) -> dict[str, tuple[Box, bool]]:
    """Return the box of each label, and whether it is so far away that it needs a line.

    The labels are placed in order, each where it covers the least of the markers, of earlier
    labels and of the area outside the room.

    ``sizes`` are (width, height) of the labels, and the room is the area available to them.
    """
    taken = list(markers.values())
    boxes = {}
    for name, marker in markers.items():
        width, height = sizes[name]
        places = [
            _beside(marker, across, down, distance, width, height)
            for distance in _DISTANCES
            for across, down in _AROUND
        ]
        covered = [_covered(place, taken, room) for place in places]
        best = covered.index(min(covered))
        taken.append(places[best])
        boxes[name] = places[best], best >= len(_AROUND)
    return boxes


def _beside(box: Box, across: int, down: int, distance: float, width: float, height: float) -> Box:
    x = (box[0] + box[2]) / 2 + across * (distance + (box[2] - box[0] + width) / 2)
    y = (box[1] + box[3]) / 2 + down * (distance + (box[3] - box[1] + height) / 2)
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _covered(place: Box, taken: list[Box], room: Box) -> float:
    outside = (place[2] - place[0]) * (place[3] - place[1]) - _overlap(place, room)
    return outside + sum(_overlap(place, other) for other in taken)


def _overlap(one: Box, other: Box) -> float:
    across = min(one[2], other[2]) - max(one[0], other[0])
    down = min(one[3], other[3]) - max(one[1], other[1])
    return max(across, 0.0) * max(down, 0.0)
