"""Terms of the bound against torch, Monte Carlo and the Student-t density."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import Normal, kl_divergence

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


def positive(rng, *shape):
    return np.exp(rng.normal(size=shape))


def assert_estimates(samples, expected):
    """Check that the sample mean is within five standard errors."""
    error = samples.std(axis=0) / math.sqrt(len(samples))
    assert (abs(samples.mean(axis=0) - np.asarray(expected)) < 5 * error).all()


def student_bound(residual, degrees, scale, dtype=torch.float64):
    """Return the tight bound E_q[log N] − KL, with q the exact posterior of v̄."""
    residual = torch.as_tensor(residual, dtype=dtype)
    half = 0.5 * degrees
    alpha = torch.full_like(residual, half + 0.5)
    beta = half + 0.5 * (residual / scale) ** 2
    return expected_log_normal(residual, alpha, beta, scale) - inverse_gamma_kl(
        alpha, beta, half, half
    )


def test_gaussian_kl_matches_torch(dtype):
    rng = np.random.default_rng(0)
    mean, log_scale, prior_mean, prior_log_scale = tensors(dtype, *rng.normal(size=(4, 3, 2, 5)))
    found = gaussian_kl(mean, log_scale, prior_mean, prior_log_scale)
    wanted = kl_divergence(
        Normal(mean, log_scale.exp()), Normal(prior_mean, prior_log_scale.exp())
    ).sum(-1)
    assert found.shape == (3, 2)
    assert found.dtype == dtype
    torch.testing.assert_close(found, wanted)
    one = gaussian_kl(mean[1, 0], log_scale[1, 0], prior_mean[1, 0], prior_log_scale[1, 0])
    torch.testing.assert_close(one, found[1, 0])


def test_gaussian_kl_is_accurate_for_similar_distributions(dtype):
    """To second order it is ratio² + offset²/2."""
    mean, log_scale = tensors(dtype, [0.3], [-1.0])
    assert gaussian_kl(mean, log_scale, mean, log_scale) == 0
    step = 2.0**-10
    found = gaussian_kl(mean + step * log_scale.exp(), log_scale + step, mean, log_scale)
    assert float(found) == pytest.approx(1.5 * step**2, rel=0.01)


def test_inverse_gamma_kl_matches_torch_gamma(dtype):
    """KL is invariant to the change of variable 1/v ~ Gamma."""
    rng = np.random.default_rng(2)
    alpha, beta, prior_alpha, prior_beta = tensors(dtype, *positive(rng, 4, 3, 7))
    found = inverse_gamma_kl(alpha, beta, prior_alpha, prior_beta)
    gamma = torch.distributions.Gamma
    wanted = kl_divergence(gamma(alpha, beta), gamma(prior_alpha, prior_beta))
    assert found.dtype == dtype
    assert (found >= 0).all()
    torch.testing.assert_close(
        found, wanted, atol=2e-5 if dtype == torch.float32 else 1e-12, rtol=0
    )


def test_inverse_gamma_kl_is_accurate_near_gaussian_noise():
    """log Γ is 6·10⁶ at λ = 10⁶, beyond single precision."""
    half = 5e5
    alpha, beta = tensors(torch.float32, [half + 500, half], [half, half - 500])
    found = inverse_gamma_kl(alpha, beta, half, half)
    # To second order (α − α₀)²/(2 α₀) and (β − β₀)²/(2 β₀).
    np.testing.assert_allclose(found, [0.25, 0.25], rtol=2e-3)
    assert float(inverse_gamma_kl(alpha[1], alpha[1], half, half)) == 0


def test_expected_log_normal_matches_monte_carlo(dtype):
    rng = np.random.default_rng(4)
    residual, scale = rng.normal(size=5) * 0.02, 0.03
    alpha, beta = positive(rng, 2, 5) + 1
    found = expected_log_normal(*tensors(dtype, residual, alpha, beta), scale)
    assert found.dtype == dtype
    v = stats.invgamma.rvs(alpha, scale=beta, size=(N, 5), random_state=rng)
    assert_estimates(stats.norm.logpdf(residual, scale=scale * np.sqrt(v)), found)


def test_log_normal_matches_torch(dtype):
    rng = np.random.default_rng(5)
    residual, scale = tensors(dtype, rng.normal(size=(2, 3)), positive(rng, 3))
    torch.testing.assert_close(log_normal(residual, scale), Normal(0, scale).log_prob(residual))
    torch.testing.assert_close(log_normal(residual, 0.1), Normal(0, 0.1).log_prob(residual))
    assert log_normal(residual, 0.1).dtype == dtype


@pytest.mark.parametrize("degrees", [0.5, 4.0, 1e6])
def test_tight_bound_is_the_student_t_density(degrees):
    """The maximum over q is reached at q = p(v̄ | residual)."""
    scale = 0.03
    residual = scale * np.array([-40.0, -3.0, -0.5, 0.0, 0.1, 1.0, 8.0])
    wanted = stats.t.logpdf(residual, degrees, scale=scale)
    np.testing.assert_allclose(student_bound(residual, degrees, scale), wanted, atol=3e-8)
    single = student_bound(residual, degrees, scale, torch.float32)
    np.testing.assert_allclose(single, wanted, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("degrees", [0.5, 4.0, 1e6])
def test_other_variances_loosen_the_bound(degrees):
    rng = np.random.default_rng(6)
    residual, half = torch.tensor(0.05, dtype=torch.float64), degrees / 2
    factors = torch.tensor(np.exp(0.3 * rng.normal(size=(2, 200))))
    alpha, beta = (half + 0.5) * factors[0], (half + 0.5 * (0.05 / 0.03) ** 2) * factors[1]
    bound = expected_log_normal(residual, alpha, beta, 0.03) - inverse_gamma_kl(
        alpha, beta, half, half
    )
    assert (bound < stats.t.logpdf(0.05, degrees, scale=0.03)).all()


def test_bound_decreases_for_large_variances():
    """As printed, without log v, the data term increases with β without limit."""
    residual, alpha = tensors(torch.float64, 0.05, 3.0)
    beta = torch.logspace(0, 12, 13, dtype=torch.float64) * 10
    ours = expected_log_normal(residual, alpha, beta, 0.03)
    printed = -0.5 * alpha / beta * (residual / 0.03) ** 2
    assert (printed.diff() > 0).all()
    assert (ours.diff() < 0).all()
    torch.testing.assert_close(
        ours.diff()[-1], torch.tensor(-0.5 * math.log(10), dtype=torch.float64)
    )
    # The maximum over β satisfies E[1/v] residual² = 1.
    beta = (alpha * (residual / 0.03) ** 2).requires_grad_()
    expected_log_normal(residual, alpha, beta, 0.03).backward()
    assert float(beta.grad) == pytest.approx(0, abs=1e-12)


def test_gradients_are_correct_and_finite(dtype):
    rng = np.random.default_rng(8)
    values = rng.normal(size=(4, 2, 3))
    double = [torch.tensor(value, requires_grad=True) for value in values]
    assert torch.autograd.gradcheck(gaussian_kl, double)
    double = [torch.tensor(value, requires_grad=True) for value in np.exp(values)]
    assert torch.autograd.gradcheck(inverse_gamma_kl, double)
    assert torch.autograd.gradcheck(expected_log_normal, double)
    assert torch.autograd.gradcheck(log_normal, double[:2])
    # Extreme points: zero residuals, tiny and huge variances, Gaussian noise.
    alpha, beta = (
        torch.tensor([1e-3, 0.5, 5e5, 5e5, 1e6], dtype=dtype, requires_grad=True) for _ in range(2)
    )
    residual = torch.tensor([0.0, 10.0, 0.0, 1e-6, 1.0], dtype=dtype, requires_grad=True)
    bound = expected_log_normal(residual, alpha, beta, 0.01) - inverse_gamma_kl(
        alpha, beta, 5e5, 5e5
    )
    bound.sum().backward()
    for point in (alpha, beta, residual):
        assert point.grad.dtype == dtype
        assert torch.isfinite(point.grad).all()
