"""Tests of `ExactSampler`: priors without observations, unsupported posteriors."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Joints3D, MotionPosterior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.samplers import ExactSampler


class Normal:
    """Prior N(7, 2²) in every coordinate, with samples and a density but no exact posterior."""

    skeleton, frames, fps, dim = Skeleton(["a"], [-1]), 2, 30.0, 6

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 2, 1, 3)

    def sample(self, rng, n):
        return rng.normal(7.0, 2.0, (n, 2, 1, 3))

    def log_density(self, theta):
        return -0.5 * ((theta - 7.0) ** 2).sum(axis=-1) / 4.0

    def initial(self, rng, n):
        return rng.normal(7.0, 2.0, (n, 6))


def test_prior_without_observations_is_sampled_directly():
    posterior = MotionPosterior(Normal())
    draws = ExactSampler().sample(posterior, draws=500, chains=2, progress=False)
    assert draws.flat().mean() == pytest.approx(7, abs=0.2)
    assert draws.flat().std() == pytest.approx(2, rel=0.1)
    assert "exact" in suited(posterior)
    untruncated = TruncatedPosterior(Normal(), seed=np.full(6, 7.0))
    assert ExactSampler().sample(untruncated, draws=3, progress=False).independent


def test_posteriors_without_a_closed_form_are_refused(mixture, mixture_posterior, minimal):
    outliers = Joints3D(np.zeros((2, 2, 3)), noise=0.5, degrees_of_freedom=4.0)
    likelihood = mixture_posterior.likelihood
    for posterior, message, word in (
        (MotionPosterior(minimal()), "needs a prior with HasExactPosterior", "HasExactPosterior"),
        (
            MotionPosterior(Normal(), Joints3D(np.zeros((2, 1, 3)), noise=0.5)),
            "requires a prior that implements HasExactPosterior for observations, got Normal",
            "HasExactPosterior",
        ),
        (MotionPosterior(mixture, outliers), "in closed form, but the noise is", "not-conjugate"),
        (
            TruncatedPosterior(Normal(), seed=np.full(6, 7.0), limit=2.0),
            "cannot draw from a posterior with a truncated density",
            "truncated",
        ),
        (TruncatedPosterior(mixture, likelihood, limit=2.0), "truncated density", "truncated"),
    ):
        with pytest.raises(UnsupportedPosterior, match=f"^exact .*{message}") as refused:
            ExactSampler().sample(posterior, draws=1, progress=False)
        assert refused.value.word == word
        assert "exact" not in suited(posterior)
        if word == "truncated":
            assert not Problem("truncated", "", posterior).has_reference
