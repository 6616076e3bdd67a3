"""Problems on real motion: exact posteriors, truths from held-out clips, missing data."""

from __future__ import annotations

import time

import numpy as np
import pytest

import probmotion as pm
from probmotion import Motion, MotionPosterior, Skeleton
from probmotion.interaction.annotations.sources import world_axes
from probmotion.models import AnnotationPrior
from probmotion.posteriors.problem import Problem
from probmotion.problems import load_problem
from probmotion.problems.observations import observe
from probmotion.problems.real_motion import REAL_MOTION_PROBLEMS, pose_prior

OBSERVED = [name for name in REAL_MOTION_PROBLEMS if name != "cmu-motion"]


def problem_called(name, request):
    """Load a problem; skip the test if its held-out clip is missing."""
    if name != "cmu-motion":
        request.getfixturevalue("real_data")
    return load_problem(name)


def mean_distance(motions, truth):
    return np.linalg.norm(motions - truth, axis=-1).mean()


@pytest.mark.parametrize("name", REAL_MOTION_PROBLEMS)
def test_problem_loads_in_two_seconds(name, request):
    problem_called(name, request)  # without the imports
    start = time.process_time()
    description, make = REAL_MOTION_PROBLEMS[name]
    problem = make()
    assert time.process_time() - start < 2
    assert (problem.name, problem.description) == (name, description)


@pytest.mark.parametrize("name", OBSERVED)
def test_observations_bring_the_mean_nearer_to_a_held_out_motion(name, request):
    problem = problem_called(name, request)
    prior = problem.posterior.prior
    # Held-out motion in the frame of the prior, with its height above the floor.
    np.testing.assert_allclose(problem.truth.mean(axis=(0, 1))[[0, 2]], 0, atol=1e-12)
    error = mean_distance(problem.exact.mean(), problem.truth)
    assert error < 0.5 * mean_distance(prior.mean(), problem.truth)
    assert error < mean_distance(problem.reference(0, 100), problem.truth)


def test_occlusions_hide_a_limb_and_then_another(request):
    hidden = ~problem_called("cmu-motion-occluded", request).posterior.likelihood.entries.visible
    assert hidden.any(axis=(0, 1)).sum() == 3
    assert hidden.any(axis=(0, 2)).sum() == 5
    hidden = ~problem_called("cmu-motion-denoise", request).posterior.likelihood.entries.visible
    names = np.array(load_problem("cmu-motion").posterior.skeleton.joint_names)
    assert set(names[hidden[:5].any(axis=0)]) == {"right_elbow", "right_wrist"}
    assert set(names[hidden[5:].any(axis=0)]) == {"left_knee", "left_ankle"}


def test_exact_draws_are_right_and_draws_of_the_prior_are_not(request):
    problem = problem_called("salsa-lifted", request)
    draws = pm.sample(problem, "exact", draws=600, seed=1, progress=False)
    assert pm.score(problem, draws).verdict.is_right
    unobserved = Problem("prior", "", MotionPosterior(problem.posterior.prior))
    draws = pm.sample(unobserved, "exact", draws=200, progress=False)
    assert pm.score(problem, draws).verdict.is_wrong


def annotation_prior(views):
    """Return a prior over centred poses of four joints."""
    rng = np.random.default_rng(0)
    centring = np.kron(np.eye(4) - 1 / 4, np.eye(3))
    factors = centring @ rng.standard_normal((2, 12, 12)) * 0.1
    covariances = factors @ factors.swapaxes(1, 2) + 1e-4 * np.eye(12)
    means = (rng.standard_normal((2, 12)) @ centring).reshape(2, 4, 3)
    return AnnotationPrior(np.array([0.3, 0.7]), means, covariances, 0.03, views)


SKELETON = Skeleton(("root", "a", "b", "c"), (-1, 0, 1, 2))


def test_pose_prior_has_the_density_of_the_learnt_prior():
    learnt = annotation_prior(np.zeros((1, 2)))
    prior = pose_prior(learnt, SKELETON, azimuths=1, ground=0.1)
    poses = np.random.default_rng(1).standard_normal((5, 4, 3))
    poses -= poses.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(
        np.diff(prior.log_prior(poses[:, None])), np.diff(learnt.log_density(poses)), rtol=1e-9
    )


def test_exact_posterior_lifts_as_the_learnt_prior_does():
    """With an almost unknown position, the posterior mean is the lift at a known elevation."""
    elevation = np.pi / 12
    azimuths = 2 * np.pi * np.arange(12) / 12
    views = np.stack([azimuths, np.full(12, elevation)], axis=1)
    learnt = annotation_prior(views)
    prior = pose_prior(learnt, SKELETON, azimuths=12, ground=10.0)
    pose = prior.sample(np.random.default_rng(2), 1)[0]
    pose = pose[..., [2, 1, 0]] * [1, 1, -1]  # a quarter turn: the heading is unknown
    truth = Motion(pose, SKELETON, prior.fps)
    likelihood = observe(truth, "monocular", learnt.noise, 0)
    posterior = prior.exact_posterior(likelihood)
    lift = learnt.lift(likelihood.keypoints[0] * [1, -1])  # y up
    in_camera = posterior.mean()[0] @ world_axes(np.array([[0.0, elevation]]))[0].T
    in_camera[:, 2] -= in_camera[:, 2].mean()
    np.testing.assert_allclose(in_camera, lift.positions[0], atol=1e-3)


def test_missing_clips_are_reported(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    for name in OBSERVED:
        with pytest.raises(FileNotFoundError, match="download"):
            REAL_MOTION_PROBLEMS[name][1]()
