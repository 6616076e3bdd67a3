"""Mixture of codes: density, draws and denoiser against SciPy, and its fit."""

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion.models.latent.code_mixture import CodeMixture, CodePrior
from probmotion.posteriors.protocols import DenoisesCoordinates, HasLogDensity, Samplable

WEIGHTS = np.array([0.3, 0.7])
MEANS = np.array([[1.0, 0.0, -1.0], [-0.5, 0.5, 2.0]])
FACTORS = np.array([[[0.5, 0, 0], [0.2, 0.7, 0], [0, -0.3, 0.4]], np.diag([0.2, 1.0, 0.5])])
MIXTURE = CodeMixture(WEIGHTS, MEANS, FACTORS)


class Doubled(CodePrior):
    """Prior over one frame of one joint at 2 θ."""

    codes = MIXTURE

    def motion(self, theta):
        return 2 * theta[..., None, None, :]


def covariance(k):
    return FACTORS[k] @ FACTORS[k].T


def scipy_log_density(z):
    parts = [
        weight * stats.multivariate_normal(MEANS[k], covariance(k)).pdf(z)
        for k, weight in enumerate(WEIGHTS)
    ]
    return np.log(sum(parts))


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_density_matches_scipy(batch):
    z = np.random.default_rng(1).normal(size=(*batch, 3))
    np.testing.assert_allclose(MIXTURE.log_density(z), scipy_log_density(z), rtol=1e-10)
    result = Doubled().log_density(torch.tensor(z))
    np.testing.assert_allclose(result, scipy_log_density(z), rtol=1e-10)
    with pytest.raises(ValueError, match=r"z must have shape .*, got \(2, 4\)"):
        MIXTURE.log_density(np.zeros((2, 4)))


def test_draws_have_the_moments_of_the_mixture():
    prior = Doubled()
    for protocol in (Samplable, HasLogDensity, DenoisesCoordinates):
        assert isinstance(prior, protocol)
    z = prior.initial(np.random.default_rng(0), 20_000)
    np.testing.assert_array_equal(z[:7], prior.initial(np.random.default_rng(0), 7))
    np.testing.assert_allclose(z.mean(axis=0), WEIGHTS @ MEANS, atol=0.05)
    apart = MEANS - WEIGHTS @ MEANS
    expected = sum(
        w * (covariance(k) + np.outer(apart[k], apart[k])) for k, w in enumerate(WEIGHTS)
    )
    np.testing.assert_allclose(np.cov(z.T), expected, atol=0.08)
    np.testing.assert_array_equal(prior.sample(np.random.default_rng(0), 4)[:, 0, 0], 2 * z[:4])


def test_standard_mixture_is_the_standard_normal():
    z = np.random.default_rng(2).normal(size=(5, 3))
    expected = stats.norm.logpdf(z).sum(-1)
    standard = CodeMixture.standard(3)
    np.testing.assert_allclose(standard.log_density(z), expected, rtol=1e-12)
    np.testing.assert_allclose(standard.denoise(z, 0.3), 0.3**0.5 * z)


@pytest.mark.parametrize("alpha_bar", [0.01, 0.4, 1.0])
def test_denoiser_satisfies_tweedies_formula(alpha_bar):
    """E[z | z_t] = (z_t + (1 − ᾱ) ∇ log p_t(z_t)) / √ᾱ, where p_t is a mixture as well."""
    z_t = torch.tensor(np.random.default_rng(3).normal(size=(7, 3)), requires_grad=True)
    noisy = [alpha_bar * covariance(k) + (1 - alpha_bar) * np.eye(3) for k in range(2)]
    means = torch.tensor(alpha_bar**0.5 * MEANS)
    parts = [
        torch.distributions.MultivariateNormal(means[k], torch.tensor(noisy[k])).log_prob(z_t)
        + np.log(WEIGHTS[k])
        for k in range(2)
    ]
    (score,) = torch.autograd.grad(torch.logsumexp(torch.stack(parts), 0).sum(), z_t)
    expected = (z_t + (1 - alpha_bar) * score) / alpha_bar**0.5
    torch.testing.assert_close(MIXTURE.denoise(z_t, alpha_bar), expected)


def test_mean_log_density_is_a_bound_that_is_exact_for_one_component():
    mean, variance = np.array([0.3, -0.2, 0.5]), np.array([0.2, 0.1, 0.3])
    z = mean + np.sqrt(variance) * np.random.default_rng(7).standard_normal((200_000, 3))
    one = CodeMixture(np.ones(1), MEANS[:1], FACTORS[:1])
    expected = one.log_density(z).mean()
    np.testing.assert_allclose(one.mean_log_density(mean, variance), expected, rtol=0.01)
    bound = MIXTURE.mean_log_density(torch.tensor(mean), torch.tensor(variance))
    assert float(bound) < MIXTURE.log_density(z).mean()


def test_marginal_along_directions():
    directions = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 2)))[0]
    marginal = MIXTURE.along(directions)
    z = np.random.default_rng(5).normal(size=(6, 2))
    parts = [
        weight
        * stats.multivariate_normal(
            MEANS[k] @ directions, directions.T @ covariance(k) @ directions
        ).pdf(z)
        for k, weight in enumerate(WEIGHTS)
    ]
    np.testing.assert_allclose(marginal.log_density(z), np.log(sum(parts)), rtol=1e-9)


def test_fit_recovers_a_mixture_of_noisy_codes():
    """Codes have their own variances, which are part of the mixture's."""
    rng = np.random.default_rng(6)
    variances = np.full((6000, 3), 0.04)
    codes = MIXTURE.draw(rng, 6000)
    fitted = CodeMixture.fit(codes, variances, 2, rng)
    order = np.argsort(fitted.weights)
    np.testing.assert_allclose(fitted.weights[order], WEIGHTS, atol=0.03)
    np.testing.assert_allclose(fitted.means[order], MEANS, atol=0.08)
    for k, component in enumerate(order):
        found = fitted.factors[component] @ fitted.factors[component].T
        np.testing.assert_allclose(found, covariance(k) + 0.04 * np.eye(3), atol=0.08)
    variances = rng.uniform(0.01, 0.5, codes.shape)
    one = CodeMixture.fit(codes, variances, 1, rng)
    total = np.cov(codes.T, bias=True) + np.diag(variances.mean(axis=0)) + 1e-3 * np.eye(3)
    np.testing.assert_allclose(one.means[0], codes.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(one.factors[0] @ one.factors[0].T, total, atol=1e-9)
    assert fitted.log_density(codes).mean() > one.log_density(codes).mean() + 0.5


def test_invalid_arguments_are_rejected():
    for call, message in (
        (lambda: CodeMixture(WEIGHTS[:1], MEANS, FACTORS), "weights must have shape"),
        (lambda: CodeMixture(WEIGHTS, MEANS, FACTORS[:1]), "factors must have shape"),
        (lambda: CodeMixture(WEIGHTS, MEANS * np.nan, FACTORS), "means must be finite"),
        (lambda: CodeMixture(2 * WEIGHTS, MEANS, FACTORS), "weights must be positive with sum 1"),
        (
            lambda: CodeMixture.fit(np.zeros((3, 2)), np.ones((3, 2)), 2, None),
            "components must be at most half of the 3 codes, got 2",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()
