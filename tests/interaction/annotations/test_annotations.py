"""2D annotations: validation, storage, differences in time and simulation from 3D motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.local_frames import chest_joints, pair_frames
from probmotion.interaction.annotations.sources import ELEVATIONS, draw_annotations, world_axes
from probmotion.interaction.annotations.views import view_angles

PAIR = Skeleton.preset("pair17")
DANCES = synthetic_dances(3, frames=40)
ARRAYS = ("keypoints", "visible", "neighbours", "views")


def smooth_motion(frames=12, seed=0):
    start, velocity = np.random.default_rng(seed).standard_normal((2, 1, 34, 3))
    time = np.arange(frames)[:, None, None]
    positions = start + 0.02 * velocity * time + 0.1 * np.sin(time / 3 + velocity)
    return Motion(positions, PAIR, 30.0, name=f"walk {seed}")


def one_annotation(before, current, after, visible=True):
    neighbours = np.stack([before, after])[None]
    return Annotations(current[None], np.full((1, 34), visible), PAIR, neighbours, 30.0)


def random_annotations(**changes):
    rng = np.random.default_rng(0)
    keypoints, neighbours = rng.standard_normal((5, 34, 2)), rng.standard_normal((5, 2, 34, 2))
    visible = np.ones((5, 34), dtype=bool)
    return Annotations(keypoints, visible, PAIR, neighbours, 30.0, **changes)


def changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda a: replace(a, keypoints=a.keypoints[:0]), "keypoints must contain at least one"),
        (lambda a: replace(a, visible=a.visible * 1.0), "visible must be bool, got float64"),
        (
            lambda a: replace(a, keypoints=changed(a.keypoints, (1, 4), np.nan)),
            "keypoints must be finite where visible, got .* in annotation 1, joint person0:head",
        ),
        (
            lambda a: replace(a, visible=changed(a.visible, np.s_[3, 17:], False)),
            "at least one joint per person, got none .* person1:pelvis in annotation 3",
        ),
        (lambda a: replace(a, neighbours=a.neighbours + np.inf), "neighbours must be finite"),
        (lambda a: replace(a, views=np.zeros((4, 2))), r"views must have shape \(5, 2\)"),
        (lambda a: replace(a, views=np.full((5, 2), np.inf)), "views must be finite, or NaN"),
        (lambda a: replace(a, sources=["a"]), "sources must have 5 names, got 1"),
        (lambda a: a.subset([0, 5]), "indices must be from 0 to 4, got 0 to 5"),
        (lambda a: a.subset([0.7, 1.2]), "indices must be integers or a mask, got float64"),
        (lambda a: a.subset(np.ones(3, bool)), r"indices must have shape \(5\), got \(3,\)"),
        (lambda a: Annotations.joined([]), "several must contain at least one set"),
        (lambda a: Annotations.joined([a, replace(a, fps=25.0)]), r"several\[1\] .* 25 frames per"),
    ],
)
def test_invalid_annotations_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make(random_annotations())


def test_rows_are_selected_and_videos_joined():
    given = random_annotations(views=np.ones((5, 2)), sources=list("abcde"))
    indices, mask = given.subset([3, 0]), given.subset(np.array([False, True, False, False, True]))
    joined = Annotations.joined([indices, mask])
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(joined, name), getattr(given, name)[[3, 0, 1, 4]])
    assert joined.sources == ("d", "a", "b", "e")
    assert Annotations.joined([given, random_annotations(dropped={"cut": 2})]).views is None


def test_saved_annotations_are_loaded_unchanged(tmp_path):
    drawn = draw_annotations(DANCES, 20, 0, known_views=True, hidden=0.2).annotations
    for given in (replace(drawn, dropped={"one person missing": 3}), random_annotations()):
        given.save(tmp_path / "seen.npz")
        read = Annotations.load(tmp_path / "seen.npz")
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
        for name in ("skeleton", "fps", "sources", "dropped"):
            assert getattr(read, name) == getattr(given, name)


def test_damaged_files_are_rejected(tmp_path):
    path = tmp_path / "seen.npz"
    random_annotations().save(path)
    intact = path.read_bytes()
    np.savez(tmp_path / "other.npz", positions=np.zeros(3))
    other = (tmp_path / "other.npz").read_bytes()
    for content in (b"", b"none", intact[: len(intact) // 2], other):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"seen\.npz must be an archive written by"):
            Annotations.load(path)
    with pytest.raises(FileNotFoundError):
        Annotations.load(tmp_path / "none.npz")


def test_differences_are_those_of_angle_length_and_root():
    """The bones rotate and stretch at constant rates."""
    turn, stretch, time = 0.002 * np.arange(34), 0.01, np.arange(-1, 2)
    keypoints = np.zeros((3, 34, 2))
    for joint, parent in sorted(PAIR.bones):
        angle, length = joint + turn[joint] * time, 0.3 + stretch * time
        bone = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        keypoints[:, joint] = keypoints[:, parent] + bone
    keypoints += np.array([0.03, -0.04]) * time[:, None, None]
    turns, stretches = one_annotation(*keypoints).local_differences()
    bones = [joint for joint, _ in PAIR.bones]
    np.testing.assert_allclose(turns[0, bones], np.sin(turn[bones]))  # half a chord of two steps
    np.testing.assert_allclose(stretches[0, bones], stretch)
    roots = list(PAIR.roots)
    np.testing.assert_allclose(stretches[0, roots], 0.05)
    for root, chest in zip(roots, chest_joints(PAIR), strict=True):
        backbone = keypoints[:, chest] - keypoints[:, root]
        unit = backbone / np.linalg.norm(backbone, axis=-1, keepdims=True)
        assert turns[0, root] == pytest.approx(np.linalg.norm(unit[2] - unit[0]) / 2)


def test_differences_are_one_sided_at_cuts_and_zero_without_neighbours():
    before, current, after = keypoints = smooth_motion().positions[4:7, :, :2]
    missing = np.full((34, 2), np.nan)
    lengths = np.linalg.norm(keypoints[:, 13] - keypoints[:, 12], axis=-1)
    for neighbours, expected in (
        ((before, after), abs(lengths[2] - lengths[0]) / 2),
        ((missing, after), abs(lengths[2] - lengths[1])),
        ((before, missing), abs(lengths[1] - lengths[0])),
    ):
        _, stretch = one_annotation(neighbours[0], current, neighbours[1]).local_differences()
        assert stretch[0, 13] == pytest.approx(expected, abs=1e-12)
    assert (np.stack(one_annotation(missing, current, missing).local_differences()) == 0).all()


def test_differences_are_zero_for_occluded_joints_and_bones_of_length_zero():
    before, current, after = smooth_motion().positions[4:7, :, :2]
    for neighbour in (before, after):
        neighbour[1] = np.nan
        neighbour[4] = neighbour[3]  # a bone along the line of sight
    annotation = one_annotation(before, current, after, np.arange(34) != 1)
    turns, stretches = annotation.local_differences()
    assert (turns[0, [1, 2, 4]] == 0).all()  # the parent of 2 is occluded
    assert (stretches[0, [1, 4]] == 0).all()
    assert turns[0, 3] > 0


def test_annotations_are_projections_of_frames_and_neighbours():
    motions = [smooth_motion(seed=0), smooth_motion(20, seed=1)]
    drawn = draw_annotations(motions, 32, 0)
    assert len({*zip(drawn.clips, drawn.frames, strict=True)}) == 32  # every frame once
    axes, annotations = world_axes(drawn.world_views), drawn.annotations
    assert annotations.visible.all()
    for row, (clip, frame) in enumerate(zip(drawn.clips, drawn.frames, strict=True)):
        assert annotations.sources[row] == motions[clip].name
        projections = motions[clip].positions @ axes[row, :2].T
        before, current, after = (
            projections[t] if 0 <= t < len(projections) else np.full((34, 2), np.nan)
            for t in (frame - 1, frame, frame + 1)
        )
        np.testing.assert_allclose(annotations.keypoints[row], current)
        np.testing.assert_allclose(annotations.neighbours[row], [before, after])
    expected = view_angles(pair_frames(drawn.positions, PAIR), axes[:, 2])
    np.testing.assert_allclose(drawn.views, expected)


def test_camera_axes_are_upright_and_orthonormal():
    axes = world_axes(np.array([[0.0, 0.0], [np.pi / 2, 0.0], [0.0, np.pi / 2]]))
    np.testing.assert_allclose(axes[0], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(axes[1], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(axes[2], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)
    drawn = draw_annotations(DANCES, 100, 0)
    axes = world_axes(drawn.world_views)
    products = axes @ np.swapaxes(axes, 1, 2)
    np.testing.assert_allclose(products, np.tile(np.eye(3), (100, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    assert (axes[:, 1, 1] > 0).all()
    azimuth, elevation = drawn.world_views.T
    assert ELEVATIONS[0] <= elevation.min() < -0.1 < 0.6 < elevation.max() <= ELEVATIONS[1]
    assert azimuth.min() < -2.8
    assert azimuth.max() > 2.8


def test_given_views_and_frames_are_used():
    views = np.tile([[0.4, 0.1]], (10, 1))
    masks = [np.arange(motion.frames) % 7 == 3 for motion in DANCES]
    drawn = draw_annotations(DANCES, 10, 0, frames=masks, world_views=views, known_views=True)
    np.testing.assert_array_equal(drawn.annotations.views, drawn.views)
    np.testing.assert_array_equal(drawn.world_views, views)
    assert (drawn.frames % 7 == 3).all()
    assert np.isfinite(drawn.annotations.neighbours).all()


def test_draws_depend_on_the_seed_only():
    exact, again, other = (draw_annotations(DANCES, 60, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(exact.annotations.keypoints, again.annotations.keypoints)
    assert not np.array_equal(exact.frames, other.frames)
    noisy = draw_annotations(DANCES, 60, 3, noise=0.05, hidden=0.25)
    np.testing.assert_array_equal(noisy.world_views, exact.world_views)
    np.testing.assert_array_equal(noisy.frames, exact.frames)
    visible = noisy.annotations.visible
    for person in np.split(visible, 2, axis=1):
        assert ((~person).sum(axis=1) == 4).all()  # a quarter of 17
    assert len(np.unique(visible, axis=0)) > 50
    errors = (noisy.annotations.keypoints - exact.annotations.keypoints)[visible]
    assert errors.std() == pytest.approx(0.05, rel=0.05)
    occluded = np.broadcast_to(~visible[:, None], noisy.annotations.neighbours.shape[:-1])
    assert np.isnan(noisy.annotations.neighbours[occluded]).all()


TOUCHING = DANCES[0].positions.copy()
TOUCHING[:, 17] = TOUCHING[:, 0]
SLOW = Motion(DANCES[0].positions, PAIR, 25.0)
ONE_PERSON = Motion(DANCES[0].positions[:, :17], Skeleton.preset("person17"), 30.0)


@pytest.mark.parametrize(
    ("motions", "n", "options", "message"),
    [
        ([], 1, {}, "motions must contain at least one clip, got none"),
        (DANCES, 121, {}, "n must be at most 120, the number of frames, got 121"),
        ([*DANCES, SLOW], 5, {}, r"motions\[3\] .*, got 34 joints and 25 frames per second"),
        ([*DANCES, ONE_PERSON], 5, {}, r"motions\[3\] .*, got 17 joints and 30 frames per second"),
        ([ONE_PERSON], 5, {}, "skeleton must have at least 2 people, got 1"),
        ([Motion(TOUCHING, PAIR, 30.0)], 5, {}, "degenerate pair in frame .* of clip 0"),
        (DANCES, 5, {"noise": -0.1}, "noise must be a finite number of at least 0, got -0.1"),
        (DANCES, 5, {"hidden": 1.0}, "hidden must be at least 0 and below 1, got 1.0"),
        (DANCES, 5, {"frames": [np.ones(40, bool)] * 2}, "frames must have 3 masks, .* got 2"),
    ],
)
def test_invalid_motions_are_rejected(motions, n, options, message):
    with pytest.raises(ValueError, match=message):
        draw_annotations(motions, n, 0, **options)
