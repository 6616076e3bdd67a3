"""Tests of the bias of multi-view samplers on mixtures fitted to gaits and real clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probmotion import MotionPosterior, seeds
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.io.files import load_all
from probmotion.metrics.distribution import random_directions, sliced_wasserstein_ratio, trace_ratio
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.retargeting import common_skeleton
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector

REAL_CLIPS = Path(__file__).parents[3].parent / "shared" / "data" / "cmu_single"
DRAWS = 300
SEEDS = 10


def gaits():
    proportions = {"walk": 0.5, "run": 0.3, "march": 0.2}
    clips = make_gaits(300, styles=proportions)
    labels = [clip.name.rpartition("-")[0] for clip in clips]
    return GaussianMixtureMotion.fit(
        clips, 30, styles=labels, weights=[proportions[style] for style in sorted(proportions)]
    )


def real_clips():
    if not REAL_CLIPS.is_dir():
        pytest.skip(f"no real clips at {REAL_CLIPS.name}/ beside the repository")
    clips = load_all(str(REAL_CLIPS / "*.npz"))
    shared = common_skeleton([clip.skeleton for clip in clips])
    return GaussianMixtureMotion.fit([clip.retarget(shared) for clip in clips], 30)


def metrics(prior, sampler, run_seeds, n=DRAWS):
    """Return the metrics of ``n`` draws for each seed, compared with exact draws: (seeds,) each."""
    exact = prior.sample(seeds.generator(0, "exact"), 8 * n).reshape(8, n, -1)
    directions = random_directions(seeds.generator(0, "directions"), 256, exact.shape[-1])
    rows = []
    for seed in run_seeds:
        draws = sampler.sample(MotionPosterior(prior), draws=n, seed=seed, progress=False)
        X, flat = draws.flat(), draws.flat().reshape(n, -1)
        rows.append(
            {
                "swd_ratio": sliced_wasserstein_ratio(flat, list(exact), directions),
                "off_manifold_ratio": prior.off_manifold(X).mean(),
                "variance_ratio": trace_ratio(flat, exact.reshape(8 * n, -1)),
                "calls": draws.counts["denoiser"] / n,
            }
        )
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


# Calls per draw: 97 predictor and 61 corrector steps of 3 views, and 95 steps of 5 views.
EQUAL_COST = (MultiViewPredictorCorrector(), MultiViewAncestral(steps=95))


def test_mvpc_is_more_accurate_than_mas_on_a_few_draws():
    """This is the fast version of the slow test below, in reduced coordinates.

    The margin is within the spread of MAS over seeds, so that two seeds are averaged.
    """
    reduced, _ = gaits().reduced()
    mvpc, mas = (metrics(reduced, sampler, [0, 1], 100) for sampler in EQUAL_COST)
    assert set(mvpc["calls"]) == {474}
    assert set(mas["calls"]) == {475}
    for name in ("swd_ratio", "off_manifold_ratio", "variance_ratio"):
        gaps = [abs(np.log(values[name].mean())) for values in (mvpc, mas)]
        assert gaps[0] < gaps[1] - 0.1, name


@pytest.mark.slow
@pytest.mark.parametrize("make", [gaits, real_clips])
def test_mvpc_is_more_accurate_than_mas_at_equal_cost(make):
    """The test compares |log| of mean ratios with 99 % intervals by resampling the seeds."""
    prior = make()
    mvpc, mas = (metrics(prior, sampler, range(SEEDS)) for sampler in EQUAL_COST)
    resampled = seeds.generator(0, "resampled").integers(SEEDS, size=(20_000, SEEDS))
    for name in ("swd_ratio", "off_manifold_ratio", "variance_ratio"):
        gaps = [abs(np.log(values[name][resampled].mean(axis=1))) for values in (mas, mvpc)]
        assert np.quantile(gaps[0] - gaps[1], 0.005) > 0, name
