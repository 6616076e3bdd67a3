"""Certified reference draws from two independent runs.

Each run has four chains. The draws are accepted only if both runs have mixed and agree, in world
coordinates and after rigid alignment, because large translations can mask poor mixing of poses.
If chains start at few seeds, modes that no chain reached remain undetected; the certificate records
the number of seeds. For exact posteriors, two sets of exact draws are tested in the same way.
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
from probmotion.posteriors.protocols import HasLogDensity, HasWalks, Samplable
from probmotion.posteriors.reference import StoredReference, fingerprint_of
from probmotion.posteriors.sampling import Sampler, load_sampler
from probmotion.problems.references.outlier_gibbs import OutlierGibbs
from probmotion.samplers.mcmc.tempered_pairs import TemperedPairs
from probmotion.validation import check_count

__all__ = ["ReferenceRefused", "agreement", "certify", "make_reference"]

_CHAINS = 4  # per run
_RHAT = 1.01  # maximum R-hat
_MIN_RUN_DRAWS = 4000  # minimum number of draws of both runs before thinning
_PROBES = 4  # points of the fingerprint of unfinished runs
_DIRECTIONS = 128  # random projections of the sliced Wasserstein distance
_DEVIATIONS, _MIN_RATIO_LIMIT = 5.0, 1.5  # limits of the distance: deviations, minimum
_LEVEL = 1e-3  # significance level of the test of means
_CONSTANT = 1e-9  # range or standard deviation of constant coordinates, metres


class ReferenceRefused(ValueError):  # noqa: N818
    """Error raised if two runs have not mixed or disagree."""


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
        Number of draws, half from each run: a multiple of 8, at least 32. The runs make at least
        4000 draws, as R-hat is unreliable for short chains, and are thinned to this number.
    seed : int
        Seed of both runs.
    progress : bool
        Show progress bars.
    sampler : Sampler, optional
        Sampler for posteriors that are not exact; by default ``OutlierGibbs`` or ``TemperedPairs``
        where suitable, else NUTS with a long warm-up or, without gradients, a random walk.
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
        If ``unfinished`` is not writable; later write errors are issued as warnings.
    """
    check_count("draws", draws, least=8 * _CHAINS)
    if draws % (2 * _CHAINS):
        raise ValueError(f"draws must be a multiple of {2 * _CHAINS}, got {draws}")
    # Compute the fingerprint first, so that unsupported posteriors fail before the long runs.
    fingerprint = fingerprint_of(problem.posterior, _probes(problem))
    if problem.exact_source is not None:
        sampler = load_sampler("exact")()
    elif sampler is None:
        sampler = _default_sampler(problem)
    n = max(draws, _MIN_RUN_DRAWS) // 2
    folder = None if unfinished is None else writable_folder(Path(unfinished))
    key = [problem.name, fingerprint, sampler.name, settings_of(sampler), n, seed]
    runs = []
    for half in range(2):
        make = partial(_run, problem, sampler, n, seed, half, progress)
        runs.append(make(None) if folder is None else _cached_run(folder, half, key, make))
    return certify(problem, runs, seed, draws)


def _probes(problem: Problem) -> np.ndarray:
    """Return motions at which log densities distinguish posteriors."""
    posterior, rng = problem.posterior, seeds.generator(0, "unfinished")
    if isinstance(posterior.prior, HasLogDensity):
        return posterior.complete(posterior.initial(rng, _PROBES))
    # Motions near the origin, since there are no others.
    shape = (_PROBES, posterior.frames, posterior.skeleton.n_joints, 3)
    return 0.1 * rng.standard_normal(shape)


def _default_sampler(problem: Problem) -> Sampler:
    tempered = TemperedPairs(levels=24, steps=120, warmup=2000, thin=120)
    samplers: list[OutlierGibbs | TemperedPairs] = [OutlierGibbs(), tempered]
    for sampler in samplers:
        if sampler.draws_from(problem.posterior):
            return sampler
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
    resumable = isinstance(sampler, TemperedPairs)
    options: dict[str, Any] = {"unfinished": unfinished} if resumable else {}
    return sampler.sample(
        problem.posterior,
        draws=n // _CHAINS,
        chains=_CHAINS,
        seed=seeds.integer(seed, "reference run", half),
        progress=progress,
        **options,
    )


