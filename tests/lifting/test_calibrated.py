"""Lifts of several calibrated cameras, and of one."""

from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.geometry.cameras import Cameras
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.keypoints.calibration import Calibration
from probmotion.io.recordings import read_recording
from probmotion.lifting import lift
from probmotion.lifting.calibrated import calibrated_views
from probmotion.lifting.camera import LevelCamera, LevelCameras
from probmotion.lifting.keypoints import PERSON, SIDED, PersonKeypoints
from probmotion.lifting.sides import consistent_sides
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

SEEN = slice(2, None)  # person14 but for pelvis and neck
AZIMUTHS = (0.8, 2.4, 4.0)


def calibration_of(cameras: Cameras, distortion=0.0, size=(1000, 1000)) -> Calibration:
    V = cameras.n_views
    K = np.zeros((V, 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = cameras.focal
    K[:, :2, 2], K[:, 2, 2] = cameras.centre, 1.0
    names = tuple(f"cam_{view}" for view in range(V))
    return Calibration(names, cameras, K, np.full((V, 5), distortion), (size,) * V)


@pytest.fixture(scope="module")
def filmed():
    """Return keypoints of a walk in three views, their calibration, and the true positions."""
    clip = make_gait("walk", 3, frames=60)
    videos = [film(clip, view, azimuth=a, height=1.4) for view, a in enumerate(AZIMUTHS)]
    fields = [
        np.concatenate([getattr(video.camera, name) for video in videos])
        for name in ("rotation", "translation", "focal", "centre")
    ]
    tracks = [replace(video.track, name=f"cam_{view}") for view, video in enumerate(videos)]
    calibration = calibration_of(Cameras(*fields, orthographic=False))
    return tracks, calibration, clip.retarget(PERSON).positions


def lifted(filmed, views, **options):
    tracks, calibration, _ = filmed
    given = [tracks[view] for view in views]
    return lift(given, camera=calibration, progress=False, **({"draws": 40} | options))


@pytest.fixture(scope="module")
def three(filmed):
    return lifted(filmed, (2, 0, 1))


def error(result, truth) -> float:
    """Return the mean error of absolute positions, metres."""
    return float(np.linalg.norm(result.mean.positions - truth, axis=-1)[:, SEEN].mean())


def test_level_views_have_the_geometry_of_rolled_cameras_with_lenses():
    turn = vector_to_matrix(np.array([0.1, -0.3, 0.35]))  # with roll
    cameras = Cameras(
        turn @ Cameras.ring(1, start=1.0, perspective=True).rotation,
        np.array([[0.2, 0.1, 4.0]]),
        np.array([1500.0]),
        np.array([[530.0, 950.0]]),
        orthographic=False,
    )
    points = make_gait("walk", frames=20).retarget(PERSON).positions - [0.0, 1.0, 0.0]
    x, y = np.moveaxis((cameras.project(points)[0] - cameras.centre) / 1500.0, -1, 0)
    square = x**2 + y**2
    radial = 1 + 0.01 * (square + square**2 + square**3)
    u = x * radial + 0.02 * x * y + 0.01 * (square + 2 * x**2)
    v = y * radial + 0.01 * (square + 2 * y**2) + 0.02 * x * y
    seen = 1500.0 * np.stack([u, v], axis=-1) + cameras.centre
    track = KeypointTrack(seen, np.ones(seen.shape[:2]), PERSON, 30.0)
    _, (view,) = calibrated_views([track], calibration_of(cameras, 0.01, (9000, 9000)))
    assert np.allclose(view.pixels(view.keypoints), cameras.project(points)[0], atol=1e-3)
    assert np.allclose(view.keypoints.points, view.camera.pixels(points), atol=1e-3)
    own = view.camera.pinhole()
    assert np.allclose(own.project(points)[0], view.camera.pixels(points))


def test_linearisations_of_several_views_have_the_derivatives_of_projections():
    cameras = LevelCameras(
        (
            LevelCamera(900.0, (0.0, 0.0), -0.3, 0.7, (3.0, 1.0, 4.0)),
            LevelCamera(700.0, (5.0, 0.0), 0.2, -1.9, (-4.0, 0.5, -1.0)),
        )
    )
    rng = np.random.default_rng(1)
    at = rng.normal(size=(4, 6, 3))
    assert (cameras.depth(at) > 0.5).all()
    change = 1e-6 * rng.normal(size=at.shape)
    matrix, target = cameras.linearised(at, cameras.project(at + change))
    assert matrix.shape == (2, 4, 6, 2, 3)
    assert np.allclose((matrix @ (at + change)[..., None])[..., 0], target, atol=1e-10)


def test_three_views_determine_positions_in_the_world(filmed, three):
    truth = filmed[2]
    assert error(three, truth) < 0.02
    low, high = np.quantile(three.draws, [0.05, 0.95], axis=0)
    assert 0.85 < ((truth >= low) & (truth <= high))[:, SEEN].mean() < 0.99
    assert three.noise == pytest.approx(4.0, abs=0.8)
    assert three.trusted
    assert three.camera_names == ("cam_2", "cam_0", "cam_1")
    assert "3 cameras (cam_2, cam_0, cam_1)" in three.summary()[2]
    pixels = three.cameras.project(three.mean.positions)
    residual = np.linalg.norm(pixels - three.keypoints, axis=-1)[three.weight > 0]
    assert np.median(residual) < 2 * three.noise


def test_errors_fall_with_the_number_of_views(filmed, three):
    truth = filmed[2]
    two = lifted(filmed, (0, 1))
    assert error(three, truth) < error(two, truth) < 0.03
    one = lifted(filmed, (0,))
    assert error(two, truth) < 0.5 * error(one, truth)
    # The known floor tells the distance better than the height of an unknown person does.
    place = one.camera_positions[0]
    distance = np.linalg.norm(truth[:, 8] - place, axis=-1)
    ratio = np.linalg.norm(one.mean.positions[:, 8] - place, axis=-1) / distance
    assert np.abs(ratio - 1).mean() < 0.06


def test_the_world_may_be_turned_and_moved(filmed, three):
    tracks, calibration, _ = filmed
    turn, shift = vector_to_matrix(np.array([0.0, np.pi / 2, 0.0])), np.array([1.0, 2.0, -3.0])
    old = calibration.cameras
    rotation = old.rotation @ turn.T
    cameras = Cameras(
        rotation, old.translation - rotation @ shift, old.focal, old.centre, orthographic=False
    )
    moved = lifted((tracks, replace(calibration, cameras=cameras), None), (2, 0, 1))
    wanted = three.mean.positions @ turn.T + shift
    assert np.allclose(moved.mean.positions, wanted, atol=2e-3)


def test_the_size_of_the_person_is_measured(filmed):
    tracks, calibration, truth = filmed
    old = calibration.cameras
    cameras = Cameras(
        old.rotation, 0.7 * old.translation, old.focal, old.centre, orthographic=False
    )
    small = lifted((tracks, replace(calibration, cameras=cameras), None), (0, 1, 2))
    assert error(small, 0.7 * truth) < 0.02


@pytest.mark.parametrize("kind", ["gap", "exchanged"])
def test_one_view_may_have_a_gap_or_exchanged_sides(filmed, kind):
    tracks, calibration, truth = filmed
    order = list(tracks[0].skeleton.mirrored_order)
    points, confidence = tracks[0].keypoints.copy(), tracks[0].confidence.copy()
    if kind == "gap":
        confidence[15:45] = 0.0
    else:  # in most frames, so that the view alone is consistent
        points[:50], confidence[:50] = points[:50, order], confidence[:50, order]
    first = replace(tracks[0], keypoints=points, confidence=confidence)
    result = lifted(([first, *tracks[1:]], calibration, None), (0, 1, 2), draws=2)
    assert error(result, truth) < 0.025
    assert (result.swapped > 0.2) == (kind == "exchanged")


def test_sides_are_those_of_most_views():
    rng = np.random.default_rng(0)
    cameras = LevelCameras(
        tuple(
            LevelCamera(800.0, (0.0, 0.0), 0.0, yaw, (4 * np.sin(yaw), 1.0, 4 * np.cos(yaw)))
            for yaw in (0.0, 1.0, 2.5)
        )
    )
    positions = make_gait("walk", frames=30).retarget(PERSON).positions
    order = list(PERSON.mirrored_order)
    arms = [j for j, name in enumerate(PERSON.joint_names) if name.endswith(SIDED[0])]
    views = []
    for camera in cameras.views:
        pixels = camera.pixels(positions) + rng.normal(size=(*positions.shape[:2], 2))
        views.append(PersonKeypoints(pixels, np.ones(pixels.shape[:2]), 0.0))
    wrong = views[1].points.copy()
    wrong[5:20, arms] = views[1].points[5:20, [order[j] for j in arms]]
    found = consistent_sides([views[0], views[1]._replace(points=wrong), views[2]], cameras)
    for result, view, swapped in zip(found, views, (0.0, 0.25, 0.0), strict=True):
        assert np.array_equal(result.points, view.points)
        assert result.swapped == swapped


def test_views_that_contradict_each_other_are_flagged(filmed):
    tracks, calibration, _ = filmed
    late = replace(
        tracks[0],
        keypoints=np.roll(tracks[0].keypoints, 15, axis=0),
        confidence=np.roll(tracks[0].confidence, 15, axis=0),
    )
    result = lifted(([late, *tracks[1:]], calibration, None), (0, 1, 2), draws=2)
    assert not result.trusted
    assert "contradict the others" in result.summary()[0]


def test_checks_of_several_views_have_limits_of_their_own(filmed, three):
    two = lifted(filmed, (0, 1), draws=2)
    for result, views, residual in ((two, 2, 1.6), (three, 3, 2.4)):
        limits = {check.name: check.limit for check in result.checks}
        assert list(limits) == ["noise", "residual", "proportions", "mirrored"]
        assert limits["residual"] == residual
        assert limits["noise"] == pytest.approx(0.04 * np.sqrt(views))
        assert limits["mirrored"] == 0
        assert 0 < result.checks[2].value < limits["proportions"]


def test_tracks_of_detections_alone_are_aligned_by_their_frames(filmed):
    tracks, calibration, _ = filmed
    starts, stops = (7, 12, 9), (60, 58, 50)
    whole = [replace(track, start=5) for track in tracks]
    cut = [
        replace(
            track,
            keypoints=track.keypoints[start - 5 : stop - 5],
            confidence=track.confidence[start - 5 : stop - 5],
            start=start,
        )
        for track, start, stop in zip(whole, starts, stops, strict=True)
    ]
    _, expected = calibrated_views(whole, calibration)
    _, views = calibrated_views(cut, calibration)
    for view, full, start, stop in zip(views, expected, starts, stops, strict=True):
        assert len(view.keypoints.points) == 60 - 7
        rows = slice(start - 7, stop - 7)
        for name in ("points", "weight"):
            got, whole_view = (getattr(each.keypoints, name) for each in (view, full))
            np.testing.assert_allclose(got[rows], whole_view[start - 5 : stop - 5])
        outside = np.delete(view.keypoints.weight, rows, axis=0)
        assert not outside.any()
    late = replace(cut[1], start=60)
    with pytest.raises(ValueError, match="frames in common, got first frames 7, 60, 9"):
        calibrated_views([cut[0], late, cut[2]], calibration)


def shortened(track):
    return replace(track, keypoints=track.keypoints[:-1], confidence=track.confidence[:-1])


def hidden(track):
    confidence = track.confidence.copy()
    confidence[5:] = 0.0
    return replace(track, confidence=confidence)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (shortened, {}, "same number of frames, got 59, 60, 60; synchronise"),
        (lambda t: replace(t, fps=25.0), {}, "same frame rate, got 25, 30, 30; synchronise"),
        (
            lambda t: replace(t, keypoints=t.keypoints + 700),
            {},
            "keypoints of cam_0 must be pixels",
        ),
        (hidden, {}, "every camera must show the person, got 5 of 60 frames"),
        (None, {"image_size": (1000, 900)}, "that of the calibration, 1000 × 1000 of cam_0"),
        (None, {"pitch": 3.0}, "pitch must not be given with camera"),
        (None, {"fov": 60.0}, "fov must not be given with camera"),
        (None, {"views": (0, 1), "name": "left"}, "must be named after the calibrated cameras"),
        (None, {"scale": 1000.0}, "calibration must be in metres"),
        (None, {"scale": 1000.0, "height": 1.7}, "calibration must be in metres"),
        (None, {"scale": 1000.0, "views": (0,), "draws": 2}, "calibration must be in metres"),
        (None, {"views": (0,) * 9}, "at most 8 cameras, got 9"),
        (None, {"axes": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])}, "must be upright"),
        (None, {"camera": None}, "camera must be given for several tracks"),
    ],
)
def test_bad_input_is_refused(filmed, change, options, words):
    tracks, calibration, _ = filmed
    options = dict(options)
    old = calibration.cameras
    cameras = Cameras(
        old.rotation @ options.pop("axes", np.eye(3)),
        options.pop("scale", 1.0) * old.translation,
        old.focal,
        old.centre,
        orthographic=False,
    )
    first = tracks[0] if change is None else change(tracks[0])
    first = replace(first, name=options.pop("name", first.name))
    given = [[first, *tracks[1:]][view] for view in options.pop("views", (0, 1, 2))]
    defaults = {"camera": replace(calibration, cameras=cameras), "progress": False}
    with pytest.raises(ValueError, match=words):
        lift(given, **(defaults | options))


def test_several_views_of_a_balancing_person_agree_with_the_triangulation(real_data):
    path = real_data / "pose2sim_multiview" / "S00_P00_T01_BalancingTrial_multiview.npz"
    with np.load(path) as archive:
        keypoints, confidence = archive["keypoints"], archive["confidence"]
    skeleton = Skeleton.preset("body25b")
    names = [f"cam{view}_json" for view in range(1, 5)]
    tracks = [
        KeypointTrack(*pair, skeleton, 60.0, name)
        for *pair, name in zip(keypoints, confidence, names, strict=True)
    ]
    toml = real_data / "originals" / "Calib_qualisys.toml"
    result = lift(tracks, camera=toml, progress=False, draws=2)
    recording = read_recording(path, fps=None)
    distance = np.linalg.norm(result.mean.positions - recording.filtered, axis=-1)[:, SEEN]
    assert np.nanmean(distance) < 0.035


def test_the_page_names_the_camera_whose_view_it_shows(three, tmp_path):
    seen = (three.weight > 0).sum(axis=(1, 2))
    text = three.report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<h1>3D motion from 3 cameras</h1>" in text  # tracks are named after the cameras
    assert f"keypoints are those of {three.camera_names[seen.argmax()]}<" in text
