from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film, quadruped_as_person
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.lifting import lift, track_lift
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import LIMBS, PERSON, person_keypoints
from probmotion.lifting.track_lift import _windows

SEEN = slice(2, None)  # person14 but for pelvis and neck


def about_hips(positions: np.ndarray) -> np.ndarray:
    return (positions - positions[..., [8, 11], :].mean(axis=-2, keepdims=True))[..., SEEN, :]


def test_a_walk_is_lifted(video, lifted):
    truth = video.motion.positions
    error = np.linalg.norm(about_hips(lifted.mean.positions) - about_hips(truth), axis=-1)
    assert error.mean() < 0.1
    # The motion's axes have the camera at (0, height, 0).
    path = lifted.mean.positions[:, 0] - [0, lifted.camera_height, 0]
    distance = np.linalg.norm(truth[:, 0], axis=-1).mean()
    assert np.linalg.norm(path - truth[:, 0], axis=-1).mean() < 0.15 * distance
    assert lifted.noise == pytest.approx(4.0, abs=1.0)
    low, high = np.quantile(about_hips(lifted.draws), [0.05, 0.95], axis=0)
    inside = (about_hips(truth) >= low) & (about_hips(truth) <= high)
    assert inside.mean() > 0.6
    assert lifted.trusted


def test_the_cameras_project_the_mean_to_the_keypoints(lifted):
    pixels = lifted.cameras.project(lifted.mean.positions)[0]
    residual = np.linalg.norm(pixels - lifted.keypoints, axis=-1)[lifted.weight > 0]
    assert np.median(residual) < 2 * lifted.noise


def test_people_may_be_absent_for_two_windows(video):
    long = film(make_gait("walk", 3, frames=240), 0, azimuth=0.8)
    confidence = long.track.confidence.copy()
    confidence[90:180] = 0
    gap = replace(long.track, confidence=confidence)

    def spread(track):
        result = lift(track, image_size=long.size, progress=False, draws=20)
        assert np.isfinite(result.draws).all()
        assert all(np.isfinite(check.value) for check in result.checks)
        return np.linalg.norm(about_hips(result.draws[:, 120:150]).std(axis=0), axis=-1).mean()

    assert spread(gap) > 1.2 * spread(long.track)


def test_depths_of_joints_that_are_not_seen_do_not_count(video, lifted):
    windows = _windows(person_keypoints(video.track), video.track.fps)
    unseen = windows.keypoints.weight[:, LIMBS] == 0

    def score(windows):
        return windows.posterior(0, lifted.camera, 4.0).best.score

    assert unseen.any()
    wrong = np.where(unseen, 5.0, windows.depths.depth)
    assert score(windows._replace(depths=windows.depths._replace(depth=wrong))) == score(windows)
    wrong = np.where(unseen, windows.depths.depth, 5.0)
    assert score(windows._replace(depths=windows.depths._replace(depth=wrong))) < score(windows)


def test_intervals_are_wider_where_depths_of_visible_joints_disagree(video, lifted):
    windows = _windows(person_keypoints(video.track), video.track.fps)
    hidden = np.isin(LIMBS, LIMBS[:7])

    def inflation(of_hidden, of_visible):
        weight = windows.keypoints.weight.copy()
        weight[:, LIMBS[:7]] = 0.0
        shape = windows.depths.disagreement.shape
        disagreement = np.broadcast_to(np.where(hidden, of_hidden, of_visible), shape)
        changed = windows._replace(
            keypoints=windows.keypoints._replace(weight=weight),
            depths=windows.depths._replace(disagreement=disagreement),
        )
        return changed.posterior(0, lifted.camera, 4.0).best.inflation

    assert inflation(1.0, 0.0) == inflation(0.0, 0.0)
    assert inflation(0.0, 0.009) == pytest.approx(2.25 * inflation(0.0, 0.0))


def test_exchanged_sides_have_depths_of_their_own(video):
    windows = _windows(person_keypoints(video.track), video.track.fps)
    mirrored = windows.mirrored()
    order = [LIMBS.index(PERSON.mirrored_order[joint]) for joint in LIMBS]
    for other in (windows.depths.depth, windows.depths.depth[:, order]):
        assert np.abs(mirrored.depths.depth - other).mean() > 0.02
    assert np.array_equal(mirrored.mirrored().depths.depth, windows.depths.depth)


def test_eight_frames_are_enough(video):
    track = video.track
    few = slice(0, 16, 2)
    short = replace(
        track, keypoints=track.keypoints[few], confidence=track.confidence[few], fps=track.fps / 2
    )
    result = lift(short, image_size=video.size, progress=False, draws=2)
    assert result.mean.frames == 8
    assert all(np.isfinite(check.value) for check in result.checks)


