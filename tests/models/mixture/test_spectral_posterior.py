"""Exact posterior against dense linear algebra, statistical tests of its draws, calibration."""

import numpy as np
import pytest
from scipy.stats import chi2, chisquare, norm

from probmotion import Joints3D, Keypoints2D
from probmotion.models.mixture.spectral_posterior import condition, draw
from probmotion.posteriors.protocols import NotConjugate


def test_matches_dense_linear_algebra(prior, dense, likelihood, assert_close):
    exact = prior.exact_posterior(likelihood)
    expected, evidence = dense.observed(likelihood)
    mean, covariance = expected.moments()
    assert_close(exact.log_marginal_likelihood, evidence)
    assert_close(exact.component_probabilities.reshape(-1), np.exp(expected.log_weights))
    assert_close(exact.mean().reshape(-1), mean)
    blocks = [covariance[i : i + 3, i : i + 3] for i in range(0, 60, 3)]
    assert_close(exact.covariances().reshape(20, 3, 3), blocks)
    draws = exact.sample(np.random.default_rng(2), 3)
    values = expected.log_density(draws.reshape(3, -1))
    assert_close(exact.log_density(draws), values)


def test_prior_is_the_posterior_without_observations(prior, dense, assert_close):
    exact = prior.exact_posterior(None)
    mean, covariance = dense.moments()
    assert exact.log_marginal_likelihood == pytest.approx(0.0, abs=1e-12)
    assert_close(exact.component_probabilities.reshape(-1), np.exp(dense.log_weights))
    assert_close(exact.mean().reshape(-1), mean)
    blocks = [covariance[i : i + 3, i : i + 3] for i in range(0, 60, 3)]
    assert_close(exact.covariances().reshape(20, 3, 3), blocks)


@pytest.mark.parametrize(
    ("case", "noise"),
    [("joints with gaps", 1e-4), ("one view with gaps", 1e-2), ("three views with gaps", 1e-2)],
)
def test_precise_observations(prior, dense, make_likelihood, assert_close, case, noise):
    """Noise far below the prior's deviation costs digits, since gaps cancel precise entries."""
    likelihood = make_likelihood(case, noise)
    exact = prior.exact_posterior(likelihood)
    expected, evidence = dense.observed(likelihood)
    mean, covariance = expected.moments()
    assert_close(exact.log_marginal_likelihood, evidence, 1e-6)
    assert_close(exact.mean().reshape(-1), mean, 1e-6)
    blocks = [covariance[i : i + 3, i : i + 3] for i in range(0, 60, 3)]
    assert_close(exact.covariances().reshape(20, 3, 3), blocks, 1e-6)


@pytest.mark.parametrize("case", [None, "joints with gaps", "one view with gaps", "one view"])
def test_draws_have_the_exact_moments(prior, dense, make_likelihood, case):
    likelihood = None if case is None else make_likelihood(case)
    mean, covariance = (dense if case is None else dense.observed(likelihood)[0]).moments()
    n = 4000
    draws = prior.exact_posterior(likelihood).sample(np.random.default_rng(3), n)
    size, axes = np.linalg.eigh(covariance)
    white = (draws.reshape(n, -1) - mean) @ axes / np.sqrt(size)
    assert chi2.sf(n * (white.mean(axis=0) ** 2).sum(), 60) > 1e-3
    # Second moments of all pairs of whitened coordinates; draws of a mixture are not Gaussian, so
    # their own deviation scales the difference. Bonferroni over the pairs.
    products = np.einsum("ni,nj->nij", white, white)[:, *np.triu_indices(60)]
    difference = products.mean(axis=0) - np.eye(60)[np.triu_indices(60)]
    z = np.sqrt(n) * difference / products.std(axis=0)
    assert np.abs(z).max() < norm.isf(1e-3 / z.size)


