"""Fitting: windows, headings, probabilistic PCA per style."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.models import GaussianMixtureMotion
from probmotion.models.mixture.fit import cut_windows, turn_to

SIDES = Skeleton(["root", "left_hip", "right_hip"], [-1, 0, 0])


def clips_of(windows, skeleton=SIDES, fps=30.0):
    return [Motion(window, skeleton, fps, name=f"c{i}") for i, window in enumerate(windows)]


def made_style(rng, n, turned=True):
    """Windows of one known style: a mean body, two directions, small noise; any heading."""
    body = np.array([[0.0, 1.0, 0.0], [0.2, 1.0, 0.1], [-0.2, 1.0, 0.1]])
    mean = np.tile(body, (4, 1, 1)) + 0.3 * rng.normal(size=(4, 1, 3))
    factors = rng.normal(size=(2, 4, 3, 3)) * np.array([0.2, 0.1])[:, None, None, None]
    factors[..., [0, 2]] *= 0.0  # Vertical only, so that they leave the heading alone.
    z = rng.normal(size=(n, 2))
    windows = mean + np.tensordot(z, factors, 1) + 0.01 * rng.normal(size=(n, 4, 3, 3))
    motions = clips_of(windows)
    if turned:
        motions = [motion.turned(rng.uniform(0, 2 * np.pi)) for motion in motions]
    return motions, mean, factors


def test_fit_finds_the_style_that_made_the_clips():
    rng = np.random.default_rng(0)
    motions, mean, factors = made_style(rng, 2000)
    prior = GaussianMixtureMotion.fit(motions, 4, rank=2, styles=1)
    assert prior.weights == pytest.approx([1.0])
    # Centring on the root removes its 3 of 36 dimensions' mean noise and couples what is left.
    assert prior.noise == pytest.approx(0.01, rel=0.1)
    centre = mean - mean[:, 0].mean(axis=0)
    aligned = turn_to(prior.means, centre)[0]
    np.testing.assert_allclose(aligned, centre, atol=0.02)
    fitted = prior.factors[0].reshape(2, -1)
    shifted = (factors - factors[:, :, :1].mean(axis=1, keepdims=True)).reshape(2, -1)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(fitted @ fitted.T), np.linalg.eigvalsh(shifted @ shifted.T), rtol=0.15
    )


def test_fit_is_the_closed_form_of_probabilistic_pca():
    """At the maximum-likelihood fit the model's covariance has the data's leading spectrum."""
    rng = np.random.default_rng(1)
    motions, _, _ = made_style(rng, 500, turned=False)
    prior = GaussianMixtureMotion.fit(motions, 4, rank=2, styles=1, azimuths=1)
    W = prior.factors[0].reshape(2, -1)
    model = np.linalg.eigvalsh(W.T @ W + prior.noise**2 * np.eye(36))[::-1]
    windows, _ = cut_windows(motions, 4)
    from probmotion.models.mixture.fit import _common_heading, _turned_to_mean

    aligned = _turned_to_mean(_common_heading(windows, motions[0])).reshape(500, -1)
    data = np.linalg.eigvalsh(np.cov(aligned.T))[::-1]
    np.testing.assert_allclose(model[:2], data[:2], rtol=1e-9)
    np.testing.assert_allclose(model.sum(), data.sum(), rtol=1e-9)


def test_labels_or_clusters_give_the_styles():
    clips = make_gaits(120, seed=3)
    labels = [clip.name.rpartition("-")[0] for clip in clips]
    by_label = GaussianMixtureMotion.fit(clips, 30, rank=5, styles=labels)
    assert by_label.styles == ("march", "run", "walk")
    assert by_label.weights == pytest.approx([0.2, 0.3, 0.5])
    found = GaussianMixtureMotion.fit(clips, 30, rank=5, styles=2)
    assert found.styles == ("style-0", "style-1")
    assert found.weights[0] >= found.weights[1]


def test_the_heading_of_a_clip_does_not_matter():
    clips = make_gaits(60, styles={"walk": 1.0}, seed=4)
    rng = np.random.default_rng(5)
    turned = [clip.turned(rng.uniform(0, 2 * np.pi)) for clip in clips]
    a = GaussianMixtureMotion.fit(clips, 30, rank=5, styles=1)
    b = GaussianMixtureMotion.fit(turned, 30, rank=5, styles=1)
    np.testing.assert_allclose(a.means, b.means, atol=1e-9)
    assert a.noise == pytest.approx(b.noise, rel=1e-9)


def test_windows_are_centred_and_cover_each_clip():
    motion = make_gaits(1, styles={"walk": 1.0}, frames=50)[0]
    windows, clip_of = cut_windows([motion, motion], 20, stride=10)
    assert windows.shape == (8, 20, 17, 3)
    assert clip_of.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    np.testing.assert_allclose(windows[:, :, 0].mean(axis=1), 0, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: cut_windows([], 10), "motions must contain at least one clip, got none"),
        (
            lambda: cut_windows(make_gaits(2, frames=10), 11),
            "motions has at most 10 frames in a clip, expected at least frames=11",
        ),
        (
            lambda: cut_windows([*make_gaits(2), *make_gaits(2, fps=25.0)], 10),
            "expected clips of one frame rate",
        ),
        (
            lambda: cut_windows(
                [*make_gaits(2), *make_gaits(1, styles={"quadruped-trot": 1.0})], 10
            ),
            "expected clips of one skeleton",
        ),
        (
            lambda: GaussianMixtureMotion.fit(make_gaits(10), 30, rank=10, styles=1),
            "puts 10 windows into style-0, expected at least 12 for rank 10",
        ),
        (
            lambda: GaussianMixtureMotion.fit(make_gaits(10), 30, styles=["walk"]),
            "styles has 1 labels, expected 10, one per motion",
        ),
        (
            lambda: GaussianMixtureMotion.fit(make_gaits(10), 0),
            "frames must be an integer of at least 1, got 0",
        ),
    ],
)
def test_wrong_input_is_one_sentence(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()
