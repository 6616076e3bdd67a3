"""Accuracy of the shipped Motion-DVAE on held-out real clips."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.joint_filters import kalman_smooth, savitzky_golay
from probmotion.metrics import accuracy
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.problems.denoising import body_of, body_prior, limb_occlusions
from probmotion.problems.joint_correction import correct_joints
from probmotion.samplers import DVAEInference

FRAMES, NOISE = 60, 0.04
FILTERS = ("Savitzky-Golay", "Kalman")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:the network does not explain:UserWarning"),
]


@pytest.fixture(scope="module")
def errors(real_data):
    """Return the mean error of all and of occluded joints by estimator, metres."""
    prior = body_prior()
    fit = DVAEInference(mode="optimization")
    errors = {}
    for number, clip in enumerate(denoising_clips(real_data)["test"]):
        frames = min(FRAMES, clip.frames)
        truth = clip.window((clip.frames - frames) // 2, frames)
        hidden = limb_occlusions(truth)
        likelihood = Joints3D.observe(truth, NOISE, number, hidden=hidden)
        adapted = prior.of(frames=frames, body=body_of(likelihood, prior))
        posterior = MotionPosterior(adapted, likelihood)
        seen = likelihood.entries.confidence
        estimates = {
            "Savitzky-Golay": savitzky_golay(likelihood.joints, seen > 0, fps=truth.fps),
            "Kalman": kalman_smooth(likelihood.joints, seen, noise=NOISE, fps=truth.fps)[0],
            "regression": replace(fit, mode="regression").predict(posterior).positions,
            "optimization": fit.predict(posterior, progress=False).positions,
        }
        found = denoise_joints(
            likelihood.joints, seen, skeleton=truth.skeleton, fps=truth.fps, noise=NOISE, draws=0,
            progress=False,
        )  # fmt: skip
        estimates |= {"spectral": found.mean}
        for name, iterations in (("corrected", 50), ("amortised", 0)):
            result = correct_joints(found, fps=truth.fps, iterations=iterations, progress=False)
            estimates[name] = result.mean
        for name, positions in estimates.items():
            error = accuracy.joint_errors(positions, truth.positions)
            errors.setdefault(name, []).append((error.mean(), error[hidden].mean()))
    return {name: np.mean(rows, axis=0) for name, rows in errors.items()}


ALL, OCCLUDED = 0, 1


def best_filter(errors, joints):
    return min(errors[name][joints] for name in FILTERS)


def test_optimisation_beats_filters_on_occluded_joints_and_is_on_par_on_all(errors):
    assert errors["optimization"][OCCLUDED] < 0.9 * best_filter(errors, OCCLUDED)
    # 29.5 mm against 30.8 mm.
    assert 0.9 < errors["optimization"][ALL] / best_filter(errors, ALL) < 1


def test_corrected_means_are_better_than_those_of_the_spectral_prior(errors):
    # `accuracy.py learnt` has ratios of .92 and .93 without optimisation, .89 and .86 with it;
    # these are seven windows, which differ.
    assert errors["amortised"][ALL] < 0.95 * errors["spectral"][ALL]
    assert errors["corrected"][ALL] < 0.95 * errors["spectral"][ALL]
    assert errors["corrected"][OCCLUDED] < 0.92 * errors["spectral"][OCCLUDED]


def test_corrected_means_without_optimisation_beat_filters(errors):
    assert errors["amortised"][ALL] < 0.9 * best_filter(errors, ALL)
    assert errors["amortised"][OCCLUDED] < 0.9 * best_filter(errors, OCCLUDED)


def test_regression_alone_is_behind_filters(errors):
    assert errors["regression"][ALL] > best_filter(errors, ALL)
    assert errors["regression"][OCCLUDED] > best_filter(errors, OCCLUDED)
