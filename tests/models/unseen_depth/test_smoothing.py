"""Smoothed lifts against the posteriors of single frames."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.interaction.annotations.sources import world_axes
from probmotion.models.unseen_depth import AnnotationPrior, smoothed_lifts

J, FRAMES, FPS = 5, 60, 30.0


def made_prior() -> AnnotationPrior:
    """Return a prior with correlated joints, seen from twelve azimuths."""
    rng = np.random.default_rng(3)
    mean = np.array(
        [[0, 0.9, 0], [0.3, 0.6, 0.1], [-0.3, 0.6, 0.1], [0.2, 0, 0.3], [-0.2, 0, -0.2]]
    )
    factor = 0.04 * rng.normal(size=(3 * J, 6))
    azimuths = 2 * np.pi * np.arange(12) / 12
    return AnnotationPrior(
        np.ones(1),
        (mean - mean.mean(axis=0))[None],
        (factor @ factor.T + 0.005**2 * np.eye(3 * J))[None],
        0.02,
        np.stack([azimuths, 0 * azimuths], axis=1),
    )


PRIOR = made_prior()


def filmed(n: int, seed: int) -> np.ndarray:
    """Return keypoints (n, J, 2) of poses of the prior, each in one of its views."""
    rng = np.random.default_rng(seed)
    axes = world_axes(PRIOR.views[rng.integers(len(PRIOR.views), size=n)])
    images = np.einsum("nai,nji->nja", axes[:, :2], PRIOR.sample(rng, n))
    return images + PRIOR.noise * rng.standard_normal(images.shape)


def test_frames_of_a_still_pose_keep_their_posterior():
    keypoints = np.repeat(filmed(1, 5), FRAMES, axis=0)
    lifts = PRIOR.lift(keypoints)
    n = 4000
    result = smoothed_lifts(PRIOR, keypoints, FPS, np.random.default_rng(0), n)
    np.testing.assert_allclose(result.positions, lifts.positions, atol=1e-9)
    np.testing.assert_allclose(result.sd, lifts.sd, rtol=1e-9)
    own = PRIOR.sample_lifts(keypoints[:1], np.random.default_rng(1), n)[:, 0]
    wanted, got = (np.cov(draws.reshape(n, -1).T) for draws in (own, result.draws[:, 20]))
    scale = np.sqrt(np.outer(wanted.diagonal(), wanted.diagonal()))
    assert np.abs(got - wanted).max() < 5 * scale.max() / np.sqrt(n)


def test_noise_of_keypoints_is_averaged_over_a_longer_time_in_depth():
    rng = np.random.default_rng(1)
    keypoints = np.repeat(filmed(1, 5), 300, axis=0)
    keypoints += 0.01 * rng.standard_normal(keypoints.shape)
    own = PRIOR.lift(keypoints).positions
    smoothed = smoothed_lifts(PRIOR, keypoints, FPS, rng, 2).positions
    image, depth = (smoothed[..., a].std(axis=0) / own[..., a].std(axis=0) for a in (0, 2))
    # Averages with weights of standard deviation s frames divide white noise by √(2 s √π).
    assert 0.3 < image.mean() < 0.45
    assert depth.mean() < 0.25


def test_draws_have_the_means_and_deviations():
    keypoints = filmed(FRAMES, 6)  # another pose in every frame
    n = 2000
    result = smoothed_lifts(PRIOR, keypoints, FPS, np.random.default_rng(0), n)
    error = (result.draws.mean(axis=0) - result.positions) / (result.sd / np.sqrt(n))
    assert np.abs(error).max() < 5.5
    ratio = result.draws.std(axis=0) / result.sd
    assert np.abs(ratio - 1).max() < 5.5 / np.sqrt(2 * n) + 0.02
    # Neighbouring frames of a draw are close: errors of depth last.
    steps = np.diff(result.draws[..., 2] - result.positions[..., 2], axis=1).std()
    assert steps < 0.15 * result.sd[..., 2].mean()


def test_frames_that_show_nobody_are_interpolated_with_large_deviations():
    keypoints = filmed(FRAMES, 6)
    keypoints[20:40] = np.nan
    keypoints[50, 1:] = np.nan  # a single joint
    result = smoothed_lifts(PRIOR, keypoints, FPS, np.random.default_rng(0), 400)
    assert np.isfinite(result.positions).all()
    assert (result.sd[30] > 1.3 * result.sd[5]).mean() > 0.8
    inside = np.abs(result.draws[:, 30] - result.positions[30]) < 1.645 * result.sd[30]
    assert 0.85 < inside.mean() < 0.95


def test_keypoints_without_a_visible_pose_are_refused():
    with pytest.raises(ValueError, match="keypoints must show 2 joints in one frame, got none"):
        smoothed_lifts(PRIOR, np.full((9, J, 2), np.nan), FPS, np.random.default_rng(0), 2)
