import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg

from probmotion import seeds
from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.cameras import Cameras
from probmotion.metrics.distribution import precision_recall
from probmotion.metrics.filming import film_motions, random_azimuths
from probmotion.metrics.generation import (
    EncodesViews,
    GenerationReference,
    GenerationScores,
    diversity,
    frechet_distance,
    score_generation,
)
from probmotion.motion.skeleton import Skeleton


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def with_moments(rng, mean, covariance, n=60):
    """Points whose sample mean and covariance are these, to rounding."""
    points = rng.normal(size=(n, len(mean)))
    points -= points.mean(axis=0)
    white = points @ np.linalg.inv(np.linalg.cholesky(np.cov(points.T))).T
    return white @ np.linalg.cholesky(covariance).T + mean


# ---- the Fréchet distance


def test_frechet_distance_of_gaussians_with_one_basis_is_that_of_their_axes(rng):
    basis, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    first, second = np.array([1.0, 4.0, 9.0, 0.25]), np.array([4.0, 4.0, 1.0, 1.0])
    shift = np.array([1.0, -2.0, 0.0, 2.0])
    a = with_moments(rng, np.zeros(4), basis * first @ basis.T)
    b = with_moments(rng, shift, basis * second @ basis.T)
    # ‖μ‖² + Σ (σ_a − σ_b)², deviations 1 2 3 .5 and 2 2 1 1.
    assert frechet_distance(a, b) == pytest.approx(9 + 1 + 0 + 4 + 0.25)


