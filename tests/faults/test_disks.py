"""Full, read-only and vanished disks: one sentence, and earlier files are as they were."""

from __future__ import annotations

import os
import shutil
import subprocess
from contextlib import suppress

import numpy as np
import pytest
from own_files import OWN, write_comparison

import probmotion as pm
from probmotion import files
from probmotion.cli.main import main
from probmotion.comparison import Comparison
from probmotion.data.synthetic.gaits import make_gait
from probmotion.io.npz import write_npz
from probmotion.motion.motion import Motion
from probmotion.plots.skeletons import draw_skeletons
from probmotion.posteriors import streams

WALK = make_gait("walk", 0, frames=60, fps=30.0)
CLIPS = "--size tiny --validation walk3 --test walk4 --batch 4 --checkpoint-every 2"


def run(*words):
    """Run a command; raise an error if it ends with the status of an error."""
    if main([str(word) for word in words]) == 2:
        raise OSError


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


def report(folder, number):
    if number == 1:
        (folder.parent / "comparison").mkdir()
        write_comparison(folder.parent / "comparison")
    Comparison.load(folder.parent / "comparison").report(folder / "report.html")


def lift(folder, number):
    from probmotion.data.videos import film

    filmed = film(make_gait("walk", 1, frames=30), 0, azimuth=0.8).track
    pm.lift(filmed, image_size=(1000, 1000), draws=2).save(folder)


WRITERS = {
    "grid": compare,
    "stream": stream,
    "training": train,
    "denoise": denoise,
    "report": report,
    "lift": lift,
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
            "draws", "reference", "annotations", "annotation prior", "joint limits", "checkpoint",
            "decomposition", "stored problem",
        )
    },
}  # fmt: skip
ALL = [pytest.param(n, marks=[pytest.mark.slow] if n == "lift" else [], id=n) for n in WRITERS]


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    monkeypatch.setattr(streams, "_BLOCK_BYTES", 80_000)


def contents(folder):
    """Return the files that a user sees; locks are empty and tables say when they were written."""
    visible = [path for path in folder.rglob("*") if path.is_file() and path.name[0] != "."]
    return {path: path.read_bytes() for path in visible}


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
        assert not [*folder.rglob("*unfinished*"), *folder.rglob("*.partial")]
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
