"""Reference pages of the documentation: one per package, listing its public names."""

from __future__ import annotations

import importlib
import inspect
from functools import cache
from pathlib import Path

import probmotion

_TITLE = "API reference"


@cache
def packages() -> list[str]:
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


def _documenting_package(package: str, name: str) -> str:
    """Return the package whose page documents a name: that of the defining module."""
    value = getattr(importlib.import_module(package), name)
    module = getattr(value, "__module__", None) or package
    return module.rpartition(".")[0] if module not in packages() else module


def _directive(package: str, name: str) -> str:
    value = getattr(importlib.import_module(package), name)
    if _documenting_package(package, name) != package:
        return f"- :py:obj:`{name} <{value.__module__}.{name}>`\n"
    if inspect.isclass(value):
        return f".. autoclass:: {value.__module__}.{name}\n   :members:\n   :show-inheritance:\n"
    if callable(value):
        return f".. autofunction:: {value.__module__}.{name}\n"
    return f".. py:data:: {package}.{name}\n"


def _page(package: str) -> str:
    module = importlib.import_module(package)
    names = [
        name
        for name in sorted(module.__all__, key=str.lower)
        if not inspect.ismodule(getattr(module, name))
    ]
    lines = [f"``{package}``", "=" * (len(package) + 4), "", (module.__doc__ or "").strip(), ""]
    # Links to names documented by other packages come first.
    own = [name for name in names if _documenting_package(package, name) == package]
    lines += [_directive(package, name).rstrip() for name in names if name not in own]
    lines += ["", *(_directive(package, name) for name in own)]
    return "\n".join(lines)


def write(docs: Path) -> None:
    """Write ``reference/*.rst``."""
    folder = docs / "reference"
    folder.mkdir(exist_ok=True)
    for package in packages():
        page = folder / f"{package}.rst"
        text = _page(package)
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")
    listed = "\n".join(f"   {package}" for package in packages())
    index = (
        f"{_TITLE}\n{'=' * len(_TITLE)}\n\n"
        "All public names by package. For most uses, ``import probmotion as pm`` suffices.\n\n"
        f".. toctree::\n   :maxdepth: 1\n\n{listed}\n"
    )
    (folder / "index.rst").write_text(index, encoding="utf-8")
