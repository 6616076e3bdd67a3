"""Tests of SyncTweedies and StochSync."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probmotion import Joints3D, MotionPosterior
from probmotion.samplers import MultiViewAncestral
from probmotion.samplers.diffusion import DDIM, StochSync, SyncTweedies
from probmotion.samplers.diffusion.views import view_sets


def test_sync_tweedies_is_mas_with_deterministic_steps(gaussian):
    posterior = MotionPosterior(gaussian)
    draws = SyncTweedies(steps=8, elevation=math.pi / 16).sample(posterior, draws=3, progress=False)
    mas = MultiViewAncestral(steps=8, integrator=DDIM()).sample(posterior, draws=3, progress=False)
    np.testing.assert_array_equal(draws.flat(), mas.flat())
    assert draws.counts == {"denoiser": 8 * 5 * 3}


VARIANCE = 0.3  # of an isotropic prior, for which views agree and every level is linear
SEEN = 0.8  # both joints, as one further view of each axis beside two of the sampler


def isotropic(gaussian_motion, observed):
    prior = gaussian_motion(np.zeros((1, 2, 3)), VARIANCE * np.eye(6))
    seen = Joints3D(np.full((1, 2, 3), SEEN), noise=0.1) if observed else None
    return MotionPosterior(prior, seen)


def assert_moments(drawn, mean, variance, assert_covariance):
    assert_covariance(drawn - mean, variance * np.eye(6))
    assert drawn.mean() == pytest.approx(mean, abs=5 * math.sqrt(variance / drawn.size))


@pytest.mark.parametrize("observed", [False, True])
def test_deterministic_synchronisation_is_linear(gaussian_motion, assert_covariance, observed):
    weight = 1 / 3 if observed else 0.0
    sampler = SyncTweedies(steps=6)
    mean, gain = 0.0, 1 / math.sqrt(sampler.schedule.alpha_bar[6])
    for t in range(6, 0, -1):
        sigma = sampler.schedule.sigma(t)
        ratio = sampler.schedule.sigma(t - 1) / sigma if t > 1 else 0.0
        shrink = (1 - weight) * VARIANCE / (VARIANCE + sigma**2)
        gain *= ratio + (1 - ratio) * shrink
        mean = ratio * mean + (1 - ratio) * (shrink * mean + weight * SEEN)
    posterior = isotropic(gaussian_motion, observed)
    drawn = sampler.sample(posterior, draws=6000, progress=False).flat()
    assert_moments(drawn, mean, gain**2, assert_covariance)


@pytest.mark.parametrize("observed", [False, True])
def test_stochastic_synchronisation_is_linear(gaussian_motion, assert_covariance, observed):
    weight = 1 / 3 if observed else 0.0
    sampler = StochSync(steps=6, ode_steps=3)
    schedule, mean, variance = sampler.schedule, 0.0, 0.0
    for t in range(6, 0, -1):
        gain = 1 - weight
        below = np.geomspace(schedule.sigma(t), schedule.sigma(1), 3)
        for now, after in zip(below, [*below[1:], 0.0], strict=True):
            shrink = VARIANCE / (VARIANCE + now**2)
            gain *= shrink + after / now * (1 - shrink)
        mean = gain * mean + weight * SEEN
        variance = gain**2 * (variance + schedule.sigma(t) ** 2)
    draws = sampler.sample(isotropic(gaussian_motion, observed), draws=6000, seed=2, progress=False)
    assert_moments(draws.flat(), mean, variance, assert_covariance)
    assert draws.counts == {"denoiser": 6 * 3 * 3 * 6000}
    with pytest.raises(AssertionError, match="of the limit"):
        assert_covariance(draws.flat() - mean, VARIANCE * np.eye(6))


def test_learnt_denoisers_have_rings_of_views(gaussian):
    class Learnt(type(gaussian)):
        view_elevation = 0.3

    learnt = Learnt(gaussian.mean, gaussian.covariance)
    sets = view_sets(learnt, 3, None, rings=5)
    forward = np.concatenate([views.cameras.rotation[:, 2] for views in sets])
    np.testing.assert_allclose(forward[:, 1], -math.sin(0.3))
    assert len(np.unique(forward.round(9), axis=0)) == 15
    for views in sets:
        np.testing.assert_allclose(views.gram, sets[0].gram, atol=1e-12)
    assert len(view_sets(learnt, 3, None)) == len(view_sets(gaussian, 3, 0.1)) == 1


def test_exact_denoisers_have_views_over_the_sphere(gaussian):
    sets = view_sets(gaussian, 5, None)
    forward = np.concatenate([views.cameras.rotation[:, 2] for views in sets])
    cosines = abs(forward @ forward.T)
    # Angles between the two-fold axes of an icosahedron: 90°, 72°, 60° and 36°.
    expected = np.cos(np.radians([90, 72, 60, 36, 0]))
    np.testing.assert_allclose(np.unique(cosines.round(6)), np.sort(expected), atol=1e-5)
    assert len(forward) == 15
    assert (cosines > 0.999).sum() == 15
    for views in sets:
        np.testing.assert_allclose(views.gram, 2 * np.eye(3), atol=1e-12)
