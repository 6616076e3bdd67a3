"""Validation of arguments."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import fields
from difflib import get_close_matches
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from probmotion.arrays import Array, array_namespace, to_numpy

__all__ = [
    "check_count",
    "check_finite",
    "check_not_negative",
    "check_positive",
    "check_shape",
    "check_types",
    "did_you_mean",
]


def check_shape(name: str, value: Array, expected: tuple[int | str, ...]) -> None:
    """Raise ``ValueError`` unless the shape of ``value`` is ``expected``.

    Integers in ``expected`` must match, strings (``"L"``, ``"J"``) accept any size, and a leading
    ``"…"`` accepts any batch axes.
    """
    batch = bool(expected) and expected[0] == "…"
    axes = expected[1:] if batch else expected
    shape = tuple(value.shape)
    fits = len(shape) >= len(axes) if batch else len(shape) == len(axes)
    trailing = shape[len(shape) - len(axes) :]
    if not fits or any(
        isinstance(axis, int) and axis != size for axis, size in zip(axes, trailing, strict=True)
    ):
        sizes = ", ".join(map(str, expected))
        raise ValueError(f"{name} must have shape ({sizes}), got {shape}")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of an error message with the names similar to ``name``; empty without any."""
    similar = " or ".join(get_close_matches(name, list(known)))
    return f"; did you mean {similar}?" if similar else ""


def check_finite(name: str, value: Any) -> None:
    """Raise ``ValueError`` if a NumPy, torch or JAX array contains NaN or infinite entries."""
    xp = array_namespace(value)
    bad = to_numpy(~xp.isfinite(value))
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name} must be finite, got {bad.sum()} values that are NaN or infinite, "
            f"the first at index {where}"
        )


def check_positive(name: str, value: float) -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number above zero."""
    if not (_is_finite(value) and value > 0):
        raise ValueError(f"{name} must be a finite number above 0, got {value!r:.80}")


def check_not_negative(name: str, value: float) -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number of at least zero."""
    if not (_is_finite(value) and value >= 0):
        raise ValueError(f"{name} must be a finite number of at least 0, got {value!r:.80}")


def _is_finite(value: object) -> bool:
    """Return whether a value is a finite real number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond floating point
        return False


def check_count(name: str, value: int, least: int = 1) -> None:
    """Raise ``ValueError`` unless ``value`` is an integer of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}, got {value!r}")


def check_types(value: Any) -> None:
    """Raise ``ValueError`` unless the fields of a dataclass have the annotated types.

    For dataclasses that are read from files. Annotations may be classes, ``Any``, unions, and
    dictionaries, lists and tuples of them; integers are accepted as ``float``.
    """
    kinds = get_type_hints(type(value))
    for entry in fields(value):
        given = getattr(value, entry.name)
        if not _fits(given, kinds[entry.name]):
            expected = str(entry.type)
            raise ValueError(f"{entry.name} must be {expected}, got {given!r:.80}")


def _fits(value: Any, kind: Any) -> bool:
    """Return whether a JSON value has the type of an annotation."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any:
        return True
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is dict:
        return isinstance(value, dict) and all(
            _fits(key, parts[0]) and _fits(entry, parts[1]) for key, entry in value.items()
        )
    if origin in (list, tuple):
        return isinstance(value, origin) and all(_fits(entry, parts[0]) for entry in value)
    if kind is float:
        return isinstance(value, int | float)
    return isinstance(value, NoneType if kind is None else kind)
