"""Mutation testing: fraction of seeded faults detected by the tests, at two revisions.

A mutant has one fault in one expression: a changed operator or constant, a removed sign, or two
swapped arguments. Mutants are sampled with a fixed seed from metrics, priors, samplers and formats
of the first revision. In the second revision they are located by function and expression. Each is
tested for at most 60 s of processor time with the test files that import its module, or else with
those of its package, in order of name similarity and without slow tests.

``mutants_caught_before``, ``mutants_caught_after``: fraction of mutants with failing tests among
those that exist at both revisions. ``mutants_gone``: number of mutants without a match in the
second revision. The benchmark takes about two hours on two cores. Results are stored in ``--out``;
run the same command again to resume an interrupted run.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent
_COUNT, _SEED = 200, 20261123
_SECONDS = 60
_FOLDERS = ("metrics", "formats", "io", "samplers", "models")
# These models are priors; the others are networks and their training.
_PRIORS = (
    "mixture", "pose_chart", "penetration.py", "joint_limits.py", "standard_normal",
    "reduced_latent", "row_decoding", "body_states", "articulated_body", "pair_posterior",
)  # fmt: skip
_OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """Fault in a function: ``new`` replaces the given occurrence of ``old``, counted from 0."""

    file: str
    function: str
    occurrence: int
    old: str
    new: str


def functions(tree: ast.AST, above: str = "") -> Iterator[tuple[str, ast.AST]]:
    """Yield every outermost function and method with its qualified name."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef):
            yield above + node.name, node
        elif isinstance(node, ast.ClassDef):
            yield from functions(node, f"{above}{node.name}.")


def expressions(function: ast.AST) -> Iterator[ast.expr]:
    """Yield the expressions of a function body that are eligible for mutation."""
    for statement in getattr(function, "body", ()):
        waiting: list[ast.AST] = [statement]
        while waiting:
            node = waiting.pop(0)
            if isinstance(node, ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
                continue
            if isinstance(node, ast.expr):
                yield node
            parts = [node.value] if isinstance(node, ast.AnnAssign) and node.value else None
            waiting += parts or list(ast.iter_child_nodes(node))


def mutated(node: ast.expr) -> ast.expr | None:
    """Return the expression with a fault, or None if no fault applies to it."""
    copy = deepcopy(node)
    if isinstance(copy, ast.BinOp) and type(copy.op) in _OPERATORS:
        if isinstance(copy.left, ast.Constant) and isinstance(copy.left.value, str):
            return None
        copy.op = _OPERATORS[type(copy.op)]()  # type: ignore[assignment]
    elif isinstance(copy, ast.Compare) and type(copy.ops[0]) in _OPERATORS:
        copy.ops[0] = _OPERATORS[type(copy.ops[0])]()  # type: ignore[assignment]
    elif isinstance(copy, ast.UnaryOp) and isinstance(copy.op, ast.USub):
        copy = copy.operand
    elif isinstance(copy, ast.Constant) and type(copy.value) in (int, float):
        copy.value = copy.value + 1 if isinstance(copy.value, int) else 1.5 * copy.value + 0.1
    elif isinstance(copy, ast.Call) and len(copy.args) > 1:
        if any(isinstance(arg, ast.Starred) for arg in copy.args[:2]):
            return None
        copy.args[0], copy.args[1] = copy.args[1], copy.args[0]
    else:
        return None
    return copy


def choose(package: Path) -> list[Mutant]:
    """Return the mutants of a revision, sampled with a fixed seed."""
    mutants = []
    for path in sorted(package.rglob("*.py")):
        file = path.relative_to(package).as_posix()
        folder = file.split("/")[0]
        is_prior = folder != "models" or any(prior in file for prior in _PRIORS)
        if folder not in _FOLDERS or not is_prior or "kernels" in file:
            continue
        for name, function in functions(ast.parse(path.read_text(encoding="utf-8"))):
            occurrences: dict[str, int] = {}
            for node in expressions(function):
                old = ast.unparse(node)
                occurrences[old] = occurrences.get(old, -1) + 1
                fault = mutated(node)
                if fault is not None and ast.unparse(fault) != old:
                    mutants.append(Mutant(file, name, occurrences[old], old, ast.unparse(fault)))
    return random.Random(_SEED).sample(mutants, _COUNT)


def apply(mutant: Mutant, package: Path) -> Path | None:
    """Write the fault to its file and return the path, or None if the expression is gone."""
    first = package / mutant.file
    name = mutant.function.rpartition(".")[2]
    for path in [first, *sorted(package.rglob("*.py"))]:
        source = path.read_text(encoding="utf-8") if path.exists() else ""
        if f"def {name}(" not in source:
            continue
        for qualified, function in functions(ast.parse(source)):
            if qualified != mutant.function:
                continue
            same = [node for node in expressions(function) if ast.unparse(node) == mutant.old]
            if len(same) > mutant.occurrence:
                fault = _replaced(source, same[mutant.occurrence], mutant.new)
                path.write_text(fault, encoding="utf-8")
                return path
    return None


def _replaced(source: str, node: ast.expr, new: str) -> str:
    lines = source.encode().splitlines(keepends=True)
    assert node.end_lineno is not None
    assert node.end_col_offset is not None
    start = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    stop = sum(map(len, lines[: node.end_lineno - 1])) + node.end_col_offset
    text = b"".join(lines)
    return (text[:start] + f"({new})".encode() + text[stop:]).decode()


def tests_of(path: Path, package: Path, tests: Path) -> list[str]:
    """Return the test files that import a module or its names, or else those of its package."""
    module = "probmotion." + ".".join(path.relative_to(package).with_suffix("").parts)
    public = {
        node.name
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }
    files = []
    for test in sorted(tests.rglob("test_*.py")):
        for node in ast.walk(ast.parse(test.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not node.module:
                continue
            names = {alias.name for alias in node.names}
            above = module.startswith(f"{node.module}.")
            if node.module == module or (above and names & (public | {module.split(".")[-1]})):
                files.append(test.relative_to(tests.parent).as_posix())
                break
    if not files:
        folder = tests / path.parent.relative_to(package)
        files = [test.relative_to(tests.parent).as_posix() for test in folder.rglob("test_*.py")]
    stem = set(path.stem.split("_"))
    return sorted(files, key=lambda test: (-len(stem & set(Path(test).stem.split("_"))), test))


def install(revision: str, folder: Path) -> None:
    """Create a folder with the installed package of a revision, its metadata and its tests."""
    if (folder / "ready").exists():
        return
    shutil.rmtree(folder, ignore_errors=True)
    checkout = folder / "checkout"
    checkout.mkdir(parents=True)
    archive = subprocess.run(
        ["git", "archive", revision], cwd=_ROOT, stdout=subprocess.PIPE, check=True
    )
    subprocess.run(["tar", "-x"], cwd=checkout, input=archive.stdout, check=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(folder), str(checkout)], check=True)
    for part in ("probmotion", "samplers", "models"):
        shutil.rmtree(checkout / part)
    shared = _ROOT.parent / "shared"
    if shared.exists():
        (folder / "shared").symlink_to(shared)
    (folder / "ready").write_text("")


def run_tests(mutant: Mutant, tree: Path) -> str:
    """Test a mutant and return ``caught``, ``survived``, ``untested`` or ``gone``."""
    package = tree / "probmotion"
    before: dict[Path, str] = {}
    for path in package.rglob("*.py"):
        before[path] = path.read_text(encoding="utf-8")
    changed = apply(mutant, package)
    if changed is None:
        return "gone"
    try:
        files = tests_of(changed, package, tree / "checkout" / "tests")
        if not files:
            return "untested"
        command = [
            sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "-p", "no:cacheprovider",
        ]  # fmt: skip
        environment = os.environ | {
            "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
            "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        done = subprocess.run(
            [*command, *files], cwd=tree / "checkout", env=environment,
            capture_output=True, check=False, stdin=subprocess.DEVNULL,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS)),
        )  # fmt: skip
        # Codes below 0 mean a time limit without a failure, code 5 that no test was selected.
        return "caught" if done.returncode in (1, 2, 3, 4) else "survived"
    finally:
        changed.write_text(before[changed], encoding="utf-8")


