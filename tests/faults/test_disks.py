"""Full, read-only and vanished disks: one sentence, and earlier files are as they were."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
import warnings
from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from own_files import OWN, write_comparison

import probmotion as pm
from probmotion import files
from probmotion.calibration.error_result import ErrorDecomposition
from probmotion.cli.main import main
from probmotion.comparison import Comparison
from probmotion.comparison.measurements import save_measurements
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.npz import write_npz
from probmotion.models.images.category import Category
from probmotion.models.mixture import SpectralMixtureMotion
from probmotion.motion.motion import Motion
from probmotion.plots.skeletons import draw_skeletons
from probmotion.posteriors import streams
from probmotion.samplers.mcmc import stored_chain
from probmotion.samplers.mcmc.stored_chain import StoredChain

WALK = make_gait("walk", 0, frames=60, fps=30.0)
CLIPS = "--size tiny --validation walk3 --test walk4 --batch 4 --checkpoint-every 2"


def run(*words):
    """Run a command; raise an error if it ends with the status of an error."""
    if main([str(word) for word in words]) == 2:
        raise OSError


def results(folder, number):
    """Return the results of a grid in another folder; the second has larger files."""
    if not (folder.parent / "grid1").exists():
        for grid in (folder.parent / "grid1", folder.parent / "grid2"):
            grid.mkdir()
            write_comparison(grid)
        with open(grid / "runs/filmed/good/0/draws.nc", "ab") as file:
            file.write(bytes(100_000))
    return Comparison.load(folder.parent / f"grid{number}")


def compare(folder, number):
    pm.compare(
        "gait(frames=8)", "exact", draws=20, chains=2, seeds=number, out=folder, workers=0,
        progress=False,
    )  # fmt: skip


def stream(folder, number):
    sampler = pm.samplers.MetropolisHastings(warmup=20, thin=1)
    problem = pm.problem("gait-monocular", frames=6).posterior
    streams.stream_draws(sampler, problem, folder, draws=40 * number, chains=2, progress=False)


def train(folder, number):
    clips = folder.parent / "clips"
    if number == 1:
        clips.mkdir()
        for walk in range(5):
            pm.save(make_gait("walk", walk, frames=40, fps=30.0), clips / f"walk{walk}.npz")
    steps = ["--steps", 2 * number, "--out", folder]
    run("train", "dvae", "--clips", f"{clips}/walk*.npz", *CLIPS.split(), *steps)


def denoise(folder, number):
    source = folder.parent / "noisy.npz"
    if number == 1:
        noise = 0.02 * np.random.default_rng(0).normal(size=WALK.positions.shape)
        write_npz(Motion(WALK.positions + noise, WALK.skeleton, WALK.fps), source)
    run("denoise", source, "--draws", 2, "--out", folder)


def calibrate(folder, number):
    simulations = {"simulations": 10 * number, "draws": 20, "chains": 1}
    pm.calibrate("gait(frames=8)", "exact", **simulations, out=folder, workers=0, progress=False)


def decompose(folder, number):
    rows = [{"swd_ratio": 1.0 + seed, "seconds": 1.0} for seed in range(3)]
    ErrorDecomposition("walk", {"exact": rows, "mas": rows[::-1]}).write(folder / "errors.csv")


def store_chain(folder, number):
    """Store a chain; its errors are warnings, as sampling continues."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        StoredChain(folder / "chain.npz").save(lambda: {"poses": np.full((99, 99), number)})
    for warning in caught:
        raise OSError(str(warning.message))


def lift(folder, number):
    from probmotion.data.videos import film

    filmed = film(make_gait("walk", 1, frames=30), 0, azimuth=0.8).track
    pm.lift(filmed, image_size=(1000, 1000), draws=2).save(folder)


def lift_pairs(folder, number):
    pairs().save(folder)


@cache
def pairs():
    """Return two people in 60 frames, without a lift."""
    from probmotion.data.synthetic.dances import synthetic_dances
    from probmotion.interaction.annotations import Annotations
    from probmotion.lifting import LiftedPairs
    from probmotion.models.unseen_depth import AnnotationPrior

    dance = synthetic_dances(1, frames=60, seed=5)[0]
    keypoints, spread = dance.positions[..., :2], np.full(dance.positions.shape, 0.1)
    seen = np.ones(keypoints.shape[:2], bool)
    neighbours = np.full((len(keypoints), 2, *keypoints.shape[1:]), np.nan)
    annotations = Annotations(keypoints, seen, dance.skeleton, neighbours, dance.fps)
    poses = dance.positions[:1] - dance.positions[:1].mean(axis=1, keepdims=True)
    prior = AnnotationPrior(np.ones(1), poses, 0.1 * np.eye(102)[None], 0.03, np.zeros((1, 2)))
    return LiftedPairs(
        dance, spread, dance.positions[None], keypoints, 0.0, annotations, prior, -1.0
    )


def reconstruct(folder, number):
    reconstruction().save(folder)


