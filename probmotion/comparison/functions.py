"""Functions to name a problem, sample it and score the draws."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.comparison.results.naming import AnyProblem, named_problems, named_samplers
from probmotion.comparison.results.table import BLOCKS
from probmotion.metrics.run_statistics import draw_statistics
from probmotion.metrics.verdict import Verdict, judge
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.finished import FinishedDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import Likelihood, MotionPrior
from probmotion.posteriors.streams import stream_draws
from probmotion.problems.catalogue import load_problem
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_shape

__all__ = ["Score", "posterior", "problem", "sample", "score"]

_MIN_DRAWS = 5
_MAX_SCORED = 20_000


def problem(name: str, **sizes: Any) -> Problem:
    """Return a problem by name; ``sizes``, such as ``frames=30``, change its difficulty.

    Raises
    ------
    ValueError
        If the problem or a size is unknown.
    """
    return load_problem(name, **sizes)


def posterior(prior: MotionPrior, likelihood: Likelihood | None = None) -> MotionPosterior:
    """Return the posterior p(X | y) ∝ p(X) p(y | X); without a likelihood, the prior."""
    return MotionPosterior(prior, likelihood)


def sample(
    target: AnyProblem,
    sampler: Any = "exact",
    *,
    draws: int = 200,
    chains: int = 4,
    seed: int = 0,
    progress: bool = True,
    stream: str | Path | None = None,
    **settings: Any,
) -> MotionDraws:
    """Return draws from a posterior.

    Parameters
    ----------
    target : str, Problem or MotionPosterior
        Posterior to sample, its problem, or the name of a problem.
    sampler : str, Sampler or function
        Name, object, or function ``(log_density, dim, rng, draws) → θ``.
    draws : int
        Number of draws over all chains.
    chains : int
        Number of chains.
    seed : int
        Seed of all random numbers.
    progress : bool
        Show a progress bar.
    stream : str or Path, optional
        Folder to which draws are written as they come, so that memory does not grow. An unfinished
        run in it is continued with the same draws. The result reads draws when they are used; see
        :func:`~probmotion.open_draws`.
    **settings
        Settings of the sampler that differ from its defaults.

    Raises
    ------
    ValueError
        If a name, setting or number is invalid; :class:`~probmotion.UnsupportedPosterior` if the
        sampler does not support the posterior.
    """
    check_count("draws", draws)
    check_count("chains", chains)
    if draws % chains:
        raise ValueError(f"draws must be a multiple of chains, {chains}, got {draws}")
    (used,) = named_samplers([sampler]).values()
    if settings:
        try:
            used = replace(used, **settings)  # type: ignore[type-var]
        except TypeError as error:
            raise ValueError(f"settings must be those of {used.name}, got {error}") from error
    chosen = _problem(target)
    options: dict[str, Any] = {"draws": draws // chains, "chains": chains, "seed": seed}
    if stream is not None:
        return stream_draws(used, chosen.posterior, stream, progress=progress, **options)
    return used.sample(chosen.posterior, progress=progress, **options)


@dataclass(frozen=True)
class Score:
    """Verdict on draws and all their metrics.

    Parameters
    ----------
    sampler, problem : str
        Names.
    verdict : Verdict or None
        ``None`` without reference draws.
    metrics : dict of float
        As in the table of :func:`~probmotion.compare`.
    """

    sampler: str
    problem: str
    verdict: Verdict | None
    metrics: dict[str, float]

    def __str__(self) -> str:
        judged = "no verdict without reference draws" if self.verdict is None else self.verdict
        lines = [f"{self.sampler} on {self.problem}: {judged}"]
        for title, columns in BLOCKS.items():
            shown = [
                f"{heading} {_short(self.metrics[name])}"
                for name, heading in columns.items()
                if name in self.metrics and (name != "seconds" or title.startswith("cost"))
            ]
            if shown:
                lines.append(f"  {title}: {', '.join(shown)}")
        return "\n".join(lines)


def score(target: AnyProblem, draws: Any, *, seed: int = 0) -> Score:
    """Return the verdict and the metrics of finished draws.

    Parameters
    ----------
    target : str, Problem or MotionPosterior
        Posterior that was sampled, its problem, or the name of a problem.
    draws : MotionDraws, xarray.DataTree or array
        At least five draws; see :meth:`probmotion.posteriors.FinishedDraws.of`. Chains of
        :class:`~probmotion.MotionDraws` are thinned to 20 000 draws in all.
    seed : int
        Seed of reference draws.

    Raises
    ------
    ValueError
        If the draws have another shape than the posterior's motions or are too few.
    """
    from probmotion.metrics.measures import measure

    chosen = _problem(target)
    if isinstance(draws, MotionDraws):
        draws = _thinned(draws)
    finished = FinishedDraws.of(draws)
    known = draws if isinstance(draws, MotionDraws) else finished.sample(chosen.posterior)
    _check_draws(known.flat(), chosen)
    reference = seeds.integer(seed, "exact", chosen.name)
    verdict = None
    # As in a comparison; several threads are not faster for matrices of this size.
    with one_thread():
        metrics = measure(chosen, known, reference)
        if chosen.has_reference:
            verdict = judge([draw_statistics(chosen, known, reference, metrics)])
    return Score(finished.name, chosen.name, verdict, metrics)


def _check_draws(motions: np.ndarray, chosen: Problem) -> None:
    if len(motions) < _MIN_DRAWS:
        raise ValueError(f"draws must contain at least {_MIN_DRAWS}, got {len(motions)}")
    posterior = chosen.posterior
    check_shape("draws", motions, ("n", posterior.frames, posterior.skeleton.n_joints, 3))


def _thinned(draws: MotionDraws) -> MotionDraws:
    """Return at most 20 000 evenly spaced draws; the others are not read."""
    most = max(1, _MAX_SCORED // draws.dataset.sizes["chain"])
    step = max(1, -(-draws.dataset.sizes["draw"] // most))
    return replace(draws, dataset=draws.dataset.isel(draw=slice(None, None, step)))


def _problem(target: AnyProblem) -> Problem:
    ((_, given),) = named_problems([target]).items()
    return load_problem(given) if isinstance(given, str) else given


def _short(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "–"
