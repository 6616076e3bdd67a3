"""Terms of the bound against torch, Monte Carlo and the Student-t density."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Gamma, Normal, kl_divergence

from probmotion.models.dvae.variational_terms import (
    expected_log_normal,
    gaussian_kl,
    inverse_gamma_kl,
    log_normal,
)

N = 100_000


@pytest.fixture(params=[torch.float64, torch.float32], ids=["float64", "float32"])
def dtype(request):
    return request.param


def tensors(dtype, *values):
    return [torch.tensor(value, dtype=dtype) for value in values]


def test_gaussian_kl_matches_torch(dtype):
    rng = np.random.default_rng(0)
    mean, log_scale, prior_mean, prior_log_scale = tensors(dtype, *rng.normal(size=(4, 3, 2, 5)))
    q, p = Normal(mean, log_scale.exp()), Normal(prior_mean, prior_log_scale.exp())
    result = gaussian_kl(mean, log_scale, prior_mean, prior_log_scale)
    torch.testing.assert_close(result, kl_divergence(q, p).sum(-1))


def test_gaussian_kl_is_accurate_for_similar_distributions(dtype):
    """To second order, the KL divergence is ratio² + offset²/2."""
    mean, log_scale = tensors(dtype, [0.3], [-1.0])
    assert gaussian_kl(mean, log_scale, mean, log_scale) == 0
    step = 2.0**-10
    result = gaussian_kl(mean + step * log_scale.exp(), log_scale + step, mean, log_scale)
    assert float(result) == pytest.approx(1.5 * step**2, rel=0.01)


def test_inverse_gamma_kl_matches_torch_gamma(dtype):
    """KL is invariant to the change of variable 1/v ~ Gamma."""
    values = np.exp(np.random.default_rng(2).normal(size=(4, 3, 7)))
    alpha, beta, prior_alpha, prior_beta = tensors(dtype, *values)
    result = inverse_gamma_kl(alpha, beta, prior_alpha, prior_beta)
    expected = kl_divergence(Gamma(alpha, beta), Gamma(prior_alpha, prior_beta))
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    torch.testing.assert_close(result, expected, atol=tolerance, rtol=0)


def test_inverse_gamma_kl_is_accurate_for_almost_gaussian_noise():
    """log Γ is 6·10⁶ at λ = 10⁶, beyond single precision."""
    half = 5e5
    alpha, beta = tensors(torch.float32, [half + 500, half], [half, half - 500])
    # To second order, the values are (α − α₀)²/(2 α₀) and (β − β₀)²/(2 β₀).
    np.testing.assert_allclose(inverse_gamma_kl(alpha, beta, half, half), 0.25, rtol=2e-3)
    assert float(inverse_gamma_kl(alpha[1], alpha[1], half, half)) == 0


def test_expected_log_normal_matches_monte_carlo(dtype):
    rng = np.random.default_rng(4)
    residual, scale = rng.normal(size=5) * 0.02, 0.03
    alpha, beta = np.exp(rng.normal(size=(2, 5))) + 1
    result = expected_log_normal(*tensors(dtype, residual, alpha, beta), scale)
    assert result.dtype == dtype
    v = stats.invgamma.rvs(alpha, scale=beta, size=(N, 5), random_state=rng)
    samples = stats.norm.logpdf(residual, scale=scale * np.sqrt(v))
    error = samples.std(axis=0) / math.sqrt(N)
    assert (abs(samples.mean(axis=0) - result.numpy()) < 5 * error).all()


def test_log_normal_matches_torch(dtype):
    rng = np.random.default_rng(5)
    residual, scale = tensors(dtype, rng.normal(size=(2, 3)), np.exp(rng.normal(size=3)))
    for value in (scale, 0.1):
        expected = Normal(0, value).log_prob(residual)
        torch.testing.assert_close(log_normal(residual, value), expected)


@pytest.mark.parametrize("degrees", [0.5, 4.0, 1e6])
def test_tight_bound_is_the_student_t_density(dtype, degrees):
    """The maximum of E_q[log N] − KL over q is reached at q = p(v̄ | residual)."""
    half, scale = 0.5 * degrees, 0.03
    values = scale * np.array([-40.0, -3.0, -0.5, 0.0, 0.1, 1.0, 8.0])
    (residual,) = tensors(dtype, values)
    alpha = torch.full_like(residual, half + 0.5)
    beta = half + 0.5 * (residual / scale) ** 2
    bound = expected_log_normal(residual, alpha, beta, scale)
    bound = bound - inverse_gamma_kl(alpha, beta, half, half)
    expected = stats.t.logpdf(values, degrees, scale=scale)
    rtol, atol = (1e-7, 3e-8) if dtype == torch.float64 else (1e-5, 1e-4)
    np.testing.assert_allclose(bound, expected, rtol=rtol, atol=atol)


def test_gradients_are_finite_at_extreme_points(dtype):
    """The points have zero residuals, extreme variances or Gaussian noise."""
    alpha, beta, residual = (
        value.requires_grad_()
        for value in tensors(dtype, *[[1e-3, 0.5, 5e5, 5e5, 1e6]] * 2, [0.0, 10.0, 0.0, 1e-6, 1.0])
    )
    bound = expected_log_normal(residual, alpha, beta, 0.01)
    (bound - inverse_gamma_kl(alpha, beta, 5e5, 5e5)).sum().backward()
    for point in (alpha, beta, residual):
        assert point.grad.dtype == dtype
        assert torch.isfinite(point.grad).all()
