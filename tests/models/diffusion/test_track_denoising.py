"""Cleaning tracks with a learnt prior: nearer to the truth, near what was seen, without seams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from probmotion import Skeleton, seeds
from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.tracks.learning import film_clips, read_tracks, synthetic_walks
from probmotion.data.tracks.preparation import prepare_tracks
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.track_denoising import denoise_track
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.training.checkpoints import WEIGHTS
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack

PERSON = Skeleton.preset("person14")
NOISE = 0.03  # metres, along each axis


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> MotionDiffusion:
    """A tiny network that saw walks of 36 people for some six seconds."""
    exact = DetectorNoise.none()
    tracks = film_clips(synthetic_walks(40, seconds=3.0), PERSON, 20.0, views=6, noise=exact).tracks
    trainee = DiffusionTrainee(
        tracks[:-24],
        tracks[-24:],
        DiffusionSettings(12, layers=2, width=64, heads=2, feedforward=128, dropout=0.0),
        augmentation=Augmentation.none(),
    )
    settings = TrainingSettings(
        steps=700, batch=32, learning_rate=4e-3, warmup=50, ema=0.99, checkpoint_every=700
    )
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = train(trainee, settings, tmp_path_factory.mktemp("walks"), progress=False)
    finally:
        torch.set_num_threads(before)
    return MotionDiffusion.load(result.model)


@pytest.fixture(scope="module")
def true() -> list[KeypointTrack]:
    """Walks of other people, from two sides each, without errors: three seconds."""
    bodies = [make_gait("walk", 100 + n, frames=60, fps=20.0).retarget(PERSON) for n in range(6)]
    return project_clips(bodies, views=2, seed=7, noise=DetectorNoise.none())


def detected(track: KeypointTrack, noise: DetectorNoise) -> KeypointTrack:
    """What a detector finds of a centred track: the root is where it is."""
    rng = seeds.generator(1, "detected", track.name)
    keypoints, confidence = noise.detect(rng, track.keypoints)
    keypoints[:, 0], confidence[:, 0] = 0.0, 1.0
    return replace(track, keypoints=keypoints, confidence=confidence)


@pytest.fixture(scope="module")
def came(true: list[KeypointTrack]) -> list[KeypointTrack]:
    return [detected(track, DetectorNoise(found=NOISE, share=0.1)) for track in true]


def off(
    tracks: Sequence[KeypointTrack], true: Sequence[KeypointTrack], where: Sequence[np.ndarray]
) -> float:
    """Root mean square distance from the truth, metres along an axis, of entries ``where``."""
    squares = [
        ((track.keypoints - truth.keypoints) ** 2)[there]
        for track, truth, there in zip(tracks, true, where, strict=True)
    ]
    return float(np.sqrt(np.concatenate(squares).mean()))


def believed(track: KeypointTrack) -> np.ndarray:
    """Joints that were found, but the root, which has no error."""
    found = track.confidence >= 0.3
    found[:, 0] = False
    return found


def test_tracks_come_nearer_to_the_truth(
    prior: MotionDiffusion, true: list[KeypointTrack], came: list[KeypointTrack]
) -> None:
    clean = [denoise_track(track, prior, noise=NOISE) for track in came]
    found = [believed(track) for track in came]
    assert off(came, true, found) == pytest.approx(NOISE, rel=0.05)
    assert off(clean, true, found) < 0.65 * NOISE
    # Each of the tracks, not only their sum.
    for track, truth, there in zip(clean, true, found, strict=True):
        assert off([track], [truth], [there]) < 0.9 * NOISE
    # What was lost is known to a few centimetres; people's joints spread by far more.
    lost = [track.confidence < 0.3 for track in came]
    mean = [
        replace(track, keypoints=np.broadcast_to(prior.standards.mean, track.keypoints.shape))
        for track in true
    ]
    assert off(clean, true, lost) < 0.4 * off(mean, true, lost)
    for track, raw in zip(clean, came, strict=True):
        assert np.isfinite(track.keypoints).all()
        assert (track.name, track.fps, track.frames) == (raw.name, raw.fps, raw.frames)
        np.testing.assert_array_equal(track.keypoints[:, 0], 0.0)
        sure = raw.confidence >= 0.3
        np.testing.assert_array_equal(track.confidence[sure], 1.0)
        np.testing.assert_array_equal(track.confidence[~sure], raw.confidence[~sure])


def test_a_prior_knows_more_than_smoothing(
    prior: MotionDiffusion, true: list[KeypointTrack], came: list[KeypointTrack]
) -> None:
    videos = [track.name for track in came]
    prepared = list(prepare_tracks(came, fps=20.0, videos=videos).tracks)
    assert [track.frames for track in prepared] == [60] * len(true)
    clean = [denoise_track(track, prior, noise=NOISE) for track in came]
    there = [np.isfinite(track.keypoints[..., 0]) for track in prepared]
    # Preparation leaves long gaps open: there, what a straight line in time would say.
    filled = [replace(track, keypoints=straight(track.keypoints)) for track in prepared]
    lost = [raw.confidence < 0.3 for raw in came]
    found = [believed(raw) for raw in came]
    short = [gone & known for gone, known in zip(lost, there, strict=True)]
    long = [gone & ~known for gone, known in zip(lost, there, strict=True)]
    assert off(clean, true, found) < 0.9 * off(filled, true, found)
    assert off(clean, true, short) < 1.05 * off(filled, true, short)
    assert sum(gone.sum() for gone in long) > 200
    assert off(clean, true, long) < 0.8 * off(filled, true, long)
    assert off(clean, true, lost) < 0.8 * off(filled, true, lost)


def straight(keypoints: np.ndarray) -> np.ndarray:
    """Return keypoints, (L, J, 2), whose holes are filled linearly in time, or from one side."""
    time = np.arange(len(keypoints))
    filled = keypoints.copy()
    for joint in range(keypoints.shape[1]):
        known = np.isfinite(keypoints[:, joint, 0])
        for axis in range(2):
            path = keypoints[known, joint, axis]
            filled[:, joint, axis] = np.interp(time, time[known], path)
    return filled


def test_the_right_noise_is_the_best(
    prior: MotionDiffusion, true: list[KeypointTrack], came: list[KeypointTrack]
) -> None:
    found = [believed(track) for track in came]
    errors = {
        noise: off([denoise_track(track, prior, noise=noise) for track in came], true, found)
        for noise in (NOISE / 4, NOISE, 4 * NOISE)
    }
    assert min(errors, key=errors.get) == NOISE


@pytest.mark.parametrize("noise", [1e-6, 1e-3, 0.02, 0.5, 20.0])
def test_no_believed_joint_moves_by_more_than_the_noise(
    prior: MotionDiffusion, came: list[KeypointTrack], noise: float
) -> None:
    for track in came[:3]:
        clean = denoise_track(track, prior, noise=noise)
        for joint in range(1, 14):
            there = believed(track)[:, joint]
            moved = (clean.keypoints - track.keypoints)[there, joint]
            assert 0 < np.sqrt((moved**2).mean()) <= noise * (1 + 1e-9)


def test_an_exact_denoiser_is_left_alone(
    prior: MotionDiffusion, came: list[KeypointTrack], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A Gaussian prior of deviation s about 0: E[x₀ | x] = s²/(s² + σ²) x, exactly.
    deviation = 0.2 / prior.scale

    def shrink(x_t: np.ndarray, alpha_bar: float, cameras: object) -> np.ndarray:
        return np.sqrt(alpha_bar) * deviation**2 * x_t / (alpha_bar * deviation**2 + 1 - alpha_bar)

    monkeypatch.setattr(prior, "denoise", shrink)
    rng = np.random.default_rng(0)
    truth = 0.2 * rng.standard_normal((4000, 14, 2))
    keypoints = truth + 0.1 * rng.standard_normal(truth.shape)
    track = replace(came[0], keypoints=keypoints, confidence=np.ones((4000, 14)))
    clean = denoise_track(track, prior, noise=0.1)
    np.testing.assert_allclose(clean.keypoints, 0.8 * keypoints, atol=1e-12)
    error = np.sqrt(((clean.keypoints - truth) ** 2).mean())
    assert error == pytest.approx(0.2 * 0.1 / np.hypot(0.2, 0.1), rel=0.02)


def test_a_denoiser_with_errors_of_its_own_is_weighed_against_the_detections(
    prior: MotionDiffusion, came: list[KeypointTrack], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two measurements of one point with errors .03 and .04: together .03 · .04 / .05.
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((4000, 14, 2))
    guess = truth + 0.04 * rng.standard_normal(truth.shape)
    keypoints = truth + 0.03 * rng.standard_normal(truth.shape)
    window = prior.settings.frames

    def wrong(x_t: np.ndarray, alpha_bar: float, cameras: object) -> np.ndarray:
        starts = [*range(0, 4000 - window + 1, window // 2), 4000 - window]
        views = [guess[start : start + window] for start in np.unique(starts)]
        return np.stack(views)[:, None] / prior.scale

    monkeypatch.setattr(prior, "denoise", wrong)
    track = replace(came[0], keypoints=keypoints, confidence=np.ones((4000, 14)))
    error = denoise_track(track, prior, noise=0.03).keypoints - truth
    assert np.sqrt((error**2).mean()) == pytest.approx(0.024, rel=0.02)


def test_what_unseen_joints_held_has_no_influence(
    prior: MotionDiffusion, came: list[KeypointTrack]
) -> None:
    track = came[0]
    wanted = denoise_track(track, prior, noise=NOISE).keypoints
    doubted = track.confidence < 0.3
    for value in (np.nan, 1e6, 0.0):
        keypoints = np.where(doubted[..., None], value, track.keypoints)
        for confidence in (0.0, 0.29):
            if np.isnan(value) and confidence:
                continue
            weights = np.where(doubted, confidence, track.confidence)
            other = replace(track, keypoints=keypoints, confidence=weights)
            clean = denoise_track(other, prior, noise=NOISE)
            np.testing.assert_array_equal(clean.keypoints, wanted)
    # How sure a believed joint is does not matter either, only that it is.
    sure = replace(track, confidence=np.where(doubted, 0.0, 1.0))
    np.testing.assert_array_equal(denoise_track(sure, prior, noise=NOISE).keypoints, wanted)
    stricter = denoise_track(track, prior, noise=NOISE, threshold=0.8).keypoints
    assert (stricter != wanted).any()


def test_long_tracks_have_no_seam(prior: MotionDiffusion) -> None:
    body = make_gait("walk", 200, frames=200, fps=20.0).retarget(PERSON)
    (truth,) = project_clips([body], views=1, seed=3, noise=DetectorNoise.none())
    track = detected(truth, DetectorNoise(found=0.01, share=0.05))
    clean = denoise_track(track, prior, noise=0.01)
    assert off([clean], [truth], [np.ones((200, 14), bool)]) < 0.03
    # Windows of 12 frames begin every 6: bends at these frames are as elsewhere.
    bend = abs(np.diff(clean.keypoints, n=2, axis=0)).mean(axis=(1, 2))
    place = np.arange(1, 199) % 6
    means = [bend[place == phase].mean() for phase in range(6)]
    deviation = bend.std() / np.sqrt(len(bend) / 6)
    assert np.ptp(means) < 6 * deviation
    assert max(means) < 1.25 * np.mean(means)


def test_windows_that_disagree_are_blended(
    prior: MotionDiffusion, came: list[KeypointTrack], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Every other window says one metre, the rest minus one metre.
    def stubborn(x_t: np.ndarray, alpha_bar: float, cameras: object) -> np.ndarray:
        sign = np.where(np.arange(len(x_t)) % 2, -1.0, 1.0)[:, None, None, None, None]
        return np.broadcast_to(sign / prior.scale, x_t.shape)

    monkeypatch.setattr(prior, "denoise", stubborn)
    only_root = replace(came[0], confidence=came[0].confidence * (np.arange(14) == 0))
    path = denoise_track(only_root, prior, noise=NOISE).keypoints[:, 1, 0]
    assert path.max() == pytest.approx(1.0)
    assert path.min() < -0.7
    # From one to the other in the half window that both see, in equal steps.
    half = prior.settings.frames / 2
    assert abs(np.diff(path)).max() < 1.1 * 2 / half


def test_frames_far_away_do_not_matter(prior: MotionDiffusion, came: list[KeypointTrack]) -> None:
    # What is drawn back is by joint over the whole track; the network's own estimate is local.
    track = came[1]
    changed = track.keypoints.copy()
    changed[40:] += 0.1
    other = replace(track, keypoints=changed)
    first, second = (
        denoise_track(some, prior, noise=NOISE).keypoints - some.keypoints
        for some in (track, other)
    )
    lost = track.confidence[:20] < 0.3
    np.testing.assert_allclose(first[:20][lost], second[:20][lost], atol=1e-12)


@pytest.mark.parametrize("frames", [2, 5, 12, 13])
def test_tracks_of_any_length(
    prior: MotionDiffusion, came: list[KeypointTrack], frames: int
) -> None:
    track = came[0]
    short = replace(track, keypoints=track.keypoints[:frames], confidence=track.confidence[:frames])
    clean = denoise_track(short, prior, noise=NOISE)
    assert clean.keypoints.shape == (frames, 14, 2)
    assert np.isfinite(clean.keypoints).all()


def test_a_joint_that_is_never_seen_is_made_up(
    prior: MotionDiffusion, true: list[KeypointTrack]
) -> None:
    wrist = PERSON.joint_names.index("left_wrist")
    errors, spread = [], []
    for truth in true:
        keypoints, confidence = truth.keypoints.copy(), truth.confidence.copy()
        keypoints[:, wrist], confidence[:, wrist] = np.nan, 0.0
        track = replace(truth, keypoints=keypoints, confidence=confidence)
        clean = denoise_track(track, prior, noise=0.01)
        errors.append(clean.keypoints[:, wrist] - truth.keypoints[:, wrist])
        spread.append(truth.keypoints[:, wrist] - prior.standards.mean[wrist])
        np.testing.assert_array_equal(clean.confidence[:, wrist], 0.0)
    # The elbow and the other arm say where it is.
    assert np.sqrt(np.square(errors).mean()) < 0.5 * np.sqrt(np.square(spread).mean())


@pytest.mark.parametrize(("scale", "offset"), [(183.0, 0.0), (183.0, 500.0), (1e3, 0.0), (1.0, 9)])
def test_tracks_that_are_not_metres_about_the_root_are_refused(
    prior: MotionDiffusion, came: list[KeypointTrack], scale: float, offset: float
) -> None:
    pixels = replace(came[0], keypoints=scale * came[0].keypoints + offset, name="film/0")
    with pytest.raises(
        ValueError,
        match=r"^track film/0 spans .* root mean square, expected metres about the root, at most",
    ):
        denoise_track(pixels, prior, noise=NOISE)
    # What is not believed does not count, and a body of twice the size is one.
    unsure = np.where(np.arange(14) == 4, 0.1, came[0].confidence)
    far = np.where((np.arange(14) == 4)[:, np.newaxis], 1e6, 2 * came[0].keypoints)
    denoise_track(replace(came[0], keypoints=far, confidence=unsure), prior, noise=NOISE)


def test_bad_input_is_one_sentence(prior: MotionDiffusion, came: list[KeypointTrack]) -> None:
    track = came[0]
    coco = Skeleton.preset("coco17")
    other = KeypointTrack(np.zeros((30, 17, 2)), np.ones((30, 17)), coco, 20.0, "other")
    with pytest.raises(ValueError, match=r"^track is of the joints nose, .*, expected the prior's"):
        denoise_track(other, prior, noise=NOISE)
    with pytest.raises(
        ValueError, match=r"^track is at 30 frames per second, expected the prior's 20; resample"
    ):
        denoise_track(replace(track, fps=30.0), prior, noise=NOISE)
    unsure = replace(track, confidence=0.2 * track.confidence)
    with pytest.raises(ValueError, match=r"has no joint of confidence 0\.3 or more, expected some"):
        denoise_track(unsure, prior, noise=NOISE)
    blind = replace(
        track, keypoints=np.full((60, 14, 2), np.nan), confidence=np.zeros((60, 14)), name=""
    )
    with pytest.raises(ValueError, match=r"^track unnamed has no joint of confidence 0 or more"):
        denoise_track(blind, prior, noise=NOISE, threshold=0.0)
    one = replace(track, keypoints=track.keypoints[:1], confidence=track.confidence[:1])
    with pytest.raises(ValueError, match=r"^track has 1 frame, expected at least 2"):
        denoise_track(one, prior, noise=NOISE)
    for noise in (0.0, -1.0, np.nan, np.inf, None):
        with pytest.raises(ValueError, match=r"^noise must be a finite number above 0, got .*"):
            denoise_track(track, prior, noise=noise)
    for noise in (1e5, 1e200):
        with pytest.raises(
            ValueError, match=r"^noise must be at most .* metres, the most, got 1.*0"
        ):
            denoise_track(track, prior, noise=noise)
    with pytest.raises(ValueError, match=r"^rounds must be an integer of at least 1, got 0"):
        denoise_track(track, prior, noise=NOISE, rounds=0)


# --- real detections ----------------------------------------------------------------------------


def test_real_detections_are_denoised_by_the_prior_that_comes_with_the_package(
    real_data: Path,
) -> None:
    if not (WEIGHTS / "walk2d.safetensors").is_file():
        pytest.skip("the prior walk2d is not there")
    prior = MotionDiffusion.load("walk2d")
    files = str(real_data / "pose2sim_multiview" / "*_T01_*cam_0?.npz")
    tracks = read_tracks([files], prior.skeleton, prior.fps).tracks
    assert len(tracks) == 4
    for track in tracks:
        clean = denoise_track(track, prior, noise=0.03)
        assert np.isfinite(clean.keypoints).all()
        there = believed(track)
        moved = np.linalg.norm(clean.keypoints - track.keypoints, axis=-1)[there]
        assert np.median(moved) < 0.1
        assert np.abs(clean.keypoints).max() < 2.0
