"""Tests of SyncTweedies and StochSync."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probmotion import MotionPosterior
from probmotion.samplers import MultiViewAncestral
from probmotion.samplers.diffusion import DDIM, StochSync, SyncTweedies
from probmotion.samplers.diffusion.views import view_sets


def test_sync_tweedies_is_mas_with_deterministic_steps(gaussian):
    posterior = MotionPosterior(gaussian)
    draws = SyncTweedies(steps=8, elevation=math.pi / 16).sample(posterior, draws=3, progress=False)
    mas = MultiViewAncestral(steps=8, integrator=DDIM()).sample(posterior, draws=3, progress=False)
    np.testing.assert_array_equal(draws.flat(), mas.flat())
    assert draws.counts == {"denoiser": 8 * 5 * 3}


def test_stochastic_synchronisation_has_the_exact_variance(gaussian_motion, assert_covariance):
    """For an isotropic prior, views agree and each level is a linear map with new noise."""
    prior = gaussian_motion(np.zeros((1, 2, 3)), 0.3 * np.eye(6))
    sampler = StochSync(steps=6, ode_steps=3)
    schedule, variance = sampler.schedule, 0.0
    for t in range(6, 0, -1):
        gain = 1.0
        below = np.geomspace(schedule.sigma(t), schedule.sigma(1), 3)
        for now, after in zip(below, [*below[1:], 0.0], strict=True):
            shrink = 0.3 / (0.3 + now**2)
            gain *= shrink + after / now * (1 - shrink)
        variance = gain**2 * (variance + schedule.sigma(t) ** 2)
    draws = sampler.sample(MotionPosterior(prior), draws=6000, seed=2, progress=False)
    assert_covariance(draws.flat(), variance * np.eye(6))
    assert draws.counts == {"denoiser": 6 * 3 * 3 * 6000}
    with pytest.raises(AssertionError, match="of the limit"):
        assert_covariance(draws.flat(), 0.3 * np.eye(6))


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
