"""Tests of `Ancestral2D`: exact mean and covariance, reproducibility."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, MotionPosterior, NoiseSchedule, UnsupportedPosterior
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D

DEFAULT = Cameras.ring(1, elevation=math.pi / 16)


def projected(prior, camera):
    """Return the mean and covariance of a Gaussian in a view, metres."""
    rows = np.kron(np.eye(prior.dim // 3), camera.image_axes[0])
    return rows @ prior.mean.ravel(), rows @ prior.covariance @ rows.T


def after_all_steps(prior, camera, schedule):
    """Return the exact mean and covariance of the draws, metres."""
    true_mean, true = projected(prior, camera)
    true_mean, true = true_mean / prior.scale, true / prior.scale**2
    identity = np.eye(len(true))
    mean, covariance = np.zeros(len(true)), identity
    for t in range(schedule.steps, 0, -1):
        alpha_bar, step = schedule.alpha_bar[t], schedule.posterior(t)
        gain = math.sqrt(alpha_bar) * np.linalg.solve(
            alpha_bar * true + (1 - alpha_bar) * identity, true
        )
        move = step.clean * gain + step.noisy * identity
        shift = step.clean * (true_mean - math.sqrt(alpha_bar) * gain @ true_mean)
        mean = move @ mean + shift
        covariance = move @ covariance @ move.T + step.deviation**2 * identity
    return mean * prior.scale, covariance * prior.scale**2


def test_many_steps_converge_to_the_projected_prior(gaussian):
    mean, covariance = projected(gaussian, DEFAULT)
    gaps = []
    for T in (250, 500, 1000):
        got_mean, got = after_all_steps(gaussian, DEFAULT, NoiseSchedule.cosine(T))
        assert abs(got_mean - mean).max() < 3 / T
        gaps.append(abs(got - covariance).max())
    # The error decreases as 1/T.
    assert gaps[0] / gaps[1] == pytest.approx(2, rel=0.1)
    assert gaps[1] / gaps[2] == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize("camera", [None, Cameras.around([1.1], [-0.4])], ids=["default", "other"])
def test_draws_have_the_exact_mean_and_covariance(gaussian, assert_covariance, camera):
    sampler = Ancestral2D(steps=12)
    views = sampler.sample_views(
        MotionPosterior(gaussian), draws=8000, seed=3, camera=camera, progress=False
    )
    assert views.shape == (8000, 2, 2, 2)
    mean, covariance = after_all_steps(gaussian, camera or DEFAULT, sampler.schedule)
    flat = views.reshape(8000, -1)
    error = np.sqrt(np.diag(covariance) / 8000)
    assert (abs(flat.mean(axis=0) - mean) < 5 * error).all()
    assert_covariance(flat - mean, covariance)
    # Negative control: another view.
    _, elsewhere = after_all_steps(gaussian, Cameras.around([2.5], [0.9]), sampler.schedule)
    with pytest.raises(AssertionError, match="of the limit"):
        assert_covariance(flat - mean, elsewhere)


def test_a_draw_depends_only_on_its_seed_and_number(gaussian):
    posterior, sampler = MotionPosterior(gaussian), Ancestral2D(steps=6)
    whole = sampler.sample_views(posterior, draws=7, seed=2, progress=True)
    small = replace(sampler, batch=2).sample_views(posterior, draws=4, seed=2, progress=False)
    np.testing.assert_allclose(small, whole[:4], atol=1e-12)
    other = sampler.sample_views(posterior, draws=7, seed=3, progress=False)
    assert abs(other - whole).min() > 0


def test_invalid_arguments(gaussian, mute):
    sampler, posterior = Ancestral2D(), MotionPosterior(gaussian)
    with pytest.raises(ValueError, match="camera must have one view, got 2"):
        sampler.sample_views(posterior, draws=1, camera=Cameras.ring(2))
    with pytest.raises(ValueError, match="draws must be an integer of at least 1, got 0"):
        sampler.sample_views(posterior, draws=0, progress=False)
    with pytest.raises(UnsupportedPosterior, match="needs a prior with Denoises2D, got Mute"):
        sampler.sample_views(MotionPosterior(mute()), draws=1)
