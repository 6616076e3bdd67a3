"""A built wheel, installed away from the checkout, imports and runs a comparison."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = {
    "probmotion": "probmotion",
    "samplers": "probmotion/samplers",
    "models": "probmotion/models",
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Return a wheel built from a copy of the checkout."""
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for room in ROOMS:
        shutil.copytree(ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__"))
    out = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out)]
    done = subprocess.run([*build, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = out.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """Return the folder that the wheel is installed into, without its dependencies."""
    target = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    done = subprocess.run(
        [*pip, "--target", str(target), str(wheel)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return target


def run(installed: Path, folder: Path, *words: str) -> str:
    """Run Python in ``folder`` with the installed wheel before everything else."""
    environment = os.environ | {
        "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_holds_every_module_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
    wanted = {
        f"{place}/{path.relative_to(ROOT / room).as_posix()}"
        for room, place in ROOMS.items()
        for path in (ROOT / room).rglob("*.py*")
        if path.suffix in (".py", ".pyi")
    }
    data = {"py.typed", "data/registry.csv", "plots/animation.css", "plots/animation.js"}
    data |= {"report/page.css", "report/tables.js"}
    data |= {"comparison/measured.csv", "comparison/measured.json"}
    data |= {
        f"problems/references/{name}/{file}"
        for name in ("dance-pairs", "gait-noisy3d", "salsa-pairs", "walk-vae-monocular")
        for file in ("draws.npz", "certificate.json")
    }
    learnt = ("joint_limits.npz", "walk2d.md", "walk2d.safetensors", "walk2d-evaluator.safetensors")
    body = ("body-dvae.md", "body-dvae.safetensors", "body-dvae-denoiser.safetensors")
    vae = [
        f"{name}{ending}"
        for name in ("walk-vae", "animal-vae")
        for ending in (".md", ".safetensors", "-evaluator.safetensors", "-features.npz")
    ]
    features = ("walk2d-features.npz",)
    data |= {f"models/weights/{name}" for name in (*learnt, *body, *vae, *features)}
    assert held == wanted | {f"probmotion/{name}" for name in data}


def test_it_imports_from_where_it_was_installed(installed, tmp_path):
    code = (
        "import probmotion, probmotion.samplers as s, probmotion.models as m;"
        "s.ExactSampler; m.GaussianMixtureMotion;"
        "print(probmotion.__file__, s.__file__, m.__file__, sep='\\n')"
    )
    for line in run(installed, tmp_path, "-c", code).split():
        assert Path(line).is_relative_to(installed)


def test_it_runs_a_comparison(installed, tmp_path):
    program = installed / "bin" / "probmotion"
    words = ["compare", "gait", "--samplers", "exact", "--draws", "20"]
    printed = run(installed, tmp_path, str(program), *words)
    assert "exact" in printed
    header = (tmp_path / "comparison" / "table.csv").read_text().splitlines()[0]
    assert header == "problem,sampler,seed,metric,value"
