"""2D denoiser and covariance products against dense linear algebra."""

import numpy as np
import pytest

from probmotion import Cameras

VIEWS = Cameras.ring(3, elevation=0.3, start=0.2)


def noisy_views(x_t):
    return np.stack([x_t @ axes.T for axes in VIEWS.image_axes], axis=1)


@pytest.mark.parametrize("alpha_bar", [0.999, 0.5, 0.02])
def test_denoiser_and_covariance_products(prior, dense, noisy, assert_close, alpha_bar):
    x_t = noisy_views(noisy(alpha_bar))
    vectors = np.random.default_rng(3).normal(size=x_t.shape)
    means = prior.denoise(x_t, alpha_bar, VIEWS)
    products = prior.view_covariance(x_t, alpha_bar, VIEWS)(vectors)
    for view, axes in enumerate(VIEWS.image_axes):
        project = np.kron(np.eye(20), axes)
        for i in range(len(x_t)):
            mean, covariance = dense.denoised(x_t[i, view], alpha_bar, axes).moments()
            assert_close(means[i, view].reshape(-1), project @ mean / prior.scale)
            product = project @ covariance @ project.T @ vectors[i, view].reshape(-1)
            assert_close(products[i, view].reshape(-1), product / prior.scale**2)


def test_clean_views_are_unchanged(prior):
    x = noisy_views(prior.sample(np.random.default_rng(1), 2) / prior.scale)
    np.testing.assert_allclose(prior.denoise(x, 1.0, VIEWS), x, atol=1e-12)


def test_rounding_does_not_depend_on_the_batch(prior, noisy):
    x_t = noisy_views(noisy(0.6, 21))
    means = prior.denoise(x_t, 0.6, VIEWS)
    products = prior.view_covariance(x_t, 0.6, VIEWS)(x_t[::-1])
    for i in (0, 15, 20):
        row, vector = x_t[i : i + 1], x_t[::-1][i : i + 1]
        np.testing.assert_array_equal(prior.denoise(row, 0.6, VIEWS)[0], means[i])
        alone = prior.view_covariance(row, 0.6, VIEWS)(vector)
        np.testing.assert_array_equal(alone[0], products[i])
