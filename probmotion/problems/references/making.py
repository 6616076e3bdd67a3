"""`make_reference`: reference draws from two independent runs that agree.

Both runs are the sampler's own, four chains each; their draws are kept only if each has mixed and
they cannot be told apart, in where motions are as in what they are like wherever they stand: places
that differ by metres would hide poses that do not mix. Chains start where the prior says: where
that is a few seeds, they start together and say nothing of modes that none of them reached, and the
certificate tells from how many points. Of a posterior that is known exactly they are two sets of
exact draws, which are measured the same way.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import to_numpy
from probmotion.files import writable_folder
from probmotion.interaction.geometry.coordinates import align_motions
from probmotion.metrics.chains import chain_diagnostics, principal_coordinates
from probmotion.metrics.distribution import random_directions
from probmotion.posteriors.draws import MotionDraws, library_versions, settings_of
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.protocols import HasSeeds, Samplable
from probmotion.posteriors.reference import StoredReference, fingerprint_of
from probmotion.posteriors.sampling import Sampler, load_sampler
from probmotion.problems.references.outlier_gibbs import OutlierGibbs
from probmotion.problems.references.tempered_pairs import TemperedPairs
from probmotion.validation import check_count

__all__ = ["ReferenceRefused", "agreement", "certify", "make_reference"]

_CHAINS = 4
_RHAT = 1.01
_LEAST = 4000
_PROBES = 4
_DIRECTIONS = 128
_SPREADS, _RATIO = 5.0, 1.5
_LEVEL = 1e-3
_STILL = 1e-9


class ReferenceRefused(ValueError):  # noqa: N818 (a verdict, not a fault)
    """Two runs that have not mixed, or do not agree: their draws are no reference."""


def make_reference(
    problem: Problem,
    *,
    draws: int = 4000,
    seed: int = 0,
    progress: bool = True,
    sampler: Sampler | None = None,
    unfinished: str | Path | None = None,
) -> StoredReference:
    """Return reference draws of a problem with their certificate.

    Parameters
    ----------
    problem : Problem
        The problem; its stored reference is not read.
    draws : int
        Draws to keep, half from each run: a multiple of 8, 4 chains each. The runs have 4000 at
        least, because R-hat says little of short ones; of more, as many as asked for are kept,
        evenly apart.
    seed : int
        Seed of both runs.
    progress : bool
        Show bars.
    sampler : Sampler, optional
        What draws where the posterior is not exact. By default
        :class:`~probmotion.problems.references.outlier_gibbs.OutlierGibbs` or
        :class:`~probmotion.problems.references.tempered_pairs.TemperedPairs` where that can, else
        NUTS with a longer warm-up; a random walk where there is no gradient.
    unfinished : str or Path, optional
        Folder in which each run is kept once it has ended, and chains of tempered pairs before: the
        same call, stopped on the way, goes on there. Whoever named it deletes it. By default
        nothing is written.

    Raises
    ------
    ValueError
        If ``draws`` is not such a number, or the prior has no density.
    ReferenceRefused
        If R-hat is above 1.01, or the runs disagree.
    OSError
        If ``unfinished`` cannot be written to; once runs have begun that is a warning.
    """
    check_count("draws", draws, least=8 * _CHAINS)
    if draws % (2 * _CHAINS):
        raise ValueError(f"draws must be a multiple of {2 * _CHAINS}, 4 chains twice, got {draws}")
    shape = (problem.posterior.frames, problem.posterior.skeleton.n_joints, 3)
    # A posterior that has no fingerprint is refused before hours are spent. Near the origin, where
    # cameras look: density is problem at any points that tell one evidence from another.
    probes = 0.1 * seeds.generator(0, "unfinished").standard_normal((_PROBES, *shape))
    known = fingerprint_of(problem.posterior, probes)
    used = load_sampler("exact")() if problem.known is not None else sampler or _long_run(problem)
    made = max(draws, _LEAST) // 2
    folder = None if unfinished is None else writable_folder(Path(unfinished))
    made_by = [problem.name, known, used.name, settings_of(used), made, seed]
    runs = []
    for half in range(2):
        make = partial(_run, problem, used, made, seed, half, progress)
        runs.append(make(None) if folder is None else _kept_or_made(folder, half, made_by, make))
    return certify(problem, runs, seed, draws)


def _long_run(problem: Problem) -> Sampler:
    gibbs, tempered = OutlierGibbs(), TemperedPairs()
    if gibbs.draws_from(problem.posterior):
        return gibbs
    if tempered.draws_from(problem.posterior):
        return tempered
    if problem.posterior.differentiable:
        return load_sampler("nuts")(warmup=1000, candidates=10_000)
    return load_sampler("mh")(warmup=20_000, thin=50)


def _run(
    problem: Problem,
    sampler: Sampler,
    n: int,
    seed: int,
    half: int,
    progress: bool,
    unfinished: Path | None,
) -> MotionDraws:
    sample = sampler.sample
    if isinstance(sampler, TemperedPairs):
        sample = partial(sampler.sample, unfinished=unfinished)
    return sample(
        problem.posterior,
        draws=n // _CHAINS,
        chains=_CHAINS,
        seed=seeds.integer(seed, "reference run", half),
        progress=progress,
    )


def _kept_or_made(
    folder: Path, half: int, made_by: list[Any], make: Callable[[Path], MotionDraws]
) -> MotionDraws:
    """Return a run that has ended, or make it and keep it; a file that fails stops neither.

    The file's name tells by what it was made, and of what. A run that keeps its chains before it
    has ended does so beside it.
    """
    told = json.dumps([*made_by, library_versions()])
    path = folder / f"run-{half}-{hashlib.sha256(told.encode()).hexdigest()[:16]}.nc"
    if path.is_file():
        try:
            return MotionDraws.load(path)
        except ValueError as error:
            warnings.warn(f"{error}; the run is made anew", stacklevel=3)
    run = make(path.with_suffix(""))
    try:
        run.save(path)
        for chain in folder.glob(f"{path.stem}-*.npz"):
            chain.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        warnings.warn(f"cannot keep the run in {path}: {reason}", stacklevel=3)
    return run


def certify(
    problem: Problem, runs: list[MotionDraws], seed: int, draws: int | None = None
) -> StoredReference:
    """Return the draws of two runs as a reference, if both have mixed and they agree.

    ``draws`` of them are kept, evenly apart in every chain; all by default.

    Raises
    ------
    ReferenceRefused
        If they have not or do not; the message says how far.
    """
    there = [run.dataset["positions"].values for run in runs]
    moved = [align_motions(positions, there[0][0, 0]) for positions in there]
    measured = [chain_diagnostics(run) for run in runs]
    # A rigid body looks the same wherever it stands; what is left of it is rounding.
    several = not _alike(moved)
    if several:
        measured += [
            chain_diagnostics(*pair) for pair in zip(runs, map(_principal, moved), strict=True)
        ]
    elif not _is_rigid(problem):
        raise ReferenceRefused(
            f"the runs on {problem.name} hold one motion wherever it stands, expected several; "
            "nothing was kept"
        )
    found = [each["rhat"] for each in measured if "rhat" in each]
    # Not-a-number is no R-hat that is small.
    for number, rhat in enumerate(found):
        if not rhat <= _RHAT:
            raise ReferenceRefused(
                f"the runs on {problem.name} have an R-hat of {rhat:.3f}{_where(number > 1)}, "
                f"expected at most {_RHAT}; more draws may help, nothing was kept"
            )
    agreed = _agreed(problem.name, there, seed, "")
    agreed_moved = _agreed(problem.name, moved, seed, _where(True)) if several else None
    positions = np.concatenate([_evenly(run, draws) for run in runs]).astype(np.float32)
    first = runs[0].dataset.attrs
    certificate: dict[str, Any] = {
        "problem": problem.name,
        "draws": len(positions),
        "exact": problem.known is not None,
        "sampler": first["sampler"],
        "settings": json.loads(first["settings"]),
        "draws_made": sum(len(run.flat()) for run in runs),
        "chains": len(runs) * runs[0].dataset.sizes["chain"],
        "seeds": _n_seeds(problem),
        "rhat": max(found, default=None),
        "ess_bulk": _least(measured, "ess_bulk"),
        "ess_tail": _least(measured, "ess_tail"),
        "agreement": agreed,
        "agreement_wherever_they_stand": agreed_moved,
        "seed": seed,
        "versions": library_versions(),
        "fingerprint": fingerprint_of(problem.posterior, positions),
    }
    return StoredReference(positions, certificate)


def _agreed(name: str, runs: list[np.ndarray], seed: int, where: str) -> dict[str, float]:
    """Return :func:`agreement` of two runs, or raise :class:`ReferenceRefused`."""
    agreed = agreement(*runs, seed=seed)
    for measure, limit in (("swd_ratio", "swd_ratio_at_most"), ("mean_z", "mean_z_at_most")):
        if not agreed[measure] <= agreed[limit]:
            raise ReferenceRefused(
                f"two runs on {name} disagree, {measure} is {agreed[measure]:.3g}{where}, "
                f"expected at most {agreed[limit]:.3g}; nothing was kept"
            )
    return agreed


def _where(moved: bool) -> str:
    return " wherever motions stand" if moved else ""


def _alike(moved: list[np.ndarray]) -> bool:
    flat = np.concatenate([run.reshape(-1, *run.shape[-3:]) for run in moved])
    return bool(np.ptp(flat, axis=0).max() < _STILL)


def _is_rigid(problem: Problem) -> bool:
    """Whether all motions of the prior are one, wherever it stands."""
    prior, rng = problem.posterior.prior, seeds.generator(0, "rigid")
    if isinstance(prior, Samplable):
        positions = to_numpy(prior.sample(rng, 8))
    else:
        positions = to_numpy(prior.motion(rng.standard_normal((8, problem.posterior.dim))))
    return _alike([align_motions(positions, positions[0])])


def _principal(moved: np.ndarray) -> np.ndarray:
    return principal_coordinates(moved.reshape(*moved.shape[:2], -1))


def _n_seeds(problem: Problem) -> int | None:
    """Return from how many points chains start; None where each starts at a draw of its own."""
    prior = problem.posterior.prior
    return len(prior.seed_coordinates()) if isinstance(prior, HasSeeds) else None


def _evenly(run: MotionDraws, draws: int | None) -> np.ndarray:
    positions = run.dataset["positions"].values
    made = positions.shape[1]
    n = made if draws is None else draws // (2 * len(positions))
    chosen = positions[:, np.arange(n) * made // n]
    return chosen.reshape(-1, *positions.shape[2:])


def agreement(first: np.ndarray, second: np.ndarray, *, seed: int) -> dict[str, float]:
    """Return how far two runs are apart, and how far two runs alike may be.

    - ``swd_ratio``: their sliced Wasserstein distance over that of halves which take half of
      the chains of each run, so that they differ as runs that agree do, slow mixing included;
      ``swd_ratio_at_most`` is 1 and five of those halves' standard deviations, or 1.5
    - ``mean_z``: the largest difference of means over coordinates, in standard errors that count
      each run's effective draws; ``mean_z_at_most`` is exceeded once in a thousand times by
      runs that agree

    Parameters
    ----------
    first, second : ndarray, (chain, draw, L, J, 3)
        Positions, metres; as many of both.
    seed : int
        Of the directions of projection.
    """
    from scipy.stats import norm

    runs = [run.reshape(*run.shape[:2], -1) for run in (first, second)]
    dim = runs[0].shape[-1]
    directions = random_directions(seeds.generator(seed, "directions"), _DIRECTIONS, dim)
    seen = np.concatenate([run @ directions.T for run in runs])
    chains = len(runs[0])
    halves = [_apart(seen, chosen) for chosen in _mixed_halves(chains)]
    floor = float(np.mean(halves))
    # A root whose center nothing moves has neither deviation nor difference.
    spread = np.concatenate([run.reshape(-1, dim) for run in runs]).std(axis=0) > _STILL
    z = _standard_errors_apart(*(run[..., spread] for run in runs))
    return {
        "swd_ratio": _apart(seen, tuple(range(chains))) / floor,
        "swd_ratio_at_most": max(_RATIO, 1 + _SPREADS * float(np.std(halves)) / floor),
        "mean_z": float(np.abs(z).max()),
        "mean_z_at_most": float(norm.isf(0.5 * _LEVEL / len(z))),
    }


def _mixed_halves(chains: int) -> list[tuple[int, ...]]:
    """Chains of halves that take as many from each run; each of the two halves stands for both."""
    own = list(combinations(range(chains), chains // 2))
    return [(*a, *(chains + i for i in b)) for a in own for b in own if 0 in a]


def _apart(seen: np.ndarray, chosen: tuple[int, ...]) -> float:
    """The sliced Wasserstein distance of some chains to the others, all projected already."""
    others = [chain for chain in range(len(seen)) if chain not in chosen]
    x, y = (seen[list(some)].reshape(-1, seen.shape[-1]) for some in (chosen, others))
    return float(np.sqrt(np.mean((np.sort(x, axis=0) - np.sort(y, axis=0)) ** 2)))


def _standard_errors_apart(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    from arviz_stats.base import array_stats

    difference = first.mean(axis=(0, 1)) - second.mean(axis=(0, 1))
    variance = np.zeros(len(difference))
    for run in (first, second):
        ess = array_stats.ess(run, method="mean", chain_axis=0, draw_axis=1)
        variance += run.var(axis=(0, 1), ddof=1) / np.asarray(ess)
    return difference / np.sqrt(variance)


def _least(measured: list[dict[str, float]], name: str) -> float | None:
    values = [found[name] for found in measured if name in found]
    return min(values) if values and all(map(math.isfinite, values)) else None
