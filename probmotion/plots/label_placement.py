"""Placement of labels beside markers."""

from __future__ import annotations

from collections.abc import Mapping

__all__ = ["Box", "place_labels"]

Box = tuple[float, float, float, float]
"""Box (left, top, right, bottom); (left, bottom, right, top) if the vertical axis is upwards."""

# Candidate directions (across, down) and distances of labels from their markers.
_AROUND = ((1, 0), (0, -1), (0, 1), (1, -1), (1, 1), (-1, 0), (-1, -1), (-1, 1))
_DISTANCES = (3.0, 16.0, 30.0)


def place_labels(
    markers: Mapping[str, Box], sizes: Mapping[str, tuple[float, float]], room: Box
) -> dict[str, tuple[Box, bool]]:
    """Return the box of each label and whether it needs a line to its marker.

    Labels are placed in order, each at the position with the least overlap with markers, earlier
    labels and the area outside ``room``. ``sizes`` contains the (width, height) of each label.
    """
    occupied = list(markers.values())
    boxes = {}
    for name, marker in markers.items():
        width, height = sizes[name]
        candidates = [
            _beside(marker, across, down, distance, width, height)
            for distance in _DISTANCES
            for across, down in _AROUND
        ]
        overlaps = [_covered(candidate, occupied, room) for candidate in candidates]
        best = overlaps.index(min(overlaps))
        occupied.append(candidates[best])
        boxes[name] = candidates[best], best >= len(_AROUND)
    return boxes


def _beside(box: Box, across: int, down: int, distance: float, width: float, height: float) -> Box:
    x = (box[0] + box[2]) / 2 + across * (distance + (box[2] - box[0] + width) / 2)
    y = (box[1] + box[3]) / 2 + down * (distance + (box[3] - box[1] + height) / 2)
    return x - width / 2, y - height / 2, x + width / 2, y + height / 2


def _covered(label: Box, taken: list[Box], room: Box) -> float:
    outside = (label[2] - label[0]) * (label[3] - label[1]) - _overlap(label, room)
    return outside + sum(_overlap(label, other) for other in taken)


def _overlap(first: Box, second: Box) -> float:
    across = min(first[2], second[2]) - max(first[0], second[0])
    down = min(first[3], second[3]) - max(first[1], second[1])
    return max(across, 0.0) * max(down, 0.0)
