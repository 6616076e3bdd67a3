"""Check that a change of layout left every draw as it was.

Draws with every sampler from every problem, with few steps, at this checkout and at another
revision, and compares the bits. ``moved_draws_differ``: runs whose draws differ, or that fail at
one of the two. ``moved_draws_compared``: runs that returned draws at both. Problems whose data is
missing are left out of both. Takes about ten minutes on two cores.
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
# Enough to pass through every branch of a sampler, not enough for good draws.
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

    found = {}
    for problem in problem_names():
        try:
            posterior = load_problem(problem).posterior
        except FileNotFoundError:
            continue
        for name, sampler in quick_samplers().items():
            found[f"{problem}/{name}"] = _digest(_short(sampler), posterior)
            print(f"{problem}/{name}: {found[f'{problem}/{name}'][:40]}", file=sys.stderr)
    return found


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
    """Return the digests of the package in ``folder``, laid out as a wheel holds it."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--digests"]
    done = subprocess.run(command, env=environment, cwd=folder, stdout=subprocess.PIPE, check=True)
    return dict(json.loads(done.stdout))


def _lay_out(revision: str, folder: Path) -> Path:
    """Install a revision into ``folder``, with its own entry points."""
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
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", default="fe35fb8", help="Revision to compare with.")
    parser.add_argument("--digests", action="store_true", help="Print this tree's digests as JSON.")
    parser.add_argument("--keep", type=Path, help="File that keeps the other revision's digests.")
    given = parser.parse_args()
    if given.digests:
        print(json.dumps(digests()))
        return
    with tempfile.TemporaryDirectory() as made:
        if given.keep and given.keep.exists():
            before = dict(json.loads(given.keep.read_text(encoding="utf-8")))
        else:
            before = _digests_of_tree(_lay_out(given.before, Path(made) / "before"))
            if given.keep:
                given.keep.write_text(json.dumps(before, indent=1), encoding="utf-8")
        after = _digests_of_tree(_lay_out("HEAD", Path(made) / "after"))
    differing = [run for run in before | after if before.get(run) != after.get(run)]
    for run in differing:
        print(f"{run}: {before.get(run)} before, {after.get(run)} after")
    drawn = [run for run, digest in before.items() if len(digest) == 64 and run in after]
    print(f"moved_draws_compared: {len(drawn)}")
    print(f"moved_draws_differ: {len(differing)}")


if __name__ == "__main__":
    main()
