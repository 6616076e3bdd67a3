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


def walks(n=3, frames=12):
    return np.stack(
        [make_gait("walk", number, frames=frames).retarget(PERSON).positions for number in range(n)]
    )


def all_seen(joints):
    return np.ones(joints.shape[:-1], dtype=bool)


@pytest.mark.parametrize(("window", "overlap"), [(30, 10), (12, 0), (12, 11), (2, 1)])
def test_windows_cover_motions_of_any_length(window, overlap):
    """The weighted mean of consistent windows is the motion."""
    for frames in (1, 2, 5, 11, 12, 13, 30, 31, 57, 100):
        cut = Stitching(frames, window, overlap)
        assert cut.length == min(window, frames)
        assert cut.starts[0] == 0
        assert cut.starts[-1] + cut.length == frames
        # There are no gaps, and the overlap is at least the requested one.
        assert all(0 < step <= window - overlap for step in np.diff(cut.starts))
        assert (cut.weights > 0).all()
        motions = np.random.default_rng(0).normal(size=(2, frames, 4, 3))
        windows = np.stack([cut.cut(motion) for motion in motions])
        np.testing.assert_allclose(cut.mean(windows), motions, atol=1e-12)


@pytest.mark.parametrize("overlap", [4, 20])
def test_blending_of_inconsistent_windows_is_smooth(overlap):
    """For two windows a metre apart, sin² ramps rise by at most π/2 per overlap."""
    windows = np.zeros((2, 30, 1, 3))
    windows[1] = 1.0
    blended = Stitching(60 - overlap, 30, overlap).mean(windows)[:, 0, 0]
    assert blended[0] == 0
    steps = np.diff(blended)
    assert -1e-12 <= steps.min() < steps.max() < 0.5 * math.pi / (overlap + 1) + 1e-9
    np.testing.assert_allclose(blended + blended[::-1], 1, atol=1e-12)


@pytest.mark.parametrize(("frames", "window", "overlap"), [(51, 30, 10), (45, 12, 5)])
def test_stitched_draws_preserve_the_variance(frames, window, overlap):
    cut, n = Stitching(frames, window, overlap), 20_000
    rng = np.random.default_rng(1)
    means = rng.normal(size=(len(cut.starts), cut.length, 1, 3))
    windows = means + 0.3 * rng.standard_normal((n, *means.shape))
    draws = cut.draws(windows, means)
    np.testing.assert_allclose(draws.std(axis=0), 0.3, atol=5 * 0.3 / math.sqrt(2 * n))
    assert abs(draws.mean(axis=0) - cut.mean(means)).max() < 5 * 0.3 / math.sqrt(n)
    # A plain mean reduces the variance.
    assert cut.mean(windows).std(axis=0).min() < 0.25


def test_heading_is_perpendicular_to_left_right_pairs():
    joints = np.zeros((1, 3, 14, 3))
    for left, right in PERSON.mirrored_pairs:
        joints[:, :, left], joints[:, :, right] = [0.2, 1, 0], [-0.2, 1, 0]
    for angle in np.linspace(-3, 3, 7):
        rotated = turned_about_vertical(joints, angle)
        heading, _ = rough_placement(rotated, all_seen(joints), PERSON)
        assert heading[0] == pytest.approx(angle)


def test_placement_uses_the_first_visible_frames():
    joints, (seen, late, paired) = walks(), (all_seen(walks()) for _ in range(3))
    late[:, :3] = False
    placement = rough_placement(np.where(late[..., None], joints, np.nan), late, PERSON)
    np.testing.assert_allclose(placement[0], rough_placement(joints[:, 3:], seen[:, 3:], PERSON)[0])
    np.testing.assert_allclose(placement[1], rough_placement(joints[:, 3:], seen[:, 3:], PERSON)[1])
    # One root is occluded for four frames, and one is never visible.
    seen[:, :4, PELVIS] = False
    seen[2, :, PELVIS] = False
    _, ground = rough_placement(np.where(seen[..., None], joints, 1e6), seen, PERSON)
    roots = joints[:2, 4:9, PELVIS].mean(axis=1)
    visible = np.delete(joints[2, :5], PELVIS, axis=1).mean(axis=(0, 1))
    np.testing.assert_allclose(ground, [*roots[:, [0, 2]], visible[[0, 2]]])
    # Pairs with one occluded joint do not contribute to the heading.
    paired[:, :, [PERSON.index("left_wrist"), PERSON.index("right_ankle")]] = False
    heading, _ = rough_placement(np.where(paired[..., None], joints, 1e6), paired, PERSON)
    expected, _ = rough_placement(joints, all_seen(joints), PERSON)
    assert np.cos(heading - expected).min() > math.cos(0.3)
    seen[1] = False
    with pytest.raises(ValueError, match="must have a visible joint, got none in window 1 of 3"):
        rough_placement(joints, seen, PERSON)


