"""Priors for the samplers' tests, everything in dense algebra: a Gaussian, two bumps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from probmotion.arrays import array_namespace, constant, dot, logsumexp
from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import Likelihood


@dataclass(frozen=True, eq=False)
class GaussianMotion:
    """X ~ N(mean, covariance) over (L, J, 3) positions, metres; coordinates ordered as in X."""

    mean: np.ndarray
    covariance: np.ndarray
    scale: float = 1.0
    fps: float = 20.0

    @property
    def skeleton(self) -> Skeleton:
        n_joints = self.mean.shape[1]
        return Skeleton([f"joint-{j}" for j in range(n_joints)], [-1] * n_joints)

    @property
    def frames(self) -> int:
        return len(self.mean)

    @property
    def dim(self) -> int:
        return self.mean.size

    def motion(self, theta: np.ndarray) -> np.ndarray:
        return theta.reshape(*theta.shape[:-1], *self.mean.shape)

    def sample(self, rng: np.random.Generator, n: int) -> np.ndarray:
        root = np.linalg.cholesky(self.covariance)
        return self.mean + (rng.standard_normal((n, self.dim)) @ root.T).reshape(
            n, *self.mean.shape
        )

    def posterior(self, likelihood: Likelihood) -> tuple[np.ndarray, np.ndarray]:
        """Mean (L, J, 3) and covariance given linear Gaussian evidence."""
        axes, target, precision = likelihood.linear()  # type: ignore[attr-defined]
        information = np.linalg.inv(self.covariance)
        shift = information @ self.mean.ravel()
        for view, weights in zip(axes, precision, strict=True):
            rows = np.kron(np.eye(weights.size), view)
            weight = np.repeat(weights.ravel(), len(view))
            information = information + rows.T @ (weight[:, None] * rows)
        for view, seen, weights in zip(axes, target, precision, strict=True):
            rows = np.kron(np.eye(weights.size), view)
            shift = shift + rows.T @ (np.repeat(weights.ravel(), len(view)) * seen.ravel())
        covariance = np.linalg.inv(information)
        return (covariance @ shift).reshape(self.mean.shape), covariance

    def denoise_motion(self, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        return self._denoise(np.eye(3), x_t, alpha_bar)

    def motion_covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, vectors: np.ndarray
    ) -> np.ndarray:
        return self._spread(np.eye(3), alpha_bar, vectors)

    def denoise(self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras) -> np.ndarray:
        """As a network would, take any camera for the orthographic one at its place."""
        axes = cameras.as_orthographic().image_axes
        views = [self._denoise(P, x_t[:, v], alpha_bar) for v, P in enumerate(axes)]
        return np.stack(views, axis=1)

    def view_covariance_product(
        self, x_t: np.ndarray, alpha_bar: float, cameras: Cameras, vectors: np.ndarray
    ) -> np.ndarray:
        views = [
            self._spread(P, alpha_bar, vectors[:, v]) for v, P in enumerate(cameras.image_axes)
        ]
        return np.stack(views, axis=1)

    def _seen(self, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows = np.kron(np.eye(self.dim // 3), axes)
        mean = rows @ self.mean.ravel() / self.scale
        return mean, rows @ self.covariance @ rows.T / self.scale**2

    def _denoise(self, axes: np.ndarray, x_t: np.ndarray, alpha_bar: float) -> np.ndarray:
        mean, covariance = self._seen(axes)
        noisy = alpha_bar * covariance + (1 - alpha_bar) * np.eye(len(mean))
        gain = np.sqrt(alpha_bar) * np.linalg.solve(noisy, covariance)
        flat = x_t.reshape(len(x_t), -1)
        return (mean + (flat - np.sqrt(alpha_bar) * mean) @ gain).reshape(x_t.shape)

    def _spread(self, axes: np.ndarray, alpha_bar: float, vectors: np.ndarray) -> np.ndarray:
        _, covariance = self._seen(axes)
        noisy = alpha_bar * covariance + (1 - alpha_bar) * np.eye(len(covariance))
        product = covariance - alpha_bar * covariance @ np.linalg.solve(noisy, covariance)
        return (vectors.reshape(len(vectors), -1) @ product).reshape(vectors.shape)


@pytest.fixture(scope="session")
def gaussian_motion() -> Callable[..., GaussianMotion]:
    """The class itself."""
    return GaussianMotion


@pytest.fixture(scope="session")
def lively(gaussian_motion: Callable[..., GaussianMotion]) -> GaussianMotion:
    """A Gaussian without symmetry over 2 frames of 2 joints, not centred, in odd units."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(12, 12)) * 0.3
    return gaussian_motion(
        rng.normal(size=(2, 2, 3)) * 0.5, root @ root.T + 0.02 * np.eye(12), scale=0.7
    )


def assert_covariance(draws: np.ndarray, covariance: np.ndarray, deviations: float = 5.0) -> None:
    """Compare the draws' second moments about 0 with a covariance, entry by entry.

    Whitened, an entry of the sample covariance of n draws has standard deviation 1/√n (√2/√n on
    the diagonal); with 12 dimensions, 5 of them fail one time in 20 000.
    """
    n = len(draws)
    white = np.linalg.solve(np.linalg.cholesky(covariance), draws.reshape(n, -1).T)
    gap = white @ white.T / n - np.eye(len(covariance))
    limit = deviations * np.sqrt((1 + np.eye(len(covariance))) / n)
    assert (np.abs(gap) < limit).all(), f"off by {np.abs(gap / limit).max():.2g} of the limit"


@pytest.fixture(scope="session")
def covariance_is() -> Callable[..., None]:
    """The function above."""
    return assert_covariance


@dataclass(frozen=True, eq=False)
class TwoBumps:
    """A prior for chains: θ is one joint's position, a mixture of two Gaussians in closed form."""

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    frames: int = 1
    fps: float = 20.0
    dim: int = 3

    @property
    def skeleton(self) -> Skeleton:
        return Skeleton(["point"], [-1])

    def motion(self, theta: Any) -> Any:
        return theta.reshape(*theta.shape[:-1], 1, 1, 3)

    def log_density(self, theta: Any) -> Any:
        terms = []
        for weight, mean, covariance in zip(
            self.weights, self.means, self.covariances, strict=True
        ):
            white = (theta - constant(mean, theta)) @ constant(
                np.linalg.inv(np.linalg.cholesky(covariance)).T, theta
            )
            norm = np.log(weight) - 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
            terms.append(norm - 0.5 * dot(white, white))
        return logsumexp(array_namespace(theta).stack(terms, axis=-1))

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        chosen = rng.choice(2, size=n, p=self.weights)
        roots = np.linalg.cholesky(self.covariances)[chosen]
        return self.means[chosen] + (roots @ rng.standard_normal((n, 3, 1)))[..., 0]

    @property
    def mean(self) -> np.ndarray:
        return self.weights @ self.means

    @property
    def variance(self) -> np.ndarray:
        square = np.diagonal(self.covariances, axis1=1, axis2=2) + self.means**2
        return self.weights @ square - self.mean**2


@pytest.fixture(scope="session")
def two_bumps() -> TwoBumps:
    """Two Gaussians of unlike shape whose overlap lets any chain cross."""
    return TwoBumps(
        weights=np.array([0.3, 0.7]),
        means=np.array([[-1.0, 0.0, 0.5], [1.0, 0.3, 0.0]]),
        covariances=np.array([0.6 * np.eye(3), np.diag([0.5, 0.1, 0.3]) + 0.08]),
    )
