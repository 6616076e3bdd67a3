"""The kernel Stein discrepancy against quadrature, exact draws and finite differences."""

from __future__ import annotations

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
from probmotion.problems import load_problem


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def within(values, expected):
    """Whether the mean is the expected one within four standard errors."""
    return abs(np.mean(values) - expected) < 4 * np.std(values, ddof=1) / math.sqrt(len(values))


def test_it_is_the_mean_of_the_stein_kernel_by_torchs_derivatives(rng):
    theta, score = rng.normal(size=(2, 6, 3))
    scale = 1.7

    def kernel(a, b):
        return (1 + ((a - b) ** 2).sum() / scale**2) ** -0.5

    total = 0.0
    for i in range(6):
        for j in range(6):
            if i == j:
                continue
            a, b = (torch.tensor(theta[k], requires_grad=True) for k in (i, j))
            s, t = torch.tensor(score[i]), torch.tensor(score[j])
            by_a, by_b = torch.autograd.grad(kernel(a, b), (a, b), create_graph=True)
            trace = sum(torch.autograd.grad(by_b[k], a, retain_graph=True)[0][k] for k in range(3))
            total += ((s @ t) * kernel(a, b) + s @ by_b + t @ by_a + trace).item()
    # In units of the length scale: each derivative carries one.
    expected = total / 30 * scale**2
    found = kernel_stein_discrepancy(theta, score, length_scale=scale)
    assert found == pytest.approx(expected, rel=1e-10)


def double_integral(mean, spread, length_scale):
    """∬ q(x) q(x') δ(x) δ(x') k(x, x') dx dx', δ = ∇log p − ∇log q, times ℓ²; p is N(0, 1).

    What Stein's identity says the discrepancy is (Liu et al. 2016, definition 3.2), with no
    derivative of k.
    """
    x = mean + spread * np.linspace(-8, 8, 801)
    q = np.exp(-0.5 * ((x - mean) / spread) ** 2)
    weights = q / q.sum() * (-x + (x - mean) / spread**2)
    kernel = (1 + (x[:, None] - x) ** 2 / length_scale**2) ** -0.5
    return length_scale**2 * weights @ kernel @ weights


