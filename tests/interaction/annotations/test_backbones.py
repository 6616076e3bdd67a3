"""Lifted torsos: exact where the torso is the seed's, close enough on real pairs."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.data.pairs import choose_seed, dance_frames, ground_truth, load_pairs
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.backbones import (
    BackboneEstimate,
    annotation_views,
    lift_torsos,
    torso_joints,
)
from probmotion.interaction.annotations.local_frames import chests, local_frames, pair_frames
from probmotion.interaction.annotations.sources import (
    DrawnAnnotations,
    draw_annotations,
    world_axes,
)
from probmotion.interaction.annotations.torso_fits import fit_body
from probmotion.interaction.annotations.views import view_angles, view_vectors

PAIR = Skeleton.preset("pair17")
ROOTS = list(PAIR.roots)
TOWARDS = np.array([0.0, 0.0, 1.0])
# Metres from the pelvis: right of the picture is the person's left, who looks towards +z.
BODY = {
    "pelvis": (0, 0, 0), "spine": (0, 0.15, -0.02), "chest": (0, 0.3, -0.02),
    "neck": (0, 0.5, -0.03), "head": (0, 0.6, 0.03), "left_shoulder": (0.2, 0.45, -0.02),
    "left_elbow": (0.25, 0.2, 0), "left_wrist": (0.2, 0, 0.15), "left_hip": (0.1, -0.03, 0),
    "left_knee": (0.1, -0.45, 0.05), "left_ankle": (0.1, -0.87, 0),
}  # fmt: skip


def standing(apart: float = 0.6) -> np.ndarray:
    """Two people who face each other along z, ``(J, 3)``."""
    person = np.array(
        [
            BODY.get(name, np.array(BODY.get(name.replace("right", "left"))) * [-1, 1, 1])
            for name in Skeleton.preset("person17").joint_names
        ]
    )
    facing = person * [-1, 1, -1] + [0.05, 0, apart]
    return np.concatenate([person, facing]) + np.array([0, 0.9, 0])


def turned(pair: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Each person turned about their own pelvis by each of ``turns`` (n, K, 3, 3)."""
    persons = pair.reshape(2, 17, 3)
    roots = persons[:, :1]
    return (np.einsum("nkij,kmj->nkmi", turns, persons - roots) + roots).reshape(-1, 34, 3)


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(cross, (a * b).sum(axis=-1)))


def lifted(
    positions: np.ndarray, seed: np.ndarray, visible: np.ndarray | None = None
) -> BackboneEstimate:
    shown = np.ones(positions.shape[:2], dtype=bool) if visible is None else visible
    return lift_torsos(positions[..., :2], shown, seed, PAIR)


# Where the truth is attainable.


def test_torso_of_the_seed_is_found_exactly_from_any_side() -> None:
    seed = standing()
    turns = Rotation.random(400, rng=0).as_matrix().reshape(200, 2, 3, 3)
    positions = turned(seed, turns)
    estimate = lifted(positions, seed)
    assert estimate.lifted.all()
    assert estimate.residuals.max() < 1e-6
    np.testing.assert_allclose(estimate.rotations, turns, atol=1e-4)
    truth = positions[:, list(chests(PAIR))] - positions[:, ROOTS]
    np.testing.assert_allclose(estimate.backbones, truth, atol=1e-4)
    np.testing.assert_allclose(estimate.roots[..., :2], positions[:, ROOTS, :2])


def test_views_of_the_seed_itself_are_exact() -> None:
    """The pair turned as one: even the depth between the characters is the seed's."""
    seed = standing()
    turns = Rotation.random(100, rng=1).as_matrix()
    positions = np.einsum("nij,mj->nmi", turns, seed)
    estimate = lifted(positions, seed)
    depth = positions[:, ROOTS[1], 2] - positions[:, ROOTS[0], 2]
    np.testing.assert_allclose(estimate.roots[:, 1, 2], depth, atol=1e-4)
    wanted = view_angles(pair_frames(positions, PAIR), TOWARDS)
    found = view_angles(local_frames(estimate.roots, estimate.backbones), TOWARDS)
    assert degrees(view_vectors(found), view_vectors(wanted)).max() < 0.01


def test_a_torso_that_turned_away_says_little_of_the_depth() -> None:
    """Where one person turned alone, their torso carries the offset elsewhere in the picture."""
    seed = standing()
    whole = Rotation.from_rotvec(np.linspace(-1.2, -0.3, 40)[:, None] * [0, 1, 0]).as_matrix()
    alone = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    positions = turned(seed, np.stack([np.tile(np.eye(3), (40, 1, 1)), [alone] * 40], axis=1))
    positions = np.einsum("nij,nmj->nmi", whole, positions)
    estimate = lifted(positions, seed)
    truth = positions[:, 17, 2] - positions[:, 0, 2]
    mean = (estimate.rotations @ (seed[17] - seed[0]))[..., 2].mean(axis=-1)
    error = np.abs(estimate.roots[:, 1, 2] - truth)
    assert np.median(error) < 0.5 * np.median(np.abs(mean - truth))


