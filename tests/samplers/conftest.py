"""Priors with dense linear algebra for tests of samplers: a Gaussian and a bimodal mixture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from probmotion import Cameras, Keypoints2D, Motion, MotionPosterior
from probmotion.arrays import array_namespace, constant, logsumexp
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.samplers.variational.amortised import AmortisedPosterior


@dataclass(frozen=True, eq=False)
class GaussianMotion:
    """Prior X ~ N(mean, covariance) over positions (L, J, 3), metres, with coordinates as in X."""

    mean: np.ndarray
    covariance: np.ndarray
    scale: float = 1.0
    fps: float = 20.0

    @property
    def skeleton(self):
        n_joints = self.mean.shape[1]
        return Skeleton([f"joint-{j}" for j in range(n_joints)], [-1] * n_joints)

    @property
    def frames(self):
        return len(self.mean)

    @property
    def dim(self):
        return self.mean.size

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], *self.mean.shape)

    def sample(self, rng, n):
        noise = rng.standard_normal((n, self.dim)) @ np.linalg.cholesky(self.covariance).T
        return self.mean + noise.reshape(n, *self.mean.shape)

    def posterior(self, likelihood):
        """Return the mean (L, J, 3) and covariance given linear Gaussian observations."""
        axes, target, precision = likelihood.linear()
        information = np.linalg.inv(self.covariance)
        shift = information @ self.mean.ravel()
        for view, y, weights in zip(axes, target, precision, strict=True):
            rows = np.kron(np.eye(weights.size), view)
            weight = np.repeat(weights.ravel(), len(view))
            information = information + rows.T @ (weight[:, None] * rows)
            shift = shift + rows.T @ (weight * y.ravel())
        covariance = np.linalg.inv(information)
        return (covariance @ shift).reshape(self.mean.shape), covariance

    def given(self, likelihood):
        mean, covariance = self.posterior(likelihood)
        return replace(self, mean=mean, covariance=covariance)

    def denoise_motion(self, x_t, alpha_bar):
        return self._denoise(np.eye(3), x_t, alpha_bar)

    def motion_covariance(self, x_t, alpha_bar):
        return lambda vectors: self._denoise(np.eye(3), vectors, alpha_bar, covariance=True)

    def denoise(self, x_t, alpha_bar, cameras, **options):
        """Like a network, treat every camera as orthographic."""
        axes = cameras.as_orthographic().image_axes
        views = [self._denoise(P, x_t[:, v], alpha_bar, **options) for v, P in enumerate(axes)]
        return np.stack(views, axis=1)

    def view_covariance(self, x_t, alpha_bar, cameras):
        return lambda vectors: self.denoise(vectors, alpha_bar, cameras, covariance=True)

    def _denoise(self, axes, x, alpha_bar, covariance=False):
        """Return E[x₀ | x_t = x] along the axes, or Cov[x₀ | x_t] x."""
        rows = np.kron(np.eye(self.dim // 3), axes)
        mean, prior = rows @ self.mean.ravel() / self.scale, rows @ self.covariance @ rows.T
        prior = prior / self.scale**2
        noisy = alpha_bar * prior + (1 - alpha_bar) * np.eye(len(mean))
        gain = np.sqrt(alpha_bar) * np.linalg.solve(noisy, prior)
        flat = x.reshape(len(x), -1)
        if covariance:
            return (flat @ (prior - np.sqrt(alpha_bar) * prior @ gain)).reshape(x.shape)
        return (mean + (flat - np.sqrt(alpha_bar) * mean) @ gain).reshape(x.shape)


@pytest.fixture(scope="session")
def gaussian_motion():
    """Return the class of Gaussian priors."""
    return GaussianMotion


@pytest.fixture(scope="session")
def gaussian():
    """Return a Gaussian prior without symmetry over 2 frames of 2 joints, with mean and scale."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(12, 12)) * 0.3
    return GaussianMotion(
        rng.normal(size=(2, 2, 3)) * 0.5, root @ root.T + 0.02 * np.eye(12), scale=0.7
    )


@pytest.fixture(scope="session")
def assert_covariance():
    """Return a function that compares second moments about 0 with a covariance, by entry.

    An entry of the sample covariance of n whitened draws has standard deviation 1/√n (√2/√n on the
    diagonal); in 12 dimensions one exceeds five deviations with probability 1/20 000.
    """

    def check(draws, covariance):
        n = len(draws)
        white = np.linalg.solve(np.linalg.cholesky(covariance), draws.reshape(n, -1).T)
        error = white @ white.T / n - np.eye(len(covariance))
        limit = 5 * np.sqrt((1 + np.eye(len(covariance))) / n)
        worst = np.abs(error / limit).max()
        assert worst < 1, f"the largest error is {worst:.2g} of the limit"

    return check


