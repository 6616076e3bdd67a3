"""A digest of what was asked for, so that a finished cell is reused only for the same question."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cached_property, partial
from pathlib import PurePath
from typing import Any

import numpy as np
from array_api_compat import is_array_api_obj

from probmotion.arrays import to_numpy

__all__ = ["fingerprint"]


def fingerprint(value: Any) -> str:
    """Return a hexadecimal digest of what ``value`` holds.

    Numbers, strings, arrays, lists, mappings, dataclasses (by the fields they are made with, so
    that caches do not count), classes and functions (by name), networks (by layers and weights),
    and other objects by their attributes.

    Raises
    ------
    ValueError
        If an object has nothing of that kind to tell it by.
    """
    digest = hashlib.sha256()
    _add(digest, value, ())
    return digest.hexdigest()


def _add(digest: Any, value: Any, above: tuple[int, ...]) -> None:
    kind = type(value)
    digest.update(f"<{kind.__module__}.{kind.__qualname__}>".encode())
    parts: list[Any] = []
    if id(value) in above:
        digest.update(f"the object {above.index(id(value))} levels down".encode())
    elif value is None or isinstance(value, bool | int | float | str | bytes | np.generic):
        digest.update(repr(value).encode())
    elif isinstance(value, Mapping):
        for key in sorted(value, key=repr):
            parts += [key, value[key]]
    elif isinstance(value, list | tuple):
        parts += value
    elif isinstance(value, set | frozenset):
        parts += sorted(value, key=repr)
    elif is_array_api_obj(value):
        array = np.ascontiguousarray(to_numpy(value))
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    elif callable(getattr(value, "state_dict", None)):
        # A network: its layers and its weights, not what hangs on them while it runs.
        parts += [repr(value), dict(value.state_dict())]
    elif isinstance(value, PurePath):
        digest.update(str(value).encode())
    elif isinstance(value, partial):
        parts += [value.func, value.args, value.keywords]
    elif isinstance(value, type) or hasattr(value, "__qualname__"):
        digest.update(f"{value.__module__}.{value.__qualname__}".encode())
    elif is_dataclass(value):
        for field in fields(value):
            if field.init:
                parts += [field.name, getattr(value, field.name)]
    elif getattr(value, "__dict__", None):
        held = vars(value).items()
        # What was computed from the rest, once asked for, says nothing new.
        parts.append({name: part for name, part in held if not _computed(kind, name)})
    elif not _plain(kind):
        raise ValueError(
            f"value holds a {kind.__name__}, which cannot be told from another, expected numbers, "
            "strings, arrays, dataclasses or objects with attributes"
        )
    for part in parts:
        _add(digest, part, (*above, id(value)))
    digest.update(b"</>")


def _computed(kind: type, name: str) -> bool:
    return isinstance(getattr(kind, name, None), cached_property)


def _plain(kind: type) -> bool:
    """Whether objects of a class written in Python hold nothing: then its name says all."""
    return kind.__module__ != "builtins" and hasattr(kind, "__dict__") and bool(kind.__dictoffset__)
