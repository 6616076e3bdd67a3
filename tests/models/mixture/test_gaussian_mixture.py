"""The exact prior against brute force: dense Gaussian algebra, derivatives, Monte Carlo."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import (
    DenoiserCovariance2D,
    DenoiserCovariance3D,
    Denoises2D,
    Denoises3D,
    HasExactPosterior,
    HasLogDensity,
    Marginalises,
    MotionPrior,
    NotConjugate,
    Samplable,
)

K, R, L, J, A = 2, 2, 2, 3, 5
LEVELS = (0.9999, 0.5, 0.01)


def small_prior(coordinates="latent"):
    rng = np.random.default_rng(0)
    return GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b", "c"], [-1, 0, 0]),
        fps=30.0,
        means=rng.normal(size=(K, L, J, 3)),
        factors=0.4 * rng.normal(size=(K, R, L, J, 3)),
        weights=np.array([0.6, 0.4]),
        noise=0.2,
        azimuths=A,
        coordinates=coordinates,
    )


class Dense:
    """The same mixture with every covariance written out; slow and plain."""

    def __init__(self, prior, image=None):
        self.components = []
        image = np.eye(3) if image is None else image
        P = np.kron(np.eye(L * J), image)
        for k in range(K):
            for yaw in prior.yaws:
                c, s = np.cos(yaw), np.sin(yaw)
                turn = np.kron(np.eye(L * J), [[c, 0, s], [0, 1, 0], [-s, 0, c]])
                W = turn @ prior.factors[k].reshape(R, -1).T
                covariance = W @ W.T + prior.noise**2 * np.eye(3 * L * J)
                self.components.append(
                    (
                        np.log(prior.weights[k] / A),
                        P @ turn @ prior.means[k].ravel(),
                        P @ covariance @ P.T,
                    )
                )

    def log_density(self, x):
        return logsumexp(
            [lw + multivariate_normal(m, C).logpdf(x) for lw, m, C in self.components], axis=0
        )

    def denoise(self, x, alpha_bar, scale):
        """Mean and covariance of x₀ given one x_t."""
        weights, means, covariances = [], [], []
        a = np.sqrt(alpha_bar)
        for log_weight, mean, covariance in self.components:
            mean, covariance = mean / scale, covariance / scale**2
            noisy = alpha_bar * covariance + (1 - alpha_bar) * np.eye(len(mean))
            weights.append(log_weight + multivariate_normal(a * mean, noisy).logpdf(x))
            gain = a * np.linalg.solve(noisy, covariance).T
            means.append(mean + gain @ (x - a * mean))
            covariances.append(covariance - a * gain @ covariance)
        w = np.exp(np.array(weights) - logsumexp(weights))
        mean = w @ np.array(means)
        apart = np.array(means) - mean
        return mean, np.tensordot(w, covariances, 1) + (w[:, None] * apart).T @ apart


def likelihoods(prior, motions):
    rng = np.random.default_rng(3)
    truth = Motion(motions[0], prior.skeleton, 30.0)
    hidden = rng.random((2, L, J)) < 0.4
    cameras = Cameras.ring(2, elevation=0.2, start=0.4)
    return {
        "keypoints": Keypoints2D.observe(truth, cameras, 0.1, 0, hidden=hidden),
        "joints": Joints3D.observe(truth, 0.3, 0, hidden=hidden[0]),
    }


@pytest.fixture(scope="module")
def prior():
    return small_prior()


@pytest.fixture(scope="module")
def motions(prior):
    return prior.sample(np.random.default_rng(1), 4)


def test_can_do_everything(prior):
    for protocol in (
        MotionPrior,
        Samplable,
        HasLogDensity,
        Marginalises,
        Denoises2D,
        Denoises3D,
        DenoiserCovariance2D,
        DenoiserCovariance3D,
        HasExactPosterior,
    ):
        assert isinstance(prior, protocol), protocol.__name__


def test_log_density_is_the_dense_mixtures(prior, motions):
    expected = Dense(prior).log_density(motions.reshape(4, -1))
    np.testing.assert_allclose(prior.log_prior(motions), expected, rtol=0, atol=1e-10)
    posterior = prior.exact_posterior(None)
    np.testing.assert_allclose(posterior.log_density(motions), expected, rtol=0, atol=1e-10)
    assert posterior.log_marginal_likelihood == pytest.approx(0, abs=1e-12)
    whole = small_prior("positions")
    np.testing.assert_allclose(
        whole.log_density(motions.reshape(4, -1)), expected, rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("library", ["torch", "jax"])
def test_densities_agree_in_every_library(prior, motions, library):
    evidence = likelihoods(prior, motions)["keypoints"]
    posterior = prior.exact_posterior(evidence)
    theta = np.random.default_rng(2).normal(size=(3, R))
    functions = [
        (prior.log_prior, motions),
        (prior.log_density, theta),
        (posterior.log_likelihood, theta),
        (posterior.log_density, motions),
        (MotionPosterior(prior, evidence).log_density, theta),
        (MotionPosterior(small_prior("positions"), evidence).log_density, motions.reshape(4, -1)),
    ]
    for function, x in functions:
        expected = function(x)
        for dtype, tolerance in (("float64", 1e-10), ("float32", 1e-4)):
            if library == "torch":
                import torch

                got = function(torch.asarray(x, dtype=getattr(torch, dtype))).numpy()
                empty = function(torch.asarray(x[:0], dtype=getattr(torch, dtype)))
            else:
                import jax

                with jax.enable_x64(dtype == "float64"):
                    got = np.asarray(jax.jit(function)(jax.numpy.asarray(x, dtype=dtype)))
                    empty = function(jax.numpy.asarray(x[:0], dtype=dtype))
            assert got.dtype == dtype
            assert tuple(empty.shape) == (0,)
            np.testing.assert_allclose(got, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("alpha_bar", LEVELS)
def test_3d_denoiser_and_covariance_are_the_dense_ones(prior, alpha_bar):
    rng = np.random.default_rng(4)
    x, v = rng.normal(size=(2, 4, L, J, 3))
    dense = Dense(prior)
    expected = [dense.denoise(row.ravel(), alpha_bar, prior.scale) for row in x]
    mean = prior.denoise_motion(x, alpha_bar).reshape(4, -1)
    np.testing.assert_allclose(mean, [m for m, _ in expected], rtol=0, atol=1e-10)
    product = prior.motion_covariance_product(x, alpha_bar, v).reshape(4, -1)
    truth = [C @ row.ravel() for (_, C), row in zip(expected, v, strict=True)]
    np.testing.assert_allclose(product, truth, rtol=0, atol=1e-10)


@pytest.mark.parametrize("alpha_bar", LEVELS)
def test_2d_denoiser_and_covariance_are_the_dense_ones(prior, alpha_bar):
    rng = np.random.default_rng(5)
    # Neither evenly placed nor on the prior's grid of azimuths, and at two elevations.
    cameras = Cameras.around(np.array([0.3, 2.0, 4.0]), np.array([0.3, 0.0, -0.2]))
    x, v = rng.normal(size=(2, 4, 3, L, J, 2))
    mean = prior.denoise(x, alpha_bar, cameras)
    product = prior.view_covariance_product(x, alpha_bar, cameras, v)
    for view, image in enumerate(cameras.image_axes):
        dense = Dense(prior, image)
        for row in range(4):
            m, C = dense.denoise(x[row, view].ravel(), alpha_bar, prior.scale)
            np.testing.assert_allclose(mean[row, view].ravel(), m, rtol=0, atol=1e-10)
            np.testing.assert_allclose(
                product[row, view].ravel(), C @ v[row, view].ravel(), rtol=0, atol=1e-10
            )


@pytest.mark.parametrize("alpha_bar", LEVELS)
def test_denoiser_is_tweedies(prior, alpha_bar):
    """E[x₀|x_t] = (x_t + (1−ᾱ) ∇ log p(x_t)) / √ᾱ, with a numerical derivative."""
    x = 0.7 * np.random.default_rng(6).normal(size=(L, J, 3))
    mixture = prior._normalised
    step = 1e-5
    gradient = np.empty(x.size)
    for i in range(x.size):
        shift = np.zeros(x.size)
        shift[i] = step
        ends = np.stack([x.ravel() + shift, x.ravel() - shift])
        above, below = mixture.log_density(ends, alpha_bar)
        gradient[i] = (above - below) / (2 * step)
    expected = (x.ravel() + (1 - alpha_bar) * gradient) / np.sqrt(alpha_bar)
    np.testing.assert_allclose(
        prior.denoise_motion(x[None], alpha_bar).ravel(), expected, atol=1e-6
    )


def test_denoiser_is_the_mean_of_draws_weighted_by_their_noise(prior):
    """Monte Carlo of E[X₀ | X_t], self-normalised, within five of its own standard errors."""
    alpha_bar = 0.05
    rng = np.random.default_rng(7)
    clean = prior.sample(rng, 200_000).reshape(200_000, -1) / prior.scale
    x = np.sqrt(alpha_bar) * clean[0] + np.sqrt(1 - alpha_bar) * rng.normal(size=clean.shape[1])
    log_w = -0.5 * ((x - np.sqrt(alpha_bar) * clean) ** 2).sum(axis=1) / (1 - alpha_bar)
    w = np.exp(log_w - logsumexp(log_w))
    mean = w @ clean
    error = np.sqrt((w[:, None] ** 2 * (clean - mean) ** 2).sum(axis=0))
    got = prior.denoise_motion(x.reshape(1, L, J, 3), alpha_bar).ravel()
    assert (np.abs(got - mean) < 5 * error).all()


@pytest.mark.parametrize("kind", ["keypoints", "joints"])
def test_posterior_density_is_bayes(prior, motions, kind):
    """log p(X|y) − log p(X) − log p(y|X) is −log p(y), the same at every X."""
    evidence = likelihoods(prior, motions)[kind]
    posterior = prior.exact_posterior(evidence)
    X = np.concatenate([motions, posterior.sample(np.random.default_rng(8), 4)])
    bayes = prior.log_prior(X) + evidence.log_density(X) - posterior.log_density(X)
    np.testing.assert_allclose(bayes, posterior.log_marginal_likelihood, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["keypoints", "joints"])
def test_latent_likelihood_integrates_to_the_evidence(prior, motions, kind):
    """log p(y) = log ∫ p(y|z) p(z) dz; the trapezoidal rule is exact to rounding here."""
    posterior = prior.exact_posterior(likelihoods(prior, motions)[kind])
    node, step = np.linspace(-8, 8, 401, retstep=True)
    grid = np.stack(np.meshgrid(node, node), axis=-1).reshape(-1, 2)
    total = logsumexp(prior.log_density(grid) + posterior.log_likelihood(grid)) + 2 * np.log(step)
    assert total == pytest.approx(posterior.log_marginal_likelihood, abs=1e-6)


@pytest.mark.parametrize("kind", ["keypoints", "joints"])
def test_posterior_draws_have_its_moments_by_importance_sampling(prior, motions, kind):
    """Prior draws weighted by the likelihood against exact draws: means and second moments."""
    rng = np.random.default_rng(9)
    evidence = likelihoods(prior, motions)[kind]
    posterior = prior.exact_posterior(evidence)
    exact = posterior.sample(rng, 20_000).reshape(20_000, -1)
    # Proposals near the evidence: exact draws of the same posterior under twice the noise.
    wide = type(evidence)(
        **{
            name: getattr(evidence, name)
            for name in ("keypoints", "joints", "cameras", "confidence")
            if hasattr(evidence, name)
        },
        noise=2 * evidence.noise,
    )
    from_wide = prior.exact_posterior(wide).sample(rng, 60_000)
    log_w = evidence.log_density(from_wide) - wide.log_density(from_wide)
    w = np.exp(log_w - logsumexp(log_w))
    assert 1 / (w**2).sum() > 1000
    flat = from_wide.reshape(len(from_wide), -1)
    for power in (1, 2):
        weighted = w @ flat**power
        error = np.sqrt((w[:, None] ** 2 * (flat**power - weighted) ** 2).sum(axis=0))
        error = np.hypot(error, (exact**power).std(axis=0) / np.sqrt(len(exact)))
        # 18 coordinates x 2 powers x 2 kinds at 5 sigma: fewer than 1 false alarm in 20 000.
        assert (np.abs((exact**power).mean(axis=0) - weighted) < 5 * error).all()
    error = exact.std(axis=0) / np.sqrt(len(exact))
    assert (np.abs(exact.mean(axis=0) - posterior.mean().ravel()) < 5 * error).all()


def test_posterior_draws_of_one_component_have_the_dense_covariance():
    rng = np.random.default_rng(13)
    rank, joints = 3, 3
    prior = GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b", "c"], [-1, 0, 0]),
        fps=30.0,
        means=rng.normal(size=(1, 1, joints, 3)),
        factors=rng.normal(size=(1, rank, 1, joints, 3)),
        weights=np.ones(1),
        noise=0.1,
        azimuths=1,
    )
    evidence = Joints3D(rng.normal(size=(1, joints, 3)), 0.5, np.array([[1.0, 0.0, 0.3]]))
    W = prior.factors.reshape(rank, -1).T
    precision = np.repeat(evidence.confidence.ravel() / 0.5**2, 3)
    covariance = np.linalg.inv(np.linalg.inv(W @ W.T + 0.1**2 * np.eye(9)) + np.diag(precision))
    n = 40_000
    X = prior.exact_posterior(evidence).sample(rng, n).reshape(n, -1)
    # The standard error of entry (i, j) is √((C_ii C_jj + C_ij²) / n); 45 entries at 5 sigma.
    spread = np.sqrt(np.diag(covariance))
    error = np.sqrt((np.outer(spread, spread) ** 2 + covariance**2) / n)
    assert (np.abs(np.cov(X.T) - covariance) < 5 * error).all()


def test_draws_of_theta_completed_are_draws_of_the_posterior(prior, motions):
    """X drawn from p(X|z,y), z from p(z|y) by quadrature, has the exact posterior's mean."""
    rng = np.random.default_rng(10)
    evidence = likelihoods(prior, motions)["joints"]
    posterior = prior.exact_posterior(evidence)
    z = rng.normal(size=(200_000, R))
    log_w = posterior.log_likelihood(z)
    kept = rng.choice(len(z), size=20_000, p=np.exp(log_w - logsumexp(log_w)))
    X = MotionPosterior(prior, evidence).complete(rng, z[kept]).reshape(20_000, -1)
    error = X.std(axis=0) * np.sqrt((1 + 20_000 * np.exp(2 * log_w).sum()
                                     / np.exp(log_w).sum() ** 2) / 20_000)  # fmt: skip
    assert (np.abs(X.mean(axis=0) - posterior.mean().ravel()) < 5 * error).all()


