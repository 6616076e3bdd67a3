"""Diagram of the packages by level, generated from their imports."""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib.pyplot as plt

_COLOURS = {"probmotion": "#dbe9f6", "samplers": "#fde3cf", "models": "#dff0d8"}
_WIDTH, _HEIGHT, _GAP = 2.9, 0.62, 0.35


def package_imports(root: Path) -> dict[str, set[str]]:
    """Return the packages that each package imports, without the top level of probmotion."""
    packages = {
        ".".join(init.parent.relative_to(root).parts)
        for folder in _COLOURS
        for init in (root / folder).rglob("__init__.py")
    } - {"probmotion"}
    graph: dict[str, set[str]] = {package: set() for package in packages}
    for package in packages:
        for path in (root / package.replace(".", "/")).glob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ImportFrom) and node.module:
                    graph[package] |= {_package_of(node.module, packages)} - {"", package}
    return graph


def _package_of(module: str, packages: set[str]) -> str:
    name = module
    for folder in ("samplers", "models"):
        name = name.replace(f"probmotion.{folder}", folder, 1)
    while name and name not in packages:
        name = name.rpartition(".")[0]
    return name


def package_levels(graph: dict[str, set[str]]) -> dict[str, int]:
    """Return the level of each package: one above the highest package that it imports."""
    levels: dict[str, int] = {}

    def level(package: str) -> int:
        if package not in levels:
            levels[package] = 1 + max((level(below) for below in graph[package]), default=-1)
        return levels[package]

    for package in graph:
        level(package)
    return levels


def draw(path: Path) -> None:
    """Write the diagram as SVG."""
    graph = package_imports(Path(__file__).parents[2])
    levels = package_levels(graph)
    rows = [
        sorted(package for package in levels if levels[package] == level)
        for level in range(max(levels.values()) + 1)
    ]
    figure, axes = plt.subplots(figsize=(11, 0.62 * len(rows) + 0.6))
    positions = {}
    for height, row in enumerate(rows):
        for column, package in enumerate(row):
            x = (column - (len(row) - 1) / 2) * (_WIDTH + _GAP)
            positions[package] = (x, height * (_HEIGHT + _GAP))
    for package, targets in graph.items():
        for target in targets:
            (x, y), (a, b) = positions[package], positions[target]
            axes.annotate(
                "",
                (a, b + _HEIGHT / 2),
                (x, y - _HEIGHT / 2),
                arrowprops={"arrowstyle": "-|>", "color": "#9aa7b4", "lw": 0.5, "alpha": 0.6},
            )
    for package, (x, y) in positions.items():
        colour = _COLOURS[package.partition(".")[0]]
        box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": "#56646f"}
        label = package.removeprefix("probmotion.").replace(".", "/")
        axes.text(x, y, label, ha="center", va="center", fontsize=8, bbox=box)
    xs, ys = zip(*positions.values(), strict=True)
    axes.set_xlim(min(xs) - _WIDTH, max(xs) + _WIDTH)
    axes.set_ylim(min(ys) - 1, max(ys) + 1)
    axes.set_axis_off()
    with plt.rc_context({"svg.hashsalt": "house"}):
        figure.savefig(path, bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)
