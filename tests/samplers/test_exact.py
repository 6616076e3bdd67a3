"""`ExactSampler`: the closed form, its addresses and its refusals."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Joints3D, MotionPosterior
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.samplers import ExactSampler


@pytest.fixture(scope="module")
def posterior():
    rng = np.random.default_rng(0)
    prior = GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b"], [-1, 0]),
        fps=30.0,
        means=rng.normal(size=(2, 2, 2, 3)),
        factors=rng.normal(size=(2, 2, 2, 2, 3)),
        weights=np.array([0.6, 0.4]),
        noise=0.2,
        azimuths=4,
    )
    return MotionPosterior(prior, Joints3D(prior.sample(rng, 1)[0], noise=0.5))


def test_a_draw_is_the_same_however_many_others_there_are(posterior):
    many = ExactSampler().sample(posterior, draws=7, chains=3, seed=5, progress=False)
    few = ExactSampler().sample(posterior, draws=3, chains=2, seed=5, progress=True)
    np.testing.assert_array_equal(many.positions.values[:2, :3], few.positions.values)
    assert many.independent


def test_seeds_and_chains_differ(posterior):
    one = ExactSampler().sample(posterior, draws=2, chains=2, seed=0, progress=False)
    two = ExactSampler().sample(posterior, draws=2, chains=2, seed=1, progress=False)
    values = np.concatenate([one.flat(), two.flat()]).reshape(8, -1)
    assert len(np.unique(values, axis=0)) == 8


def test_a_prior_without_a_closed_form_is_refused(two_bumps):
    with pytest.raises(UnsupportedPosterior, match=r"exact needs a prior with HasExactPosterior"):
        ExactSampler().sample(MotionPosterior(two_bumps), draws=1, progress=False)


class Drawn:
    """A prior that can be drawn from, and has a density."""

    skeleton, frames, fps, dim = Skeleton(["a"], [-1]), 2, 30.0, 6

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 2, 1, 3)

    def sample(self, rng, n):
        return rng.normal(7.0, 2.0, (n, 2, 1, 3))

    def log_density(self, theta):
        return -0.5 * ((theta - 7.0) ** 2).sum(axis=-1) / 4.0

    def initial(self, rng, n):
        return rng.normal(7.0, 2.0, (n, 6))


def test_without_evidence_a_prior_that_can_be_drawn_from_will_do():
    draws = ExactSampler().sample(MotionPosterior(Drawn()), draws=500, chains=2, progress=False)
    assert draws.independent
    assert draws.flat().mean() == pytest.approx(7, abs=0.2)
    assert draws.flat().std() == pytest.approx(2, rel=0.1)
    seen = MotionPosterior(Drawn(), Joints3D(np.zeros((2, 1, 3)), noise=0.5))
    with pytest.raises(UnsupportedPosterior, match=r"exact needs a prior with HasExactPosterior"):
        ExactSampler().sample(seen, draws=1, progress=False)
    assert "exact" in suited(MotionPosterior(Drawn()))
    assert "exact" not in suited(seen)


def test_a_density_that_is_cut_is_refused(posterior):
    whole = TruncatedPosterior(Drawn(), seed=np.full(6, 7.0))
    assert ExactSampler().sample(whole, draws=3, progress=False).independent
    for cut in (
        TruncatedPosterior(Drawn(), seed=np.full(6, 7.0), limit=2.0),
        TruncatedPosterior(posterior.prior, posterior.likelihood, limit=2.0),
    ):
        with pytest.raises(UnsupportedPosterior, match="exact draws from prior and evidence") as no:
            ExactSampler().sample(cut, draws=3, progress=False)
        assert no.value.word == "truncated"
        assert "exact" not in suited(cut)
        assert not Problem("cut", "", cut).has_reference


def test_evidence_without_a_closed_form_is_refused(posterior):
    outliers = Joints3D(np.zeros((2, 2, 3)), noise=0.5, degrees_of_freedom=4.0)
    with pytest.raises(
        UnsupportedPosterior, match=r"exact needs a posterior in closed form, but the noise is"
    ) as refused:
        ExactSampler().sample(MotionPosterior(posterior.prior, outliers), progress=False)
    assert refused.value.word == "not-conjugate"


def test_a_starting_point_means_nothing(posterior):
    with pytest.raises(ValueError, match=r"initial must be None, got ndarray"):
        ExactSampler().sample(posterior, initial=np.zeros((1, 2)), progress=False)
