"""The posterior as prior times likelihood, and its checks."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, Keypoints2D, Motion, MotionPosterior, Skeleton
from probmotion.arrays import array_namespace, constant, logsumexp

FRAMES, CHAIN = 2, Skeleton(["hip", "knee"], [-1, 0])
DIM = FRAMES * 2 * 3
BASIS = np.random.default_rng(0).standard_normal((FRAMES, 2, 3, DIM))


class Flat:
    """Standard normal coordinates, positions linear in them."""

    skeleton, frames, fps, dim = CHAIN, FRAMES, 30.0, DIM

    def motion(self, theta):
        xp = array_namespace(theta)
        return xp.sum(constant(BASIS, theta) * theta[..., None, None, None, :], axis=-1)

    def log_density(self, theta):
        square = array_namespace(theta).sum(theta**2, axis=-1)
        return -0.5 * square - 0.5 * DIM * float(np.log(2 * np.pi))

    def initial(self, rng, n):
        return rng.standard_normal((n, DIM))


class Turned(Flat):
    """The same with a sign marginalised: half of the motions are mirrored."""

    def log_likelihood(self, theta, likelihood):
        both = [likelihood.log_density(sign * self.motion(theta)) for sign in (1.0, -1.0)]
        xp = array_namespace(theta)
        return logsumexp(xp.stack(both, axis=-1)) - float(np.log(2))

    def complete(self, rng, theta, likelihood):
        signs = rng.choice([-1.0, 1.0], len(theta))
        return signs[:, None, None, None] * self.motion(theta)


@pytest.fixture(scope="module")
def likelihood():
    seen = np.random.default_rng(1).standard_normal((2, FRAMES, 2, 2))
    return Keypoints2D(seen, Cameras.ring(2), 0.5)


def test_the_log_density_is_the_sum_of_prior_and_likelihood(library, likelihood):
    prior = Flat()
    posterior = MotionPosterior(prior, likelihood)
    theta = np.random.default_rng(2).standard_normal((3, DIM))
    got = library.compiled(posterior.log_density)(library.array(theta))
    wanted = prior.log_density(theta) + likelihood.log_density(prior.motion(theta))
    np.testing.assert_allclose(np.asarray(got) / 100, wanted / 100, rtol=0, atol=library.tolerance)
    alone = MotionPosterior(prior).log_density(library.array(theta))
    np.testing.assert_allclose(np.asarray(alone), prior.log_density(theta), rtol=1e-5)
    none = library.array(np.zeros((0, DIM)))
    assert posterior.log_density(none).shape == (0,)
    assert posterior.motion(none).shape == (0, FRAMES, 2, 3)


def test_marginalised_variables(likelihood):
    prior = Turned()
    posterior = MotionPosterior(prior, likelihood)
    theta = np.random.default_rng(2).standard_normal((400, DIM))
    wanted = prior.log_density(theta) + prior.log_likelihood(theta, likelihood)
    np.testing.assert_allclose(posterior.log_density(theta), wanted)
    motions = posterior.complete(theta, np.random.default_rng(3))
    unchanged = (motions == posterior.motion(theta)).all(axis=(1, 2, 3)).mean()
    assert unchanged == pytest.approx(0.5, abs=0.125)
    plain = MotionPosterior(Flat(), likelihood)
    rng = np.random.default_rng(3)
    np.testing.assert_array_equal(plain.complete(theta, rng), plain.motion(theta))
    assert rng.random() == np.random.default_rng(3).random()  # rng is unused


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("prior", [Flat, Turned])
def test_batches(prior, batch, library, likelihood):
    posterior = MotionPosterior(prior(), likelihood)
    theta = np.random.default_rng(2).standard_normal((*batch, DIM))
    motions = posterior.complete(library.array(theta))
    assert motions.shape == (*batch, FRAMES, 2, 3)
    assert isinstance(motions, np.ndarray)
    rows = theta.reshape(-1, DIM)
    wanted = posterior.complete(rows).reshape(motions.shape)
    np.testing.assert_allclose(motions, wanted, rtol=0, atol=10 * library.tolerance)
    log_density = np.asarray(posterior.log_density(library.array(theta)))
    assert log_density.shape == batch
    wanted = [posterior.log_density(row[None])[0] for row in rows]
    rtol = 1e-10 if library.dtype == "float64" else 1e-4
    np.testing.assert_allclose(log_density.reshape(-1), wanted, rtol=rtol)


PRIOR = MotionPosterior(Flat())


def observed(skeleton=CHAIN, fps=30.0):
    return Joints3D.observe(Motion(np.zeros((FRAMES, 2, 3)), skeleton, fps), 0.1, 0)


@pytest.mark.parametrize(
    ("likelihood", "message"),
    [
        (Keypoints2D(np.zeros((1, 3, 2, 2)), Cameras.ring(1), 1), "the prior's frames, 2, got 3"),
        (Joints3D(np.zeros((FRAMES, 5, 3)), 0.1), "the prior's n_joints, 2, got 5"),
        (
            observed(Skeleton(["hip", "ankle"], [-1, 0])),
            "the prior's joints, hip, knee, got hip, ankle; retarget",
        ),
        (observed(fps=60.0), "the prior's frame rate, 30, got 60; resample"),
        (0.3, r"likelihood must have log_density.*, got float"),
    ],
)
def test_likelihoods_that_do_not_match_are_refused(likelihood, message):
    with pytest.raises(ValueError, match=message):
        MotionPosterior(Flat(), likelihood)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: MotionPosterior("walk"), "prior must have skeleton, frames, .*, got str"),
        (lambda: PRIOR.log_density(np.zeros((3, 5))), r"shape \(…, 12\), got"),
        (lambda: PRIOR.motion(np.zeros((3, 5))), r"shape \(…, 12\), got \(3, 5"),
        (lambda: PRIOR.complete(np.zeros(5)), r"shape \(…, 12\), got"),
        (lambda: PRIOR.log_likelihood(np.zeros(DIM)), "must have a likelihood"),
    ],
)
def test_invalid_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_matching_skeleton_and_frame_rate_are_accepted():
    posterior = MotionPosterior(Flat(), observed())
    assert (posterior.dim, posterior.frames, posterior.skeleton) == (DIM, FRAMES, CHAIN)
    points = posterior.initial(np.random.default_rng(0), 7)
    np.testing.assert_array_equal(points, Flat().initial(np.random.default_rng(0), 7))
