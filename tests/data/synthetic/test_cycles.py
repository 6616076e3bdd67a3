"""A cycle repeated: moved and turned as its root was, closed without a seam, its pieces rigid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.animals import synthetic_animals
from probmotion.data.synthetic.cycles import repeated_cycle


def distances(clip: Motion, pairs: list[tuple[int, int]]) -> np.ndarray:
    """Distances between joints, (pairs, L)."""
    return np.stack(
        [np.linalg.norm(clip.positions[:, a] - clip.positions[:, b], axis=-1) for a, b in pairs]
    )


def sway(frames: int, degrees: float = 50.0, miss: float = 0.1) -> Motion:
    """A made cycle of a trunk, its two sides and a tail that walks an arc 1 m long.

    At the end its joints miss by a share of their swing where they were at the beginning.
    """
    skeleton = Skeleton(
        ["pelvis", "tail", "left_hip", "right_hip", "chest", "neck"], [-1, 0, 0, 0, 0, 4]
    )
    time = np.linspace(0, 1, frames)
    arc = np.radians(degrees)
    heading = Rotation.from_rotvec(arc * time[:, None] * [0.0, 1.0, 0.0])
    wave = np.sin(2 * np.pi * time) + miss * time
    roll = heading * Rotation.from_rotvec(0.2 * wave[:, None] * [0.0, 0.0, 1.0])
    pitch = heading * Rotation.from_rotvec(0.3 * wave[:, None] * [1.0, 0.0, 0.0])
    nod = heading * Rotation.from_rotvec(-0.5 * wave[:, None] * [1.0, 0.0, 0.0])
    across = time * np.sinc(arc * time / (2 * np.pi)) * np.sin(arc * time / 2)
    ahead = time * np.sinc(arc * time / np.pi)
    root = np.stack([across, 0.6 + 0.02 * wave, ahead], axis=-1)
    chest = root + pitch.apply([0.0, 0.0, 0.4])
    parts = [
        root, root + roll.apply([0, 0, -0.1]), root + roll.apply([0.1, -0.1, 0]),
        root + roll.apply([-0.1, -0.1, 0]), chest, chest + nod.apply([0, 0.1, 0.2]),
    ]  # fmt: skip
    return Motion(np.stack(parts, axis=1), skeleton, 30.0, name="sway")


def test_what_a_cycle_misses_is_made_up_for_evenly() -> None:
    # About fixed axes, what is made up for is just the drift that was put in, piece by piece.
    found = repeated_cycle(sway(21, degrees=0, miss=0.3), 21)
    np.testing.assert_allclose(found.positions, sway(21, degrees=0, miss=0).positions, atol=1e-12)


def test_every_cycle_is_the_first_moved_and_turned() -> None:
    period = 20
    cycle = sway(period + 1)
    clip = repeated_cycle(cycle, 3 * period + 5)
    assert clip.frames == 3 * period + 5
    first = clip.positions[: period + 1]
    turn = Rotation.from_rotvec([0.0, np.radians(50), 0.0])
    for number in (1, 2):
        later = clip.positions[number * period : (number + 1) * period + 1]
        power = turn**number
        expected = power.apply((first - first[0, 0]).reshape(-1, 3)).reshape(first.shape)
        np.testing.assert_allclose(later - later[0, 0], expected, atol=2e-2)
    # Every cycle turns by the same angle, that of the cycle's ends up to what they miss.
    heading = clip.positions[:, 2] - clip.positions[:, 3]
    angle = np.unwrap(np.arctan2(-heading[:, 2], heading[:, 0]))
    step = np.diff(angle[[0, period, 2 * period, 3 * period]])
    np.testing.assert_allclose(step, step[0], atol=1e-12)
    assert np.degrees(step[0]) == pytest.approx(50, abs=1)
    travel = (cycle.positions[-1, 0] - cycle.positions[0, 0]) * [1.0, 0.0, 1.0]
    np.testing.assert_allclose(clip.positions[period, 0] - first[0, 0], travel, atol=1e-12)
    np.testing.assert_allclose(clip.positions[::period, 0, 1], 0.6, atol=1e-12)


def test_a_closed_cycle_stays_what_it_is() -> None:
    walk = synthetic_animals(1, frames=31)[0]
    frame = walk.positions[:1]
    bob = 0.05 * np.sin(2 * np.pi * np.arange(11) / 10)
    move = np.stack([0 * bob, bob, 0.1 * np.arange(11)], axis=-1)
    cycle = Motion(frame + move[:, None], walk.skeleton, 30.0)
    clip = repeated_cycle(cycle, 26)
    np.testing.assert_allclose(clip.positions[:11], cycle.positions, atol=1e-12)
    np.testing.assert_allclose(
        clip.positions[10:21], cycle.positions + np.array([0.0, 0.0, 1.0]), atol=1e-12
    )


def test_pieces_stay_rigid_and_seams_smooth() -> None:
    period = 20
    cycle = sway(period + 1)
    clip = repeated_cycle(cycle, 4 * period)
    pairs = [*cycle.skeleton.bones, (1, 2), (2, 3)]
    own = distances(cycle, pairs)[:, :1]
    np.testing.assert_allclose(distances(clip, pairs), own.repeat(clip.frames, 1), atol=1e-12)
    bends = np.linalg.norm(np.diff(clip.positions, n=2, axis=0), axis=-1).max(axis=-1)
    within = np.linalg.norm(np.diff(cycle.positions, n=2, axis=0), axis=-1).max()
    seams = [number * period - 1 for number in (1, 2, 3)]
    assert bends[seams].max() < 1.2 * within


def test_bad_input() -> None:
    cycle = sway(3)
    with pytest.raises(ValueError, match="cycle has 2 frames, expected at least 3"):
        repeated_cycle(cycle.window(0, 2), 9)
    with pytest.raises(ValueError, match="frames must be an integer of at least 1, got 0"):
        repeated_cycle(cycle, 0)
    pair = Motion(np.zeros((4, 2, 3)), Skeleton(["one", "other"], [-1, -1]), 30.0)
    with pytest.raises(ValueError, match="cycle has 2 roots, expected one body"):
        repeated_cycle(pair, 9)
