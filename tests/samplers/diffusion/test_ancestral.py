"""Tests of `Ancestral2D` and `Ancestral3D`: exact moments, agreement with diffusers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, MotionPosterior, NoiseSchedule, UnsupportedPosterior
from probmotion.samplers import Ancestral3D
from probmotion.samplers.diffusion.ancestral import ancestral
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.integrators import DDPM
from probmotion.samplers.diffusion.noise_levels import Cosine
from probmotion.samplers.diffusion.states import MotionState
from probmotion.samplers.diffusion.views import MotionDenoiser
from probmotion.seeds import NormalStreams

DEFAULT = Cameras.ring(1, elevation=math.pi / 16)


def exact_moments(prior, schedule, axes):
    """Return the exact mean and covariance of the draws along the image axes, metres."""
    rows = np.kron(np.eye(prior.dim // 3), axes)
    true_mean = rows @ prior.mean.ravel() / prior.scale
    true = rows @ prior.covariance @ rows.T / prior.scale**2
    identity = np.eye(len(true))
    mean, covariance = np.zeros(len(true)), identity
    for t in range(schedule.steps, 0, -1):
        alpha_bar, step = schedule.alpha_bar[t], schedule.posterior(t)
        noisy = alpha_bar * true + (1 - alpha_bar) * identity
        gain = math.sqrt(alpha_bar) * np.linalg.solve(noisy, true)
        transition = step.clean * gain + step.noisy * identity
        shift = step.clean * (true_mean - math.sqrt(alpha_bar) * gain @ true_mean)
        mean = transition @ mean + shift
        covariance = transition @ covariance @ transition.T + step.deviation**2 * identity
    return mean * prior.scale, covariance * prior.scale**2


@pytest.mark.parametrize("camera", [None, Cameras.around([1.1], [-0.4])], ids=["default", "other"])
def test_views_have_the_exact_moments(gaussian, assert_covariance, camera):
    sampler = Ancestral2D(steps=12)
    views = sampler.sample_views(
        MotionPosterior(gaussian), draws=8000, seed=3, camera=camera, progress=False
    )
    assert views.shape == (8000, 2, 2, 2)
    axes = (camera or DEFAULT).image_axes[0]
    mean, covariance = exact_moments(gaussian, sampler.schedule, axes)
    flat = views.reshape(8000, -1)
    assert (abs(flat.mean(axis=0) - mean) < 5 * np.sqrt(np.diag(covariance) / 8000)).all()
    assert_covariance(flat - mean, covariance)
    # As a negative control, use another view.
    axes = Cameras.around([2.5], [0.9]).image_axes[0]
    with pytest.raises(AssertionError, match="of the limit"):
        assert_covariance(flat - mean, exact_moments(gaussian, sampler.schedule, axes)[1])


@pytest.mark.parametrize("power", [2, 4])
def test_motions_have_the_exact_moments(gaussian, assert_covariance, power):
    sampler = Ancestral3D(steps=10, levels=Cosine(power=power), integrator=DDPM())
    draws = sampler.sample(MotionPosterior(gaussian), draws=8000, seed=1, progress=False)
    assert draws.counts == {"denoiser": 80_000}
    assert draws.independent
    mean, covariance = exact_moments(gaussian, sampler.schedule, np.eye(3))
    flat = draws.flat().reshape(8000, -1) - mean
    assert (abs(flat.mean(axis=0)) < 5 * np.sqrt(np.diag(covariance) / 8000)).all()
    assert_covariance(flat, covariance)
    # As a negative control, compare with infinitely many steps.
    with pytest.raises(AssertionError, match="of the limit"):
        assert_covariance(flat, gaussian.covariance)


def test_steps_agree_with_diffusers(gaussian):
    torch = pytest.importorskip("torch")
    schedulers = pytest.importorskip("diffusers.schedulers")
    steps = 12
    schedule = NoiseSchedule.cosine(steps)
    oracle = schedulers.DDPMScheduler(
        num_train_timesteps=steps,
        trained_betas=1 - schedule.alpha_bar[1:] / schedule.alpha_bar[:-1],
        prediction_type="sample",
        variance_type="fixed_small",
        clip_sample=False,
    )
    oracle.alphas_cumprod = torch.tensor(schedule.alpha_bar[1:])
    recorded = []
    denoiser = MotionDenoiser(gaussian)
    state = MotionState([denoiser], schedule, (2, 2, 3))
    streams = NormalStreams([np.random.default_rng(0)])
    result = ancestral(
        state, streams, lambda: None, DDPM(), watch=lambda *pair: recorded.append(pair)
    )
    transitions, noises = zip(*recorded, strict=True)

    x = torch.tensor(noises[0])
    for t in range(steps, 0, -1):
        clean = denoiser.denoise(x.numpy(), schedule.alpha_bar[t])
        estimate = transitions[steps - t + 1].estimate if t > 1 else result
        np.testing.assert_allclose(clean, estimate, atol=1e-6)
        # diffusers draws the noise itself: solve for its mean and deviation from two seeds.
        samples, noise = [], []
        for seed in (0, 1):
            first, second = (torch.Generator().manual_seed(seed) for _ in range(2))
            samples.append(oracle.step(torch.tensor(clean), t - 1, x, generator=first).prev_sample)
            noise.append(torch.randn(x.shape, generator=second, dtype=x.dtype))
        deviation = ((samples[0] - samples[1]) / (noise[0] - noise[1])).mean()
        mean = samples[0] - deviation * noise[0]
        if t > 1:
            assert float(deviation) == pytest.approx(schedule.posterior(t).deviation, rel=1e-5)
            x = mean + deviation * torch.tensor(noises[steps - t + 1])
        else:
            np.testing.assert_allclose(mean, result, atol=1e-6)


def test_noise_levels_match_the_schedule():
    schedule = NoiseSchedule.cosine(10)
    for t in range(1, 11):
        assert 1 / (1 + schedule.sigma(t) ** 2) == pytest.approx(schedule.alpha_bar[t])


def test_a_view_depends_only_on_its_seed_and_number(gaussian):
    posterior, sampler = MotionPosterior(gaussian), Ancestral2D(steps=6)
    views = sampler.sample_views(posterior, draws=7, seed=2)
    subset = replace(sampler, batch=2).sample_views(posterior, draws=4, seed=2, progress=False)
    np.testing.assert_allclose(subset, views[:4], atol=1e-12)
    other = sampler.sample_views(posterior, draws=7, seed=3, progress=False)
    assert abs(other - views).min() > 0


def test_invalid_arguments_of_views(gaussian, minimal):
    sampler, posterior = Ancestral2D(), MotionPosterior(gaussian)
    with pytest.raises(ValueError, match="camera must have one view, got 2"):
        sampler.sample_views(posterior, draws=1, camera=Cameras.ring(2))
    with pytest.raises(ValueError, match="draws must be an integer of at least 1, got 0"):
        sampler.sample_views(posterior, draws=0, progress=False)
    with pytest.raises(UnsupportedPosterior, match="needs a prior with Denoises2D, got Minimal"):
        sampler.sample_views(MotionPosterior(minimal()), draws=1)
