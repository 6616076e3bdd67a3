"""Synthetic 2D tracks: projection geometry and detector errors."""

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, seeds
from probmotion.data.projections import DetectorNoise, Filming, project_clips
from probmotion.data.synthetic.gaits import make_gaits

NO_NOISE = DetectorNoise.none()


@pytest.fixture(scope="module")
def clips():
    shifted = []
    for number, clip in enumerate(make_gaits(3, frames=24, seed=1)):
        positions = clip.positions + np.array([3.0 * number, 1.0, -2.0])
        shifted.append(replace(clip, positions=positions, rotations=None, rest_offsets=None))
    return shifted


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("centre", ["frame", "sequence"])
def test_noiseless_tracks_are_projections_of_the_centred_clip(clips, perspective, centre):
    filming = Filming(elevation=0.3, tilt=0.0, distance=5.0, perspective=perspective, centre=centre)
    tracks = project_clips(clips, views=4, seed=2, filming=filming, noise=NO_NOISE)
    assert [track.name for track in tracks] == [f"{c.name}/{v}" for c in clips for v in range(4)]
    for number, clip in enumerate(clips):
        root = clip.positions[:, clip.skeleton.roots[0]]
        origin = root[:, None] if centre == "frame" else root.mean(axis=0)
        azimuths = seeds.generator(2, "filming", clip.name).uniform(0, 2 * np.pi, 4)
        cameras = Cameras.around(azimuths, np.full(4, 0.3), distance=5.0, perspective=perspective)
        expected = cameras.project(clip.positions - origin)
        for track, image in zip(tracks[4 * number :][:4], expected, strict=True):
            np.testing.assert_allclose(track.keypoints, image, atol=1e-12)
            assert track.confidence.min() >= 0.5
            assert (track.skeleton, track.fps) == (clip.skeleton, clip.fps)


def test_camera_elevations_and_azimuths():
    filming = Filming(elevation=0.4, tilt=0.1, distance=9.0)
    cameras = filming.cameras(np.random.default_rng(0), 4000)
    forward = cameras.rotation[:, 2]
    elevation = np.arcsin(-forward[:, 1])
    assert 0.3 <= elevation.min() < elevation.max() <= 0.5
    assert elevation.mean() == pytest.approx(0.4, abs=5 * 0.1 / math.sqrt(3 * 4000))
    azimuth = np.arctan2(-forward[:, 0], -forward[:, 2])
    # The first two moments of a uniform angle have sd 1/√(2n).
    for k in (1, 2):
        assert abs(np.exp(1j * k * azimuth).mean()) < 5 / math.sqrt(4000)
    np.testing.assert_array_equal(cameras.focal, 9.0)


def test_tracks_do_not_depend_on_other_clips(clips):
    by_name = {track.name: track for track in project_clips(clips, views=3, seed=5)}
    for selection in (clips[::-1], clips[1:2]):
        for track in project_clips(selection, views=3, seed=5):
            np.testing.assert_array_equal(track.keypoints, by_name[track.name].keypoints)
            np.testing.assert_array_equal(track.confidence, by_name[track.name].confidence)
    other = project_clips(clips, views=3, seed=6)
    assert all((track.confidence != by_name[track.name].confidence).any() for track in other)


def test_frequency_and_duration_of_losses():
    noise = DetectorNoise(share=0.1, frames=5.0)
    n, L = 4000, 60
    lost = noise.lost_spans(np.random.default_rng(0), L, n)
    # With losses of 5 frames about n L / 9 frames are independent.
    error = math.sqrt(0.1 * 0.9 / (n * L / 9))
    assert lost.mean() == pytest.approx(0.1, abs=5 * error)
    # The chain starts in its stationary distribution.
    for frame in (0, L - 1):
        assert lost[frame].mean() == pytest.approx(0.1, abs=5 * math.sqrt(0.09 / n))
    # The mean duration follows from the number of ends.
    ended = lost[:-1] & ~lost[1:]
    mean = lost[:-1].sum() / ended.sum()
    assert mean == pytest.approx(5.0, rel=5 / math.sqrt(ended.sum()))


def test_errors_and_confidences():
    noise = DetectorNoise(found=0.02, lost=0.3, share=0.2, frames=3.0, silent=0.25)
    true = np.random.default_rng(1).normal(size=(2000, 30, 2))
    keypoints, confidence = noise.detect(np.random.default_rng(2), true)
    silent = confidence == 0
    np.testing.assert_array_equal(np.isnan(keypoints), np.repeat(silent[..., None], 2, axis=2))
    detected = confidence >= 0.3
    assert confidence[detected].min() >= 0.5
    assert confidence.max() <= 1
    assert (~detected).mean() == pytest.approx(0.2, abs=0.01)
    assert silent.sum() / (~detected).sum() == pytest.approx(0.25, abs=0.02)
    errors = keypoints - true
    n = 2 * detected.sum()
    assert errors[detected].std() == pytest.approx(0.02, rel=5 / math.sqrt(2 * n))
    assert abs(errors[detected].mean()) < 5 * 0.02 / math.sqrt(n)
    reported = ~detected & ~silent
    assert errors[reported].std() == pytest.approx(0.3, rel=5 / math.sqrt(2 * 2 * reported.sum()))


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (DetectorNoise, {"found": -1.0}),
        (DetectorNoise, {"lost": math.inf}),
        (DetectorNoise, {"share": 1.0}),
        (DetectorNoise, {"silent": 1.5}),
        (DetectorNoise, {"frames": 0.5}),
        (DetectorNoise, {"frames": math.inf}),
        (DetectorNoise, {"share": 0.9, "frames": 2.0}),
        (Filming, {"distance": 0.0}),
        (Filming, {"elevation": 1.57}),
        (Filming, {"elevation": math.nan}),
        (Filming, {"elevation": 1.5, "tilt": -0.1}),
        (Filming, {"centre": "clip"}),
    ],
)
def test_invalid_options(kind, options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))} must be"):
        kind(**options)


def test_invalid_clips(clips):
    with pytest.raises(ValueError, match="motions must contain at least one"):
        project_clips([])
    for names in ([clips[0], clips[0]], [replace(clips[0], name="")]):
        with pytest.raises(ValueError, match="motions must have unique names"):
            project_clips(names)
    with pytest.raises(ValueError, match="views must be an integer of at least 1, got 0"):
        project_clips(clips, views=0)