def _cached_run(
    folder: Path, half: int, key: list[Any], make: Callable[[Path], MotionDraws]
) -> MotionDraws:
    """Load a finished run, or make and store it; file errors are issued as warnings.

    The file name contains a hash of everything that determines the run.
    """
    digest = hashlib.sha256(json.dumps([*key, library_versions()]).encode()).hexdigest()
    path = folder / f"run-{half}-{digest[:16]}.nc"
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
    """Return the draws of two runs as a reference, or raise :class:`ReferenceRefused`.

    Both runs must have mixed and agree. The reference contains ``draws`` evenly spaced draws of the
    chains, all by default.
    """
    world = [run.dataset["positions"].values for run in runs]
    aligned = [align_motions(positions, world[0][0, 0]) for positions in world]
    diagnostics = [chain_diagnostics(run) for run in runs]
    # After alignment a rigid body leaves only rounding errors.
    deforms = not _are_equal(aligned)
    if deforms:
        for run, positions in zip(runs, aligned, strict=True):
            flat = positions.reshape(*positions.shape[:2], -1)
            diagnostics.append(chain_diagnostics(run, principal_coordinates(flat)))
    elif not _is_rigid(problem):
        raise ReferenceRefused(
            f"runs on {problem.name} must contain motions that differ by more than a rigid "
            "motion, got none"
        )
    names = (problem.name, f"{problem.name} after alignment")
    rhats = [each["rhat"] for each in diagnostics if "rhat" in each]
    # The negation also rejects NaN.
    for number, rhat in enumerate(rhats):
        if not rhat <= _RHAT:
            raise ReferenceRefused(
                f"R-hat of the runs on {names[number > 1]} must be at most {_RHAT}, got "
                f"{rhat:.3f}; try more draws"
            )
    agreed = _agreed(names[0], world, seed)
    agreed_after_alignment = _agreed(names[1], aligned, seed) if deforms else None
    positions = np.concatenate([_thinned(run, draws) for run in runs]).astype(np.float32)
    attributes, prior = runs[0].dataset.attrs, problem.posterior.prior
    certificate: dict[str, Any] = {
        "problem": problem.name,
        "draws": len(positions),
        "exact": problem.exact_source is not None,
        "sampler": attributes["sampler"],
        "settings": json.loads(attributes["settings"]),
        "draws_made": sum(len(run.flat()) for run in runs),
        "chains": len(runs) * runs[0].dataset.sizes["chain"],
        # None if chains start at draws from the prior.
        "seeds": len(prior.seed) if isinstance(prior, HasWalks) else None,
        "rhat": max(rhats, default=None),
        "ess_bulk": _minimum(diagnostics, "ess_bulk"),
        "ess_tail": _minimum(diagnostics, "ess_tail"),
        "agreement": agreed,
        "agreement_wherever_they_stand": agreed_after_alignment,
        "seed": seed,
        "versions": library_versions(),
        "fingerprint": fingerprint_of(problem.posterior, positions),
    }
    return StoredReference(positions, certificate)


def _agreed(name: str, runs: list[np.ndarray], seed: int) -> dict[str, float]:
    """Return :func:`agreement` of two runs, or raise :class:`ReferenceRefused`."""
    agreed = agreement(*runs, seed=seed)
    for measure in ("swd_ratio", "mean_z"):
        value, limit = agreed[measure], agreed[f"{measure}_at_most"]
        if not value <= limit:
            raise ReferenceRefused(
                f"{measure} of two runs on {name} must be at most {limit:.3g}, got {value:.3g}"
            )
    return agreed


def _are_equal(aligned: list[np.ndarray]) -> bool:
    flat = np.concatenate([run.reshape(-1, *run.shape[-3:]) for run in aligned])
    return bool(np.ptp(flat, axis=0).max() < _CONSTANT)


