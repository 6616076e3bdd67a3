"""Programs that are killed or interrupted at any moment, run in forked processes.

A process is forked from a server that has imported the libraries, so that its time is spent on the
work.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import forkserver
from pathlib import Path
from unittest.mock import patch

import pandas as pd
import torch
from toy_samplers import numbers

import probmotion as pm
from probmotion.cli.main import main
from probmotion.comparison.results.run_results import read_draws, read_result
from probmotion.models.images.category import Category
from probmotion.models.training.checkpoints import _kind, load_checkpoint
from probmotion.posteriors import streams
from probmotion.reconstruction import learning, refinement

# Imported when they are used, which takes longer than the work of a victim.
for module in (
    "arviz_stats", "matplotlib.figure", "numba", "PIL.PngImagePlugin", "scipy.stats", "zarr",
    "probmotion.samplers.mcmc.metropolis",
    "torch._dynamo", "probmotion.cli.train", "probmotion.metrics.measures",
    "probmotion.data.projections", "probmotion.models.diffusion.training",
    "probmotion.models.images.encoder_training", "probmotion.models.images.made_images",
    "probmotion.models.vae.training", "probmotion.models.dvae.denoiser_training",
):  # fmt: skip
    importlib.import_module(module)

learn_surface = learning.learn_surface
PARTS = ["--validation", "walk3", "--test", "walk4"]


@dataclass(frozen=True)
class Victim:
    """Program that writes to a folder.

    ``run(folder, data)`` returns an exit status, ``finished(folder)`` the numbers of finished items
    by name, after reading all files, and ``results(folder)`` what must not depend on the kills.
    """

    run: Callable[[Path, Path], int]
    finished: Callable[[Path], dict[str, int]]
    results: Callable[[Path], dict[str, object]]


def grid(workers):
    words = (
        "--samplers exact mh --settings.mh.warmup 20 --settings.mh.thin 2 "
        f"--draws 40 --seeds 2 --workers {workers}"
    )

    def run(folder, data):
        return main(["compare", "gait(frames=8)", *words.split(), "--out", str(folder)])

    return Victim(run, finished_runs, table)


def finished_runs(folder):
    items = {}
    for run in folder.glob("runs/*/*/[0-9]"):
        assert read_result(run).failure is None
        assert read_draws(run).positions.size
        # A run that is written again has another inode.
        items[f"{run} {run.stat().st_ino}"] = 1
    return items


def table(folder):
    return {"table": numbers(pd.read_csv(folder / "table.csv"))}


def stream(folder, data):
    streams._BLOCK_BYTES = 80_000
    posterior = pm.problem("gait-monocular", frames=6).posterior
    sampler = pm.samplers.MetropolisHastings(warmup=20, thin=1)
    pm.sample(posterior, sampler, draws=300, chains=2, seed=3, stream=folder, progress=False)
    return 0


def streamed(folder):
    if not (folder / "last.nc").exists():
        return {}
    draws = pm.open_draws(folder)
    assert draws.flat().any(axis=(1, 2, 3)).all()
    return {"draws": draws.positions.sizes["draw"]}


def stream_results(folder):
    draws = pm.open_draws(folder)
    return {name: draws.dataset[name].values.tobytes() for name in ("positions", "theta")}


def training(kind, steps, *options):
    def run(folder, data):
        words = ["train", kind, "--clips", str(data / "walk*.npz"), "--size", "tiny", *PARTS]
        more = [word.replace("DATA", str(data)) for word in options]
        often = ["--steps", str(steps), "--checkpoint-every", "2"]
        return main([*words, *more, *often, "--out", str(folder)])

    return Victim(run, taken_steps, weights)


def taken_steps(folder):
    steps = {}
    for path in folder.rglob("[!.]*.safetensors"):
        stored = load_checkpoint(path, _kind(path))
        if path.stem == "state":
            steps[str(path)] = int(stored.settings["step"])
    return steps


def weights(folder):
    stored = {}
    for path in folder.rglob("[!.]*.safetensors"):
        checkpoint, name = load_checkpoint(path, _kind(path)), path.relative_to(folder)
        for row in checkpoint.settings["history"]:
            row.pop("seconds")
            stored[f"{name} history {row['step']}"] = row
        for key, tensor in checkpoint.tensors.items():
            stored[f"{name} {key}"] = tensor.numpy().tobytes()
    return stored


def images(folder, data):
    """Train the first encoder, two rounds of few steps, and the encoder of the new category."""
    refinement._STAGES = ((32, 4.0, 1),)
    learning.learn_surface = partial(learn_surface, steps=2)
    words = "--images 2 --steps 6 --batch 2 --checkpoint-every 2"
    start = str(data / "animal.npz")
    return main(["train", "images", "--category", start, *words.split(), "--out", str(folder)])


def rounds(folder):
    return taken_steps(folder) | {"rounds": learning.rounds_done(folder)}


def category_and_weights(folder):
    category = Category.load(folder / learning.CATEGORY)
    return weights(folder) | {"category": category.digest, "rounds": category.card["rounds"]}


TRACKS = ("--views", "2")
VICTIMS = {
    "grid": grid(workers=0),
    "grid of two workers": grid(workers=2),
    "streamed chain": Victim(stream, streamed, stream_results),
    "train diffusion": training("diffusion", 16, *TRACKS),
    "train evaluator": training("evaluator", 16, *TRACKS),
    "train lifter": training("lifter", 12, *TRACKS),
    "train motion-vae": training("motion-vae", 12, *TRACKS),
    "train dvae": training("dvae", 16, "--batch", "4"),
    "train denoiser": training("denoiser", 16, "--batch", "4", "--prior", "DATA/dvae"),
    "train images": Victim(images, rounds, category_and_weights),
}
FAST = ("streamed chain", "train diffusion")


class Process:
    """Process that runs a victim; it begins when it has imported the libraries."""

    def __init__(self, victim, folder, data, log=None):
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        # Until Python 3.12, the server does not look for modules in sys.path of this process.
        with patch.dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, sys.path))):
            forkserver.ensure_running()
        here, there = context.Pipe()
        self.log = log or folder.with_suffix(".log")
        self.process = context.Process(target=_run, args=(victim, folder, data, self.log, there))
        self.process.start()
        there.close()
        assert here.recv() == "ready"

    def wait(self, seconds=None):
        """Return the exit status; None if the process is running after so many seconds."""
        self.process.join(seconds)
        return self.process.exitcode

    def send(self, number):
        """Send a signal to the process and its workers, as a terminal does."""
        with suppress(ProcessLookupError):  # it has just finished
            os.killpg(self.process.pid, number)

    def printed(self):
        return self.log.read_text()


def _run(victim, folder, data, log, ready):
    os.setsid()
    with open(log, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    torch.set_num_threads(1)
    assert threading.active_count() == 1
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        ready.send("ready")
        status = VICTIMS[victim].run(folder, data)
    except KeyboardInterrupt as stop:  # of a program without a command
        print(f"probmotion: {stop}", file=sys.stderr)
        status = 130
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)
