"""Log densities with evaluation counts, starting points of chains and continuation of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws, check_same_run
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasSeeds, Marginalises, NotConjugate
from probmotion.posteriors.sampling import Sampler, UnsupportedPosterior, batches, require
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["Density", "continued", "motions", "not_conjugate", "starting_points"]


class Density:
    """Log density of a posterior, with a counter of evaluations."""

    def __init__(self, sampler: Sampler, posterior: MotionPosterior) -> None:
        require(sampler, posterior)
        self.sampler = sampler
        self.posterior = posterior
        self.evaluations = 0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        """Return log p(θ) + log p(y | θ): ``(n, dim) → (n,)``; NaN and +∞ raise ``ValueError``."""
        return _check_density(self._counted(self.posterior.log_density, theta), theta)

    def evaluate(
        self, theta: np.ndarray, generators: Sequence[np.random.Generator] | None, guided: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the log density, (n,), and the guide of proposals at ``theta``.

        With ``generators``, one per point, the density is estimated from random views. The
        guide has shape (n, dim) if ``guided``, else (n, 0).
        """
        if generators is None and not guided:
            return self(theta), np.empty((len(theta), 0))
        self.evaluations += len(theta)
        value, closest = self.posterior.evaluate(theta, generators)
        guide = self.posterior.speeds(closest) if guided else np.empty((len(theta), 0))
        return _check_density(value, theta), guide

    def likelihood(self, theta: np.ndarray) -> np.ndarray:
        """Return log p(y | θ), ``(n, dim) → (n,)``; counted as n evaluations."""
        return self._counted(self.posterior.log_likelihood, theta)

    def _counted(
        self, function: Callable[[np.ndarray], np.ndarray], theta: np.ndarray
    ) -> np.ndarray:
        self.evaluations += len(theta)
        try:
            return np.asarray(function(theta))
        except NotConjugate as error:
            raise not_conjugate(self.sampler.name, error) from error

    def at_start(
        self,
        theta: np.ndarray,
        generators: Sequence[np.random.Generator] | None = None,
        guided: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return :meth:`evaluate` at starting points; raise ``ValueError`` if a density is 0."""
        value, guide = self.evaluate(theta, generators, guided)
        if not np.isfinite(value).all():
            bad = int(np.flatnonzero(~np.isfinite(value))[0])
            raise ValueError(
                f"initial must have a finite log density, got {value[bad]} at point {bad}"
            )
        return value, guide


def _check_density(value: np.ndarray, theta: np.ndarray) -> np.ndarray:
    # NaN compares as false, so one comparison detects NaN and +∞.
    if not value.max() < np.inf:
        bad = int(np.flatnonzero(~(value < np.inf))[0])
        raise ValueError(
            f"log_density must be finite or -inf, got {value[bad]} at theta {theta[bad]}"
        )
    return value


def not_conjugate(sampler: str, error: NotConjugate) -> UnsupportedPosterior:
    """Return the error for a marginal likelihood without a closed form."""
    return UnsupportedPosterior(
        sampler,
        f"cannot evaluate the log density: {error}; use a prior with coordinates='positions'",
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
    """Return ``initial``, or prior draws resampled in proportion to their likelihood.

    Every chain resamples ``candidates`` prior draws (sampling-importance-resampling, Rubin 1987).
    With enough candidates, starting points are approximate posterior draws: they cover the modes in
    proportion to their mass, and R-hat detects chains that do not mix. Chains of one walker cycle
    through the seed coordinates of the prior (``HasSeeds``), if any. ``shape`` is (chains, dim) or
    (chains, walkers, dim).
    """
    if initial is not None:
        assert not isinstance(initial, MotionDraws)
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
        draws = posterior.initial(rng, candidates)
        # Gumbel top-n: sample n without replacement, with probability ∝ likelihood.
        keys = log_likelihood(draws) + rng.gumbel(size=candidates)
        starts.append(draws[np.argsort(-keys, kind="stable")[:n]])
    return np.stack(starts).reshape(shape)


def continued(
    sampler: Sampler,
    log_density: Callable[[np.ndarray], np.ndarray],
    initial: object,
    chains: int,
    seed: int,
) -> Mapping[str, np.ndarray] | None:
    """Return the final state of the earlier run ``initial``; ``None`` if it is not a run.

    Raises
    ------
    ValueError
        If the sampler, settings, seed, number of chains or posterior differ from that run.
    """
    check_count("chains", chains)
    if not isinstance(initial, MotionDraws):
        return None
    check_same_run(sampler, initial, chains, seed)
    last = initial.dataset.isel(draw=-1)
    # If densities are estimated, the state contains deterministic densities for comparison.
    stored = initial.state.get("fixed", last["log_density"].values)
    recomputed = log_density(last["theta"].values)
    if not np.allclose(recomputed, stored, rtol=1e-6, atol=1e-6):
        raise ValueError(
            f"initial must be a run of the same posterior, got one with last log density "
            f"{stored[0]:.6g} instead of {recomputed[0]:.6g}"
        )
    return initial.state


def motions(posterior: MotionPosterior, theta: np.ndarray, seed: int, first: int) -> np.ndarray:
    """Return one motion per θ: ``(chains, draws, dim) → (chains, draws, L, J, 3)``, metres.

    ``first`` is the index of the first draw in its chain.
    """
    chains, draws, _ = theta.shape
    shape = (posterior.frames, posterior.skeleton.n_joints, 3)
    out = np.empty((chains, draws, *shape))
    streams = None  # creating generators can take as long as the motions
    for chain in range(chains):
        for numbers in batches(range(draws), 256):
            if isinstance(posterior.prior, Marginalises):
                streams = NormalStreams.of_draws(seed, [(chain, first + draw) for draw in numbers])
            batch = slice(numbers[0], numbers[-1] + 1)
            out[chain, batch] = posterior.complete(theta[chain, batch], streams)
    return out
