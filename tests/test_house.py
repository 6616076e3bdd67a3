"""The laws of the layout: who may import whom, what a room holds, and what importing costs."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WINGS = ("probmotion", "samplers", "models")
MOST_ROOMS = 36
# Loose files that a wing may hold beside its rooms.
LOOSE = {
    "probmotion": {"arrays", "citations", "files", "seeds", "threads", "validation"},
    "probmotion.models": set(),
    "probmotion.samplers": {"adam", "densities", "exact", "independent"},
}
HEAVY = {
    "torch", "jax", "jaxlib", "numpyro", "emcee", "matplotlib", "arviz_base", "arviz_stats",
    "xarray", "pandas", "scipy.stats", "tyro", "tqdm", "pooch", "safetensors", "diffusers",
}  # fmt: skip
# What modules of the lower rooms may import, as `import probmotion` may not.
ON_USE = {"scipy.stats", "xarray", "pandas"}
PROBE = """
import sys, time
start = time.perf_counter()
import probmotion
seconds = time.perf_counter() - start
import json
print(json.dumps({"seconds": seconds, "modules": sorted(sys.modules)}))
"""

Graph = dict[str, set[str]]


def name_of(path: Path) -> str:
    """Return the module that a file is installed as."""
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    name = name if name.startswith("probmotion") else f"probmotion.{name}"
    return name.removesuffix(".__init__")


FILES = {
    name_of(path): path
    for wing in WINGS
    for path in sorted((ROOT / wing).rglob("*.py"))
    if path.name != "__init__.py"
}
FACES = {
    name_of(path): path for wing in WINGS for path in sorted((ROOT / wing).rglob("__init__.py"))
}


def room_of(module: str) -> str:
    return module if module in FACES else module.rpartition(".")[0]


def imported_names(source: str, package: str) -> set[str]:
    """Return every dotted name that a file imports, wherever in the file it does."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1]
            base = ".".join([*parts, *filter(None, [node.module])]) if node.level else node.module
            found |= {f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            found |= {str(arg.value) for arg in node.args if isinstance(arg, ast.Constant)}
    return found


def module_of(name: str) -> str | None:
    """Return the file that a dotted name comes from; a name of a face, from the file behind it."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        head = ".".join(parts[:length])
        if head in FILES:
            return head
        if head in FACES:
            if length == len(parts):
                return head
            stub = FACES[head].with_suffix(".pyi").read_text(encoding="utf-8")
            for node in ast.parse(stub).body:
                names = [alias.name for alias in getattr(node, "names", [])]
                if isinstance(node, ast.ImportFrom) and node.module and parts[length] in names:
                    return f"{head}.{node.module}"
            return head
    return None


def import_graph() -> Graph:
    return {
        module: {
            target
            for name in imported_names(path.read_text(encoding="utf-8"), room_of(module))
            if (target := module_of(name)) is not None and target != module
        }
        for module, path in FILES.items()
    }


def rooms_of(graph: Graph) -> Graph:
    """Return which room imports which; the loose files of ``probmotion`` lie below all rooms."""
    rooms: Graph = {}
    for module, targets in graph.items():
        room = rooms.setdefault(room_of(module), set())
        room |= {room_of(target) for target in targets} - {room_of(module), "probmotion"}
    return rooms


def circles(graph: Graph) -> list[list[str]]:
    """Return the groups of nodes that import each other, however far around."""
    reach = {node: _reached(graph, node) for node in graph}
    groups = {
        tuple(sorted(other for other in reach[node] if node in reach.get(other, set())))
        for node in graph
        if node in reach[node]
    }
    return sorted(map(list, groups))


def _reached(graph: Graph, start: str) -> set[str]:
    seen: set[str] = set()
    waiting = list(graph[start])
    while waiting:
        node = waiting.pop()
        if node not in seen:
            seen.add(node)
            waiting += graph.get(node, ())
    return seen


def trespasses(graph: Graph, wing: str, other: str) -> list[str]:
    return [
        f"{module} imports {target}"
        for module, targets in graph.items()
        if module.startswith(f"{wing}.")
        for target in targets
        if f"{target}.".startswith(f"{other}.")
    ]


@pytest.fixture(scope="module")
def graph() -> Graph:
    found = import_graph()
    assert len(found) > 200
    return found


def test_no_file_imports_in_a_circle(graph: Graph) -> None:
    assert circles(graph) == []


def test_no_room_imports_in_a_circle(graph: Graph) -> None:
    assert circles(rooms_of(graph)) == []


def test_a_sampler_imports_no_model_and_a_model_no_sampler(graph: Graph) -> None:
    assert trespasses(graph, "probmotion.samplers", "probmotion.models") == []
    assert trespasses(graph, "probmotion.models", "probmotion.samplers") == []


def test_the_loose_files_import_no_room(graph: Graph) -> None:
    upwards = {
        module: targets - set(LOOSE["probmotion"])
        for module in graph
        if room_of(module) == "probmotion"
        for targets in [{target.removeprefix("probmotion.") for target in graph[module]}]
    }
    assert all(targets == set() for targets in upwards.values()), upwards


def test_there_are_few_rooms_and_few_loose_files() -> None:
    rooms = {room_of(module) for module in FILES}
    assert len(rooms) <= MOST_ROOMS
    for wing, allowed in LOOSE.items():
        loose = {module.rpartition(".")[2] for module in FILES if room_of(module) == wing}
        assert loose == allowed


def test_a_room_holds_at_most_sixteen_files() -> None:
    for room in FACES:
        files = [module for module in FILES if room_of(module) == room]
        assert len(files) <= 16, f"{room} holds {len(files)}"


def test_a_face_is_a_sentence_and_its_public_names() -> None:
    for room, path in FACES.items():
        if room == "probmotion":
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        sentence = ast.get_docstring(tree)
        assert sentence, room
        kinds = [type(node) for node in tree.body[1:]]
        assert kinds == [ast.Import, ast.Assign], room


def test_every_public_name_is_there() -> None:
    """A name in a face comes from the file that the stub says, and no module hides it."""
    for room, path in FACES.items():
        face = importlib.import_module(room)
        stub = ast.parse(path.with_suffix(".pyi").read_text(encoding="utf-8"))
        for node in stub.body:
            assert isinstance(node, ast.ImportFrom)
            for alias in node.names:
                assert alias.name in face.__all__
                home = importlib.import_module(".".join(filter(None, [room, node.module])))
                if node.module is not None:
                    assert getattr(face, alias.name) is getattr(home, alias.name)
                    assert f"{room}.{alias.name}" not in FILES, alias.name
    with pytest.raises(AttributeError, match="Motions"):
        importlib.import_module("probmotion").Motions  # noqa: B018


def test_tests_mirror_the_rooms() -> None:
    rooms = {path.parent.relative_to(ROOT).as_posix() for path in FACES.values()}
    rooms = {room.removeprefix("probmotion/").removeprefix("probmotion") for room in rooms}
    tests = ROOT / "tests"
    folders = {path.parent.relative_to(tests).as_posix() for path in tests.rglob("test_*.py")} - {
        ".",
        "studies",
    }
    assert folders <= rooms


@pytest.mark.parametrize(
    "line",
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
def test_a_trespass_is_seen(line: str) -> None:
    """The test can fail: every way to write the import is found."""
    names = imported_names(line, "probmotion.samplers")
    found = {"probmotion.samplers.new": {target for name in names if (target := module_of(name))}}
    assert trespasses(found, "probmotion.samplers", "probmotion.models")


def test_a_circle_is_seen() -> None:
    chain: Graph = {"a": {"b"}, "b": {"c"}, "c": set()}
    assert circles(chain) == []
    assert circles(chain | {"c": {"a"}}) == [["a", "b", "c"]]


def probed(code: str) -> str:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return run.stdout.strip()


def test_importing_the_package_is_light_and_fast() -> None:
    """Best of several: a busy machine must not fail it, a heavy import must."""
    probes = [json.loads(probed(PROBE)) for _ in range(5)]
    assert HEAVY & set(probes[0]["modules"]) == set()
    assert min(probe["seconds"] for probe in probes) <= 0.3


@pytest.mark.parametrize(
    "modules",
    [
        ("motion.skeleton", "motion.motion", "geometry.cameras", "geometry.rotations", "seeds"),
        ("posteriors.likelihoods", "posteriors.posterior"),
    ],
)
def test_the_lower_rooms_import_no_network_and_no_plots(modules: Iterable[str]) -> None:
    imports = ", ".join(f"probmotion.{module}" for module in modules)
    assert (
        probed(f"import sys, {imports}; print(sorted({HEAVY - ON_USE} & set(sys.modules)))") == "[]"
    )


def test_problems_load_no_network_that_they_are_not_about() -> None:
    """A worker of a comparison begins with this."""
    code = "import sys, probmotion.problems.catalogue; print({'torch', 'jax'} & set(sys.modules))"
    assert probed(code) == "set()"
