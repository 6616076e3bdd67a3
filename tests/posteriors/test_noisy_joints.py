"""Likelihood of a recording: conversion, warnings and errors."""

from __future__ import annotations

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


def test_matching_recordings_are_unchanged():
    joints = walk()
    joints[4:9, 3] = np.nan
    confidence = np.random.default_rng(0).uniform(0.1, 2.0, (40, 14))
    given = confidence.copy()
    likelihood = likelihood_of(joints, confidence=given, degrees_of_freedom=4.0)
    np.testing.assert_array_equal(given, confidence)
    occluded = np.isnan(joints).all(axis=-1)
    np.testing.assert_array_equal(likelihood.confidence, np.where(occluded, 0.0, confidence))
    np.testing.assert_array_equal(likelihood.joints[~occluded], joints[~occluded])
    assert (likelihood.noise, likelihood.degrees_of_freedom) == (0.03, 4.0)
    assert (likelihood.skeleton, likelihood.fps, likelihood.frames) == (PERSON, 30.0, 40)


def test_fully_occluded_frames():
    joints = walk()
    joints[5:35] = np.nan
    with pytest.raises(ValueError, match="any 30 consecutive frames, got none in the 30 frames fr"):
        likelihood_of(joints)
    for options in ({"longest_gap": 31}, {"prior": Prior(frames=31)}):
        with pytest.warns(UserWarning, match="occluded in 30 of 40 frames") as caught:
            likelihood = likelihood_of(joints, **options)
        assert [warning.filename for warning in caught] == [__file__]
        assert (likelihood.confidence.sum(axis=1) == 0).sum() == 30
    confidence = np.ones((40, 14))
    confidence[28:] = 0.0
    with pytest.raises(ValueError, match=r"any 12 .* the 12 frames from frame 28"):
        likelihood_of(walk(), confidence=confidence, prior=Standing())  # the networks' window
    with pytest.warns(UserWarning, match="12 of 40 frames"):
        likelihood_of(walk(), confidence=confidence, prior=Standing(), longest_gap=13)


def lifted(height):
    joints = walk() + np.array([0.0, height, 0.0])
    joints[0, 10] = [0.0, -9.0, 0.0]  # a single outlier is ignored
    return joints


# The longest chain is from the pelvis to a wrist: .5 + .175 + .29 + .25 m.
@pytest.mark.parametrize(
    ("joints", "options", "message"),
    [
        (walk() * 1e3, {"noise": 30}, "is 121[0-9] long, implausible in metres; are these mill"),
        (walk() * 100, {"noise": 3}, "is 121.* long, implausible in metres; are these centim"),
        (walk() * 39.37, {}, "is 47.* long, implausible in metres; are these inches"),
        (walk() / 1e3, {}, "is 0.00121.* long, implausible in metres; are these kilometres"),
        (walk() / 1e6, {}, "implausible in metres$"),
        (walk(), {"noise": 30.0}, "^noise is 30 m, larger than .* is it in metres"),
        (walk()[..., [0, 2, 1]], {}, "aligned with Z, but Y must be up"),
        (walk()[..., [1, 0, 2]], {}, "aligned with X, but Y must be up"),
        (walk() * [1, -1, 1], {}, "aligned with -Y, but Y must be up"),
        (lifted(3.0), {"prior": Standing()}, "joints are at 3.* is Y up and the floor at that h"),
        (lifted(-0.8), {"prior": Standing()}, "joints are at -0.[78].* is Y up and the floor"),
    ],
)
def test_implausible_recordings_give_a_warning(joints, options, message):
    with pytest.warns(UserWarning, match=message):
        likelihood = likelihood_of(joints, **options)
    np.testing.assert_array_equal(likelihood.joints, joints)


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
    likelihood = likelihood_of(joints, fps=60.0, resample=True)
    assert likelihood.fps == 30.0
    np.testing.assert_allclose(likelihood.joints, joints[::2], atol=1e-12)
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
    motion = make_gait("walk", frames=40)
    joints = motion.positions.copy()
    joints[5, motion.skeleton.index("left_hip")] = np.nan
    likelihood = likelihood_of(joints, skeleton=motion.skeleton)
    wanted = motion.retarget(PERSON).positions
    occluded = np.argwhere(likelihood.confidence == 0)
    assert occluded.tolist() == [[5, PERSON.index("left_hip")]]
    seen = likelihood.confidence > 0
    np.testing.assert_allclose(likelihood.joints[seen], wanted[seen])


def invalid(value, axes):
    joints = walk()
    joints[6, 2, axes] = value
    return joints


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joints": np.zeros((40, 3, 3))}, "joints must have shape"),
        ({"joints": np.zeros((0, 14, 3))}, "joints must have at least one frame"),
        ({"joints": np.ones((40, 14, 3))}, "joints must be distinct"),
        ({"joints": np.full((10, 14, 3), np.nan)}, "in at least one frame, got none"),
        (
            {"joints": invalid(np.nan, [1])},
            r"NaN in only some .* at frame 6, joint 2 \(left_should",
        ),
        ({"joints": invalid(np.inf, [0])}, "infinite values at frame 6, joint 2"),
        ({"confidence": np.ones((40, 3))}, "confidence must have shape"),
        ({"confidence": np.full((40, 14), -1.0)}, "confidence must be at least 0, got -1"),
        ({"noise": "3 cm"}, "noise must be a finite number above 0, got '3 cm'"),
        ({"skeleton": "person14"}, "skeleton must be a Skeleton, got str"),
        ({"prior": "body-dvae"}, "prior must be a MotionPrior, got str"),
        ({"fps": 0.0}, "fps must be a finite number above 0"),
        ({"longest_gap": 0}, "longest_gap must be an integer of at least 1"),
    ],
)
def test_invalid_arguments(options, message):
    with pytest.raises(ValueError, match=message):
        likelihood_of(**({"joints": walk()} | options))
