"""Denoising of recordings: exact in one window, continuous over many, robust to outliers."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.joint_filters import kalman_smooth
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.problems.denoising import gaussian_noise

PERSON = Skeleton.preset("person14")
CLIPS = [clip.retarget(PERSON) for clip in synthetic_walks(12, PERSON, seconds=6.0)]
PRIOR = SpectralMixtureMotion.fit(CLIPS[:10], 30, components=4, progress=False)
TRUTH = CLIPS[11]
NOISE = 0.03
OPTIONS = {"skeleton": PERSON, "fps": TRUTH.fps, "progress": False, "prior": PRIOR}


def noisy(freedom: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return noisy joints with gaps as NaN, and the mask of gaps."""
    rng = np.random.default_rng(0)
    shape = TRUTH.positions.shape
    unit = rng.standard_normal(shape) if freedom is None else rng.standard_t(freedom, shape)
    hidden = np.zeros(shape[:2], bool)
    hidden[20:40, PERSON.index("left_wrist")] = True
    joints = TRUTH.positions + NOISE * unit
    joints[hidden] = np.nan
    return joints, hidden


def test_one_window_is_the_exact_posterior():
    joints, hidden = noisy()
    window = slice(0, round(2 * TRUTH.fps))
    found = denoise_joints(joints[window], noise=NOISE, draws=400, **OPTIONS)
    origin = np.nanmean(joints[window], axis=(0, 1)) * [1.0, 0.0, 1.0]
    prior = PRIOR.resampled(window.stop)
    confidence = (~hidden[window]).astype(float)
    posterior = prior.exact_posterior(Joints3D(joints[window] - origin, NOISE, confidence))
    np.testing.assert_allclose(found.mean, posterior.mean() + origin, atol=1e-8)
    variance = np.diagonal(posterior.covariances(), axis1=-2, axis2=-1)
    np.testing.assert_allclose(found.sd, np.sqrt(variance), atol=1e-7)
    z = (found.draws.mean(axis=0) - found.mean) / (found.sd / 20)
    assert np.abs(z).max() < 5
    np.testing.assert_allclose(found.draws.std(axis=0).mean() / found.sd.mean(), 1, atol=0.05)


def test_windows_join_and_beat_the_smoother():
    joints, hidden = noisy()
    found = denoise_joints(joints, noise=NOISE, draws=8, **OPTIONS)
    smooth, _ = kalman_smooth(joints, (~hidden).astype(float), noise=NOISE, fps=TRUTH.fps)
    errors = [np.linalg.norm(x - TRUTH.positions, axis=-1) for x in (found.mean, smooth)]
    assert errors[0].mean() < 0.9 * errors[1].mean()
    assert errors[0][hidden].mean() < 0.7 * errors[1][hidden].mean()
    inside = np.abs(found.mean - TRUTH.positions) < 1.645 * found.sd
    assert 0.85 < inside.mean() < 0.96
    # Draws are as smooth where windows join as elsewhere.
    jerk = np.abs(np.diff(found.draws, 2, axis=1)).mean(axis=(0, 2, 3))
    assert jerk.max() < 2.5 * np.median(jerk)
    spread = np.sqrt(((found.draws - found.mean) ** 2).mean(axis=0)).mean() / found.sd.mean()
    assert 0.8 < spread < 1.25


def test_unknown_noise_is_estimated():
    joints, _ = noisy()
    found = denoise_joints(joints, draws=0, **OPTIONS)
    assert 0.5 * NOISE < found.noise < 2 * NOISE


def test_outliers_are_discounted():
    joints, hidden = (part[:90] for part in noisy(freedom=2.5))
    robust = denoise_joints(joints, noise=NOISE, degrees_of_freedom=2.5, draws=0, **OPTIONS)
    seen = Joints3D(np.nan_to_num(joints), NOISE, (~hidden).astype(float), 2.5)
    wide = gaussian_noise(seen)
    gaussian = denoise_joints(joints, noise=wide, draws=0, **OPTIONS)
    smooth, _ = kalman_smooth(joints, (~hidden).astype(float), noise=wide, fps=TRUTH.fps)
    errors = [
        np.linalg.norm(x - TRUTH.positions[:90], axis=-1).mean()
        for x in (robust.mean, gaussian.mean, smooth)
    ]
    assert errors[0] < errors[1] < errors[2]


def test_long_gaps_and_lone_frames():
    joints, _ = noisy()
    joints[60:150] = np.nan
    found = denoise_joints(joints, noise=NOISE, draws=2, **OPTIONS)
    assert np.isfinite(found.mean).all()
    assert np.isfinite(found.draws).all()
    assert found.sd[100].mean() > 2 * found.sd[10].mean()
    one = denoise_joints(joints[:1], noise=NOISE, draws=2, **OPTIONS)
    assert one.mean.shape == (1, 14, 3)


def test_face_is_uncertain_if_only_limbs_are_observed():
    coco = Skeleton.preset("coco17")
    walk = make_gait("walk", frames=20, fps=10.0).retarget(coco.subset(range(5, 17))).positions
    joints = np.full((20, 17, 3), np.nan)
    joints[:, 5:] = walk + 0.02 * np.random.default_rng(0).normal(size=walk.shape)
    options = {"skeleton": coco, "fps": 10.0, "noise": 0.02, "draws": 0, "progress": False}
    found = denoise_joints(joints, **options)
    assert (found.sd[:, :5].mean(axis=(1, 2)) > 2 * found.sd[:, 5:].mean(axis=(1, 2))).all()
    error = np.linalg.norm(found.mean[:, 5:] - walk, axis=-1)
    assert error.mean() < 0.02 * np.sqrt(3)
    # The nose is in front of the ears, where the walk leads, and above the shoulders.
    ears = found.mean[:, 3:5].mean(axis=1)
    travel = (walk[-1] - walk[0]).mean(axis=0) * [1.0, 0.0, 1.0]
    assert ((found.mean[:, 0] - ears) @ travel / np.linalg.norm(travel) > 0.08).all()
    assert (ears[:, 1] > walk[:, :2, 1].max(axis=1) + 0.1).all()


def test_invalid_input():
    joints, _ = noisy()
    with pytest.raises(ValueError, match="joints must contain an observed joint, got none"):
        denoise_joints(np.full_like(joints, np.nan), **OPTIONS)
    with pytest.raises(ValueError, match="noise"):
        denoise_joints(joints, noise=-1.0, **OPTIONS)
    other = Skeleton(["a", "b"], [-1, 0])
    with pytest.raises(ValueError, match="skeleton must be person14 or coco17"):
        denoise_joints(joints[:, :2], skeleton=other, fps=30.0, progress=False)