def test_frechet_distance_is_the_matrix_roots(rng):
    a = rng.normal(size=(80, 6)) @ rng.normal(size=(6, 6))
    b = rng.normal(size=(50, 6)) @ rng.normal(size=(6, 6)) + 1
    covariances = np.cov(a.T), np.cov(b.T)
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1])
    apart = ((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum()
    expected = apart + np.trace(covariances[0] + covariances[1] - 2 * root).real
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-10)
    assert frechet_distance(b, a) == pytest.approx(expected, rel=1e-10)


def test_frechet_distance_of_a_set_from_itself_is_nothing_even_with_more_features(rng):
    for n in (5, 200):
        features = 100 * rng.normal(size=(n, 20))
        found = frechet_distance(features, features[::-1])
        assert 0 <= found < 1e-12 * features.var(axis=0).sum()


def test_small_sets_raise_the_frechet_distance_as_the_docstring_says(rng):
    D, N = 10, 400
    found = [frechet_distance(rng.normal(size=(N, D)), rng.normal(size=(N, D))) for _ in range(40)]
    assert np.mean(found) == pytest.approx(2 * D * (D + 5) / (4 * N), rel=0.05)


# ---- diversity, and the scores together


def test_diversity_is_the_mean_distance_of_different_motions(rng):
    assert diversity(np.array([[0.0, 0.0], [3.0, 4.0]]), rng) == 5
    features = rng.normal(size=(2000, 3))
    apart = features[:, None] - features[None, :100]
    expected = np.linalg.norm(apart, axis=-1).sum() / (100 * 1999)
    assert diversity(features, rng, pairs=20_000) == pytest.approx(expected, rel=0.02)


def test_scores_are_means_and_deviations_of_the_repeats(rng):
    held_out = rng.normal(size=(60, 3))
    sets = [rng.normal(size=(40, 3)) + shift for shift in (0, 1, 2)]
    remaining = iter(sets)
    asked = []

    def draw(generator, n):
        asked.append((generator.random(), n))
        return next(remaining)

    scores = score_generation(np.negative, draw, -held_out, seed=3, samples=40, repeats=3)
    fids = [frechet_distance(one, held_out) for one in sets]
    assert scores["fid"] == pytest.approx((np.mean(fids), np.std(fids, ddof=1)))
    precisions, recalls = np.transpose([precision_recall(one, held_out) for one in sets])
    assert scores["precision"] == pytest.approx((precisions.mean(), precisions.std(ddof=1)))
    assert scores["recall"] == pytest.approx((recalls.mean(), recalls.std(ddof=1)))
    diversities = [
        diversity(-one, seeds.generator(3, "pairs", number)) for number, one in enumerate(sets)
    ]
    assert scores["diversity"] == pytest.approx((np.mean(diversities), np.std(diversities, ddof=1)))
    assert len({number for number, _ in asked}) == 3
    assert {n for _, n in asked} == {40}


def test_a_generator_of_one_motion_has_collapsed():
    assert GenerationScores(1.0, 0.1, 0.9, 0.09).collapsed
    assert not GenerationScores(1.0, 0.1, 0.9, 0.1).collapsed


# ---- filming


@pytest.fixture
def motions(rng):
    return rng.normal(size=(5, 4, 3, 3)) + np.array([3.0, 1.0, -2.0])


def test_filming_is_what_cameras_around_the_root_see(motions):
    azimuths = random_azimuths(np.random.default_rng(1), 5)
    views = film_motions(motions, np.random.default_rng(1), elevation=0.3, distance=9.0, root=2)
    cameras = Cameras.around(azimuths, np.full(5, 0.3), distance=9.0, perspective=True)
    for number, motion in enumerate(motions):
        expected = cameras.view(number).project(motion - motion[:, 2:3])[0]
        np.testing.assert_allclose(views[number], expected, atol=1e-12)
    assert (views[:, :, 2] == 0).all()


def test_azimuths_cover_what_they_should(rng):
    found = np.sort(random_azimuths(rng, 4000))
    # Kolmogorov's distance from the uniform distribution, at odds of 1 in 10 000.
    uniform = (np.arange(4000) + 0.5) / 4000
    assert np.abs(found / (2 * math.pi) - uniform).max() < 2.23 / math.sqrt(4000)
    side = np.sort(random_azimuths(rng, 4000, "side"))
    share = (side - math.pi / 4) / (math.pi / 2)
    assert np.abs(share - uniform).max() < 2.23 / math.sqrt(4000)
    assert (random_azimuths(rng, 3, "reference-code-side") == math.pi / 2).all()
    with pytest.raises(ValueError, match="angles must be one of all, side, got 'front'"):
        random_azimuths(rng, 3, "front")


def test_the_side_of_a_gait_is_its_profile(rng):
    walk = make_gait("walk").positions[None]
    # Gaits face +Z, where the reference camera stands: from the side shoulders are in line.
    skeleton = make_gait("walk").skeleton
    left, right = (skeleton.canonical_names.index(f"{side}_shoulder") for side in ("left", "right"))

    def breadth(angles):
        view = film_motions(walk, rng, angles=angles)
        return np.abs(view[0, 0, left, 0] - view[0, 0, right, 0])

    assert breadth("reference-code-side") < 0.15 < 0.25 < np.ptp(walk[0, 0, [left, right], 0])


def test_a_joint_behind_the_camera_is_refused(motions, rng):
    with pytest.raises(ValueError, match="points has a joint"):
        film_motions(100 * motions, rng)


# ---- the reference


class Plain:
    """Features that are a motion's own coordinates, first and last frame."""

    skeleton = Skeleton(["ankle", "knee", "hip"], [1, 2, -1])
    frames = 10

    def features(self, views, lengths=None):
        return views[:, [0, -1], :2].reshape(len(views), -1)


def made(rng, n):
    return 0.5 * rng.normal(size=(n, 4, 3, 3))


@pytest.fixture
def reference(rng):
    views = film_motions(made(rng, 200), rng, elevation=0.2, distance=9.0, root=2)
    return GenerationReference(Plain(), Plain().features(views), elevation=0.2, distance=9.0)


def test_real_motions_score_better_than_others(rng, reference):
    assert isinstance(Plain(), EncodesViews)
    right = reference.score_motions(made(rng, 200), seed=0, repeats=3)
    wide = reference.score_motions(2 * made(rng, 200), seed=0, repeats=3)
    one = reference.score_motions(
        np.repeat(made(rng, 1), 200, axis=0) * [0, 1, 0], seed=0, repeats=3
    )
    assert right["fid"][0] < 0.2 * wide["fid"][0]
    assert wide["precision"][0] < 0.5 < right["precision"][0]
    assert one["recall"][0] < 0.1 < 0.5 < right["recall"][0]


def test_motions_are_filmed_as_the_reference_says(rng, reference):
    motions = made(rng, 30)
    scores = reference.score_motions(motions, seed=0, repeats=2, angles="reference-code-side")
    views = film_motions(
        motions, rng, elevation=0.2, distance=9.0, angles="reference-code-side", root=2
    )
    expected = frechet_distance(Plain().features(views), reference.held_out_features)
    assert scores["fid"][0] == pytest.approx(expected, rel=1e-9)


def test_repeats_differ_by_views_and_subsets_alone(rng, reference):
    motions = made(rng, 100)
    scores = reference.score_motions(motions, seed=1, samples=50, repeats=3)
    assert scores == reference.score_motions(motions, seed=1, samples=50, repeats=3)
    assert all(deviation > 0 for _, deviation in scores.values())
    assert scores != reference.score_motions(motions, seed=2, samples=50, repeats=3)
    fixed = reference.score_motions(motions, seed=1, repeats=3, angles="reference-code-side")
    # All motions from one side: nothing but the diversity's pairs is left to chance.
    assert fixed["fid"][1] < 1e-12
    assert fixed["recall"][1] < 1e-12 < 1e-3 < fixed["diversity"][1]


def test_views_are_judged_as_they_are(rng, reference):
    views = film_motions(made(rng, 80), rng)
    scores = reference.score_views(views, seed=0, repeats=2)
    expected = frechet_distance(Plain().features(views), reference.held_out_features)
    assert scores["fid"] == (pytest.approx(expected), pytest.approx(0, abs=1e-12))
    assert reference.score_views(views, seed=0, samples=40, repeats=3)["fid"][1] > 0


@pytest.mark.parametrize(("frames", "whole"), [(23, 20), (10, 10), (4, 4)])
def test_the_chamfer_distance_is_of_whole_windows_of_pictures(rng, reference, frames, whole):
    motions = 0.5 * rng.normal(size=(1, frames, 3, 3))
    filmed = film_motions(
        motions, seeds.generator(3, "chamfer"), elevation=0.2, distance=9.0, root=2
    )
    real = filmed + np.array([0.1, 0.0])
    real[:, whole:] = 50.0
    found = replace(reference, held_out_views=real).chamfer(motions, seed=3)
    # The nearest of its windows is the same one, 10 cm beside.
    assert found.of_generated == pytest.approx(0.01)
    with pytest.raises(ValueError, match="held_out_views is missing"):
        reference.chamfer(motions, seed=0)
    with pytest.raises(ValueError, match=r"held_out_views has shape \(5, 4, 2, 2\)"):
        replace(reference, held_out_views=np.zeros((5, 4, 2, 2)))


def test_bad_input(rng):
    with pytest.raises(ValueError, match=r"b must have shape \(M, 2\), got \(5, 3\)"):
        frechet_distance(np.zeros((5, 2)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="b has 1 motions, expected at least 2"):
        frechet_distance(np.zeros((5, 2)), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="a must be finite, got 1 values that are NaN"):
        frechet_distance(np.array([[0.0], [np.nan]]), np.zeros((5, 1)))
    with pytest.raises(ValueError, match="features has 1 motions, expected at least 2"):
        diversity(np.zeros((1, 2)), rng)
    with pytest.raises(ValueError, match=r"held_out_features must have shape \(M, D\), got \(5,\)"):
        GenerationReference(Plain(), np.zeros(5))
    with pytest.raises(ValueError, match="repeats must be an integer of at least 2, got 1"):
        score_generation(np.negative, lambda g, n: np.zeros((9, 2)), np.zeros((9, 2)),
                         seed=0, repeats=1)  # fmt: skip


def test_the_learnt_clips_are_another_reference():
    rng = np.random.default_rng(0)
    held_out, learnt = rng.normal(size=(2, 50, 3)) + np.array([[[0.0]], [[5.0]]])
    both = GenerationReference(Plain(), held_out, learnt, elevation=0.1)
    again = both.of_learnt()
    np.testing.assert_array_equal(again.held_out_features, learnt)
    assert again.elevation == 0.1
    with pytest.raises(ValueError, match="learnt_features is missing"):
        GenerationReference(Plain(), held_out).of_learnt()
    with pytest.raises(
        ValueError, match=r"learnt_features must have shape \(M, 3\), got \(50, 2\)"
    ):
        GenerationReference(Plain(), held_out, learnt[:, :2])
