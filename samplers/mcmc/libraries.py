"""Adapters for the samplers of BlackJAX, NumPyro, emcee and flowMC."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from probmotion.samplers.mcmc.function import SamplingFunction, TargetDensity

__all__ = ["blackjax_kernel", "emcee_sampler", "flowmc_sampler", "numpyro_kernel"]


def blackjax_kernel(
    algorithm: Callable[[Callable[[Any], Any]], Any], *, warmup: int = 500
) -> SamplingFunction:
    """Return a sampling function around a BlackJAX algorithm.

    Parameters
    ----------
    algorithm : callable
        Builds the algorithm, with ``init`` and ``step``, from the log density; for instance
        ``lambda f: blackjax.nuts(f, 0.05, np.ones(dim))``.
    warmup : int
        Steps before the first draw. Nothing is adapted.

    Examples
    --------
    >>> import blackjax
    >>> import probmotion as pm
    >>> walk = blackjax_kernel(lambda f: blackjax.rmh(f, blackjax.mcmc.random_walk.normal(0.1)))
    >>> draws = pm.sample("gait-monocular(frames=4)", walk, draws=40, chains=1, progress=False)
    >>> draws.positions.shape
    (1, 40, 4, 17, 3)
    """

    def blackjax(
        log_density: TargetDensity, dim: int, rng: np.random.Generator, draws: int
    ) -> np.ndarray:
        from probmotion.extras import jax

        with jax.enable_x64(True):
            kernel = algorithm(log_density)
            state = kernel.init(jax.numpy.asarray(log_density.initial(rng, 1)[0]))

            def step(state: Any, key: Any) -> tuple[Any, Any]:
                state, _ = kernel.step(key, state)
                return state, state.position

            keys = jax.random.split(jax.random.key(_integer(rng)), warmup + draws)
            return np.asarray(jax.lax.scan(step, state, keys)[1])[warmup:]

    return blackjax


def numpyro_kernel(
    kernel: Callable[[Callable[[Any], Any]], Any], *, warmup: int = 500
) -> SamplingFunction:
    """Return a sampling function around an MCMC kernel of NumPyro.

    Parameters
    ----------
    kernel : callable
        Builds the kernel from the potential, minus the log density; for instance
        ``lambda potential: numpyro.infer.NUTS(potential_fn=potential)``.
    warmup : int
        Adaptation steps before the first draw.

    Examples
    --------
    >>> import numpyro
    >>> import probmotion as pm
    >>> kernel = numpyro_kernel(lambda potential: numpyro.infer.SA(potential_fn=potential))
    >>> draws = pm.sample("gait-monocular(frames=4)", kernel, draws=40, chains=1, progress=False)
    >>> draws.positions.shape
    (1, 40, 4, 17, 3)
    """

    def numpyro(
        log_density: TargetDensity, dim: int, rng: np.random.Generator, draws: int
    ) -> np.ndarray:
        from probmotion.extras import jax, numpyro

        with jax.enable_x64(True):
            chain = numpyro.infer.MCMC(
                kernel(lambda theta: -log_density(theta)),
                num_warmup=warmup,
                num_samples=draws,
                progress_bar=False,
            )
            start = jax.numpy.asarray(log_density.initial(rng, 1)[0])
            chain.run(jax.random.key(_integer(rng)), init_params=start)
            return np.asarray(chain.get_samples())

    return numpyro


def emcee_sampler(
    moves: Any = None, *, walkers: int | None = None, warmup: int = 500
) -> SamplingFunction:
    """Return a sampling function around emcee's ensemble sampler.

    Parameters
    ----------
    moves : optional
        Moves of emcee; by default its stretch move.
    walkers : int, optional
        Number of walkers; by default twice the dimension plus two.
    warmup : int
        Steps before the first draw.

    Examples
    --------
    >>> import emcee
    >>> import probmotion as pm
    >>> sampler = emcee_sampler(emcee.moves.DEMove(), walkers=40, warmup=20)
    >>> draws = pm.sample("gait-monocular(frames=4)", sampler, draws=40, chains=1, progress=False)
    >>> draws.positions.shape
    (1, 40, 4, 17, 3)
    """

    def emcee(
        log_density: TargetDensity, dim: int, rng: np.random.Generator, draws: int
    ) -> np.ndarray:
        from emcee import EnsembleSampler

        n = walkers or 2 * dim + 2
        sampler = EnsembleSampler(n, dim, log_density, moves=moves, vectorize=True)
        sampler.random_state = np.random.RandomState(_integer(rng)).get_state()
        steps = -(-draws // n)
        sampler.run_mcmc(log_density.initial(rng, n), warmup + steps)
        return _walker_by_walker(sampler.get_chain(discard=warmup).swapaxes(0, 1), draws)

    return emcee


def flowmc_sampler(bundle: Any, *, walkers: int = 20, **settings: Any) -> SamplingFunction:
    """Return a sampling function around flowMC, whose proposals are a learnt normalising flow.

    Parameters
    ----------
    bundle : type
        Bundle of flowMC, for instance ``RQSpline_MALA_Bundle``.
    walkers : int
        Number of walkers.
    **settings
        Settings of the bundle: at least ``n_local_steps``, ``n_global_steps``,
        ``n_training_loops`` and ``n_epochs``.

    Examples
    --------
    >>> from flowMC.resource_strategy_bundle.RQSpline_MALA import RQSpline_MALA_Bundle
    >>> import probmotion as pm
    >>> sampler = flowmc_sampler(
    ...     RQSpline_MALA_Bundle, n_local_steps=5, n_global_steps=5, n_training_loops=2, n_epochs=2
    ... )
    >>> draws = pm.sample("gait-monocular(frames=4)", sampler, draws=40, chains=1, progress=False)
    >>> draws.positions.shape
    (1, 40, 4, 17, 3)
    """

    def flowmc(
        log_density: TargetDensity, dim: int, rng: np.random.Generator, draws: int
    ) -> np.ndarray:
        from flowMC.Sampler import Sampler

        from probmotion.extras import jax

        def target(theta: Any, data: Any) -> Any:
            return log_density(theta)

        steps = settings["n_local_steps"] + settings["n_global_steps"]
        loops = -(-draws // (walkers * steps))
        with jax.enable_x64(True):
            keys = jax.random.split(jax.random.key(_integer(rng)))
            built = bundle(keys[0], walkers, dim, target, n_production_loops=loops, **settings)
            sampler = Sampler(
                n_dim=dim,
                n_chains=walkers,
                rng_key=keys[1],
                resource_strategy_bundles=built,
                checkpoint_interval=0,
            )
            sampler.sample(jax.numpy.asarray(log_density.initial(rng, walkers)), {})
            chains = np.asarray(sampler.resources["positions_production"].data)
            return _walker_by_walker(chains, draws)

    return flowmc


def _walker_by_walker(chains: np.ndarray, draws: int) -> np.ndarray:
    """Return draws of walkers (walkers, steps, dim) one after another, (draws, dim).

    If they were interleaved, the effective sample size would hide their autocorrelation.
    """
    return chains.reshape(-1, chains.shape[-1])[:draws]


def _integer(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))
