"""`make_reference`: certified reference draws from two independent runs.

Each run has four chains. The draws are kept only if both runs have mixed and agree, in world
coordinates and after rigid alignment, because large translations can hide poses that do not mix.
Chains start where the prior says. If that is at few seeds, modes that no chain reached remain
undetected, and the certificate records the number of seeds. Exact posteriors give two sets of exact
draws, tested in the same way.
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


class ReferenceRefused(ValueError):  # noqa: N818
    """Raised if two runs have not mixed or disagree."""


def make_reference(
    problem: Problem,
    *,
    draws: int = 4000,
    seed: int = 0,
    progress: bool = True,
    sampler: Sampler | None = None,
    unfinished: str | Path | None = None,
) -> StoredReference:
    """Return certified reference draws of a problem.

    Parameters
    ----------
    problem : Problem
        The problem; its stored reference is ignored.
    draws : int
        Number of draws, half from each run: a multiple of 8 (4 chains each). Runs have at least
        4000 draws, as R-hat is unreliable for short ones, and are thinned to this number.
    seed : int
        Seed of both runs.
    progress : bool
        Show progress bars.
    sampler : Sampler, optional
        Sampler for posteriors that are not exact. By default
        :class:`~probmotion.problems.references.outlier_gibbs.OutlierGibbs` or
        :class:`~probmotion.problems.references.tempered_pairs.TemperedPairs` where suitable, else
        NUTS with a long warm-up, or a random walk without gradients.
    unfinished : str or Path, optional
        Folder for finished runs and the state of tempered chains, from which the same call
        resumes; the caller deletes it. By default nothing is written.

    Raises
    ------
    ValueError
        If ``draws`` is invalid or the prior has no density.
    ReferenceRefused
        If R-hat exceeds 1.01 or the runs disagree.
    OSError
        If ``unfinished`` is not writable; errors after the start only warn.
    """
    check_count("draws", draws, least=8 * _CHAINS)
    if draws % (2 * _CHAINS):
        raise ValueError(f"draws must be a multiple of {2 * _CHAINS}, got {draws}")
    shape = (problem.posterior.frames, problem.posterior.skeleton.n_joints, 3)
    # Compute the fingerprint first, so that unsupported posteriors fail before the long runs. Any
    # points near the origin distinguish posteriors.
    probes = 0.1 * seeds.generator(0, "unfinished").standard_normal((_PROBES, *shape))
    fingerprint = fingerprint_of(problem.posterior, probes)
    used = (
        load_sampler("exact")()
        if problem.exact_source is not None
        else sampler or _long_run(problem)
    )
    made = max(draws, _LEAST) // 2
    folder = None if unfinished is None else writable_folder(Path(unfinished))
    key = [problem.name, fingerprint, used.name, settings_of(used), made, seed]
    runs = []
    for half in range(2):
        make = partial(_run, problem, used, made, seed, half, progress)
        runs.append(make(None) if folder is None else _cached_run(folder, half, key, make))
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


def _cached_run(
    folder: Path, half: int, key: list[Any], make: Callable[[Path], MotionDraws]
) -> MotionDraws:
    """Load a finished run, or make and store it; file errors only warn.

    The file name contains a hash of everything that determines the run.
    """
    text = json.dumps([*key, library_versions()])
    path = folder / f"run-{half}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.nc"
    if path.is_file():
        try:
            return MotionDraws.load(path)
        except ValueError as error:
            warnings.warn(f"{error}; the run is repeated", stacklevel=3)
    run = make(path.with_suffix(""))
    try:
        run.save(path)
        for chain in folder.glob(f"{path.stem}-*.npz"):
            chain.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        warnings.warn(f"cannot store the run in {path}: {reason}", stacklevel=3)
    return run


def certify(
    problem: Problem, runs: list[MotionDraws], seed: int, draws: int | None = None
) -> StoredReference:
    """Return the draws of two runs as a reference if both have mixed and they agree.

    Keeps ``draws`` evenly spaced draws of the chains; all by default.

    Raises
    ------
    ReferenceRefused
        Otherwise, with the violated limit.
    """
    world = [run.dataset["positions"].values for run in runs]
    aligned = [align_motions(positions, world[0][0, 0]) for positions in world]
    measured = [chain_diagnostics(run) for run in runs]
    # After alignment a rigid body leaves only rounding errors.
    several = not _alike(aligned)
    if several:
        measured += [
            chain_diagnostics(*pair) for pair in zip(runs, map(_principal, aligned), strict=True)
        ]
    elif not _is_rigid(problem):
        raise ReferenceRefused(
            f"runs on {problem.name} must contain more than one motion up to rigid motion"
        )
    rhats = [each["rhat"] for each in measured if "rhat" in each]
    # The negation also refuses NaN.
    for number, rhat in enumerate(rhats):
        if not rhat <= _RHAT:
            raise ReferenceRefused(
                f"R-hat of the runs on {problem.name}{_where(number > 1)} must be at most {_RHAT}, "
                f"got {rhat:.3f}; try more draws"
            )
    agreed = _agreed(problem.name, world, seed, "")
    agreed_moved = _agreed(problem.name, aligned, seed, _where(True)) if several else None
    positions = np.concatenate([_evenly(run, draws) for run in runs]).astype(np.float32)
    first = runs[0].dataset.attrs
    certificate: dict[str, Any] = {
        "problem": problem.name,
        "draws": len(positions),
        "exact": problem.exact_source is not None,
        "sampler": first["sampler"],
        "settings": json.loads(first["settings"]),
        "draws_made": sum(len(run.flat()) for run in runs),
        "chains": len(runs) * runs[0].dataset.sizes["chain"],
        "seeds": _n_seeds(problem),
        "rhat": max(rhats, default=None),
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
                f"{measure} of two runs on {name}{where} must be at most {agreed[limit]:.3g}, "
                f"got {agreed[measure]:.3g}"
            )
    return agreed


def _where(aligned: bool) -> str:
    return " after alignment" if aligned else ""


def _alike(aligned: list[np.ndarray]) -> bool:
    flat = np.concatenate([run.reshape(-1, *run.shape[-3:]) for run in aligned])
    return bool(np.ptp(flat, axis=0).max() < _STILL)


def _is_rigid(problem: Problem) -> bool:
    """Whether all motions of the prior agree up to rigid motion."""
    prior, rng = problem.posterior.prior, seeds.generator(0, "rigid")
    if isinstance(prior, Samplable):
        positions = to_numpy(prior.sample(rng, 8))
    else:
        positions = to_numpy(prior.motion(rng.standard_normal((8, problem.posterior.dim))))
    return _alike([align_motions(positions, positions[0])])


def _principal(aligned: np.ndarray) -> np.ndarray:
    return principal_coordinates(aligned.reshape(*aligned.shape[:2], -1))


def _n_seeds(problem: Problem) -> int | None:
    """Return the number of starting points; None if chains start at draws from the prior."""
    prior = problem.posterior.prior
    return len(prior.seed_coordinates()) if isinstance(prior, HasSeeds) else None


def _evenly(run: MotionDraws, draws: int | None) -> np.ndarray:
    positions = run.dataset["positions"].values
    made = positions.shape[1]
    n = made if draws is None else draws // (2 * len(positions))
    chosen = positions[:, np.arange(n) * made // n]
    return chosen.reshape(-1, *positions.shape[2:])


def agreement(first: np.ndarray, second: np.ndarray, *, seed: int) -> dict[str, float]:
    """Return the discrepancy of two runs and its limits.

    - ``swd_ratio``: sliced Wasserstein distance, relative to the mean distance of halves that each
      combine chains of both runs and so reflect slow mixing; ``swd_ratio_at_most`` is 1 plus five
      standard deviations over these halves, at least 1.5
    - ``mean_z``: largest difference of means in standard errors from the effective sample sizes;
      ``mean_z_at_most`` is exceeded with probability .001 by equal distributions

    Takes positions (chain, draw, L, J, 3) of equal shape, metres, and the seed of the projections.
    """
    from scipy.stats import norm

    runs = [run.reshape(*run.shape[:2], -1) for run in (first, second)]
    dim = runs[0].shape[-1]
    directions = random_directions(seeds.generator(seed, "directions"), _DIRECTIONS, dim)
    seen = np.concatenate([run @ directions.T for run in runs])
    chains = len(runs[0])
    halves = [_apart(seen, chosen) for chosen in _mixed_halves(chains)]
    floor = float(np.mean(halves))
    # Skip constant coordinates, such as those of a centred root.
    spread = np.concatenate([run.reshape(-1, dim) for run in runs]).std(axis=0) > _STILL
    z = _standard_errors_apart(*(run[..., spread] for run in runs))
    return {
        "swd_ratio": _apart(seen, tuple(range(chains))) / floor,
        "swd_ratio_at_most": max(_RATIO, 1 + _SPREADS * float(np.std(halves)) / floor),
        "mean_z": float(np.abs(z).max()),
        "mean_z_at_most": float(norm.isf(0.5 * _LEVEL / len(z))),
    }


def _mixed_halves(chains: int) -> list[tuple[int, ...]]:
    """Return halves that contain equally many chains of both runs, one of each pair."""
    own = list(combinations(range(chains), chains // 2))
    return [(*a, *(chains + i for i in b)) for a in own for b in own if 0 in a]


def _apart(seen: np.ndarray, chosen: tuple[int, ...]) -> float:
    """Return the sliced Wasserstein distance of chosen chains to the others from projections."""
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
    values = [diagnostic[name] for diagnostic in measured if name in diagnostic]
    return min(values) if values and all(map(math.isfinite, values)) else None
