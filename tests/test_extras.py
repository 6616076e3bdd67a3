"""Optional libraries: messages, names of extras, and the core without them."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from probmotion import extras

ROOT = Path(__file__).parents[1]
# Distributions that install a library, if other than its name.
DISTRIBUTIONS = {"nn": "torch", "drjit": "mitsuba", "skimage": "scikit-image"}
# Runs pytest in a process in which no finder finds the optional libraries.
WITHOUT = """
import sys
import pytest

OPTIONAL = {"torch", "jax", "jaxlib", "numpyro", "numba", "llvmlite", "sklearn", "zarr", "mitsuba"}

class Without:
    def __init__(self, finder):
        self.finder = finder
    def find_spec(self, name, path=None, target=None):
        hidden = name.partition(".")[0] in OPTIONAL
        return None if hidden else self.finder.find_spec(name, path, target)
    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = map(Without, sys.meta_path)
status = pytest.main(["-q", "-p", "no:cacheprovider", "-rs", sys.argv[1]])
assert not OPTIONAL & set(sys.modules)
sys.exit(status)
"""


def test_the_core_passes_its_tests_without_optional_libraries(tmp_path):
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTEST_XDIST_WORKER", None)
    # Plugins of pytest may import the optional libraries.
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT, str(ROOT / "tests" / "core")],
        capture_output=True, text=True, cwd=tmp_path, env=environment, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout + run.stderr
    assert "skipped" not in run.stdout


@pytest.mark.parametrize("library", extras.OPTIONAL)
def test_optional_libraries_are_imported_or_named_with_their_extra(library, monkeypatch):
    module = getattr(extras, library)
    assert module.__name__.rpartition(".")[2] == library
    package = module.__name__.partition(".")[0]
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "torch.nn", raising=False)
    message = (
        rf"^{package} must be installed; run pip install "
        rf"'probmotion\[{extras.OPTIONAL[library]}\]'$"
    )
    with pytest.raises(ModuleNotFoundError, match=message) as caught:
        getattr(extras, library)
    assert caught.value.name == package
    assert not extras.is_installed(package)


def test_a_missing_dependency_of_a_library_is_named(monkeypatch, tmp_path):
    (tmp_path / "ezc3d.py").write_text("import no_such_dependency", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "ezc3d", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"^no_such_dependency must be installed; run"):
        extras.ezc3d  # noqa: B018


def test_extras_are_those_of_the_package_and_other_names_are_refused():
    with open(ROOT / "pyproject.toml", "rb") as file:
        project = tomllib.load(file)["project"]
    declared = project["optional-dependencies"]
    for library, extra in extras.OPTIONAL.items():
        named = DISTRIBUTIONS.get(library, library)
        assert any(each.startswith(named) for each in declared[extra]), library
        assert not any(each.startswith(named) for each in project["dependencies"]), library
    with pytest.raises(AttributeError, match="no library 'numpy'"):
        extras.numpy  # noqa: B018
