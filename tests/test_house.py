"""Layout of the packages: allowed imports, sizes, public names and import time."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from probmotion.extras import OPTIONAL

ROOT = Path(__file__).resolve().parents[1]
MAX_PACKAGES = 40
# Top-level packages and their modules outside any subpackage.
LOOSE = {
    "probmotion": {
        "arrays",
        "citations",
        "extras",
        "files",
        "seeds",
        "threads",
        "validation",
    },
    "probmotion.models": set(),
    "probmotion.samplers": {"adam", "densities", "exact", "independent"},
}
HEAVY = {
    "torch", "jax", "jaxlib", "numpyro", "emcee", "matplotlib", "arviz_base", "arviz_stats",
    "xarray", "pandas", "scipy.stats", "tyro", "tqdm", "pooch", "safetensors", "diffusers",
}  # fmt: skip
PROBE = """
import json, sys, time
start = time.perf_counter()
import probmotion
print(json.dumps([time.perf_counter() - start, sorted(sys.modules)]))
"""

Graph = dict[str, set[str]]


def name_of(path: Path) -> str:
    """Return the name of the module that a file is installed as."""
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    name = name if name.startswith("probmotion") else f"probmotion.{name}"
    return name.removesuffix(".__init__")


PATHS = {
    name_of(path): path
    for package in ("probmotion", "samplers", "models")
    for path in sorted((ROOT / package).rglob("*.py"))
}
PACKAGES = {name: path for name, path in PATHS.items() if path.name == "__init__.py"}
MODULES = {name: path for name, path in PATHS.items() if name not in PACKAGES}


def package_of(module: str) -> str:
    return module if module in PACKAGES else module.rpartition(".")[0]


def imported_names(source: str, package: str) -> set[str]:
    """Return every dotted name that a source imports, at module level or inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*parts, *filter(None, [node.module])]) if node.level else node.module
            names |= {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names |= {str(arg.value) for arg in node.args if isinstance(arg, ast.Constant)}
    return names


def module_of(name: str) -> str | None:
    """Return the module of a dotted name; public names of a package are looked up in its stub."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        head = ".".join(parts[:length])
        if head in PACKAGES and length < len(parts):
            for node in ast.parse(PACKAGES[head].with_suffix(".pyi").read_text("utf-8")).body:
                names = [alias.name for alias in getattr(node, "names", [])]
                if isinstance(node, ast.ImportFrom) and node.module and parts[length] in names:
                    return f"{head}.{node.module}"
        if head in PATHS:
            return head
    return None


def cycle_of(graph: Graph) -> list[str]:
    """Return a cycle of imports, empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def imports_between(graph: Graph, first: str, second: str) -> list[str]:
    """Return the imports of modules of ``second`` in modules of ``first``."""
    return [
        f"{module} imports {target}"
        for module, targets in graph.items()
        if module.startswith(f"{first}.")
        for target in targets
        if f"{target}.".startswith(f"{second}.")
    ]


@pytest.fixture(scope="module")
def graph() -> Graph:
    """Return the imported modules of every module."""
    modules = {
        module: {
            target
            for name in imported_names(path.read_text("utf-8"), package_of(module))
            if (target := module_of(name)) is not None and target != module
        }
        for module, path in MODULES.items()
    }
    assert len(modules) > 200
    return modules


def test_modules_and_packages_import_without_cycles(graph: Graph) -> None:
    assert cycle_of(graph) == []
    packages: Graph = {}
    for module, targets in graph.items():
        package = package_of(module)
        # The loose modules of probmotion may be imported everywhere.
        imported = {package_of(target) for target in targets} - {package, "probmotion"}
        packages[package] = packages.get(package, set()) | imported
    assert cycle_of(packages) == []


def test_samplers_and_models_do_not_import_each_other(graph: Graph) -> None:
    assert imports_between(graph, "probmotion.samplers", "probmotion.models") == []
    assert imports_between(graph, "probmotion.models", "probmotion.samplers") == []


def test_optional_libraries_are_imported_from_extras() -> None:
    """A missing library is then named with its extra; see :mod:`probmotion.extras`."""
    for module in MODULES.keys() - {"probmotion.extras"}:
        for node in ast.walk(ast.parse(MODULES[module].read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [str(node.module)]
            assert not OPTIONAL.keys() & {name.partition(".")[0] for name in names}, module


def test_loose_modules_import_only_each_other(graph: Graph) -> None:
    loose = {f"probmotion.{name}" for name in LOOSE["probmotion"]}
    assert set().union(*(graph[module] for module in loose)) <= loose


def test_number_and_size_of_packages_are_limited() -> None:
    homes = [package_of(module) for module in MODULES]
    assert len(set(homes)) <= MAX_PACKAGES
    for top, allowed in LOOSE.items():
        loose = {module.rpartition(".")[2] for module in MODULES if package_of(module) == top}
        assert loose == allowed
    for package in PACKAGES:
        assert homes.count(package) <= 16, package


def test_init_files_contain_a_docstring_and_lazy_names_only() -> None:
    for package, path in PACKAGES.items():
        tree = ast.parse(path.read_text("utf-8"))
        if package != "probmotion":
            assert ast.get_docstring(tree), package
            assert [type(node) for node in tree.body[1:]] == [ast.Import, ast.Assign], package


def test_public_names_come_from_the_modules_in_the_stubs() -> None:
    for package, path in PACKAGES.items():
        public = importlib.import_module(package)
        for node in ast.parse(path.with_suffix(".pyi").read_text("utf-8")).body:
            assert isinstance(node, ast.ImportFrom)
            home = importlib.import_module(".".join(filter(None, [package, node.module])))
            for alias in node.names:
                assert alias.name in public.__all__
                if node.module is not None:
                    assert getattr(public, alias.name) is getattr(home, alias.name)
                    # A module of this name would hide it.
                    assert f"{package}.{alias.name}" not in MODULES, alias.name


def test_test_folders_mirror_the_packages() -> None:
    packages = {path.parent.relative_to(ROOT).as_posix() for path in PACKAGES.values()}
    packages = {package.removeprefix("probmotion/") for package in packages}
    tests = ROOT / "tests"
    folders = {path.parent.relative_to(tests).as_posix() for path in tests.rglob("test_*.py")}
    assert folders - {".", "core", "faults", "fuzz", "studies"} <= packages


@pytest.mark.parametrize(
    "source",
    [
        "import probmotion.models.mixture.fit",
        "from probmotion import models",
        "from probmotion.models.mixture.fit import fit_styles as f",
        "def late():\n    from probmotion.models import GaussianMixtureMotion",
        "from ..models import GaussianMixtureMotion",
        "from .. import models",
        "import importlib\nimportlib.import_module('probmotion.models')",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import probmotion.models",
    ],
)
def test_every_form_of_import_is_detected(source: str) -> None:
    names = imported_names(source, "probmotion.samplers")
    graph = {"probmotion.samplers.new": {target for name in names if (target := module_of(name))}}
    assert imports_between(graph, "probmotion.samplers", "probmotion.models")


def output_of(code: str) -> str:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.strip()


def test_importing_the_package_is_light_and_fast() -> None:
    """The fastest of several runs counts, since the machine may be busy."""
    runs = [json.loads(output_of(PROBE)) for _ in range(4)]
    assert HEAVY & set(runs[0][1]) == set()
    assert min(seconds for seconds, _ in runs) <= 0.3


@pytest.mark.parametrize(
    ("modules", "excluded"),
    [
        (
            "motion.skeleton motion.motion geometry.cameras geometry.rotations seeds "
            "posteriors.likelihoods posteriors.posterior",
            HEAVY - {"scipy.stats", "xarray", "pandas"},
        ),
        ("problems.catalogue", {"torch", "jax"}),
    ],
)
def test_lower_packages_load_no_heavy_libraries(modules: str, excluded: set[str]) -> None:
    imports = ", ".join(f"probmotion.{module}" for module in modules.split())
    assert output_of(f"import sys, {imports}; print({excluded} & set(sys.modules))") == "set()"
