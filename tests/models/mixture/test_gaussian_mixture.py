"""Gaussian mixture prior against dense Gaussian algebra, numerical integrals and Monte Carlo."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, Skeleton
from probmotion.models import GaussianMixtureMotion
from probmotion.posteriors import protocols

K, R, L, J, A = 2, 2, 2, 3, 5
LEVELS = pytest.mark.parametrize("alpha_bar", [0.9999, 0.5, 0.01])
KINDS = pytest.mark.parametrize("kind", ["keypoints", "joints"])


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
    """Mixture with explicit covariance matrices, as a reference."""

    def __init__(self, prior, image=None):
        self.components = []
        P = np.kron(np.eye(L * J), np.eye(3) if image is None else image)
        for k in range(K):
            for yaw in prior.yaws:
                c, s = np.cos(yaw), np.sin(yaw)
                turn = np.kron(np.eye(L * J), [[c, 0, s], [0, 1, 0], [-s, 0, c]])
                W = turn @ prior.factors[k].reshape(R, -1).T
                covariance = W @ W.T + prior.noise**2 * np.eye(3 * L * J)
                mean = P @ turn @ prior.means[k].ravel()
                self.components.append((np.log(prior.weights[k] / A), mean, P @ covariance @ P.T))

    def log_densities(self, x):
        return np.array([lw + multivariate_normal(m, C).logpdf(x) for lw, m, C in self.components])

    def given(self, H, noise, y):
        """Return the probabilities, means and covariances given y = H x + ε, and log p(y)."""
        logs, means, covariances = [], [], []
        for log_weight, mean, C in self.components:
            S = H @ C @ H.T + noise
            gain = np.linalg.solve(S, H @ C).T
            logs.append(log_weight + multivariate_normal(H @ mean, S).logpdf(y))
            means.append(mean + gain @ (y - H @ mean))
            covariances.append(C - gain @ H @ C)
        total = logsumexp(logs)
        return np.exp(logs - total), np.array(means), np.array(covariances), total

    def denoise(self, x_t, alpha_bar, scale):
        """Return the mean and covariance of x₀ given one x_t, in normalised units."""
        identity = np.eye(len(x_t))
        H, noise = np.sqrt(alpha_bar) / scale * identity, (1 - alpha_bar) * identity
        mean, covariance = moments(*self.given(H, noise, x_t)[:3])
        return mean / scale, covariance / scale**2


def moments(w, means, covariances):
    mean = w @ means
    centred = means - mean
    return mean, np.tensordot(w, covariances, 1) + (w[:, None] * centred).T @ centred


def likelihood_of(kind, prior, motions):
    rng = np.random.default_rng(3)
    truth = Motion(motions[0], prior.skeleton, 30.0)
    hidden = rng.random((2, L, J)) < 0.4
    if kind == "joints":
        return Joints3D.observe(truth, 0.3, 0, hidden=hidden[0])
    cameras = Cameras.ring(2, elevation=0.2, start=0.4)
    return Keypoints2D.observe(truth, cameras, 0.1, 0, hidden=hidden)


@pytest.fixture(scope="module")
def prior():
    return small_prior()


@pytest.fixture(scope="module")
def motions(prior):
    return prior.sample(np.random.default_rng(1), 4)


def test_implements_every_prior_protocol(prior):
    names = (
        "MotionPrior Samplable HasLogDensity Marginalises HasExactPosterior Denoises2D Denoises3D "
        "DenoiserCovariance2D DenoiserCovariance3D"
    )
    for name in names.split():
        assert isinstance(prior, getattr(protocols, name)), name


def test_log_density_and_style_responsibilities_match_dense_algebra(prior, motions):
    flat = motions.reshape(4, -1)
    logs = Dense(prior).log_densities(flat)
    total = logsumexp(logs, axis=0)
    for value in (
        prior.log_prior(motions),
        prior.exact_posterior(None).log_density(motions),
        small_prior("positions").log_density(flat),
    ):
        np.testing.assert_allclose(value, total, rtol=0, atol=1e-10)
    p = np.exp(logs - total).reshape(K, A, 4).sum(axis=1).T
    np.testing.assert_allclose(prior.style_responsibilities(motions), p, atol=1e-10)


@pytest.mark.parametrize("name", ["torch", "jax"])
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-4)])
def test_densities_agree_across_array_libraries(prior, motions, name, dtype, tolerance):
    jax, torch = pytest.importorskip("jax"), pytest.importorskip("torch")
    likelihood = likelihood_of("keypoints", prior, motions)
    posterior = prior.exact_posterior(likelihood)
    theta = np.random.default_rng(2).normal(size=(3, R))
    positions = MotionPosterior(small_prior("positions"), likelihood)

    def evaluate(function, x):
        if name == "torch":
            return function(torch.asarray(x, dtype=getattr(torch, dtype))).numpy()
        return np.asarray(jax.jit(function)(jax.numpy.asarray(x, dtype=dtype)))

    with jax.enable_x64(dtype == "float64"):
        for function, x in (
            (prior.log_prior, motions),
            (prior.log_density, theta),
            (posterior.log_likelihood, theta),
            (posterior.log_density, motions),
            (MotionPosterior(prior, likelihood).log_density, theta),
            (positions.log_density, motions.reshape(4, -1)),
        ):
            got = evaluate(function, x)
            assert got.dtype == dtype
            np.testing.assert_allclose(got, function(x), rtol=tolerance, atol=tolerance)
            assert evaluate(function, x[:0]).shape == (0,)


@LEVELS
def test_denoisers_and_covariances_match_dense_algebra(prior, alpha_bar):
    # Azimuths are off the prior's grid and unevenly spaced, and elevations differ.
    cameras = Cameras.around(np.array([0.3, 2.0, 4.0]), np.array([0.3, 0.0, -0.2]))
    rng = np.random.default_rng(5)
    X, V = rng.normal(size=(2, 4, L, J, 3))
    x, v = rng.normal(size=(2, 4, 3, L, J, 2))
    mean = prior.denoise(x, alpha_bar, cameras)
    product = prior.view_covariance(x, alpha_bar, cameras)(v)
    product_3d = prior.motion_covariance(X, alpha_bar)(V)
    views = [(x[:, i], v[:, i], mean[:, i], product[:, i]) for i in range(3)]
    results = [(X, V, prior.denoise_motion(X, alpha_bar), product_3d), *views]
    images = [None, *cameras.image_axes]
    for image, (noisy, vectors, means, products) in zip(images, results, strict=True):
        dense = Dense(prior, image)
        for row in range(4):
            m, C = dense.denoise(noisy[row].ravel(), alpha_bar, prior.scale)
            np.testing.assert_allclose(means[row].ravel(), m, rtol=0, atol=1e-10)
            expected = C @ vectors[row].ravel()
            np.testing.assert_allclose(products[row].ravel(), expected, rtol=0, atol=1e-10)


@KINDS
def test_posterior_density_satisfies_bayes_rule(prior, motions, kind):
    likelihood = likelihood_of(kind, prior, motions)
    posterior = prior.exact_posterior(likelihood)
    X = np.concatenate([motions, posterior.sample(np.random.default_rng(8), 4)])
    bayes = prior.log_prior(X) + likelihood.log_density(X) - posterior.log_density(X)
    np.testing.assert_allclose(bayes, posterior.log_marginal_likelihood, rtol=0, atol=1e-9)


@KINDS
def test_latent_likelihood_integrates_to_the_marginal_likelihood(prior, motions, kind):
    """The trapezoidal rule computes log p(y) = log ∫ p(y|z) p(z) dz."""
    posterior = prior.exact_posterior(likelihood_of(kind, prior, motions))
    node, step = np.linspace(-8, 8, 161, retstep=True)
    grid = np.stack(np.meshgrid(node, node), axis=-1).reshape(-1, 2)
    total = logsumexp(prior.log_density(grid) + posterior.log_likelihood(grid)) + 2 * np.log(step)
    assert total == pytest.approx(posterior.log_marginal_likelihood, abs=1e-6)


@KINDS
def test_posterior_and_its_draws_match_dense_algebra(prior, motions, kind):
    likelihood = likelihood_of(kind, prior, motions)
    axes, target, precision = likelihood.linear()
    rows, y, noise = [], [], []
    for v, frame, joint in np.argwhere(precision > 0):
        for m in range(axes.shape[1]):
            row = np.zeros((L, J, 3))
            row[frame, joint] = axes[v, m]
            rows.append(row.ravel())
            y.append(target[v, frame, joint, m])
            noise.append(1 / precision[v, frame, joint])
    p, means, covariances, total = Dense(prior).given(np.array(rows), np.diag(noise), np.array(y))
    posterior = prior.exact_posterior(likelihood)
    assert posterior.log_marginal_likelihood == pytest.approx(total, abs=1e-9)
    np.testing.assert_allclose(posterior.component_probabilities.ravel(), p, atol=1e-10)
    mean, covariance = moments(p, means, covariances)
    np.testing.assert_allclose(posterior.mean().ravel(), mean, atol=1e-10)
    root = posterior._latent_root
    expected = np.linalg.inv(posterior._latent_precision)
    np.testing.assert_allclose(root @ np.swapaxes(root, -1, -2), expected, atol=1e-12)
    n = 20_000
    X = posterior.sample(np.random.default_rng(9), n).reshape(n, -1) - mean
    assert (np.abs(X.mean(axis=0)) < 5 * np.sqrt(np.diag(covariance) / n)).all()
    squares = X[:, :, None] * X[:, None, :]
    # The 171 entries for each kind are compared at 5 standard errors.
    error = squares.std(axis=0) / np.sqrt(n)
    assert (np.abs(squares.mean(axis=0) - covariance) < 5 * error).all()


def test_completed_draws_of_theta_have_the_posterior_mean(prior, motions):
    """Draw z ~ p(z|y) by importance resampling, then X ~ p(X|z, y)."""
    rng = np.random.default_rng(10)
    likelihood = likelihood_of("joints", prior, motions)
    posterior = prior.exact_posterior(likelihood)
    n = 10_000
    z = rng.normal(size=(100_000, R))
    w = np.exp(posterior.log_likelihood(z))
    w /= w.sum()
    chosen = rng.choice(len(z), size=n, p=w)
    X = MotionPosterior(prior, likelihood).complete(z[chosen], rng).reshape(n, -1)
    error = X.std(axis=0) * np.sqrt(1 / n + (w**2).sum())
    assert (np.abs(X.mean(axis=0) - posterior.mean().ravel()) < 5 * error).all()


def test_off_manifold_ratio_and_scale_match_prior_draws(prior):
    draws = prior.sample(np.random.default_rng(11), 20_000)
    assert np.sqrt((draws**2).mean()) == pytest.approx(prior.scale, rel=0.02)
    ratio = prior.off_manifold(draws)
    # A few draws are assigned to a wrong component.
    assert ratio.mean() == pytest.approx(1.0, abs=5 * ratio.std() / np.sqrt(20_000) + 0.005)


@LEVELS
def test_reduction_commutes_with_projection_and_denoising(alpha_bar):
    rng = np.random.default_rng(12)
    frames, joints = 6, 8
    prior = GaussianMixtureMotion(
        skeleton=Skeleton([f"j{j}" for j in range(joints)], [-1] * joints),
        fps=30.0,
        means=rng.normal(size=(2, frames, joints, 3)),
        factors=0.3 * rng.normal(size=(2, 3, frames, joints, 3)),
        weights=np.array([0.7, 0.3]),
        noise=0.05,
        azimuths=8,
    )
    reduced, basis = prior.reduced()
    M = basis.shape[1]
    assert M == 2 * 4 * 3 < frames * joints
    cameras = Cameras.ring(3, elevation=0.3)
    X = prior.sample(rng, 5) / prior.scale
    x_t = np.sqrt(alpha_bar) * X + np.sqrt(1 - alpha_bar) * rng.normal(size=X.shape)
    y_t = (basis.T @ x_t.reshape(5, -1, 3)).reshape(5, 1, M, 3)
    # Outside the span there is only noise, whose posterior mean is a fixed fraction of x_t.
    outside = x_t.reshape(5, -1, 3) - basis @ y_t[:, 0]
    variance = (prior.noise / prior.scale) ** 2
    fraction = np.sqrt(alpha_bar) * variance / (alpha_bar * variance + 1 - alpha_bar)
    recovered = basis @ reduced.denoise_motion(y_t, alpha_bar)[:, 0] + fraction * outside
    full = prior.denoise_motion(x_t, alpha_bar).reshape(5, -1, 3)
    np.testing.assert_allclose(recovered, full, rtol=0, atol=2e-13)
    projected, projected_small = cameras.project(x_t), cameras.project(y_t)
    np.testing.assert_allclose(
        basis.T @ projected.reshape(5, 3, -1, 2), projected_small[:, :, 0], rtol=0, atol=1e-13
    )
    views = prior.denoise(projected, alpha_bar, cameras).reshape(5, 3, -1, 2)
    views_small = reduced.denoise(projected_small, alpha_bar, cameras)[:, :, 0]
    np.testing.assert_allclose(basis.T @ views, views_small, rtol=0, atol=2e-13)


def test_deep_copy_drops_caches_and_keeps_results(prior, motions):
    likelihood = likelihood_of("joints", prior, motions)
    values = [
        mixture.exact_posterior(likelihood).log_density(motions)
        for mixture in (prior, copy.deepcopy(prior))
    ]
    np.testing.assert_array_equal(*values)


def test_unsupported_likelihoods_and_cameras_are_rejected(prior, motions):
    truth = Motion(motions[0], prior.skeleton, 30.0)
    camera = Cameras.ring(1, perspective=True)
    with pytest.raises(protocols.NotConjugate, match="perspective"):
        prior.exact_posterior(Keypoints2D.observe(truth, camera, 0.1, 0))
    with pytest.raises(protocols.NotConjugate, match="Student-t"):
        prior.exact_posterior(Joints3D.observe(truth, 0.1, 0, degrees_of_freedom=4.0))
    with pytest.raises(protocols.OrthographicOnly, match="cameras must be orthographic, got persp"):
        prior.denoise(np.zeros((1, 1, L, J, 2)), 0.5, camera)
    with pytest.raises(ValueError, match="coordinates must be 'positions', got 'latent'"):
        prior.motion(np.zeros(R))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise": 0.0}, "noise must be a finite number above 0, got 0.0"),
        ({"weights": np.array([0.5, 0.6])}, "weights must be positive and sum to 1"),
        ({"azimuths": 0}, "azimuths must be an integer of at least 1, got 0"),
        ({"coordinates": "polar"}, "coordinates must be 'latent' or 'positions', got 'polar'"),
        ({"means": np.zeros((K, L, J, 2))}, "means must have shape"),
        ({"factors": np.full((K, R, L, J, 3), np.nan)}, "factors must be finite"),
        ({"styles": ("walk",)}, "styles must contain 2 names, one per mean, got 1"),
    ],
)
def test_invalid_parameters_are_rejected(prior, change, message):
    names = ("skeleton", "fps", "means", "factors", "weights", "noise", "azimuths")
    with pytest.raises(ValueError, match=message):
        GaussianMixtureMotion(**({name: getattr(prior, name) for name in names} | change))
