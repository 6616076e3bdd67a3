"""Ancestral sampling of one view: its exact mean and covariance, the names of draws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, MotionPosterior, NoiseSchedule, UnsupportedPosterior
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D

DEFAULT = Cameras.ring(1, elevation=math.pi / 16)


def seen(prior, camera):
    """Mean and covariance of what the camera sees of a Gaussian, metres."""
    rows = np.kron(np.eye(prior.dim // 3), camera.image_axes[0])
    return rows @ prior.mean.ravel(), rows @ prior.covariance @ rows.T


def after_all_steps(prior, camera, schedule):
    """Mean and covariance of the draws, step by step in closed form: no Monte Carlo."""
    true_mean, true = seen(prior, camera)
    true_mean, true = true_mean / prior.scale, true / prior.scale**2
    identity = np.eye(len(true))
    mean, covariance = np.zeros(len(true)), identity
    for t in range(schedule.steps, 0, -1):
        alpha_bar, step = schedule.alpha_bar[t], schedule.posterior(t)
        gain = math.sqrt(alpha_bar) * np.linalg.solve(
            alpha_bar * true + (1 - alpha_bar) * identity, true
        )
        move = step.clean * gain + step.noisy * identity
        still = step.clean * (true_mean - math.sqrt(alpha_bar) * gain @ true_mean)
        mean = move @ mean + still
        covariance = move @ covariance @ move.T + step.deviation**2 * identity
    return mean * prior.scale, covariance * prior.scale**2


def test_many_steps_draw_the_projected_prior(lively):
    mean, covariance = seen(lively, DEFAULT)
    gaps = []
    for T in (250, 500, 1000):
        got_mean, got = after_all_steps(lively, DEFAULT, NoiseSchedule.cosine(T))
        assert abs(got_mean - mean).max() < 3 / T
        gaps.append(abs(got - covariance).max())
    # The error falls as 1/T.
    assert gaps[0] / gaps[1] == pytest.approx(2, rel=0.1)
    assert gaps[1] / gaps[2] == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize("camera", [None, Cameras.around([1.1], [-0.4])], ids=["default", "other"])
def test_drawn_views_have_the_exact_mean_and_covariance(lively, covariance_is, camera):
    sampler = Ancestral2D(steps=12)
    views = sampler.sample_views(
        MotionPosterior(lively), draws=8000, seed=3, camera=camera, progress=False
    )
    assert views.shape == (8000, 2, 2, 2)
    mean, covariance = after_all_steps(lively, camera or DEFAULT, sampler.schedule)
    flat = views.reshape(8000, -1)
    error = np.sqrt(np.diag(covariance) / 8000)
    assert (abs(flat.mean(axis=0) - mean) < 5 * error).all()
    covariance_is(flat - mean, covariance)
    # The comparison can fail: another camera sees another motion.
    _, elsewhere = after_all_steps(lively, Cameras.around([2.5], [0.9]), sampler.schedule)
    with pytest.raises(AssertionError, match="of the limit"):
        covariance_is(flat - mean, elsewhere)


def test_draws_depend_on_their_names_alone(lively):
    posterior, sampler = MotionPosterior(lively), Ancestral2D(steps=6)
    whole = sampler.sample_views(posterior, draws=7, seed=2, progress=False)
    bars = sampler.sample_views(posterior, draws=7, seed=2, progress=True)
    np.testing.assert_array_equal(bars, whole)
    small = replace(sampler, batch=2).sample_views(posterior, draws=7, seed=2, progress=False)
    np.testing.assert_allclose(small, whole, atol=1e-12)
    fewer = sampler.sample_views(posterior, draws=4, seed=2, progress=False)
    np.testing.assert_allclose(fewer, whole[:4], atol=1e-12)
    other = sampler.sample_views(posterior, draws=7, seed=3, progress=False)
    assert abs(other - whole).min() > 0


def test_levels_are_strided_from_the_longer_schedule():
    sampler = Ancestral2D(steps=20, trained_steps=100, schedule_power=4)
    wanted = NoiseSchedule.cosine(100, power=4).alpha_bar[::5]
    np.testing.assert_array_equal(sampler.schedule.alpha_bar, wanted)


def test_what_does_not_fit_is_refused_in_a_sentence(lively):
    evidence = MotionPosterior(lively, Joints3D(lively.mean, noise=0.1))
    with pytest.raises(UnsupportedPosterior, match=r"place for evidence; .*mas, .*mvpc.* would do"):
        Ancestral2D().sample_views(evidence, draws=1)
    with pytest.raises(ValueError, match="camera has 2 views, expected one"):
        Ancestral2D().sample_views(MotionPosterior(lively), draws=1, camera=Cameras.ring(2))
    for wrong in (0, 2.5):
        with pytest.raises(ValueError, match=r"draws must be an integer of at least 1, got .*"):
            Ancestral2D().sample_views(MotionPosterior(lively), draws=wrong, progress=False)
    with pytest.raises(ValueError, match="steps must be at most the schedule's 100, got 200"):
        Ancestral2D(steps=200, trained_steps=100)
    with pytest.raises(ValueError, match="batch must be an integer of at least 1, got 0"):
        Ancestral2D(batch=0)

    class Flat:
        skeleton, frames, fps, dim = lively.skeleton, 2, 20.0, 12

        def motion(self, theta):
            return theta

    with pytest.raises(UnsupportedPosterior, match="needs a prior with Denoises2D, which Flat is"):
        Ancestral2D().sample_views(MotionPosterior(Flat()), draws=1)
