"""Public names of ``import probmotion as pm``."""

from __future__ import annotations

import importlib
import subprocess
import sys
from importlib.metadata import version

import pytest

import probmotion as pm


@pytest.mark.parametrize("old", list(pm._RENAMED))
def test_errors_for_renamed_names_state_the_new_name(old):
    new = f"probmotion.{pm._RENAMED[old]}"
    with pytest.raises(AttributeError, match=rf"^probmotion\.{old} is now {new}$"):
        getattr(pm, old)
    module, _, name = new.rpartition(".")
    try:
        importlib.import_module(new)
    except ModuleNotFoundError:
        assert hasattr(importlib.import_module(module), name)


def test_unknown_names_are_refused_and_the_version_is_that_of_the_package():
    with pytest.raises(AttributeError, match="no_such_name"):
        pm.no_such_name  # noqa: B018
    assert version("probmotion") == pm.__version__


def test_reconstructions_are_imported_when_they_are_asked_for():
    code = (
        "import sys, probmotion as pm; assert 'probmotion.reconstruction' not in sys.modules;"
        "print(pm.reconstruct.__module__, pm.Reconstruction.__module__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    room = "probmotion.reconstruction"
    assert done.stdout.split() == [f"{room}.inference", f"{room}.result"], done.stderr
