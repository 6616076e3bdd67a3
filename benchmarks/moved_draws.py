"""Bitwise comparison of all draws between two revisions, as a regression check.

Runs every sampler on every problem with few steps, at HEAD and at another revision.
``moved_draws_differ``: number of runs with different draws, or with an error at one revision only.
``moved_draws_compared``: number of runs with draws at both revisions. Problems without data are
skipped. The comparison takes about ten minutes on two cores.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

_ROOT = Path(__file__).resolve().parent.parent
# These settings execute every branch of a sampler, but do not yield accurate draws.
_EFFORT = {
    "steps": 8,
    "iterations": 20,
    "training_steps": 20,
    "training_pairs": 256,
    "warmup": 20,
    "thin": 2,
    "candidates": 50,
}
_DRAWS, _CHAINS, _SEED = 3, 2, 0


def digests() -> dict[str, str]:
    """Return the SHA-256 of the draws of each run, or the name of its error."""
    from probmotion.comparison import quick_samplers
    from probmotion.problems import load_problem, problem_names

    results = {}
    for problem in problem_names():
        try:
            posterior = load_problem(problem).posterior
        except FileNotFoundError:
            continue
        for name, sampler in quick_samplers().items():
            results[f"{problem}/{name}"] = _digest(_short(sampler), posterior)
            print(f"{problem}/{name}: {results[f'{problem}/{name}'][:40]}", file=sys.stderr)
    return results


def _short(sampler: Any) -> Any:
    settings = {
        field.name: _EFFORT[field.name] for field in fields(sampler) if field.name in _EFFORT
    }
    return replace(sampler, **settings)


def _digest(sampler: Any, posterior: Any) -> str:
    try:
        drawn = sampler.sample(posterior, draws=_DRAWS, chains=_CHAINS, seed=_SEED, progress=False)
    except Exception as error:
        return type(error).__name__
    return hashlib.sha256(np.asarray(drawn.positions).tobytes()).hexdigest()


def _digests_of_tree(folder: Path) -> dict[str, str]:
    """Return the digests of the package installed in ``folder``."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--digests"]
    done = subprocess.run(command, env=environment, cwd=folder, stdout=subprocess.PIPE, check=True)
    return dict(json.loads(done.stdout))


def _install(revision: str, folder: Path) -> Path:
    """Install a revision and its entry points into ``folder``; return the installed tree."""
    source = folder / "source"
    source.mkdir(parents=True)
    archive = subprocess.run(
        ["git", "archive", revision], cwd=_ROOT, stdout=subprocess.PIPE, check=True
    )
    subprocess.run(["tar", "-x"], cwd=source, input=archive.stdout, check=True)
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(folder / "tree"), str(source)], check=True)
    return folder / "tree"


def main() -> None:
    """Print the differing runs and their number."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", default="fe35fb8", help="Other revision; default: fe35fb8.")
    parser.add_argument("--digests", action="store_true", help="Print this tree's digests as JSON.")
    parser.add_argument("--keep", type=Path, help="Cache file for digests of the other revision.")
    options = parser.parse_args()
    if options.digests:
        print(json.dumps(digests()))
        return
    with tempfile.TemporaryDirectory() as folder:
        if options.keep and options.keep.exists():
            before = dict(json.loads(options.keep.read_text(encoding="utf-8")))
        else:
            before = _digests_of_tree(_install(options.before, Path(folder) / "before"))
            if options.keep:
                options.keep.write_text(json.dumps(before, indent=1), encoding="utf-8")
        after = _digests_of_tree(_install("HEAD", Path(folder) / "after"))
    differing = [run for run in before | after if before.get(run) != after.get(run)]
    for run in differing:
        print(f"{run}: {before.get(run)} before, {after.get(run)} after")
    compared = [run for run, digest in before.items() if len(digest) == 64 and run in after]
    print(f"moved_draws_compared: {len(compared)}")
    print(f"moved_draws_differ: {len(differing)}")


if __name__ == "__main__":
    main()
