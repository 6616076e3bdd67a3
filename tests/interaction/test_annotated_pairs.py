"""The likelihood of annotated pairs: eqs. 6 and 9 by the plain path, fixed and fresh views."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from probmotion import MotionPosterior
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.interaction.annotations.views import project_to_views
from probmotion.interaction.geometry.coordinates import align_rigidly, dissimilarity
from probmotion.interaction.geometry.graphs import graph_edges
from probmotion.posteriors.protocols import ComparesViews, Likelihood


@pytest.fixture(scope="module")
def drawn():
    return draw_annotations(synthetic_dances(4), 60, seed=0, known_views=True)


@pytest.fixture(scope="module")
def likelihood(drawn) -> AnnotatedPairs:
    return AnnotatedPairs(drawn.annotations, n_views=6, n_near=5)


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    """Pairs of another dance, (4, 1, J, 3)."""
    return synthetic_dances(5)[4].positions[[0, 20, 50, 80], None]


def test_the_density_is_equations_6_and_9(likelihood, poses, drawn):
    expected = []
    for pose in poses:
        pictures = project_to_views(pose, likelihood.views, likelihood.skeleton)[0]
        terms = []
        for picture, near in zip(pictures, likelihood.near, strict=True):
            best = np.inf
            for annotation in drawn.annotations.keypoints[near]:
                moved = align_rigidly(picture, annotation)
                d = dissimilarity(moved, annotation, graph_edges(moved), graph_edges(annotation))
                best = min(best, float(d))
            terms.append(-(best**2) / (2 * likelihood.noise**2))
        expected.append(logsumexp(terms) - np.log(6))
    assert np.allclose(likelihood.log_density(poses), expected, atol=1e-8)


def test_it_is_a_likelihood_that_compares_views(likelihood):
    assert isinstance(likelihood, Likelihood)
    assert isinstance(likelihood, ComparesViews)


def test_with_fixed_views_the_density_is_a_function(drawn, poses):
    first = AnnotatedPairs(drawn.annotations, seed=3)
    second = AnnotatedPairs(drawn.annotations, seed=3)
    assert np.array_equal(first.views, second.views)
    assert np.array_equal(first.log_density(poses), second.log_density(poses))
    assert np.array_equal(first.log_density(poses)[1:2], first.log_density(poses[1:2]))
    other = AnnotatedPairs(drawn.annotations, seed=4)
    assert not np.array_equal(first.log_density(poses), other.log_density(poses))


@pytest.mark.slow
def test_fresh_views_estimate_the_integral_without_bias(drawn, poses):
    """The mean of many small estimates is that of one with as many views, the standard error apart.

    Their logarithms would not be: by Jensen's inequality their mean is lower.
    """
    few = AnnotatedPairs(drawn.annotations, n_views=4, n_near=8, noise=0.1)
    many = AnnotatedPairs(drawn.annotations, n_views=40_000, n_near=8, noise=0.1)
    generators = [np.random.default_rng(k) for k in range(4000)]
    log_density, closest = few.evaluate(np.repeat(poses[:1], 4000, axis=0), generators)
    assert closest.shape == (4000, 4)
    estimates = np.exp(log_density)
    truth = np.exp(many.log_density(poses[:1]))[0]
    error = np.hypot(estimates.std() / np.sqrt(4000), estimates.std() * 2 / np.sqrt(40_000))
    assert abs(estimates.mean() - truth) < 4 * error
    assert abs(np.exp(log_density.mean()) - truth) > 4 * error


def test_a_generator_of_its_own_decides_each_estimate(drawn, poses):
    few = AnnotatedPairs(drawn.annotations, n_views=4, n_near=8)
    alone, _ = few.evaluate(poses[2:3], [np.random.default_rng(7)])
    beside, _ = few.evaluate(poses, [np.random.default_rng(k) for k in (1, 2, 7, 9)])
    assert alone[0] == beside[2]


def test_where_the_pair_stands_and_faces_is_no_matter(likelihood, poses):
    turn = Rotation.from_rotvec([0.4, 2.5, -0.3])
    moved = turn.apply(poses.reshape(-1, 3)).reshape(poses.shape) + np.array([3.0, 1.0, -2.0])
    assert np.allclose(likelihood.log_density(moved), likelihood.log_density(poses), atol=1e-7)


def test_the_annotated_pairs_themselves_are_likeliest(drawn):
    likelihood = AnnotatedPairs(drawn.annotations, n_near=60)
    own = likelihood.log_density(drawn.positions[:, None])
    rng = np.random.default_rng(0)
    shaken = drawn.positions[:, None] + 0.1 * rng.standard_normal((60, 1, 34, 3))
    assert (own > likelihood.log_density(shaken)).all()


def test_speeds_are_means_over_the_closest_annotations(likelihood, drawn):
    turn, stretch = drawn.annotations.local_differences()
    closest = np.array([[0, 3, 3, 7, 1, 2], [5, 5, 5, 5, 5, 5]])
    speeds = likelihood.joint_speeds(closest)
    assert speeds.shape == (2, 34, 2)
    assert np.allclose(speeds[0, :, 0], (turn[closest[0]] ** 2).mean(axis=0))
    assert np.allclose(speeds[1, :, 1], stretch[5] ** 2)


def test_views_are_estimated_where_they_are_not_known(drawn):
    unknown = draw_annotations(synthetic_dances(4), 60, seed=0).annotations
    with pytest.raises(ValueError, match="annotations has no views"):
        AnnotatedPairs(unknown)
    estimated = AnnotatedPairs.estimated(unknown, drawn.positions[0], n_views=4)
    assert estimated.annotations.views.shape == (60, 2)
    assert np.isfinite(estimated.log_density(drawn.positions[:3, None])).all()


def test_one_annotation_and_one_view_will_do(drawn, poses):
    one = AnnotatedPairs(drawn.annotations.subset([11]))
    assert np.isfinite(one.log_density(poses)).all()
    assert one.near.shape == (32, 1)
    views = np.repeat(drawn.annotations.views[:1], 60, axis=0)
    from dataclasses import replace

    same = AnnotatedPairs(replace(drawn.annotations, views=views))
    assert np.isfinite(same.log_density(poses)).all()


def test_people_far_apart_have_a_density(likelihood, poses):
    apart = poses.copy()
    apart[:, :, 17:] += [50.0, 0.0, 0.0]
    log_density = likelihood.log_density(apart)
    assert np.isfinite(log_density).all()
    assert (log_density < likelihood.log_density(poses)).all()


def test_hidden_joints_are_not_read(poses):
    hidden = draw_annotations(synthetic_dances(4), 60, seed=0, known_views=True, hidden=0.3)
    likelihood = AnnotatedPairs(hidden.annotations, n_near=60)
    assert not hidden.annotations.visible.all()
    whole = AnnotatedPairs(
        draw_annotations(synthetic_dances(4), 60, seed=0, known_views=True).annotations, n_near=60
    )
    found, expected = likelihood.log_density(poses), whole.log_density(poses)
    assert np.isfinite(found).all()
    assert np.abs(found - expected).max() < 0.5 * np.abs(expected).max() + 5


def test_simulated_evidence_is_of_the_pose(likelihood, poses):
    evidence = likelihood.simulate(np.random.default_rng(0), poses[0])
    values = evidence.log_density(poses)
    assert values.argmax() == 0
    assert evidence.joint_speeds(np.zeros((1, 6), dtype=int)).max() == 0


def test_arrays_with_gradients_are_refused(likelihood, poses):
    with pytest.raises(ValueError, match=r"positions is a Tensor, expected a NumPy array"):
        likelihood.log_density(torch.tensor(poses))


def test_a_posterior_of_other_joints_is_refused(likelihood):
    from probmotion.problems import load_problem

    with pytest.raises(ValueError, match="likelihood"):
        MotionPosterior(load_problem("gait").posterior.prior, likelihood)


def test_pictures_whose_view_cannot_be_estimated_are_counted(drawn):
    hidden = draw_annotations(synthetic_dances(4), 60, seed=0, hidden=0.7).annotations
    estimated = AnnotatedPairs.estimated(hidden, drawn.positions[0], n_views=4)
    left_out = estimated.annotations.dropped["view not to be estimated"]
    assert left_out > 0
    assert len(estimated.annotations) == 60 - left_out
    assert "view not to be estimated" in estimated.annotations.describe()
    trunk = np.array(["hip" in name or "knee" in name for name in hidden.skeleton.joint_names])
    from dataclasses import replace

    legs = replace(hidden, visible=np.tile(trunk, (60, 1)))
    with pytest.raises(ValueError, match="too little of the torsos in all 60 pictures"):
        AnnotatedPairs.estimated(legs, drawn.positions[0])


def test_what_is_not_in_metres_or_of_other_people_is_refused(drawn):
    from dataclasses import replace

    thousand = replace(drawn.annotations, keypoints=1000 * drawn.annotations.keypoints)
    with pytest.raises(ValueError, match=r"annotations has bones .* long .*keypoints are metres"):
        AnnotatedPairs(thousand)
    with pytest.raises(ValueError, match=r"seed_pose must have shape \(34, 3\), got \(17, 3\)"):
        AnnotatedPairs.estimated(drawn.annotations, drawn.positions[0, :17])
    with pytest.raises(ValueError, match="shortest_edge is 0"):
        AnnotatedPairs(drawn.annotations, shortest_edge=0)
    with pytest.raises(ValueError, match="view_bandwidth is 0"):
        AnnotatedPairs(drawn.annotations, view_bandwidth=0)


def test_pictures_that_had_to_be_joggled_are_counted(likelihood, poses):
    assert likelihood.degenerate_fraction(poses) == 0
    flat = poses.copy()
    flat[0] = flat[0, :, :1]
    flat[0, :, [0, 17]] += np.array([[[0.0, 0, 0]], [[0.3, 0, 0]]])
    flat[0, :, [2, 19]] += np.array([0.0, 0.3, 0.0])
    assert 0 < likelihood.degenerate_fraction(flat) <= 1 / 4


def test_the_shortest_edge_is_the_densitys(drawn, poses):
    """ε counts where joints are near: the coarser it is, the less near joints weigh."""
    fine, coarse = (
        AnnotatedPairs(drawn.annotations, shortest_edge=size, noise=0.1) for size in (0.01, 0.5)
    )
    assert np.abs(fine.log_density(poses) - coarse.log_density(poses)).min() > 1e-3


def test_views_are_estimated_from_the_first_seed(drawn):
    from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior

    unknown = draw_annotations(synthetic_dances(4), 60, seed=0).annotations
    seeds = drawn.positions[[0, 30]]
    several = pair_posterior(seeds, unknown, PairSettings(n_views=4))
    first = AnnotatedPairs.estimated(unknown, seeds[0], n_views=4)
    assert np.array_equal(several.likelihood.annotations.views, first.annotations.views)
