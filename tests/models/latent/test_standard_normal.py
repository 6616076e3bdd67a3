"""Standard-normal prior: density against SciPy, draws and Tweedie's formula."""

import jax
import numpy as np
import pytest
import torch
from scipy import stats

from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.posteriors.protocols import DenoisesCoordinates, HasLogDensity, Samplable


class Doubled(StandardNormalPrior):
    """Prior over one frame of one joint at 2 θ."""

    dim = 3

    def motion(self, theta):
        return 2 * theta[..., None, None, :]


PRIOR = Doubled()


def test_draws_are_independent_standard_normals():
    for protocol in (Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(PRIOR, protocol)
    theta = PRIOR.initial(np.random.default_rng(0), 4000)
    assert stats.kstest(theta.ravel(), stats.norm.cdf).pvalue > 1e-4
    # The standard error of a correlation is 1/√4000.
    assert abs(np.corrcoef(theta.T) - np.eye(3)).max() < 5 / np.sqrt(4000)
    sampled = PRIOR.sample(np.random.default_rng(0), 4000)
    np.testing.assert_array_equal(sampled, PRIOR.motion(theta))


@pytest.mark.parametrize("batch", [(), (2, 0), (2, 3)])
def test_density_matches_scipy_in_every_library(batch):
    theta = np.random.default_rng(1).normal(size=(*batch, 3))
    expected = stats.norm.logpdf(theta).sum(-1)
    np.testing.assert_allclose(PRIOR.log_density(theta), expected, rtol=1e-13)
    np.testing.assert_allclose(PRIOR.log_density(torch.tensor(theta)), expected, rtol=1e-13)
    np.testing.assert_allclose(PRIOR.log_density(jax.numpy.asarray(theta)), expected, rtol=1e-5)
    with pytest.raises(ValueError, match=r"theta must have shape .*, got \(2, 4\)"):
        PRIOR.log_density(np.zeros((2, 4)))


def test_denoiser_satisfies_tweedies_formula():
    """E[θ | θ_t] = (θ_t + (1 − ᾱ) ∇ log p(θ_t)) / √ᾱ, and θ_t ~ N(0, I) like θ."""
    theta_t = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    theta_t.requires_grad_(True)
    (score,) = torch.autograd.grad(PRIOR.log_density(theta_t).sum(), theta_t)
    for alpha_bar in (0.01, 0.3, 1.0):
        expected = (theta_t + (1 - alpha_bar) * score) / alpha_bar**0.5
        torch.testing.assert_close(PRIOR.denoise_coordinates(theta_t, alpha_bar), expected)
