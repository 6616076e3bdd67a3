"""Small samplers, problems and helpers for the tests of comparison, importable by workers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd

from probmotion import Motion, MotionDraws, MotionPosterior, Skeleton, UnsupportedPosterior, seeds
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import Samplable
from probmotion.problems.observations import observe

SMALL = {"draws": 20, "chains": 2, "workers": 0, "progress": False}


def numbers(table) -> str:
    """Return all values of a table that do not depend on the machine."""
    table = pd.DataFrame(table)
    return table[~table["metric"].isin(["seconds", "peak_memory_mib"])].to_csv(index=False)


def count(diary: Path) -> int:
    """Return how many runs a diary records."""
    return len(diary.read_text().split()) if diary.exists() else 0


def start(*words, cwd=None) -> subprocess.Popen:
    """Start Python with these samplers importable."""
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    command, environment = [sys.executable, *map(str, words)], os.environ | {"PYTHONPATH": paths}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=environment, text=True, cwd=cwd, **pipes)


def finish(process: subprocess.Popen, returncode: int = 0) -> tuple[str, str]:
    """Return what a process printed, after checking its return code."""
    output, errors = process.communicate(timeout=300)
    assert process.returncode == returncode, errors
    return output, errors


@dataclass(frozen=True)
class Holder:
    """Value with a cache that does not count."""

    value: object
    cache: dict = field(init=False, default_factory=dict)


class Plain:
    """Object that is no dataclass."""

    def __init__(self, value):
        self.value = value


def small_prior() -> GaussianMixtureMotion:
    rng = np.random.default_rng(0)
    return GaussianMixtureMotion(
        skeleton=Skeleton(["root", "a", "b"], [-1, 0, 1]),
        fps=30.0,
        means=rng.normal(size=(2, 4, 3, 3)),
        factors=0.4 * rng.normal(size=(2, 2, 4, 3, 3)),
        weights=np.array([0.6, 0.4]),
        noise=0.1,
        azimuths=5,
        styles=("calm", "wild"),
    )


def generation() -> Problem:
    return Problem("generation", "no observations", MotionPosterior(small_prior()))


def monocular() -> Problem:
    prior = small_prior()
    truth = Motion(prior.sample(np.random.default_rng(1), 1)[0], prior.skeleton, 30.0)
    likelihood = observe(truth, "monocular", 0.05, 0)
    return Problem("monocular", "one camera", MotionPosterior(prior, likelihood), truth.positions)


@dataclass(frozen=True)
class PriorDraws:
    """Stretched draws from the prior, without observations; records every run in a diary."""

    name: ClassVar[str] = "prior-draws"
    requires: ClassVar[tuple[type, ...]] = (Samplable,)

    spread: float = 1.0
    nap: float = 0.0
    diary: str = ""

    def sample(self, posterior, *, draws=1000, chains=1, seed=0, initial=None, progress=True):
        start = time.perf_counter()
        if self.diary:
            with open(self.diary, "a") as file:
                file.write(f"{seed}\n")
        if posterior.likelihood is not None:
            reason = "takes no observations"
            raise UnsupportedPosterior(self.name, reason, "observations", ["exact"])
        time.sleep(self.nap)
        rng = seeds.generator(seed, "toy")
        x = self.spread * posterior.prior.sample(rng, draws * chains)
        # A product whose last bits depend on the number of threads.
        x = x + 1e-12 * float(np.tile(x.ravel(), 50) @ np.tile(x.ravel(), 50))
        return MotionDraws.of(
            posterior,
            self,
            x.reshape(chains, draws, *x.shape[1:]),
            seed=seed,
            seconds=time.perf_counter() - start,
            counts={"denoiser": 5 * draws * chains},
            independent=True,
        )


SEEN = []


@dataclass(frozen=True)
class Counting(PriorDraws):
    """Records how many posteriors this process has seen."""

    name: ClassVar[str] = "counting"

    def sample(self, posterior, **settings):
        if all(posterior is not each for each in SEEN):
            SEEN.append(posterior)
        with open(self.diary, "a") as file:
            file.write(f"{len(SEEN)} ")
        return PriorDraws().sample(posterior, **settings)


ERRORS = {
    "raise": RuntimeError("singular\nmatrix"),
    "exit": SystemExit(3),
    "memory": MemoryError(),
    "KeyboardInterrupt": KeyboardInterrupt("of its own"),
}


@dataclass(frozen=True)
class Failing(PriorDraws):
    """Fails in the given way."""

    name: ClassVar[str] = "failing"
    how: str = "raise"
    file: str = ""

    def sample(self, posterior, **settings):
        if self.how in ERRORS:
            raise ERRORS[self.how]
        match self.how:
            case "until the file exists":
                if not Path(self.file).exists():
                    raise RuntimeError("not yet")
            case "die":
                os._exit(9)
            case "hang" | "hang without signals":
                if self.how != "hang":  # as compiled code
                    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
                while True:
                    try:
                        time.sleep(30)
                    except Exception:  # as libraries that wrap errors of callbacks
                        continue
            case "too few":
                settings["draws"] -= 1
            case "one chain":
                settings |= {"draws": settings["draws"] * settings["chains"], "chains": 1}
            case "infinite":
                x = np.full((2, 10, posterior.frames, posterior.skeleton.n_joints, 3), np.inf)
                return MotionDraws.of(posterior, self, x, seed=0, seconds=0.0)
            case "other skeleton":
                skeleton = Skeleton(["x", "y", "z"], posterior.skeleton.parents)
                posterior = MotionPosterior(replace(posterior.prior, skeleton=skeleton))
        draws = super().sample(posterior, **settings)
        positions = draws.dataset["positions"].values
        match self.how:
            case "interrupt the second run":
                if count(Path(self.diary)) == 2:
                    raise KeyboardInterrupt
            case "unwritable":
                draws.dataset.attrs["odd"] = {"a": 1}
            case "nan":
                positions[0, 0, 0, 0, 0] = np.nan
            case "diverged":
                positions[0, 0] *= 1e200
            case "none":
                return None
            case "no time":
                return replace(draws, dataset=draws.dataset.assign_attrs(seconds=np.nan))
        return draws


@dataclass(frozen=True)
class Walking(PriorDraws):
    """Its reported cost is linear in ``stride``, which has no other effect."""

    name: ClassVar[str] = "walking"
    effort: ClassVar[tuple[str, ...]] = ("stride", "start")
    least_effort: ClassVar[int] = 2

    stride: int = 10
    start: int = 100
    most: int = 10**9

    def __post_init__(self):
        if self.stride > self.most:
            raise ValueError(f"stride must be at most {self.most}, got {self.stride}")

    def sample(self, posterior, *, draws=1000, chains=1, **settings):
        dataset = super().sample(posterior, draws=draws, chains=chains, **settings).dataset
        cost = chains * (50 + self.start + draws * self.stride)
        counts = {"evaluations_density": cost, "evaluations_gradient": chains * draws}
        return MotionDraws(dataset.assign_attrs({"evaluations_denoiser": 0, **counts}))


@dataclass(frozen=True)
class Napping(PriorDraws):
    """Reports a hundredth of a second per unit of effort."""

    name: ClassVar[str] = "napping"
    effort: ClassVar[tuple[str, ...]] = ("rounds",)

    rounds: int = 4

    def sample(self, posterior, **settings):
        dataset = super().sample(posterior, **settings).dataset
        return MotionDraws(dataset.assign_attrs(seconds=0.01 * self.rounds))
