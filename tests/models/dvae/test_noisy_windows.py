"""Noisy joints: corruption, windows, placement and stitching."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats

from probmotion import Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.dvae.joint_noise import JointNoise
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
SHAPES = [(30, 10), (12, 0), (12, 11), (2, 1)]


def walks(n=3, frames=12):
    return np.stack(
        [make_gait("walk", number, frames=frames).retarget(PERSON).positions for number in range(n)]
    )


def all_seen(joints):
    return np.ones(joints.shape[:-1], dtype=bool)


def apart(angle, other):
    return (angle - other + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize(("window", "overlap"), SHAPES)
def test_windows_cover_motions_of_any_length_with_weights_summing_to_one(window, overlap):
    for frames in (1, 2, 5, 11, 12, 13, 30, 31, 57, 100):
        cut = Stitching(frames, window, overlap)
        assert cut.length == min(window, frames)
        assert cut.starts[0] == 0
        assert cut.starts[-1] + cut.length == frames
        # No gaps, and at least the requested overlap.
        assert all(0 < step <= window - overlap for step in np.diff(cut.starts))
        weights = cut.weights
        assert weights.shape == (len(cut.starts), cut.length)
        assert (weights > 0).all()
        np.testing.assert_allclose(cut.joined(weights[..., None]), 1, atol=1e-12)
    assert Stitching(window, window, overlap).starts == [0]


@pytest.mark.parametrize(("window", "overlap"), SHAPES)
@pytest.mark.parametrize("frames", [1, 5, 13, 100])
def test_mean_of_consistent_windows_is_the_motion(window, overlap, frames):
    cut = Stitching(frames, window, overlap)
    motion = np.random.default_rng(0).normal(size=(frames, 4, 3))
    windows = cut.cut(motion)
    assert windows.shape == (len(cut.starts), cut.length, 4, 3)
    np.testing.assert_allclose(cut.mean(windows), motion, atol=1e-12)
    many = np.stack([windows, 2 * windows])
    np.testing.assert_allclose(cut.mean(many), np.stack([motion, 2 * motion]), atol=1e-12)


@pytest.mark.parametrize("overlap", [4, 10, 20])
def test_blending_of_inconsistent_windows_is_smooth(overlap):
    """For two windows a metre apart, sin² ramps rise by at most π/2 per overlap."""
    cut = Stitching(60 - overlap, 30, overlap)
    assert len(cut.starts) == 2
    windows = np.zeros((2, 30, 1, 3))
    windows[1] = 1.0
    found = cut.mean(windows)[:, 0, 0]
    assert found[0] == 0
    assert found[-1] == pytest.approx(1)
    assert (np.diff(found) >= -1e-12).all()
    assert np.diff(found).max() < 0.5 * math.pi / (overlap + 1) + 1e-9
    np.testing.assert_allclose(found + found[::-1], 1, atol=1e-12)


@pytest.mark.parametrize(("frames", "window", "overlap"), [(50, 30, 10), (51, 30, 10), (45, 12, 5)])
def test_stitched_draws_preserve_the_variance(frames, window, overlap):
    cut, n = Stitching(frames, window, overlap), 20_000
    rng = np.random.default_rng(1)
    means = rng.normal(size=(len(cut.starts), cut.length, 1, 3))
    windows = means + 0.3 * rng.standard_normal((n, *means.shape))
    found = cut.draws(windows, means)
    assert found.shape == (n, frames, 1, 3)
    np.testing.assert_allclose(found.std(axis=0), 0.3, atol=5 * 0.3 / math.sqrt(2 * n))
    off = found.mean(axis=0) - cut.mean(means)
    assert abs(off).max() < 5 * 0.3 / math.sqrt(n)
    # A plain mean reduces the variance.
    assert cut.mean(windows).std(axis=0).min() < 0.25


def test_heading_is_perpendicular_to_left_right_pairs():
    joints = np.zeros((1, 3, 14, 3))
    for left, right in PERSON.mirrored_pairs:
        joints[:, :, left], joints[:, :, right] = [0.2, 1, 0], [-0.2, 1, 0]
    for angle in np.linspace(-3, 3, 7):
        turned = turned_about_vertical(joints, angle)
        heading, _ = rough_placement(turned, all_seen(joints), PERSON)
        assert heading[0] == pytest.approx(angle)


def test_placement_uses_the_first_visible_frames():
    joints = walks()
    seen = all_seen(joints)
    seen[:, :3] = False
    harmed = np.where(seen[..., None], joints, np.nan)
    heading, ground = rough_placement(harmed, seen, PERSON)
    later, there = rough_placement(joints[:, 3:], all_seen(joints)[:, 3:], PERSON)
    np.testing.assert_allclose(heading, later)
    np.testing.assert_allclose(ground, there)
    # A root occluded for four frames, and one that is never visible.
    seen = all_seen(joints)
    seen[:, :4, PELVIS] = False
    seen[2, :, PELVIS] = False
    heading, ground = rough_placement(np.where(seen[..., None], joints, 1e6), seen, PERSON)
    wanted = joints[:2, 4:9, PELVIS].mean(axis=1)
    np.testing.assert_allclose(ground[:2], wanted[:, [0, 2]])
    shown = np.delete(joints[2, :5], PELVIS, axis=1).mean(axis=(0, 1))
    np.testing.assert_allclose(ground[2], shown[[0, 2]])
    # Pairs with one occluded joint do not contribute to the heading.
    seen = all_seen(joints)
    seen[:, :, [PERSON.index("left_wrist"), PERSON.index("right_ankle")]] = False
    heading, _ = rough_placement(np.where(seen[..., None], joints, 1e6), seen, PERSON)
    whole, _ = rough_placement(joints, all_seen(joints), PERSON)
    assert abs(apart(heading, whole)).max() < 0.3


def test_window_without_visible_joints_is_rejected():
    joints = walks()
    seen = all_seen(joints)
    seen[1] = False
    with pytest.raises(
        ValueError,
        match="every window of joints must have a visible joint, got none in window 1 of 3",
    ):
        rough_placement(joints, seen, PERSON)


def noisy(seed=0, degrees_of_freedom=None, frames=20):
    """Return observations of a walk with occlusions and different confidences."""
    rng = np.random.default_rng(seed)
    joints = walks(1, frames)[0] + 0.02 * rng.normal(size=(frames, 14, 3))
    confidence = rng.choice([0.0, 0.5, 1.0, 2.0], (frames, 14))
    joints[confidence == 0] = np.nan
    return Joints3D(joints, 0.03, confidence, degrees_of_freedom, PERSON, 30.0)


def test_windows_contain_noise_scales_and_mask_occluded_joints():
    likelihood, cut = noisy(), Stitching(20, 12, 4)
    body = np.random.default_rng(3).normal(size=(14, 3))
    windows = windows_of(likelihood, body, PERSON, cut, 0.25)
    assert len(windows) == 2
    assert windows.joints.dtype == windows.noise.dtype == torch.float32
    for number, at in enumerate(cut.starts):
        part = slice(at, at + 12)
        seen = likelihood.confidence[part] > 0
        np.testing.assert_array_equal(windows.seen[number], seen)
        wanted = likelihood.entries.precision[part][seen] ** -0.5
        np.testing.assert_allclose(windows.noise[number][seen], wanted, rtol=1e-6)
        np.testing.assert_allclose(
            windows.joints[number][seen], likelihood.joints[part][seen], rtol=1e-6
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


def test_canonical_joints_invert_the_placement():
    joints = walks()
    other = (np.full(joints.shape[:-1], 0.01), all_seen(joints), np.zeros(3), np.zeros((3, 14, 3)))
    windows = NoisyWindows.of(joints, *other, PERSON)
    rng = np.random.default_rng(4)
    heading, ground = torch.tensor(rng.normal(size=3)), torch.tensor(rng.normal(size=(3, 2)))
    there = turned_about_vertical(torch.tensor(joints), heading)
    there = there + on_ground(ground)[:, None, None, :]
    moved = NoisyWindows.of(there.numpy(), *other, PERSON)
    found = moved.in_frame(heading.float(), ground.float())
    np.testing.assert_allclose(found, joints, atol=1e-5)
    # In the estimated frame, a motion starts close to the origin.
    first = windows.in_frame(windows.heading, windows.ground)[:, :5, PELVIS]
    np.testing.assert_allclose(first.mean(1)[:, [0, 2]], 0, atol=1e-5)
    again = moved.in_frame(moved.heading, moved.ground)
    np.testing.assert_allclose(again, windows.in_frame(windows.heading, windows.ground), atol=1e-4)


BODY = Skeleton(
    ["hips", "chest", "left_hand", "right_hand", "left_foot", "right_foot"], [-1, 0, 1, 1, 0, 0]
)


def test_noise_has_the_stated_distribution():
    joints = np.zeros((400, 10, 6, 3))
    noise = JointNoise(least=0.01, most=0.08, outliers=0.5, hidden=0.0)
    noisy = noise.apply(np.random.default_rng(0), joints, BODY)
    assert noisy.seen.all()
    unit = noisy.joints / noisy.noise[..., None]
    gaussian = noisy.tails == 0
    assert abs(gaussian.mean() - 0.5) < 5 * 0.5 / 20
    assert stats.kstest(unit[gaussian].ravel(), "norm").pvalue > 1e-4
    for tail, values in zip(noisy.tails[~gaussian][:5], unit[~gaussian], strict=False):
        assert 1 / 8 <= tail <= 1 / 2
        assert stats.kstest(values.ravel(), stats.t(1 / tail).cdf).pvalue > 1e-4
    logs = np.log(noisy.noise[:, 0, 0] / 0.01) / math.log(8)
    assert stats.kstest(logs, "uniform").pvalue > 1e-4
    occluded = JointNoise(hidden=1.0).apply(np.random.default_rng(0), joints, BODY)
    assert occluded.seen.any(axis=(1, 2)).all()
    assert 0.5 < occluded.seen.mean() < 0.95
    clean = JointNoise.nearly_clean().apply(np.random.default_rng(0), joints, BODY)
    assert clean.joints.std() == pytest.approx(5e-3, rel=0.02)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"least": 0.1}, "most must be at least least=0.1, got 0.08"),
        ({"outliers": 1.5}, "outliers must be between 0 and 1, got 1.5"),
        ({"least": 0.0}, "least must be a finite number above 0, got 0.0"),
        ({"most": math.inf}, "most must be a finite number above 0, got inf"),
        ({"hidden": math.nan}, "hidden must be between 0 and 1, got nan"),
    ],
)
def test_invalid_settings_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        JointNoise(**options)
