"""Conditioned mixture: denoisers against the posterior of both observations at once."""

import numpy as np
import pytest

from probmotion import Joints3D, MotionPosterior
from probmotion.geometry.cameras import Cameras
from probmotion.posteriors.protocols import (
    Denoises2D,
    Denoises3D,
    HasExactPosterior,
    NotConjugate,
    OrthographicOnly,
)
from probmotion.problems import load_problem

VIEWS = Cameras.ring(2, elevation=0.3)


@pytest.fixture(scope="module")
def posterior():
    return load_problem("gait-monocular", frames=3, components=6, noise=0.1).posterior


@pytest.fixture(scope="module")
def mixture(posterior):
    return posterior.conditioned().prior


class Linear:
    """Linear observations from several likelihoods, padded to three coordinates per joint."""

    def __init__(self, *parts):
        axes, target, precision = zip(*parts, strict=True)
        axes = [np.pad(P, ((0, 0), (0, 3 - P.shape[1]), (0, 0))) for P in axes]
        target = [np.pad(y, (*[(0, 0)] * 3, (0, 3 - y.shape[-1]))) for y in target]
        self.parts = tuple(map(np.concatenate, (axes, target, precision)))

    def linear(self):
        return self.parts


def noisy(prior, alpha_bar):
    rng = np.random.default_rng(7)
    clean = prior.sample(rng, 3) / prior.scale
    return np.sqrt(alpha_bar) * clean + np.sqrt(1 - alpha_bar) * rng.standard_normal(clean.shape)


def projected(x_t):
    return np.stack([x_t @ P.T for P in VIEWS.image_axes], axis=1)


@pytest.mark.parametrize("alpha_bar", [0.02, 0.6, 0.995])
def test_denoisers_match_the_posterior_of_both_observations(posterior, mixture, alpha_bar):
    x_t = noisy(mixture, alpha_bar)
    results = [mixture.denoise_motion(x_t, alpha_bar)]
    results += list(mixture.denoise(projected(x_t), alpha_bar, VIEWS).swapaxes(0, 1))
    precision = alpha_bar / ((1 - alpha_bar) * mixture.scale**2)
    for P, means in zip([np.eye(3), *VIEWS.image_axes], results, strict=True):
        for x, mean in zip(x_t, means, strict=True):
            target = (x @ P.T) * mixture.scale / np.sqrt(alpha_bar)
            level = (P[None], target[None], np.full((1, *x.shape[:2]), precision))
            both = posterior.prior.exact_posterior(Linear(posterior.likelihood.linear(), level))
            np.testing.assert_allclose(mean, both.mean() @ P.T / mixture.scale, atol=1e-9)


def test_uninformative_likelihood_leaves_the_prior_unchanged(posterior):
    prior = posterior.prior
    mixture = prior.given(Joints3D(np.zeros(prior.means.shape[1:]), noise=1e6))
    x_t = noisy(prior, 0.4)
    np.testing.assert_allclose(
        mixture.denoise_motion(x_t, 0.4), prior.denoise_motion(x_t, 0.4), atol=1e-7
    )
    views = [one.denoise(projected(x_t), 0.4, VIEWS) for one in (mixture, prior)]
    np.testing.assert_allclose(*views, atol=1e-7)


def test_implements_the_prior_protocols(posterior, mixture):
    inner = MotionPosterior(mixture)
    for protocol in (Denoises2D, Denoises3D, HasExactPosterior):
        assert isinstance(mixture, protocol)
    assert (inner.frames, inner.fps, inner.dim) == (3, posterior.fps, 3 * 17 * 3)
    assert mixture.motion(np.zeros((2, inner.dim))).shape == (2, 3, 17, 3)
    exact = posterior.prior.exact_posterior(posterior.likelihood)
    draws = [one.sample(np.random.default_rng(3), 4) for one in (mixture, exact)]
    np.testing.assert_array_equal(*draws)
    assert inner.conditioned() is inner


def test_invalid_input_is_rejected(posterior, mixture):
    x_t = noisy(posterior.prior, 0.5)
    perspective = Cameras.around([0.0], [0.1], perspective=True)
    outliers = Joints3D(posterior.prior.means[0], noise=0.1, degrees_of_freedom=4)
    for error, message, call in (
        (ValueError, "alpha_bar must be between 0 and", lambda: mixture.denoise_motion(x_t, 1.0)),
        (ValueError, "alpha_bar must be between 0 and", lambda: mixture.denoise_motion(x_t, 0.0)),
        (ValueError, r"got \(3, 2, 17, 3\)", lambda: mixture.denoise_motion(x_t[:, :2], 0.5)),
        (
            OrthographicOnly,
            "got perspective",
            lambda: mixture.denoise(x_t[..., :2], 0.5, perspective),
        ),
        (NotConjugate, "must be None", lambda: mixture.exact_posterior(posterior.likelihood)),
        (NotConjugate, "Student-t", lambda: posterior.prior.given(outliers)),
    ):
        with pytest.raises(error, match=message):
            call()
