"""All measures that apply to one run on one problem, by name: the numbers of the table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from probmotion import seeds
from probmotion.interaction.geometry.coordinates import align_motions
from probmotion.metrics import accuracy, distribution, keypoints
from probmotion.metrics.chains import chain_diagnostics
from probmotion.metrics.cost import costs
from probmotion.metrics.generation import diversity
from probmotion.metrics.stein import NoGradient, kernel_stein_discrepancy, score_of
from probmotion.metrics.structure import HasManifold, HasStyles
from probmotion.metrics.two_sample import classifier_two_sample, maximum_mean_discrepancy
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.likelihoods import Keypoints2D

if TYPE_CHECKING:
    from probmotion.posteriors.posterior import MotionPosterior
    from probmotion.posteriors.problem import Problem, ScoresGeneration

__all__ = ["accuracy_of", "load_libraries", "measure"]

_LATE = (
    "arviz_stats.base",
    "scipy.spatial.distance",
    "sklearn.decomposition",
    "sklearn.model_selection",
    "sklearn.svm",
)

_DIRECTIONS = 256
# Exact draws to compare with: sets as large as the run's, as many as make about 4000.
_ENOUGH, _MOST_SETS = 4000, 8
_MILLIMETRES = 1000.0
_SQUARE_CENTIMETRES = 1e4
_LOOKED_AT = 100
_OF_DENSITY = 500
_REAL_PAIRS = 5000


def measure(problem: Problem, draws: MotionDraws, seed: int) -> dict[str, float]:
    """Return every measure that applies, by name.

    Against reference draws, exact ones or those that a long run left, where the problem has them
    (aligned to one motion where the problem says so, but for densities, styles and the manifold):

    - ``swd_ratio``: sliced Wasserstein distance over that of two exact sets; 1 is right
    - ``variance_ratio``: trace of covariance over the exact one; < 1 is over-confident
    - ``mean_error_sd``: distance of means over √tr of the exact covariance; 0 is right
    - ``off_manifold_ratio``: variance off the prior's manifold over exact draws'; 1 is right
    - ``log_density_gap``: mean log density less exact draws', nats; 0 is right
    - ``mode_proportion_<style>`` and ``mode_proportions_tv``: proportion of each style, and total
      variation distance of the proportions from those of exact draws
    - ``precision``, ``recall``: k-nearest-neighbour manifolds, k = 3
    - ``mmd``: squared maximum mean discrepancy; 0 is right, and may be missed to either side
    - ``c2st``: how often a classifier tells draws from reference draws; .5 is right

    Against the density, where it has a gradient and the run keeps θ, ``ksd``: squared kernel Stein
    discrepancy; 0 is right, and no number where most draws are one or the slope is not finite.

    Filmed, against held-out real 2D motion (MAS, section 6.3), mean over random views: ``fid``,
    ``diversity_ratio`` (over the real motion's), ``view_precision``, ``view_recall``, and from the
    side ``fid_side`` and ``view_recall_side``; ``fid_learnt`` and ``view_recall_learnt`` are
    against the clips that were learnt from: few clips are far from few others, even real ones.
    ``mcd_cm2``: Motion Chamfer Distance, square centimetres, of windows of 10 frames, where the
    reference holds views and not their features alone; it falls with the number of draws.

    Against poses that were held out: ``coverage_interaction``, ``coverage_cartesian`` and
    ``coverage_shape-context``, the mean distance of each to its nearest draw; see
    :func:`~probmotion.metrics.coverage.coverage`. Of a truncated density: ``at_cap`` and
    ``near_floor``, shares of draws; of annotated evidence ``degenerate``, the share of a draw's
    pictures (of 100 draws) that have no triangulation of their own.

    Against the truth, where it is known, millimetres: see :func:`accuracy_of`. In the pictures of
    2D evidence, against the truth's, all joints: ``pck``, percent nearer than a tenth of the
    picture, and ``velocity_error``, relative, each as in :mod:`probmotion.metrics.keypoints`; no
    numbers where a draw is behind a camera. Of chains: see
    :func:`~probmotion.metrics.chains.chain_diagnostics`. Cost: ``seconds`` and evaluations.

    Parameters
    ----------
    problem : Problem
        What was drawn from.
    draws : MotionDraws
        The run.
    seed : int
        Seed of the exact draws and directions: the same for every sampler, so that samplers are
        compared on common random numbers.
    """
    found: dict[str, float] = {}
    positions = draws.flat()
    if problem.has_reference:
        found |= _against_reference(problem, positions, seed)
    found |= _against_density(problem, draws)
    if problem.truth is not None:
        found |= accuracy_of(positions, problem.truth, problem.posterior)
        found |= _in_pictures(positions, problem.truth, problem.posterior)
    if problem.held_out is not None:
        found |= _coverage_of(positions, problem.held_out)
    if problem.generation is not None:
        found |= _against_real_views(problem.generation, positions, seed)
    for name in ("at_cap", "near_floor"):
        if name in draws.dataset:
            found[name] = float(draws.dataset[name].mean())
    found |= _degenerate(problem, positions)
    return found | chain_diagnostics(draws) | costs(draws)


@dataclass(frozen=True, eq=False)
class _Exact:
    """Reference draws of one problem, and what is measured of them for every sampler alike."""

    sets: list[np.ndarray]
    flat: np.ndarray
    directions: np.ndarray
    off: float | None
    log_density: float | None
    shares: dict[str, float]


@lru_cache(maxsize=2)
def _exact_draws(problem: Problem, seed: int, n: int) -> _Exact:
    most = problem.most_reference
    n_sets = min(_MOST_SETS, max(2, _ENOUGH // n), *([] if most is None else [most // n]))
    reference = problem.reference(seed, n_sets * n)
    flat = _compared(problem, reference)
    rng = seeds.generator(seed, "directions")
    prior = problem.posterior.prior
    return _Exact(
        sets=np.split(flat, n_sets),
        flat=flat,
        directions=distribution.random_directions(rng, _DIRECTIONS, flat.shape[1]),
        off=_off_manifold(prior, reference),
        log_density=_log_density(problem, reference),
        shares=_shares(prior, reference),
    )


def _against_reference(problem: Problem, positions: np.ndarray, seed: int) -> dict[str, float]:
    flat = _compared(problem, positions)
    # Of many draws as many are judged, evenly apart, as two sets of reference draws can have.
    most = problem.most_reference
    n = len(flat) if most is None else min(len(flat), most // 2)
    some = flat[np.arange(n) * len(flat) // n]
    exact = _exact_draws(problem, seed, n)
    prior = problem.posterior.prior
    found = {
        "swd_ratio": distribution.sliced_wasserstein_ratio(some, exact.sets, exact.directions),
        "variance_ratio": float(distribution.trace_ratio(flat, exact.flat)),
        "mean_error_sd": float(distribution.mean_error(flat, exact.flat)),
    }
    off = _off_manifold(prior, positions)
    if off is not None and exact.off is not None:
        found["off_manifold_ratio"] = off / exact.off
    log_density = _log_density(problem, positions)
    if log_density is not None and exact.log_density is not None:
        found["log_density_gap"] = log_density - exact.log_density
    shares = _shares(prior, positions)
    if shares:
        found |= {f"mode_proportion_{style}": share for style, share in shares.items()}
        apart = [abs(share - exact.shares[style]) for style, share in shares.items()]
        found["mode_proportions_tv"] = 0.5 * sum(apart)
    found["precision"], found["recall"] = distribution.precision_recall(some, exact.sets[0])
    found["mmd"] = maximum_mean_discrepancy(some, exact.sets[0])
    found["c2st"] = classifier_two_sample(some, exact.sets[0], seed)
    return found


def _compared(problem: Problem, motions: np.ndarray) -> np.ndarray:
    """Return what of motions is compared with that of reference draws: (n, L J 3)."""
    if problem.aligned_to is not None:
        motions = align_motions(motions, problem.aligned_to)
    return motions.reshape(len(motions), -1)


def _against_density(problem: Problem, draws: MotionDraws) -> dict[str, float]:
    if "theta" not in draws.dataset:
        return {}
    theta = draws.dataset["theta"].values
    theta = theta.reshape(-1, theta.shape[-1])
    n = min(len(theta), _OF_DENSITY)
    chosen = theta[np.arange(n) * len(theta) // n]
    try:
        score = score_of(problem.posterior, chosen)
    except NoGradient:
        return {}
    try:
        return {"ksd": kernel_stein_discrepancy(chosen, score)}
    except ValueError:
        # More than half of the draws are one, or the density has no slope where they are.
        return {"ksd": math.nan}


def _against_real_views(
    reference: ScoresGeneration, positions: np.ndarray, seed: int
) -> dict[str, float]:
    samples = len(positions)
    around = reference.score_motions(positions, seed=seed, samples=samples)
    side = reference.score_motions(positions, seed=seed, samples=samples, angles="side")
    pairs = seeds.generator(seed, "real pairs")
    real = diversity(reference.held_out_features, pairs, _REAL_PAIRS)
    found = {
        "fid": around["fid"][0],
        "diversity_ratio": around["diversity"][0] / real,
        "view_precision": around["precision"][0],
        "view_recall": around["recall"][0],
        "fid_side": side["fid"][0],
        "view_recall_side": side["recall"][0],
    }
    if reference.learnt_features is not None:
        again = reference.of_learnt().score_motions(positions, seed=seed, samples=samples)
        found["fid_learnt"] = again["fid"][0]
        found["view_recall_learnt"] = again["recall"][0]
    if reference.held_out_views is not None:
        found["mcd_cm2"] = _SQUARE_CENTIMETRES * reference.chamfer(positions, seed=seed).mean
    return found


def _off_manifold(prior: object, positions: np.ndarray) -> float | None:
    if not isinstance(prior, HasManifold):
        return None
    return float(prior.off_manifold(positions).mean())


def _log_density(problem: Problem, positions: np.ndarray) -> float | None:
    value = problem.log_density_of(positions)
    return None if value is None else float(np.mean(value))


def _shares(prior: object, positions: np.ndarray) -> dict[str, float]:
    if not isinstance(prior, HasStyles):
        return {}
    shares = prior.style_responsibilities(positions).mean(axis=0)
    return {style: float(share) for style, share in zip(prior.styles, shares, strict=True)}


def _coverage_of(positions: np.ndarray, held_out: np.ndarray) -> dict[str, float]:
    from probmotion.interaction.geometry.pose_distances import MEASURES
    from probmotion.metrics.coverage import coverage

    # Poses are compared one by one, whatever motion they are a frame of.
    poses, draws = (motions.reshape(-1, *motions.shape[-2:]) for motions in (held_out, positions))
    return {f"coverage_{kind}": float(coverage(poses, draws, kind)) for kind in MEASURES}


def _degenerate(problem: Problem, positions: np.ndarray) -> dict[str, float]:
    likelihood = problem.posterior.likelihood
    counted = getattr(likelihood, "degenerate_fraction", None)
    if counted is None:
        return {}
    return {"degenerate": float(counted(positions[:: max(1, len(positions) // _LOOKED_AT)]))}


def accuracy_of(
    positions: np.ndarray, truth: np.ndarray, posterior: MotionPosterior
) -> dict[str, float]:
    """Return errors against the truth, millimetres (accelerations: m/s²).

    - ``mpjpe``: after aligning the root in every frame, mean over draws: what to expect of one
    - ``mpjpe_mean``: of the mean of all draws; ``mpjpe_best``: of the best draw
    - ``mpjpe_visible``, ``mpjpe_occluded``: like ``mpjpe``, where the evidence saw the joint or not
    - ``g_mpjpe``, ``g_mpjpe_mean`` and each with ``_visible``, ``_hidden``: without alignment
    - ``pa_mpjpe``: after the best similarity per frame
    - ``acceleration_error``: mean over draws; ``acceleration_ratio``: mean size of a draw's over
      the truth's, where that has any; plausible between a half and two
    """
    root = posterior.skeleton.roots[0]
    target = accuracy.aligned_by_root(truth, root)
    errors = accuracy.joint_errors(accuracy.aligned_by_root(positions, root), target)
    middle = accuracy.aligned_by_root(positions.mean(axis=0), root)
    per_draw = accuracy.mean_over(errors)
    far = accuracy.joint_errors(positions, truth)
    far_mean = accuracy.joint_errors(positions.mean(axis=0), truth)
    metres = {
        "mpjpe": per_draw.mean(),
        "mpjpe_mean": accuracy.joint_errors(middle, target).mean(),
        "mpjpe_best": per_draw.min(),
    }
    metres |= {"g_mpjpe": far.mean(), "g_mpjpe_mean": far_mean.mean()}
    seen = _visible(posterior)
    if seen is not None and not seen.all() and seen.any():
        for where, mask in (("visible", seen), ("occluded", ~seen)):
            metres[f"mpjpe_{where}"] = accuracy.mean_over(errors, mask).mean()
            metres[f"g_mpjpe_{where}"] = accuracy.mean_over(far, mask).mean()
            metres[f"g_mpjpe_mean_{where}"] = accuracy.mean_over(far_mean, mask)
    nearest = accuracy.aligned_by_similarity(positions, truth)
    metres["pa_mpjpe"] = accuracy.joint_errors(nearest, truth).mean()
    found = {f"{name}_mm": float(value) * _MILLIMETRES for name, value in metres.items()}
    if len(truth) >= 3:
        bend = accuracy.acceleration_error(positions, truth, posterior.fps)
        found["acceleration_error"] = float(bend.mean())
        if np.diff(truth, 2, axis=0).any():
            found["acceleration_ratio"] = float(
                accuracy.acceleration_ratio(positions, truth).mean()
            )
    return found


def _in_pictures(
    positions: np.ndarray, truth: np.ndarray, posterior: MotionPosterior
) -> dict[str, float]:
    if not isinstance(posterior.likelihood, Keypoints2D):
        return {}
    cameras = posterior.likelihood.cameras
    true = cameras.project(truth)
    try:
        shown = cameras.project(positions)
    except ValueError:
        return {"pck": math.nan, "velocity_error": math.nan}
    true = np.broadcast_to(true, shown.shape)
    found = {}
    # One joint in one frame has no size to compare errors with.
    if np.ptp(true, axis=(-3, -2)).any(axis=-1).all():
        size = keypoints.image_extent(true)
        found["pck"] = keypoints.percentage_of_correct_keypoints(shown, true, size)
    if np.diff(true, axis=-3).any():
        found["velocity_error"] = keypoints.velocity_error(shown, true)
    return found


def _visible(posterior: MotionPosterior) -> np.ndarray | None:
    """Where any view saw the joint, (L, J); None where the likelihood does not say."""
    entries = getattr(posterior.likelihood, "entries", None)
    if entries is None:
        return None
    shape = (math.prod(entries.visible.shape[:-2]), *entries.visible.shape[-2:])
    return entries.visible.reshape(shape).any(axis=0)


def load_libraries() -> None:
    """Import what measures import when they are first asked, so that no cell's clock counts it."""
    for name in _LATE:
        import_module(name)