def test_component_probabilities_are_the_dense_ones(prior, motions):
    evidence = likelihoods(prior, motions)["keypoints"]
    axes, target, precision = evidence.linear()
    rows, values = [], []
    for v, frame, joint in np.argwhere(precision > 0):
        for m in range(2):
            row = np.zeros((L, J, 3))
            row[frame, joint] = axes[v, m]
            rows.append(row.ravel())
            values.append(target[v, frame, joint, m])
    H = np.array(rows)
    logs = [
        lw + multivariate_normal(H @ mean, H @ C @ H.T + 0.1**2 * np.eye(len(H))).logpdf(values)
        for lw, mean, C in Dense(prior).components
    ]
    posterior = prior.exact_posterior(evidence)
    assert posterior.log_marginal_likelihood == pytest.approx(logsumexp(logs), abs=1e-9)
    np.testing.assert_allclose(
        posterior.component_probabilities.ravel(), np.exp(logs - logsumexp(logs)), atol=1e-10
    )


def test_off_manifold_is_one_for_the_priors_own_draws(prior):
    off = prior.off_manifold(prior.sample(np.random.default_rng(11), 20_000))
    # The mean square of D − r = 16 normal numbers, but for few draws given to a wrong component.
    assert off.mean() == pytest.approx(1.0, abs=5 * off.std() / np.sqrt(20_000) + 0.005)