def main() -> None:
    """Print the fraction of mutants caught at each revision."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", default="fe35fb8", help="First revision; default: fe35fb8.")
    parser.add_argument("--after", default="HEAD", help="Second revision; default: HEAD.")
    parser.add_argument("--only", choices=("before", "after"), help="Run one revision only.")
    parser.add_argument("--workers", type=int, default=2, help="Number of workers; default: 2.")
    parser.add_argument("--out", type=Path, default=Path("mutants"), help="Output folder.")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    out = options.out.resolve()
    install(options.before, out / "before-0")
    mutants = choose(out / "before-0" / "probmotion")
    results = {}
    for side in ("before", "after"):
        store = out / f"{side}.json"
        outcomes = json.loads(store.read_text(encoding="utf-8")) if store.exists() else {}
        results[side] = outcomes
        if options.only not in (None, side):
            continue
        trees = [out / f"{side}-{worker}" for worker in range(options.workers)]
        for tree in trees:
            install(getattr(options, side), tree)

        def run(
            worker: int,
            trees: list[Path] = trees,
            outcomes: dict[str, str] = outcomes,
            store: Path = store,
        ) -> None:
            for number in range(worker, len(mutants), options.workers):
                if str(number) not in outcomes:
                    outcome = outcomes[str(number)] = run_tests(mutants[number], trees[worker])
                    store.write_text(json.dumps(outcomes, indent=1), encoding="utf-8")
                    print(store.stem, number, outcome, asdict(mutants[number]), flush=True)

        with ThreadPoolExecutor(options.workers) as pool:
            list(pool.map(run, range(options.workers)))
    common = [
        n for n, result in results["after"].items() if result != "gone" and n in results["before"]
    ]
    for side in ("before", "after"):
        numbers = common or list(results[side])
        detected = [results[side].get(n) == "caught" for n in numbers]
        print(f"mutants_caught_{side}: {sum(detected) / max(1, len(detected)):.3f}")
    print(f"mutants_gone: {sum(result == 'gone' for result in results['after'].values())}")


if __name__ == "__main__":
    main()
