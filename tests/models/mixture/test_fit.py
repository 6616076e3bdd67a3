"""Fitting the mixture: windows, headings and probabilistic PCA per style."""

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.models import GaussianMixtureMotion
from probmotion.models.mixture.fit import (
    _common_heading,
    _rotated_to_mean,
    cut_windows,
    turn_to,
)

SIDES = Skeleton(["root", "left_hip", "right_hip"], [-1, 0, 0])


def synthetic_style(rng, n, turned=True):
    """Return clips of one style: a mean body, two directions, small noise and random headings."""
    body = np.array([[0.0, 1.0, 0.0], [0.2, 1.0, 0.1], [-0.2, 1.0, 0.1]])
    mean = np.tile(body, (4, 1, 1)) + 0.3 * rng.normal(size=(4, 1, 3))
    factors = rng.normal(size=(2, 4, 3, 3)) * np.array([0.2, 0.1])[:, None, None, None]
    factors[..., [0, 2]] = 0.0  # Vertical, so the heading is unchanged.
    windows = mean + np.tensordot(rng.normal(size=(n, 2)), factors, 1)
    windows += 0.01 * rng.normal(size=(n, 4, 3, 3))
    motions = [Motion(window, SIDES, 30.0) for window in windows]
    if turned:
        motions = [motion.turned(rng.uniform(0, 2 * np.pi)) for motion in motions]
    return motions, mean, factors


def test_fit_recovers_the_style_of_synthetic_clips():
    motions, mean, factors = synthetic_style(np.random.default_rng(0), 2000)
    prior = GaussianMixtureMotion.fit(motions, 4, rank=2, styles=1)
    assert prior.weights == pytest.approx([1.0])
    # Centring on the root changes the noise slightly.
    assert prior.noise == pytest.approx(0.01, rel=0.1)
    centre = mean - mean[:, 0].mean(axis=0)
    np.testing.assert_allclose(turn_to(prior.means, centre)[0], centre, atol=0.02)
    fitted = prior.factors[0].reshape(2, -1)
    shifted = (factors - factors[:, :, :1].mean(axis=1, keepdims=True)).reshape(2, -1)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(fitted @ fitted.T), np.linalg.eigvalsh(shifted @ shifted.T), rtol=0.15
    )


def test_fit_reproduces_the_leading_spectrum_of_the_data():
    """Maximum-likelihood probabilistic PCA matches the r leading variances and the total."""
    motions, _, _ = synthetic_style(np.random.default_rng(1), 500, turned=False)
    prior = GaussianMixtureMotion.fit(motions, 4, rank=2, styles=1, azimuths=1)
    W = prior.factors[0].reshape(2, -1)
    model = np.linalg.eigvalsh(W.T @ W + prior.noise**2 * np.eye(36))[::-1]
    windows, _ = cut_windows(motions, 4)
    aligned = _rotated_to_mean(_common_heading(windows, motions[0])).reshape(500, -1)
    data = np.linalg.eigvalsh(np.cov(aligned.T))[::-1]
    np.testing.assert_allclose(model[:2], data[:2], rtol=1e-9)
    np.testing.assert_allclose(model.sum(), data.sum(), rtol=1e-9)


def test_styles_come_from_labels_or_clusters():
    clips = make_gaits(120, seed=3)
    labels = [clip.name.rpartition("-")[0] for clip in clips]
    by_label = GaussianMixtureMotion.fit(clips, 30, rank=5, styles=labels)
    assert by_label.styles == ("march", "run", "walk")
    assert by_label.weights == pytest.approx([0.2, 0.3, 0.5])
    clustered = GaussianMixtureMotion.fit(clips, 30, rank=5, styles=2)
    assert clustered.styles == ("style-0", "style-1")
    assert clustered.weights[0] >= clustered.weights[1]


def test_fit_is_invariant_to_clip_headings():
    clips = make_gaits(60, styles={"walk": 1.0}, seed=4)
    rng = np.random.default_rng(5)
    turned = [clip.turned(rng.uniform(0, 2 * np.pi)) for clip in clips]
    a, b = (GaussianMixtureMotion.fit(motions, 30, rank=5, styles=1) for motions in (clips, turned))
    np.testing.assert_allclose(a.means, b.means, atol=1e-9)
    assert a.noise == pytest.approx(b.noise, rel=1e-9)


def test_rotations_are_recovered_exactly():
    target = np.random.default_rng(6).normal(size=(4, 3, 3))
    motion = Motion(target, SIDES, 30.0)
    turned = np.stack([motion.turned(angle).positions for angle in (-2.0, 0.4, 3.0)])
    np.testing.assert_allclose(turn_to(turned, target), [target] * 3, atol=1e-12)


def test_windows_are_centred_and_cover_each_clip():
    motion = make_gaits(1, styles={"walk": 1.0}, frames=50)[0]
    windows, clip_of = cut_windows([motion, motion], 20, stride=10)
    assert windows.shape == (8, 20, 17, 3)
    assert len(cut_windows([motion], 20)[0]) == 7  # every 5 frames
    assert clip_of.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    np.testing.assert_allclose(windows[:, :, 0].mean(axis=1), 0, atol=1e-12)


def test_invalid_clips_are_rejected():
    clips = make_gaits(10)
    dogs = make_gaits(1, styles={"quadruped-trot": 1.0})
    for motions, message in (
        ([], "motions must contain at least one clip, got none"),
        (clips, "motions must contain a clip of at least 99 frames, got at most"),
        ([*clips, *make_gaits(2, fps=25.0)], "motions must share one frame rate"),
        ([*clips, *dogs], "motions must share one skeleton"),
    ):
        with pytest.raises(ValueError, match=message):
            cut_windows(motions, 99)
    for options, message in (
        ({"rank": 10, "styles": 1}, "style-0 must have at least 12 windows for rank 10, got 10"),
        ({"styles": ["walk"]}, "styles must contain 10 labels, one per motion, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            GaussianMixtureMotion.fit(clips, 30, **options)