@pytest.mark.parametrize(("mean", "spread"), [(0.0, 1.0), (0.5, 1.0), (0.0, 0.6), (0.3, 1.4)])
def test_it_is_the_double_integral_and_unbiased(rng, mean, spread):
    expected = double_integral(mean, spread, 1.2)
    for n in (2, 20):
        draws = mean + spread * rng.normal(size=(400 // n + 100, n, 1))
        found = [kernel_stein_discrepancy(theta, -theta, length_scale=1.2) for theta in draws]
        assert within(found, expected)
    assert (mean, spread) == (0, 1) or expected > 0.01


@pytest.mark.parametrize("dim", [1, 10])
def test_of_exact_draws_it_is_zero_in_the_mean(rng, dim):
    variances = np.geomspace(0.1, 10, dim)
    found = []
    for _ in range(100):
        theta = np.sqrt(variances) * rng.normal(size=(30, dim)) + 3
        found.append(kernel_stein_discrepancy(theta, -(theta - 3) / variances))
    assert within(found, 0)


def test_it_grows_with_a_shift_and_with_a_wrong_variance(rng):
    z = rng.normal(size=(400, 5))

    def found(shift, spread):
        theta = spread * z + shift
        return kernel_stein_discrepancy(theta, -theta)

    shifts = [found(shift, 1) for shift in (0, 0.3, 0.6, 1.2)]
    assert np.all(np.diff(shifts) > 0.02)
    wide = [found(0, spread) for spread in (1, 1.2, 1.5, 2)]
    narrow = [found(0, spread) for spread in (1, 0.8, 0.6, 0.3)]
    assert np.all(np.diff(wide) > 0.02)
    assert np.all(np.diff(narrow) > 0.02)


def test_of_variance_r_it_is_one_minus_r_squared(rng):
    # ∇log p − ∇log q is linear: the double integral is (1 − r)² that of r = 0.
    def mean_of(spread):
        draws = spread * np.random.default_rng(1).normal(size=(100, 30, 4))
        return np.array([kernel_stein_discrepancy(theta, -theta) for theta in draws])

    constant = mean_of(1e-9)
    for ratio in (0.5, 1.5, 2.0):
        assert within(mean_of(math.sqrt(ratio)) - (1 - ratio) ** 2 * constant, 0)


def test_overconfidence_stands_out_of_chance(rng):
    # 200 draws of three fifths of the spread, in five dimensions: beyond what exact draws show.
    def found(spread):
        theta = spread * rng.normal(size=(200, 5))
        return kernel_stein_discrepancy(theta, -theta)

    exact = [found(1.0) for _ in range(30)]
    assert min(found(0.6) for _ in range(10)) > max(exact)


def test_it_does_not_depend_on_the_unit_or_axes_of_theta(rng):
    theta, score = rng.normal(size=(2, 30, 4))
    turned = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    expected = kernel_stein_discrepancy(theta, score)
    found = kernel_stein_discrepancy(1000 * theta @ turned + 7, score @ turned / 1000)
    assert found == pytest.approx(expected, rel=1e-9)


def test_the_share_of_distant_modes_is_not_seen(rng):
    # Known of it, and said in its docstring: of two modes one may be missing.
    middle = np.array([20.0, 0.0])
    theta = rng.normal(size=(400, 2)) + middle
    score = middle - theta  # of .5 N(middle, I) + .5 N(−middle, I), to 1e-200
    assert abs(kernel_stein_discrepancy(theta, score)) < 0.02


@pytest.mark.parametrize(
    ("theta", "score", "match"),
    [
        (np.zeros((3, 2)), np.zeros((3, 1)), r"score must have shape \(3, 2\), got \(3, 1\)"),
        (np.zeros(3), np.zeros(3), r"points must have shape \(n, D\), got \(3,\)"),
        (
            np.zeros((3, 2)),
            np.full((3, 2), np.inf),
            "score must be finite, got 6 values that are NaN",
        ),
        (np.zeros((1, 2)), np.zeros((1, 2)), "points has 1 points, expected at least 2"),
        (np.zeros((3, 2)), np.zeros((3, 2)), "points have median distance 0"),
    ],
)
def test_draws_are_checked(theta, score, match):
    with pytest.raises(ValueError, match=match):
        kernel_stein_discrepancy(theta, score)


SKELETON = pm.Skeleton(("hip", "head"), (-1, 0))


@dataclass(frozen=True)
class Bent:
    """A curved density, so that a linear score could not pass, in one library or in all."""

    library: str = "any"

    skeleton = SKELETON
    frames = 2
    fps = 10.0
    dim = 12

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
        ahead, back = (posterior.log_density(theta + way * step * axis) for way in (1, -1))
        columns.append((ahead - back) / (2 * step))
    return np.stack(columns, axis=-1)


def seen(rng):
    return pm.Joints3D(rng.normal(size=(2, 2, 3)), 0.5, skeleton=SKELETON)


@pytest.mark.parametrize("library", ["any", "torch", "jax"])
def test_the_score_is_the_densitys_slope(rng, library):
    theta = rng.normal(size=(5, 12))
    posterior = pm.MotionPosterior(Bent(library), None if library == "jax" else seen(rng))
    score = score_of(posterior, theta)
    assert score.dtype == np.float64
    expected = finite_differences(posterior, theta)
    np.testing.assert_allclose(score, expected, rtol=1e-6, atol=1e-6)


def test_the_score_of_a_row_does_not_depend_on_the_others(rng):
    theta = rng.normal(size=(300, 12))
    posterior = pm.MotionPosterior(Bent())
    np.testing.assert_allclose(score_of(posterior, theta)[290:], score_of(posterior, theta[290:]))


def test_a_problems_posterior_has_a_score(rng):
    posterior = load_problem("gait").posterior
    theta = posterior.initial(rng, 3)
    score = score_of(posterior, theta)
    ahead = rng.normal(size=theta.shape)
    step = 1e-6
    rise = posterior.log_density(theta + step * ahead) - posterior.log_density(theta - step * ahead)
    np.testing.assert_allclose((score * ahead).sum(axis=1), rise / (2 * step), rtol=1e-5)


def test_no_gradient_is_said_in_one_sentence(rng):
    theta = rng.normal(size=(3, 12))
    with pytest.raises(NoGradient, match="Bent with no likelihood lets no gradient through, torch"):
        score_of(pm.MotionPosterior(Bent("numpy")), theta)

    class Stepped(Bent):
        differentiable = False

    with pytest.raises(NoGradient, match="posterior has no score: Stepped has no gradient"):
        score_of(pm.MotionPosterior(Stepped()), theta)

    class Unclosed(Bent):
        def log_density(self, theta):
            raise NotConjugate("noise is Student's")

    with pytest.raises(NoGradient, match="posterior has no score: noise is Student's"):
        score_of(pm.MotionPosterior(Unclosed()), theta)

    class Mute:
        skeleton, frames, fps, dim = SKELETON, 2, 10.0, 12
        motion = Bent.motion

    with pytest.raises(NoGradient, match="posterior has no score: Mute has no log density"):
        score_of(pm.MotionPosterior(Mute()), theta)


def test_draws_without_a_finite_slope_are_an_error():
    class Cornered(Bent):
        def log_density(self, theta):
            return (theta**2).sum(-1) ** 0.5

    theta = np.ones((3, 12))
    theta[1] = 0
    with pytest.raises(
        ValueError, match="score must be finite, got 12 values that are NaN or infinite"
    ):
        score_of(pm.MotionPosterior(Cornered()), theta)
    with pytest.raises(ValueError, match=r"theta must have shape \(n, 12\), got \(3, 5\)"):
        score_of(pm.MotionPosterior(Bent()), theta[:, :5])
