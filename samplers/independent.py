"""Samplers whose draws are independent: batches, streams of random numbers, bars, provenance."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from probmotion.arrays import to_numpy
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, Sampler, batches, progress_bar
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread
from probmotion.validation import check_count

__all__ = ["DrawBatch", "draw_independently", "refuse_initial", "with_coordinates"]

DrawBatch = Callable[[NormalStreams, Callable[[], Any]], np.ndarray]
"""(streams, tick) → motions (B, L, J, 3) in normalised units; calls ``tick()`` once per step."""


def draw_independently(
    sampler: Sampler,
    posterior: MotionPosterior,
    draw_batch: DrawBatch,
    *,
    draws: int,
    chains: int,
    seed: int,
    batch: int,
    steps: int,
    scale: float,
    counts: Mapping[str, int],
    progress: bool,
) -> MotionDraws:
    """Return ``chains`` × ``draws`` draws, at most ``batch`` at a time.

    Parameters
    ----------
    sampler, posterior
        For the result's provenance.
    draw_batch : callable
        Draws one batch.
    draws, chains, seed, progress
        As in :class:`~probmotion.posteriors.sampling.Sampler`.
    batch : int
        Draws at a time; draw i of chain k uses its own random numbers whatever its batch.
    steps : int
        How often ``draw_batch`` ticks.
    scale : float
        Metres per normalised unit.
    counts : mapping of int
        Evaluations, read when the draws are done.

    Raises
    ------
    Interrupted
        At Ctrl-C, with the draws of the finished batches.
    """
    check_count("draws", draws)
    check_count("chains", chains)
    start = time.perf_counter()
    # Draw by draw, so that an interrupted run has as many of every chain.
    pairs = [(chain, draw) for draw in range(draws) for chain in range(chains)]
    done: list[np.ndarray] = []
    spent = dict(counts)

    def result() -> MotionDraws:
        motions = np.concatenate(done)
        whole = motions[: len(motions) // chains * chains]
        return MotionDraws.of(
            posterior,
            sampler,
            whole.reshape(-1, chains, *whole.shape[1:]).swapaxes(0, 1),
            seed=seed,
            seconds=time.perf_counter() - start,
            counts=spent,
            independent=True,
        )

    bars = progress_bar(steps * -(-len(pairs) // batch), sampler.name, progress)
    # How a product is split over threads depends on its size, and its rounding on the split: after
    # a hundred steps draws would differ with the batch by far more than rounding.
    try:
        with threadpool_limits(1, user_api="blas"), bars as bar:
            for some in batches(pairs, batch):
                streams = NormalStreams.of_draws(seed, list(some))
                done.append(draw_batch(streams, lambda: bar.update(1)) * scale)
                spent = dict(counts)
    except KeyboardInterrupt as interrupt:
        if sum(map(len, done)) < chains:
            raise
        raise Interrupted(result()) from interrupt
    return result()


def with_coordinates(
    found: MotionDraws, posterior: MotionPosterior, batches_of_theta: Sequence[np.ndarray]
) -> MotionDraws:
    """Return draws with their θ and log density.

    Parameters
    ----------
    found : MotionDraws
        What :func:`draw_independently` gave.
    posterior : MotionPosterior
        Whose density.
    batches_of_theta : sequence of ndarray, (B, dim)
        θ of every batch, as ``draw_batch`` was called.
    """
    sizes = found.dataset.sizes
    # Draw by draw, as the batches were made.
    shape = (sizes["draw"], sizes["chain"])
    theta = np.concatenate(batches_of_theta)[: math.prod(shape)]
    # One by one: the bits of a product depend on its shape and on the place of a row in it.
    with one_thread():
        log_density = np.concatenate([to_numpy(posterior.log_density(row[None])) for row in theta])
    log_density = log_density.reshape(shape).T
    theta = theta.reshape(*shape, -1).swapaxes(0, 1)
    return MotionDraws(
        found.dataset.assign(
            theta=(("chain", "draw", "coordinate"), theta),
            log_density=(("chain", "draw"), log_density),
        )
    )


def refuse_initial(sampler: Sampler, initial: object) -> None:
    """Raise ``ValueError`` if starting points are given to a sampler that starts from noise."""
    if initial is not None:
        raise ValueError(
            f"initial is {type(initial).__name__}, expected None: {sampler.name} starts every draw "
            "from noise"
        )
