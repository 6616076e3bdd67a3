import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.lifting.keypoints import (
    LIMBS,
    PERSON,
    PersonKeypoints,
    averaged,
    body_path,
    person_keypoints,
    smooth_size,
)
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton


def track_of(pixels: np.ndarray, skeleton: Skeleton = PERSON) -> KeypointTrack:
    return KeypointTrack(pixels, np.ones(pixels.shape[:2]), skeleton, 30.0)


@pytest.fixture(scope="module")
def pixels() -> np.ndarray:
    """Orthographic keypoints of a walk, seen from the front, 200 pixels per metre."""
    positions = make_gait("walk", 1, frames=60).retarget(PERSON).positions
    return 200 * positions[..., :2] * [1.0, -1.0] + 500


@pytest.mark.parametrize("group", [("hip", "knee", "ankle"), ("shoulder", "elbow", "wrist")])
def test_exchanged_sides_are_repaired(pixels, group):
    sides = [[PERSON.joint_names.index(f"{s}_{g}") for g in group] for s in ("left", "right")]
    broken = pixels.copy()
    for frame in (11, 12, 30):
        broken[frame, sides[0] + sides[1]] = pixels[frame, sides[1] + sides[0]]
    found = person_keypoints(track_of(broken))
    assert np.allclose(found.points, pixels)
    assert found.swapped == pytest.approx(3 / 60 / 2)


def test_clean_keypoints_are_unchanged(pixels):
    found = person_keypoints(track_of(pixels))
    assert np.array_equal(found.points, pixels)
    assert found.swapped == 0


def test_neck_and_pelvis_of_detectors_are_not_used(pixels):
    body = Skeleton.preset("body25")
    points = np.zeros((60, body.n_joints, 2))
    for joint, name in enumerate(body.joint_names):
        if name in PERSON.joint_names:
            points[:, joint] = pixels[:, PERSON.joint_names.index(name)]
    found = person_keypoints(track_of(points, body))
    assert np.flatnonzero(found.weight.any(axis=0)).tolist() == LIMBS


def test_missing_limbs_are_named(pixels):
    kept = [j for j, name in enumerate(PERSON.joint_names) if "wrist" not in name]
    with pytest.raises(ValueError, match="without left_wrist, right_wrist"):
        person_keypoints(track_of(pixels[:, kept], PERSON.subset(kept)))


def test_averages_have_the_weights_of_frames():
    points = np.arange(5.0)[:, None, None] * np.ones((5, 1, 2))
    weight = np.array([1.0, 3.0, 0.0, 0.0, 1.0])[:, None]
    mean = averaged(PersonKeypoints(points, weight, 0.0), 2)
    assert mean.points[:, 0, 0].tolist() == [0.75, 0.0]
    assert mean.weight[:, 0].tolist() == [4.0, 0.0]


def test_size_is_that_of_the_image(pixels):
    weight = np.ones(pixels.shape[:2])
    path = body_path(PersonKeypoints(pixels, weight, 0.0))
    assert smooth_size(path.size) == pytest.approx(200, rel=0.1)
    assert np.abs(path.middle - pixels.mean(axis=1)).max() < 60
    # A body that recedes to twice the distance has half the size.
    growth = np.geomspace(1, 2, 60)[:, None, None]
    receding = body_path(PersonKeypoints((pixels - 500) / growth, weight, 0.0))
    line = smooth_size(receding.size)
    assert line[0] / line[-1] == pytest.approx(2, rel=0.1)


def test_frames_without_a_body_are_interpolated(pixels):
    weight = np.ones(pixels.shape[:2])
    weight[20:45] = 0
    path = body_path(PersonKeypoints(np.where(weight[..., None] > 0, pixels, 0), weight, 0.0))
    assert path.size == pytest.approx(200, rel=0.25)
    assert np.isfinite(path.middle).all()


def test_low_confidences_are_relative(pixels):
    track = KeypointTrack(pixels, np.full(pixels.shape[:2], 0.01), PERSON, 30.0)
    assert np.allclose(person_keypoints(track).weight, 1)
