"""Which room may import which, and what importing costs."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {
    "torch", "jax", "jaxlib", "numpyro", "emcee", "matplotlib", "arviz_base", "arviz_stats",
    "xarray", "pandas", "scipy.stats", "tyro", "tqdm", "pooch", "safetensors", "diffusers",
}  # fmt: skip
# What modules of the language may import where they are used, as `import probmotion` may not.
ON_USE = {"scipy.stats", "xarray", "pandas"}
PROBE = """
import sys, time
start = time.perf_counter()
import probmotion
seconds = time.perf_counter() - start
import json
print(json.dumps({"seconds": seconds, "modules": sorted(sys.modules)}))
"""


def imported_by_probe() -> dict:
    run = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)
    return json.loads(run.stdout)


def test_importing_the_package_is_light_and_fast() -> None:
    """Best of several: a busy machine must not fail it, a heavy import must."""
    probes = [imported_by_probe() for _ in range(5)]
    assert HEAVY & set(probes[0]["modules"]) == set()
    assert min(probe["seconds"] for probe in probes) <= 0.3


@pytest.mark.parametrize(
    "module", ["skeleton", "motion", "cameras", "likelihoods", "posterior", "rotations", "seeds"]
)
def test_the_language_imports_no_library_of_networks_or_pictures(module: str) -> None:
    probe = f"import sys, probmotion.{module}; print(sorted({HEAVY - ON_USE} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_problems_load_no_network_that_they_are_not_about() -> None:
    """A worker of a comparison begins with this."""
    probe = "import sys, probmotion.problems; print(sorted({'torch', 'jax'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_every_public_name_is_there() -> None:
    import probmotion

    for name in probmotion.__all__:
        home = probmotion._HOMES[name]
        if find_spec(f"probmotion.{home}") is not None:
            assert getattr(probmotion, name).__name__ == name
    assert set(probmotion.__all__) == set(probmotion._HOMES) <= set(dir(probmotion))
    with pytest.raises(AttributeError, match="module 'probmotion' has no attribute 'Motions'"):
        probmotion.Motions  # noqa: B018


# The three sentences of the design: a sampler never imports a model, a model never imports a
# sampler, the language imports neither but for its two upper floors (the command line has
# a file for each family of commands).


def imports_of(path: Path, package: str) -> set[str]:
    """Every module that a file names in an import, wherever in the file it stands."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*parts, *filter(None, [node.module])]) if node.level else node.module
            found |= {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant)}
    return found


def files_of(room: str) -> list[tuple[Path, str]]:
    """The files of a room with the package that each is in."""
    return [
        (path, ".".join(path.relative_to(ROOT).parent.parts))
        for path in sorted((ROOT / room).rglob("*.py"))
    ]


def trespasses(files: list[tuple[Path, str]], *rooms: str) -> list[str]:
    return [
        f"{path.relative_to(ROOT)} imports {module}"
        for path, package in files
        for module in imports_of(path, package)
        if any(f"{module}.".startswith(f"{room}.") for room in rooms)
    ]


def test_a_sampler_never_imports_a_model() -> None:
    files = [(path, f"probmotion.{package}") for path, package in files_of("samplers")]
    assert files
    assert trespasses(files, "probmotion.models", "models") == []


def test_a_model_never_imports_a_sampler() -> None:
    files = [(path, f"probmotion.{package}") for path, package in files_of("models")]
    assert files
    assert trespasses(files, "probmotion.samplers", "samplers") == []


def test_the_language_imports_neither_below_its_upper_floors() -> None:
    lower = [
        (path, package)
        for path, package in files_of("probmotion")
        if path.name
        not in (
            "cli.py",
            "comparison_commands.py",
            "file_commands.py",
            "training_commands.py",
            "body_training_commands.py",
            "motion_vae_commands.py",
            "training_options.py",
        )
        and not package.startswith("probmotion.problems")
    ]
    assert len(lower) > 20
    rooms = ("probmotion.samplers", "probmotion.models", "samplers", "models")
    assert trespasses(lower, *rooms) == []


def test_trespasses_are_seen(tmp_path: Path) -> None:
    """The test can fail: every way to write the import is found."""
    for line in (
        "import probmotion.models",
        "from probmotion import models",
        "from probmotion.models.mixture_fit import fit_styles as f",
        "def late():\n    from probmotion.models import GaussianMixtureMotion",
        "from ..models import GaussianMixtureMotion",
        "from .. import models",
        "import importlib\nimportlib.import_module('probmotion.models')",
    ):
        path = tmp_path / "sampler.py"
        path.write_text(line)
        found = imports_of(path, "probmotion.samplers")
        assert any(f"{module}.".startswith("probmotion.models.") for module in found), line
