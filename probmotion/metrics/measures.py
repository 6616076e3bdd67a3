"""Metrics of a run on a problem, by name."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from probmotion import seeds
from probmotion.metrics import accuracy, distribution, keypoints
from probmotion.metrics.chains import chain_diagnostics
from probmotion.metrics.generation import GenerationReference, diversity
from probmotion.metrics.run_statistics import Features, reference_draws
from probmotion.metrics.stein import NoGradient, kernel_stein_discrepancy, score_of
from probmotion.metrics.two_sample import classifier_two_sample, maximum_mean_discrepancy
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.likelihoods import Keypoints2D
from probmotion.posteriors.protocols import HasStyles

if TYPE_CHECKING:
    from probmotion.posteriors.posterior import MotionPosterior
    from probmotion.posteriors.problem import Problem

__all__ = ["accuracy_of", "load_libraries", "measure", "visible_joints"]

_LIBRARIES = ("arviz_stats.base", "scipy.spatial.distance")

_DIRECTIONS = 256  # of the sliced Wasserstein distance
# Target number of exact draws, and maximum number of sets of exact draws, each as large as a run.
_EXACT_DRAWS, _MAX_SETS = 4000, 8
_MILLIMETRES = 1000.0  # per metre
_SQUARE_CENTIMETRES = 1e4  # per square metre
_MAX_DEGENERATE = 100  # approximate maximum of draws tested for degenerate views
_MAX_STEIN = 500  # maximum number of draws for the kernel Stein discrepancy
_REAL_PAIRS = 5000  # pairs for the diversity of real motions


def measure(problem: Problem, draws: MotionDraws, seed: int) -> dict[str, float]:
    """Return all metrics that apply to a problem and a run, by name.

    Metrics relative to reference draws, exact or stored. If the problem requires it, motions are
    aligned first, except for densities, styles and the manifold:

    - ``swd_ratio``: sliced Wasserstein distance relative to that between exact sets; 1 is ideal
    - ``variance_ratio``: trace of the covariance relative to the exact one; < 1: overconfident
    - ``mean_error_sd``: error of the mean in posterior standard deviations; 0 is ideal
    - ``off_manifold_ratio``: variance off the prior's manifold relative to exact draws; 1 is ideal
    - ``log_density_gap``: mean log density minus that of exact draws, nats; 0 is ideal
    - ``mode_proportion_<style>``: proportion of a style; ``mode_proportions_tv``: total variation
      distance of the proportions from those of exact draws
    - ``precision``, ``recall``: k-nearest-neighbour manifolds, k = 3; 1 is best
    - ``mmd``: squared maximum mean discrepancy, unbiased; 0 is ideal
    - ``c2st``: accuracy of a classifier between draws and reference draws; 0.5 is ideal

    Metrics relative to held-out real 2D motion (MAS, section 6.3), averaged over random views:

    - ``fid``, ``view_precision``, ``view_recall``, ``diversity_ratio`` (relative to real motion)
    - ``fid_side``, ``view_recall_side``: side views; ``fid_learnt``, ``view_recall_learnt``:
      comparison with the training clips
    - ``mcd_cm2``: Motion Chamfer Distance of 10-frame windows, cm²; decreases with more draws

    Other metrics:

    - ``ksd``: squared kernel Stein discrepancy from a differentiable density in θ; 0 is ideal,
      NaN if most draws are equal or the gradient is not finite
    - ``coverage_<measure>``: mean distance of held-out poses to the nearest draw
    - ``at_cap``, ``near_floor``: fractions of draws at the bounds of a truncated density
    - ``degenerate``: fraction of views of annotated draws without a unique triangulation
    - ``pck`` (at a tenth of the image extent, %), ``velocity_error``: 2D errors against the truth,
      see :mod:`probmotion.metrics.keypoints`; NaN if a draw is behind a camera
    - errors against the 3D truth (:func:`accuracy_of`), ``seconds``, evaluations and, for chains,
      :func:`~probmotion.metrics.chains.chain_diagnostics`

    Parameters
    ----------
    problem : Problem
        Problem that was sampled.
    draws : MotionDraws
        Draws of the run.
    seed : int
        Seed of reference draws and directions, shared by all samplers.
    """
    values: dict[str, float] = {}
    positions = draws.flat()
    if problem.has_reference:
        values |= _against_reference(problem, positions, seed)
    values |= _against_density(problem, draws)
    if problem.truth is not None:
        values |= accuracy_of(positions, problem.truth, problem.posterior)
        values |= _image_errors(positions, problem.truth, problem.posterior)
    if problem.held_out is not None:
        values |= _coverage_of(positions, problem.held_out)
    if problem.generation is not None:
        values |= _against_real_views(problem.generation, positions, seed)
    for name in ("at_cap", "near_floor"):
        if name in draws.dataset:
            values[name] = float(draws.dataset[name].mean())
    values |= _degenerate(problem, positions)
    return values | chain_diagnostics(draws) | costs(draws)


def costs(draws: MotionDraws) -> dict[str, float]:
    """Return wall-clock ``seconds`` and ``<kind>_evaluations`` of a run."""
    counts = {f"{kind}_evaluations": float(count) for kind, count in draws.counts.items()}
    return {"seconds": draws.seconds} | counts


@dataclass(frozen=True, eq=False)
class _Exact:
    """Reference draws of one problem and their metrics, shared by all samplers."""

    sets: list[np.ndarray]
    flat: np.ndarray
    directions: np.ndarray
    off: float | None
    log_density: float | None
    mode_proportions: dict[str, float]


@lru_cache(maxsize=2)
def _exact_draws(problem: Problem, seed: int, n: int) -> _Exact:
    limit = problem.max_references
    n_sets = min(_MAX_SETS, max(2, _EXACT_DRAWS // n), *([] if limit is None else [limit // n]))
    reference, used = reference_draws(problem, seed, n_sets * n), n_sets * n
    flat = reference.flat[:used]
    rng = seeds.generator(seed, "directions")
    return _Exact(
        sets=np.split(flat, n_sets),
        flat=flat,
        directions=distribution.random_directions(rng, _DIRECTIONS, flat.shape[1]),
        off=_off_manifold(reference, used),
        log_density=_log_density(problem, reference.positions[:used]),
        mode_proportions=_mode_proportions(reference, used),
    )


def _against_reference(problem: Problem, positions: np.ndarray, seed: int) -> dict[str, float]:
    draws = Features(problem, positions)
    flat = draws.flat
    # Thin draws to the size of two available reference sets.
    limit = problem.max_references
    n = len(flat) if limit is None else min(len(flat), limit // 2)
    thinned = flat[np.arange(n) * len(flat) // n]
    exact = _exact_draws(problem, seed, n)
    values = {
        "swd_ratio": distribution.sliced_wasserstein_ratio(thinned, exact.sets, exact.directions),
        "variance_ratio": float(distribution.trace_ratio(flat, exact.flat)),
        "mean_error_sd": float(distribution.mean_error(flat, exact.flat)),
    }
    off_manifold = _off_manifold(draws)
    if off_manifold is not None and exact.off is not None:
        values["off_manifold_ratio"] = off_manifold / exact.off
    log_density = _log_density(problem, positions)
    if log_density is not None and exact.log_density is not None:
        values["log_density_gap"] = log_density - exact.log_density
    proportions = _mode_proportions(draws)
    if proportions:
        values |= {f"mode_proportion_{style}": p for style, p in proportions.items()}
        differences = [abs(p - exact.mode_proportions[style]) for style, p in proportions.items()]
        values["mode_proportions_tv"] = 0.5 * sum(differences)
    values["precision"], values["recall"] = distribution.precision_recall(thinned, exact.sets[0])
    values["mmd"] = maximum_mean_discrepancy(thinned, exact.sets[0])
    values["c2st"] = classifier_two_sample(thinned, exact.sets[0], seed)
    return values


def _against_density(problem: Problem, draws: MotionDraws) -> dict[str, float]:
    if "theta" not in draws.dataset:
        return {}
    theta = draws.dataset["theta"].values
    theta = theta.reshape(-1, theta.shape[-1])
    n = min(len(theta), _MAX_STEIN)
    chosen = theta[np.arange(n) * len(theta) // n]
    try:
        score = score_of(problem.posterior, chosen)
    except NoGradient:
        return {}
    try:
        return {"ksd": kernel_stein_discrepancy(chosen, score)}
    except ValueError:
        # Most draws are equal, or the gradient is not finite.
        return {"ksd": math.nan}


def _against_real_views(
    reference: GenerationReference, positions: np.ndarray, seed: int
) -> dict[str, float]:
    samples = len(positions)
    uniform = reference.score_motions(positions, seed=seed, samples=samples)
    side = reference.score_motions(positions, seed=seed, samples=samples, angles="side")
    pairs = seeds.generator(seed, "real pairs")
    real = diversity(reference.held_out_features, pairs, _REAL_PAIRS)
    values = {
        "fid": uniform["fid"][0],
        "diversity_ratio": uniform["diversity"][0] / real,
        "view_precision": uniform["precision"][0],
        "view_recall": uniform["recall"][0],
        "fid_side": side["fid"][0],
        "view_recall_side": side["recall"][0],
    }
    if reference.learnt_features is not None:
        learnt = reference.of_learnt().score_motions(positions, seed=seed, samples=samples)
        values["fid_learnt"] = learnt["fid"][0]
        values["view_recall_learnt"] = learnt["recall"][0]
    if reference.held_out_views is not None:
        values["mcd_cm2"] = _SQUARE_CENTIMETRES * reference.chamfer(positions, seed=seed).mean
    return values


def _off_manifold(draws: Features, used: int | None = None) -> float | None:
    values = draws.off_manifold
    return None if values is None else float(values[:used].mean())


def _log_density(problem: Problem, positions: np.ndarray) -> float | None:
    value = problem.log_density_of(positions)
    return None if value is None else float(np.mean(value))


def _mode_proportions(draws: Features, used: int | None = None) -> dict[str, float]:
    prior = draws.problem.posterior.prior
    if not isinstance(prior, HasStyles) or draws.proportions is None:
        return {}
    proportions = draws.proportions[:used].mean(axis=0)
    return {style: float(p) for style, p in zip(prior.styles, proportions, strict=True)}


def _coverage_of(positions: np.ndarray, held_out: np.ndarray) -> dict[str, float]:
    from probmotion.interaction.geometry.pose_distances import MEASURES
    from probmotion.metrics.coverage import coverage

    # Frames are compared individually.
    poses, draws = (motions.reshape(-1, *motions.shape[-2:]) for motions in (held_out, positions))
    return {f"coverage_{kind}": float(coverage(poses, draws, kind)) for kind in MEASURES}


def _degenerate(problem: Problem, positions: np.ndarray) -> dict[str, float]:
    fraction = getattr(problem.posterior.likelihood, "degenerate_fraction", None)
    if fraction is None:
        return {}
    return {"degenerate": float(fraction(positions[:: max(1, len(positions) // _MAX_DEGENERATE)]))}


def accuracy_of(
    positions: np.ndarray, truth: np.ndarray, posterior: MotionPosterior
) -> dict[str, float]:
    """Return errors against the truth, millimetres (accelerations: m/s²).

    - ``mpjpe_mm``: mean joint error over draws, after root alignment in every frame
    - ``mpjpe_mean_mm``: error of the mean of draws; ``mpjpe_best_mm``: error of the best draw
    - ``mpjpe_visible_mm``, ``mpjpe_occluded_mm``: mean error of observed or occluded joints
    - ``g_mpjpe_mm``, ``g_mpjpe_mean_mm``, each also ``_visible``, ``_occluded``: unaligned errors
    - ``pa_mpjpe_mm``: mean joint error over draws, after similarity alignment of every frame
    - ``acceleration_error``, ``acceleration_ratio`` (to the true acceleration; plausible 0.5 to 2)
    """
    root = posterior.skeleton.roots[0]
    target = accuracy.aligned_by_root(truth, root)
    errors = accuracy.joint_errors(accuracy.aligned_by_root(positions, root), target)
    mean = positions.mean(axis=0)
    mean_errors = accuracy.joint_errors(accuracy.aligned_by_root(mean, root), target)
    per_draw = accuracy.mean_over(errors)
    unaligned = accuracy.joint_errors(positions, truth)
    unaligned_mean = accuracy.joint_errors(mean, truth)
    aligned = accuracy.aligned_by_similarity(positions, truth)
    metres = {
        "mpjpe": per_draw.mean(),
        "mpjpe_mean": mean_errors.mean(),
        "mpjpe_best": per_draw.min(),
        "g_mpjpe": unaligned.mean(),
        "g_mpjpe_mean": unaligned_mean.mean(),
        "pa_mpjpe": accuracy.joint_errors(aligned, truth).mean(),
    }
    visible = visible_joints(posterior)
    if visible is not None and not visible.all() and visible.any():
        for where, mask in (("visible", visible), ("occluded", ~visible)):
            metres[f"mpjpe_{where}"] = accuracy.mean_over(errors, mask).mean()
            metres[f"g_mpjpe_{where}"] = accuracy.mean_over(unaligned, mask).mean()
            metres[f"g_mpjpe_mean_{where}"] = accuracy.mean_over(unaligned_mean, mask)
    values = {f"{name}_mm": float(value) * _MILLIMETRES for name, value in metres.items()}
    if len(truth) >= 3:
        differences = accuracy.acceleration_error(positions, truth, posterior.fps)
        values["acceleration_error"] = float(differences.mean())
        if np.diff(truth, 2, axis=0).any():
            ratios = accuracy.acceleration_ratio(positions, truth)
            values["acceleration_ratio"] = float(ratios.mean())
    return values


def _image_errors(
    positions: np.ndarray, truth: np.ndarray, posterior: MotionPosterior
) -> dict[str, float]:
    """Return the 2D errors of projected draws against the projected truth."""
    if not isinstance(posterior.likelihood, Keypoints2D):
        return {}
    cameras = posterior.likelihood.cameras
    true = cameras.project(truth)
    try:
        projected = cameras.project(positions)
    except ValueError:
        return {"pck": math.nan, "velocity_error": math.nan}
    true = np.broadcast_to(true, projected.shape)
    values = {}
    # A single joint in a single frame has no extent.
    if np.ptp(true, axis=(-3, -2)).any(axis=-1).all():
        size = keypoints.image_extent(true)
        values["pck"] = keypoints.percentage_of_correct_keypoints(projected, true, size)
    if np.diff(true, axis=-3).any():
        values["velocity_error"] = keypoints.velocity_error(projected, true)
    return values


def visible_joints(posterior: MotionPosterior) -> np.ndarray | None:
    """Return the mask (L, J) of joints observed in any view; ``None`` if unknown."""
    entries = getattr(posterior.likelihood, "entries", None)
    if entries is None:
        return None
    return entries.visible.reshape(-1, *entries.visible.shape[-2:]).any(axis=0)


def load_libraries() -> None:
    """Import the libraries of the metrics, so that timings of runs exclude imports."""
    for name in _LIBRARIES:
        import_module(name)
