"""Small spectral prior, observations of its motions, and an oracle with explicit covariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, Skeleton
from probmotion.models.mixture import SpectralMixtureMotion

BODY = Skeleton(["hips", "head", "left_hand", "right_hand"], [-1, 0, 0, 0])
L, J = 5, 4
P = 3 * J


def random_prior(components=2, azimuths=3, seed=0, bands=(0, 1, 2, 3, 3), **changes):
    """Return a prior whose directions differ between components and bands."""
    rng = np.random.default_rng(seed)
    shifts = np.zeros((P, 2))
    shifts[0::3, 0] = shifts[2::3, 1] = 1 / np.sqrt(J)
    directions = np.linalg.qr(rng.normal(size=(components, bands[-1] + 1, P, P)))[0]
    first = np.concatenate([np.tile(shifts, (components, 1, 1)), directions[:, 0, :, 2:]], -1)
    directions[:, 0] = np.linalg.qr(first)[0]
    directions[:, 0, :, :2] = shifts
    poses = 0.4 * rng.normal(size=(components, J, 3))
    poses[..., [0, 2]] -= poses[..., [0, 2]].mean(axis=1, keepdims=True)
    size = np.exp(0.7 * rng.normal(size=(components, L, P)))
    weights = np.arange(components, 0, -1.0)
    return SpectralMixtureMotion(
        **{
            "skeleton": BODY,
            "fps": 10.0,
            "poses": poses,
            "velocities": 0.5 * rng.normal(size=(components, 2)),
            "directions": directions,
            "band": np.array(bands),
            "variances": 0.1 * size / (1 + np.arange(L)[:, None]) ** 2,
            "weights": weights / weights.sum(),
            "scales": np.array([0.5, 3.0]),
            "scale_weights": np.array([0.7, 0.3]),
            "ground": 0.3,
            "azimuths": azimuths,
        }
        | changes
    )


class Dense:
    """The mixture over all 3 L J coordinates, with one explicit covariance matrix per Gaussian.

    The Gaussians are ordered by component, scale and azimuth.
    """

    def __init__(self, prior):
        n_frames, n_joints = prior.frames, prior.skeleton.n_joints
        t = np.arange(n_frames)
        waves = np.sqrt(2 / n_frames) * np.cos(np.pi * np.outer(t, t + 0.5) / n_frames)
        waves[0] = 1 / np.sqrt(n_frames)
        times = (t - t.mean()) / prior.fps
        self.scale = prior.scale
        self.dim = 3 * n_frames * n_joints
        self.log_weights, self.means, self.covariances = [], [], []
        for k, (pose, (vx, vz)) in enumerate(zip(prior.poses, prior.velocities, strict=True)):
            mean = (pose + np.multiply.outer(times, [vx, 0, vz])[:, None]).reshape(-1)
            for factor, share in zip(prior.scales, prior.scale_weights, strict=True):
                covariance = np.zeros((self.dim, self.dim))
                for f, wave in enumerate(waves):
                    variances = factor * prior.variances[k, f]
                    if f == 0:
                        variances[:2] = n_joints * n_frames * prior.ground**2
                    V = prior.directions[k, prior.band[f]]
                    covariance += np.kron(np.outer(wave, wave), V @ np.diag(variances) @ V.T)
                for a in range(prior.azimuths):
                    angle = 2 * np.pi * a / prior.azimuths
                    c, s = np.cos(angle), np.sin(angle)
                    turn = np.kron(np.eye(n_frames * n_joints), [[c, 0, s], [0, 1, 0], [-s, 0, c]])
                    self.log_weights.append(np.log(prior.weights[k] * share / prior.azimuths))
                    self.means.append(turn @ mean)
                    self.covariances.append(turn @ covariance @ turn.T)

    def log_density(self, x):
        return logsumexp(
            [
                weight + multivariate_normal(mean, covariance).logpdf(x)
                for weight, mean, covariance in zip(
                    self.log_weights, self.means, self.covariances, strict=True
                )
            ],
            axis=0,
        )

    def given(self, H, variance, y):
        """Condition on y = H x + N(0, diag(variance)); return the posterior and log p(y)."""
        posterior = object.__new__(Dense)
        posterior.scale, posterior.dim = self.scale, self.dim
        logs, posterior.means, posterior.covariances = [], [], []
        for weight, mean, C in zip(self.log_weights, self.means, self.covariances, strict=True):
            S = H @ C @ H.T + np.diag(variance)
            gain = np.linalg.solve(S, H @ C).T
            residual = y - H @ mean
            square = residual @ np.linalg.solve(S, residual)
            logs.append(weight - 0.5 * (square + np.linalg.slogdet(2 * np.pi * S)[1]))
            posterior.means.append(mean + gain @ residual)
            posterior.covariances.append(C - gain @ H @ C)
        evidence = logsumexp(logs)
        posterior.log_weights = np.array(logs) - evidence
        return posterior, evidence

    def observed(self, likelihood):
        """Condition on a likelihood."""
        return self.given(*equations(likelihood, self.dim))

    def denoised(self, x_t, alpha_bar, axes=None):
        """Condition on one noisy motion, or on one noisy view with the given axes."""
        H = np.kron(np.eye(self.dim // 3), np.eye(3) if axes is None else axes)
        H = np.sqrt(alpha_bar) / self.scale * H
        return self.given(H, np.full(len(H), 1 - alpha_bar), x_t.reshape(-1))[0]

    def moments(self):
        """Return the mean and the covariance matrix of all coordinates."""
        weights = np.exp(self.log_weights)
        mean = weights @ np.array(self.means)
        centred = np.array(self.means) - mean
        covariance = np.tensordot(weights, np.array(self.covariances), 1)
        return mean, covariance + (weights[:, None] * centred).T @ centred


def equations(likelihood, dim):
    """Return H, the noise variances and y of y = H x + noise."""
    axes, target, precision = likelihood.linear()
    H, variance, y = [np.zeros((0, dim))], [], []
    for view, t, j in zip(*np.nonzero(precision), strict=True):
        rows = np.zeros((axes.shape[1], dim))
        start = 3 * (t * precision.shape[2] + j)
        rows[:, start : start + 3] = axes[view]
        H.append(rows)
        variance += [1 / precision[view, t, j]] * axes.shape[1]
        y += [*target[view, t, j]]
    return np.concatenate(H), np.array(variance), np.array(y)


CASES = (
    "joints",
    "joints with gaps",
    "joints of unequal confidence",
    "one hidden frame",
    "one view",
    "one view with gaps",
    "three views with gaps",
    "three views of unequal confidence",
    "nothing",
)


def observe(case, motion, noise):
    """Return the likelihood of a case, simulated from a motion."""
    rng = np.random.default_rng(5)
    gaps = np.zeros((L, J), bool)
    gaps[1:4, 2] = gaps[2, 0] = True
    hidden = gaps if "gaps" in case else None
    if case == "nothing":
        hidden = np.ones((L, J), bool)
    if case == "one hidden frame":
        hidden = np.arange(L)[:, None] == np.full(J, 2)
    if "view" not in case:
        likelihood = Joints3D.observe(motion, noise, 6, hidden=hidden)
    else:
        cameras = Cameras.ring(3 if "three" in case else 1, elevation=0.3, start=0.2)
        if "three" in case and hidden is not None:
            hidden = np.stack([hidden, ~hidden, hidden[::-1]])
        likelihood = Keypoints2D.observe(motion, cameras, noise, 6, hidden=hidden)
    if "unequal" not in case:
        return likelihood
    confidence = rng.uniform(0.2, 3.0, likelihood.confidence.shape)
    confidence[..., 3, 1] = 0.0
    values = {"confidence": confidence}
    kind, cameras = type(likelihood), getattr(likelihood, "cameras", None)
    blank = (
        kind(likelihood.joints, noise, **values)
        if cameras is None
        else kind(likelihood.keypoints, cameras, noise, **values)
    )
    return blank.simulate(rng, motion.positions)


@pytest.fixture(scope="session")
def make_prior():
    return random_prior


@pytest.fixture(scope="session")
def prior():
    # As in resampled priors, one band has no frequency.
    return random_prior(bands=(0, 2, 3, 4, 4))


@pytest.fixture(scope="session")
def dense(prior):
    return Dense(prior)


@pytest.fixture(scope="session")
def make_dense():
    return Dense


@pytest.fixture(scope="session")
def make_likelihood(prior):
    """Return a function of a case and noise that simulates observations of one motion."""
    motion = Motion(prior.sample(np.random.default_rng(4), 1)[0], BODY, prior.fps)
    return lambda case, noise=0.2: observe(case, motion, noise)


@pytest.fixture(params=CASES)
def likelihood(request, make_likelihood):
    return make_likelihood(request.param)


@pytest.fixture(scope="session")
def noisy(prior):
    """Return a function that draws n noisy motions x_t of the prior, normalised units."""

    def draw(alpha_bar, n=3):
        rng = np.random.default_rng(8)
        clean = prior.sample(rng, n) / prior.scale
        noise = rng.standard_normal(clean.shape)
        return np.sqrt(alpha_bar) * clean + np.sqrt(1 - alpha_bar) * noise

    return draw


@pytest.fixture(scope="session")
def assert_close():
    """Return an assertion of agreement within 1e-8 of the largest expected value."""

    def check(got, wanted, tolerance=1e-8):
        wanted = np.asarray(wanted)
        scale = max(np.abs(wanted).max(), 1e-3)
        np.testing.assert_allclose(got, wanted, rtol=0, atol=tolerance * scale)

    return check
