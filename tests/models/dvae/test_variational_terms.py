"""The bound's terms against Monte Carlo, libraries, and the Student-t that they imply."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats
from scipy.special import digamma, gammaln
from torch.distributions import InverseGamma, Normal, kl_divergence

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
    """Monte Carlo's mean is within five of its standard errors (one failure in 10⁶)."""
    error = samples.std(axis=0) / math.sqrt(len(samples))
    assert (abs(samples.mean(axis=0) - np.asarray(expected)) < 5 * error).all()


def student_bound(residual, degrees, scale, dtype=torch.float64):
    """E_q[log N] − KL where the bound is tight, q the exact posterior of v̄."""
    residual = torch.as_tensor(residual, dtype=dtype)
    half = 0.5 * degrees
    alpha = torch.full_like(residual, half + 0.5)
    beta = half + 0.5 * (residual / scale) ** 2
    return expected_log_normal(residual, alpha, beta, scale) - inverse_gamma_kl(
        alpha, beta, half, half
    )


def test_gaussian_kl_is_the_library_s_in_any_batch(dtype):
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


def test_gaussian_kl_is_the_mean_of_the_log_ratio():
    rng = np.random.default_rng(1)
    mean, log_scale, prior_mean, prior_log_scale = rng.normal(size=(4, 3)) * 0.5
    drawn = mean + np.exp(log_scale) * rng.normal(size=(N, 3))
    ratio = stats.norm.logpdf(drawn, mean, np.exp(log_scale)) - stats.norm.logpdf(
        drawn, prior_mean, np.exp(prior_log_scale)
    )
    found = gaussian_kl(*tensors(torch.float64, mean, log_scale, prior_mean, prior_log_scale))
    assert_estimates(ratio.sum(-1), found)


def test_gaussian_kl_is_positive_and_small_between_neighbours(dtype):
    """To second order it is ratio² + offset²/2, which a difference of 1 − 1 would lose."""
    mean, log_scale = tensors(dtype, [0.3], [-1.0])
    assert gaussian_kl(mean, log_scale, mean, log_scale) == 0
    step = 2.0**-10
    found = gaussian_kl(mean + step * log_scale.exp(), log_scale + step, mean, log_scale)
    assert float(found) == pytest.approx(1.5 * step**2, rel=0.01)


def test_inverse_gamma_kl_is_the_library_s(dtype):
    """A library has it between gammas: 1/v is one, and KL does not see a change of variable."""
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


def test_inverse_gamma_kl_is_the_mean_of_the_log_ratio():
    rng = np.random.default_rng(3)
    alpha, beta, prior_alpha, prior_beta = positive(rng, 4, 5) + 1
    drawn = stats.invgamma.rvs(alpha, scale=beta, size=(N, 5), random_state=rng)
    ratio = stats.invgamma.logpdf(drawn, alpha, scale=beta) - stats.invgamma.logpdf(
        drawn, prior_alpha, scale=prior_beta
    )
    assert_estimates(
        ratio, inverse_gamma_kl(*tensors(torch.float64, alpha, beta, prior_alpha, prior_beta))
    )
    library = InverseGamma(*tensors(torch.float64, alpha, beta)).log_prob(torch.tensor(drawn))
    np.testing.assert_allclose(library, stats.invgamma.logpdf(drawn, alpha, scale=beta), atol=1e-9)


@pytest.mark.parametrize("degrees", [0.5, 4.0, 1e6])
def test_inverse_gamma_kl_is_the_formula_of_the_design(degrees):
    alpha, beta, half = 2.3 + degrees / 2, 1.7 + degrees / 2, degrees / 2
    wanted = (
        (alpha - half) * digamma(alpha)
        - gammaln(alpha)
        + gammaln(half)
        + half * (math.log(beta) - math.log(half))
        + alpha * (half - beta) / beta
    )
    found = inverse_gamma_kl(*tensors(torch.float64, alpha, beta), half, half)
    assert float(found) == pytest.approx(wanted, abs=1e-8)
    # And that, by quadrature over log v, is the divergence.
    if degrees < 100:
        q, p = stats.invgamma(alpha, scale=beta), stats.invgamma(half, scale=half)

        def integrand(log_v):
            v = math.exp(log_v)
            return q.pdf(v) * v * (q.logpdf(v) - p.logpdf(v))

        assert integrate.quad(integrand, -6, 25, limit=200)[0] == pytest.approx(wanted, abs=1e-7)


def test_inverse_gamma_kl_keeps_its_digits_near_gaussian_noise():
    """At λ of a million log Γ is 6·10⁶, of which single precision knows no unit."""
    half = 5e5
    alpha, beta = tensors(torch.float32, [half + 500, half], [half, half - 500])
    found = inverse_gamma_kl(alpha, beta, half, half)
    # To second order (α − α₀)²/(2 α₀) and (β − β₀)²/(2 β₀).
    np.testing.assert_allclose(found, [0.25, 0.25], rtol=2e-3)
    assert float(inverse_gamma_kl(alpha[1], alpha[1], half, half)) == 0


def test_expected_log_normal_is_the_mean_over_variances(dtype):
    rng = np.random.default_rng(4)
    residual, scale = rng.normal(size=5) * 0.02, 0.03
    alpha, beta = positive(rng, 2, 5) + 1
    found = expected_log_normal(*tensors(dtype, residual, alpha, beta), scale)
    assert found.dtype == dtype
    v = stats.invgamma.rvs(alpha, scale=beta, size=(N, 5), random_state=rng)
    assert_estimates(stats.norm.logpdf(residual, scale=scale * np.sqrt(v)), found)


