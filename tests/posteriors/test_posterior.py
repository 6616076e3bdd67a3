"""The posterior: prior plus likelihood, and what it refuses."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from probmotion import (
    Cameras,
    Joints3D,
    Keypoints2D,
    KeypointTrack,
    Motion,
    MotionPosterior,
    Skeleton,
)
from probmotion.arrays import array_namespace, constant, dot
from probmotion.problems import load_problem

FRAMES, CHAIN = 2, Skeleton(["hip", "knee"], [-1, 0])
DIM = FRAMES * 2 * 3
BASIS = np.random.default_rng(0).standard_normal((FRAMES, 2, 3, DIM))


class Flat:
    """Standard normal coordinates, positions linear in them."""

    skeleton, frames, fps, dim = CHAIN, FRAMES, 30.0, DIM

    def motion(self, theta: Any) -> Any:
        xp = array_namespace(theta)
        return xp.sum(constant(BASIS, theta) * theta[..., None, None, None, :], axis=-1)

    def log_density(self, theta: Any) -> Any:
        return -0.5 * dot(theta, theta) - 0.5 * DIM * float(np.log(2 * np.pi))

    def initial(self, rng: np.random.Generator, n: int) -> np.ndarray:
        return rng.standard_normal((n, DIM))


class Turned(Flat):
    """The same with a sign integrated out: half of the motions are mirrored."""

    def log_likelihood(self, theta: Any, likelihood: Any) -> Any:
        both = [likelihood.log_density(sign * self.motion(theta)) for sign in (1.0, -1.0)]
        return np.logaddexp(*both) - np.log(2)

    def complete(self, rng: np.random.Generator, theta: np.ndarray, likelihood: Any) -> np.ndarray:
        signs = rng.choice([-1.0, 1.0], len(theta))
        return signs[:, None, None, None] * self.motion(theta)


class Mute(Flat):
    """A prior that can only make motions."""

    log_density = initial = None  # type: ignore[assignment]


def evidence() -> Keypoints2D:
    seen = np.random.default_rng(1).standard_normal((2, FRAMES, 2, 2))
    return Keypoints2D(seen, Cameras.ring(2), 0.5)


def test_the_log_density_is_the_sum_of_both(library: Any) -> None:
    prior, likelihood = Flat(), evidence()
    posterior = MotionPosterior(prior, likelihood)
    theta = np.random.default_rng(2).standard_normal((3, DIM))
    got = library.compiled(posterior.log_density)(library.array(theta))
    wanted = prior.log_density(theta) + likelihood.log_density(prior.motion(theta))
    np.testing.assert_allclose(np.asarray(got) / 100, wanted / 100, rtol=0, atol=library.tolerance)
    alone = MotionPosterior(prior).log_density(library.array(theta))
    np.testing.assert_allclose(np.asarray(alone), prior.log_density(theta), rtol=1e-5)


def test_empty_batches_stay_empty(library: Any) -> None:
    posterior = MotionPosterior(Flat(), evidence())
    none = library.array(np.zeros((0, DIM)))
    assert posterior.log_density(none).shape == (0,)
    assert posterior.motion(none).shape == (0, FRAMES, 2, 3)


def test_what_the_prior_integrates_out_stays_out() -> None:
    prior, likelihood = Turned(), evidence()
    posterior = MotionPosterior(prior, likelihood)
    theta = np.random.default_rng(2).standard_normal((400, DIM))
    wanted = prior.log_density(theta) + prior.log_likelihood(theta, likelihood)
    np.testing.assert_allclose(posterior.log_density(theta), wanted)
    motions = posterior.complete(np.random.default_rng(3), theta)
    assert (motions == posterior.motion(theta)).all(axis=(1, 2, 3)).mean() == pytest.approx(
        0.5, abs=0.125
    )
    plain = MotionPosterior(Flat(), likelihood)
    rng = np.random.default_rng(3)
    np.testing.assert_array_equal(plain.complete(rng, theta), plain.motion(theta))
    assert rng.random() == np.random.default_rng(3).random()  # not used


def test_starting_points_come_from_the_prior() -> None:
    posterior = MotionPosterior(Flat(), evidence())
    points = posterior.initial(np.random.default_rng(0), 7)
    np.testing.assert_array_equal(points, Flat().initial(np.random.default_rng(0), 7))
    assert (posterior.dim, posterior.frames, posterior.fps) == (DIM, FRAMES, 30.0)
    assert posterior.skeleton == CHAIN


def test_evidence_of_another_clip_is_refused() -> None:
    longer = Keypoints2D(np.zeros((1, 3, 2, 2)), Cameras.ring(1), 0.1)
    with pytest.raises(ValueError, match="likelihood has frames 3, expected the prior's 2"):
        MotionPosterior(Flat(), longer)
    more = Joints3D(np.zeros((FRAMES, 5, 3)), 0.1)
    with pytest.raises(ValueError, match="likelihood has n_joints 5, expected the prior's 2"):
        MotionPosterior(Flat(), more)


def test_what_is_no_prior_or_likelihood_is_refused() -> None:
    with pytest.raises(ValueError, match="prior must be an object with skeleton, frames, got str"):
        MotionPosterior("walk")  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match="likelihood must be an object with log_density, got float"
    ):
        MotionPosterior(Flat(), 0.3)  # type: ignore[arg-type]


def test_wrong_coordinates_are_refused() -> None:
    posterior = MotionPosterior(Flat())
    for call in (posterior.log_density, posterior.motion):
        with pytest.raises(ValueError, match=r"theta must have shape \(…, 12\), got \(3, 5\)"):
            call(np.zeros((3, 5)))
    with pytest.raises(ValueError, match=r"theta must have shape \(n, 12\), got \(12,\)"):
        posterior.complete(np.random.default_rng(0), np.zeros(DIM))


def test_evidence_of_another_skeleton_or_frame_rate_is_refused() -> None:
    prior = load_problem("gait").posterior.prior
    positions = prior.sample(np.random.default_rng(0), 1)[0]
    camera = Cameras.ring(1)
    other = Motion(positions, Skeleton.preset("coco17"), prior.fps)
    with pytest.raises(ValueError, match=r"likelihood is of the joints nose, left_eye.*retarget"):
        MotionPosterior(prior, Keypoints2D.observe(other, camera, 0.02, 0))
    fast = Motion(positions, prior.skeleton, 2 * prior.fps)
    with pytest.raises(ValueError, match=r"likelihood is at 60 frames per second, expected .* 30"):
        MotionPosterior(prior, Joints3D.observe(fast, 0.02, 0))
    track = KeypointTrack(
        np.zeros((30, 17, 2)), np.ones((30, 17)), Skeleton.preset("coco17"), prior.fps
    )
    with pytest.raises(ValueError, match="likelihood is of the joints"):
        MotionPosterior(prior, Keypoints2D.from_track(track, camera, 0.02))
    right = Motion(positions, prior.skeleton, prior.fps)
    assert MotionPosterior(prior, Keypoints2D.observe(right, camera, 0.02, 0)).frames == 30
