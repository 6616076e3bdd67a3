"""Ancestral sampling of the 3D state: the DDPM step, its exact covariance, the names of draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Joints3D, MotionPosterior, NoiseSchedule, UnsupportedPosterior
from probmotion.samplers import Ancestral3D
from probmotion.samplers.diffusion.ancestral import MotionState, ancestral, cosine_schedule
from probmotion.samplers.diffusion.views import MotionDenoiser
from probmotion.seeds import NormalStreams


def ancestral_covariance(covariance, schedule):
    """Covariance after all steps on N(0, covariance), eigenvalue by eigenvalue: no Monte Carlo."""
    true, axes = np.linalg.eigh(covariance)
    value = np.ones_like(true)
    for t in range(schedule.steps, 0, -1):
        alpha_bar, step = schedule.alpha_bar[t], schedule.posterior(t)
        shrink = np.sqrt(alpha_bar) * true / (alpha_bar * true + 1 - alpha_bar)
        value = (step.clean * shrink + step.noisy) ** 2 * value + step.deviation**2
    return (axes * value) @ axes.T


@pytest.mark.parametrize("power", [2, 4])
def test_draws_follow_the_exact_covariance_of_finitely_many_steps(lively, covariance_is, power):
    sampler = Ancestral3D(steps=10, schedule_power=power)
    draws = sampler.sample(MotionPosterior(lively), draws=8000, seed=1, progress=False)
    expected = ancestral_covariance(lively.covariance / lively.scale**2, sampler.schedule)
    covariance_is(draws.flat() - lively.mean, expected * lively.scale**2)
    # The comparison can fail: ten steps are not infinitely many.
    with pytest.raises(AssertionError, match="of the limit"):
        covariance_is(draws.flat() - lively.mean, lively.covariance)


def test_many_steps_draw_from_the_prior(lively):
    true = lively.covariance
    found = [ancestral_covariance(true, NoiseSchedule.cosine(T)) for T in (500, 1000, 2000)]
    gaps = [abs(covariance - true).max() for covariance in found]
    assert gaps[2] < 5e-3
    # The error falls as 1/T.
    assert gaps[0] / gaps[1] == pytest.approx(2, rel=0.05)
    assert gaps[1] / gaps[2] == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize(
    ("variance", "steps", "ratio"), [(1.0, 100, 0.955), (1.0, 1000, 0.995), (0.0137, 100, 0.79)]
)
def test_limit_6_the_steps_alone_shrink_variance(variance, steps, ratio):
    found = ancestral_covariance(variance * np.eye(1), NoiseSchedule.cosine(steps)) / variance
    assert found[0, 0] == pytest.approx(ratio, abs=6e-3 if variance < 1 else 6e-4)


def test_step_is_that_of_diffusers(lively):
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

    denoiser = MotionDenoiser(lively)
    state = MotionState(denoiser, schedule, (2, 2, 3))
    streams = NormalStreams([np.random.default_rng(0)])
    found = ancestral(state, streams, lambda: None, watch=watch)

    x = torch.tensor(noises[0])
    for t in range(steps, 0, -1):
        clean = denoiser.denoise(x.numpy(), schedule.alpha_bar[t])
        np.testing.assert_allclose(clean, estimates[steps - t + 1], atol=1e-6)
        # diffusers draws its noise itself: take its mean, and its deviation from another seed.
        ask = [
            oracle.step(torch.tensor(clean), t - 1, x, generator=torch.Generator().manual_seed(s))
            for s in (0, 1)
        ]
        unit = [
            torch.randn(x.shape, generator=torch.Generator().manual_seed(s), dtype=x.dtype)
            for s in (0, 1)
        ]
        got = [answer.prev_sample for answer in ask]
        deviation = ((got[0] - got[1]) / (unit[0] - unit[1])).mean()
        mean = got[0] - deviation * unit[0]
        if t > 1:
            assert float(deviation) == pytest.approx(schedule.posterior(t).deviation, rel=1e-5)
            x = mean + deviation * torch.tensor(noises[steps - t + 1])
        else:
            np.testing.assert_allclose(mean, found, atol=1e-6)


def test_draws_depend_on_their_names_alone(lively):
    posterior = MotionPosterior(lively)
    sampler = Ancestral3D(steps=6)
    whole = sampler.sample(posterior, draws=7, chains=3, seed=2, progress=False).positions.values
    bars = sampler.sample(posterior, draws=7, chains=3, seed=2, progress=True).positions.values
    np.testing.assert_array_equal(bars, whole)
    small = replace(sampler, batch=2).sample(posterior, draws=7, chains=3, seed=2, progress=False)
    np.testing.assert_allclose(small.positions.values, whole, atol=1e-12)
    fewer = sampler.sample(posterior, draws=4, chains=2, seed=2, progress=False)
    np.testing.assert_allclose(fewer.positions.values, whole[:2, :4], atol=1e-12)


def test_counts_and_independence(lively):
    draws = Ancestral3D(steps=6).sample(MotionPosterior(lively), draws=5, chains=2, progress=False)
    assert draws.counts == {"denoiser": 60}
    assert draws.independent


def test_strided_levels_are_those_of_the_longer_schedule():
    schedule = cosine_schedule(20, 100, 2)
    np.testing.assert_array_equal(schedule.alpha_bar, NoiseSchedule.cosine(100).alpha_bar[::5])
    assert Ancestral3D(steps=20, trained_steps=100).schedule.steps == 20
    with pytest.raises(ValueError, match="steps must be at most the schedule's 100, got 200"):
        Ancestral3D(steps=200, trained_steps=100)


def test_what_does_not_fit_is_refused_in_a_sentence(lively):
    with pytest.raises(ValueError, match="initial is tuple, expected None: ancestral3d starts"):
        Ancestral3D().sample(MotionPosterior(lively), initial=(), progress=False)
    for wrong in ({"draws": 0}, {"chains": 0}, {"draws": 2.5}):
        with pytest.raises(ValueError, match="expected an integer of at least 1"):
            Ancestral3D(steps=3).sample(MotionPosterior(lively), progress=False, **wrong)

    class Flat:
        skeleton, frames, fps, dim, scale = lively.skeleton, 2, 20.0, 12, 1.0

        def motion(self, theta):
            return theta

        def denoise(self, x_t, alpha_bar, cameras):
            return x_t

    with pytest.raises(UnsupportedPosterior, match="needs a prior with Denoises3D, which Flat is"):
        Ancestral3D().sample(MotionPosterior(Flat()), progress=False)
    outliers = Joints3D(lively.mean, noise=0.1, degrees_of_freedom=4)
    with pytest.raises(UnsupportedPosterior, match="but the noise is Student-t with 4 degrees"):
        Ancestral3D().sample(MotionPosterior(lively, outliers), progress=False)
