"""A built wheel, installed outside the checkout, is complete and runs a comparison."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "probmotion": "probmotion",
    "samplers": "probmotion/samplers",
    "models": "probmotion/models",
}


def run(*arguments: str | Path, **options) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Wheel built from a copy of the checkout."""
    source, out = (tmp_path_factory.mktemp(name) for name in ("source", "wheel"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    run("-m", "build", "--wheel", "--no-isolation", "--outdir", out, source)
    (path,) = out.glob("*.whl")
    return path


def test_wheel_contains_every_module_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        files = {name for name in archive.namelist() if ".dist-info/" not in name}
    modules = {
        f"{target}/{path.relative_to(ROOT / name).as_posix()}"
        for name, target in PACKAGES.items()
        for path in (ROOT / name).rglob("*.py*")
        if path.suffix in (".py", ".pyi")
    }
    data = {
        "py.typed", "data/person_clips.csv", "data/registry.csv", "plots/animation.css",
        "plots/animation.js", "plots/map.js", "plots/picture.js", "reconstruction/surface.js",
        "report/copy.js", "report/page.css", "report/tables.js", "comparison/measured.csv",
        "comparison/measured.json", "comparison/longer.csv",
    }  # fmt: skip
    data |= {
        f"problems/references/{name}/{file}"
        for name in (
            "dance-pairs",
            "gait-noisy3d",
            "salsa-pairs",
            "salsa-physical",
            "walk-vae-monocular",
        )
        for file in ("draws.npz", "certificate.json")
    }
    weights = [
        "joint_limits.md", "joint_limits.npz", "body-dvae.md", "body-dvae.safetensors",
        "body-dvae-denoiser.safetensors", "cmu-motion.md", "cmu-motion.npz",
        "cmu-motion-coco17.md", "cmu-motion-coco17.npz", "salsa-pairs.md", "salsa-pairs.npz",
        "pose-depth.md", "pose-depth.npz", "joint-corrector.md", "joint-corrector.safetensors",
    ]  # fmt: skip
    weights += [
        f"{name}{ending}"
        for name in ("walk2d", "motion2d", "walk-vae", "animal-vae")
        for ending in (".md", ".safetensors", "-evaluator.safetensors", "-features.npz")
    ]
    weights += [
        f"{name}-images{ending}"
        for name in ("quadruped", "person")
        for ending in (".md", ".npz", ".safetensors")
    ]
    data |= {f"models/weights/{name}" for name in weights}
    assert files == modules | {f"probmotion/{name}" for name in data}


def test_installed_wheel_runs_a_comparison(wheel, tmp_path):
    site = tmp_path / "site"
    run("-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", site, wheel)
    environment = os.environ | {"PYTHONPATH": str(site)}
    code = (
        "import probmotion, probmotion.samplers as s, probmotion.models as m;"
        "s.ExactSampler; m.GaussianMixtureMotion;"
        "print(probmotion.__file__, s.__file__, m.__file__, sep='\\n')"
    )
    for file in run("-c", code, cwd=tmp_path, env=environment).split():
        assert Path(file).is_relative_to(site)
    command = [site / "bin" / "probmotion", "compare", "gait", "--samplers", "exact"]
    assert "exact" in run(*command, "--draws", "20", cwd=tmp_path, env=environment)
    header = (tmp_path / "comparison" / "table.csv").read_text().splitlines()[0]
    assert header == "problem,sampler,seed,metric,value"
