"""Annotated pairs: what is refused, pictures of 3D motions, tracks of detectors, differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.local_frames import chests, pair_frames
from probmotion.interaction.annotations.sources import ELEVATIONS, draw_annotations, world_axes
from probmotion.interaction.annotations.views import view_angles

PAIR = Skeleton.preset("pair17")
DANCES = synthetic_dances(3, frames=40)


def walk(frames: int = 12, seed: int = 0) -> Motion:
    """Joints that move smoothly at random."""
    rng = np.random.default_rng(seed)
    start, pace = rng.standard_normal((2, 1, 34, 3))
    time = np.arange(frames)[:, None, None]
    positions = start + 0.02 * pace * time + 0.1 * np.sin(time / 3 + pace)
    return Motion(positions, PAIR, 30.0, name=f"walk {seed}")


def some_annotations(n: int = 5, seed: int = 0) -> Annotations:
    rng = np.random.default_rng(seed)
    return Annotations(
        rng.standard_normal((n, 34, 2)),
        np.ones((n, 34), dtype=bool),
        PAIR,
        rng.standard_normal((n, 2, 34, 2)),
        30.0,
    )


# What annotations are.


def test_hidden_joints_are_zero_whatever_came() -> None:
    given = some_annotations()
    keypoints, visible = given.keypoints.copy(), given.visible.copy()
    keypoints[2, 3], visible[2, 3] = np.nan, False
    keypoints[1, 5], visible[1, 5] = 7.0, False
    held = replace(given, keypoints=keypoints, visible=visible)
    assert (held.keypoints[[2, 1], [3, 5]] == 0).all()
    np.testing.assert_array_equal(held.keypoints[visible], given.keypoints[visible])
    assert held.describe() == "5 annotations, 2 of 170 joints hidden"


def person_hidden(given: Annotations) -> Annotations:
    visible = given.visible.copy()
    visible[3, 17:] = False
    return replace(given, visible=visible)


def not_finite(given: Annotations) -> Annotations:
    keypoints = given.keypoints.copy()
    keypoints[1, 4] = np.nan
    return replace(given, keypoints=keypoints)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            lambda a: replace(a, keypoints=a.keypoints[:0]),
            "keypoints has no annotation, expected at least one",
        ),
        (
            lambda a: replace(a, keypoints=a.keypoints[:, :17]),
            r"keypoints must have shape \(n, 34, 2\), got \(5, 17, 2\)",
        ),
        (lambda a: replace(a, visible=a.visible.astype(float)), "visible is of float64, expected"),
        (
            not_finite,
            "keypoints is not finite in annotation 1, joint person0:head, expected it hidden",
        ),
        (
            person_hidden,
            r"visible shows no joint of the character of person1:pelvis in annotation 3 \(one pers",
        ),
        (
            lambda a: replace(a, neighbours=a.neighbours[:, :1]),
            r"neighbours must have shape \(5, 2, 34, 2\), got \(5, 1, 34, 2\)",
        ),
        (lambda a: replace(a, neighbours=a.neighbours + np.inf), "neighbours has infinite values"),
        (lambda a: replace(a, fps=0.0), "fps must be a finite number above 0, got 0.0"),
        (lambda a: replace(a, views=np.zeros((4, 2))), r"views must have shape \(5,, got \(4, 2\)"),
        (lambda a: replace(a, views=np.full((5, 2), np.inf)), "views has infinite values"),
        (lambda a: replace(a, sources=["a"]), "sources has 1 names, expected 5"),
        (lambda a: a.subset([0, 5]), "indices has values from 0 to 5, expected them from 0 to 4"),
        (lambda a: a.subset([]), "keypoints has no annotation, expected at least one"),
    ],
)
def test_wrong_annotations_are_refused_in_one_sentence(
    wrong: Callable[[Annotations], Annotations], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        wrong(some_annotations())


def test_subset_and_length() -> None:
    given = replace(some_annotations(), views=np.random.rand(5, 2), sources=list("abcde"))  # noqa: NPY002
    assert len(given) == 5
    for chosen in ([3, 0], np.array([False, True, False, False, True])):
        some = given.subset(chosen)
        assert len(some) == 2
        for name in ("keypoints", "visible", "neighbours", "views"):
            np.testing.assert_array_equal(getattr(some, name), getattr(given, name)[chosen])
        assert some.sources == tuple(np.array(list("abcde"))[chosen])


def test_save_and_load_give_the_same(tmp_path: Path) -> None:
    drawn = draw_annotations(DANCES, 20, 0, known_views=True, hidden=0.2).annotations
    for given in (replace(drawn, dropped={"one person missing": 3}), some_annotations()):
        given.save(tmp_path / "seen.npz")
        read = Annotations.load(tmp_path / "seen.npz")
        for name in ("keypoints", "visible", "neighbours", "views"):
            np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
        for name in ("skeleton", "fps", "sources", "dropped"):
            assert getattr(read, name) == getattr(given, name)


def test_damaged_files_are_refused_in_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "seen.npz"
    some_annotations().save(path)
    whole = path.read_bytes()
    np.savez(tmp_path / "other.npz", positions=np.zeros(3))
    for content in (b"", b"none", whole[: len(whole) // 2], (tmp_path / "other.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"seen\.npz holds no annotations"):
            Annotations.load(path)
    with pytest.raises(FileNotFoundError):
        Annotations.load(tmp_path / "none.npz")


# Differences in time, equation 12.


def test_differences_are_those_of_angle_length_and_root() -> None:
    """Against derivatives of a bone that turns and stretches evenly, by its definition."""
    turn, stretch, time = 0.002 * np.arange(34), 0.01, np.arange(-1, 2)
    keypoints = np.zeros((3, 34, 2))
    for joint, parent in sorted(PAIR.bones):
        angle, length = joint + turn[joint] * time, 0.3 + stretch * time
        bone = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        keypoints[:, joint] = keypoints[:, parent] + bone
    keypoints += np.array([0.03, -0.04]) * time[:, None, None]
    seen = Annotations(
        keypoints[[1]], np.ones((1, 34), dtype=bool), PAIR, keypoints[None, [0, 2]], 30.0
    )
    turns, stretches = seen.local_differences()
    bones = [joint for joint, _ in PAIR.bones]
    np.testing.assert_allclose(turns[0, bones], np.sin(turn[bones]))  # half a chord of two steps
    np.testing.assert_allclose(stretches[0, bones], stretch)
    roots = list(PAIR.roots)
    np.testing.assert_allclose(stretches[0, roots], 0.05)
    for root, chest in zip(roots, chests(PAIR), strict=True):
        backbone = keypoints[:, chest] - keypoints[:, root]
        unit = backbone / np.linalg.norm(backbone, axis=-1, keepdims=True)
        assert turns[0, root] == pytest.approx(np.linalg.norm(unit[2] - unit[0]) / 2)


def test_differences_at_cuts_are_one_sided_and_zero_without_neighbours() -> None:
    motion = walk()
    pictures = motion.positions[..., :2]
    gap = np.full((34, 2), np.nan)
    both, after, before, none = (
        Annotations(pictures[[5]], np.ones((1, 34), dtype=bool), PAIR, np.stack(pair)[None], 30.0)
        for pair in (
            (pictures[4], pictures[6]), (gap, pictures[6]), (pictures[4], gap), (gap, gap)
        )
    )  # fmt: skip
    joint, parent = PAIR.index("person1:left_knee"), PAIR.index("person1:left_hip")
    lengths = np.linalg.norm(pictures[4:7, joint] - pictures[4:7, parent], axis=-1)
    for seen, wanted in (
        (both, abs(lengths[2] - lengths[0]) / 2),
        (after, abs(lengths[2] - lengths[1])),
        (before, abs(lengths[1] - lengths[0])),
        (none, 0.0),
    ):
        assert seen.local_differences()[1][0, joint] == pytest.approx(wanted, abs=1e-12)
    assert (np.stack(none.local_differences()) == 0).all()


def test_differences_do_not_see_hidden_joints_or_bones_without_length() -> None:
    motion = walk()
    visible = np.ones((1, 34), dtype=bool)
    visible[0, 1] = False
    neighbours = motion.positions[None, [4, 6], :, :2].copy()
    neighbours[:, :, 1] = np.nan
    neighbours[:, :, 4] = neighbours[:, :, 3]  # a bone seen from its end
    turns, stretches = Annotations(
        motion.positions[[5], :, :2], visible, PAIR, neighbours, 30.0
    ).local_differences()
    assert turns[0, 1] == stretches[0, 1] == 0
    assert turns[0, 2] == 0  # its parent is hidden
    assert turns[0, 4] == stretches[0, 4] == 0
    assert turns[0, 3] > 0


# From 3D pairs.


def test_pictures_are_projections_of_their_frames_and_their_neighbours() -> None:
    motions = [walk(seed=0), walk(20, seed=1)]
    drawn = draw_annotations(motions, 32, 0)
    assert len({*zip(drawn.clips, drawn.frames, strict=True)}) == 32  # every frame once
    axes = world_axes(drawn.world_views)
    seen = drawn.annotations
    assert seen.visible.all()
    assert seen.views is None
    for row, (clip, frame) in enumerate(zip(drawn.clips, drawn.frames, strict=True)):
        positions = motions[clip].positions
        assert seen.sources is not None
        assert seen.sources[row] == motions[clip].name
        np.testing.assert_allclose(seen.keypoints[row], positions[frame] @ axes[row, :2].T)
        for slot, at in enumerate((frame - 1, frame + 1)):
            if 0 <= at < len(positions):
                wanted = positions[at] @ axes[row, :2].T
                np.testing.assert_allclose(seen.neighbours[row, slot], wanted)
            else:
                assert np.isnan(seen.neighbours[row, slot]).all()
    np.testing.assert_allclose(
        drawn.views, view_angles(pair_frames(drawn.positions, PAIR), axes[:, 2])
    )


def test_cameras_stand_upright_where_they_are_said_to() -> None:
    axes = world_axes(np.array([[0.0, 0.0], [np.pi / 2, 0.0], [0.0, np.pi / 2]]))
    np.testing.assert_allclose(axes[0], np.eye(3), atol=1e-15)
    np.testing.assert_allclose(axes[1], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(axes[2], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)
    drawn = draw_annotations(DANCES, 100, 0)
    axes = world_axes(drawn.world_views)
    np.testing.assert_allclose(
        axes @ np.swapaxes(axes, 1, 2), np.tile(np.eye(3), (100, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1)
    assert (axes[:, 0, 1] == 0).all()  # right is level
    assert (axes[:, 1, 1] > 0).all()  # up is up
    azimuth, elevation = drawn.world_views.T
    assert ELEVATIONS[0] <= elevation.min() < -0.1 < 0.6 < elevation.max() <= ELEVATIONS[1]
    assert azimuth.min() < -2.8
    assert azimuth.max() > 2.8


def test_all_annotations_from_one_view_are_handled() -> None:
    views = np.tile([[0.4, 0.1]], (10, 1))
    drawn = draw_annotations(DANCES, 10, 0, world_views=views, known_views=True)
    assert drawn.annotations.views is not None
    np.testing.assert_array_equal(drawn.annotations.views, drawn.views)
    np.testing.assert_array_equal(drawn.world_views, views)


def test_seed_decides_everything_and_noise_and_hiding_change_nothing_else() -> None:
    plain, again, other = (draw_annotations(DANCES, 60, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(plain.annotations.keypoints, again.annotations.keypoints)
    assert not np.array_equal(plain.frames, other.frames)
    rough = draw_annotations(DANCES, 60, 3, noise=0.05, hidden=0.25)
    np.testing.assert_array_equal(rough.world_views, plain.world_views)
    np.testing.assert_array_equal(rough.frames, plain.frames)
    seen = rough.annotations
    for person in np.split(seen.visible, 2, axis=1):
        assert ((~person).sum(axis=1) == 4).all()  # a quarter of 17
    assert len(np.unique(seen.visible, axis=0)) > 50
    gap = (seen.keypoints - plain.annotations.keypoints)[seen.visible]
    assert gap.std() == pytest.approx(0.05, rel=0.05)
    hidden = np.broadcast_to(~seen.visible[:, None], seen.neighbours.shape[:-1])
    assert np.isnan(seen.neighbours[hidden]).all()


def test_only_frames_that_are_offered_are_drawn() -> None:
    offered = [np.arange(motion.frames) % 7 == 3 for motion in DANCES]
    drawn = draw_annotations(DANCES, 10, 0, frames=offered)
    assert (drawn.frames % 7 == 3).all()
    assert np.isfinite(drawn.annotations.neighbours).all()  # neighbours need not be offered


def test_wrong_motions_are_refused_in_one_sentence() -> None:
    slow = Motion(DANCES[0].positions, PAIR, 25.0)
    alone = Motion(DANCES[0].positions[:, :17], Skeleton.preset("person17"), 30.0)
    touching = DANCES[0].positions.copy()
    touching[:, 17] = touching[:, 0]
    for motions, n, message in (
        ([], 1, "motions must contain at least one clip, got none"),
        (DANCES, 121, "n must be at most the 120 frames to draw from, got 121"),
        (DANCES, 0, "n must be an integer of at least 1, got 0"),
        ([*DANCES, slow], 5, r"motions\[3\] has 25 frames per second and the first 30, expected"),
        ([*DANCES, alone], 5, r"motions\[3\] has other joints than the first, expected the"),
        ([alone], 5, r"has 1 character, expected at least two \(one person missing\)"),
        ([Motion(touching, PAIR, 30.0)], 5, "motions has a degenerate pair in frame .* of clip 0"),
    ):
        with pytest.raises(ValueError, match=message):
            draw_annotations(motions, n, 0)
    with pytest.raises(ValueError, match=r"noise must be a finite number of at least 0, got -0\.1"):
        draw_annotations(DANCES, 5, 0, noise=-0.1)
    with pytest.raises(ValueError, match=r"hidden must be a share from 0 to below 1, got 1\.0"):
        draw_annotations(DANCES, 5, 0, hidden=1.0)
    with pytest.raises(ValueError, match="frames has 2 entries, expected 3, one per clip"):
        draw_annotations(DANCES, 5, 0, frames=[np.ones(40, dtype=bool)] * 2)


def test_videos_are_joined() -> None:
    first = draw_annotations(DANCES[:1], 7, 0, hidden=0.2).annotations
    second = draw_annotations(DANCES[1:2], 5, 1).annotations
    both = Annotations.joined([first, second])
    assert len(both) == 12
    np.testing.assert_array_equal(both.keypoints[7:], second.keypoints)
    np.testing.assert_array_equal(both.visible[:7], first.visible)
    np.testing.assert_array_equal(both.neighbours[7:], second.neighbours)
    assert both.sources == (*first.sources, *second.sources)
    assert both.views is None
    slower = replace(second, fps=25.0)
    with pytest.raises(ValueError, match=r"several\[1\] has 34 joints at 25 frames per second"):
        Annotations.joined([first, slower])
    with pytest.raises(ValueError, match="several is empty"):
        Annotations.joined([])


def test_indices_of_a_subset_are_integers_or_a_mask() -> None:
    seen = draw_annotations(DANCES[:1], 7, 0).annotations
    with pytest.raises(ValueError, match="indices is of float64, expected integers or a mask"):
        seen.subset([0.7, 1.2])
    with pytest.raises(ValueError, match=r"indices must have shape \(7\), got \(3,\)"):
        seen.subset(np.ones(3, dtype=bool))
