"""`StandardNormalPrior`: θ is N(0, I), whatever motion stands at it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion.models.latent.standard_normal import StandardNormalPrior
from probmotion.posteriors.protocols import DenoisesCoordinates, HasLogDensity, Samplable


class Moved(StandardNormalPrior):
    """One frame of one joint, which stands at 2 θ."""

    dim = 3

    def motion(self, theta):
        return 2 * theta[..., None, None, :]


PRIOR = Moved()


def test_a_subclass_can_what_samplers_ask_for():
    for ability in (Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(PRIOR, ability)
    with pytest.raises(TypeError, match="abstract"):
        StandardNormalPrior()


def test_draws_are_of_the_density():
    theta = PRIOR.initial(np.random.default_rng(0), 4000)
    assert theta.shape == (4000, 3)
    assert stats.kstest(theta.ravel(), stats.norm.cdf).pvalue > 1e-4
    # Coordinates are independent: correlations have a deviation of 1/√4000.
    assert abs(np.corrcoef(theta.T) - np.eye(3)).max() < 5 / np.sqrt(4000)
    sampled = PRIOR.sample(np.random.default_rng(0), 4000)
    np.testing.assert_array_equal(sampled, PRIOR.motion(theta))


@pytest.mark.parametrize("batch", [(), (5,), (2, 0), (2, 3)])
def test_the_density_is_scipy_s_in_any_library(batch):
    theta = np.random.default_rng(1).normal(size=(*batch, 3))
    wanted = stats.norm.logpdf(theta).sum(-1)
    np.testing.assert_allclose(PRIOR.log_density(theta), wanted, rtol=1e-13)
    np.testing.assert_allclose(PRIOR.log_density(torch.tensor(theta)), wanted, rtol=1e-13)
    jax = pytest.importorskip("jax")
    found = PRIOR.log_density(jax.numpy.asarray(theta))
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_the_denoiser_is_that_of_the_density():
    """Tweedie: E[θ | θ_t] = (θ_t + (1 − ᾱ) ∇ log p(θ_t)) / √ᾱ, and θ_t ~ N(0, I) as θ is."""
    theta_t = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    theta_t.requires_grad_(True)
    (score,) = torch.autograd.grad(PRIOR.log_density(theta_t).sum(), theta_t)
    for alpha_bar in (0.01, 0.3, 1.0):
        wanted = (theta_t + (1 - alpha_bar) * score) / alpha_bar**0.5
        torch.testing.assert_close(PRIOR.denoise_coordinates(theta_t, alpha_bar), wanted)


def test_a_theta_of_another_length_is_refused():
    with pytest.raises(ValueError, match=r"^theta has shape \(2, 4\), expected"):
        PRIOR.log_density(np.zeros((2, 4)))
