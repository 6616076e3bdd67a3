"""Tests of `correct_joints` with a stand-in for the network's prediction."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.mixture.denoising import DenoisedJoints
from probmotion.motion.skeleton import Skeleton
from probmotion.problems.joint_correction import _plausible, correct_joints
from probmotion.samplers import DVAEInference

PERSON = Skeleton.preset("person14")
SD = 0.01


def walk(fps):
    return make_gait("walk", frames=round(3 * fps), fps=fps).retarget(PERSON).positions


def denoised(truth):
    rng = np.random.default_rng(0)
    mean = truth + 0.5 * SD * rng.standard_normal(truth.shape)
    return DenoisedJoints(
        mean, np.full(truth.shape, SD), mean + SD * rng.standard_normal((4, *truth.shape)), 0.03
    )


@pytest.fixture
def predicted(monkeypatch):
    """Replace the prediction by that in the list, and record the observations there."""
    values = []

    def predict(sampler, posterior, **options):
        values.append((sampler, posterior))
        return SimpleNamespace(positions=values[0])

    monkeypatch.setattr(DVAEInference, "predict", predict)
    return values


def test_the_mean_is_that_of_the_network_and_deviations_are_kept(predicted):
    truth = walk(30.0)
    found = denoised(truth)
    predicted.append(truth)
    corrected = correct_joints(found, fps=30.0, progress=False)
    np.testing.assert_allclose(corrected.mean, truth, atol=1e-12)
    np.testing.assert_allclose(
        corrected.draws - corrected.mean, found.draws - found.mean, atol=1e-12
    )
    assert corrected.sd is found.sd
    sampler, posterior = predicted[1]
    assert (sampler.mode, sampler.iterations) == ("optimization", 50)
    evidence = posterior.likelihood
    np.testing.assert_array_equal(evidence.joints, found.mean)
    deviation = evidence.noise / np.sqrt(evidence.entries.confidence)
    np.testing.assert_allclose(deviation, SD)
    correct_joints(found, fps=30.0, iterations=0, progress=False)
    assert predicted[2][0].mode == "regression"


def test_corrections_are_interpolated_at_other_rates(predicted):
    found = denoised(walk(60.0))
    offset = np.linspace(-0.01, 0.01, 90)[:, None, None]
    predicted.append(found.mean[::2] + offset)
    corrected = correct_joints(found, fps=60.0, progress=False)
    change = (corrected.mean - found.mean)[:179]
    np.testing.assert_allclose(change, np.linspace(-0.01, 0.01, 179)[:, None, None] + 0 * change)


def test_the_mean_is_kept_where_the_network_fails(predicted):
    found = denoised(walk(30.0))
    wrong = np.full((90, 1, 1), 0.5 * SD)
    wrong[30:40] = 3 * SD
    predicted.append(found.mean + wrong)
    with pytest.warns(UserWarning, match=r"does not explain [12]\.\d of 3\.0 s"):
        corrected = correct_joints(found, fps=30.0, progress=False)
    change = corrected.mean - found.mean
    assert (change[30:40] == 0).all()
    np.testing.assert_allclose(change[-1], 0.5 * SD)


def test_plausible_corrections_are_below_one_standard_deviation():
    size = np.where(np.arange(200) < 100, 0.9, 1.1)[:, None, None] * np.ones((200, 2, 3))
    weight = _plausible(size, 30)
    assert (weight[:60] == 1).all()
    assert (weight[100:] == 0).all()
    assert (np.diff(weight) <= 0).all()


@pytest.mark.parametrize(
    ("joints", "frames", "fps", "message"),
    [
        (13, 90, 30.0, "found must have the 14 joints of the prior, got 13"),
        (14, 2, 120.0, "the recording must last at least 0.067 s, got 0.017 s"),
        (14, 90, 0.0, "fps must be"),
    ],
)
def test_refused_recordings(joints, frames, fps, message):
    found = denoised(walk(30.0)[:frames, :joints])
    with pytest.raises(ValueError, match=message):
        correct_joints(found, fps=fps, progress=False)
