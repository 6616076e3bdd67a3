"""Diagram of the packages by level, generated from their imports."""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib.pyplot as plt

_WINGS = {"probmotion": "#dbe9f6", "samplers": "#fde3cf", "models": "#dff0d8"}
_WIDTH, _HEIGHT, _GAP = 2.9, 0.62, 0.35


def imports_of_rooms(root: Path) -> dict[str, set[str]]:
    """Return the packages that each package imports, without the top level of probmotion."""
    rooms = {
        ".".join(init.parent.relative_to(root).parts)
        for folder in _WINGS
        for init in (root / folder).rglob("__init__.py")
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
    for folder in ("samplers", "models"):
        name = name.replace(f"probmotion.{folder}", folder, 1)
    while name and name not in rooms:
        name = name.rpartition(".")[0]
    return name


def floors_of(graph: dict[str, set[str]]) -> dict[str, int]:
    """Return the level of each package: one above the highest package that it imports."""
    floors: dict[str, int] = {}

    def floor(room: str) -> int:
        if room not in floors:
            floors[room] = 1 + max((floor(below) for below in graph[room]), default=-1)
        return floors[room]

    for room in graph:
        floor(room)
    return floors


def draw(path: Path) -> None:
    """Write the diagram as SVG."""
    graph = imports_of_rooms(Path(__file__).parents[2])
    floors = floors_of(graph)
    rows = [
        sorted(room for room in floors if floors[room] == floor)
        for floor in range(max(floors.values()) + 1)
    ]
    figure, axes = plt.subplots(figsize=(11, 0.62 * len(rows) + 0.6))
    positions = {}
    for height, row in enumerate(rows):
        for column, room in enumerate(row):
            x = (column - (len(row) - 1) / 2) * (_WIDTH + _GAP)
            positions[room] = (x, height * (_HEIGHT + _GAP))
    for room, targets in graph.items():
        for target in targets:
            (x, y), (a, b) = positions[room], positions[target]
            axes.annotate(
                "",
                (a, b + _HEIGHT / 2),
                (x, y - _HEIGHT / 2),
                arrowprops={"arrowstyle": "-|>", "color": "#9aa7b4", "lw": 0.5, "alpha": 0.6},
            )
    for room, (x, y) in positions.items():
        colour = _WINGS[room.partition(".")[0]]
        box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "#56646f"}
        label = room.removeprefix("probmotion.").replace(".", "/")
        axes.text(x, y, label, ha="center", va="center", fontsize=8, bbox=box)
    xs, ys = zip(*positions.values(), strict=True)
    axes.set_xlim(min(xs) - _WIDTH, max(xs) + _WIDTH)
    axes.set_ylim(min(ys) - 1, max(ys) + 1)
    axes.set_axis_off()
    with plt.rc_context({"svg.hashsalt": "house"}):
        figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)
