"""Forward kinematics and fitting of rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Skeleton
from probmotion.motion.kinematics import fit_rotations, forward_kinematics

# Two trees with some parents after their children.
TANGLED = Skeleton(["c", "b", "a", "e", "d", "f"], [1, 2, -1, 4, -1, 2])
SKELETONS = pytest.mark.parametrize(
    "skeleton", [TANGLED, Skeleton.preset("pair17")], ids=["tangled", "pair"]
)
CHAIN = Skeleton(["a", "b", "c"], [-1, 0, 1])


def random_pose(skeleton, batch, seed):
    rng = np.random.default_rng(seed)
    shape = (*batch, skeleton.n_joints)
    rotations = Rotation.random(int(np.prod(shape)), rng=rng).as_matrix().reshape(*shape, 3, 3)
    offsets = rng.standard_normal((skeleton.n_joints, 3))
    return rotations, rng.standard_normal((*batch, len(skeleton.roots), 3)), offsets


def by_matrix_products(skeleton, rotations, translations, offsets):
    """Positions of one frame by products of 4 × 4 transforms from the root."""
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


@SKELETONS
def test_positions_agree_with_matrix_products(library, skeleton):
    pose = random_pose(skeleton, (2, 3), seed=1)
    run = library.compiled(lambda *parts: forward_kinematics(skeleton, *parts))
    positions, turns = run(*(library.array(part) for part in pose))
    expected = [
        [by_matrix_products(skeleton, pose[0][b, f], pose[1][b, f], pose[2]) for f in range(3)]
        for b in range(2)
    ]
    library.assert_close(positions, np.array(expected))
    local, turns = pose[0], np.asarray(turns)
    root, (joint, parent) = skeleton.roots[0], skeleton.bones[0]
    tolerance = library.tolerance
    np.testing.assert_allclose(turns[:, :, root], local[:, :, root], atol=tolerance)
    product = turns[:, :, parent] @ local[:, :, joint]
    np.testing.assert_allclose(turns[:, :, joint], product, atol=tolerance)


def test_empty_batches_stay_empty():
    positions, turns = forward_kinematics(TANGLED, *random_pose(TANGLED, (0, 4), seed=1))
    assert (positions.shape, turns.shape) == ((0, 4, 6, 3), (0, 4, 6, 3, 3))


ROTATIONS, TRANSLATIONS, OFFSETS = random_pose(TANGLED, (2,), seed=1)


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (forward_kinematics, (ROTATIONS[:, :5], TRANSLATIONS, OFFSETS), r"\(…, L, 6, 3, 3\), got"),
        (forward_kinematics, (ROTATIONS, TRANSLATIONS[:, :1], OFFSETS), r"\(…, L, 2, 3\), got"),
        (forward_kinematics, (ROTATIONS, TRANSLATIONS, OFFSETS[:5]), r"shape \(…, 6, 3\), got"),
        (fit_rotations, (np.zeros((2, 5, 3)),), r"positions must have shape \(L, 6, 3\), got"),
        (fit_rotations, (np.zeros((0, 6, 3)),), "positions must contain at least one frame"),
        (fit_rotations, (np.full((1, 6, 3), np.nan),), "positions must be finite, got 18 values"),
    ],
)
def test_invalid_input_is_refused(function, arguments, message):
    with pytest.raises(ValueError, match=message):
        function(TANGLED, *arguments)


def assert_rotations(rotations):
    identity = rotations @ np.swapaxes(rotations, -1, -2)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-12)
    assert (np.linalg.det(rotations) > 0).all()


def errors_of(skeleton, positions):
    """Distances between positions and the reconstruction from fitted rotations, (L, J)."""
    rotations, offsets = fit_rotations(skeleton, positions)
    assert_rotations(rotations)
    back, _ = forward_kinematics(skeleton, rotations, positions[:, list(skeleton.roots)], offsets)
    return np.linalg.norm(back - positions, axis=-1)


@SKELETONS
def test_rigid_motion_is_reconstructed_exactly(skeleton):
    positions, _ = forward_kinematics(skeleton, *random_pose(skeleton, (7,), seed=2))
    assert errors_of(skeleton, positions).max() < 1e-9
    # The rest pose is the first frame.
    rotations, _ = fit_rotations(skeleton, positions)
    np.testing.assert_allclose(rotations[0], [np.eye(3)] * skeleton.n_joints, atol=1e-9)


def test_chains_are_fitted_without_twist():
    rng = np.random.default_rng(5)
    positions = np.cumsum(rng.standard_normal((9, 3, 3)), axis=1)
    positions[1, 1] = positions[0, 1]
    positions[1] = 2 * positions[1, :1] - positions[1]  # every bone reversed
    positions[2] = positions[0] + [[0, 0, 0], [1e-9, 0, 0], [0, 1e-9, 0]]
    rotations, offsets = fit_rotations(CHAIN, positions)
    assert_rotations(rotations)
    # The axis of a minimal rotation is orthogonal to the bone.
    for joint in (0, 1):
        axis = Rotation.from_matrix(rotations[:, joint]).as_rotvec()
        np.testing.assert_allclose(axis @ offsets[joint + 1], 0, atol=1e-9)


def test_half_turns_are_fitted():
    bone = Skeleton(["a", "b"], [-1, 0])
    start, aside = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0][:2]
    for gap in (0.0, 1e-13, 1e-7):
        end = (gap * aside - start) / np.linalg.norm(gap * aside - start)
        positions = np.array([[np.zeros(3), start], [np.zeros(3), end]])
        assert errors_of(bone, positions).max() < 1e-12


def test_zero_length_bones_follow_their_parents():
    positions = np.zeros((4, 3, 3))
    positions[:, 2] = Rotation.random(4, rng=6).as_matrix()[:, 0]
    assert errors_of(CHAIN, positions).max() < 1e-12
    rotations, _ = fit_rotations(CHAIN, positions)
    np.testing.assert_array_equal(rotations[:, 0], [np.eye(3)] * 4)
    assert errors_of(CHAIN, np.zeros((2, 3, 3))).max() == 0


def test_bones_have_their_mean_length_and_errors_do_not_accumulate():
    positions = np.array([[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1.2, 0, 0], [1.2, 1, 0]]])
    errors = errors_of(CHAIN, positions)
    np.testing.assert_allclose(errors[:, 1], 0.1, atol=1e-12)
    np.testing.assert_allclose(errors[:, 2], np.sqrt(1 + 0.1**2) - 1, atol=1e-12)


def test_collinear_children_are_fitted_without_twist():
    skeleton = Skeleton(["a", "b", "c"], [-1, 0, 0])
    ends = Rotation.random(20, rng=4).as_matrix()[:, 0]
    positions = np.stack([np.zeros((20, 3)), ends, -0.5 * ends], axis=1)
    rotations, offsets = fit_rotations(skeleton, positions)
    assert errors_of(skeleton, positions).max() < 1e-9
    axis = Rotation.from_matrix(rotations[:, 0]).as_rotvec()
    np.testing.assert_allclose(axis @ offsets[1], 0, atol=1e-2)


def test_rest_pose_is_fitted_to_all_frames():
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


def test_rotation_of_moving_siblings_is_least_squares():
    """Kabsch: no rotation of the rest pose is closer, by random search around the fit."""
    skeleton = Skeleton(["a", "b", "c", "d"], [-1, 0, 0, 0])
    rng = np.random.default_rng(7)
    positions = np.concatenate([np.zeros((5, 1, 3)), rng.standard_normal((5, 3, 3))], axis=1)
    rotations, offsets = fit_rotations(skeleton, positions)

    def loss(turns):
        residual = np.einsum("...lij,cj->...lci", turns, offsets[1:]) - positions[:, 1:]
        return (residual**2).sum(axis=(-1, -2))

    best = loss(rotations[:, 0])
    for size in (1e-3, 1e-1, 1.0):
        nearby = Rotation.from_rotvec(size * rng.standard_normal((200 * 5, 3))).as_matrix()
        assert (loss(nearby.reshape(200, 5, 3, 3) @ rotations[:, 0]) > best - 1e-12).all()
