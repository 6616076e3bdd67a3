"""Density, 3D denoiser and covariance products against dense linear algebra."""

import numpy as np
import pytest

LEVELS = pytest.mark.parametrize("alpha_bar", [0.999, 0.5, 0.02])


def test_density_and_style_probabilities(prior, dense, assert_close):
    motions = prior.sample(np.random.default_rng(1), 6)
    motions[3:] += np.random.default_rng(2).normal(size=(3, 5, 4, 3))
    values = dense.log_density(motions.reshape(6, -1))
    assert_close(prior.log_prior(motions), values)
    assert_close(prior.log_prior(motions.reshape(2, 3, 5, 4, 3)), values.reshape(2, 3))
    # p(k | X) are ratios of densities.
    full = prior.style_responsibilities(motions)
    for k in range(2):
        own = np.arange(12) // 6 == k
        part = object.__new__(type(dense))
        part.log_weights = np.array(dense.log_weights)[own]
        part.means, part.covariances = np.array(dense.means)[own], np.array(dense.covariances)[own]
        assert_close(full[:, k], np.exp(part.log_density(motions.reshape(6, -1)) - values))


@LEVELS
def test_denoiser_and_covariance_products(prior, dense, noisy, assert_close, alpha_bar):
    x_t = noisy(alpha_bar)
    vectors = np.random.default_rng(3).normal(size=x_t.shape)
    means = prior.denoise_motion(x_t, alpha_bar)
    products = prior.motion_covariance(x_t, alpha_bar)(vectors)
    for x, v, mean, product in zip(x_t, vectors, means, products, strict=True):
        expected, covariance = dense.denoised(x, alpha_bar).moments()
        assert_close(mean.reshape(-1), expected / prior.scale)
        assert_close(product.reshape(-1), covariance @ v.reshape(-1) / prior.scale**2)


def test_clean_motions_are_unchanged(prior):
    x = prior.sample(np.random.default_rng(1), 2) / prior.scale
    np.testing.assert_allclose(prior.denoise_motion(x, 1.0), x, atol=1e-12)
    assert np.abs(prior.motion_covariance(x, 1.0)(x)).max() < 1e-12


def test_rounding_does_not_depend_on_the_batch(prior, noisy):
    x_t = noisy(0.6, 21)
    together = prior.denoise_motion(x_t, 0.6), prior.motion_covariance(x_t, 0.6)(x_t[::-1])
    for i in (0, 15, 20):
        row, vector = x_t[i : i + 1], x_t[::-1][i : i + 1]
        np.testing.assert_array_equal(prior.denoise_motion(row, 0.6)[0], together[0][i])
        alone = prior.motion_covariance(row, 0.6)(vector)
        np.testing.assert_array_equal(alone[0], together[1][i])
