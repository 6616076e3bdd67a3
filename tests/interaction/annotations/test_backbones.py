"""Backbones and views estimated from 2D annotations of synthetic and recorded pairs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.data.pair_sets import choose_seed, dance_frames, ground_truth
from probmotion.data.pairs import load_pairs
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.backbones import TORSO, annotation_views, lift_torsos
from probmotion.interaction.annotations.local_frames import chest_joints, joints_named, pair_frames
from probmotion.interaction.annotations.sources import draw_annotations, world_axes
from probmotion.interaction.annotations.torso_fits import fit_body
from probmotion.interaction.annotations.views import view_angles, view_vectors

PAIR = Skeleton.preset("pair17")
ROOTS, CHESTS = list(PAIR.roots), list(chest_joints(PAIR))
TORSOS = joints_named(PAIR, TORSO)
TOWARDS = np.array([0.0, 0.0, 1.0])
SEED = synthetic_dances(1)[0].positions[10]


def rotated(rotations, pair=SEED):
    """Rotate each person about their pelvis by ``rotations`` (n, K, 3, 3)."""
    people = pair.reshape(2, 17, 3)
    roots = people[:, :1]
    return (np.einsum("nkij,kmj->nkmi", rotations, people - roots) + roots).reshape(-1, 34, 3)


def random_rotations(n, seed):
    return Rotation.random(2 * n, rng=seed).as_matrix().reshape(n, 2, 3, 3)


def degrees(a, b):
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(cross, (a * b).sum(axis=-1)))


def annotated(positions, visible=True):
    mask = np.broadcast_to(visible, positions.shape[:2])
    missing = np.full((len(positions), 2, 34, 2), np.nan)
    return Annotations(positions[..., :2], mask, PAIR, missing, 30.0)


def lifted(positions, seed=SEED, visible=True):
    return lift_torsos(
        positions[..., :2], np.broadcast_to(visible, positions.shape[:2]), seed, PAIR
    )


def test_rotated_torsos_are_recovered_from_any_side():
    rotations = random_rotations(200, 0)
    positions = rotated(rotations)
    estimate = lifted(positions)
    assert estimate.lifted.all()
    assert estimate.residuals.max() < 1e-6
    np.testing.assert_allclose(estimate.rotations, rotations, atol=1e-4)
    truth = positions[:, CHESTS] - positions[:, ROOTS]
    np.testing.assert_allclose(estimate.backbones, truth, atol=1e-4)
    occluded = [PAIR.index(f"person1:{name}") for name in ("pelvis", "left_shoulder", "head")]
    visible = ~np.isin(np.arange(34), occluded)
    corrupted = np.where(visible[:, None], positions, np.nan)
    for other in (estimate, lifted(corrupted, visible=visible)):
        np.testing.assert_allclose(other.roots[..., :2], positions[:, ROOTS, :2], atol=1e-4)


def test_views_of_the_rotated_seed_are_exact():
    rotations = Rotation.random(100, rng=1).as_matrix()
    positions = np.einsum("nij,mj->nmi", rotations, SEED)
    estimate = lifted(positions)
    depth = positions[:, ROOTS[1], 2] - positions[:, ROOTS[0], 2]
    np.testing.assert_allclose(estimate.roots[:, 1, 2], depth, atol=1e-4)
    expected = view_angles(pair_frames(positions, PAIR), TOWARDS)
    views = annotation_views(annotated(positions), SEED)
    assert degrees(view_vectors(views), view_vectors(expected)).max() < 0.01


def test_depth_ignores_the_torso_of_a_person_who_rotated_alone():
    pairs = Rotation.from_rotvec(np.linspace(-1.2, -0.3, 40)[:, None] * [0, 1, 0]).as_matrix()
    second_rotation = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    positions = rotated(np.tile([np.eye(3), second_rotation], (40, 1, 1, 1)))
    positions = np.einsum("nij,nmj->nmi", pairs, positions)
    estimate = lifted(positions)
    truth = positions[:, 17, 2] - positions[:, 0, 2]
    mean = (estimate.rotations @ (SEED[17] - SEED[0]))[..., 2].mean(axis=-1)
    error = np.abs(estimate.roots[:, 1, 2] - truth)
    assert np.median(error) < 0.5 * np.median(np.abs(mean - truth))


def test_fit_is_the_global_minimum():
    """The reference is the best of several descents from random starts."""
    rng = np.random.default_rng(3)
    body = SEED[list(TORSOS[0])]
    axes = Rotation.random(4, rng=4).as_matrix()[:, :2]
    points = np.einsum("nij,mj->nmi", axes, body) + 0.03 * rng.standard_normal((4, 9, 2))
    fit = fit_body(points, np.ones((4, 9), dtype=bool), body)

    def rms(parameters, observed):
        rotation = Rotation.from_rotvec(parameters[:3]).as_matrix()
        residual = body @ rotation[:2].T + parameters[3:] - observed
        return float(np.sqrt((residual**2).sum() / 9))

    starts = np.concatenate([Rotation.random(8, rng=5).as_rotvec(), np.zeros((8, 2))], axis=1)
    for index, observed in enumerate(points):
        best = min(minimize(rms, start, args=(observed,)).fun for start in starts)
        assert fit.residuals[index] == pytest.approx(best, abs=1e-5)
        rotation = Rotation.from_matrix(fit.rotations[index]).as_rotvec()
        parameters = np.concatenate([rotation, fit.translations[index]])
        assert rms(parameters, observed) == pytest.approx(fit.residuals[index])


def test_estimates_do_not_depend_on_the_batch():
    noise = 0.02 * np.random.default_rng(0).standard_normal((1100, 34, 3))
    positions = rotated(random_rotations(1100, 0)) + noise
    single, batch = lifted(positions[1050:1051]), lifted(positions)
    np.testing.assert_allclose(single.rotations[0], batch.rotations[1050], atol=1e-9)


def test_annotations_without_a_torso_are_nan():
    positions = rotated(random_rotations(6, 7))
    visible = np.ones((6, 34), dtype=bool)
    visible[2, list(TORSOS[1])] = False
    visible[4, list(TORSOS[0][2:])] = False  # two joints are too few
    estimate = lifted(positions, visible=visible)
    assert estimate.lifted.tolist() == [True, True, False, True, False, True]
    assert np.isnan(estimate.backbones[[2, 4]]).all()
    assert np.isnan(estimate.roots[[2, 4]]).all()
    np.testing.assert_array_equal(estimate.rotations[[0, 5]], lifted(positions).rotations[[0, 5]])
    visible[2, 17] = True
    views = annotation_views(annotated(positions, visible), SEED)
    np.testing.assert_array_equal(np.isnan(views).any(axis=-1), ~estimate.lifted)


def test_degenerate_seed_is_rejected():
    seed = SEED.copy()
    seed[17:] -= seed[17] - seed[0]
    with pytest.raises(ValueError, match=r"seed must have distinct roots .* degenerate pair"):
        lifted(SEED[None], seed)


def errors(drawn, seed):
    """Return the errors of backbones (n, K) and views (n,), degrees."""
    annotations = drawn.annotations
    estimate = lift_torsos(annotations.keypoints, annotations.visible, seed, PAIR)
    axes = world_axes(drawn.world_views)
    truth = drawn.positions[:, CHESTS] - drawn.positions[:, ROOTS]
    backbones = degrees(estimate.backbones, np.einsum("nij,nkj->nki", axes, truth))
    views = annotation_views(annotations, seed)
    return backbones, degrees(view_vectors(views), view_vectors(drawn.views))


@pytest.fixture(scope="module")
def salsa(real_data):
    """Return clips, masks of dance frames, and a seed from other clips."""
    motions = load_pairs(real_data / "cmu_salsa_pairs")
    poses, _, _ = ground_truth([motion for n, motion in enumerate(motions) if n % 3], 200)
    frames = [dance_frames(motion) for motion in motions[::3]]
    return motions[::3], frames, poses[choose_seed(poses)]


@pytest.mark.parametrize(
    ("noise", "hidden", "bounds"),
    [(0.0, 0.0, (5, 9, 14, 50)), (0.02, 0.0, (8, 24, 16, 60)), (0.0, 0.3, (5, 13, 14, 55))],
)
def test_errors_of_real_pairs_are_small(salsa, noise, hidden, bounds):
    """The bounds are medians and 90 % quantiles of the errors of backbones and of views."""
    clips, frames, seed = salsa
    drawn = draw_annotations(clips, 500, 0, frames=frames, noise=noise, hidden=hidden)
    backbones, views = errors(drawn, seed)
    known = np.isfinite(views)
    assert known.mean() > 0.98
    quantiles = [np.quantile(e[known], level) for e in (backbones, views) for level in (0.5, 0.9)]
    assert (np.array(quantiles) < bounds).all(), quantiles
