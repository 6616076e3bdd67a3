"""A digest of what was asked for, so that a finished cell is reused only for the same question."""

from __future__ import annotations

import hashlib
import random
import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache, cached_property, partial
from importlib.metadata import packages_distributions, version
from pathlib import PurePath
from types import CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from array_api_compat import is_array_api_obj

from probmotion.arrays import to_numpy
from probmotion.comparison.results.script_code import SIMPLE, class_content, is_of_a_script, reached
from probmotion.posteriors.draws import library_versions

__all__ = ["fingerprint"]

_RANDOM = (np.random.Generator, np.random.BitGenerator, np.random.RandomState, random.Random)

_TOLD_ANYWAY = {"sklearn", *(name.replace("-", "_") for name in library_versions())}
"""Packages whose versions stand beside every fingerprint."""

_NUMPYS_OWN_RANDOMNESS = getattr(np.random.random, "__self__", None)

_CODE = (
    *("code", "consts", "names", "varnames", "freevars", "cellvars", "exceptiontable"),
    *("argcount", "posonlyargcount", "kwonlyargcount", "flags"),
)
"""What code does, of its attributes: not the file and the lines that it stands in."""


def fingerprint(value: Any) -> str:
    """Return a hexadecimal digest of what ``value`` holds.

    Numbers, strings, arrays, lists, mappings, dataclasses (by the fields they are made with, so
    that caches do not count), classes, modules and functions written in C (by name), functions of
    Python (by name, compiled code, defaults and what they close over), bound methods (by what
    they are bound to as well), networks (by layers and weights), other objects by their
    attributes, and what has none by what it is pickled as. Of an object whose class is in no
    installed package, but in a script or notebook, the methods count as functions do, and with a
    script's functions what they read of their module: other functions, classes, numbers, strings
    and arrays, but not lists and mappings, which may be filled as it runs. What is of an installed
    package counts by its name and the package's version.

    Another version of Python compiles other code, so that it has other fingerprints of functions.

    Raises
    ------
    ValueError
        If an object has nothing of that kind to tell it by; the message says where it is held.
    """
    digest = hashlib.sha256()
    _add(digest, value, ())
    return digest.hexdigest()


def _add(digest: Any, value: Any, above: tuple[int, ...]) -> None:
    kind = type(value)
    digest.update(f"<{kind.__module__}.{kind.__qualname__}{_edition(kind.__module__)}>".encode())
    parts: list[Any] = []
    if id(value) in above:
        digest.update(f"the object {above.index(id(value))} levels down".encode())
    elif value is None or isinstance(value, SIMPLE):
        digest.update(repr(value).encode())
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            parts += [key, value[key]]
    elif isinstance(value, list | tuple):
        parts += value
    elif isinstance(value, set | frozenset):
        parts += sorted(value, key=repr)
    elif _has_a_name(value):
        module, name = getattr(value, "__module__", ""), getattr(value, "__qualname__", "")
        digest.update(f"{module}.{name}{_edition(module)}".encode())
        parts += _behind_the_name(value)
    elif isinstance(value, CodeType):
        parts += [getattr(value, f"co_{name}") for name in _CODE]
    elif value is _NUMPYS_OWN_RANDOMNESS:
        pass  # There is one; SciPy's distributions hold it, whose density does not ask it.
    elif isinstance(value, slice):
        parts += [value.start, value.stop, value.step]
    elif is_array_api_obj(value):
        array = np.ascontiguousarray(to_numpy(value))
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        if array.dtype.hasobject:
            parts += array.ravel().tolist()
        else:
            digest.update(array.tobytes())
    elif callable(getattr(value, "state_dict", None)):
        # A network: its layers and its weights, not what hangs on them while it runs.
        parts += [repr(value), dict(value.state_dict())]
    elif isinstance(value, PurePath):
        digest.update(str(value).encode())
    elif isinstance(value, partial):
        parts += [value.func, value.args, value.keywords]
    elif is_dataclass(value):
        for field in fields(value):
            if field.init:
                parts += [field.name, getattr(value, field.name)]
    elif getattr(value, "__dict__", None):
        held = vars(value).items()
        # What was computed from the rest, once asked for, says nothing new.
        parts.append({name: part for name, part in held if not _computed(kind, name)})
    elif not _plain(kind):
        parts += _as_pickled(value)
    if is_of_a_script(kind.__module__):
        parts.append(class_content(kind))
    for part in parts:
        _add(digest, part, (*above, id(value)))
    digest.update(b"</>")


def _has_a_name(value: Any) -> bool:
    if isinstance(value, type | ModuleType | FunctionType | MethodType):
        return True
    # An object of a class of Python may be called, and have taken over a function's name, but its
    # attributes say what it does.
    if not callable(value) or isinstance(type(value).__call__, FunctionType):
        return False
    return hasattr(value, "__qualname__")


def _behind_the_name(value: Any) -> list[Any]:
    """Return what tells a function or method from another of the same name."""
    if isinstance(value, type):
        return [class_content(value)] if is_of_a_script(value.__module__) else []
    if isinstance(value, ModuleType):
        return [value.__name__]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, FunctionType):
        defaults = [_or_marker(each) for each in value.__defaults__ or ()]
        named = {name: _or_marker(each) for name, each in (value.__kwdefaults__ or {}).items()}
        cells = [_held(cell) for cell in value.__closure__ or ()]
        return [value.__code__, defaults, named, cells, vars(value), reached(value)]
    # Written in C: a method of an object, or the compiled or caching form of a function.
    return [getattr(value, "__self__", None), getattr(value, "__wrapped__", None)]


def _held(cell: CellType) -> list[Any]:
    """Return what a function closes over; nothing where that is not assigned yet."""
    try:
        return [_or_marker(cell.cell_contents)]
    except ValueError:
        return []


def _or_marker(value: Any) -> Any:
    """Return the value, or for a bare object, which libraries use for "not given", its class."""
    return object if type(value) is object else value


def _as_pickled(value: Any) -> list[Any]:
    """Return what an object without attributes is made anew from, where it can be."""
    try:
        # What draws is another after every draw, and a bare object stands for itself.
        told = type(value) is not object and not isinstance(value, _RANDOM)
        made: Any = value.__reduce_ex__(2) if told else None
    except TypeError:
        made = None
    if isinstance(made, str):
        return [made]  # The name of what there is one of.
    if made is None:
        name = type(value).__name__
        raise ValueError(
            f"value holds a {name}, which cannot be told from another, expected numbers, strings, "
            "arrays, dataclasses, objects with attributes or what can be pickled, and randomness "
            "that comes from seeds"
        )
    made_by, given, *rest = made
    # What follows the state are iterators, over the items of lists and mappings.
    state, items, pairs = (*rest, None, None, None)[:3]
    return [made_by, given, state, list(items or ()), list(pairs or ())]


def _edition(module: str | None) -> str:
    """Return which version of its package a module is of, where results do not say so anyway."""
    package = (module or "").partition(".")[0]
    told = package in sys.stdlib_module_names or package in _TOLD_ANYWAY
    return "" if told or is_of_a_script(module) else _installed_version(package)


@cache
def _installed_version(package: str) -> str:
    names = sorted(set(packages_distributions().get(package, ())))
    return "".join(f" {name} {version(name)}" for name in names)


def _computed(kind: type, name: str) -> bool:
    return isinstance(getattr(kind, name, None), cached_property)


def _plain(kind: type) -> bool:
    """Whether objects of a class written in Python hold nothing: then its name says all."""
    return kind.__module__ != "builtins" and hasattr(kind, "__dict__") and bool(kind.__dictoffset__)