def test_a_flat_torso_is_known_but_for_its_reflection_in_the_image() -> None:
    seed = standing() * [1, 1, 0]
    seed[17:, 2] = 0.6
    turns = Rotation.random(80, rng=2).as_matrix().reshape(40, 2, 3, 3)
    positions = turned(seed, turns)
    estimate = lifted(positions, seed)
    assert estimate.residuals.max() < 1e-6
    truth = positions[:, list(chests(PAIR))] - positions[:, ROOTS]
    np.testing.assert_allclose(estimate.backbones[..., :2], truth[..., :2], atol=1e-4)
    np.testing.assert_allclose(np.abs(estimate.backbones[..., 2]), np.abs(truth[..., 2]), atol=1e-4)


def test_fit_is_the_best_of_many_descents_from_random_starts() -> None:
    rng = np.random.default_rng(3)
    body = standing()[list(torso_joints(PAIR)[0])]
    turns = Rotation.random(6, rng=4).as_matrix()
    points = np.einsum("nij,mj->nmi", turns[:, :2], body) + 0.03 * rng.standard_normal((6, 9, 2))
    fit = fit_body(points, np.ones((6, 9), dtype=bool), body)

    def rms(numbers: np.ndarray, picture: np.ndarray) -> float:
        own = body @ Rotation.from_rotvec(numbers[:3]).as_matrix()[:2].T + numbers[3:]
        return float(np.sqrt(((own - picture) ** 2).sum() / 9))

    starts = np.concatenate([Rotation.random(12, rng=5).as_rotvec(), np.zeros((12, 2))], axis=1)
    for index, picture in enumerate(points):
        best = min(minimize(rms, start, args=(picture,)).fun for start in starts)
        assert fit.residuals[index] == pytest.approx(best, abs=1e-5)
        own = [*Rotation.from_matrix(fit.rotations[index]).as_rotvec(), *fit.translations[index]]
        assert rms(np.array(own), picture) == pytest.approx(fit.residuals[index])


def test_an_annotation_is_lifted_alike_in_any_company() -> None:
    turns = Rotation.random(2 * 1100, rng=0).as_matrix().reshape(-1, 2, 3, 3)
    seed = standing()
    positions = turned(seed, turns) + 0.02 * np.random.default_rng(0).standard_normal((1100, 34, 3))
    together = lifted(positions, seed)
    alone = lifted(positions[1050:1051], seed)
    np.testing.assert_allclose(alone.rotations[0], together.rotations[1050], atol=1e-9)


# Hidden joints, far apart, degenerate.


def test_hidden_joints_are_not_read_and_a_hidden_root_is_filled_from_the_torso() -> None:
    seed = standing()
    positions = turned(seed, Rotation.random(40, rng=6).as_matrix().reshape(20, 2, 3, 3))
    visible = np.ones((20, 34), dtype=bool)
    hidden = [PAIR.index(f"person1:{name}") for name in ("pelvis", "left_shoulder", "head")]
    visible[:, hidden] = False
    broken = positions.copy()
    broken[:, hidden] = np.nan
    estimate = lift_torsos(broken[..., :2], visible, seed, PAIR)
    assert estimate.lifted.all()
    np.testing.assert_allclose(estimate.roots[..., :2], positions[:, ROOTS, :2], atol=1e-4)


def test_annotations_without_a_torso_are_marked_and_the_others_are_not_touched() -> None:
    seed = standing()
    positions = turned(seed, Rotation.random(12, rng=7).as_matrix().reshape(6, 2, 3, 3))
    visible = np.ones((6, 34), dtype=bool)
    visible[2, list(torso_joints(PAIR)[1])] = False
    visible[4, list(torso_joints(PAIR)[0][2:])] = False  # two joints are too few
    estimate = lifted(positions, seed, visible)
    assert estimate.lifted.tolist() == [True, True, False, True, False, True]
    assert np.isnan(estimate.backbones[[2, 4]]).all()
    assert np.isnan(estimate.roots[[2, 4]]).all()
    whole = lifted(positions, seed)
    np.testing.assert_array_equal(estimate.rotations[[0, 5]], whole.rotations[[0, 5]])