def test_log_normal_is_the_library_s(dtype):
    rng = np.random.default_rng(5)
    residual, scale = tensors(dtype, rng.normal(size=(2, 3)), positive(rng, 3))
    torch.testing.assert_close(log_normal(residual, scale), Normal(0, scale).log_prob(residual))
    torch.testing.assert_close(log_normal(residual, 0.1), Normal(0, 0.1).log_prob(residual))
    assert log_normal(residual, 0.1).dtype == dtype


@pytest.mark.parametrize("degrees", [0.5, 4.0, 1e6])
def test_the_tight_bound_is_the_student_t(degrees):
    """max over q of E_q[log N] − KL = log p(residual), reached at q = p(v̄ | residual)."""
    scale = 0.03
    residual = scale * np.array([-40.0, -3.0, -0.5, 0.0, 0.1, 1.0, 8.0])
    wanted = stats.t.logpdf(residual, degrees, scale=scale)
    np.testing.assert_allclose(student_bound(residual, degrees, scale), wanted, atol=3e-8)
    single = student_bound(residual, degrees, scale, torch.float32)
    np.testing.assert_allclose(single, wanted, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("degrees", [0.5, 4.0, 1e6])
def test_any_other_variances_loosen_the_bound(degrees):
    rng = np.random.default_rng(6)
    residual, half = torch.tensor(0.05, dtype=torch.float64), degrees / 2
    factors = torch.tensor(np.exp(0.3 * rng.normal(size=(2, 200))))
    alpha, beta = (half + 0.5) * factors[0], (half + 0.5 * (0.05 / 0.03) ** 2) * factors[1]
    bound = expected_log_normal(residual, alpha, beta, 0.03) - inverse_gamma_kl(
        alpha, beta, half, half
    )
    assert (bound < stats.t.logpdf(0.05, degrees, scale=0.03)).all()


@pytest.mark.parametrize("degrees", [0.5, 4.0])
def test_normal_noise_of_inverse_gamma_variance_is_student_t(degrees):
    """The integral itself, over log v̄."""
    scale, half = 0.03, degrees / 2
    for residual in (0.0, 0.02, 0.2):

        def integrand(log_v, residual=residual):
            v = math.exp(log_v)
            given = float(log_normal(torch.tensor(residual).double(), scale * math.sqrt(v)))
            return math.exp(given) * stats.invgamma.pdf(v, half, scale=half) * v

        found = integrate.quad(integrand, -12, 60, limit=400, points=[0.0, 5.0])[0]
        assert found == pytest.approx(stats.t.pdf(residual, degrees, scale=scale), rel=1e-6)


def test_many_degrees_of_freedom_are_gaussian():
    residual = 0.03 * torch.linspace(-3, 3, 13, dtype=torch.float64)
    gaussian = log_normal(residual, 0.03)
    gaps = [
        float((student_bound(residual, degrees, 0.03) - gaussian).abs().max())
        for degrees in (1e2, 1e4, 1e6)
    ]
    # log t − log N is of the order of r⁴/(4λ).
    assert gaps[2] < 3e-5
    assert gaps[0] > 50 * gaps[1] > 2500 * gaps[2]


@pytest.mark.parametrize("factor", [1000.0, 0.01])
def test_the_unit_shifts_the_density_and_nothing_else(factor):
    """Millimetres in place of metres: every log density less log 1000."""
    rng = np.random.default_rng(7)
    residual, alpha, beta, scale = tensors(
        torch.float64, 0.1 * rng.normal(size=6), *positive(rng, 2, 6), positive(rng, 6)
    )
    for function in (
        log_normal,
        lambda r, s: expected_log_normal(r, alpha, beta, s),
        lambda r, s: student_bound(r, 4.0, s),
    ):
        moved = function(factor * residual, factor * scale)
        torch.testing.assert_close(moved, function(residual, scale) - math.log(factor))


def test_the_bound_does_not_reward_endless_variance():
    """As printed, without log v, the data term rises with β for ever; ours falls past its peak."""
    residual, alpha = tensors(torch.float64, 0.05, 3.0)
    beta = torch.logspace(0, 12, 13, dtype=torch.float64) * 10
    ours = expected_log_normal(residual, alpha, beta, 0.03)
    printed = -0.5 * alpha / beta * (residual / 0.03) ** 2
    assert (printed.diff() > 0).all()
    assert (ours.diff() < 0).all()
    torch.testing.assert_close(
        ours.diff()[-1], torch.tensor(-0.5 * math.log(10), dtype=torch.float64)
    )
    # The peak over β is where E[1/v] residual² = 1.
    beta = (alpha * (residual / 0.03) ** 2).requires_grad_()
    expected_log_normal(residual, alpha, beta, 0.03).backward()
    assert float(beta.grad) == pytest.approx(0, abs=1e-12)


def test_gradients_are_right_and_finite(dtype):
    rng = np.random.default_rng(8)
    values = rng.normal(size=(4, 2, 3))
    double = [torch.tensor(value, requires_grad=True) for value in values]
    assert torch.autograd.gradcheck(gaussian_kl, double)
    double = [torch.tensor(value, requires_grad=True) for value in np.exp(values)]
    assert torch.autograd.gradcheck(inverse_gamma_kl, double)
    assert torch.autograd.gradcheck(expected_log_normal, double)
    assert torch.autograd.gradcheck(log_normal, double[:2])
    # Hostile points: no residual, tiny and huge variances, the prior of Gaussian noise.
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
