"""Likelihood of a recording: conversion, warnings and errors."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from probmotion import Joints3D, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.posteriors.noisy_joints import noisy_joints

PERSON = Skeleton.preset("person14")


@dataclass(frozen=True)
class Prior:
    skeleton: Skeleton = PERSON
    frames: int = 30
    fps: float = 30.0
    dim: int = 1

    def motion(self, theta):
        raise NotImplementedError


class Standing(Prior):
    """A prior with a floor and networks over windows of 12 frames."""

    floor = 0.0
    settings = SimpleNamespace(frames=12)


def walk(frames=40, fps=30.0):
    return make_gait("walk", frames=frames, fps=fps).retarget(PERSON).positions.copy()


def likelihood_of(joints, **options):
    given = {"prior": Prior(), "noise": 0.03, "fps": 30.0, "skeleton": PERSON} | options
    return noisy_joints(joints, **given)


@pytest.fixture
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_matching_recordings_are_unchanged():
    joints = walk()
    confidence = np.random.default_rng(0).uniform(0.1, 2.0, (40, 14))
    found = likelihood_of(joints, confidence=confidence, degrees_of_freedom=4.0)
    np.testing.assert_array_equal(found.joints, joints)
    np.testing.assert_array_equal(found.confidence, confidence)
    assert (found.noise, found.degrees_of_freedom) == (0.03, 4.0)
    assert (found.skeleton, found.fps, found.frames) == (PERSON, 30.0, 40)


def test_nan_joints_are_occluded():
    joints = walk()
    joints[4:9, 3] = np.nan
    confidence = np.full((40, 14), 2.0)
    confidence[20, 5] = 0.0
    found = likelihood_of(joints, confidence=confidence)
    occluded = np.zeros((40, 14), bool)
    occluded[4:9, 3] = occluded[20, 5] = True
    np.testing.assert_array_equal(found.confidence, np.where(occluded, 0.0, 2.0))
    assert (confidence == 2).sum() == 40 * 14 - 1  # arguments are not modified


@pytest.mark.parametrize(
    ("value", "axes", "message"),
    [
        (np.nan, [1], r"NaN in only some coordinates at frame 6, joint 2 \(left_should"),
        (np.nan, [0, 2], "NaN in only some coordinates at frame 6"),
        (np.inf, [0], "infinite values at frame 6, joint 2"),
        (-np.inf, [0, 1, 2], "infinite values at frame 6, joint 2"),
    ],
)
def test_partly_invalid_joints_are_rejected(value, axes, message):
    joints = walk()
    joints[6, 2, axes] = value
    with pytest.raises(ValueError, match=message):
        likelihood_of(joints)


def test_fully_occluded_frames():
    joints = walk()
    joints[5:35] = np.nan
    with pytest.raises(ValueError, match="any 30 consecutive frames, got none in the 30 frames fr"):
        likelihood_of(joints)
    for options in ({"longest_gap": 31}, {"prior": Prior(frames=31)}):
        with pytest.warns(UserWarning, match="occluded in 30 of 40 frames") as caught:
            found = likelihood_of(joints, **options)
        assert [warning.filename for warning in caught] == [__file__]
        assert (found.confidence.sum(axis=1) == 0).sum() == 30
    confidence = np.ones((40, 14))
    confidence[35:] = 0.0
    with pytest.raises(ValueError, match=r"any 5 .* the 5 frames from frame 35"):
        likelihood_of(walk(), confidence=confidence, longest_gap=5)
    with pytest.raises(ValueError, match="got every frame occluded"):
        likelihood_of(np.full((10, 14, 3), np.nan))


def test_the_longest_gap_is_the_window_of_the_networks_by_default():
    joints = walk()
    joints[5:17] = np.nan
    with pytest.raises(ValueError, match=r"any 12 .* the 12 frames from frame 5"):
        likelihood_of(joints, prior=Standing())
    for options in ({"longest_gap": 13}, {"prior": Prior()}):
        with pytest.warns(UserWarning, match="12 of 40 frames"):
            likelihood_of(joints, **({"prior": Standing()} | options))


@pytest.mark.parametrize(
    ("scale", "unit"),
    [(1000.0, "millimetres"), (100.0, "centimetres"), (39.37, "inches"), (0.001, "kilometres")],
)
def test_implausible_sizes_suggest_a_unit(scale, unit):
    joints = walk() * scale
    with pytest.warns(UserWarning, match=f"implausible in metres; are these {unit}") as caught:
        found = likelihood_of(joints, noise=0.03 * scale)
    np.testing.assert_array_equal(found.joints, joints)
    # The longest chain is from the pelvis to a wrist: .5 + .175 + .29 + .25 m.
    size = float(str(caught[0].message).partition("bones is ")[2].split()[0])
    assert size == pytest.approx(1.2146 * scale, rel=0.01)


def test_sizes_without_a_matching_unit():
    with pytest.warns(UserWarning, match="implausible in metres$"):
        likelihood_of(walk() * 1e-6)
    with pytest.raises(ValueError, match="joints must be distinct"):
        likelihood_of(np.ones((40, 14, 3)))


@pytest.mark.usefixtures("no_warnings")
def test_plausible_recordings_give_no_warnings():
    for scale in (0.45, 1.0, 1.5):
        likelihood_of(walk() * scale)
    joints = Joints3D.observe(make_gait("walk", frames=40).retarget(PERSON), 0.1, 0).joints.copy()
    joints[:, 2:5] = np.nan
    likelihood_of(joints, noise=0.1)
    likelihood_of(walk(), prior=Standing())
    likelihood_of(walk() + np.array([0.0, 3.0, 0.0]))  # no floor
    joints = walk()
    joints[:, [10, 13]] = np.nan  # the lowest joints are the knees
    likelihood_of(joints, prior=Standing())


def test_resampling_on_request():
    joints = walk(81, 60.0)
    with pytest.raises(ValueError, match="fps must be the prior's 30, got 60; pass resample=True"):
        likelihood_of(joints, fps=60.0)
    found = likelihood_of(joints, fps=60.0, resample=True)
    assert found.fps == 30.0
    np.testing.assert_allclose(found.joints, joints[::2], atol=1e-12)
    # 29.97 is another rate; rounded frame times of 0.03333 s are not.
    with pytest.raises(ValueError, match=r"got 29\.97"):
        likelihood_of(joints[:40], fps=29.97)
    assert likelihood_of(joints[:40], fps=1 / 0.03333).fps == 30.0
    # Occluded frames are counted after resampling: frames 10 to 29 of 51.
    joints = walk(101, 60.0)
    joints[20:60] = np.nan
    with pytest.warns(UserWarning, match="20 of 51 frames"):
        likelihood_of(joints, fps=60.0, resample=True)


def test_joints_are_mapped_by_name():
    whole = make_gait("walk", frames=40)
    names = whole.skeleton.joint_names
    kept = [j for j, name in enumerate(names) if name not in ("pelvis", "neck", "spine")]
    source = whole.skeleton.subset(kept)
    joints = whole.positions[:, kept].copy()
    joints[5, source.index("left_hip")] = np.nan
    found = likelihood_of(joints, skeleton=source)
    assert found.skeleton == PERSON
    hips = [source.index("left_hip"), source.index("right_hip")]
    seen = np.arange(40) != 5
    np.testing.assert_allclose(found.joints[seen, 0], joints[seen][:, hips].mean(axis=1))
    assert found.confidence[5, 0] == 0
    np.testing.assert_array_equal(found.joints[:, 13], joints[:, source.index("right_ankle")])
    arms = [j for j in range(source.n_joints) if "knee" not in source.joint_names[j]]
    with pytest.raises(ValueError, match="left_knee, right_knee"):
        likelihood_of(joints[:, arms], skeleton=source.subset(arms))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joints": np.zeros((40, 3, 3))}, "joints must have shape"),
        ({"joints": np.zeros((0, 14, 3))}, "joints must have at least one frame"),
        ({"confidence": np.ones((40, 3))}, "confidence must have shape"),
        ({"confidence": np.full((40, 14), -1.0)}, "confidence must be at least 0, got -1"),
        ({"confidence": np.full((40, 14), np.nan)}, "confidence must be finite, got 560 values"),
        ({"noise": "3 cm"}, "noise must be a finite number above 0, got '3 cm'"),
        ({"skeleton": "person14"}, "skeleton must be a Skeleton, got str"),
        ({"prior": "body-dvae"}, "prior must be a MotionPrior, got str"),
        ({"degrees_of_freedom": 0.0}, "degrees_of_freedom must be a finite number above 0"),
        ({"fps": 0.0}, "fps must be a finite number above 0"),
        ({"longest_gap": 0}, "longest_gap must be an integer of at least 1"),
    ],
)
def test_invalid_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        likelihood_of(**({"joints": walk()} | options))


@pytest.mark.parametrize("height", [3.0, -0.8])
def test_distance_from_the_floor(height):
    joints = walk() + np.array([0.0, height, 0.0])
    joints[0, 10] = [0.0, -9.0, 0.0]  # a single outlier is ignored
    lowest = np.quantile(joints[1:, :, 1].min(axis=1), 0.05)
    with pytest.warns(UserWarning, match="is Y up and the floor at that height") as caught:
        found = likelihood_of(joints, prior=Standing())
    value = str(caught[0].message).removeprefix("the lowest joints are at ").split()[0]
    assert float(value) == pytest.approx(lowest, abs=0.06)
    np.testing.assert_array_equal(found.joints, joints)


def test_noise_in_another_unit():
    with pytest.warns(UserWarning, match=r"^noise is 30 m, more than .* is it in metres"):
        assert likelihood_of(walk(), noise=30.0).noise == 30.0


@pytest.mark.parametrize(
    ("change", "axis"),
    [
        (lambda joints: joints[..., [0, 2, 1]], "Z"),
        (lambda joints: joints[..., [1, 0, 2]], "X"),
        (lambda joints: joints * [1, -1, 1], "-Y"),
    ],
)
def test_bodies_along_another_axis_than_y(change, axis):
    with pytest.warns(UserWarning, match=f"stands along {axis}, but Y must be up"):
        likelihood_of(change(walk()))