def test_draws_depend_on_the_seed_alone(video, lifted):
    again = lift(video.track, image_size=video.size, progress=False, draws=40)
    assert np.array_equal(again.draws, lifted.draws)
    other = lift(video.track, image_size=video.size, progress=False, draws=40, seed=1)
    assert np.array_equal(other.mean.positions, lifted.mean.positions)
    assert not np.array_equal(other.draws, lifted.draws)


def test_a_camera_that_looks_down_is_found():
    video = film(make_gait("walk", 3, frames=60), 0, azimuth=0.8, height=2.4)
    distance = np.linalg.norm(video.motion.positions[:, 0, [0, 2]], axis=-1).mean()
    result = lift(video.track, image_size=video.size, progress=False, draws=2)
    true = -np.degrees(np.arctan2(1.4, distance))
    assert np.degrees(result.camera.pitch) == pytest.approx(true, abs=6)


@pytest.mark.parametrize("tilt", [-10.0, 10.0])
def test_the_pitch_is_found_where_the_body_is_above_or_below_the_centre(video, lifted, tilt):
    """The camera is turned about its right: the image changes by a homography."""
    centre, focal = 500.0, 866.0
    rays = (video.track.keypoints - centre) / focal * [1.0, -1.0]
    turn = vector_to_matrix(np.array([np.radians(-tilt), 0.0, 0.0]))
    rays = np.concatenate([rays, -np.ones((*rays.shape[:-1], 1))], axis=-1) @ turn.T
    moved = centre + focal * rays[..., :2] / -rays[..., 2:] * [1.0, -1.0]
    result = lift(
        replace(video.track, keypoints=moved), image_size=video.size, progress=False, draws=2
    )
    change = np.degrees(result.camera.pitch - lifted.camera.pitch)
    assert change == pytest.approx(tilt, abs=2.5)


def test_a_given_pitch_is_kept(video, lifted):
    # The made camera is at 1.4 m and looks at a point 1 m above the floor.
    distance = np.linalg.norm(video.motion.positions[:, 0, [0, 2]], axis=-1).mean()
    true = -np.degrees(np.arctan2(0.4, distance))
    assert np.degrees(lifted.camera.pitch) == pytest.approx(true, abs=8)
    given = lift(video.track, image_size=video.size, progress=False, draws=2, pitch=true)
    assert given.camera.pitch == pytest.approx(np.radians(true))


def test_taller_people_are_farther_away(video, lifted):
    tall = lift(video.track, image_size=video.size, progress=False, draws=2, height=2.04)
    usual = lift(video.track, image_size=video.size, progress=False, draws=2, height=1.7)
    assert np.allclose(tall.mean.positions, 1.2 * lifted.mean.positions)
    assert np.allclose(tall.draws, 1.2 * usual.draws)
    # Without a height, each draw has its own size.
    assert not np.allclose(usual.draws, lifted.draws[:2], rtol=0.01)


@pytest.fixture
def uncorrected(monkeypatch, video):
    """Return a lift before the assumed camera, with pitches of ± 1° and focal lengths of ± .1."""
    error = track_lift._CameraError(np.radians(1.0), 0.1)

    def kept(camera, _, heights, spreads, __):
        return camera, error, track_lift._shared(heights, spreads)

    monkeypatch.setattr(track_lift, "_levelled", kept)
    return lift(video.track, image_size=video.size, progress=False, draws=40)


def test_draws_have_pitches_of_their_own_where_it_is_estimated(video, uncorrected):
    pitch = float(np.degrees(uncorrected.camera.pitch))
    given = lift(video.track, image_size=video.size, progress=False, draws=40, pitch=pitch)

    def inclination(draws: np.ndarray) -> np.ndarray:
        trunk = (draws[:, :, 1] - draws[:, :, 0]).mean(axis=1)
        return np.degrees(np.arctan2(trunk[:, 2], trunk[:, 1]))

    # The same draws, each turned.
    turns = inclination(uncorrected.draws) - inclination(given.draws)
    assert np.std(turns) == pytest.approx(1.0, rel=0.3)
    # The floor stays where it is.
    heights = uncorrected.draws[:, :, 0, 1].mean(axis=1)
    assert np.std(heights) < 1.5 * np.std(given.draws[:, :, 0, 1].mean(axis=1)) + 0.06


def test_draws_have_focal_lengths_of_their_own_without_a_field_of_view(video, uncorrected):
    given = lift(video.track, image_size=video.size, progress=False, draws=40, fov=60.0)
    assert np.allclose(about_hips(given.draws), about_hips(uncorrected.draws))
    ratio = np.log(uncorrected.draws[..., 0, 2] / given.draws[..., 0, 2])
    assert np.allclose(ratio, ratio[:, :1])
    assert np.std(ratio[:, 0]) == pytest.approx(0.1, rel=0.4)