def test_style_responsibilities_are_the_dense_ones(prior, motions):
    logs = np.array(
        [
            lw + multivariate_normal(m, C).logpdf(motions.reshape(4, -1))
            for lw, m, C in Dense(prior).components
        ]
    )
    p = np.exp(logs - logsumexp(logs, axis=0)).reshape(K, A, 4).sum(axis=1).T
    np.testing.assert_allclose(prior.style_responsibilities(motions), p, atol=1e-10)


def test_turning_by_a_step_of_the_grid_changes_nothing(prior, motions):
    turned = np.stack(
        [Motion(X, prior.skeleton, 30.0).turned(prior.yaws[1]).positions for X in motions]
    )
    np.testing.assert_allclose(prior.log_prior(turned), prior.log_prior(motions), atol=1e-10)


def test_reduced_prior_loses_nothing():
    """Denoising, turning, projecting commute with the reduction, to 1e-13."""
    rng = np.random.default_rng(12)
    frames, joints = 6, 8
    prior = GaussianMixtureMotion(
        skeleton=Skeleton([f"j{j}" for j in range(joints)], [-1] + [0] * (joints - 1)),
        fps=30.0,
        means=rng.normal(size=(2, frames, joints, 3)),
        factors=0.3 * rng.normal(size=(2, 3, frames, joints, 3)),
        weights=np.array([0.7, 0.3]),
        noise=0.05,
        azimuths=8,
    )
    reduced, basis = prior.reduced()
    M = basis.shape[1]
    assert M == 2 * 4 * 3
    assert frames * joints > M
    cameras = Cameras.ring(3, elevation=0.3)
    for alpha_bar in LEVELS:
        X = prior.sample(rng, 5) / prior.scale
        x_t = np.sqrt(alpha_bar) * X + np.sqrt(1 - alpha_bar) * rng.normal(size=X.shape)
        y_t = (basis.T @ x_t.reshape(5, -1, 3)).reshape(5, 1, M, 3)
        # What lies outside the span is only noise: its denoised value is its prior share of x_t.
        outside = x_t.reshape(5, -1, 3) - basis @ y_t[:, 0]
        variance = (prior.noise / prior.scale) ** 2
        share = np.sqrt(alpha_bar) * variance / (alpha_bar * variance + 1 - alpha_bar)
        back = basis @ reduced.denoise_motion(y_t, alpha_bar)[:, 0] + share * outside
        whole = prior.denoise_motion(x_t, alpha_bar).reshape(5, -1, 3)
        np.testing.assert_allclose(back, whole, rtol=0, atol=2e-13)
        seen = cameras.project(x_t)
        seen_small = cameras.project(y_t)
        np.testing.assert_allclose(
            basis.T @ seen.reshape(5, 3, -1, 2), seen_small[:, :, 0], rtol=0, atol=1e-13
        )
        views = prior.denoise(seen, alpha_bar, cameras).reshape(5, 3, -1, 2)
        views_small = reduced.denoise(seen_small, alpha_bar, cameras)[:, :, 0]
        np.testing.assert_allclose(basis.T @ views, views_small, rtol=0, atol=2e-13)


