"""Tests of `Ancestral3D`: exact covariance of finitely many steps, agreement with diffusers."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import MotionPosterior, NoiseSchedule
from probmotion.samplers import Ancestral3D
from probmotion.samplers.diffusion.ancestral import MotionState, ancestral
from probmotion.samplers.diffusion.views import MotionDenoiser
from probmotion.seeds import NormalStreams


def ancestral_covariance(covariance, schedule):
    """Return the exact covariance after all steps on N(0, covariance)."""
    true, axes = np.linalg.eigh(covariance)
    value = np.ones_like(true)
    for t in range(schedule.steps, 0, -1):
        alpha_bar, step = schedule.alpha_bar[t], schedule.posterior(t)
        shrink = np.sqrt(alpha_bar) * true / (alpha_bar * true + 1 - alpha_bar)
        value = (step.clean * shrink + step.noisy) ** 2 * value + step.deviation**2
    return (axes * value) @ axes.T


@pytest.mark.parametrize("power", [2, 4])
def test_draws_have_the_exact_covariance(gaussian, assert_covariance, power):
    sampler = Ancestral3D(steps=10, schedule_power=power)
    draws = sampler.sample(MotionPosterior(gaussian), draws=8000, seed=1, progress=False)
    assert draws.counts == {"denoiser": 80_000}
    assert draws.independent
    expected = ancestral_covariance(gaussian.covariance / gaussian.scale**2, sampler.schedule)
    assert_covariance(draws.flat() - gaussian.mean, expected * gaussian.scale**2)
    # Negative control: infinitely many steps.
    with pytest.raises(AssertionError, match="of the limit"):
        assert_covariance(draws.flat() - gaussian.mean, gaussian.covariance)


def test_many_steps_converge_to_the_prior(gaussian):
    true = gaussian.covariance
    found = [ancestral_covariance(true, NoiseSchedule.cosine(T)) for T in (500, 1000, 2000)]
    gaps = [abs(covariance - true).max() for covariance in found]
    assert gaps[2] < 5e-3
    # The error decreases as 1/T.
    assert gaps[0] / gaps[1] == pytest.approx(2, rel=0.05)
    assert gaps[1] / gaps[2] == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize(
    ("variance", "steps", "ratio"), [(1.0, 100, 0.955), (1.0, 1000, 0.995), (0.0137, 100, 0.79)]
)
def test_limit_6_finitely_many_steps_shrink_variance(variance, steps, ratio):
    found = ancestral_covariance(variance * np.eye(1), NoiseSchedule.cosine(steps)) / variance
    assert found[0, 0] == pytest.approx(ratio, abs=6e-3 if variance < 1 else 6e-4)


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
    estimates, noises = [], []

    def watch(clean, noise):
        estimates.append(clean)
        noises.append(noise)

    denoiser = MotionDenoiser(gaussian)
    state = MotionState(denoiser, schedule, (2, 2, 3))
    streams = NormalStreams([np.random.default_rng(0)])
    found = ancestral(state, streams, lambda: None, watch=watch)

    x = torch.tensor(noises[0])
    for t in range(steps, 0, -1):
        clean = denoiser.denoise(x.numpy(), schedule.alpha_bar[t])
        np.testing.assert_allclose(clean, estimates[steps - t + 1], atol=1e-6)
        # diffusers draws the noise itself: solve for its mean and deviation from two seeds.
        got, unit = [], []
        for seed in (0, 1):
            first, second = (torch.Generator().manual_seed(seed) for _ in range(2))
            got.append(oracle.step(torch.tensor(clean), t - 1, x, generator=first).prev_sample)
            unit.append(torch.randn(x.shape, generator=second, dtype=x.dtype))
        deviation = ((got[0] - got[1]) / (unit[0] - unit[1])).mean()
        mean = got[0] - deviation * unit[0]
        if t > 1:
            assert float(deviation) == pytest.approx(schedule.posterior(t).deviation, rel=1e-5)
            x = mean + deviation * torch.tensor(noises[steps - t + 1])
        else:
            np.testing.assert_allclose(mean, found, atol=1e-6)
