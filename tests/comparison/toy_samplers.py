"""Small samplers and problems for the tests of the comparison, importable by its workers."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from probmotion import Motion, MotionDraws, MotionPosterior, Skeleton, UnsupportedPosterior, seeds
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import Samplable
from probmotion.problems.observations import observe


@dataclass(frozen=True)
class Holder:
    """A value, and a cache that does not count."""

    value: object
    cache: dict = field(init=False, default_factory=dict)


class Plain:
    """An object that is no dataclass."""

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
    return Problem("generation", "no evidence", MotionPosterior(small_prior()))


def monocular() -> Problem:
    prior = small_prior()
    truth = Motion(prior.sample(np.random.default_rng(1), 1)[0], prior.skeleton, 30.0)
    evidence = observe(truth, "monocular", 0.05, 0)
    return Problem("monocular", "one camera", MotionPosterior(prior, evidence), truth.positions)


@dataclass(frozen=True)
class PriorDraws:
    """Draws from the prior, stretched; takes no evidence. Notes every run in a file."""

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
            raise UnsupportedPosterior(self.name, "takes no evidence", "observations", ["exact"])
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
    """Notes how many posteriors this process has met."""

    name: ClassVar[str] = "counting"

    def sample(self, posterior, **settings):
        if all(posterior is not each for each in SEEN):
            SEEN.append(posterior)
        with open(self.diary, "a") as file:
            file.write(f"{len(SEEN)} ")
        return PriorDraws().sample(posterior, **settings)


@dataclass(frozen=True)
class Unwritable(PriorDraws):
    """Its draws hold what no file can."""

    name: ClassVar[str] = "unwritable"

    def sample(self, posterior, **settings):
        found = super().sample(posterior, **settings)
        found.dataset.attrs["odd"] = {"a": 1}
        return found


@dataclass(frozen=True)
class Crashing(PriorDraws):
    name: ClassVar[str] = "crashing"

    def sample(self, posterior, **settings):
        super().sample(posterior, **settings)
        raise RuntimeError("the floor gave\nway")


@dataclass(frozen=True)
class CrashingOnce(PriorDraws):
    """Fails until a file exists."""

    name: ClassVar[str] = "crashing-once"
    mended: str = ""

    def sample(self, posterior, **settings):
        if not Path(self.mended).exists():
            raise RuntimeError("not yet")
        return super().sample(posterior, **settings)


@dataclass(frozen=True)
class Dying(PriorDraws):
    """Takes its process with it."""

    name: ClassVar[str] = "dying"

    def sample(self, posterior, **settings):
        os._exit(9)


@dataclass(frozen=True)
class TooFew(PriorDraws):
    name: ClassVar[str] = "too-few"

    def sample(self, posterior, *, draws=1000, **settings):
        return super().sample(posterior, draws=draws - 1, **settings)


@dataclass(frozen=True)
class Interrupting(PriorDraws):
    """Ctrl-C arrives in the middle of its second cell."""

    name: ClassVar[str] = "interrupting"

    def sample(self, posterior, **settings):
        draws = super().sample(posterior, **settings)
        if len(Path(self.diary).read_text().split()) == 2:
            raise KeyboardInterrupt
        return draws


@dataclass(frozen=True)
class NotANumber(PriorDraws):
    """Hands over draws that were spoilt after they were checked."""

    name: ClassVar[str] = "not-a-number"

    def sample(self, posterior, **settings):
        found = super().sample(posterior, **settings)
        found.dataset["positions"].values[0, 0, 0, 0, 0] = np.nan
        return found


@dataclass(frozen=True)
class Unchecked(PriorDraws):
    """Leaves it to MotionDraws to find out that a draw is infinite."""

    name: ClassVar[str] = "unchecked"

    def sample(self, posterior, *, draws=1000, chains=1, **settings):
        x = np.full((chains, draws, posterior.frames, posterior.skeleton.n_joints, 3), np.inf)
        return MotionDraws.of(posterior, self, x, seed=0, seconds=0.0)


@dataclass(frozen=True)
class Diverged(PriorDraws):
    """Its draws are numbers, but of what measures make of them squares are not."""

    name: ClassVar[str] = "diverged"

    def sample(self, posterior, **settings):
        found = super().sample(posterior, **settings)
        found.dataset["positions"].values[0, 0] *= 1e200
        return found


@dataclass(frozen=True)
class Interrupted(PriorDraws):
    """Asks to be stopped where nobody pressed a key."""

    name: ClassVar[str] = "interrupted"

    def sample(self, posterior, **settings):
        raise KeyboardInterrupt("of its own")


@dataclass(frozen=True)
class Hungry(PriorDraws):
    name: ClassVar[str] = "hungry"

    def sample(self, posterior, **settings):
        raise MemoryError


@dataclass(frozen=True)
class Quitting(PriorDraws):
    name: ClassVar[str] = "quitting"

    def sample(self, posterior, **settings):
        raise SystemExit(3)


@dataclass(frozen=True)
class Endless(PriorDraws):
    """Never returns; calls itself compiled code where it does not even hear alarms."""

    name: ClassVar[str] = "endless"
    deaf: bool = False

    def sample(self, posterior, **settings):
        if self.deaf:
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
        while True:
            try:
                time.sleep(30)
            except Exception:  # as libraries do that wrap what they call
                continue


@dataclass(frozen=True)
class Walking(PriorDraws):
    """Its cost is a straight line in ``stride``, and nothing else comes of it."""

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
        found = super().sample(posterior, draws=draws, chains=chains, **settings)
        cost = chains * (50 + self.start + draws * self.stride)
        counts = {"evaluations_density": cost, "evaluations_gradient": chains * draws}
        return MotionDraws(
            found.dataset.drop_attrs(deep=False).assign_attrs(
                {**found.dataset.attrs, "evaluations_denoiser": 0, **counts}
            )
        )


@dataclass(frozen=True)
class Napping(PriorDraws):
    """Takes a hundredth of a second per unit of effort."""

    name: ClassVar[str] = "napping"
    effort: ClassVar[tuple[str, ...]] = ("rounds",)

    rounds: int = 4

    def sample(self, posterior, **settings):
        found = super().sample(posterior, **settings)
        time.sleep(0.01 * self.rounds)
        return MotionDraws(found.dataset.assign_attrs(seconds=0.01 * self.rounds))
