"""What samplers that walk on a log density share: the density, where to start, motions at the end.

A chain's own random numbers are addressed by its number, a motion's by (chain, draw), so that
chain k is the same however many chains run and a continued run goes on as if it had not stopped.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws, settings_of
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasSeeds, NotConjugate
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior, batches, require
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_finite, check_shape

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
        return _below_infinity(self._counted(self.posterior.log_density, theta), theta)

    def evaluate(
        self, theta: np.ndarray, generators: Sequence[np.random.Generator] | None, guided: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log density and the guide of proposals there (:mod:`proposals`).

        Parameters
        ----------
        theta : ndarray, (n, dim)
            Where.
        generators : sequence of numpy.random.Generator, optional
            One per point; the density is then an estimate from views that each draws anew.
        guided : bool
            Whether the guide is wanted; else it has no width.
        """
        if generators is None and not guided:
            return self(theta), np.empty((len(theta), 0))
        self.evaluations += len(theta)
        value, closest = self.posterior.evaluate(theta, generators)
        guide = self.posterior.speeds(closest) if guided else np.empty((len(theta), 0))
        return _below_infinity(value, theta), guide

    def likelihood(self, theta: np.ndarray) -> np.ndarray:
        """Return log p(y | θ), ``(n, dim) → (n,)``; an evaluation like any other."""
        return self._counted(self.posterior.log_likelihood, theta)

    def _counted(
        self, function: Callable[[np.ndarray], np.ndarray], theta: np.ndarray
    ) -> np.ndarray:
        self.evaluations += len(theta)
        try:
            return np.asarray(function(theta))
        except NotConjugate as error:
            raise not_conjugate(self.sampler, error) from error

    def at_start(
        self,
        theta: np.ndarray,
        generators: Sequence[np.random.Generator] | None = None,
        guided: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return density and guide where chains start; a start of density 0 is an error."""
        value, guide = self.evaluate(theta, generators, guided)
        if not np.isfinite(value).all():
            bad = int(np.flatnonzero(~np.isfinite(value))[0])
            raise ValueError(
                f"initial has log density {value[bad]} at point {bad}, expected starting points "
                "of density above 0"
            )
        return value, guide


def _below_infinity(value: np.ndarray, theta: np.ndarray) -> np.ndarray:
    # NaN compares as false: one look finds both.
    if not value.max() < np.inf:
        bad = int(np.flatnonzero(~(value < np.inf))[0])
        raise ValueError(
            f"log_density is {value[bad]} at theta {theta[bad]}, expected a finite number or -inf"
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
    log_likelihood: Callable[[np.ndarray], np.ndarray],
    initial: MotionDraws | np.ndarray | None,
    shape: tuple[int, ...],
    seed: int,
    candidates: int,
) -> np.ndarray:
    """Return where chains start, unless told: draws from the prior, chosen by their likelihood.

    A posterior after much evidence has modes that a chain cannot leave. Each chain chooses among
    ``candidates`` draws of its own from the prior, in proportion to their likelihood
    (sampling-importance-resampling, Rubin 1987): nearly a draw from the posterior where enough
    candidates have a share, so that starts are spread over the modes as the mass is, and R-hat
    still sees a chain that stays where it began. Without evidence it is a draw from the prior. Of a
    prior with seeds each chain starts at one of them in turn.

    Parameters
    ----------
    posterior : MotionPosterior
        What is drawn from.
    log_likelihood : callable
        log p(y | θ), ``(n, dim) → (n,)``; not called where there is no evidence.
    initial : ndarray, optional
        The starting points themselves.
    shape : tuple of int
        (chains, dim), or (chains, walkers, dim).
    seed : int
        The run's seed.
    candidates : int
        Draws from the prior per chain; with no more than it needs, it starts at them.
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
        rng = seeds.generator(seed, "initial", chain)
        if isinstance(posterior.prior, HasSeeds) and n == 1:
            seeded = posterior.prior.seed_coordinates()
            starts.append(seeded[[chain % len(seeded)]])
            continue
        if posterior.likelihood is None or candidates <= n:
            starts.append(posterior.initial(rng, n))
            continue
        drawn = posterior.initial(rng, candidates)
        # The n largest of log w + Gumbel noise are n choices without replacement, ∝ w.
        keys = log_likelihood(drawn) + rng.gumbel(size=candidates)
        starts.append(drawn[np.argsort(-keys, kind="stable")[:n]])
    return np.stack(starts).reshape(shape)


def continued(
    sampler: Sampler,
    log_density: Callable[[np.ndarray], np.ndarray],
    initial: object,
    chains: int,
    seed: int,
) -> Mapping[str, np.ndarray] | None:
    """Return the state that ``initial`` stopped in, or ``None`` where it is no finished run.

    Raises
    ------
    ValueError
        If the run was of another sampler, settings, seed, number of chains or posterior: it would
        not go on as if it had not stopped.
    """
    check_count("chains", chains)
    if not isinstance(initial, MotionDraws):
        return None
    attributes = initial.dataset.attrs
    settings = settings_of(sampler)
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
    last = initial.dataset.isel(draw=-1)
    # Of a run whose densities are estimates the state holds what they are to be compared with.
    stored = initial.state.get("fixed", last["log_density"].values)
    found = log_density(last["theta"].values)
    if not np.allclose(found, stored, rtol=1e-6, atol=1e-6):
        raise ValueError(
            f"initial is a run of another posterior: its last log density is {stored[0]:.6g}, and "
            f"this posterior's there is {found[0]:.6g}"
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
