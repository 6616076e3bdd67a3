"""Conditioned mixture: denoisers against the posterior of both observations at once."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Joints3D, MotionPosterior
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.conditioned_mixture import ConditionedMixture
from probmotion.posteriors.protocols import Denoises2D, Denoises3D, HasExactPosterior, NotConjugate
from probmotion.problems import load_problem
from probmotion.problems.conditioned import conditioned

VIEWS = Cameras.ring(2, elevation=0.3)


@pytest.fixture(scope="module")
def posterior():
    return load_problem("gait-monocular", frames=3, components=6, noise=0.1).posterior


@pytest.fixture(scope="module")
def known(posterior):
    return conditioned(posterior).prior


class Linear:
    """Linear observations from several likelihoods, padded to three coordinates per joint."""

    def __init__(self, *parts):
        def padded(values, axis):
            widths = [(0, 0)] * values.ndim
            widths[axis] = (0, 3 - values.shape[axis])
            return np.pad(values, widths)

        axes, target, precision = zip(*parts, strict=True)
        rows, values = [padded(one, 1) for one in axes], [padded(one, -1) for one in target]
        self.parts = tuple(map(np.concatenate, (rows, values, precision)))

    def linear(self):
        return self.parts


def noisy(prior, alpha_bar):
    rng = np.random.default_rng(7)
    clean = prior.sample(rng, 3) / prior.scale
    return np.sqrt(alpha_bar) * clean + np.sqrt(1 - alpha_bar) * rng.standard_normal(clean.shape)


def seen(x_t):
    return np.stack([x_t @ P.T for P in VIEWS.image_axes], axis=1)


@pytest.mark.parametrize("alpha_bar", [0.02, 0.6, 0.995])
def test_denoisers_match_the_posterior_of_both_observations(posterior, known, alpha_bar):
    x_t = noisy(known, alpha_bar)
    results = [known.denoise_motion(x_t, alpha_bar)]
    results += list(known.denoise(seen(x_t), alpha_bar, VIEWS).swapaxes(0, 1))
    precision = alpha_bar / ((1 - alpha_bar) * known.scale**2)
    for P, means in zip([np.eye(3), *VIEWS.image_axes], results, strict=True):
        for x, mean in zip(x_t, means, strict=True):
            target = (x @ P.T) * known.scale / np.sqrt(alpha_bar)
            level = (P[None], target[None], np.full((1, *x.shape[:2]), precision))
            both = posterior.prior.exact_posterior(Linear(posterior.likelihood.linear(), level))
            np.testing.assert_allclose(mean, both.mean() @ P.T / known.scale, atol=1e-9)


def test_uninformative_likelihood_leaves_the_prior_unchanged(posterior):
    prior = posterior.prior
    known = ConditionedMixture(prior, Joints3D(np.zeros(prior.means.shape[1:]), noise=1e6))
    x_t = noisy(prior, 0.4)
    for one in ("denoise_motion", "denoise"):
        args = (x_t, 0.4) if one == "denoise_motion" else (seen(x_t), 0.4, VIEWS)
        got, wanted = getattr(known, one)(*args), getattr(prior, one)(*args)
        np.testing.assert_allclose(got, wanted, atol=1e-7)


def test_pure_noise_gives_the_posterior_mean(posterior, known):
    mean = posterior.prior.exact_posterior(posterior.likelihood).mean() / known.scale
    x_t = np.random.default_rng(0).standard_normal((2, *mean.shape))
    np.testing.assert_allclose(known.denoise_motion(x_t, 1e-14), [mean, mean], atol=1e-4)


def test_implements_the_prior_protocols(posterior, known):
    inside = MotionPosterior(known)
    for protocol in (Denoises2D, Denoises3D, HasExactPosterior):
        assert isinstance(known, protocol)
    assert (inside.frames, inside.fps, inside.dim) == (3, posterior.fps, 3 * 17 * 3)
    assert known.motion(np.zeros((2, inside.dim))).shape == (2, 3, 17, 3)
    exact = posterior.prior.exact_posterior(posterior.likelihood)
    draws = [one.sample(np.random.default_rng(3), 4) for one in (known, exact)]
    np.testing.assert_array_equal(*draws)
    assert conditioned(inside) is inside


def test_invalid_input_is_rejected(posterior, known):
    prior = posterior.prior
    x_t = noisy(prior, 0.5)
    with pytest.raises(ValueError, match="alpha_bar must be between 0 and 1"):
        known.denoise_motion(x_t, 1.0)
    with pytest.raises(ValueError, match=r"x_t must have shape .*, got \(3, 2, 17, 3\)"):
        known.denoise_motion(x_t[:, :2], 0.5)
    with pytest.raises(ValueError, match="cameras must be orthographic, got perspective"):
        known.denoise(x_t[:, None, ..., :2], 0.5, Cameras.around([0.0], [0.1], perspective=True))
    with pytest.raises(NotConjugate, match="likelihood must be None"):
        known.exact_posterior(posterior.likelihood)
    outliers = Joints3D(prior.means[0], noise=0.1, degrees_of_freedom=4)
    with pytest.raises(NotConjugate, match="Student-t"):
        conditioned(MotionPosterior(prior, outliers))
