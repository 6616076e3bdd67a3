"""Preparation of raw tracks: known motions are recovered and reports add up."""

from itertools import pairwise

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.tracks.preparation import prepare_tracks
from probmotion.data.tracks.scales import bone_sizes
from probmotion.io.keypoints.files import read_keypoints
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.motion.splits import clip_of

PERSON = Skeleton.preset("person14")
JUMP = 70  # frame at which the tracker switches to another person


def walk(number):
    """Return a side view of a walk in metres, 60 fps, 2 s."""
    motion = make_gait("walk", number, frames=120, fps=60.0).retarget(PERSON).turned(np.pi / 2)
    keypoints = motion.positions[..., :2] * [1, -1]
    return KeypointTrack(keypoints, np.ones((120, 14)), PERSON, 60, f"video{number}")


def detected(track, seed):
    """Return detections in pixels, with noise, outliers, gaps and uncertain joints."""
    rng = np.random.default_rng(seed)
    keypoints = 200 * track.keypoints + 500 + rng.normal(scale=2, size=track.keypoints.shape)
    confidence = rng.uniform(0.5, 1, size=track.confidence.shape)
    for frame in rng.choice(np.arange(10, 110), 6, replace=False):
        keypoints[frame, rng.integers(14)] += rng.choice([-300, 300])
    for start in rng.integers(8, 105, size=10):
        confidence[start : start + 5, rng.integers(14)] = 0
    confidence[rng.random(confidence.shape) < 0.01] = 0.1
    keypoints[confidence == 0] = np.nan
    return KeypointTrack(keypoints, confidence, PERSON, track.fps, track.name)


@pytest.fixture(scope="module")
def clean():
    return [walk(number) for number in range(6)]


@pytest.fixture(scope="module")
def raw(clean):
    """Tracks of six people, one with a jump, and a poor, a short and an empty track."""
    tracks = [detected(track, seed) for seed, track in enumerate(clean)]
    tracks[2].keypoints[JUMP:] += 900
    factors = np.where(np.arange(14) < 6, 1.0, 0.45)
    first, second = ((track.keypoints, track.confidence) for track in tracks[:2])
    return [
        *tracks,
        KeypointTrack(first[0], factors * first[1], PERSON, 60, "poor"),
        KeypointTrack(second[0][:40], second[1][:40], PERSON, 60, "short"),
        KeypointTrack(first[0], 0 * first[1], PERSON, 60, "never"),
    ]


def prepared(tracks, clean, **more):
    settings = {"fps": 20, "sizes": bone_sizes(clean), "threshold": 0.5} | more
    return prepare_tracks(tracks, **settings)


@pytest.fixture(scope="module")
def result(raw, clean):
    return prepared(raw, clean)


def test_known_motions_are_recovered_in_metres(raw, clean, result):
    first, last = result.reports[0], result.reports[-1]
    assert (first.tracks_before, last.tracks_after) == (len(raw), len(result.tracks))
    assert first.frames_before == sum(track.frames for track in raw)
    assert last.frames_after == sum(track.frames for track in result.tracks)
    for before, after in pairwise(result.reports):
        assert before.tracks_after == after.tracks_before
        assert before.frames_after == after.frames_before
    for report in result.reports:
        if report.step != "resample":
            assert report.frames_before == report.frames_after + report.frames_dropped
        if report.step != "segments":
            assert report.tracks_before == report.tracks_after + report.tracks_dropped
    assert [track.name for track in result.tracks] == [
        "video0", "video1", "video2/0", "video3", "video4", "video5",
    ]  # fmt: skip
    dropped = {report.step: report.tracks_dropped for report in result.reports[:-1]}
    assert {step: number for step, number in dropped.items() if number} == {
        "segments": 1, "quality": 1, "short": 2,
    }  # fmt: skip
    for track in result.tracks:
        truth = next(c.keypoints for c in clean if c.name == clip_of(track.name))
        centred = (truth - truth[:, :1])[::3][: track.frames]
        assert (track.fps, track.frames) == (20, 24 if "/" in track.name else 40)
        assert (track.confidence > 0).mean() > 0.98
        error = np.linalg.norm(track.keypoints - centred, axis=-1)
        assert np.nanmean(error) < 0.014  # 0.018 without smoothing
        assert np.nanmax(error) < 0.1


def test_options_select_steps(raw, clean, result):
    steps = [
        "uncertain", "crowds", "segments", "outliers", "quality", "gaps", "smooth", "resample",
        "short", "scale", "centre", "quality",
    ]  # fmt: skip
    assert [report.step for report in result.reports] == steps
    head, *lines = str(result).splitlines()
    assert head.split() == ["step", "tracks", "frames", "dropped", "changed"]
    assert [line.split()[0] for line in lines] == steps
    assert "9 → 9" in lines[0]
    pixels = prepared(raw[3:5], clean, sizes=None, centre="sequence", videos=["one", "other"])
    assert "scale" not in [report.step for report in pixels.reports]
    assert len(pixels.tracks) == 2
    assert np.ptp(pixels.tracks[0].keypoints[:, 0, 0]) > 100
    # A track is prepared independently of others.
    (single,) = prepared(raw[3:4], clean).tracks
    np.testing.assert_array_equal(single.keypoints, result.tracks[3].keypoints)
    with pytest.raises(ValueError, match="no track remains after step crowds: tracks 2 → 0"):
        prepared([raw[0], raw[0]], clean, videos=["one", "one"])


def test_invalid_input(raw, clean):
    skeleton = Skeleton(["tail", "mid", "head"], [-1, 0, 1])
    snake = KeypointTrack(np.ones((50, 3, 2)), np.ones((50, 3)), skeleton, 30.0)
    for tracks, options, message in (
        ([], {}, "tracks must contain at least one, got none"),
        (raw, {"fps": None}, "fps must be a finite number above 0, got None"),
        (raw[-1:], {}, "no track remains after step segments: tracks 1"),
        (raw[:6], {"threshold": 2}, "no track remains after step segments: tracks 6"),
        ([snake], {"skeleton": PERSON}, "tracks of tail, mid, head cannot be retargeted: .*own"),
        ([raw[0], snake], {}, "tracks must have one skeleton, got several; pass skeleton"),
    ):
        with pytest.raises(ValueError, match=message):
            prepared(tracks, clean, **options)


def test_real_detections(real_data, clean):
    files = sorted((real_data / "pose2sim_multiview").glob("*_cam_0*.npz"))
    raw = [track for file in files for track in read_keypoints(file)]
    videos = [track.name.removesuffix("_bystander") for track in raw]
    result = prepared(raw, clean, skeleton=PERSON, videos=videos, threshold=0.3)
    # The bystander of the first camera has an occluded hip, hence no root.
    assert [track.name[-12:] for track in result.tracks] == [
        "Trial_cam_01", "Trial_cam_02", "02_bystander", "Trial_cam_03", "Trial_cam_04",
    ]  # fmt: skip
    for track in result.tracks:
        assert (track.frames, track.skeleton) == (34, PERSON)
        assert (track.confidence > 0).mean() > 0.9
        sizes = bone_sizes([track])
        assert 0.3 < sizes["left_knee"] < 0.55
        assert 0.25 < sizes["right_ankle"] < 0.55
        assert 1.0 < np.nanmax(track.keypoints[..., 1]) - np.nanmin(track.keypoints[..., 1]) < 2.0
