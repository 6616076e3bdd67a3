"""Conditioned spectra: denoisers against dense linear algebra with both observations."""

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, MotionPosterior
from probmotion.posteriors.protocols import (
    Denoises2D,
    Denoises3D,
    HasExactPosterior,
    NotConjugate,
    OrthographicOnly,
)

VIEWS = Cameras.ring(2, elevation=0.3)


@pytest.mark.parametrize("alpha_bar", [0.999, 0.5, 0.02])
def test_denoisers_match_both_observations(
    prior, dense, likelihood, noisy, assert_close, alpha_bar
):
    conditioned = prior.given(likelihood)
    given, _ = dense.observed(likelihood)
    x_t = noisy(alpha_bar, 2)
    views = np.stack([x_t @ axes.T for axes in VIEWS.image_axes], axis=1)
    motions = conditioned.denoise_motion(x_t, alpha_bar)
    images = conditioned.denoise(views, alpha_bar, VIEWS)
    for i, x in enumerate(x_t):
        mean = given.denoised(x, alpha_bar).moments()[0]
        assert_close(motions[i].reshape(-1), mean / prior.scale)
        for view, axes in enumerate(VIEWS.image_axes):
            mean = given.denoised(views[i, view], alpha_bar, axes).moments()[0]
            expected = mean.reshape(5, 4, 3) @ axes.T / prior.scale
            assert_close(images[i, view], expected)


def test_is_the_posterior_as_a_prior(prior, make_likelihood):
    likelihood = make_likelihood("joints with gaps")
    conditioned = prior.given(likelihood)
    for protocol in (Denoises2D, Denoises3D, HasExactPosterior):
        assert isinstance(conditioned, protocol)
    posterior = MotionPosterior(conditioned)
    assert (posterior.frames, posterior.fps, posterior.dim) == (5, 10.0, 60)
    exact = prior.exact_posterior(likelihood)
    draws = [one.sample(np.random.default_rng(3), 4) for one in (conditioned, exact)]
    np.testing.assert_array_equal(*draws)
    np.testing.assert_array_equal(conditioned.exact_posterior(None).mean(), exact.mean())
    theta = np.random.default_rng(4).normal(size=(2, 60))
    np.testing.assert_array_equal(conditioned.motion(theta), prior.motion(theta))


def test_invalid_input_is_rejected(prior, make_likelihood, noisy):
    likelihood = make_likelihood("joints")
    conditioned = prior.given(likelihood)
    x_t = noisy(0.5)
    perspective = Cameras.around([0.0], [0.1], perspective=True)
    student = Joints3D(np.zeros((5, 4, 3)), 0.1, degrees_of_freedom=4)
    for error, message, call in (
        (
            ValueError,
            "alpha_bar must be between 0 and",
            lambda: conditioned.denoise_motion(x_t, 1.0),
        ),
        (
            ValueError,
            "alpha_bar must be between 0 and",
            lambda: conditioned.denoise_motion(x_t, 0.0),
        ),
        (ValueError, r"got \(3, 2, 4, 3\)", lambda: conditioned.denoise_motion(x_t[:, :2], 0.5)),
        (
            OrthographicOnly,
            "got perspective",
            lambda: conditioned.denoise(x_t[..., :2], 0.5, perspective),
        ),
        (NotConjugate, "must be None", lambda: conditioned.exact_posterior(likelihood)),
        (NotConjugate, "Student-t", lambda: prior.given(student)),
    ):
        with pytest.raises(error, match=message):
            call()
