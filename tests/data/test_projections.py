"""2D tracks from 3D clips: what cameras see, how detectors err, and nothing of the third axis."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, seeds
from probmotion.data.projections import DetectorNoise, Filming, centre_motion, project_clips
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.motion.splits import clip_of

NO_NOISE = DetectorNoise.none()


@pytest.fixture(scope="module")
def clips():
    moved = []
    for number, clip in enumerate(make_gaits(3, frames=24, seed=1)):
        away = clip.positions + np.array([3.0 * number, 1.0, -2.0])
        moved.append(replace(clip, positions=away, rotations=None, rest_offsets=None))
    return moved


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("centre", ["frame", "sequence"])
def test_without_noise_tracks_are_projections_of_the_centred_clip(clips, perspective, centre):
    filming = Filming(elevation=0.3, tilt=0.0, distance=5.0, perspective=perspective, centre=centre)
    tracks = project_clips(clips, views=4, seed=2, filming=filming, noise=NO_NOISE)
    assert [track.name for track in tracks] == [f"{c.name}/{v}" for c in clips for v in range(4)]
    for clip, views in zip(
        clips, np.array_split(np.array(tracks, object), len(clips)), strict=True
    ):
        root = clip.positions[:, clip.skeleton.roots[0]]
        origin = root[:, None] if centre == "frame" else root.mean(axis=0)
        azimuths = seeds.generator(2, "filming", clip.name).uniform(0, 2 * np.pi, 4)
        cameras = Cameras.around(azimuths, np.full(4, 0.3), distance=5.0, perspective=perspective)
        wanted = cameras.project(clip.positions - origin)
        for track, picture in zip(views, wanted, strict=True):
            np.testing.assert_allclose(track.keypoints, picture, atol=1e-12)
            assert track.confidence.min() >= 0.5
            assert track.skeleton == clip.skeleton
            assert track.fps == clip.fps
            assert clip_of(track.name) == clip.name


def test_pictures_are_in_metres_with_down_positive_and_the_root_in_the_middle(clips):
    for perspective in (True, False):
        filming = Filming(perspective=perspective)
        for track in project_clips(clips, views=3, filming=filming, noise=NO_NOISE):
            names = track.skeleton.joint_names
            root = track.skeleton.roots[0]
            np.testing.assert_allclose(track.keypoints[:, root], 0, atol=1e-12)
            # Feet are below the pelvis by most of a metre.
            low = [j for j, name in enumerate(names) if name.endswith(("foot", "ankle"))]
            assert low
            assert 0.3 < track.keypoints[:, low, 1].mean() < 1.2


def test_elevations_and_azimuths_are_as_said():
    filming = Filming(elevation=0.4, tilt=0.1, distance=9.0)
    cameras = filming.cameras(np.random.default_rng(0), 4000)
    forward = cameras.rotation[:, 2]
    elevation = np.arcsin(-forward[:, 1])
    assert elevation.min() >= 0.3
    assert elevation.max() <= 0.5
    assert elevation.mean() == pytest.approx(0.4, abs=5 * 0.1 / math.sqrt(3 * 4000))
    azimuth = np.arctan2(-forward[:, 0], -forward[:, 2])
    # The first two moments of a uniform angle have deviation 1/√(2n).
    for k in (1, 2):
        assert abs(np.exp(1j * k * azimuth).mean()) < 5 / math.sqrt(4000)
    np.testing.assert_array_equal(cameras.focal, 9.0)


def test_a_clip_s_tracks_do_not_depend_on_the_other_clips(clips):
    together = {track.name: track for track in project_clips(clips, views=3, seed=5)}
    for some in (clips[::-1], clips[1:2]):
        for track in project_clips(some, views=3, seed=5):
            np.testing.assert_array_equal(track.keypoints, together[track.name].keypoints)
            np.testing.assert_array_equal(track.confidence, together[track.name].confidence)
    other = project_clips(clips, views=3, seed=6)
    assert all((track.confidence != together[track.name].confidence).any() for track in other)


def test_joints_are_lost_as_often_and_as_long_as_said():
    noise = DetectorNoise(share=0.1, frames=5.0)
    n, L = 4000, 60
    lost = noise.lost_spans(np.random.default_rng(0), L, n)
    # Spans of 5 frames leave about n L / 9 independent frames.
    error = math.sqrt(0.1 * 0.9 / (n * L / 9))
    assert lost.mean() == pytest.approx(0.1, abs=5 * error)
    # The chain starts in its stationary state.
    for frame in (0, L - 1):
        assert lost[frame].mean() == pytest.approx(0.1, abs=5 * math.sqrt(0.09 / n))
    # Spans that begin and end inside have a geometric length; whole ones are seen by their ends.
    begun = lost[1:] & ~lost[:-1]
    ended = lost[:-1] & ~lost[1:]
    mean = lost[:-1].sum() / ended.sum()
    assert mean == pytest.approx(5.0, rel=5 / math.sqrt(ended.sum()))
    assert abs(begun.sum() - ended.sum()) < 5 * math.sqrt(begun.sum())


def test_errors_and_confidences_are_as_said():
    noise = DetectorNoise(found=0.02, lost=0.3, share=0.2, frames=3.0, silent=0.25)
    true = np.random.default_rng(1).normal(size=(2000, 30, 2))
    keypoints, confidence = noise.detect(np.random.default_rng(2), true)
    silent = confidence == 0
    np.testing.assert_array_equal(np.isnan(keypoints), np.repeat(silent[..., None], 2, axis=2))
    # The thresholds in use part them: .3 for people, .5 for horses.
    found = confidence >= 0.3
    assert confidence[found].min() >= 0.5
    assert confidence.max() <= 1
    assert (~found).mean() == pytest.approx(0.2, abs=0.01)
    assert silent.sum() / (~found).sum() == pytest.approx(0.25, abs=0.02)
    errors = keypoints - true
    n = 2 * found.sum()
    assert errors[found].std() == pytest.approx(0.02, rel=5 / math.sqrt(2 * n))
    assert abs(errors[found].mean()) < 5 * 0.02 / math.sqrt(n)
    reported = ~found & ~silent
    assert errors[reported].std() == pytest.approx(0.3, rel=5 / math.sqrt(2 * 2 * reported.sum()))


def test_the_default_detector_is_kinder_than_its_worst():
    noise = DetectorNoise()
    true = np.zeros((400, 50, 2))
    keypoints, confidence = noise.detect(np.random.default_rng(0), true)
    assert (confidence < 0.3).mean() == pytest.approx(noise.share, abs=0.01)
    assert np.nanstd(keypoints[confidence >= 0.3]) == pytest.approx(noise.found, rel=0.05)


def test_tracks_have_no_third_axis(clips):
    # Depth does not matter to orthographic pictures: moved along the view, a clip looks the same.
    filming = Filming(elevation=0.0, tilt=0.0, perspective=False, centre="sequence")
    clip = clips[0]
    track = project_clips([clip], views=1, filming=filming, noise=NO_NOISE)[0]
    assert track.keypoints.shape == (24, clip.skeleton.n_joints, 2)
    azimuth = seeds.generator(0, "filming", clip.name).uniform(0, 2 * np.pi, 1)
    forward = Cameras.around(azimuth, np.zeros(1)).rotation[0, 2]
    depth = np.random.default_rng(0).normal(size=(24, clip.skeleton.n_joints, 1))
    bent = replace(clip, positions=clip.positions + depth * forward)
    other = project_clips([bent], views=1, filming=filming, noise=NO_NOISE)[0]
    np.testing.assert_allclose(other.keypoints, track.keypoints, atol=1e-12)


def test_centring_moves_the_root_and_nothing_else(clips):
    clip = clips[1]
    root = clip.skeleton.roots[0]
    for centre in ("frame", "sequence"):
        moved = centre_motion(clip, centre)
        step = clip.positions - moved.positions
        np.testing.assert_allclose(step, np.broadcast_to(step[:, :1], step.shape), atol=1e-12)
        np.testing.assert_allclose(moved.positions[:, root].mean(axis=0), 0, atol=1e-12)
        assert (moved.name, moved.fps, moved.skeleton) == (clip.name, clip.fps, clip.skeleton)
    np.testing.assert_allclose(centre_motion(clip).positions[:, root], 0, atol=1e-12)
    assert abs(centre_motion(clip, "sequence").positions[:, root]).max() > 0.01


def test_bad_input_is_refused_in_a_sentence(clips):
    with pytest.raises(ValueError, match="motions must contain at least one clip, got none"):
        project_clips([])
    for double in ([clips[0], clips[0]], [replace(clips[0], name="")]):
        with pytest.raises(ValueError, match=r"motions has the names .*, expected one of its own"):
            project_clips(double)
    with pytest.raises(ValueError, match="views must be an integer of at least 1, got 0"):
        project_clips(clips, views=0)
    for kind, wrong in [
        (DetectorNoise, {"found": -1.0}),
        (DetectorNoise, {"lost": math.inf}),
        (DetectorNoise, {"share": 1.0}),
        (DetectorNoise, {"silent": 1.5}),
        (DetectorNoise, {"frames": 0.5}),
        (DetectorNoise, {"frames": math.nan}),
        (DetectorNoise, {"frames": math.inf}),
        (DetectorNoise, {"share": 0.9, "frames": 2.0}),
        (Filming, {"distance": 0.0}),
        (Filming, {"elevation": 1.57}),
        (Filming, {"elevation": math.nan}),
        (Filming, {"elevation": 1.5, "tilt": -0.1}),
        (Filming, {"centre": "clip"}),
    ]:
        with pytest.raises(ValueError, match=f"^{next(iter(wrong))} is .*, expected"):
            kind(**wrong)
