"""The formats together: what users read is where the others are."""

from __future__ import annotations

import pkgutil
from importlib import import_module

from probmotion import io as formats


def test_every_reader_of_a_file_is_in_the_package() -> None:
    readers = {
        name: getattr(module, name)
        for found in pkgutil.iter_modules(formats.__path__)
        for module in [import_module(f"probmotion.io.{found.name}")]
        for name in module.__all__
        if name.startswith("read_") and name != "read_bytes"  # this is of files of any kind
    }
    assert len(readers) >= 6
    for name, reader in readers.items():
        assert getattr(formats, name) is reader
    assert {"read_motion", "read_keypoints", "read_predictions"} <= set(formats.__all__)
    assert all(hasattr(formats, name) for name in formats.__all__)
