"""Optional libraries: ``from probmotion.extras import torch`` imports torch or names its extra.

The core of the package needs none of them. Modules are imported when their name is imported from
here, so that :class:`ModuleNotFoundError` states the command that installs a missing library.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import drjit as drjit
    import ezc3d as ezc3d
    import jax as jax
    import mitsuba as mitsuba
    import numba as numba
    import numcodecs as numcodecs
    import numpyro as numpyro
    import skimage as skimage
    import torch as torch
    import zarr as zarr
    from torch import nn as nn

__all__ = ["NO_ALLOCATION", "OPTIONAL", "is_installed"]

OPTIONAL = {
    "torch": "torch",
    "nn": "torch",
    "jax": "jax",
    "numpyro": "jax",
    "numba": "fast",
    "zarr": "stream",
    "numcodecs": "stream",
    "ezc3d": "c3d",
    "mitsuba": "images",
    "drjit": "images",
    "skimage": "images",
}
"""Extra of this package that installs a library, by the name to import from this module."""

NO_ALLOCATION = {"cache": True, "nogil": True, "_nrt": False}
"""Options of ``numba.njit`` for functions that create no arrays and are called by compiled code.
Without them, functions count references to each array of their arguments, which takes most of the
time of short functions. Functions that these call inherit the private option ``_nrt``."""

_MODULES = {"nn": "torch.nn"}  # if other than the name


def is_installed(library: str) -> bool:
    """Return whether a library can be imported, without importing it."""
    return find_spec(library) is not None


def __getattr__(name: str) -> Any:
    """Import an optional library; raise ``ModuleNotFoundError`` with its extra if it is missing."""
    if name not in OPTIONAL:
        raise AttributeError(f"probmotion.extras has no library {name!r}")
    try:
        return import_module(_MODULES.get(name, name))
    except ModuleNotFoundError as error:
        missing = str(error.name).partition(".")[0]
        raise ModuleNotFoundError(
            f"{missing} must be installed; run pip install 'probmotion[{OPTIONAL[name]}]'",
            name=missing,
        ) from error