def _is_rigid(problem: Problem) -> bool:
    """Return whether eight motions of the prior agree up to a rigid motion."""
    prior, rng = problem.posterior.prior, seeds.generator(0, "rigid")
    drawn = (
        prior.sample(rng, 8)
        if isinstance(prior, Samplable)
        else prior.motion(rng.standard_normal((8, problem.posterior.dim)))
    )
    positions = to_numpy(drawn)
    return _are_equal([align_motions(positions, positions[0])])


def _thinned(run: MotionDraws, draws: int | None) -> np.ndarray:
    positions = run.dataset["positions"].values
    available = positions.shape[1]
    n = available if draws is None else draws // (2 * len(positions))
    return positions[:, np.arange(n) * available // n].reshape(-1, *positions.shape[2:])


def agreement(first: np.ndarray, second: np.ndarray, *, seed: int) -> dict[str, float]:
    """Return the discrepancy of two runs and its limits.

    - ``swd_ratio``: sliced Wasserstein distance between the runs, relative to its mean over splits
      of all chains into halves with chains of both runs; ``swd_ratio_at_most`` is 1 plus five
      relative standard deviations over these splits, but at least 1.5
    - ``mean_z``: largest difference of means in standard errors, given effective sample sizes;
      ``mean_z_at_most`` is exceeded with probability 0.001 if the distributions are equal

    Both runs are positions (chain, draw, L, J, 3) of equal shape, metres; ``seed`` is the seed of
    the random projections.
    """
    from scipy.stats import norm

    runs = [run.reshape(*run.shape[:2], -1) for run in (first, second)]
    dim = runs[0].shape[-1]
    directions = random_directions(seeds.generator(seed, "directions"), _DIRECTIONS, dim)
    projected = np.concatenate([run @ directions.T for run in runs])
    chains = len(runs[0])
    halves = [_sliced_distance(projected, chosen) for chosen in _mixed_halves(chains)]
    floor = float(np.mean(halves))
    # Skip constant coordinates, such as those of a centred root.
    varies = np.concatenate([run.reshape(-1, dim) for run in runs]).std(axis=0) > _CONSTANT
    z = _z_scores(*(run[..., varies] for run in runs))
    return {
        "swd_ratio": _sliced_distance(projected, tuple(range(chains))) / floor,
        "swd_ratio_at_most": max(_MIN_RATIO_LIMIT, 1 + _DEVIATIONS * float(np.std(halves)) / floor),
        "mean_z": float(np.abs(z).max()),
        "mean_z_at_most": float(norm.isf(0.5 * _LEVEL / len(z))),
    }


def _mixed_halves(chains: int) -> list[tuple[int, ...]]:
    """Return chains of halves with equally many chains of each run, one half per split."""
    halves = list(combinations(range(chains), chains // 2))
    return [(*a, *(chains + i for i in b)) for a in halves for b in halves if 0 in a]


def _sliced_distance(projected: np.ndarray, chosen: tuple[int, ...]) -> float:
    """Return the sliced Wasserstein distance between chosen and other chains, given projections."""
    others = [chain for chain in range(len(projected)) if chain not in chosen]
    x, y = (
        np.sort(projected[list(chains)].reshape(-1, projected.shape[-1]), axis=0)
        for chains in (chosen, others)
    )
    return float(np.sqrt(np.mean((x - y) ** 2)))


def _z_scores(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the differences of the runs' means in standard errors."""
    from arviz_stats.base import array_stats

    difference = first.mean(axis=(0, 1)) - second.mean(axis=(0, 1))
    variance = np.zeros(len(difference))
    for run in (first, second):
        ess = array_stats.ess(run, method="mean", chain_axis=0, draw_axis=1)
        variance += run.var(axis=(0, 1), ddof=1) / np.asarray(ess)
    return difference / np.sqrt(variance)


def _minimum(diagnostics: list[dict[str, float]], name: str) -> float | None:
    values = [diagnostic[name] for diagnostic in diagnostics if name in diagnostic]
    return min(values) if values and all(map(math.isfinite, values)) else None
