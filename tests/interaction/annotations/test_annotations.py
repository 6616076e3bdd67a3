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
    rng = np.random.default_rng(seed)
    start, pace = rng.standard_normal((2, 1, 34, 3))
    time = np.arange(frames)[:, None, None]
    positions = start + 0.02 * pace * time + 0.1 * np.sin(time / 3 + pace)
    return Motion(positions, PAIR, 30.0, name=f"walk {seed}")


def one_annotation(before, own, after, visible=None):
    visible = np.ones((1, 34), dtype=bool) if visible is None else visible
    return Annotations(own[None], visible, PAIR, np.stack([before, after])[None], 30.0)


def random_annotations(**changes):
    rng = np.random.default_rng(0)
    fields = {
        "keypoints": rng.standard_normal((5, 34, 2)),
        "visible": np.ones((5, 34), dtype=bool),
        "skeleton": PAIR,
        "neighbours": rng.standard_normal((5, 2, 34, 2)),
        "fps": 30.0,
    }
    return Annotations(**fields | changes)


def changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


def test_occluded_joints_are_set_to_zero():
    given = random_annotations()
    keypoints = changed(changed(given.keypoints, (2, 3), np.nan), (1, 5), 7.0)
    visible = changed(given.visible, ([2, 1], [3, 5]), False)
    held = replace(given, keypoints=keypoints, visible=visible)
    assert (held.keypoints[[2, 1], [3, 5]] == 0).all()
    np.testing.assert_array_equal(held.keypoints[visible], given.keypoints[visible])
    assert held.describe() == "5 annotations, 2 of 170 joints occluded"


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
        (
            lambda a: Annotations.joined([a, replace(a, fps=25.0)]),
            r"several\[1\] must have the skeleton .* got 34 joints and 25 frames per second",
        ),
    ],
)
def test_invalid_annotations_are_rejected(make, message):
    with pytest.raises(ValueError, match=message):
        make(random_annotations())


def test_subset_selects_rows():
    given = random_annotations(views=np.ones((5, 2)), sources=list("abcde"))
    for chosen in ([3, 0], np.array([False, True, False, False, True])):
        subset = given.subset(chosen)
        assert len(subset) == 2
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(subset, name), getattr(given, name)[chosen])
        assert subset.sources == tuple(np.array(list("abcde"))[chosen])


