"""What samplers that walk on a log density share: the density, where to start, motions at the end.

A chain's own random numbers are addressed by its number, a motion's by (chain, draw), so that
chain k is the same however many chains run and a continued run goes on as if it had not stopped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict

import numpy as np

from probmotion import seeds
from probmotion.checks import check_count, check_finite, check_shape
from probmotion.draws import MotionDraws
from probmotion.posterior import MotionPosterior
from probmotion.priors import NotConjugate
from probmotion.sampling import Sampler, UnsupportedPosterior, batches, require
from probmotion.seeds import NormalStreams

__all__ = ["Density", "continued", "motions", "not_conjugate", "starting_points"]


class Density:
    """The log density of one run's posterior, with its evaluations counted.

    Parameters
    ----------
    sampler : Sampler
        Who asks, for messages.
    posterior : MotionPosterior
        Whose density.

    Raises
    ------
    UnsupportedPosterior
        If the prior lacks what the sampler requires.
    """

    def __init__(self, sampler: Sampler, posterior: MotionPosterior) -> None:
        require(sampler, posterior)
        self.sampler = sampler
        self.posterior = posterior
        self.evaluations = 0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        """Return log p(θ) + log p(y | θ): ``(n, dim) → (n,)``.

        Raises
        ------
        UnsupportedPosterior
            If the posterior has no density in these coordinates.
        ValueError
            If a value is NaN or +∞.
        """
        self.evaluations += len(theta)
        try:
            value = np.asarray(self.posterior.log_density(theta))
        except NotConjugate as error:
            raise not_conjugate(self.sampler, error) from error
        # NaN compares as false: one look finds both.
        if not value.max() < np.inf:
            bad = int(np.flatnonzero(~(value < np.inf))[0])
            raise ValueError(
                f"log_density is {value[bad]} at theta {theta[bad]}, expected a finite number or "
                "-inf"
            )
        return value

    def at_start(self, theta: np.ndarray) -> np.ndarray:
        """Return the log density where chains start; a start of density 0 is an error."""
        value = self(theta)
        if not np.isfinite(value).all():
            bad = int(np.flatnonzero(~np.isfinite(value))[0])
            raise ValueError(
                f"initial has log density {value[bad]} at point {bad}, expected starting points "
                "of density above 0"
            )
        return value


def not_conjugate(sampler: Sampler, error: NotConjugate) -> UnsupportedPosterior:
    """Return the error of a density that has no closed form where the prior marginalises."""
    return UnsupportedPosterior(
        sampler.name,
        f"has no density to walk on: {error}; a prior with coordinates='positions' has one",
        word="not-conjugate",
    )


def starting_points(
    posterior: MotionPosterior,
    log_density: Callable[[np.ndarray], np.ndarray],
    initial: MotionDraws | np.ndarray | None,
    shape: tuple[int, ...],
    seed: int,
    candidates: int,
) -> np.ndarray:
    """Return where chains start: the likeliest of some draws from the prior, unless told.

    A posterior after much evidence has modes that a chain cannot leave; each chain looks at
    ``candidates`` draws of its own, so that it seldom begins in a mode that holds no mass.

    Parameters
    ----------
    posterior : MotionPosterior
        What is drawn from.
    log_density : callable
        Its log density, ``(n, dim) → (n,)``.
    initial : ndarray, optional
        The starting points themselves.
    shape : tuple of int
        (chains, dim), or (chains, walkers, dim).
    seed : int
        The run's seed.
    candidates : int
        Draws from the prior per chain, of which it starts at the likeliest (an ensemble: at as
        many of the likeliest as it has walkers); with no more than it needs, it starts at them.
    """
    if initial is not None:
        assert not isinstance(initial, MotionDraws), "a run to go on from has a state"
        points = np.array(initial, dtype=np.float64)
        check_shape("initial", points, shape)
        check_finite("initial", points)
        return points
    chains, *walkers, _ = shape
    n = walkers[0] if walkers else 1
    starts = []
    for chain in range(chains):
        drawn = posterior.initial(seeds.generator(seed, "initial", chain), max(candidates, n))
        if len(drawn) > n:
            likeliest = np.argsort(-log_density(drawn), kind="stable")
            drawn = drawn[likeliest[:n]]
        starts.append(drawn)
    return np.stack(starts).reshape(shape)


def continued(
    sampler: Sampler, initial: object, chains: int, seed: int
) -> Mapping[str, np.ndarray] | None:
    """Return the state that ``initial`` stopped in, or ``None`` where it is no finished run.

    Raises
    ------
    ValueError
        If the run was of another sampler, settings, seed or number of chains: it would not go on
        as if it had not stopped.
    """
    check_count("chains", chains)
    if not isinstance(initial, MotionDraws):
        return None
    attributes = initial.dataset.attrs
    settings = json.loads(json.dumps(asdict(sampler), default=repr))  # type: ignore[call-overload]
    for name, came, expected in (
        ("sampler", sampler.name, attributes["sampler"]),
        ("settings", settings, json.loads(attributes["settings"])),
        ("seed", seed, int(attributes["seed"])),
        ("chains", chains, initial.dataset.sizes["chain"]),
    ):
        if came != expected:
            raise ValueError(
                f"initial is a run with {name} {expected}, and {name} is {came}: a run goes on as "
                "it began; to start afresh where it stopped, pass an array of points"
            )
    return initial.state


def motions(posterior: MotionPosterior, theta: np.ndarray, seed: int, first: int) -> np.ndarray:
    """Return one motion per θ: ``(chains, draws, dim) → (chains, draws, L, J, 3)``, metres.

    ``first`` is the number of the first draw in its chain.
    """
    chains, draws, _ = theta.shape
    shape = (posterior.frames, posterior.skeleton.n_joints, 3)
    out = np.empty((chains, draws, *shape))
    for chain in range(chains):
        for numbers in batches(range(draws), _BATCH):
            streams = NormalStreams.of_draws(seed, [(chain, first + draw) for draw in numbers])
            some = slice(numbers[0], numbers[-1] + 1)
            out[chain, some] = posterior.complete(streams, theta[chain, some])
    return out


_BATCH = 256
