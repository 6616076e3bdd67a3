"""What scripts and notebooks define: code that may change between two runs of one version."""

from __future__ import annotations

import dis
import sys
import sysconfig
from collections.abc import Iterator
from types import CodeType, EllipsisType, FunctionType
from typing import Any

import numpy as np
from array_api_compat import is_array_api_obj

__all__ = ["SIMPLE", "class_content", "is_of_a_script", "reached"]

SIMPLE = bool | int | float | complex | str | bytes | EllipsisType | np.generic
"""Kinds of values that their ``repr`` tells."""

_INSTALLED = tuple(map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib")))
"""Folders of packages, whose code changes with their versions alone."""


def is_of_a_script(module: str | None) -> bool:
    """Return whether what stands in a module is in no installed package or library."""
    package = (module or "").partition(".")[0]
    if package in (*sys.builtin_module_names, __name__.partition(".")[0]):
        return False
    # A notebook has no file.
    file = getattr(sys.modules.get(module or ""), "__file__", None) or ""
    return not file.startswith(_INSTALLED)


def class_content(kind: type) -> dict[str, Any]:
    """Return methods and plain numbers and strings of a class and of those that it inherits from.

    Of classes in scripts alone. Fields of a dataclass, and methods that it writes, are left out:
    objects tell them.
    """
    found: dict[str, Any] = {}
    for each in reversed(kind.__mro__):
        if each is object or not is_of_a_script(each.__module__):
            continue
        fields = getattr(each, "__dataclass_fields__", {})
        for name, value in vars(each).items():
            function = getattr(value, "__func__", getattr(value, "fget", value))
            if isinstance(function, FunctionType):
                if not function.__code__.co_filename.startswith("<string>"):
                    found[name] = function
            elif isinstance(value, SIMPLE) and name not in fields and not name.startswith("__"):
                found[name] = value
    return found


def reached(function: FunctionType) -> dict[str, Any]:
    """Return what a script's function reads by its name, by that name, and what that reads in turn.

    Functions and classes of scripts, numbers, strings, arrays, and tuples of them. Not lists and
    mappings, which functions fill as they run, nor other objects.

    Returns
    -------
    dict
        Of functions the code, defaults and named defaults; of classes the same of each method.
    """
    found: dict[str, Any] = {}
    waiting = [function] if is_of_a_script(function.__module__) else []
    while waiting:
        each = waiting.pop()
        for name in sorted(set(_global_names(each.__code__))):
            value = each.__globals__.get(name)
            # What is compiled, or keeps results, has the function that it was made of.
            value = getattr(value, "__wrapped__", value)
            key = f"{each.__module__}.{name}"
            if key in found or value is function:
                continue
            if isinstance(value, FunctionType) and is_of_a_script(value.__module__):
                found[key] = _written(value)
                waiting.append(value)
            elif isinstance(value, type) and is_of_a_script(value.__module__):
                content = class_content(value)
                methods = [part for part in content.values() if isinstance(part, FunctionType)]
                found[key] = {
                    part: _written(held) if isinstance(held, FunctionType) else held
                    for part, held in content.items()
                }
                waiting += methods
            elif _is_plain(value):
                found[key] = value
    return found


def _written(function: FunctionType) -> list[Any]:
    """Return what stands in a function's text."""
    defaults = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
    return [function.__code__, [value for value in defaults if _is_plain(value)]]


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_is_plain(part) for part in value)
    return isinstance(value, SIMPLE) or (is_array_api_obj(value) and value.dtype != object)


def _global_names(code: CodeType) -> Iterator[str]:
    """Yield the names of what is neither local nor closed over, of inner functions as well."""
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield step.argval
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _global_names(inner)