@pytest.mark.parametrize(
    ("kind", "failed"),
    [
        ("random", {"noise"}),
        ("mirrored", {"mirrored"}),
        ("animal", {"uncertain", "proportions"}),
        ("moving", {"unsteady"}),
    ],
)
def test_keypoints_that_no_person_explains_are_flagged(video, kind, failed):
    track = video.track
    if kind == "animal":
        gait = quadruped_as_person(make_gait("quadruped-trot", 1, frames=60))
        track = film(gait, 0, azimuth=1.0, height=0.8).track
    points = track.keypoints.copy()
    if kind == "random":
        points = np.where(
            np.isfinite(points), np.random.default_rng(0).uniform(200, 800, points.shape), np.nan
        )
    if kind == "mirrored":
        points[..., 0] = 1000 - points[..., 0]
    if kind == "moving":
        pan = 80 * np.sin(2 * np.pi * 0.6 * np.arange(len(points)) / track.fps)
        points = np.clip(points + np.stack([pan, pan / 2], axis=-1)[:, None], 0, 999)
    result = lift(
        replace(track, keypoints=points), image_size=(1000, 1000), progress=False, draws=2
    )
    assert failed <= {check.name for check in result.checks if not check.passed}
    assert result.summary()[0].startswith("Do not trust")


def test_people_who_move_up_and_down_are_not_taken_for_a_moving_camera(video, lifted):
    points = video.track.keypoints.copy()
    points[..., 1] += (
        60 * np.sin(2 * np.pi * 0.6 * np.arange(len(points)) / video.track.fps)[:, None]
    )
    track = replace(video.track, keypoints=points)
    result = lift(track, image_size=video.size, progress=False, draws=2)
    moving, still = ({c.name: c for c in one.checks}["unsteady"] for one in (result, lifted))
    assert moving.passed
    assert moving.value == pytest.approx(still.value, rel=0.3)


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        ({"keypoints": slice(0, 1)}, {}, "at least"),
        ({}, {"fov": 500.0}, "fov must be 10 to 150"),
        ({}, {"height": 170.0}, "height must be .5 to 2.5"),
        ({}, {"image_size": (100, 100)}, "pixels of an image of 100"),
        ({}, {"image_size": (0, 100)}, "image_size"),
        ({}, {"noise": -1.0}, "noise"),
        ({}, {"draws": 1}, "draws"),
        ({}, {"pitch": 100.0}, "pitch must be -80 to 80"),
        ({"fps": 1.0}, {}, "at least 5 frames per second"),
        ({"shift": -700.0}, {}, "pixels of an image"),
        ({"absent": True}, {}, "at least half of the frames"),
    ],
)
def test_bad_input_is_refused(video, change, options, words):
    track = video.track
    if "keypoints" in change:
        rows = change["keypoints"]
        track = replace(track, keypoints=track.keypoints[rows], confidence=track.confidence[rows])
    if "fps" in change:
        track = replace(track, fps=change["fps"])
    if "shift" in change:
        track = replace(track, keypoints=track.keypoints + change["shift"])
    if "absent" in change:
        confidence = track.confidence.copy()
        confidence[:60] = 0.0
        track = replace(track, confidence=confidence)
    with pytest.raises(ValueError, match=words):
        lift(track, **{"image_size": video.size, "progress": False} | options)


@pytest.mark.parametrize("axes", ["y", "xy"])
def test_people_who_are_upside_down_are_refused_until_they_are_flipped(video, lifted, axes):
    track = video.track.flipped(axes, video.size)
    options = {"image_size": video.size, "progress": False, "draws": 2}
    with pytest.raises(ValueError, match="keypoints must show a person upright"):
        lift(track, **options)
    mean = lift(track.flipped(axes, video.size), **options).mean.positions
    np.testing.assert_allclose(mean, lifted.mean.positions, atol=1e-6)


def test_people_who_lie_with_their_feet_higher_are_not_refused_but_marked(video):
    cosine, sine = np.cos(np.radians(115)), np.sin(np.radians(115))
    turned = (video.track.keypoints - 500) @ [[cosine, sine], [-sine, cosine]] + 500
    track = replace(video.track, keypoints=turned)
    assert not lift(track, image_size=video.size, progress=False, draws=2).trusted


def test_windows_share_the_floor(video, monkeypatch):
    shared, found = [], {True: [], False: []}
    fit = track_lift._Windows.posterior

    def spy(windows, *arguments, floor=None, **options):
        result = fit(windows, *arguments, floor=floor, **options)
        if floor is not None:
            shared.append(floor)
            alone = fit(windows, *arguments, **options)
            for one, known in ((result, True), (alone, False)):
                found[known].append(one.floor.mean)
        return result

    monkeypatch.setattr(track_lift._Windows, "posterior", spy)
    lift(video.track, image_size=video.size, progress=False, draws=2)
    assert len(shared) > 1
    assert len(set(shared)) == 1
    assert np.ptp(found[True]) < np.ptp(found[False])


