"""The public names of `import probmotion as pm`."""

from __future__ import annotations

import importlib

import pytest

import probmotion as pm


@pytest.mark.parametrize("old", list(pm._RENAMED))
def test_renamed_names_say_what_to_use(old):
    new = f"probmotion.{pm._RENAMED[old]}"
    with pytest.raises(AttributeError, match=rf"^probmotion\.{old} is now {new}$"):
        getattr(pm, old)
    module, _, name = new.rpartition(".")
    try:
        importlib.import_module(new)
    except ModuleNotFoundError:
        assert hasattr(importlib.import_module(module), name)


def test_unknown_names_are_refused():
    with pytest.raises(AttributeError, match="no_such_name"):
        pm.no_such_name  # noqa: B018


def test_version_is_that_of_the_installed_package():
    assert importlib.import_module("importlib.metadata").version("probmotion") == pm.__version__
