"""Likelihood of annotated pairs: equations 6 and 9, fixed and fresh views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import logsumexp

from probmotion import MotionPosterior
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.coordinates import interaction_distance
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.problems import load_problem

DANCES = synthetic_dances(5)
DRAWN = draw_annotations(DANCES[:4], 60, seed=0, known_views=True)
ANNOTATIONS = DRAWN.annotations
UNKNOWN_VIEWS = replace(ANNOTATIONS, views=None)
POSES = DANCES[4].positions[[0, 20, 50, 80], None]


@pytest.fixture(scope="module")
def likelihood():
    return AnnotatedPairs(ANNOTATIONS, n_views=6, n_near=5, shortest_edge=0.3)


def test_density_equals_equations_6_and_9(likelihood):
    expected = []
    for pose in POSES:
        projections = project_to_views(pose, likelihood.views, likelihood.skeleton)[0]
        terms = []
        for projection, near in zip(projections, likelihood.near, strict=True):
            distances = interaction_distance(projection, ANNOTATIONS.keypoints[near], epsilon=0.3)
            terms.append(-(distances.min() ** 2) / (2 * likelihood.noise**2))
        expected.append(logsumexp(terms) - np.log(6))
    assert np.allclose(likelihood.log_density(POSES), expected, atol=1e-8)


@pytest.mark.parametrize("measure", ["interaction", "cartesian"])
@pytest.mark.parametrize("occluded", [0.0, 0.3])
def test_negligible_views_do_not_change_the_density(measure, occluded):
    """The density omits views far below the best one; ``evaluate`` compares all of them."""
    rng = np.random.default_rng(0)
    visible = rng.random(ANNOTATIONS.visible.shape) >= occluded
    annotations = replace(ANNOTATIONS, visible=visible)
    likelihood = AnnotatedPairs(annotations, n_views=12, n_near=20, measure=measure)
    poses = np.concatenate([POSES + s * rng.standard_normal(POSES.shape) for s in (0, 0.05, 0.5)])
    log_density = likelihood.log_density(poses)
    assert np.array_equal(log_density, likelihood.evaluate(poses)[0])
    projections = project_to_views(poses[:, 0], likelihood.views, likelihood.skeleton)
    terms = likelihood.comparer.log_terms(projections, likelihood.near, likelihood.noise)
    assert (terms == -np.inf).any() == (measure == "interaction")


def test_density_with_fixed_views_depends_on_the_seed_only():
    first, second, other = (AnnotatedPairs(ANNOTATIONS, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(first.views, second.views)
    assert np.array_equal(first.log_density(POSES), second.log_density(POSES))
    assert np.array_equal(first.log_density(POSES)[1:2], first.log_density(POSES[1:2]))
    assert not np.array_equal(first.log_density(POSES), other.log_density(POSES))


@pytest.mark.slow
def test_fresh_views_are_unbiased():
    """The mean of many estimates is the density with many views; the mean logarithm is lower."""
    estimator = AnnotatedPairs(ANNOTATIONS, n_views=4, n_near=8, noise=0.1)
    accurate = AnnotatedPairs(ANNOTATIONS, n_views=40_000, n_near=8, noise=0.1)
    generators = [np.random.default_rng(k) for k in range(4000)]
    log_density, closest = estimator.evaluate(np.repeat(POSES[:1], 4000, axis=0), generators)
    assert closest.shape == (4000, 4)
    estimates = np.exp(log_density)
    truth = np.exp(accurate.log_density(POSES[:1]))[0]
    error = np.hypot(estimates.std() / np.sqrt(4000), estimates.std() * 2 / np.sqrt(40_000))
    assert abs(estimates.mean() - truth) < 4 * error
    assert abs(np.exp(log_density.mean()) - truth) > 4 * error


def test_many_views_approach_the_integral_over_a_fine_grid_of_views():
    """Equation 6 by brute force: midpoints of cells of 2 by 2 degrees, each with density f(v)."""
    many = AnnotatedPairs(ANNOTATIONS, n_views=4096, n_near=8, noise=0.1)
    phi, theta = np.radians(np.arange(-179, 180, 2)), np.radians(np.arange(1, 180, 2))
    grid = np.stack(np.meshgrid(phi, theta, indexing="ij"), axis=-1).reshape(-1, 2)
    projections = project_to_views(POSES[:, 0], grid, many.skeleton)
    near = many.distribution.near(grid, 8)
    terms = np.exp(many.comparer.log_terms(projections, near, many.noise))
    cells = np.exp(many.distribution.log_density(grid)) * np.radians(2) ** 2
    assert cells.sum() == pytest.approx(1, abs=1e-3)
    integral = terms @ cells
    error = np.sqrt((terms**2 @ cells - integral**2) / many.n_views)
    assert (error < 0.05 * integral).all()
    assert (np.abs(np.exp(many.log_density(POSES)) - integral) < 4 * error).all()


def test_each_estimate_depends_on_its_generator_only():
    estimator = AnnotatedPairs(ANNOTATIONS, n_views=4, n_near=8)
    single, _ = estimator.evaluate(POSES[2:3], [np.random.default_rng(7)])
    batch, _ = estimator.evaluate(POSES, [np.random.default_rng(k) for k in (1, 2, 7, 9)])
    assert single[0] == batch[2]


def test_joint_speeds_are_means_over_the_closest_annotations(likelihood):
    turns, stretch = ANNOTATIONS.local_differences()
    closest = np.array([[0, 3, 3, 7, 1, 2], [5, 5, 5, 5, 5, 5]])
    speeds = likelihood.joint_speeds(closest)
    assert speeds.shape == (2, 34, 2)
    assert np.allclose(speeds[0, :, 0], (turns[closest[0]] ** 2).mean(axis=0))
    assert np.allclose(speeds[1, :, 1], stretch[5] ** 2)


def test_views_are_estimated_and_annotations_without_an_estimate_dropped():
    estimated = AnnotatedPairs.estimated(UNKNOWN_VIEWS, DRAWN.positions[0], n_views=4)
    assert np.isfinite(estimated.log_density(DRAWN.positions[:3, None])).all()
    posterior = pair_posterior(DRAWN.positions[[0, 30]], UNKNOWN_VIEWS, PairSettings(n_views=4))
    views = posterior.likelihood.annotations.views
    assert np.array_equal(views, estimated.annotations.views)
    occluded = draw_annotations(DANCES[:4], 60, seed=0, hidden=0.7).annotations
    remaining = AnnotatedPairs.estimated(occluded, DRAWN.positions[0], n_views=4).annotations
    dropped = remaining.dropped["view not estimated"]
    assert dropped > 0
    assert len(remaining) == 60 - dropped


def test_simulated_annotations_favour_their_pose(likelihood):
    simulated = likelihood.simulate(np.random.default_rng(0), POSES[0])
    assert simulated.log_density(POSES).argmax() == 0
    assert simulated.joint_speeds(np.zeros((1, 6), dtype=int)).max() == 0


def test_degenerate_projections_are_counted(likelihood):
    assert likelihood.degenerate_fraction(POSES) == 0
    flat = POSES.copy()
    flat[0] = flat[0, :, :1]
    flat[0, :, [0, 17]] += np.array([[[0.0, 0, 0]], [[0.3, 0, 0]]])
    flat[0, :, [2, 19]] += np.array([0.0, 0.3, 0.0])
    assert 0 < likelihood.degenerate_fraction(flat) <= 1 / 4


LEGS = ["hip" in name or "knee" in name for name in ANNOTATIONS.skeleton.joint_names]
ONLY_LEGS = replace(ANNOTATIONS, visible=np.tile(LEGS, (60, 1)))
MILLIMETRES = replace(ANNOTATIONS, keypoints=1000 * ANNOTATIONS.keypoints)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda _: AnnotatedPairs(UNKNOWN_VIEWS), "annotations must have views, got none"),
        (lambda x: x.log_density(torch.tensor(POSES)), "must be a NumPy array, got Tensor"),
        (lambda x: MotionPosterior(load_problem("gait").posterior.prior, x), "likelihood"),
        (
            lambda _: AnnotatedPairs.estimated(ONLY_LEGS, DRAWN.positions[0]),
            "at least three torso joints of each person in one frame, got none in 60 frames",
        ),
        (lambda _: AnnotatedPairs(MILLIMETRES), "have bones of .*: keypoints must be in metres"),
        (
            lambda _: AnnotatedPairs.estimated(ANNOTATIONS, DRAWN.positions[0, :17]),
            r"seed_pose must have shape \(34, 3\), got \(17, 3\)",
        ),
        (lambda _: AnnotatedPairs(ANNOTATIONS, shortest_edge=0), "shortest_edge must be"),
        (lambda _: AnnotatedPairs(ANNOTATIONS, view_bandwidth=0), "view_bandwidth must be"),
    ],
)
def test_invalid_arguments_are_rejected(call, message, likelihood):
    with pytest.raises(ValueError, match=message):
        call(likelihood)