@pytest.mark.parametrize("error", [-3.0, 3.0])
def test_the_pitch_is_corrected_where_the_person_walks_towards_the_camera(monkeypatch, error):
    video = film(make_gait("walk", 0, frames=120), 0, azimuth=0.0, height=1.6)
    true = np.arcsin(video.camera.rotation[0, 2, 1])
    monkeypatch.setattr(track_lift, "_pitch", lambda *_: true + np.radians(error))
    result = lift(video.track, image_size=video.size, progress=False, draws=2)
    assert abs(np.degrees(result.camera.pitch - true)) < 0.5 * abs(error)
    given = lift(
        video.track,
        image_size=video.size,
        progress=False,
        draws=2,
        pitch=float(np.degrees(true)) + error,
    )
    assert np.degrees(given.camera.pitch - true) == pytest.approx(error)


def test_the_focal_length_is_corrected_where_the_camera_looks_down():
    video = film(make_gait("walk", 0, frames=120), 0, azimuth=0.0, height=3.0, fov=40.0)
    pitch = float(np.degrees(np.arcsin(video.camera.rotation[0, 2, 1])))
    result = lift(video.track, image_size=video.size, progress=False, draws=2, pitch=pitch)
    assumed = 500 / np.tan(np.radians(30))
    error, before = np.log(np.array([result.camera.focal, assumed]) / video.camera.focal[0])
    assert abs(error) < 0.4 * abs(before)


def test_a_level_floor_corrects_the_camera_by_a_regression_with_a_prior():
    camera = LevelCamera(1000.0, (500.0, 500.0), pitch=-0.3)
    error = track_lift._CameraError(0.06, 0.3)
    distances, spreads = np.array([4.0, 5.0, 7.0]), np.array([0.01, 0.02, 0.03])
    heights = -1.0 + 0.05 * distances
    found, left, floor = track_lift._levelled(camera, error, heights, spreads, distances)
    # Bayesian linear regression with a flat intercept: δ d − ρ tan p d.
    noise = spreads**2 + 0.02**2
    design = np.stack([np.ones(3), distances, -np.tan(-0.3) * distances], axis=1)
    precision = design.T @ (design / noise[:, None]) + np.diag([0.0, 0.06**-2, 0.3**-2])
    expected = np.linalg.solve(precision, design.T @ (heights / noise))
    assert camera.pitch - found.pitch == pytest.approx(expected[1])
    assert np.log(found.focal / camera.focal) == pytest.approx(expected[2])
    assert left == pytest.approx(np.sqrt(np.diag(np.linalg.inv(precision)))[1:])
    rise = expected[1] - np.tan(-0.3) * expected[2]
    assert floor == pytest.approx(track_lift._shared(heights - rise * distances, spreads))


@pytest.mark.parametrize(
    ("error", "rise", "distances"),
    [
        pytest.param((0.0, 0.0), 0.05, [4.0, 5.0, 7.0], id="known camera"),
        pytest.param((0.06, 0.3), 0.05, [5.0, 5.0, 5.0], id="one distance"),
        pytest.param((0.06, 0.0), 0.3, [4.0, 5.0, 7.0], id="steps"),
    ],
)
def test_a_camera_is_kept_where_floors_tell_nothing(error, rise, distances):
    camera = LevelCamera(1000.0, (500.0, 500.0), pitch=-0.3)
    heights, spreads = -1.0 + rise * np.array(distances), np.array([0.01, 0.02, 0.03])
    found, left, floor = track_lift._levelled(
        camera, track_lift._CameraError(*error), heights, spreads, np.array(distances)
    )
    assert (found.pitch, found.focal) == pytest.approx((camera.pitch, camera.focal))
    assert left == pytest.approx(error)
    assert floor == pytest.approx(track_lift._shared(heights, spreads))


def test_the_floor_of_several_windows_is_as_certain_as_they_agree():
    close, apart = (
        track_lift._shared(np.array([-1.0, -1.0 + gap]), np.array([0.1, 0.05]))
        for gap in (0.0, 0.5)
    )
    assert close == pytest.approx((-1.0, (100 + 400) ** -0.5))
    assert apart.mean == pytest.approx(-1.0 + 0.8 * 0.5)
    assert apart.sd == pytest.approx(np.sqrt(0.2 * 0.8 * 0.5**2 + 1 / 500))
    alone = track_lift._shared(np.array([-1.0]), np.array([0.1]))
    assert alone.sd == np.inf
