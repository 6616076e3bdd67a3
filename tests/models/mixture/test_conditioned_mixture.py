"""Denoisers given evidence against the posterior of both at once, which is another formula."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Joints3D, Keypoints2D, Motion, MotionPosterior
from probmotion.geometry.cameras import Cameras
from probmotion.models.mixture.conditioned_mixture import ConditionedMixture
from probmotion.posteriors.protocols import Denoises2D, Denoises3D, HasExactPosterior, NotConjugate
from probmotion.problems import load_problem
from probmotion.problems.conditioned import conditioned


@pytest.fixture(scope="module")
def posterior():
    return load_problem("gait-monocular", frames=3, components=6, noise=0.1).posterior


@pytest.fixture(scope="module")
def known(posterior):
    return conditioned(posterior).prior


class Linear:
    """Evidence in any views, each of up to three numbers a joint."""

    def __init__(self, *parts):
        def three(values):
            return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, 3 - values.shape[-1])])

        axes, target, precision = zip(*parts, strict=True)
        rows = [np.pad(view, [(0, 0), (0, 3 - view.shape[1]), (0, 0)]) for view in axes]
        self.parts = tuple(map(np.concatenate, (rows, [three(one) for one in target], precision)))

    def linear(self):
        return self.parts


def noisy(prior, alpha_bar, n=3):
    rng = np.random.default_rng(7)
    clean = prior.sample(rng, n) / prior.scale
    noise = rng.standard_normal(clean.shape)
    return np.sqrt(alpha_bar) * clean + np.sqrt(1 - alpha_bar) * noise


@pytest.mark.parametrize("alpha_bar", [0.02, 0.6, 0.995])
def test_denoisers_are_means_given_both_noisy_motion_and_evidence(posterior, known, alpha_bar):
    x_t = noisy(known, alpha_bar)
    views = Cameras.ring(2, elevation=0.3)
    found = [known.denoise_motion(x_t, alpha_bar)]
    seen = np.stack([x_t @ P.T for P in views.image_axes], axis=1)
    found += list(known.denoise(seen, alpha_bar, views).swapaxes(0, 1))
    precision = alpha_bar / ((1 - alpha_bar) * known.scale**2)
    for P, means in zip([np.eye(3), *views.image_axes], found, strict=True):
        for x, mean in zip(x_t, means, strict=True):
            target = (x @ P.T) * known.scale / np.sqrt(alpha_bar)
            level = (P[None], target[None], np.full((1, *x.shape[:2]), precision))
            both = posterior.prior.exact_posterior(Linear(posterior.likelihood.linear(), level))
            np.testing.assert_allclose(mean, both.mean() @ P.T / known.scale, atol=1e-9)


def test_evidence_that_says_nothing_leaves_the_prior(posterior):
    prior = posterior.prior
    nothing = Joints3D(np.zeros(prior.means.shape[1:]), noise=1e6)
    known = ConditionedMixture(prior, nothing)
    x_t = noisy(prior, 0.4)
    views = Cameras.ring(3, elevation=0.2)
    seen = np.stack([x_t @ P.T for P in views.image_axes], axis=1)
    np.testing.assert_allclose(
        known.denoise_motion(x_t, 0.4), prior.denoise_motion(x_t, 0.4), atol=1e-7
    )
    np.testing.assert_allclose(
        known.denoise(seen, 0.4, views), prior.denoise(seen, 0.4, views), atol=1e-7
    )


def test_pure_noise_leaves_the_posteriors_mean(posterior, known):
    mean = posterior.prior.exact_posterior(posterior.likelihood).mean() / known.scale
    x_t = np.random.default_rng(0).standard_normal((2, *mean.shape))
    np.testing.assert_allclose(known.denoise_motion(x_t, 1e-14), [mean, mean], atol=1e-4)


def test_it_is_a_prior_that_samplers_take(posterior, known):
    inside = MotionPosterior(known)
    assert isinstance(known, Denoises2D)
    assert isinstance(known, Denoises3D)
    assert isinstance(known, HasExactPosterior)
    assert (inside.frames, inside.fps, inside.dim) == (3, posterior.fps, 3 * 17 * 3)
    theta = np.arange(2.0 * inside.dim).reshape(2, -1)
    assert known.motion(theta).shape == (2, 3, 17, 3)
    draws = known.sample(np.random.default_rng(3), 4)
    exact = posterior.prior.exact_posterior(posterior.likelihood)
    np.testing.assert_array_equal(draws, exact.sample(np.random.default_rng(3), 4))
    assert conditioned(inside) is inside


def test_what_does_not_fit_is_refused_in_a_sentence(posterior, known):
    prior = posterior.prior
    x_t = noisy(prior, 0.5)
    for level in (0.0, 1.0):
        with pytest.raises(ValueError, match="expected a number between 0 and 1"):
            known.denoise_motion(x_t, level)
    with pytest.raises(ValueError, match=r"x_t has shape \(3, 2, 17, 3\)"):
        known.denoise_motion(x_t[:, :2], 0.5)
    with pytest.raises(ValueError, match="cameras must be orthographic, got perspective"):
        known.denoise(x_t[:, None, ..., :2], 0.5, Cameras.around([0.0], [0.1], perspective=True))
    with pytest.raises(NotConjugate, match="there is evidence already"):
        known.exact_posterior(posterior.likelihood)
    outliers = Joints3D(prior.means[0], noise=0.1, degrees_of_freedom=4)
    with pytest.raises(NotConjugate, match="the noise is Student-t"):
        conditioned(MotionPosterior(prior, outliers))

    class Silent:
        skeleton, frames, fps, dim = prior.skeleton, prior.frames, prior.fps, known.dim
        motion = known.motion

    motion = Motion(prior.means[0], prior.skeleton, prior.fps)
    track = Keypoints2D.observe(motion, Cameras.ring(1, elevation=0.1), noise=0.1, seed=0)
    with pytest.raises(ValueError, match="posterior has the prior Silent, whose denoisers given"):
        conditioned(MotionPosterior(Silent(), track))
