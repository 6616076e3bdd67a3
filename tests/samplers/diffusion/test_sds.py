"""Tests of `ScoreDistillation` in views: gradient, optimiser, levels and azimuths, modes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, MotionPosterior
from probmotion.samplers import ScoreDistillation
from probmotion.samplers.adam import Adam
from probmotion.samplers.diffusion.sds import score_distillation_gradient
from probmotion.samplers.diffusion.views import Views


@pytest.mark.parametrize("alpha_bar", [0.05, 0.6, 0.99])
def test_gradient_is_that_of_the_mas_loss_up_to_the_noise_level(gaussian, alpha_bar):
    """MAS, appendix B: for x_t noised from X, ∇½‖p(X) − x̂₀‖² = √(1−ᾱ)/√ᾱ (ε_φ − ε) ∂p/∂X."""
    rng = np.random.default_rng(0)
    views = Views(Cameras.around([0.3, 2.0, 4.1], [0.2, 0.5, -0.1]))
    motions = rng.normal(size=(2, 2, 2, 3))
    noise = rng.normal(size=(2, 3, 2, 2, 2))
    noisy = math.sqrt(alpha_bar) * views.project(motions) + math.sqrt(1 - alpha_bar) * noise
    clean = gaussian.denoise(noisy, alpha_bar, views.cameras)

    def loss(state):
        return 0.5 * ((views.project(state) - clean) ** 2).sum(axis=(1, 2, 3, 4))

    step = 1e-5
    slopes = np.empty((2, 12))
    for i, direction in enumerate(np.eye(12).reshape(12, 1, 2, 2, 3)):
        up, down = loss(motions + step * direction), loss(motions - step * direction)
        slopes[:, i] = (up - down) / (2 * step)
    gradient = score_distillation_gradient(gaussian, views, motions, noise, alpha_bar)
    level = math.sqrt((1 - alpha_bar) / alpha_bar)
    np.testing.assert_allclose(level * gradient.reshape(2, 12), slopes, atol=1e-7)
    for weighting, weight in (("residual", level), ("variance", 1 - alpha_bar), ("constant", 1)):
        assert ScoreDistillation(weighting=weighting).weight(alpha_bar) == pytest.approx(weight)


def test_adam_matches_torch():
    rng = np.random.default_rng(1)
    start = rng.normal(size=(3, 4))
    ours = Adam(start.copy(), 0.05)
    theirs = torch.nn.Parameter(torch.tensor(start))
    optimiser = torch.optim.Adam([theirs], lr=0.05)
    for gradient in rng.normal(size=(30, 3, 4)) * np.geomspace(1e-3, 10, 30)[:, None, None]:
        ours.descend(gradient)
        theirs.grad = torch.tensor(gradient)
        optimiser.step()
    np.testing.assert_allclose(ours.parameters, theirs.detach().numpy(), atol=1e-10)


def test_plan_covers_levels_and_azimuths():
    uniform = ScoreDistillation(iterations=4000, n_views=3)
    t, azimuths = uniform.plan(0)
    assert t.shape == (4000,)
    assert azimuths.shape == (4000, 3)
    assert all(len(set(row)) == 3 for row in azimuths)
    for values, n, cells in ((t - 1, 4000, 99), (azimuths.ravel(), 12_000, 36)):
        counts = np.bincount(values, minlength=cells)
        assert len(counts) == cells
        # χ² has mean cells − 1 and twice that variance.
        chi2 = ((counts - n / cells) ** 2 / (n / cells)).sum()
        assert chi2 < cells - 1 + 5 * math.sqrt(2 * (cells - 1))
    t, _ = replace(uniform, levels="annealed").plan(0)
    assert (t[0], t[-1]) == (99, 1)
    assert (np.diff(t) <= 0).all()
    assert (uniform.plan(1)[0] != uniform.plan(0)[0]).any()


def test_draws_concentrate_at_the_mode(gaussian_motion):
    mean = np.random.default_rng(0).normal(size=(1, 2, 3))
    prior = gaussian_motion(mean, 0.25 * np.eye(6))
    sampler = ScoreDistillation(iterations=1500, elevation=0.4)
    draws = sampler.sample(MotionPosterior(prior), draws=30, progress=False)
    assert draws.counts == {"denoiser": 30 * 1500}
    assert abs(draws.flat().mean(axis=0) - mean).max() < 0.1
    # The standard deviation of the prior is 0.5.
    assert draws.flat().std(axis=0).max() < 0.2


def test_the_reference_code_covers_one_radian(gaussian, monkeypatch):
    azimuths, around = [], Cameras.around

    def recorded(azimuth, elevation, **options):
        azimuths.extend(np.atleast_1d(azimuth))
        return around(azimuth, elevation, **options)

    monkeypatch.setattr(Cameras, "around", recorded)
    sampler = replace(ScoreDistillation.reference_code(), iterations=200)
    sampler.sample(MotionPosterior(gaussian), draws=1, progress=False)
    assert 0 <= min(azimuths) < 0.1
    assert 0.9 < max(azimuths) < 1
