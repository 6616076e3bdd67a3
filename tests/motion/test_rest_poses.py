"""Rest poses from 2D tracks: exact for rigid bodies, close to the 3D mean pose for walks."""

import numpy as np
import pytest

from probmotion import KeypointTrack, Skeleton
from probmotion.data.projections import project_clips
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.geometry.cameras import Cameras
from probmotion.models.bodies.body_states import rest_pose
from probmotion.motion.rest_poses import estimate_rest_pose

PERSON = Skeleton.preset("person14")
QUADRUPED = Skeleton.preset("apt36k17")
CHAIN = Skeleton(["a", "b", "c", "d", "e", "f"], [-1, 0, 1, 2, 3, 4])
AZIMUTHS = np.arange(12) * np.pi / 6


def standing(skeleton):
    """Symmetric mean pose of a walking person or quadruped."""
    style = "quadruped-walk" if skeleton == QUADRUPED else "walk"
    clips = [clip.retarget(skeleton) for clip in make_gaits(3, styles={style: 1.0})]
    rest = rest_pose(skeleton, [clip.positions for clip in clips])
    return (rest + rest[list(skeleton.mirrored_order)] * [-1, 1, 1]) / 2


def joints_of(skeleton, rest):
    return np.stack(
        [rest[[joint, *skeleton.ancestors(joint)]].sum(axis=0) for joint in range(len(rest))]
    )


def rigid_tracks(skeleton, rest, azimuths, occluded=None):
    """Orthographic projections of a static body, one frame per azimuth."""
    c, s = np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]
    x, y, z = joints_of(skeleton, rest).T
    keypoints = np.stack([c * x + s * z, -y + 0 * c], axis=-1) + 0.7
    confidence = np.ones(keypoints.shape[:2])
    if occluded is not None:
        confidence[occluded] = 0.2
        keypoints[occluded] = 9.0
    half = len(azimuths) // 2
    return [
        KeypointTrack(keypoints[part], confidence[part], skeleton, 30.0)
        for part in (slice(half), slice(half, None))
    ]


def errors(skeleton, estimate, truth):
    """Angles between bones in degrees, and errors of their lengths in percent."""
    joints = [joint for joint, _ in skeleton.bones]
    sizes = [np.linalg.norm(rest[joints], axis=-1) for rest in (estimate, truth)]
    cosine = (estimate * truth)[joints].sum(-1) / sizes[0] / sizes[1]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), 100 * (sizes[0] / sizes[1] - 1)


def estimate_and_truth(clips):
    truth = rest_pose(clips[0].skeleton, [clip.positions for clip in clips])
    return estimate_rest_pose(project_clips(clips, views=10)), truth


@pytest.mark.parametrize("skeleton", [PERSON, QUADRUPED], ids=["person", "quadruped"])
def test_rigid_body_is_recovered_exactly(skeleton):
    rest = standing(skeleton)
    estimate = estimate_rest_pose(rigid_tracks(skeleton, rest, 0.3 + AZIMUTHS))
    np.testing.assert_allclose(estimate, rest, atol=1e-12)
    # From random azimuths, the error decreases with their number.
    for n, bound in ((400, 0.05), (40000, 0.005)):
        azimuths = np.random.default_rng(0).uniform(0, 2 * np.pi, n)
        estimate = estimate_rest_pose(rigid_tracks(skeleton, rest, azimuths))
        assert abs(estimate - rest).max() < bound


def test_body_without_pairs_is_recovered_up_to_reflection():
    rest = np.vstack([np.zeros(3), 0.4 * np.random.default_rng(1).normal(size=(5, 3))])
    truth = joints_of(CHAIN, rest)
    for sign in (1.0, -1.0):
        tracks = rigid_tracks(CHAIN, rest * [sign, 1, 1], AZIMUTHS)
        joints = joints_of(CHAIN, estimate_rest_pose(tracks, front="d"))
        assert joints[3, 0] == pytest.approx(0, abs=1e-9)
        assert joints[3, 2] > 0
        assert joints[abs(joints[:, 0]).argmax(), 0] > 0
        np.testing.assert_allclose(joints[:, 1], truth[:, 1], atol=1e-9)
        distances = [np.linalg.norm(x[:, None] - x, axis=-1) for x in (joints, truth)]
        np.testing.assert_allclose(*distances, atol=1e-9)


@pytest.mark.parametrize(
    "swings", [{"knee": (0.3, -0.3), "ankle": (0.6, -0.6)}, {"wrist": (0.35, 0.35)}]
)
def test_movement_does_not_bias_the_mean_pose(swings):
    """Factors of all bones would mistake legs in antiphase, or arms in phase, for the pose."""
    rest, n = standing(PERSON), 6000
    rng = np.random.default_rng(2)
    azimuths, phase = rng.uniform(0, 2 * np.pi, (2, n, 1))
    positions = np.tile(joints_of(PERSON, rest), (n, 1, 1))
    for joint, sizes in swings.items():
        for side, size in zip(("left", "right"), sizes, strict=True):
            positions[:, [PERSON.index(f"{side}_{joint}")], 2] += size * np.sin(phase)
    x = positions[..., 0] * np.cos(azimuths) + positions[..., 2] * np.sin(azimuths)
    keypoints = np.stack([x, -positions[..., 1]], axis=-1)
    track = KeypointTrack(keypoints, np.ones((n, 14)), PERSON, 30.0)
    angles, _ = errors(PERSON, estimate_rest_pose([track]), rest)
    assert angles.max() < 3


