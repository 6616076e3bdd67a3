"""Score distillation: its gradient, its optimiser, and that it seeks modes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, MotionPosterior, UnsupportedPosterior
from probmotion.problems import load_problem
from probmotion.samplers import ScoreDistillation
from probmotion.samplers.adam import Adam
from probmotion.samplers.diffusion.sds import score_distillation_gradient
from probmotion.samplers.diffusion.views import Views


@pytest.mark.parametrize("alpha_bar", [0.05, 0.6, 0.99])
def test_gradient_is_that_of_the_mas_loss_up_to_the_noise_level(lively, alpha_bar):
    """MAS, appendix B: with x_t noised from X itself, ∇½‖p(X) − x̂₀‖² = √(1−ᾱ)/√ᾱ (ε_φ − ε) ∂p/∂X.

    (Equation 7 prints the difference the other way round, and drops the ½.)
    """
    rng = np.random.default_rng(0)
    views = Views(Cameras.around([0.3, 2.0, 4.1], [0.2, 0.5, -0.1]))
    motions = rng.normal(size=(2, 2, 2, 3))
    noise = rng.normal(size=(2, 3, 2, 2, 2))
    noisy = math.sqrt(alpha_bar) * views.project(motions) + math.sqrt(1 - alpha_bar) * noise
    clean = lively.denoise(noisy, alpha_bar, views.cameras)

    def loss(at):
        return 0.5 * ((views.project(at) - clean) ** 2).sum(axis=(1, 2, 3, 4))

    step = 1e-5
    slopes = np.empty((2, 12))
    for i, direction in enumerate(np.eye(12).reshape(12, 1, 2, 2, 3)):
        up, down = loss(motions + step * direction), loss(motions - step * direction)
        slopes[:, i] = (up - down) / (2 * step)
    found = score_distillation_gradient(lively, views, motions, noise, alpha_bar)
    level = math.sqrt((1 - alpha_bar) / alpha_bar)
    np.testing.assert_allclose(level * found.reshape(2, 12), slopes, atol=1e-7)
    # The weighting `residual` makes it the same gradient.
    assert ScoreDistillation(weighting="residual").weight(alpha_bar) == pytest.approx(level)
    assert ScoreDistillation(weighting="variance").weight(alpha_bar) == pytest.approx(1 - alpha_bar)
    assert ScoreDistillation().weight(alpha_bar) == 1


def test_adam_is_torch_adam():
    torch = pytest.importorskip("torch")
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
    assert (t.min(), t.max()) == (1, 99)
    counts = np.bincount(t, minlength=100)[1:]
    # χ² of 99 cells: mean 98, standard deviation 14.
    assert ((counts - 4000 / 99) ** 2 / (4000 / 99)).sum() < 98 + 5 * 14
    assert all(len(set(row)) == 3 for row in azimuths)
    assert (
        (np.bincount(azimuths.ravel(), minlength=36) - 12000 / 36) ** 2 / (12000 / 36)
    ).sum() < 80
    t, _ = replace(uniform, levels="annealed").plan(0)
    assert (t[0], t[-1]) == (99, 1)
    assert (np.diff(t) <= 0).all()
    assert (uniform.plan(1)[0] != uniform.plan(0)[0]).any()


def test_it_seeks_the_mode(gaussian_motion):
    mean = np.random.default_rng(0).normal(size=(1, 2, 3))
    prior = gaussian_motion(mean, 0.25 * np.eye(6))
    for levels in ("uniform", "annealed"):
        sampler = ScoreDistillation(iterations=1500, levels=levels, elevation=0.4)
        draws = sampler.sample(MotionPosterior(prior), draws=30, progress=False).flat()
        # A sampler would leave a standard deviation of .5.
        assert abs(draws.mean(axis=0) - mean).max() < 0.1
        assert draws.std(axis=0).max() < 0.2


def test_shared_noise_changes_the_draws_of_several_views(lively):
    posterior = MotionPosterior(lively)
    one = ScoreDistillation(iterations=20, n_views=2)
    both = [
        replace(one, shared_noise=shared).sample(posterior, draws=3, progress=False).flat()
        for shared in (False, True)
    ]
    assert abs(both[0] - both[1]).max() > 1e-3


def test_draws_depend_on_their_names_alone(lively):
    posterior = MotionPosterior(lively)
    sampler = ScoreDistillation(iterations=25, n_views=2)
    whole = sampler.sample(posterior, draws=5, chains=3, seed=2, progress=False).positions.values
    bars = sampler.sample(posterior, draws=5, chains=3, seed=2, progress=True).positions.values
    np.testing.assert_array_equal(bars, whole)
    small = replace(sampler, batch=2).sample(posterior, draws=5, chains=3, seed=2, progress=False)
    np.testing.assert_allclose(small.positions.values, whole, atol=1e-9)
    fewer = sampler.sample(posterior, draws=4, chains=2, seed=2, progress=False)
    np.testing.assert_allclose(fewer.positions.values, whole[:2, :4], atol=1e-9)
    assert small.counts == {"denoiser": 25 * 2 * 15}


def test_what_does_not_fit_is_refused_in_a_sentence(lively):
    seen = Joints3D(lively.mean, noise=0.1)
    with pytest.raises(
        UnsupportedPosterior, match=r"place for evidence; .*mas, .*mvpc.* would do"
    ) as no:
        ScoreDistillation().sample(MotionPosterior(lively, seen), progress=False)
    assert no.value.word == "observations"
    with pytest.raises(ValueError, match="initial is int, expected None: sds starts every draw"):
        ScoreDistillation().sample(MotionPosterior(lively), initial=3, progress=False)
    for wrong, message in (
        ({"levels": "falling"}, r"levels must be one of uniform, annealed, got 'falling'"),
        ({"weighting": "w"}, r"weighting must be one of constant, variance, residual, got 'w'"),
        ({"iterations": 0}, r"iterations is 0"),
        ({"azimuths": 2, "n_views": 3}, r"azimuths must be an integer of at least 3, got 2"),
        ({"learning_rate": 0.0}, r"learning_rate is 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            ScoreDistillation(**wrong)


def test_the_reference_code_sees_a_radian_of_the_circle(monkeypatch):
    sampler = ScoreDistillation.reference_code()
    assert (sampler.iterations, sampler.weighting, sampler.arc) == (1000, "residual", 1.0)
    seen = []
    around = Cameras.around

    def watched(azimuth, elevation, **options):
        seen.extend(np.atleast_1d(azimuth))
        return around(azimuth, elevation, **options)

    monkeypatch.setattr(Cameras, "around", watched)
    few = replace(sampler, iterations=200)
    few.sample(load_problem("gait").posterior, draws=1, progress=False)
    assert 0 <= min(seen) < 0.1
    assert 0.9 < max(seen) < 1
    with pytest.raises(ValueError, match=r"arc must be at most the circle, 2 pi, got 7.0"):
        ScoreDistillation(arc=7.0)
