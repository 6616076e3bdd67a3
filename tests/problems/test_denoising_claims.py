"""What the shipped Motion-DVAE is claimed to do on real clips that were held out whole."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.joint_filters import kalman_smooth, savitzky_golay
from probmotion.likelihoods import Joints3D
from probmotion.metrics import accuracy
from probmotion.posterior import MotionPosterior
from probmotion.problems.denoising import body_of, body_prior, limbs_hidden
from probmotion.samplers import DVAEInference

FRAMES, NOISE = 60, 0.04


@pytest.mark.slow
def test_it_beats_the_filters_on_hidden_joints_and_in_all(real_data):
    prior = body_prior()
    fit = DVAEInference(mode="optimization")
    errors: dict[str, list[tuple[float, float]]] = {}
    for number, clip in enumerate(denoising_clips(real_data)["test"]):
        frames = min(FRAMES, clip.frames)
        truth = clip.window((clip.frames - frames) // 2, frames)
        hidden = limbs_hidden(truth)
        evidence = Joints3D.observe(truth, NOISE, number, hidden=hidden)
        believed = prior.of(frames=frames, body=body_of(evidence, prior))
        posterior = MotionPosterior(believed, evidence)
        seen = evidence.entries.confidence
        found = {
            "Savitzky-Golay": savitzky_golay(evidence.joints, seen > 0, fps=truth.fps),
            "Kalman": kalman_smooth(evidence.joints, seen, noise=NOISE, fps=truth.fps)[0],
            "optimization": fit.predict(posterior, progress=False).positions,
        }
        for name, positions in found.items():
            error = accuracy.joint_errors(positions, truth.positions)
            errors.setdefault(name, []).append((error.mean(), error[hidden].mean()))
    total, of_hidden = {}, {}
    for name, rows in errors.items():
        total[name], of_hidden[name] = np.mean(rows, axis=0)
    filters = ("Savitzky-Golay", "Kalman")
    assert total["optimization"] < min(total[name] for name in filters)
    assert of_hidden["optimization"] < 0.9 * min(of_hidden[name] for name in filters)