def test_joints_of_low_confidence_are_ignored():
    rest = standing(PERSON)
    rng = np.random.default_rng(3)
    azimuths = rng.uniform(0, 2 * np.pi, 20000)
    tracks = rigid_tracks(PERSON, rest, azimuths, rng.random((20000, 14)) < 0.2)
    np.testing.assert_allclose(estimate_rest_pose(tracks), rest, atol=0.01)
    assert abs(estimate_rest_pose(tracks, threshold=0.1) - rest).max() > 0.1


# Bounds on mean and maximum angle in degrees and mean length error in percent. Measured on more
# clips: 2.2, 4.5, 1.6; 4.1, 6.4, 2.6; 1.0, 2.3, 2.6.
WALKS = [("walk", 3.3, 7.5, 2.0), ("quadruped-walk", 6.0, 10.0, 3.5), ("quadruped-trot", 3, 6, 3.5)]


@pytest.mark.parametrize(("style", "mean", "most", "percent"), WALKS)
def test_walks_with_detection_noise(style, mean, most, percent):
    clips = make_gaits(24, styles={style: 1.0}, frames=60)
    if style == "walk":
        clips = [clip.retarget(PERSON) for clip in clips]
    angles, lengths = errors(clips[0].skeleton, *estimate_and_truth(clips))
    assert angles.mean() < mean
    assert angles.max() < most
    assert abs(lengths).mean() < percent
    assert abs(lengths).max() < 10


def test_elevation_shortens_heights_by_its_cosine():
    rest = standing(PERSON)
    for elevation in (0.0, np.pi / 16):
        images = Cameras.around(np.arange(24) * np.pi / 12, elevation).project(
            joints_of(PERSON, rest)[None]
        )
        tracks = [KeypointTrack(image, np.ones((1, 14)), PERSON, 30.0) for image in images]
        angles, lengths = errors(PERSON, estimate_rest_pose(tracks), rest)
        assert angles.max() < (1e-4 if elevation == 0 else 1.0)
        assert lengths.min() == pytest.approx(100 * (np.cos(elevation) - 1), abs=0.2)


def test_front_resolves_the_reflection():
    skeleton = Skeleton(["m", "left_n", "right_n", "o"], [-1, 0, 0, 0])
    rest = np.array([[0, 0, 0], [0.2, 0.1, -0.1], [-0.2, 0.1, -0.1], [0, 0.3, 0.4]])
    tracks = rigid_tracks(skeleton, rest, AZIMUTHS)
    np.testing.assert_allclose(estimate_rest_pose(tracks, front="o"), rest, atol=1e-9)
    reflected = rest * [1, 1, -1]
    np.testing.assert_allclose(estimate_rest_pose(tracks, front="left_n"), reflected, atol=1e-9)
    for front in (None, "m"):
        with pytest.raises(ValueError, match=f"front must be a joint in front .* got {front!r}"):
            estimate_rest_pose(tracks, front=front)
    with pytest.raises(ValueError, match=r"front must be one of m, .*, got 'beak'"):
        estimate_rest_pose(tracks, front="beak")


def without(*wrists):
    """Tracks of a person without the given wrists in one half of the frames each."""
    occluded = np.zeros((12, 14), bool)
    for half, wrist in zip((slice(6), slice(6, None)), wrists, strict=True):
        occluded[half, PERSON.index(f"{wrist}_wrist")] = True
    return rigid_tracks(PERSON, standing(PERSON), AZIMUTHS, occluded)


def degenerate(joint=None, scale=(1, 1, 1)):
    rest = standing(PERSON) * scale
    if joint is not None:
        rest[PERSON.index(joint)] = 0
    return rigid_tracks(PERSON, rest, AZIMUTHS)


def unit_tracks(names, parents):
    skeleton = Skeleton(names, parents)
    return rigid_tracks(skeleton, np.ones((len(names), 3)), AZIMUTHS)


@pytest.mark.parametrize(
    ("tracks", "message"),
    [
        (list, "tracks must contain at least one track, got none"),
        (lambda: [*degenerate(), *unit_tracks(["a", "b"], [-1, 0])], "tracks must share one skel"),
        (lambda: unit_tracks(["a", "b"], [-1, 0]), "front must be a joint in front of the root"),
        (lambda: unit_tracks(["a", "b"], [-1, -1]), "one root and bones, got 2 roots and 0"),
        (lambda: unit_tracks(["a"], [-1]), "one root and bones, got 1 roots and 0 bones"),
        (lambda: unit_tracks(["a", "left_b", "right_b", "c"], [-1, 0, 3, 0]), "bilaterally symm"),
        (lambda: without("left", "left"), "got none for the bones to .*left_wrist"),
        (lambda: without("left", "right"), "the bones to left_wrist and right_wrist"),
        # A degenerate bone is not replaced by its counterpart.
        (lambda: degenerate("right_wrist"), "mean direction .* the bone to right_wrist"),
        (lambda: degenerate("left_wrist"), "mean direction .* the bone to left_wrist"),
        (lambda: degenerate(scale=(0, 1, 1)), "hips or shoulders of nonzero width"),
    ],
)
def test_invalid_tracks_are_refused(tracks, message):
    with pytest.raises(ValueError, match=message):
        estimate_rest_pose(tracks())
