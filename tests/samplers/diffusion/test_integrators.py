"""Integrators: order of convergence on a Gaussian, agreement with independent implementations."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from probmotion import MotionPosterior
from probmotion.samplers import (
    Ancestral3D,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
)
from probmotion.samplers.diffusion import DDIM, DDPM, Cosine, Heun, Karras, LogSNR, SecondOrderSDE
from probmotion.samplers.diffusion.ancestral import ancestral
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.states import MotionState
from probmotion.samplers.diffusion.views import MotionDenoiser, pools, view_sets
from probmotion.seeds import NormalStreams

ALL = [DDPM(), DDIM(), SecondOrderSDE(), Heun()]


class GaussianNumber:
    """3D denoiser of N(0, variance), per coordinate."""

    def __init__(self, variance):
        self.variance = variance
        self.counts = {"denoiser": 0}

    def denoise(self, x_t, alpha_bar):
        self.counts["denoiser"] += 1
        noisy = alpha_bar * self.variance + 1 - alpha_bar
        return math.sqrt(alpha_bar) * self.variance / noisy * x_t


class Impulses:
    """Streams of which the i-th returns 1 at its i-th call and 0 otherwise."""

    def __init__(self, n):
        self.n, self.calls = n, 0

    def normal(self, *shape):
        noise = np.zeros((self.n, *shape))
        noise[self.calls] = 1.0
        self.calls += 1
        return noise


def variance_of(integrator, schedule, variance):
    """Return the exact variance of draws, which are linear in the noises."""
    state = MotionState([GaussianNumber(variance)], schedule, (1, 1, 1))
    gains = ancestral(state, Impulses(schedule.steps), lambda: None, integrator)
    return float((gains**2).sum())


@pytest.mark.parametrize(("integrator", "order"), list(zip(ALL, (1, 1, 2, 2), strict=True)))
@pytest.mark.parametrize("variance", [1.0, 0.1])
@pytest.mark.parametrize("levels", [LogSNR(1e-4, 1e3), Karras(1e-4, 1e3)])
def test_order_of_convergence(integrator, order, variance, levels):
    steps = np.array([200, 400, 800])
    fine = variance_of(integrator, levels.schedule(1600), variance)
    assert fine == pytest.approx(variance, rel=0.02 if order == 1 else 2e-4)
    errors = [abs(variance_of(integrator, levels.schedule(n), variance) - variance) for n in steps]
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    print(f"{integrator.kind}, {levels.kind}, variance {variance:g}: order {-slope:.2f}")
    assert slope == pytest.approx(-order, abs=0.15)


@pytest.mark.parametrize(("integrator", "order"), list(zip(ALL, (1, 1, 2, 2), strict=True)))
def test_order_of_convergence_with_alternating_views(gaussian, integrator, order):
    """Steps that combine estimates of two sets of views keep their order."""
    prior = replace(gaussian, mean=np.zeros_like(gaussian.mean))
    size = prior.mean.size

    class Units:
        """Streams that return each unit vector once."""

        def __init__(self, steps):
            self.steps, self.calls = steps, 0

        def normal(self, *shape):
            noise = np.zeros((self.steps, size, size))
            noise[self.calls] = np.eye(size)
            self.calls += 1
            return noise.reshape(-1, *shape)

    def covariance(steps):
        denoisers = pools(prior, view_sets(prior, 3, None))
        state = MotionState(denoisers, LogSNR(1e-3, 1e2).schedule(steps), prior.mean.shape)
        gains = ancestral(state, Units(steps), lambda: None, integrator).reshape(-1, size)
        return gains.T @ gains

    results = [covariance(steps) for steps in (40, 80, 160)]
    changes = [np.abs(after - before).max() for before, after in pairwise(results)]
    slope = np.log2(changes[1] / changes[0])
    print(f"{integrator.kind}, alternating views: order {-slope:.2f}")
    assert slope == pytest.approx(-order, abs=0.3)


def test_second_order_steps_agree_with_diffusers():
    torch = pytest.importorskip("torch")
    schedulers = pytest.importorskip("diffusers.schedulers")
    schedule = Cosine(power=4).schedule(9)
    oracle = schedulers.DPMSolverMultistepScheduler(algorithm_type="sde-dpmsolver++")
    oracle.sigmas = torch.tensor([schedule.sigma(t) for t in range(9, 0, -1)], dtype=torch.float64)
    rng = np.random.default_rng(0)
    x, noise, *estimates = rng.standard_normal((11, 3, 2, 2, 3))

    class Given:
        """Denoiser that returns given estimates."""

        def __init__(self):
            self.counts, self.left = {}, list(estimates)

        def denoise(self, x_t, alpha_bar):
            return self.left.pop(0)

    state = MotionState([Given()], schedule, (2, 2, 3))
    before = None
    for i, t in enumerate(range(9, 1, -1)):
        step = SecondOrderSDE().transition(state, x, t, before)
        ours = step.noisy * x + step.clean * step.combined + step.deviation * noise
        oracle._step_index = i
        given = {"sample": torch.tensor(x), "noise": torch.tensor(noise)}
        now = torch.tensor(step.estimate)
        if i == 0:
            theirs = oracle.dpm_solver_first_order_update(now, **given)
        else:
            pair = [torch.tensor(before), now]
            theirs = oracle.multistep_dpm_solver_second_order_update(pair, **given)
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-6, atol=1e-6)
        before, x = step.estimate, ours


def test_heun_agrees_with_the_ode_in_unscaled_coordinates(gaussian):
    schedule = Karras(0.05, 20.0).schedule(6)
    denoiser = MotionDenoiser(gaussian)
    state = MotionState([denoiser], schedule, (2, 2, 3))
    ours = ancestral(state, NormalStreams([np.random.default_rng(1)]), lambda: None, Heun())
    assert denoiser.counts == {"denoiser": 2 * 5 + 1}

    def slope(y, sigma):
        alpha_bar = 1 / (1 + sigma**2)
        return (y - gaussian.denoise_motion(math.sqrt(alpha_bar) * y, alpha_bar)) / sigma

    sigmas = [schedule.sigma(t) for t in range(6, 0, -1)]
    initial = NormalStreams([np.random.default_rng(1)]).normal(2, 2, 3)
    y = initial * math.sqrt(1 + sigmas[0] ** 2)
    for now, after in pairwise(sigmas):
        first = slope(y, now)
        second = slope(y + (after - now) * first, after)
        y = y + (after - now) * (first + second) / 2
    np.testing.assert_allclose(ours, y - sigmas[-1] * slope(y, sigmas[-1]), atol=1e-10)


@pytest.mark.parametrize("integrator", ALL)
def test_draws_do_not_depend_on_the_batch(gaussian, integrator):
    sampler = MultiViewPredictorCorrector(steps=6, integrator=integrator)
    posterior = MotionPosterior(gaussian)
    together = sampler.sample(posterior, draws=5, progress=False).flat()
    apart = replace(sampler, batch=2).sample(posterior, draws=3, progress=False).flat()
    np.testing.assert_allclose(apart, together[:3], atol=1e-12)


@pytest.mark.parametrize("levels", [Karras(), LogSNR()])
def test_levels_are_between_the_limits(levels):
    schedule = levels.schedule(20)
    assert schedule.steps == 20
    assert schedule.sigma(1) == pytest.approx(levels.smallest)
    assert schedule.sigma(20) == pytest.approx(levels.largest)
    scores = [schedule.sigma(t) for t in range(1, 21)]
    spacing = np.log(scores) if isinstance(levels, LogSNR) else np.power(scores, 1 / levels.rho)
    np.testing.assert_allclose(np.diff(spacing), np.diff(spacing)[0])


@pytest.mark.parametrize("kind", [Ancestral2D, Ancestral3D, MultiViewAncestral])
def test_a_second_order_step_requires_a_history(kind):
    kind(steps=3, levels=Cosine(), integrator=SecondOrderSDE())
    kind(steps=2, levels=Cosine(), integrator=DDPM())
    with pytest.raises(ValueError, match=r"steps must be at least 3 .*, got 2; .*DDPM\(\)"):
        kind(steps=2, levels=Cosine(), integrator=SecondOrderSDE())
