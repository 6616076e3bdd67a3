"""Scores of generated motion against closed forms and plain formulas."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from probmotion import seeds
from probmotion.geometry.cameras import Cameras
from probmotion.metrics.distribution import precision_recall
from probmotion.metrics.filming import film_motions, random_azimuths
from probmotion.metrics.generation import (
    GenerationReference,
    diversity,
    frechet_distance,
)
from probmotion.motion.skeleton import Skeleton


def test_frechet_distance_agrees_with_the_matrix_square_root(rng):
    a = rng.normal(size=(80, 6)) @ rng.normal(size=(6, 6))
    b = rng.normal(size=(50, 6)) @ rng.normal(size=(6, 6)) + 1
    covariances = np.cov(a.T), np.cov(b.T)
    root = scipy.linalg.sqrtm(covariances[0] @ covariances[1])
    differences = ((a.mean(axis=0) - b.mean(axis=0)) ** 2).sum()
    expected = differences + np.trace(covariances[0] + covariances[1] - 2 * root).real
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-10)
    assert frechet_distance(b, a) == pytest.approx(expected, rel=1e-10)
    # Equal sets have distance 0 even with fewer motions than features.
    features = 100 * rng.normal(size=(5, 20))
    assert 0 <= frechet_distance(features, features[::-1]) < 1e-12 * features.var(axis=0).sum()


def test_diversity_is_the_mean_distance_of_different_motions(rng):
    assert diversity(np.array([[0.0, 0.0], [3.0, 4.0]]), rng) == 5
    features = rng.normal(size=(2000, 3))
    differences = features[:, None] - features[None, :100]
    expected = np.linalg.norm(differences, axis=-1).sum() / (100 * 1999)
    assert diversity(features, rng, pairs=20_000) == pytest.approx(expected, rel=0.02)


def test_views_agree_with_cameras_around_the_root(rng):
    motions = rng.normal(size=(5, 4, 3, 3)) + np.array([3.0, 1.0, -2.0])
    azimuths = random_azimuths(np.random.default_rng(1), 5)
    views = film_motions(motions, np.random.default_rng(1), elevation=0.3, distance=9.0, root=2)
    cameras = Cameras.around(azimuths, np.full(5, 0.3), distance=9.0, perspective=True)
    for number, motion in enumerate(motions):
        expected = cameras.view(number).project(motion - motion[:, 2:3])[0]
        np.testing.assert_allclose(views[number], expected, atol=1e-12)
    assert (views[:, :, 2] == 0).all()
    with pytest.raises(ValueError, match="points"):  # behind the camera
        film_motions(100 * motions, rng)


def test_azimuths_are_uniform(rng):
    any_side = random_azimuths(rng, 4000) / (2 * math.pi)
    side = (random_azimuths(rng, 4000, "side") - math.pi / 4) / (math.pi / 2)
    for values in (any_side, side):
        assert scipy.stats.kstest(values, "uniform").pvalue > 1e-4
    assert (random_azimuths(rng, 3, "reference-code-side") == math.pi / 2).all()


class Plain:
    """Evaluator whose features are the coordinates of the first and last frame."""

    skeleton = Skeleton(["ankle", "knee", "hip"], [1, 2, -1])
    frames = 10

    def features(self, views, lengths=None):
        return views[:, [0, -1], :2].reshape(len(views), -1)


def random_motions(rng, n):
    return 0.5 * rng.normal(size=(n, 4, 3, 3))


@pytest.fixture
def reference(rng):
    views = film_motions(random_motions(rng, 200), rng, elevation=0.2, distance=9.0, root=2)
    return GenerationReference(Plain(), Plain().features(views), elevation=0.2, distance=9.0)


def test_views_use_the_cameras_of_the_reference(rng, reference):
    side = "reference-code-side"
    motions = random_motions(rng, 30)
    scores = reference.score_motions(motions, seed=0, repeats=2, angles=side)
    views = film_motions(motions, rng, elevation=0.2, distance=9.0, angles=side, root=2)
    expected = frechet_distance(Plain().features(views), reference.held_out_features)
    assert scores["fid"][0] == pytest.approx(expected, rel=1e-9)


def test_scores_are_means_and_standard_deviations_over_subsets(rng, reference):
    views, held_out = rng.normal(size=(60, 4, 3, 2)), reference.held_out_features
    values = {"fid": [], "diversity": [], "precision": [], "recall": []}
    for repeat in range(3):
        chosen = seeds.generator(3, "views", repeat).permutation(60)[:40]
        features = Plain().features(views[chosen])
        precision, recall = precision_recall(features, held_out)
        values["fid"].append(frechet_distance(features, held_out))
        values["diversity"].append(diversity(features, seeds.generator(3, "pairs", repeat)))
        values["precision"].append(precision)
        values["recall"].append(recall)
    scores = reference.score_views(views, seed=3, samples=40, repeats=3)
    for name, row in values.items():
        assert scores[name] == pytest.approx((np.mean(row), np.std(row, ddof=1)))


def test_repeats_differ_in_views_and_subsets_only(rng, reference):
    motions = random_motions(rng, 100)
    scores = reference.score_motions(motions, seed=1, samples=50, repeats=3)
    assert scores == reference.score_motions(motions, seed=1, samples=50, repeats=3)
    assert all(deviation > 0 for _, deviation in scores.values())
    fixed = reference.score_motions(motions, seed=1, repeats=3, angles="reference-code-side")
    # With one azimuth for all motions, only the pairs of the diversity are random.
    assert fixed["fid"][1] < 1e-12
    assert fixed["recall"][1] < 1e-12 < 1e-3 < fixed["diversity"][1]


@pytest.mark.parametrize(("frames", "used"), [(23, 20), (10, 10), (4, 4)])
def test_the_chamfer_distance_uses_complete_windows(rng, reference, frames, used):
    motions = 0.5 * rng.normal(size=(1, frames, 3, 3))
    filming = {"elevation": 0.2, "distance": 9.0, "root": 2}
    real = film_motions(motions, seeds.generator(3, "chamfer"), **filming) + np.array([0.1, 0.0])
    real[:, used:] = 50.0
    result = replace(reference, held_out_views=real).chamfer(motions, seed=3)
    # The nearest window to each window is its copy, 10 cm away.
    assert result.of_generated == pytest.approx(0.01)


def test_training_clips_as_reference(rng):
    held_out, learnt = rng.normal(size=(2, 50, 3))
    again = GenerationReference(Plain(), held_out, learnt, elevation=0.1).of_learnt()
    np.testing.assert_array_equal(again.held_out_features, learnt)
    assert again.elevation == 0.1


REAL = GenerationReference(Plain(), np.zeros((5, 2)))
FIVE = np.zeros((5, 2))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frechet_distance(FIVE, np.zeros((5, 3))), r"b must have shape \(M, 2"),
        (lambda: frechet_distance(FIVE, FIVE[:1]), "b must have at least 2 motions, got 1"),
        (lambda: frechet_distance(FIVE * np.nan, FIVE), "a must be finite, got 10 values"),
        (lambda: diversity(FIVE[:1], None), "features must have at least 2 motions, got 1"),
        (lambda: random_azimuths(None, 3, "front"), "angles must be one of all, side, .*got 'fro"),
        (lambda: replace(REAL, held_out_features=FIVE[0]), "held_out_features must have shape"),
        (lambda: replace(REAL, learnt_features=FIVE[:, :1]), "learnt_features must have shape"),
        (lambda: replace(REAL, held_out_views=FIVE), "held_out_views must have shape"),
        (lambda: REAL.of_learnt(), "learnt_features must be given, got None"),
        (lambda: REAL.chamfer(np.zeros((1, 4, 3, 3)), seed=0), "held_out_views must be given"),
        (lambda: REAL.score_views(None, seed=0, repeats=1), "repeats must be an integer of at lea"),
    ],
)
def test_invalid_arguments(call, message):
    with pytest.raises(ValueError, match=message):
        call()
