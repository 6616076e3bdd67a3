"""What the shipped Motion-DVAE is claimed to do on real clips that were held out whole."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.joint_filters import kalman_smooth, savitzky_golay
from probmotion.metrics import accuracy
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.problems.denoising import body_of, body_prior, limbs_hidden
from probmotion.samplers import DVAEInference

FRAMES, NOISE = 60, 0.04


FILTERS = ("Savitzky-Golay", "Kalman")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def errors(real_data) -> dict[str, tuple[float, float]]:
    """Mean error of all joints and of hidden ones, by estimate, metres."""
    prior = body_prior()
    fit = DVAEInference(mode="optimization")
    found: dict[str, list[tuple[float, float]]] = {}
    for number, clip in enumerate(denoising_clips(real_data)["test"]):
        frames = min(FRAMES, clip.frames)
        truth = clip.window((clip.frames - frames) // 2, frames)
        hidden = limbs_hidden(truth)
        evidence = Joints3D.observe(truth, NOISE, number, hidden=hidden)
        believed = prior.of(frames=frames, body=body_of(evidence, prior))
        posterior = MotionPosterior(believed, evidence)
        seen = evidence.entries.confidence
        estimates = {
            "Savitzky-Golay": savitzky_golay(evidence.joints, seen > 0, fps=truth.fps),
            "Kalman": kalman_smooth(evidence.joints, seen, noise=NOISE, fps=truth.fps)[0],
            "regression": replace(fit, mode="regression").predict(posterior).positions,
            "optimization": fit.predict(posterior, progress=False).positions,
        }
        for name, positions in estimates.items():
            error = accuracy.joint_errors(positions, truth.positions)
            found.setdefault(name, []).append((error.mean(), error[hidden].mean()))
    return {name: tuple(np.mean(rows, axis=0)) for name, rows in found.items()}


def of_filters(errors: dict[str, tuple[float, float]], which: int) -> float:
    return min(errors[name][which] for name in FILTERS)


def test_a_fit_beats_the_filters_on_hidden_joints(errors):
    assert errors["optimization"][1] < 0.9 * of_filters(errors, 1)


def test_a_fit_is_level_with_the_filters_in_all(errors):
    assert errors["optimization"][0] < of_filters(errors, 0)


@pytest.mark.xfail(strict=True, reason="29.5 mm against 30.8: half an hour of motion was learnt")
def test_a_fit_beats_the_filters_in_all(errors):
    assert errors["optimization"][0] < 0.9 * of_filters(errors, 0)


@pytest.mark.xfail(strict=True, reason="the networks answer poorly to actions they never saw")
def test_regression_beats_the_filters_on_hidden_joints(errors):
    assert errors["regression"][1] < 0.9 * of_filters(errors, 1)
