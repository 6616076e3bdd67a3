"""Draw the rooms of the project, floor by floor, from their imports."""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib.pyplot as plt

_WINGS = {"probmotion": "#dbe9f6", "samplers": "#fde3cf", "models": "#dff0d8"}
_WIDTH, _HEIGHT, _GAP = 2.9, 0.62, 0.35


def imports_of_rooms(root: Path) -> dict[str, set[str]]:
    """Return the rooms that each room imports; the loose files of probmotion are left out."""
    rooms = {
        ".".join(face.parent.relative_to(root).parts)
        for wing in _WINGS
        for face in (root / wing).rglob("__init__.py")
    } - {"probmotion"}
    graph: dict[str, set[str]] = {room: set() for room in rooms}
    for room in rooms:
        for path in (root / room.replace(".", "/")).glob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    graph[room] |= {_room_of(node.module, rooms)} - {"", room}
    return graph


def _room_of(module: str, rooms: set[str]) -> str:
    name = module
    for wing in ("samplers", "models"):
        name = name.replace(f"probmotion.{wing}", wing, 1)
    while name and name not in rooms:
        name = name.rpartition(".")[0]
    return name


def floors_of(graph: dict[str, set[str]]) -> dict[str, int]:
    """Return each room's floor: one above the highest room that it imports."""
    floors: dict[str, int] = {}

    def floor(room: str) -> int:
        if room not in floors:
            floors[room] = 1 + max((floor(below) for below in graph[room]), default=-1)
        return floors[room]

    for room in graph:
        floor(room)
    return floors


def draw(path: Path) -> None:
    """Write the figure as SVG."""
    graph = imports_of_rooms(Path(__file__).parents[2])
    floors = floors_of(graph)
    rows = [
        sorted(room for room in floors if floors[room] == floor)
        for floor in range(max(floors.values()) + 1)
    ]
    figure, axes = plt.subplots(figsize=(11, 0.62 * len(rows) + 0.6))
    places = {}
    for height, row in enumerate(rows):
        for column, room in enumerate(row):
            x = (column - (len(row) - 1) / 2) * (_WIDTH + _GAP)
            places[room] = (x, height * (_HEIGHT + _GAP))
    for room, targets in graph.items():
        for target in targets:
            (x, y), (a, b) = places[room], places[target]
            axes.annotate(
                "",
                (a, b + _HEIGHT / 2),
                (x, y - _HEIGHT / 2),
                arrowprops={"arrowstyle": "-|>", "color": "#9aa7b4", "lw": 0.5, "alpha": 0.6},
            )
    for room, (x, y) in places.items():
        colour = _WINGS[room.partition(".")[0]]
        box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "#56646f"}
        label = room.removeprefix("probmotion.").replace(".", "/")
        axes.text(x, y, label, ha="center", va="center", fontsize=8, bbox=box)
    xs, ys = zip(*places.values(), strict=True)
    axes.set_xlim(min(xs) - _WIDTH, max(xs) + _WIDTH)
    axes.set_ylim(min(ys) - 1, max(ys) + 1)
    axes.set_axis_off()
    with plt.rc_context({"svg.hashsalt": "house"}):
        figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)