def test_videos_are_joined():
    first = draw_annotations(DANCES[:1], 7, 0, hidden=0.2).annotations
    second = draw_annotations(DANCES[1:2], 5, 1).annotations
    both = Annotations.joined([first, second])
    for name in ARRAYS[:3]:
        parts = getattr(first, name), getattr(second, name)
        np.testing.assert_array_equal(getattr(both, name), np.concatenate(parts))
    assert both.sources == (*first.sources, *second.sources)
    assert both.views is None


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
    whole = path.read_bytes()
    np.savez(tmp_path / "other.npz", positions=np.zeros(3))
    for content in (b"", b"none", whole[: len(whole) // 2], (tmp_path / "other.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"seen\.npz must be an archive written by"):
            Annotations.load(path)
    with pytest.raises(FileNotFoundError):
        Annotations.load(tmp_path / "none.npz")


# Differences in time (eq. 12).


def test_differences_are_those_of_angle_length_and_root():
    """Bones with constant angular velocity and stretch."""
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
    keypoints = smooth_motion().positions[..., :2]
    before, own, after = keypoints[4:7]
    gap = np.full((34, 2), np.nan)
    joint, parent = PAIR.index("person1:left_knee"), PAIR.index("person1:left_hip")
    lengths = np.linalg.norm(keypoints[4:7, joint] - keypoints[4:7, parent], axis=-1)
    for annotation, expected in (
        (one_annotation(before, own, after), abs(lengths[2] - lengths[0]) / 2),
        (one_annotation(gap, own, after), abs(lengths[2] - lengths[1])),
        (one_annotation(before, own, gap), abs(lengths[1] - lengths[0])),
        (one_annotation(gap, own, gap), 0.0),
    ):
        _, stretch = annotation.local_differences()
        assert stretch[0, joint] == pytest.approx(expected, abs=1e-12)
    assert (np.stack(annotation.local_differences()) == 0).all()


def test_differences_are_zero_for_occluded_joints_and_bones_of_length_zero():
    before, own, after = smooth_motion().positions[4:7, :, :2]
    for neighbour in (before, after):
        neighbour[1] = np.nan
        neighbour[4] = neighbour[3]  # a bone along the line of sight
    visible = np.arange(34)[None] != 1
    turns, stretches = one_annotation(before, own, after, visible).local_differences()
    assert (turns[0, [1, 2, 4]] == 0).all()  # the parent of 2 is occluded
    assert (stretches[0, [1, 4]] == 0).all()
    assert turns[0, 3] > 0


# Simulation from 3D pairs.


def test_annotations_are_projections_of_frames_and_neighbours():
    motions = [smooth_motion(seed=0), smooth_motion(20, seed=1)]
    drawn = draw_annotations(motions, 32, 0)
    assert len({*zip(drawn.clips, drawn.frames, strict=True)}) == 32  # every frame once
    axes = world_axes(drawn.world_views)
    annotations = drawn.annotations
    assert annotations.visible.all()
    assert annotations.views is None
    for row, (clip, frame) in enumerate(zip(drawn.clips, drawn.frames, strict=True)):
        positions = np.pad(
            motions[clip].positions, ((1, 1), (0, 0), (0, 0)), constant_values=np.nan
        )
        assert annotations.sources[row] == motions[clip].name
        before, own, after = positions[frame : frame + 3] @ axes[row, :2].T
        np.testing.assert_allclose(annotations.keypoints[row], own)
        np.testing.assert_allclose(annotations.neighbours[row], [before, after])
    np.testing.assert_allclose(
        drawn.views, view_angles(pair_frames(drawn.positions, PAIR), axes[:, 2])
    )


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
    assert (axes[:, 0, 1] == 0).all()
    assert (axes[:, 1, 1] > 0).all()
    azimuth, elevation = drawn.world_views.T
    assert ELEVATIONS[0] <= elevation.min() < -0.1 < 0.6 < elevation.max() <= ELEVATIONS[1]
    assert azimuth.min() < -2.8
    assert azimuth.max() > 2.8


def test_given_views_and_frames_are_used():
    views = np.tile([[0.4, 0.1]], (10, 1))
    offered = [np.arange(motion.frames) % 7 == 3 for motion in DANCES]
    drawn = draw_annotations(DANCES, 10, 0, frames=offered, world_views=views, known_views=True)
    np.testing.assert_array_equal(drawn.annotations.views, drawn.views)
    np.testing.assert_array_equal(drawn.world_views, views)
    assert (drawn.frames % 7 == 3).all()
    assert np.isfinite(drawn.annotations.neighbours).all()


def test_draws_depend_on_the_seed_only():
    plain, again, other = (draw_annotations(DANCES, 60, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(plain.annotations.keypoints, again.annotations.keypoints)
    assert not np.array_equal(plain.frames, other.frames)
    noisy = draw_annotations(DANCES, 60, 3, noise=0.05, hidden=0.25)
    np.testing.assert_array_equal(noisy.world_views, plain.world_views)
    np.testing.assert_array_equal(noisy.frames, plain.frames)
    visible = noisy.annotations.visible
    for person in np.split(visible, 2, axis=1):
        assert ((~person).sum(axis=1) == 4).all()  # a quarter of 17
    assert len(np.unique(visible, axis=0)) > 50
    errors = (noisy.annotations.keypoints - plain.annotations.keypoints)[visible]
    assert errors.std() == pytest.approx(0.05, rel=0.05)
    occluded = np.broadcast_to(~visible[:, None], noisy.annotations.neighbours.shape[:-1])
    assert np.isnan(noisy.annotations.neighbours[occluded]).all()


TOUCHING = DANCES[0].positions.copy()
TOUCHING[:, 17] = TOUCHING[:, 0]
SLOW = Motion(DANCES[0].positions, PAIR, 25.0)
ALONE = Motion(DANCES[0].positions[:, :17], Skeleton.preset("person17"), 30.0)


@pytest.mark.parametrize(
    ("motions", "n", "options", "message"),
    [
        ([], 1, {}, "motions must contain at least one clip, got none"),
        (DANCES, 121, {}, "n must be at most 120, the number of frames, got 121"),
        ([*DANCES, SLOW], 5, {}, r"motions\[3\] must have the frame rate of .* 30, got 25"),
        ([*DANCES, ALONE], 5, {}, r"motions\[3\] must have the skeleton of motions\[0\]"),
        ([ALONE], 5, {}, "skeleton must have at least 2 people, got 1"),
        ([Motion(TOUCHING, PAIR, 30.0)], 5, {}, "degenerate pair in frame .* of clip 0"),
        (DANCES, 5, {"noise": -0.1}, "noise must be a finite number of at least 0, got -0.1"),
        (DANCES, 5, {"hidden": 1.0}, "hidden must be at least 0 and below 1, got 1.0"),
        (DANCES, 5, {"frames": [np.ones(40, bool)] * 2}, "frames must have 3 masks, .* got 2"),
    ],
)
def test_invalid_motions_are_rejected(motions, n, options, message):
    with pytest.raises(ValueError, match=message):
        draw_annotations(motions, n, 0, **options)
