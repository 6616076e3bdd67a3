"""Decomposition of a multi-view sampler's error on a problem with exact draws.

A chain of samplers leads from exact draws to `mas`; consecutive samplers differ by one component.
The part of a component is the difference of the samplers' error measures (T: steps of `mas`):

- ``remainder``: from exact draws to `ancestral3d` with 10 T steps; 0 if correctly implemented
- ``discretisation``: from 10 T to T steps
- ``integrator``: from the second-order integrator and levels of `ancestral3d` to those of `mas`
- ``single view``: from the 3D denoiser to `mas` with exact 2D denoisers, both given observations
- ``independent noise``: from noise shared by all views to independent noise in each view
- ``guidance``: from conditional to unconditional, guided denoising, if there are observations
- ``network``: from the exact to a learnt 2D denoiser

Measures are signed (:mod:`~probmotion.calibration.error_measures`), so the parts of each seed add
up exactly. Samplers share seeds; intervals are Student's t intervals of paired differences.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds as seeding
from probmotion.calibration.error_measures import ErrorMeasures, require_exact
from probmotion.calibration.error_result import ErrorDecomposition, StoredValues
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import MotionPrior
from probmotion.posteriors.sampling import Sampler, load_sampler, progress_bar, require
from probmotion.validation import check_count

__all__ = ["decompose_error"]

_REFINEMENT = 10  # steps of the `remainder` sampler, as a multiple of T
# Settings of `mas` that are compatible with the decomposition.
_SETTINGS = (
    "n_views", "elevation", "view_weights", "levels", "integrator", "guidance", "batch",
)  # fmt: skip


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
    """Decompose the error of `mas` on a problem.

    Parameters
    ----------
    problem : Problem
        Problem with an exact posterior and exact 3D and 2D denoisers, conditional on observations
        if there are any (:meth:`~probmotion.posteriors.posterior.MotionPosterior.conditioned`).
    steps : int
        T, number of denoising steps.
    seeds : int
        Number of replicates, at least 2.
    draws : int
        Number of draws per sampler and seed, at least 10.
    settings : mapping, optional
        Settings of `mas`: n_views, elevation, view_weights, levels, integrator,
        guidance, batch.
    shared_noise : bool, optional
        Whether `mas` projects one 3D noise into all views, which removes the part of independent
        noise. True by default if there are observations, because guidance requires it.
    learnt : MotionPrior, optional
        Prior of the same motions with a learnt 2D denoiser, e.g. from
        `probmotion.models.diffusion.projected_denoiser.denoiser_of`. The network part includes
        effects of its normalisation and training views.
    out : str or Path, optional
        Folder for ``decompose_error.csv`` and the values needed to resume an interrupted call.
    progress : bool
        Whether to show a progress bar.

    Raises
    ------
    ValueError
        If the problem has no exact posterior, an argument is invalid, ``learnt`` has other frames
        or joints, or ``out`` contains another decomposition.
    UnsupportedPosterior
        If the prior or ``learnt`` lacks a denoiser.
    """
    check_count("seeds", seeds, least=2)
    check_count("draws", draws, least=10)
    check_count("steps", steps, least=2)
    links, notes = _chain(problem, steps, dict(settings or {}), shared_noise, learnt)
    title = _title(problem, links, steps)
    stored = StoredValues(None if out is None else Path(out), [[*links], draws])
    measures: ErrorMeasures | None = None
    with progress_bar(seeds * len(links), "error decomposition", progress) as bar:
        for seed, link in itertools.product(range(seeds), links):
            if stored.get(link.name, seed) is None:
                measures = ErrorMeasures(problem) if measures is None else measures
                # Samplers share a random stream, separate from that of exact draws.
                stream = "exact" if link.name == "exact" else "samplers"
                number = seeding.integer(seed, "bias budget", stream)
                drawn = link.sampler.sample(
                    link.posterior, draws=draws, seed=number, progress=False
                )
                stored.put(link.name, seed, measures.of(drawn.flat(), seed))
            bar.update(1)
    values = {
        link.name: [stored.get(link.name, seed) or {} for seed in range(seeds)] for link in links
    }
    decomposition = ErrorDecomposition(title, values, notes)
    if out is not None:
        decomposition.write(Path(out) / "decompose_error.csv")
    return decomposition


@dataclass(frozen=True)
class _Link:
    """Sampler in the chain, named after the part that it adds; the first returns exact draws."""

    name: str
    sampler: Sampler
    posterior: MotionPosterior


def _chain(
    problem: Problem,
    steps: int,
    settings: dict[str, Any],
    shared_noise: bool | None,
    learnt: MotionPrior | None,
) -> tuple[list[_Link], list[str]]:
    """Return the samplers in order, and notes on omitted parts."""
    for name in settings:
        if name not in _SETTINGS:
            raise ValueError(f"settings must be among {', '.join(_SETTINGS)}, got {name!r}")
    require_exact(problem)
    Ancestral, Mas = load_sampler("ancestral3d"), load_sampler("mas")
    batch = {name: settings[name] for name in ("batch",) if name in settings}
    likelihood = problem.posterior.likelihood
    inside = problem.posterior.conditioned()
    shared = likelihood is not None if shared_noise is None else shared_noise
    if likelihood is not None and not shared:
        raise ValueError(
            "shared_noise must be True with observations, because guidance requires it, got False"
        )
    mas = Mas(steps=steps, **settings)
    same = Ancestral(steps=steps, levels=mas.levels, integrator=mas.integrator, **batch)
    links = [
        _Link("exact", load_sampler("exact")(), problem.posterior),
        _Link("remainder", Ancestral(steps=_REFINEMENT * steps, **batch), inside),
        _Link("discretisation", Ancestral(steps=steps, **batch), inside),
        _Link("integrator", same, inside),
        _Link("single view", mas, inside),
    ]
    notes = []
    last = links[-1].sampler
    if shared:
        notes.append("no part of independent noise: one 3D noise is projected into all views")
    else:
        last = Mas(steps=steps, shared_noise=False, **settings)
        links.append(_Link("independent noise", last, inside))
    if likelihood is None:
        notes.append("no guidance part: there are no observations")
    else:
        links.append(_Link("guidance", last, problem.posterior))
    if learnt is None:
        notes.append("no network part: no learnt denoiser was given")
    else:
        frames, joints = inside.frames, inside.skeleton.joint_names
        if (learnt.frames, learnt.skeleton.joint_names) != (frames, joints):
            raise ValueError(
                f"learnt must have the problem's {frames} frames and {len(joints)} named joints, "
                f"got {learnt.frames} frames and {learnt.skeleton.n_joints} joints"
            )
        links.append(_Link("network", last, MotionPosterior(learnt, likelihood)))
    for link in links:  # Fail before the first long run.
        require(link.sampler, link.posterior)
    return links, notes


def _title(problem: Problem, links: list[_Link], steps: int) -> str:
    """Return a title with the problem and the main settings."""
    sampler: Any = next(link.sampler for link in reversed(links) if link.sampler.name == "mas")
    words = [problem.name, f"V = {sampler.n_views}", f"T = {steps}"]
    if not np.isclose(sampler.elevation, load_sampler("mas")().elevation):
        words.append(f"elevation {np.degrees(sampler.elevation):.3g}°")
    return ", ".join(words)