@pytest.mark.parametrize("case", ["joints with gaps", "one view with gaps"])
def test_each_observation_has_its_own_draw(prior, dense, make_likelihood, case):
    """Alternate rows have the natural parameters η of two observations of one Λ."""
    blank, n = make_likelihood(case), 3000
    rng = np.random.default_rng(6)
    pair = [blank.simulate(rng, truth) for truth in prior.sample(rng, 2)]
    exact = [prior.exact_posterior(likelihood) for likelihood in pair]
    shift = np.stack([one.shift for one in exact] * n)
    log_joint = condition(prior.components, exact[0].information, shift[:2])[0]
    draws = draw(
        prior.components, exact[0].information, shift, np.tile(log_joint, (n, 1, 1)), rng
    ).reshape(2 * n, -1)
    for row, likelihood in enumerate(pair):
        mean, covariance = dense.observed(likelihood)[0].moments()
        difference = draws[row::2].mean(axis=0) - mean
        square = n * difference @ np.linalg.solve(covariance, difference)
        assert 1e-3 < chi2.sf(square, 60) < 1 - 1e-3


def ranks(prior, blank, n):
    """Return ranks of truths among 99 posterior draws, (n, functionals), simulated n times.

    The functionals are eight random projections and the posterior log density.
    """
    directions = np.random.default_rng(0).normal(size=(60, 8))
    out = np.empty((n, 9), dtype=int)
    rng = np.random.default_rng(1)
    for i, truth in enumerate(prior.sample(rng, n)):
        exact = prior.exact_posterior(blank.simulate(rng, truth))
        motions = np.concatenate([truth[None], exact.sample(rng, 99)])
        values = np.column_stack(
            [motions.reshape(100, -1) @ directions, exact.log_density(motions)]
        )
        out[i] = (values[1:] < values[0]).sum(axis=0)
    return out


@pytest.mark.parametrize(
    "n", [pytest.param(100, id="quick"), pytest.param(500, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("case", ["joints with gaps", "one view with gaps"])
def test_draws_are_calibrated(prior, make_likelihood, case, n):
    """Ranks of truths from the prior among posterior draws are uniform (Talts et al. 2018)."""
    counts = [np.bincount(r // 20, minlength=5) for r in ranks(prior, make_likelihood(case), n).T]
    assert chisquare(counts, axis=1).pvalue.min() > 1e-3 / len(counts)


def test_long_recordings_with_gaps(make_prior):
    """The gradient of the Gaussian posterior's log density vanishes at the mean of 3000 frames."""
    import torch

    options = {"scales": np.ones(1), "scale_weights": np.ones(1)}
    prior = make_prior(components=1, azimuths=1, **options).resampled(3000)
    truth = prior.sample(np.random.default_rng(0), 1)[0]
    confidence = np.ones(truth.shape[:2])
    confidence[1000:1020, 2] = confidence[7, 1] = confidence[2990:, 3] = 0
    blank = Joints3D(np.zeros(truth.shape), 0.05, confidence)
    likelihood = blank.simulate(np.random.default_rng(1), truth)
    exact = prior.exact_posterior(likelihood)
    largest = []
    for density in (likelihood.log_density, exact.log_density):
        point = torch.tensor(exact.mean(), requires_grad=True)
        density(point).backward()
        largest.append(point.grad.abs().max().item())
    assert largest[0] > 1  # prior and likelihood pull in opposite directions
    assert largest[1] < 1e-8 * largest[0]
    variances = exact.covariances().trace(axis1=2, axis2=3)
    error = ((exact.mean() - truth) ** 2).sum(axis=2)
    seen = confidence > 0
    assert error[seen].sum() == pytest.approx(variances[seen].sum(), rel=0.05)
    assert variances[~seen].min() > 2 * variances[seen].max()


def test_other_likelihoods_are_not_conjugate(prior):
    from probmotion import Cameras

    perspective = Cameras.around([0.0], [0.1], perspective=True)
    for likelihood, message in (
        (Joints3D(np.zeros((5, 4, 3)), 0.1, degrees_of_freedom=4), "Student-t"),
        (Keypoints2D(np.zeros((1, 5, 4, 2)), perspective, 0.1), "perspective"),
    ):
        with pytest.raises(NotConjugate, match=message):
            prior.exact_posterior(likelihood)
