"""Cosine transform, bands, and spectra at other lengths and frame rates."""

import numpy as np
import pytest

from probmotion.models.mixture.spectrum import (
    bands,
    from_frequencies,
    ramp,
    resampled,
    to_frequencies,
)


def test_transform_is_the_orthonormal_cosine_transform():
    t = np.arange(7)
    waves = np.cos(np.pi * np.outer(t, t + 0.5) / 7) * np.sqrt(np.where(t == 0, 1, 2) / 7)[:, None]
    values = np.random.default_rng(0).normal(size=(2, 7, 3))
    coefficients = to_frequencies(values, axis=1)
    np.testing.assert_allclose(coefficients, np.einsum("ft,ntx->nfx", waves, values), atol=1e-14)
    np.testing.assert_allclose(from_frequencies(coefficients, axis=1), values, atol=1e-14)
    times = from_frequencies(ramp(7, 20.0), axis=0)
    np.testing.assert_allclose(times, (t - 3) / 20, atol=1e-15)


def test_bands_are_octaves():
    assert bands(1).tolist() == [0]
    assert bands(10).tolist() == [0, 1, 2, 3, 3, 4, 4, 4, 4, 5]


def test_resampling_keeps_the_spectral_density():
    """Same duration, twice the frame rate: the old frequencies stay, others fall as ν⁻⁴."""
    variances = np.random.default_rng(1).uniform(1, 2, (2, 6, 3))
    band = bands(6)
    new, new_band = resampled(variances, band, 10.0, 12, 20.0)
    # A coefficient's variance is proportional to the number of frames.
    np.testing.assert_allclose(new[:, :6], 2 * variances)
    fall = (6 / np.arange(6, 12.0)[:, None]) ** 4
    np.testing.assert_allclose(new[:, 6:], new[:, 6:7] * fall)
    assert (new[:, 6] <= new[:, 5]).all()
    assert new_band.tolist() == [*band, *[band[-1]] * 6]
    back, back_band = resampled(new, new_band, 20.0, 6, 10.0)
    np.testing.assert_allclose(back, variances, rtol=1e-14)
    assert back_band.tolist() == band.tolist()


@pytest.mark.parametrize("frames", [1, 3, 6, 17, 60])
def test_white_spectra_stay_white_at_any_length(frames):
    new, _ = resampled(np.full((1, 6, 2), 0.3), bands(6), 10.0, frames, 10.0)
    known = np.arange(frames) / frames <= 5 / 6  # the old frequencies end at 5/6 of half the rate
    known[0] = False
    np.testing.assert_allclose(new[:, known], 0.3 * np.ones((1, known.sum(), 2)))
    # The variance of the mean over frames is that of frequency 0 divided by the number of frames.
    np.testing.assert_allclose(new[:, 0] / frames, 0.3 / 6 * np.ones((1, 2)))
