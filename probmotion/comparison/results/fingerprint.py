"""Fingerprint of a run's inputs, so that a finished run is reused only for identical inputs."""

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
from probmotion.comparison.results.script_code import (
    SIMPLE,
    class_content,
    globals_read,
    is_user_code,
)
from probmotion.posteriors.draws import library_versions

__all__ = ["fingerprint"]

# Random generators, which have no fingerprint because their state changes with every draw.
_RANDOM = (np.random.Generator, np.random.BitGenerator, np.random.RandomState, random.Random)

_RECORDED_PACKAGES = {name.replace("-", "_") for name in library_versions()}
"""Packages whose versions are recorded beside every fingerprint."""

_NUMPY_GLOBAL_RANDOM = getattr(np.random.random, "__self__", None)

_CODE = (
    *("code", "consts", "names", "varnames", "freevars", "cellvars", "exceptiontable"),
    *("argcount", "posonlyargcount", "kwonlyargcount", "flags"),
)
"""Attributes of compiled code other than its file and line numbers."""


def fingerprint(value: Any) -> str:
    """Return a hexadecimal digest of ``value``.

    - Numbers, strings, arrays, lists, mappings: their contents.
    - Dataclasses: their ``init`` fields, which excludes caches.
    - Classes, modules and C functions: their names.
    - Python functions: name, compiled code, defaults and closure; bound methods also their object.
    - Networks: layers and weights.
    - Other objects: their attributes, or their pickled state if they have none.
    - Classes and functions of a script or notebook: also the code of their methods and the
      functions, classes, numbers, strings and arrays of the module that they read. Lists and
      mappings are excluded, since functions may modify them.
    - Objects of installed packages: also the version of the package.

    Fingerprints of functions depend on the Python version, because they include bytecode.

    Raises
    ------
    ValueError
        If the content of an object cannot be determined.
    """
    digest = hashlib.sha256()
    _add(digest, value, ())
    return digest.hexdigest()


def _add(digest: Any, value: Any, above: tuple[int, ...]) -> None:
    kind = type(value)
    digest.update(f"<{kind.__module__}.{kind.__qualname__}{_version_of(kind.__module__)}>".encode())
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
    elif _is_named(value):
        module, name = getattr(value, "__module__", ""), getattr(value, "__qualname__", "")
        digest.update(f"{module}.{name}{_version_of(module)}".encode())
        parts += _named_content(value)
    elif isinstance(value, CodeType):
        parts += [getattr(value, f"co_{name}") for name in _CODE]
    elif value is _NUMPY_GLOBAL_RANDOM:
        pass  # SciPy's distributions refer to it, but their densities do not use it.
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
        # A network; its other attributes, such as hooks, may change while it runs.
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
        attributes = vars(value).items()
        # Cached properties are determined by the other attributes.
        parts.append({name: part for name, part in attributes if not _is_cached(kind, name)})
    elif not _is_stateless(kind):
        parts += _as_pickled(value)
    if is_user_code(kind.__module__):
        parts.append(class_content(kind))
    for part in parts:
        _add(digest, part, (*above, id(value)))
    digest.update(b"</>")


def _is_named(value: Any) -> bool:
    if isinstance(value, type | ModuleType | FunctionType | MethodType):
        return True
    # Callable objects may have a function's name, but are identified by their attributes.
    if not callable(value) or isinstance(type(value).__call__, FunctionType):
        return False
    return hasattr(value, "__qualname__")


def _named_content(value: Any) -> list[Any]:
    """Return the content that distinguishes objects of the same name."""
    if isinstance(value, type):
        return [class_content(value)] if is_user_code(value.__module__) else []
    if isinstance(value, ModuleType):
        return [value.__name__]
    if isinstance(value, MethodType):
        return [value.__func__, value.__self__]
    if isinstance(value, FunctionType):
        defaults = [_without_marker(each) for each in value.__defaults__ or ()]
        named = {name: _without_marker(each) for name, each in (value.__kwdefaults__ or {}).items()}
        cells = [_closure_value(cell) for cell in value.__closure__ or ()]
        return [value.__code__, defaults, named, cells, vars(value), globals_read(value)]
    # Written in C: a bound method, or a compiled or cached function.
    return [getattr(value, "__self__", None), getattr(value, "__wrapped__", None)]


def _closure_value(cell: CellType) -> list[Any]:
    """Return the value of a closure variable; empty if it is not assigned yet."""
    try:
        return [_without_marker(cell.cell_contents)]
    except ValueError:
        return []


def _without_marker(value: Any) -> Any:
    """Return the value, or the class of a bare ``object()``, a marker for missing arguments."""
    return object if type(value) is object else value


def _as_pickled(value: Any) -> list[Any]:
    """Return the pickled state of an object without attributes."""
    try:
        # Random generators change with every draw, and a bare object has no state.
        has_state = type(value) is not object and not isinstance(value, _RANDOM)
        reduced: Any = value.__reduce_ex__(2) if has_state else None
    except TypeError:
        reduced = None
    if isinstance(reduced, str):
        return [reduced]  # the name of a singleton
    if reduced is None:
        raise ValueError(
            "value must contain only numbers, strings, arrays, dataclasses, objects with "
            f"attributes or objects that can be pickled, got a {type(value).__name__}; derive "
            "random numbers from seeds instead of storing a generator"
        )
    factory, arguments, *rest = reduced
    # Iterators over the items of lists and mappings follow the state.
    state, items, pairs = (*rest, None, None, None)[:3]
    return [factory, arguments, state, list(items or ()), list(pairs or ())]


def _version_of(module: str | None) -> str:
    """Return the version of a module's package; empty if results record it separately."""
    package = (module or "").partition(".")[0]
    recorded = package in sys.stdlib_module_names or package in _RECORDED_PACKAGES
    return "" if recorded or is_user_code(module) else _installed_version(package)


@cache
def _installed_version(package: str) -> str:
    names = sorted(set(packages_distributions().get(package, ())))
    return "".join(f" {name} {version(name)}" for name in names)


def _is_cached(kind: type, name: str) -> bool:
    return isinstance(getattr(kind, name, None), cached_property)


def _is_stateless(kind: type) -> bool:
    """Whether instances of a Python class have no state, so that its name identifies them."""
    return kind.__module__ != "builtins" and hasattr(kind, "__dict__") and bool(kind.__dictoffset__)
