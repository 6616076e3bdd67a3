"""Denoising of tracks: accuracy, bounds on the change, filled joints and seams."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Skeleton, seeds
from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.track_denoising import denoise_track
from probmotion.motion.motion import KeypointTrack

PERSON = Skeleton.preset("person14")
NOISE = 0.03  # metres, along each axis


@pytest.fixture(scope="module")
def prior():
    return MotionDiffusion.load("walk2d")


@pytest.fixture(scope="module")
def true():
    """Return error-free tracks of six people who walk for 3 s, each from two sides."""
    bodies = [make_gait("walk", 100 + n, frames=60, fps=20.0).retarget(PERSON) for n in range(6)]
    return project_clips(bodies, views=2, seed=7, noise=DetectorNoise.none())


def detected(track, noise):
    """Return noisy detections of a centred track, with the root at the origin."""
    rng = seeds.generator(1, "detected", track.name)
    keypoints, confidence = noise.detect(rng, track.keypoints)
    keypoints[:, 0], confidence[:, 0] = 0.0, 1.0
    return replace(track, keypoints=keypoints, confidence=confidence)


@pytest.fixture(scope="module")
def noisy(true):
    return [detected(track, DetectorNoise(found=NOISE, share=0.1)) for track in true]


@pytest.fixture(scope="module")
def clean(prior, noisy):
    return [denoise_track(track, prior, noise=NOISE) for track in noisy]


def error(tracks, true, masks):
    """Return the root mean square distance from the truth along an axis, metres."""
    squares = [
        ((track.keypoints - truth.keypoints) ** 2)[mask]
        for track, truth, mask in zip(tracks, true, masks, strict=True)
    ]
    return float(np.sqrt(np.concatenate(squares).mean()))


def visible(track):
    """Return the visible joints except the root, which has no error."""
    mask = track.confidence >= 0.3
    mask[:, 0] = False
    return mask


def interpolated(track):
    """Return the keypoints with occluded ones interpolated linearly in time."""
    time = np.arange(track.frames)
    filled = track.keypoints.copy()
    for joint, axis in np.ndindex(filled.shape[1:]):
        known = track.confidence[:, joint] >= 0.3
        filled[:, joint, axis] = np.interp(time, time[known], filled[known, joint, axis])
    return filled


def test_denoising_reduces_the_error(prior, true, noisy, clean):
    observed = [visible(track) for track in noisy]
    occluded = [track.confidence < 0.3 for track in noisy]
    assert error(noisy, true, observed) == pytest.approx(NOISE, rel=0.05)
    assert error(clean, true, observed) < 0.76 * NOISE
    for track, truth, mask in zip(clean, true, observed, strict=True):
        assert error([track], [truth], [mask]) < 0.8 * NOISE
    mean = np.broadcast_to(prior.standards.mean, true[0].keypoints.shape)
    constant = [replace(track, keypoints=mean) for track in true]
    assert error(clean, true, occluded) < 0.45 * error(constant, true, occluded)
    linear = [replace(track, keypoints=interpolated(track)) for track in noisy]
    assert error(clean, true, occluded) < 0.81 * error(linear, true, occluded)
    for track, raw in zip(clean, noisy, strict=True):
        assert (track.name, track.fps, track.frames) == (raw.name, raw.fps, raw.frames)
        np.testing.assert_array_equal(track.keypoints[:, 0], 0.0)
        confidence = np.where(raw.confidence >= 0.3, 1.0, raw.confidence)
        np.testing.assert_array_equal(track.confidence, confidence)


@pytest.mark.parametrize("noise", [1e-6, 0.02, 20.0])
def test_visible_joints_move_by_at_most_the_noise(prior, noisy, noise):
    clean = denoise_track(noisy[0], prior, noise=noise)
    change = np.where(visible(noisy[0])[..., None], clean.keypoints - noisy[0].keypoints, np.nan)
    distance = np.sqrt(np.nanmean(change[:, 1:] ** 2, axis=(0, 2)))
    assert ((distance > 0) & (distance <= noise * (1 + 1e-9))).all()


def test_result_is_the_posterior_mean_of_a_gaussian_prior(prior, monkeypatch):
    # Motions follow N(0, S) in normalised units; the noise has standard deviation 1.
    rng = np.random.default_rng(0)
    frames = 30
    time = np.exp(-0.5 * np.subtract.outer(np.arange(frames), np.arange(frames)) ** 2)
    mixing = rng.normal(size=(14, 4))
    S = np.kron(time, mixing @ mixing.T + np.eye(14))
    gain = S @ np.linalg.inv(S + np.eye(len(S)))

    def exact(x_t, alpha_bar, cameras):
        assert alpha_bar == 0.5
        return (gain @ (math.sqrt(2) * x_t.reshape(-1, 2))).reshape(x_t.shape)

    monkeypatch.setattr(prior, "denoise", exact)
    root = np.linalg.cholesky(S)
    seen = root @ rng.normal(size=(len(S), 2)) + rng.normal(size=(len(S), 2))
    present = rng.random((frames, 14)) < 0.7
    present[:, 5] = False
    v = np.flatnonzero(present)
    expected = S[:, v] @ np.linalg.solve(S[np.ix_(v, v)] + np.eye(len(v)), seen[v])
    keypoints = prior.scale * seen.reshape(frames, 14, 2)
    track = KeypointTrack(keypoints, 1.0 * present, PERSON, 20.0, "gaussian/0")
    clean = denoise_track(track, prior, noise=prior.scale, rounds=150).keypoints / prior.scale
    np.testing.assert_allclose(clean, expected.reshape(frames, 14, 2), atol=1e-6)


def test_inaccurate_denoiser_is_combined_with_the_detections(prior, monkeypatch):
    # Independent estimates with errors .03 and .04 combine to an error of .03 · .04 / .05.
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((4000, 14, 2))
    keypoints = truth + 0.03 * rng.standard_normal(truth.shape)
    track = KeypointTrack(keypoints, np.ones((4000, 14)), PERSON, 20.0, "noisy/0")
    estimate = truth + 0.04 * rng.standard_normal(truth.shape)
    window = prior.settings.frames

    def inaccurate(x_t, alpha_bar, cameras):
        starts = [*range(0, 4000 - window + 1, window // 2), 4000 - window]
        views = [estimate[start : start + window] for start in np.unique(starts)]
        return np.stack(views)[:, None] / prior.scale

    monkeypatch.setattr(prior, "denoise", inaccurate)
    residual = denoise_track(track, prior, noise=0.03).keypoints - truth
    assert np.sqrt((residual**2).mean()) == pytest.approx(0.024, rel=0.02)


def test_occluded_joints_have_no_effect(prior, noisy, clean):
    track, expected = noisy[0], clean[0].keypoints
    occluded = track.confidence < 0.3
    for value, confidence in ((np.nan, 0.0), (1e6, 0.29)):
        other = replace(
            track,
            keypoints=np.where(occluded[..., None], value, track.keypoints),
            # The confidence of visible joints does not matter.
            confidence=np.where(occluded, confidence, 1.0),
        )
        result = denoise_track(other, prior, noise=NOISE)
        np.testing.assert_array_equal(result.keypoints, expected)
    stricter = denoise_track(track, prior, noise=NOISE, threshold=0.8).keypoints
    assert (stricter != expected).any()


def test_long_tracks_have_no_seams(prior):
    body = make_gait("walk", 200, frames=200, fps=20.0).retarget(PERSON)
    (truth,) = project_clips([body], views=1, seed=3, noise=DetectorNoise.none())
    track = detected(truth, DetectorNoise(found=0.01, share=0.05))
    clean = denoise_track(track, prior, noise=0.01)
    assert error([clean], [truth], [np.ones((200, 14), bool)]) < 0.0135
    # Accelerations do not depend on the position within the half-overlapping windows.
    bend = abs(np.diff(clean.keypoints, n=2, axis=0)).mean(axis=(1, 2))
    half = prior.settings.frames // 2
    phases = np.arange(1, 199) % half * 5 // half
    means = [bend[phases == phase].mean() for phase in range(5)]
    assert np.ptp(means) < 6 * bend.std() / np.sqrt(len(bend) / 5)
    assert max(means) < 1.25 * np.mean(means)


def test_windows_are_blended_linearly(prior, noisy, monkeypatch):
    def alternating(x_t, alpha_bar, cameras):
        sign = np.where(np.arange(len(x_t)) % 2, -1.0, 1.0)[:, None, None, None, None]
        return np.broadcast_to(sign / prior.scale, x_t.shape)

    monkeypatch.setattr(prior, "denoise", alternating)
    only_root = replace(noisy[0], confidence=noisy[0].confidence * (np.arange(14) == 0))
    path = denoise_track(only_root, prior, noise=NOISE).keypoints[:, 1, 0]
    assert path.max() == pytest.approx(1.0)
    assert path.min() < -0.7
    assert abs(np.diff(path)).max() < 1.1 * 2 / (prior.settings.frames / 2)


@pytest.mark.parametrize("frames", [2, 40, 41])
def test_tracks_may_have_any_length(prior, noisy, frames):
    track = noisy[0]
    short = replace(track, keypoints=track.keypoints[:frames], confidence=track.confidence[:frames])
    clean = denoise_track(short, prior, noise=NOISE)
    assert clean.keypoints.shape == (frames, 14, 2)
    assert np.isfinite(clean.keypoints).all()


def test_occluded_outliers_and_large_bodies_are_accepted(prior, noisy):
    fourth = np.arange(14) == 4
    far = np.where(fourth[:, None], 1e6, 2 * noisy[0].keypoints)
    unsure = np.where(fourth, 0.1, noisy[0].confidence)
    denoise_track(replace(noisy[0], keypoints=far, confidence=unsure), prior, noise=NOISE)


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({"fps": 30.0}, {}, "track must have the prior's 20 frames per second, got 30; resample"),
        ({"confidence": np.zeros((60, 14))}, {}, "a joint with a confidence of 0.3 or more, got n"),
        ({"keypoints": 183.0}, {}, "track .* must be in metres relative to the root, at most"),
        ({"keypoints": 9.0}, {}, "track .* must be in metres relative to the root, at most"),
        ({"skeleton": Skeleton.preset("coco17")}, {}, "track must have the prior's .*, got nose"),
        ({"frames": 1}, {}, "track must have at least 2 frames, got 1"),
        ({}, {"noise": -1.0}, "noise must be a finite number above 0, got -1.0"),
        ({}, {"noise": 1e5}, "noise must be at most .* m, the prior's highest level"),
        ({}, {"rounds": 0}, "rounds must be an integer of at least 1, got 0"),
    ],
)
def test_invalid_input_is_rejected(prior, noisy, changes, options, message):
    track = noisy[0]
    if "keypoints" in changes:
        changes = {"keypoints": track.keypoints + changes["keypoints"]}
    if "skeleton" in changes:
        changes |= {"keypoints": np.zeros((60, 17, 2)), "confidence": np.ones((60, 17))}
    if "frames" in changes:
        changes = {"keypoints": track.keypoints[:1], "confidence": track.confidence[:1]}
    with pytest.raises(ValueError, match=message):
        denoise_track(replace(track, **changes), prior, **({"noise": NOISE} | options))
