"""Content of user code in scripts and notebooks, which no package version identifies."""

from __future__ import annotations

import dis
import sys
import sysconfig
from collections.abc import Iterator
from types import CodeType, EllipsisType, FunctionType
from typing import Any

import numpy as np
from array_api_compat import is_array_api_obj

__all__ = ["SIMPLE", "class_content", "globals_read", "is_user_code"]

SIMPLE = bool | int | float | complex | str | bytes | EllipsisType | np.generic
"""Types whose ``repr`` identifies the value."""

_INSTALLED = tuple(map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib")))
"""Folders of installed packages, whose code is identified by their versions."""


def is_user_code(module: str | None) -> bool:
    """Return whether a module belongs to a script or notebook rather than an installed package."""
    package = (module or "").partition(".")[0]
    if package in (*sys.builtin_module_names, __name__.partition(".")[0]):
        return False
    # A notebook has no file.
    file = getattr(sys.modules.get(module or ""), "__file__", None) or ""
    return not file.startswith(_INSTALLED)


def class_content(kind: type) -> dict[str, Any]:
    """Return methods and simple attributes of a user's class and its user-defined bases.

    Fields and generated methods of dataclasses are omitted, because instances store the fields.
    """
    content: dict[str, Any] = {}
    for each in reversed(kind.__mro__):
        if each is object or not is_user_code(each.__module__):
            continue
        fields = getattr(each, "__dataclass_fields__", {})
        for name, value in vars(each).items():
            function = getattr(value, "__func__", getattr(value, "fget", value))
            if isinstance(function, FunctionType):
                if not function.__code__.co_filename.startswith("<string>"):
                    content[name] = function
            elif isinstance(value, SIMPLE) and name not in fields and not name.startswith("__"):
                content[name] = value
    return content


def globals_read(function: FunctionType) -> dict[str, Any]:
    """Return the global variables that a user's function reads, directly or indirectly.

    Keys are qualified names. Values are user functions and classes (their code and simple
    defaults), numbers, strings, arrays, and tuples of these. Other objects are omitted, such as
    lists and mappings, which functions may modify.
    """
    variables: dict[str, Any] = {}
    waiting = [function] if is_user_code(function.__module__) else []
    while waiting:
        each = waiting.pop()
        for name in sorted(set(_global_names(each.__code__))):
            value = each.__globals__.get(name)
            # Compiled or cached functions wrap the original one.
            value = getattr(value, "__wrapped__", value)
            key = f"{each.__module__}.{name}"
            if key in variables or value is function:
                continue
            if isinstance(value, FunctionType) and is_user_code(value.__module__):
                variables[key] = _code_and_defaults(value)
                waiting.append(value)
            elif isinstance(value, type) and is_user_code(value.__module__):
                content = class_content(value)
                methods = [part for part in content.values() if isinstance(part, FunctionType)]
                variables[key] = {
                    part: _code_and_defaults(value) if isinstance(value, FunctionType) else value
                    for part, value in content.items()
                }
                waiting += methods
            elif _is_plain(value):
                variables[key] = value
    return variables


def _code_and_defaults(function: FunctionType) -> list[Any]:
    defaults = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()]
    return [function.__code__, [value for value in defaults if _is_plain(value)]]


def _is_plain(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_is_plain(part) for part in value)
    return isinstance(value, SIMPLE) or (is_array_api_obj(value) and value.dtype != object)


def _global_names(code: CodeType) -> Iterator[str]:
    """Yield the names of global variables, including those of inner functions."""
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            yield step.argval
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            yield from _global_names(inner)
