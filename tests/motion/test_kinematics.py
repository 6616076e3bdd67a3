"""Forward kinematics and its inverse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.motion.kinematics import fit_rotations, forward_kinematics

# Two trees whose parents come after some of their children.
TANGLED = Skeleton(["c", "b", "a", "e", "d", "f"], [1, 2, -1, 4, -1, 2])


def random_pose(
    skeleton: Skeleton, batch: tuple[int, ...], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (*batch, skeleton.n_joints)
    rotations = Rotation.random(int(np.prod(shape)), rng=rng).as_matrix().reshape(*shape, 3, 3)
    offsets = rng.standard_normal((skeleton.n_joints, 3))
    return rotations, rng.standard_normal((*batch, len(skeleton.roots), 3)), offsets


def by_hand(
    skeleton: Skeleton, rotations: np.ndarray, translations: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Each joint's 4 × 4 transforms multiplied from its root down, one frame."""
    positions = np.zeros((skeleton.n_joints, 3))
    for joint in range(skeleton.n_joints):
        total = np.eye(4)
        for link in [joint, *skeleton.ancestors(joint)]:
            step = np.eye(4)
            step[:3, :3] = rotations[link]
            is_root = skeleton.parents[link] < 0
            step[:3, 3] = translations[skeleton.roots.index(link)] if is_root else offsets[link]
            total = step @ total
        positions[joint] = total[:3, 3]
    return positions


@pytest.mark.parametrize("skeleton", [TANGLED, Skeleton.preset("pair17")], ids=["tangled", "pair"])
def test_positions_are_the_products_of_the_transforms(library: Any, skeleton: Skeleton) -> None:
    pose = random_pose(skeleton, (2, 3), seed=1)
    arrays = [library.array(part) for part in pose]
    run = library.compiled(lambda *parts: forward_kinematics(skeleton, *parts))
    positions, turns = run(*arrays)
    wanted = [
        [by_hand(skeleton, pose[0][b, f], pose[1][b, f], pose[2]) for f in range(3)]
        for b in range(2)
    ]
    library.assert_close(positions, np.array(wanted))
    np.testing.assert_allclose(
        np.asarray(turns)[:, :, skeleton.roots[0]],
        pose[0][:, :, skeleton.roots[0]],
        atol=library.tolerance,
    )
    joint, parent = skeleton.bones[0]
    np.testing.assert_allclose(
        np.asarray(turns)[:, :, joint],
        np.asarray(turns)[:, :, parent] @ pose[0][:, :, joint],
        atol=library.tolerance,
    )


def test_empty_batches_and_no_frames(library: Any) -> None:
    rotations, translations, offsets = random_pose(TANGLED, (0, 4), seed=1)
    positions, turns = forward_kinematics(
        TANGLED, library.array(rotations), library.array(translations), library.array(offsets)
    )
    assert positions.shape == (0, 4, 6, 3)
    assert turns.shape == (0, 4, 6, 3, 3)


def test_the_gradient_reaches_every_offset(differentiable: Any) -> None:
    rotations, translations, offsets = random_pose(TANGLED, (2,), seed=4)

    def height(values: Any) -> Any:
        moving = (differentiable.array(rotations), differentiable.array(translations))
        return forward_kinematics(TANGLED, *moving, values)[0][..., 1].sum()

    gradient = differentiable.gradient(height, offsets)
    step = 1e-6
    for joint, axis in np.ndindex(offsets.shape):
        moved = offsets.copy()
        moved[joint, axis] += step
        change = sum(
            by_hand(TANGLED, r, t, moved)[:, 1].sum() - by_hand(TANGLED, r, t, offsets)[:, 1].sum()
            for r, t in zip(rotations, translations, strict=True)
        )
        assert gradient[joint, axis] == pytest.approx(change / step, abs=1e-7)


def test_wrong_shapes_are_refused() -> None:
    rotations, translations, offsets = random_pose(TANGLED, (2,), seed=1)
    with pytest.raises(ValueError, match=r"rotations has shape .*expected \(…, L, 6, 3, 3\)"):
        forward_kinematics(TANGLED, rotations[:, :5], translations, offsets)
    with pytest.raises(ValueError, match=r"root_translations has shape .*expected \(…, L, 2, 3\)"):
        forward_kinematics(TANGLED, rotations, translations[:, :1], offsets)
    with pytest.raises(ValueError, match=r"rest_offsets has shape .*expected \(…, 6, 3\)"):
        forward_kinematics(TANGLED, rotations, translations, offsets[:5])
    with pytest.raises(ValueError, match=r"positions has shape .*expected \(L, 6, 3\)"):
        fit_rotations(TANGLED, np.zeros((2, 5, 3)))
    with pytest.raises(ValueError, match="positions has no frame, expected at least one"):
        fit_rotations(TANGLED, np.zeros((0, 6, 3)))
    with pytest.raises(
        ValueError, match="positions must be finite, got 1 values that are NaN or infinite"
    ):
        fit_rotations(TANGLED, np.pad([[[np.nan]]], ((0, 0), (0, 5), (0, 2))))