def test_windows_contain_noise_scales_and_mask_occluded_joints():
    rng, cut = np.random.default_rng(0), Stitching(20, 12, 4)
    confidence = rng.choice([0.0, 0.5, 1.0, 2.0], (20, 14))
    joints = np.where(confidence[..., None] > 0, walks(1, 20)[0], np.nan)
    likelihood = Joints3D(joints, 0.03, confidence, None, PERSON, 30.0)
    body = rng.normal(size=(14, 3))
    windows = windows_of(likelihood, body, PERSON, cut, 0.25)
    assert len(windows) == 2
    for number, start in enumerate(cut.starts):
        part = slice(start, start + 12)
        seen = confidence[part] > 0
        np.testing.assert_array_equal(windows.seen[number], seen)
        noise = np.where(seen, 0.03 / np.sqrt(confidence[part].clip(0.5)), 1.0)
        np.testing.assert_allclose(windows.noise[number], noise, rtol=1e-6)
        np.testing.assert_allclose(
            windows.joints[number], np.where(seen[..., None], joints[part], 0), rtol=1e-6
        )
        np.testing.assert_allclose(windows.bodies[number], body, rtol=1e-6)
    assert windows.tails.tolist() == [0.25, 0.25]
    repeated = windows.repeated(3)
    for name in windows.__annotations__:
        assert torch.equal(getattr(repeated, name)[2:4], getattr(windows, name))


def test_canonical_joints_invert_the_placement():
    joints, rng = walks(), np.random.default_rng(4)
    other = (np.full(joints.shape[:-1], 0.01), all_seen(joints), np.zeros(3), np.zeros((3, 14, 3)))
    windows = NoisyWindows.of(joints, *other, PERSON)
    heading, ground = torch.tensor(rng.normal(size=3)), torch.tensor(rng.normal(size=(3, 2)))
    placed = turned_about_vertical(torch.tensor(joints), heading)
    placed = placed + on_ground(ground)[:, None, None, :]
    transformed = NoisyWindows.of(placed.numpy(), *other, PERSON)
    inverted = transformed.in_frame(heading.float(), ground.float())
    np.testing.assert_allclose(inverted, joints, atol=1e-5)
    # In the estimated frame, a motion starts close to the origin.
    canonical = windows.in_frame(windows.heading, windows.ground)
    np.testing.assert_allclose(canonical[:, :5, PELVIS].mean(1)[:, [0, 2]], 0, atol=1e-5)
    again = transformed.in_frame(transformed.heading, transformed.ground)
    np.testing.assert_allclose(again, canonical, atol=1e-4)


def test_noise_has_the_stated_distribution():
    joints = np.zeros((400, 10, 14, 3))

    def corrupted(noise):
        return noise.apply(np.random.default_rng(0), joints, PERSON)

    noisy = corrupted(JointNoise(least=0.01, most=0.08, outliers=0.5, hidden=0.0))
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
    occluded = corrupted(JointNoise(hidden=1.0))
    assert occluded.seen.any(axis=(1, 2)).all()
    assert 0.5 < occluded.seen.mean() < 0.95
    assert corrupted(JointNoise.nearly_clean()).joints.std() == pytest.approx(5e-3, rel=0.02)


def test_invalid_settings_are_rejected():
    for options, message in (
        ({"least": 0.1}, "most must be at least least=0.1, got 0.08"),
        ({"outliers": 1.5}, "outliers must be between 0 and 1, got 1.5"),
        ({"least": 0.0}, "least must be a finite number above 0, got 0.0"),
        ({"most": math.inf}, "most must be a finite number above 0, got inf"),
        ({"hidden": math.nan}, "hidden must be between 0 and 1, got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            JointNoise(**options)