@cache
def reconstruction():
    """Return a made image with draws about its truth."""
    from probmotion.models.images.made_images import make_images
    from probmotion.models.images.observation import ImageObservation
    from probmotion.models.images.surface_prior import SurfacePrior
    from probmotion.reconstruction import Reconstruction

    rng = np.random.default_rng(0)
    prior = SurfacePrior(Category.load("quadruped"), np.array([0.15]))
    made = make_images(prior, rng, 1, 64)
    observation = ImageObservation(made.mask, made.rgb, None, prior.tangent, np.eye(3)[None])
    draws = made.theta + 0.2 * rng.normal(size=(4, prior.dim))
    return Reconstruction(observation, prior, made.theta[0], draws, ())


@cache
def shipped(kind, name):
    return kind.load(name)


WRITERS = {
    "grid": compare,
    "stream": stream,
    "training": train,
    "denoise": denoise,
    "report": lambda folder, number: results(folder, 1).report(folder / "report.html"),
    "results": lambda folder, number: results(folder, number).write(folder),
    "measurements": lambda folder, number: save_measurements(
        results(folder, number), f"command {number}", folder
    ),
    "calibration": calibrate,
    "decomposition table": decompose,
    "chain": store_chain,
    "lift": lift,
    "lifted pairs": lift_pairs,
    "reconstruction": reconstruct,
    "spectral prior": lambda folder, number: shipped(SpectralMixtureMotion, "cmu-motion").save(
        folder / "prior.npz"
    ),
    "category": lambda folder, number: shipped(Category, "quadruped").save(folder / "c.npz"),
    "figure": lambda folder, number: draw_skeletons(
        {"walk": WALK.positions[None]}, WALK.skeleton, folder / "walk.png"
    ),
    **{
        suffix: lambda folder, number, suffix=suffix: pm.save(WALK, folder / f"walk{suffix}")
        for suffix in (".bvh", ".glb", ".npz", ".csv", ".trc")
    },
    **{
        kind: lambda folder, number, write=OWN[kind][0]: write(folder)
        for kind in (
            "draws", "reference", "annotations", "annotation prior", "pose depth", "joint limits",
            "checkpoint", "decomposition", "stored problem",
        )
    },
}  # fmt: skip
SLOW = ("lift", "reconstruction", "spectral prior")
ALL = [pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else [], id=n) for n in WRITERS]


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(streams, "_BLOCK_BYTES", 80_000)
    monkeypatch.setattr(stored_chain, "_SECONDS", 0.0)


def contents(folder):
    """Return the files that a user sees; locks are empty and tables say when they were written."""
    visible = [path for path in folder.rglob("*") if path.is_file() and path.name[0] != "."]
    return {path: path.read_bytes() for path in visible}


def unfinished(folder):
    return [*folder.rglob("*unfinished*"), *folder.rglob("*.partial")]


def fill(folder):
    """Fill a disk to its last byte."""
    with open(folder.parent / "filling", "wb", buffering=0) as file, suppress(OSError):
        while file.write(bytes(4096)):
            pass


def refused(write, folder, capsys):
    """Check that writing is refused in one sentence."""
    with pytest.raises(OSError) as caught:  # noqa: PT011 (its message is checked below)
        write(folder, 2)
    printed = capsys.readouterr().err
    assert "Traceback" not in printed
    lines = [line for line in printed.splitlines() if line.startswith("probmotion: ")]
    message = str(caught.value) or lines[-1]
    assert any(words in message for words in ("cannot write", "must be a writable folder")), message


@pytest.mark.parametrize("name", ALL)
def test_a_full_disk(name, disk, account, capsys):
    folder = disk / "out"
    folder.mkdir()
    WRITERS[name](folder, 1)
    before = contents(folder)
    fill(folder)
    with account("full disk", name):
        refused(WRITERS[name], folder, capsys)
        after = contents(folder)
        assert {path: after.get(path) for path in before} == before
        assert after.keys() == before.keys()
        # Zarr writes in threads: the error of one comes before another has deleted its file.
        deadline = time.monotonic() + 10.0
        while unfinished(folder) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert not unfinished(folder)
    (disk / "filling").unlink()
    with account("space again", name):
        WRITERS[name](folder, 2)


@pytest.mark.parametrize("name", ALL)
def test_a_read_only_disk(name, disk, account, capsys):
    folder = disk / "out"
    folder.mkdir()
    WRITERS[name](folder, 1)
    before = contents(folder)
    subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
    with account("read-only disk", name):
        refused(WRITERS[name], folder, capsys)
        assert contents(folder) == before


# A reference is written beside its folder.
@pytest.mark.parametrize("name", [each for each in ALL if each.id != "reference"])
def test_a_folder_that_vanishes(name, tmp_path, account, capsys, monkeypatch):
    """The folder is deleted before the first file of the second writing is complete."""
    folder, replaced = tmp_path / "out", os.replace
    folder.mkdir()
    WRITERS[name](folder, 1)

    def vanish(source, target):
        shutil.rmtree(folder)
        replaced(source, target)

    monkeypatch.setattr(files.os, "replace", vanish)
    with account("vanished folder", name):
        refused(WRITERS[name], folder, capsys)
