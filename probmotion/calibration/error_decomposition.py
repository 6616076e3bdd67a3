"""Decomposition of a multi-view sampler's error on a problem with known exact draws.

A chain of samplers leads from exact draws to the sampler in question. Each differs from the one
before in one thing, whose part of the error is the difference of what is measured of the two:

- ``remainder``: exact draws → `ancestral3d` with many steps. About 0 where all is right
- ``discretisation``: → with T steps
- ``single view``: → `mas`, which conditions on one view at a time, with the exact denoiser of a
  view, given the evidence where there is any
- ``noise sharing``: → with noise of each view's own
- ``guidance``: where there is evidence, → with the denoiser that does not know of it, guided
- ``network``: → with a learnt 2D denoiser

A measure is one signed number of a set of draws (:mod:`~probmotion.calibration.error_measures`), so
parts add up to the whole exactly, seed by seed. Samplers share their seeds, and with them noise:
intervals are Student's, of differences within seeds.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds as seeding
from probmotion.calibration.error_measures import BiasMeasures, require_exact
from probmotion.calibration.error_result import ErrorDecomposition, StoredValues
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import MotionPrior
from probmotion.posteriors.sampling import Sampler, load_sampler, progress_bar, require
from probmotion.problems.conditioned import conditioned
from probmotion.validation import check_count

__all__ = ["decompose_error"]

_MORE = 10
# Settings in which `mas` and the samplers before it in the chain may be told apart by one thing.
_SETTINGS = ("n_views", "elevation", "view_weights", "schedule_power", "guidance", "batch")
_SHARED = ("schedule_power", "batch")


def decompose_error(
    problem: Problem,
    *,
    steps: int = 100,
    seeds: int = 5,
    draws: int = 200,
    settings: Mapping[str, Any] | None = None,
    shared_noise: bool | None = None,
    learnt: MotionPrior | None = None,
    out: str | Path | None = None,
    progress: bool = True,
) -> ErrorDecomposition:
    """Split the error of `mas` on a problem into parts.

    Parameters
    ----------
    problem : Problem
        One with an exact posterior, whose prior has exact 3D and 2D denoisers; where there is
        evidence, also given it (:func:`~probmotion.problems.conditioned.conditioned`).
    steps : int
        T. "Many" is ten times as many.
    seeds : int
        Replicates, at least 2: without a spread no part can be told from chance.
    draws : int
        Per sampler and seed.
    settings : mapping, optional
        Of `mas`: n_views, elevation, view_weights, schedule_power, guidance, batch; its defaults
        where left out.
    shared_noise : bool, optional
        Whether the sampler in question projects one 3D noise into all views; noise sharing is then
        no part. By default it does where there is evidence, which guides `mas` only so.
    learnt : MotionPrior, optional
        A prior with a learnt 2D denoiser of the same motions, such as
        `probmotion.models.diffusion.projected_denoiser.denoiser_of` makes; without it the network
        is no part. What its normalisation and its training views change is its part, too.
    out : str or Path, optional
        Folder that keeps what is measured of every sampler and seed, so that the same call goes on
        where it was stopped, and ``decompose_error.csv``.
    progress : bool
        Show a bar.

    Raises
    ------
    ValueError
        If the problem is not known exactly, a number is out of range, a setting is not one of
        those above, noise is not shared where there is evidence, ``learnt`` is of other motions,
        or ``out`` holds another budget.
    UnsupportedPosterior
        If the problem's prior lacks a denoiser, or ``learnt`` does.
    """
    check_count("seeds", seeds, least=2)
    check_count("draws", draws, least=10)
    check_count("steps", steps, least=2)
    links, notes = _chain(problem, steps, dict(settings or {}), shared_noise, learnt)
    title = _title(problem, links, steps)
    kept = StoredValues(None if out is None else Path(out), [[*links], draws])
    measures: BiasMeasures | None = None
    with progress_bar(seeds * len(links), "bias budget", progress) as bar:
        for seed, link in itertools.product(range(seeds), links):
            if kept.get(link.name, seed) is None:
                measures = BiasMeasures(problem) if measures is None else measures
                number = seeding.integer(seed, "bias budget", link.stream)
                drawn = link.sampler.sample(
                    link.posterior, draws=draws, seed=number, progress=False
                )
                kept.put(link.name, seed, measures.of(drawn.flat(), seed))
            bar.update(1)
    values = {
        link.name: [kept.get(link.name, seed) or {} for seed in range(seeds)] for link in links
    }
    budget = ErrorDecomposition(title, values, notes)
    if out is not None:
        budget.write(Path(out) / "decompose_error.csv")
    return budget


@dataclass(frozen=True)
class _Link:
    """A sampler in the chain, called by the part that it adds; the first is exact draws."""

    name: str
    sampler: Sampler
    posterior: MotionPosterior

    @property
    def stream(self) -> str:
        """Exact draws have random numbers of their own, all others the same."""
        return "exact" if self.name == "exact" else "samplers"


def _chain(
    problem: Problem,
    steps: int,
    settings: dict[str, Any],
    shared_noise: bool | None,
    learnt: MotionPrior | None,
) -> tuple[list[_Link], list[str]]:
    """Return the samplers in order, and which parts are absent and why."""
    for name in settings:
        if name not in _SETTINGS:
            raise ValueError(
                f"settings has {name!r}, expected some of {', '.join(_SETTINGS)}: in others the "
                "samplers before mas have no counterpart"
            )
    require_exact(problem)
    Ancestral, Mas = load_sampler("ancestral3d"), load_sampler("mas")
    common = {name: settings[name] for name in _SHARED if name in settings}
    evidence = problem.posterior.likelihood
    inside = conditioned(problem.posterior)
    shared = evidence is not None if shared_noise is None else shared_noise
    if evidence is not None and not shared:
        raise ValueError(
            "shared_noise is False, expected True where there is evidence: mas is guided only so"
        )
    links = [
        _Link("exact", load_sampler("exact")(), problem.posterior),
        _Link("remainder", Ancestral(steps=_MORE * steps, **common), inside),
        _Link("discretisation", Ancestral(steps=steps, **common), inside),
        _Link("single view", Mas(steps=steps, **settings), inside),
    ]
    notes = []
    last = links[-1].sampler
    if shared:
        notes.append("noise sharing is no part: one 3D noise is projected into all views")
    else:
        last = Mas(steps=steps, shared_noise=False, **settings)
        links.append(_Link("noise sharing", last, inside))
    if evidence is None:
        notes.append("guidance is no part: there is no evidence")
    else:
        links.append(_Link("guidance", last, problem.posterior))
    if learnt is None:
        notes.append("network is no part: no learnt denoiser was given")
    else:
        _check_learnt(learnt, problem)
        links.append(_Link("network", last, MotionPosterior(learnt, evidence)))
    for link in links:
        # Said before an hour of the others.
        require(link.sampler, link.posterior)
    return links, notes


def _check_learnt(learnt: MotionPrior, problem: Problem) -> None:
    """Raise ``ValueError`` if a learnt denoiser is of other motions than the problem's."""
    posterior = problem.posterior
    wanted = (posterior.frames, posterior.skeleton.joint_names)
    if (learnt.frames, learnt.skeleton.joint_names) != wanted:
        raise ValueError(
            f"learnt is of {learnt.frames} frames of {learnt.skeleton.n_joints} joints, expected "
            f"the problem's {posterior.frames} frames and its {len(wanted[1])} joints by name"
        )


def _title(problem: Problem, links: list[_Link], steps: int) -> str:
    """Return what to call the setting."""
    sampler: Any = next(link.sampler for link in reversed(links) if link.sampler.name == "mas")
    words = [problem.name, f"V = {sampler.n_views}", f"T = {steps}"]
    if not np.isclose(sampler.elevation, load_sampler("mas")().elevation):
        words.append(f"elevation {np.degrees(sampler.elevation):.3g}°")
    return ", ".join(words)