def test_survives_the_way_to_another_process(prior, motions):
    """A copy (what a worker process receives) leaves the caches behind; the answers stay."""
    evidence = likelihoods(prior, motions)["joints"]
    before = prior.exact_posterior(evidence).log_density(motions)
    again = copy.deepcopy(prior)
    np.testing.assert_array_equal(again.exact_posterior(evidence).log_density(motions), before)


def test_says_why_there_is_no_closed_form(prior, motions):
    truth = Motion(motions[0], prior.skeleton, 30.0)
    perspective = Keypoints2D.observe(truth, Cameras.ring(1, perspective=True), 0.1, 0)
    with pytest.raises(NotConjugate, match="cameras are perspective"):
        prior.exact_posterior(perspective)
    heavy = Joints3D.observe(truth, 0.1, 0, degrees_of_freedom=4.0)
    with pytest.raises(NotConjugate, match="Student-t with 4 degrees of freedom"):
        prior.exact_posterior(heavy)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"noise": 0.0}, "noise must be a finite number above 0, got 0.0"),
        ({"weights": np.array([0.5, 0.6])}, "expected numbers above 0 that sum to 1"),
        ({"azimuths": 0}, "azimuths must be an integer of at least 1, got 0"),
        ({"coordinates": "polar"}, "coordinates must be 'latent' or 'positions', got 'polar'"),
        ({"means": np.zeros((K, L, J, 2))}, r"means has shape \(2, 2, 3, 2\), expected"),
        ({"factors": np.full((K, R, L, J, 3), np.nan)}, "factors has .* NaN or infinite"),
        ({"styles": ("walk",)}, "styles has 1 names, expected 2"),
    ],
)
def test_wrong_input_is_one_sentence(prior, change, sentence):
    given = {
        name: getattr(prior, name)
        for name in ("skeleton", "fps", "means", "factors", "weights", "noise", "azimuths")
    }
    with pytest.raises(ValueError, match=sentence):
        GaussianMixtureMotion(**(given | change))


def test_perspective_views_have_no_exact_denoiser(prior):
    with pytest.raises(ValueError, match="cameras must be orthographic, got perspective"):
        prior.denoise(np.zeros((1, 1, L, J, 2)), 0.5, Cameras.ring(1, perspective=True))


def test_a_motion_at_a_latent_point_is_a_draw(prior):
    with pytest.raises(ValueError, match="coordinates is 'latent'"):
        prior.motion(np.zeros(R))
