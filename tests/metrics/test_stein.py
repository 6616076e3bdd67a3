"""Kernel Stein discrepancy against quadrature, exact draws and finite differences."""

import itertools
import math
from dataclasses import dataclass

import jax
import numpy as np
import pytest
import torch

import probmotion as pm
from probmotion.arrays import array_namespace, constant
from probmotion.metrics.stein import NoGradient, kernel_stein_discrepancy, score_of
from probmotion.posteriors.protocols import NotConjugate


def test_agreement_with_derivatives_by_torch(rng):
    theta, score = rng.normal(size=(2, 6, 3))
    scale = 1.7

    def kernel(a, b):
        return (1 + ((a - b) ** 2).sum() / scale**2) ** -0.5

    total = 0.0
    for i, j in itertools.permutations(range(6), 2):
        a, b = (torch.tensor(theta[k], requires_grad=True) for k in (i, j))
        s, t = torch.tensor(score[i]), torch.tensor(score[j])
        by_a, by_b = torch.autograd.grad(kernel(a, b), (a, b), create_graph=True)
        trace = sum(torch.autograd.grad(by_b[k], a, retain_graph=True)[0][k] for k in range(3))
        total += ((s @ t) * kernel(a, b) + s @ by_b + t @ by_a + trace).item()
    expected = total / 30 * scale**2
    result = kernel_stein_discrepancy(theta, score, length_scale=scale)
    assert result == pytest.approx(expected, rel=1e-10)


def double_integral(mean, spread, length_scale):
    """Return ∬ q(x) q(x') δ(x) δ(x') k(x, x') dx dx', δ = ∇log p − ∇log q, times ℓ²; p is N(0, 1).

    By Stein's identity (Liu et al. 2016, definition 3.2), no derivatives of k are needed.
    """
    x = mean + spread * np.linspace(-8, 8, 801)
    q = np.exp(-0.5 * ((x - mean) / spread) ** 2)
    weights = q / q.sum() * (-x + (x - mean) / spread**2)
    kernel = (1 + (x[:, None] - x) ** 2 / length_scale**2) ** -0.5
    return length_scale**2 * weights @ kernel @ weights


@pytest.mark.parametrize(("mean", "spread"), [(0.0, 1.0), (0.5, 1.0), (0.0, 0.6), (0.3, 1.4)])
def test_agreement_with_quadrature(rng, mean, spread):
    expected = double_integral(mean, spread, 1.2)
    for n in (2, 20):
        draws = mean + spread * rng.normal(size=(400 // n + 100, n, 1))
        values = [kernel_stein_discrepancy(theta, -theta, length_scale=1.2) for theta in draws]
        deviation = np.std(values, ddof=1) / math.sqrt(len(values))
        assert abs(np.mean(values) - expected) < 4 * deviation
    assert (mean, spread) == (0, 1) or expected > 0.01


def test_invariance_to_units_and_axes(rng):
    theta, score = rng.normal(size=(2, 30, 4))
    rotation = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    expected = kernel_stein_discrepancy(theta, score)
    result = kernel_stein_discrepancy(1000 * theta @ rotation + 7, score @ rotation / 1000)
    assert result == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("theta", "score", "match"),
    [
        (np.zeros((3, 2)), np.zeros((3, 1)), r"score must have shape \(3, 2\), got \(3, 1\)"),
        (np.zeros(3), np.zeros(3), r"points must have shape \(n, D\), got \(3,\)"),
        (np.zeros((3, 2)), np.full((3, 2), np.inf), "score must be finite, got 6 values"),
        (np.zeros((1, 2)), np.zeros((1, 2)), "points must have at least 2 points, got 1"),
        (np.zeros((3, 2)), np.zeros((3, 2)), "points must have a median distance above 0, got 0"),
    ],
)
def test_invalid_arguments(theta, score, match):
    with pytest.raises(ValueError, match=match):
        kernel_stein_discrepancy(theta, score)


SKELETON = pm.Skeleton(("hip", "head"), (-1, 0))


@dataclass(frozen=True)
class Quartic:
    """Prior with a nonlinear score, differentiable by one array library or all."""

    library: str = "any"

    skeleton, frames, fps, dim = SKELETON, 2, 10.0, 12

    def motion(self, theta):
        return theta.reshape((*theta.shape[:-1], 2, 2, 3))

    def log_density(self, theta):
        if self.library == "torch" and isinstance(theta, jax.Array):
            theta = torch.asarray(theta)
        if self.library == "jax" and isinstance(theta, torch.Tensor):
            theta = np.asarray(theta)
        if self.library == "numpy":
            theta = np.asarray(theta)
        xp = array_namespace(theta)
        weights = constant(np.arange(1.0, 13.0), theta)
        return -xp.sum(weights * xp.cos(theta) ** 2 + theta**4, axis=-1)

    def initial(self, rng, n):
        return rng.normal(size=(n, 12))


def finite_differences(posterior, theta, step=1e-5):
    columns = []
    for axis in np.eye(posterior.dim):
        ahead, back = (posterior.log_density(theta + sign * step * axis) for sign in (1, -1))
        columns.append((ahead - back) / (2 * step))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("library", ["any", "torch", "jax"])
def test_scores_agree_with_finite_differences(rng, library):
    theta = rng.normal(size=(300, 12))
    joints = pm.Joints3D(rng.normal(size=(2, 2, 3)), 0.5, skeleton=SKELETON)
    posterior = pm.MotionPosterior(Quartic(library), None if library == "jax" else joints)
    score = score_of(posterior, theta)
    assert score.dtype == np.float64
    expected = finite_differences(posterior, theta)
    np.testing.assert_allclose(score, expected, rtol=1e-6, atol=1e-5)


def test_missing_and_infinite_gradients():
    class NoDerivative(Quartic):
        differentiable = False

    class Intractable(Quartic):
        def log_density(self, theta):
            raise NotConjugate("noise is Student's")

    class NoDensity:
        skeleton, frames, fps, dim = SKELETON, 2, 10.0, 12
        motion = Quartic.motion

    class Kinked(Quartic):
        def log_density(self, theta):
            return (theta**2).sum(-1) ** 0.5

    zero = np.zeros((3, 12))
    for prior, theta, error, message in (
        (Quartic("numpy"), zero, NoGradient, "got Quartic with no likelihood: torch raised"),
        (NoDerivative(), zero, NoGradient, "must be .*, but NoDerivative has no gradient"),
        (Intractable(), zero, NoGradient, "posterior must be differentiable: noise is Stud"),
        (NoDensity(), zero, NoGradient, "posterior must have a log density, got NoDensity"),
        (Kinked(), zero, ValueError, "score must be finite, got 36 values"),
        (Quartic(), zero[:, :5], ValueError, r"theta must have shape \(n, 12\), got \(3, 5\)"),
    ):
        with pytest.raises(ValueError, match=message) as raised:
            score_of(pm.MotionPosterior(prior), theta)
        assert raised.type is error
