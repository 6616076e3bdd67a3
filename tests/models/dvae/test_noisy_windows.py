"""Windows of noisy joints, roughly where they stand, and one motion of many windows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.noisy_windows import (
    NoisyWindows,
    Stitching,
    on_ground,
    rough_placement,
    windows_of,
)
from probmotion.posteriors.likelihoods import Joints3D

PERSON = Skeleton.preset("person14")
PELVIS = PERSON.index("pelvis")
SHAPES = [(30, 10), (12, 4), (12, 0), (12, 11), (7, 3), (2, 1)]


def walks(n=3, frames=12):
    return np.stack(
        [make_gait("walk", number, frames=frames).retarget(PERSON).positions for number in range(n)]
    )


def all_seen(joints):
    return np.ones(joints.shape[:-1], dtype=bool)


def apart(angle, other):
    return (angle - other + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize(("window", "overlap"), SHAPES)
def test_motions_of_any_length_are_covered_and_shares_add_up_to_one(window, overlap):
    for frames in range(1, 101):
        cut = Stitching(frames, window, overlap)
        assert cut.length == min(window, frames)
        assert cut.starts[0] == 0
        assert cut.starts[-1] + cut.length == frames
        # No gap, and as much overlap as was asked for.
        assert all(0 < step <= window - overlap for step in np.diff(cut.starts))
        weights = cut.weights
        assert weights.shape == (len(cut.starts), cut.length)
        assert (weights > 0).all()
        np.testing.assert_allclose(cut.joined(weights[..., None]), 1, atol=1e-12)
    assert Stitching(window, window, overlap).starts == [0]


@pytest.mark.parametrize(("window", "overlap"), SHAPES)
@pytest.mark.parametrize("frames", [1, 2, 5, 12, 13, 31, 50, 100])
def test_windows_that_agree_give_the_motion_back(window, overlap, frames):
    cut = Stitching(frames, window, overlap)
    motion = np.random.default_rng(0).normal(size=(frames, 4, 3))
    windows = cut.cut(motion)
    assert windows.shape == (len(cut.starts), cut.length, 4, 3)
    np.testing.assert_allclose(cut.mean(windows), motion, atol=1e-12)
    many = np.stack([windows, 2 * windows])
    np.testing.assert_allclose(cut.mean(many), np.stack([motion, 2 * motion]), atol=1e-12)


@pytest.mark.parametrize("overlap", [4, 10, 20])
def test_a_stitched_motion_does_not_jump_where_windows_disagree(overlap):
    """Two windows a metre apart: sin² rises at most by π/2 per overlap."""
    cut = Stitching(60 - overlap, 30, overlap)
    assert len(cut.starts) == 2
    windows = np.zeros((2, 30, 1, 3))
    windows[1] = 1.0
    found = cut.mean(windows)[:, 0, 0]
    assert found[0] == 0
    assert found[-1] == pytest.approx(1)
    assert (np.diff(found) >= -1e-12).all()
    assert np.diff(found).max() < 0.5 * math.pi / (overlap + 1) + 1e-9
    # Where neither begins nor ends, both weigh alike.
    np.testing.assert_allclose(found + found[::-1], 1, atol=1e-12)


@pytest.mark.parametrize(("frames", "window", "overlap"), [(50, 30, 10), (51, 30, 10), (45, 12, 5)])
def test_draws_keep_the_variance_of_windows(frames, window, overlap):
    cut, n = Stitching(frames, window, overlap), 20_000
    rng = np.random.default_rng(1)
    means = rng.normal(size=(len(cut.starts), cut.length, 1, 3))
    windows = means + 0.3 * rng.standard_normal((n, *means.shape))
    found = cut.draws(windows, means)
    assert found.shape == (n, frames, 1, 3)
    np.testing.assert_allclose(found.std(axis=0), 0.3, atol=5 * 0.3 / math.sqrt(2 * n))
    off = found.mean(axis=0) - cut.mean(means)
    assert abs(off).max() < 5 * 0.3 / math.sqrt(n)
    # Which a plain mean of them does not.
    assert cut.mean(windows).std(axis=0).min() < 0.25


def test_a_window_alone_is_its_own_draw():
    cut = Stitching(9, 12, 5)
    rng = np.random.default_rng(2)
    windows, means = rng.normal(size=(4, 1, 9, 2, 3)), rng.normal(size=(1, 9, 2, 3))
    np.testing.assert_allclose(cut.draws(windows, means), windows[:, 0], atol=1e-12)


@pytest.mark.parametrize("angle", [-2.8, -0.4, 0.0, 1.1, 3.0])
def test_placement_of_turned_and_moved_motions_turns_and_moves(angle):
    joints = walks()
    heading, ground = rough_placement(joints, all_seen(joints), PERSON)
    # Gaits set out along +Z; arms that swing turn the line from right to left a little.
    assert abs(heading).max() < 0.5
    np.testing.assert_allclose(ground, joints[:, :5, PELVIS][..., [0, 2]].mean(axis=1), atol=1e-12)
    shift = np.array([3.0, 0.7, -5.0])
    moved = turned_about_vertical(joints, angle) + shift
    other, there = rough_placement(moved, all_seen(joints), PERSON)
    np.testing.assert_allclose(apart(other - heading, angle), 0, atol=1e-12)
    on = turned_about_vertical(
        np.stack([ground[:, 0], 0 * heading, ground[:, 1]], -1)[:, None, None], angle
    )[:, 0, 0, [0, 2]]
    np.testing.assert_allclose(there, on + shift[[0, 2]], atol=1e-12)


def test_the_heading_is_square_to_the_line_from_right_to_left():
    joints = np.zeros((1, 3, 14, 3))
    for left, right in PERSON.mirrored_pairs:
        joints[:, :, left], joints[:, :, right] = [0.2, 1, 0], [-0.2, 1, 0]
    for angle in np.linspace(-3, 3, 7):
        turned = turned_about_vertical(joints, angle)
        heading, _ = rough_placement(turned, all_seen(joints), PERSON)
        assert heading[0] == pytest.approx(angle)


def test_placement_is_that_of_the_first_frames_that_show_something():
    joints = walks()
    seen = all_seen(joints)
    seen[:, :3] = False
    harmed = np.where(seen[..., None], joints, np.nan)
    heading, ground = rough_placement(harmed, seen, PERSON)
    later, there = rough_placement(joints[:, 3:], all_seen(joints)[:, 3:], PERSON)
    np.testing.assert_allclose(heading, later)
    np.testing.assert_allclose(ground, there)
    # A root that hides longer than the rest, and one that is never seen.
    seen = all_seen(joints)
    seen[:, :4, PELVIS] = False
    seen[2, :, PELVIS] = False
    heading, ground = rough_placement(np.where(seen[..., None], joints, 1e6), seen, PERSON)
    wanted = joints[:2, 4:9, PELVIS].mean(axis=1)
    np.testing.assert_allclose(ground[:2], wanted[:, [0, 2]])
    shown = np.delete(joints[2, :5], PELVIS, axis=1).mean(axis=(0, 1))
    np.testing.assert_allclose(ground[2], shown[[0, 2]])
    # Pairs of which one side hides say nothing of the heading; the others still do.
    seen = all_seen(joints)
    seen[:, :, [PERSON.index("left_wrist"), PERSON.index("right_ankle")]] = False
    heading, _ = rough_placement(np.where(seen[..., None], joints, 1e6), seen, PERSON)
    whole, _ = rough_placement(joints, all_seen(joints), PERSON)
    assert abs(apart(heading, whole)).max() < 0.3


def test_one_joint_in_one_frame_is_enough_for_a_place():
    joints = walks(1)
    seen = np.zeros(joints.shape[:-1], dtype=bool)
    seen[0, 7, 4] = True
    heading, ground = rough_placement(np.where(seen[..., None], joints, np.nan), seen, PERSON)
    assert heading[0] == 0
    np.testing.assert_allclose(ground[0], joints[0, 7, 4, [0, 2]])


def test_a_window_that_shows_nothing_is_refused():
    joints = walks()
    seen = all_seen(joints)
    seen[1] = False
    with pytest.raises(
        ValueError, match="joints has window 1 of 3 with every joint hidden, expected at least one"
    ):
        rough_placement(joints, seen, PERSON)


def noisy(seed=0, degrees_of_freedom=None, frames=20):
    """Evidence of a walk, some of it hidden, some trusted less."""
    rng = np.random.default_rng(seed)
    joints = walks(1, frames)[0] + 0.02 * rng.normal(size=(frames, 14, 3))
    confidence = rng.choice([0.0, 0.5, 1.0, 2.0], (frames, 14))
    joints[confidence == 0] = np.nan
    return Joints3D(joints, 0.03, confidence, degrees_of_freedom, PERSON, 30.0)


def test_windows_of_evidence_have_its_scales_and_nothing_of_what_hides():
    evidence, cut = noisy(), Stitching(20, 12, 4)
    body = np.random.default_rng(3).normal(size=(14, 3))
    windows = windows_of(evidence, body, PERSON, cut, 0.25)
    assert len(windows) == 2
    assert windows.joints.dtype == windows.noise.dtype == torch.float32
    for number, at in enumerate(cut.starts):
        part = slice(at, at + 12)
        seen = evidence.confidence[part] > 0
        np.testing.assert_array_equal(windows.seen[number], seen)
        wanted = evidence.entries.precision[part][seen] ** -0.5
        np.testing.assert_allclose(windows.noise[number][seen], wanted, rtol=1e-6)
        np.testing.assert_allclose(
            windows.joints[number][seen], evidence.joints[part][seen], rtol=1e-6
        )
        assert (windows.joints[number][~seen] == 0).all()
        assert (windows.noise[number][~seen] == 1).all()
        np.testing.assert_allclose(windows.bodies[number], body, rtol=1e-6)
    assert windows.tails.tolist() == [0.25, 0.25]
    many = windows.repeated(3)
    assert len(many) == 6
    for name in windows.__annotations__:
        assert torch.equal(getattr(many, name)[2:4], getattr(windows, name))
        assert torch.equal(getattr(windows.to(torch.device("cpu")), name), getattr(windows, name))


def test_joints_in_a_frame_are_turned_back_and_moved():
    joints = walks()
    windows = NoisyWindows.of(
        joints,
        np.full(joints.shape[:-1], 0.01),
        all_seen(joints),
        np.zeros(3),
        np.zeros((3, 14, 3)),
        PERSON,
    )
    rng = np.random.default_rng(4)
    heading, ground = torch.tensor(rng.normal(size=3)), torch.tensor(rng.normal(size=(3, 2)))
    there = turned_about_vertical(torch.tensor(joints), heading)
    there = there + on_ground(ground)[:, None, None, :]
    moved = NoisyWindows.of(
        there.numpy(),
        np.full(joints.shape[:-1], 0.01),
        all_seen(joints),
        np.zeros(3),
        np.zeros((3, 14, 3)),
        PERSON,
    )
    found = moved.in_frame(heading.float(), ground.float())
    np.testing.assert_allclose(found, joints, atol=1e-5)
    # In the frame that was roughly found, a motion begins near the origin and looks ahead.
    first = windows.in_frame(windows.heading, windows.ground)[:, :5, PELVIS]
    np.testing.assert_allclose(first.mean(1)[:, [0, 2]], 0, atol=1e-5)
    other = moved.in_frame(moved.heading, moved.ground)
    np.testing.assert_allclose(other, windows.in_frame(windows.heading, windows.ground), atol=1e-4)