def assert_rotations(rotations: np.ndarray) -> None:
    identity = rotations @ np.swapaxes(rotations, -1, -2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-12)
    assert (np.linalg.det(rotations) > 0).all()


def errors_of(skeleton: Skeleton, positions: np.ndarray) -> np.ndarray:
    """Distances between positions and what the fitted rotations give, (L, J)."""
    rotations, offsets = fit_rotations(skeleton, positions)
    assert_rotations(rotations)
    back, _ = forward_kinematics(skeleton, rotations, positions[:, list(skeleton.roots)], offsets)
    return np.linalg.norm(back - positions, axis=-1)


@pytest.mark.parametrize("skeleton", [TANGLED, Skeleton.preset("pair17")], ids=["tangled", "pair"])
def test_rigid_motion_comes_back_exactly(skeleton: Skeleton) -> None:
    rotations, translations, offsets = random_pose(skeleton, (7,), seed=2)
    positions, _ = forward_kinematics(skeleton, rotations, translations, offsets)
    assert errors_of(skeleton, positions).max() < 1e-9
    fitted, rest = fit_rotations(skeleton, positions)
    np.testing.assert_allclose(
        np.linalg.norm(rest, axis=-1)[[j for j, _ in skeleton.bones]],
        np.linalg.norm(offsets, axis=-1)[[j for j, _ in skeleton.bones]],
        atol=1e-12,
    )
    # The rest pose is the first frame: nothing is turned there.
    np.testing.assert_allclose(fitted[0], np.tile(np.eye(3), (skeleton.n_joints, 1, 1)), atol=1e-9)


def test_a_joint_with_several_children_is_turned_as_it_was() -> None:
    """Three children that are not in a plane leave nothing open: the turns are known."""
    hub = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
    rotations, translations, offsets = random_pose(hub, (5,), seed=3)
    rotations[0, 0] = np.eye(3)
    positions, _ = forward_kinematics(hub, rotations, translations, offsets)
    fitted, rest = fit_rotations(hub, positions)
    np.testing.assert_allclose(rest[1:], offsets[1:], atol=1e-12)
    np.testing.assert_allclose(fitted[:, 0], rotations[:, 0], atol=1e-9)


def test_a_chain_is_not_twisted() -> None:
    chain = Skeleton(["a", "b", "c"], [-1, 0, 1])
    rng = np.random.default_rng(5)
    positions = np.cumsum(rng.standard_normal((9, 3, 3)), axis=1)
    positions[1, 1] = positions[0, 1]
    positions[1] = 2 * positions[1, :1] - positions[1]  # every bone the other way round
    positions[2] = positions[0] + [[0, 0, 0], [1e-9, 0, 0], [0, 1e-9, 0]]
    rotations, offsets = fit_rotations(chain, positions)
    assert_rotations(rotations)
    # The axis of the least turn is square to the bone that it turns.
    axis = Rotation.from_matrix(rotations[:, 0]).as_rotvec()
    np.testing.assert_allclose(axis @ offsets[1], 0, atol=1e-9)
    axis = Rotation.from_matrix(rotations[:, 1]).as_rotvec()
    np.testing.assert_allclose(axis @ offsets[2], 0, atol=1e-9)


def test_half_a_turn_is_found() -> None:
    bone = Skeleton(["a", "b"], [-1, 0])
    start, aside = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0][:2]
    for gap in (0.0, 1e-13, 1e-9, 1e-7, 1e-4):
        end = -start + gap * aside
        end /= np.linalg.norm(end)
        positions = np.array([[np.zeros(3), start], [np.zeros(3), end]])
        assert errors_of(bone, positions).max() < 1e-12