@dataclass(frozen=True, eq=False)
class TwoModes:
    """Prior of one joint at θ, a mixture of two Gaussians."""

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    frames: int = 1
    fps: float = 20.0
    dim: int = 3

    @property
    def skeleton(self):
        return Skeleton(["point"], [-1])

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 1, 1, 3)

    def log_density(self, theta):
        xp, terms = array_namespace(theta), []
        for weight, mean, S in zip(self.weights, self.means, self.covariances, strict=True):
            whiten = np.linalg.inv(np.linalg.cholesky(S)).T
            white = (theta - constant(mean, theta)) @ constant(whiten, theta)
            norm = np.log(weight) - 0.5 * np.linalg.slogdet(2 * np.pi * S)[1]
            terms.append(norm - 0.5 * xp.sum(white * white, axis=-1))
        return logsumexp(xp.stack(terms, axis=-1))

    def initial(self, rng, n):
        chosen = rng.choice(2, size=n, p=self.weights)
        roots = np.linalg.cholesky(self.covariances)[chosen]
        return self.means[chosen] + (roots @ rng.standard_normal((n, 3, 1)))[..., 0]

    def sample(self, rng, n):
        return self.motion(self.initial(rng, n))


@pytest.fixture(scope="session")
def two_modes():
    """Return two overlapping Gaussians of different shape, so that chains mix."""
    return TwoModes(
        weights=np.array([0.3, 0.7]),
        means=np.array([[-1.0, 0.0, 0.5], [1.0, 0.3, 0.0]]),
        covariances=np.array([0.6 * np.eye(3), np.diag([0.5, 0.1, 0.3]) + 0.08]),
    )


@pytest.fixture(scope="session")
def posterior(two_modes):
    """Return the posterior of the two modes without observations."""
    return MotionPosterior(two_modes)


@pytest.fixture(scope="session")
def run(posterior):
    """Return a function that samples the two modes with two chains."""

    def sample(sampler, draws, **options):
        return sampler.sample(
            posterior, draws=draws, **{"chains": 2, "seed": 3, "progress": False} | options
        )

    return sample


@pytest.fixture(scope="session")
def mixture():
    """Return a small Gaussian mixture prior that every sampler except `sds` supports."""
    rng = np.random.default_rng(1)
    return GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b"], [-1, 0]),
        fps=30.0,
        means=rng.normal(size=(2, 2, 2, 3)),
        factors=rng.normal(size=(2, 2, 2, 2, 3)),
        weights=np.array([0.6, 0.4]),
        noise=0.3,
        azimuths=4,
    )


@pytest.fixture(scope="session")
def mixture_posterior(mixture):
    """Return the posterior of the mixture given keypoints in one view."""
    truth = Motion(mixture.sample(np.random.default_rng(2), 1)[0], mixture.skeleton, mixture.fps)
    camera = Cameras.ring(1, elevation=0.3)
    return MotionPosterior(mixture, Keypoints2D.observe(truth, camera, 0.3, seed=0))


@pytest.fixture(scope="session")
def minimal():
    """Return a class of priors that implement no optional protocol."""

    class Minimal:
        skeleton, frames, fps, dim, scale = Skeleton(["a"], [-1]), 1, 30.0, 3, 1.0

        def motion(self, theta):
            return theta.reshape(*theta.shape[:-1], 1, 1, 3)

    return Minimal


@pytest.fixture
def evaluations(monkeypatch):
    """Record the batch sizes of evaluations of a posterior's log density."""
    sizes = []

    def log_density(self, theta):
        sizes.append(len(theta))
        return self.prior.log_density(theta)

    monkeypatch.setattr(MotionPosterior, "log_density", log_density)
    return sizes


@pytest.fixture
def trainings(monkeypatch):
    """Record the settings of the networks that `dvae` trains."""
    used, fit = [], AmortisedPosterior.fit

    def spy(posterior, settings, *rest):
        used.append(settings)
        return fit(posterior, settings, *rest)

    monkeypatch.setattr(AmortisedPosterior, "fit", spy)
    return used
