"""Reference pages of the documentation: one per package, listing its public names."""

from __future__ import annotations

import importlib
import inspect
from functools import cache
from pathlib import Path

import probmotion

_TITLE = "API reference"


@cache
def rooms() -> list[str]:
    """Return the names of all packages of probmotion, from the folders."""
    root = Path(probmotion.__file__).parent
    names = []
    for top, folder in (
        ("probmotion", root),
        ("probmotion.samplers", root.parent / "samplers"),
        ("probmotion.models", root.parent / "models"),
    ):
        for init in sorted(folder.rglob("__init__.py")):
            parts = init.parent.relative_to(folder).parts
            names.append(".".join([top, *parts]))
    return names


def _home(room: str, name: str) -> str:
    """Return the package whose page documents a name: that of the defining module."""
    value = getattr(importlib.import_module(room), name)
    module = getattr(value, "__module__", None) or room
    return module.rpartition(".")[0] if module not in rooms() else module


def _directive(room: str, name: str) -> str:
    value = getattr(importlib.import_module(room), name)
    if _home(room, name) != room:
        return f"- :py:obj:`{name} <{value.__module__}.{name}>`\n"
    if inspect.isclass(value):
        return f".. autoclass:: {value.__module__}.{name}\n   :members:\n   :show-inheritance:\n"
    if callable(value):
        return f".. autofunction:: {value.__module__}.{name}\n"
    return f".. py:data:: {room}.{name}\n"


def _page(room: str) -> str:
    module = importlib.import_module(room)
    names = [
        name
        for name in sorted(module.__all__, key=str.lower)
        if not inspect.ismodule(getattr(module, name))
    ]
    lines = [f"``{room}``", "=" * (len(room) + 4), "", (module.__doc__ or "").strip(), ""]
    # Links to names documented by other packages come first.
    here = [name for name in names if _home(room, name) == room]
    lines += [_directive(room, name).rstrip() for name in names if name not in here]
    lines += ["", *(_directive(room, name) for name in here)]
    return "\n".join(lines)


def write(docs: Path) -> None:
    """Write ``reference/*.rst``."""
    folder = docs / "reference"
    folder.mkdir(exist_ok=True)
    for room in rooms():
        page = folder / f"{room}.rst"
        text = _page(room)
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")
    listed = "\n".join(f"   {room}" for room in rooms())
    index = (
        f"{_TITLE}\n{'=' * len(_TITLE)}\n\n"
        "Every public name, by package. Most work needs only ``import probmotion as pm``.\n\n"
        f".. toctree::\n   :maxdepth: 1\n\n{listed}\n"
    )
    (folder / "index.rst").write_text(index, encoding="utf-8")