def seen(positions: np.ndarray, visible: np.ndarray | None = None) -> Annotations:
    shown = np.ones(positions.shape[:2], dtype=bool) if visible is None else visible
    still = np.full((len(positions), 2, 34, 2), np.nan)
    return Annotations(positions[..., :2], shown, PAIR, still, 30.0)


def test_views_are_nan_where_nothing_can_be_lifted() -> None:
    visible = np.ones((3, 34), dtype=bool)
    visible[1, :16] = False
    seed = standing()
    views = annotation_views(seen(np.tile(seed, (3, 1, 1)), visible), seed)
    assert np.isnan(views).any(axis=-1).tolist() == [False, True, False]


def test_one_annotation_and_characters_far_apart() -> None:
    seed, far = standing(), standing()
    far[17:] += [40.0, 0.0, 0.0]
    views = annotation_views(seen(far[None]), seed)
    wanted = view_angles(pair_frames(far, PAIR), TOWARDS)
    assert degrees(view_vectors(views[0]), view_vectors(wanted)) < 1


def test_wrong_seeds_are_refused_in_one_sentence() -> None:
    seed = standing()
    seed[17:] -= seed[17] - seed[0]
    with pytest.raises(ValueError, match="seed must be roots apart and backbones, got degenerate"):
        lifted(standing()[None], seed)
    with pytest.raises(ValueError, match=r"seed must have shape \(34, 3\), got \(17, 3\)"):
        lifted(standing()[None], standing()[:17])
    with pytest.raises(
        ValueError, match="seed must be finite, got 102 values that are NaN or infinite"
    ):
        lifted(standing()[None], np.full((34, 3), np.nan))


# How far off estimates are where the torso is not the seed's and the depth is unknown.


@cache
def made_pairs() -> DrawnAnnotations:
    """Pairs who bend, turn and step about each other at random."""
    rng = np.random.default_rng(0)
    bends = Rotation.from_rotvec(0.3 * rng.standard_normal((600, 3))).as_matrix()
    positions = turned(standing(), bends.reshape(300, 2, 3, 3))
    positions[:, 17:] += 0.15 * rng.standard_normal((300, 1, 3))
    positions += 0.01 * rng.standard_normal(positions.shape)
    return draw_annotations([Motion(positions, PAIR, 30.0)], 300, 1)


def errors(drawn: DrawnAnnotations, seed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Degrees by which backbones (n, K) and views (n,) are off."""
    pictures = drawn.annotations
    estimate = lift_torsos(pictures.keypoints, pictures.visible, seed, PAIR)
    axes = world_axes(drawn.world_views)
    truth = drawn.positions[:, list(chests(PAIR))] - drawn.positions[:, ROOTS]
    backbones = degrees(estimate.backbones, np.einsum("nij,nkj->nki", axes, truth))
    views = annotation_views(pictures, seed)
    return backbones, degrees(view_vectors(views), view_vectors(drawn.views))


def test_made_pairs_are_off_by_little() -> None:
    backbones, views = errors(made_pairs(), standing())
    assert np.median(backbones) < 6
    assert np.median(views) < 15


def test_depth_from_the_torsos_beats_no_depth() -> None:
    drawn, seed = made_pairs(), standing()
    pictures = drawn.annotations
    estimate = lift_torsos(pictures.keypoints, pictures.visible, seed, PAIR)
    flat = estimate.roots * [1, 1, 0]
    views = view_angles(local_frames(flat, estimate.backbones), TOWARDS)
    without = degrees(view_vectors(views), view_vectors(drawn.views))
    _, with_depth = errors(drawn, seed)
    assert np.median(with_depth) < 0.7 * np.median(without)


@pytest.mark.parametrize(
    ("noise", "hidden", "most"),
    [(0.0, 0.0, (5, 9, 14, 50)), (0.02, 0.0, (8, 24, 16, 60)), (0.0, 0.3, (5, 13, 14, 55))],
)
def test_real_pairs_are_off_by_little(
    real_data: Path, noise: float, hidden: float, most: tuple[float, ...]
) -> None:
    """Median and 90 % of the backbones' and the views' errors; the seed is of other clips."""
    motions = load_pairs(real_data / "cmu_salsa_pairs")
    clips, seeding = motions[::3], [motion for n, motion in enumerate(motions) if n % 3]
    poses, _, _ = ground_truth(seeding, 200)
    frames = [dance_frames(motion) for motion in clips]
    drawn = draw_annotations(clips, 500, 0, frames=frames, noise=noise, hidden=hidden)
    backbones, views = errors(drawn, poses[choose_seed(poses)])
    known = np.isfinite(views)
    assert known.mean() > 0.98
    found = [np.quantile(e[known], share) for e in (backbones, views) for share in (0.5, 0.9)]
    assert (np.array(found) < most).all(), found