def test_bones_of_no_length_turn_with_their_parents() -> None:
    skeleton = Skeleton(["a", "b", "c"], [-1, 0, 1])
    positions = np.zeros((4, 3, 3))
    positions[:, 2] = np.random.default_rng(6).standard_normal((4, 3))
    positions[:, 2] /= np.linalg.norm(positions[:, 2], axis=-1, keepdims=True)
    assert errors_of(skeleton, positions).max() < 1e-12
    rotations, _ = fit_rotations(skeleton, positions)
    np.testing.assert_array_equal(rotations[:, 0], np.tile(np.eye(3), (4, 1, 1)))
    assert errors_of(skeleton, np.zeros((2, 3, 3))).max() == 0


def test_a_bone_that_changes_its_length_keeps_its_direction_and_mean() -> None:
    bone = Skeleton(["a", "b"], [-1, 0])
    lengths = np.array([0.9, 1.0, 1.2])
    directions = Rotation.random(3, rng=1).as_matrix()[:, 0]
    positions = np.stack([np.zeros((3, 3)), lengths[:, None] * directions], axis=1)
    np.testing.assert_allclose(
        errors_of(bone, positions)[:, 1], np.abs(lengths - lengths.mean()), atol=1e-12
    )


def test_an_error_is_not_passed_on() -> None:
    """A bone that is 0.1 too long ends off; the next one, at a right angle, still meets its end."""
    chain = Skeleton(["a", "b", "c"], [-1, 0, 1])
    positions = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1.2, 0, 0], [1.2, 1, 0]]])
    errors = errors_of(chain, positions)
    np.testing.assert_allclose(errors[:, 1], 0.1, atol=1e-12)
    np.testing.assert_allclose(errors[:, 2], np.sqrt(1 + 0.1**2) - 1, atol=1e-12)


def test_children_in_line_are_not_twisted() -> None:
    """Two children on one line leave the turn about it open: the least one is taken."""
    skeleton = Skeleton(["a", "b", "c"], [-1, 0, 0])
    ends = Rotation.random(20, rng=4).as_matrix()[:, 0]
    positions = np.stack([np.zeros((20, 3)), ends, -0.5 * ends], axis=1)
    rotations, offsets = fit_rotations(skeleton, positions)
    assert errors_of(skeleton, positions).max() < 1e-9
    axis = Rotation.from_matrix(rotations[:, 0]).as_rotvec()
    np.testing.assert_allclose(axis @ offsets[1], 0, atol=1e-2)


def test_the_rest_pose_serves_all_frames_not_the_first_alone() -> None:
    hub = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
    rng = np.random.default_rng(7)
    bones = rng.standard_normal((1, 3, 3)) + 0.2 * rng.standard_normal((30, 3, 3))
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    bones[0] += [[0, 0, 0.4], [0, 0, -0.4], [0, 0, 0]]  # an odd first frame
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    positions = np.concatenate([np.zeros((30, 1, 3)), bones], axis=1)
    fitted = (errors_of(hub, positions) ** 2).sum()
    first = sum(Rotation.align_vectors(now, bones[0])[1] ** 2 for now in bones)
    assert fitted < 0.8 * first


def test_siblings_that_move_against_each_other_lose_no_more_than_they_must() -> None:
    """Kabsch: no rotation of the same rest pose is nearer, by random search around the fit."""
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
    rng = np.random.default_rng(7)
    positions = np.concatenate([np.zeros((5, 1, 3)), rng.standard_normal((5, 3, 3))], axis=1)
    rotations, offsets = fit_rotations(skeleton, positions)

    def loss(turns: np.ndarray) -> np.ndarray:
        residual = np.einsum("...lij,cj->...lci", turns, offsets[1:]) - positions[:, 1:]
        return (residual**2).sum(axis=(-1, -2))

    best = loss(rotations[:, 0])
    for size in (1e-3, 1e-1, 1.0):
        nearby = Rotation.from_rotvec(size * rng.standard_normal((200 * 5, 3))).as_matrix()
        assert (loss(nearby.reshape(200, 5, 3, 3) @ rotations[:, 0]) > best - 1e-12).all()


def test_real_clips_come_back(real_data: Path) -> None:
    """Where siblings are rigid, to the file's single precision; CMU's ASF bones slip by cm."""
    for file, worst in (
        ("cmu_single/cmu_131_01", 1e-6),
        ("deepmimic_human/humanoid3d_backflip", 1e-6),
        ("deepmimic_dog/dog3d_canter", 1e-6),
        ("cmu_single/cmu_01_01", 0.06),
    ):
        archive = np.load(real_data / f"{file}.npz")
        skeleton = Skeleton(archive["joint_names"].tolist(), archive["parents"].tolist())
        assert errors_of(skeleton, archive["positions"]).max() < worst, file
