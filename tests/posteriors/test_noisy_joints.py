"""From a user's recording to evidence: each doubt is a sentence, nothing changes silently."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from probmotion import Joints3D, Motion, Skeleton
from probmotion.data.synthetic.gaits import make_gait
from probmotion.posteriors.noisy_joints import noisy_joints

PERSON = Skeleton.preset("person14")


@dataclass(frozen=True)
class Prior:
    """All that evidence is made for; it says nothing about motions."""

    skeleton: Skeleton = PERSON
    frames: int = 30
    fps: float = 30.0
    dim: int = 1

    def motion(self, theta: Any) -> Any:
        raise NotImplementedError


class Standing(Prior):
    """One of bodies on a floor, read by networks in windows of 12 frames."""

    floor = 0.0
    settings = SimpleNamespace(frames=12)


def walk(frames: int = 40, fps: float = 30.0) -> Motion:
    return make_gait("walk", frames=frames, fps=fps).retarget(PERSON)


def evidence(joints: np.ndarray, **options: Any) -> Joints3D:
    settings: dict[str, Any] = {
        "prior": Prior(),
        "noise": 0.03,
        "fps": 30.0,
        "skeleton": PERSON,
    } | options
    return noisy_joints(joints, settings.pop("skeleton"), settings.pop("fps"), **settings)


def test_a_recording_that_fits_is_taken_as_it_is() -> None:
    motion = walk()
    confidence = np.random.default_rng(0).uniform(0.1, 2.0, (40, 14))
    found = evidence(motion.positions, confidence=confidence, degrees_of_freedom=4.0)
    np.testing.assert_array_equal(found.joints, motion.positions)
    np.testing.assert_array_equal(found.confidence, confidence)
    assert (found.noise, found.degrees_of_freedom) == (0.03, 4.0)
    assert (found.skeleton, found.fps, found.frames) == (PERSON, 30.0, 40)
    wanted = Joints3D(motion.positions, 0.03, confidence, 4.0, PERSON, 30.0)
    moved = motion.positions + 0.01
    assert found.log_density(moved) == wanted.log_density(moved)


def test_nan_joints_are_hidden() -> None:
    joints = walk().positions.copy()
    joints[4:9, 3] = np.nan
    confidence = np.full((40, 14), 2.0)
    confidence[20, 5] = 0.0
    found = evidence(joints, confidence=confidence)
    assert found.confidence is not None
    hidden = np.zeros((40, 14), bool)
    hidden[4:9, 3] = hidden[20, 5] = True
    np.testing.assert_array_equal(found.confidence, np.where(hidden, 0.0, 2.0))
    # What is given is left as it was.
    assert confidence.min() == 0
    assert (confidence == 2).sum() == 40 * 14 - 1


@pytest.mark.parametrize(
    ("value", "axes", "message"),
    [
        (np.nan, [1], r"NaN in some coordinates but not in all at frame 6, joint 2 \(left_should"),
        (np.nan, [0, 2], "NaN in some coordinates but not in all at frame 6"),
        (np.inf, [0], "joints is infinite at frame 6, joint 2"),
        (-np.inf, [0, 1, 2], "joints is infinite at frame 6, joint 2"),
    ],
)
def test_half_a_joint_is_no_hidden_one(value: float, axes: list[int], message: str) -> None:
    joints = walk().positions.copy()
    joints[6, 2, axes] = value
    with pytest.raises(ValueError, match=message) as error:
        evidence(joints)
    assert "\n" not in str(error.value)


def test_frames_without_a_joint_are_allowed_and_said() -> None:
    joints = walk().positions.copy()
    joints[3] = joints[10:39] = np.nan
    with pytest.warns(UserWarning, match="all hidden in 30 of 40 frames") as caught:
        found = evidence(joints)
    assert len(caught) == 1
    assert caught[0].filename == __file__.replace(".pyc", ".py")
    assert found.confidence is not None
    assert (found.confidence.sum(axis=1) == 0).sum() == 30


def test_a_window_without_a_joint_is_refused() -> None:
    joints = walk().positions.copy()
    joints[5:35] = np.nan
    with pytest.raises(ValueError, match="all hidden in the 30 frames from frame 5, expected one"):
        evidence(joints)
    with pytest.warns(UserWarning, match="30 of 40"):
        evidence(joints, longest_gap=31)
    with pytest.warns(UserWarning, match="30 of 40"):
        evidence(joints, prior=Prior(frames=31))
    shorter = walk().positions
    confidence = np.ones((40, 14))
    confidence[35:] = 0.0
    with pytest.raises(ValueError, match=r"the 5 frames from frame 35, expected one .* any 5 fr"):
        evidence(shorter, confidence=confidence, longest_gap=5)
    with pytest.raises(ValueError, match="hidden in every frame"):
        evidence(np.full((10, 14, 3), np.nan))


@pytest.mark.parametrize(
    ("scale", "unit"),
    [(1000.0, "millimetres"), (100.0, "centimetres"), (39.37, "inches"), (0.001, "kilometres")],
)
def test_other_units_than_metres_are_said_and_kept(scale: float, unit: str) -> None:
    joints = walk().positions * scale
    with pytest.warns(UserWarning, match=f"no size in metres; are these {unit}") as caught:
        found = evidence(joints, noise=0.03 * scale)
    np.testing.assert_array_equal(found.joints, joints)
    # The longest chain is from the pelvis to a wrist: .5 + .175 + .29 + .25 m.
    size = float(str(caught[0].message).partition("bones is ")[2].split()[0])
    assert size == pytest.approx(1.2146 * scale, rel=0.01)


def test_a_size_of_no_unit_is_said_without_a_guess() -> None:
    with pytest.warns(UserWarning, match="which is no size in metres$"):
        evidence(walk().positions * 1e-6)
    with pytest.raises(ValueError, match="joints are all in one place"):
        evidence(np.ones((40, 14, 3)))


def test_children_and_giants_are_no_doubt() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scale in (0.45, 1.0, 1.5):
            evidence(walk().positions * scale)
        # Nor is noise or a hidden limb.
        joints = Joints3D.observe(walk(), 0.1, 0).joints.copy()
        joints[:, 2:5] = np.nan
        evidence(joints, noise=0.1)


def test_another_rate_is_refused_unless_asked_for() -> None:
    motion = walk(81, 60.0)
    with pytest.raises(ValueError, match="fps is 60, expected 30, the prior's; give resample=Tr"):
        evidence(motion.positions, fps=60.0)
    found = evidence(motion.positions, fps=60.0, resample=True)
    assert found.fps == 30.0
    np.testing.assert_allclose(found.joints, motion.positions[::2], atol=1e-12)
    # Television's 29.97 is another rate; one that a file rounds to .03333 s a frame is not.
    with pytest.raises(ValueError, match=r"fps is 29\.97"):
        evidence(motion.positions[:40], fps=29.97)
    assert evidence(motion.positions[:40], fps=1 / 0.03333).fps == 30.0


def test_hidden_frames_are_counted_at_the_priors_rate() -> None:
    joints = walk(101, 60.0).positions.copy()
    joints[20:60] = np.nan  # frames 10 to 29 of 51, and no neighbour of others
    with pytest.warns(UserWarning, match="20 of 51 frames"):
        evidence(joints, fps=60.0, resample=True)


def test_another_skeleton_is_taken_by_names() -> None:
    whole = make_gait("walk", frames=40)
    names = whole.skeleton.joint_names
    kept = [j for j, name in enumerate(names) if name not in ("pelvis", "neck", "spine")]
    source = whole.skeleton.subset(kept)
    joints = whole.positions[:, kept].copy()
    joints[5, source.index("left_hip")] = np.nan
    found = evidence(joints, skeleton=source)
    assert found.skeleton == PERSON
    assert found.confidence is not None
    hips = [source.index("left_hip"), source.index("right_hip")]
    seen = np.arange(40) != 5
    np.testing.assert_allclose(found.joints[seen, 0], joints[seen][:, hips].mean(axis=1))
    assert found.confidence[5, 0] == 0
    np.testing.assert_array_equal(found.joints[:, 13], joints[:, source.index("right_ankle")])
    arms = [j for j in range(source.n_joints) if "knee" not in source.joint_names[j]]
    with pytest.raises(ValueError, match="lacks left_knee, right_knee, expected the prior's"):
        evidence(joints[:, arms], skeleton=source.subset(arms))


def test_shapes_and_numbers_are_checked() -> None:
    joints = walk().positions
    for options, message in (
        ({"joints": joints[:, :3]}, "joints has shape"),
        ({"joints": joints[:0]}, "joints has no frame"),
        ({"confidence": np.ones((40, 3))}, "confidence has shape"),
        ({"confidence": np.full((40, 14), -1.0)}, "confidence is -1 at its least"),
        (
            {"confidence": np.full((40, 14), np.nan)},
            "confidence must be finite, got 560 values that are NaN",
        ),
        ({"noise": 0.0}, "noise is 0"),
        ({"noise": None}, "noise must be a finite number above 0, got None"),
        ({"noise": "3 cm"}, "noise is '3 cm', expected a finite number above 0"),
        ({"skeleton": "person14"}, "skeleton must be a Skeleton, got str"),
        ({"prior": "body-dvae"}, "prior must be a MotionPrior, got str"),
        ({"degrees_of_freedom": 0.0}, "degrees_of_freedom is 0"),
        ({"fps": 0.0}, "fps is 0"),
        ({"longest_gap": 0}, "longest_gap is 0"),
    ):
        with pytest.raises(ValueError, match=message):
            evidence(**({"joints": joints} | options))


@pytest.mark.parametrize("height", [3.0, -0.8])
def test_a_floor_elsewhere_than_the_prior_s_is_said(height: float) -> None:
    joints = walk().positions + np.array([0.0, height, 0.0])
    joints[0, 10] = [0.0, -9.0, 0.0]  # one frame's outlier is not the floor
    lowest = np.quantile(joints[1:, :, 1].min(axis=1), 0.05)
    with pytest.warns(UserWarning, match="; is the world's Y up, its floor at 0") as caught:
        found = evidence(joints, prior=Standing())
    said = str(caught[0].message).removeprefix("the lowest joints are at ").partition(" m, and")[0]
    assert float(said) == pytest.approx(lowest, abs=0.06)
    np.testing.assert_array_equal(found.joints, joints)
    assert [caught[0].filename, len(caught)] == [__file__.replace(".pyc", ".py"), 1]


def test_hidden_feet_and_priors_without_a_floor_are_no_doubt() -> None:
    joints = walk().positions.copy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evidence(joints, prior=Standing())
        evidence(joints + np.array([0.0, 3.0, 0.0]))
        joints[:, [10, 13]] = np.nan  # the lowest are then the knees
        evidence(joints, prior=Standing())


def test_noise_in_another_unit_is_said() -> None:
    with pytest.warns(UserWarning, match=r"^noise is 30 m, more than .*; is it in metres, as"):
        assert evidence(walk().positions, noise=30.0).noise == 30.0


def test_no_gap_is_as_long_as_the_networks_window() -> None:
    joints = walk().positions.copy()
    joints[5:17] = np.nan
    with pytest.raises(ValueError, match=r"the 12 frames from frame 5, expected one .* any 12 fr"):
        evidence(joints, prior=Standing())
    for options in ({"longest_gap": 13}, {"prior": Prior()}):
        with pytest.warns(UserWarning, match="12 of 40 frames"):
            evidence(joints, **({"prior": Standing()} | options))


@pytest.mark.parametrize(("axes", "named"), [([0, 2, 1], "Z"), ([1, 0, 2], "X")])
def test_a_body_that_stands_along_another_axis_is_said(axes: list[int], named: str) -> None:
    joints = walk().positions[..., axes]
    with pytest.warns(UserWarning, match=f"stands along {named}, expected Y to be up"):
        found = evidence(joints)
    np.testing.assert_array_equal(found.joints, joints)
    with pytest.warns(UserWarning, match="stands along -Y"):
        evidence(walk().positions * [1, -1, 1])
