"""Programs killed or interrupted at any moment lose nothing, and end with the same results."""

from __future__ import annotations

import os
import random
import re
import signal
import time
from zlib import crc32

import numpy as np
import pytest
import torch
from victims import FAST, VICTIMS, Process

from probmotion.cli.main import main
from probmotion.data.synthetic.gaits import make_gait
from probmotion.files import written_whole
from probmotion.io.files import save
from probmotion.models.images.category import Category
from probmotion.models.images.surface_prior import SurfacePrior

PATIENCE = 300  # seconds; the machine may be busy
ALL = [
    name if name in FAST else pytest.param(name, marks=pytest.mark.slow, id=name)
    for name in VICTIMS
]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder of five clips, a prior, and a category without an encoder."""
    folder = tmp_path_factory.mktemp("data")
    for number in range(5):
        save(make_gait("walk", number, frames=60, fps=30.0), folder / f"walk{number}.npz")
    words = f"train dvae --size tiny --clips {folder}/walk*.npz --validation walk3 --test walk4"
    more = f"--batch 4 --steps 2 --out {folder / 'dvae'}"
    assert main([*words.split(), *more.split()]) == 0
    Category.load("quadruped").save(folder / "animal.npz")
    return folder


@pytest.fixture(scope="module")
def undisturbed(data, tmp_path_factory):
    """Return a function with the results and the seconds of an undisturbed program."""
    known = {}

    def run(name):
        if name not in known:
            folder = tmp_path_factory.mktemp("undisturbed") / "out"
            process, start = Process(name, folder, data), time.monotonic()
            assert process.wait(PATIENCE) == 0, process.printed()
            known[name] = VICTIMS[name].results(folder), time.monotonic() - start
        return known[name]

    return run


def left(folder):
    """Return the remains of killed processes."""
    return [*folder.rglob("*unfinished*"), *folder.rglob("*.partial")]


def disturb(name, data, folder, undisturbed, account, fault, moments, stop):
    """Stop a program at random moments until it has finished; repeat for all ``moments``."""
    victim, (expected, seconds) = VICTIMS[name], undisturbed(name)
    rng, out, number, before = random.Random(crc32(name.encode())), folder / "0", 0, {}
    while True:
        process = Process(name, out, data)
        moment = rng.uniform(0, seconds) if number < moments else PATIENCE
        if (status := process.wait(moment)) is None:
            assert number < moments, "the program hangs"
            with account(fault, name):
                number += 1
                stop(process)
                after = victim.finished(out)
                lost = {item for item in before if after.get(item, 0) < before[item]}
                assert not lost
                before = after
            continue
        with account(f"resumed after {fault}", name):
            assert status == 0, process.printed()
            assert left(out) == []
            results = victim.results(out)
            assert results.keys() == expected.keys()
            assert [key for key in results if results[key] != expected[key]] == []
        if number >= moments:
            return
        out, before = folder / f"{number}", {}


def kill(process):
    process.send(signal.SIGKILL)
    # 0 if it had just finished.
    assert process.wait(PATIENCE) in (0, -signal.SIGKILL), process.printed()


def interrupt(process):
    process.send(signal.SIGINT)
    status, printed = process.wait(PATIENCE), process.printed()
    assert status in (0, 130), printed
    # Python prints a Ctrl-C in a callback of an import or of a garbage collection, and goes on.
    assert "Traceback" not in re.sub(
        r"(?m)^Exception ignored in[^\0]*?^KeyboardInterrupt:.*$", "", printed
    )
    if status == 130:
        assert printed.splitlines()[-1].startswith("probmotion: ")


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="the processes are forked")


@needs_fork
@pytest.mark.parametrize("name", ALL)
def test_nothing_is_lost_by_kills(name, data, tmp_path, undisturbed, account, moments):
    disturb(name, data, tmp_path, undisturbed, account, "SIGKILL", moments, kill)


@needs_fork
@pytest.mark.parametrize("name", ALL)
def test_nothing_is_lost_by_ctrl_c(name, data, tmp_path, undisturbed, account, moments):
    half = max(1, moments // 2)
    disturb(name, data, tmp_path, undisturbed, account, "SIGINT", half, interrupt)


@needs_fork
@pytest.mark.parametrize("name", FAST)
def test_partial_files_of_killed_processes_are_removed(name, data, tmp_path, account):
    """Also those of a process that was killed before anything was finished."""
    out = tmp_path / "out"
    (out / "draws.zarr").mkdir(parents=True)
    with written_whole(out / "last.nc") as mine:
        mine.touch()
        dead = mine.with_name(mine.name.replace(f".{os.getpid()}.", f".{2**30}."))
    (out / "last.nc").unlink()
    for path in (dead, out / ".lock", out / "draws.zarr" / "a.partial"):
        path.write_text("half")
    with account("partial files", name):
        process = Process(name, out, data)
        assert process.wait(PATIENCE) == 0, process.printed()
        assert not dead.exists()


def test_ctrl_c_while_images_are_rendered(account):
    """Numba raises SystemError from functions that return several arrays."""
    prior = SurfacePrior(Category.load("quadruped"), np.array([0.15]))
    theta, rng = torch.zeros(1, prior.dim), random.Random(0)
    prior.render(theta, 64)

    def render():
        signal.setitimer(signal.ITIMER_REAL, rng.uniform(0.01, 0.05))
        while True:
            prior.render(theta, 64)

    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        for _ in range(20):
            with account("SIGINT", "rendering"), pytest.raises(KeyboardInterrupt):
                render()
    finally:
        signal.signal(signal.SIGALRM, before)
