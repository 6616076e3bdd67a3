"""Tests of `correct_joints` with stand-ins for the networks."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.fft import dct

from probmotion.data.synthetic.gaits import make_gait
from probmotion.models.mixture.denoising import DenoisedJoints
from probmotion.motion.skeleton import Skeleton
from probmotion.problems.joint_correction import _weight, correct_joints
from probmotion.samplers import DVAEInference

PERSON = Skeleton.preset("person14")
SD = 0.01
ENERGY = 1e-8


def walk(fps, seconds=3):
    return make_gait("walk", frames=round(seconds * fps), fps=fps).retarget(PERSON).positions


def denoised(truth, draws=4):
    rng = np.random.default_rng(0)
    mean = truth + 0.5 * SD * rng.standard_normal(truth.shape)
    deviations = SD * rng.standard_normal((draws, *truth.shape))
    return DenoisedJoints(mean, np.full(truth.shape, SD), mean + deviations, 0.03)


class Constant:
    """Corrector that shifts all joints by ``shift``, in all windows or in those at numbers."""

    skeleton, fps, settings = PERSON, 30.0, SimpleNamespace(frames=60)
    band_edges = np.array([5, 9, 17, 33])

    def __init__(self, shift, windows=None):
        self.shift, self.windows, self.given = shift, windows, []

    def correct(self, mean, sd):
        self.given.append((mean, sd))
        chosen = np.ones(len(mean)) if self.windows is None else self.windows(len(mean))
        shift = chosen[:, None, None, None] * self.shift
        return shift + np.zeros(mean.shape), np.full((len(mean), 4, 14), ENERGY)


def test_mean_and_draws_are_moved_and_slow_deviations_are_kept():
    found = denoised(walk(30.0, seconds=2))
    network = Constant(0.5 * SD)
    corrected = correct_joints(found, fps=30.0, iterations=0, corrector=network)
    ((mean, sd),) = network.given
    np.testing.assert_allclose(mean[0], found.mean, atol=1e-12)
    np.testing.assert_allclose(sd, SD)
    np.testing.assert_allclose(corrected.mean, found.mean + 0.5 * SD, atol=1e-12)
    assert corrected.sd is found.sd
    old, new = (dct(each.draws - each.mean, axis=1, norm="ortho") for each in (found, corrected))
    np.testing.assert_allclose(new[:, :5], old[:, :5], atol=1e-12)
    for band in (slice(5, 9), slice(9, 17), slice(17, 33), slice(33, None)):
        np.testing.assert_allclose((new[:, band] ** 2).mean(axis=(0, 1, 3)), ENERGY)
    ratio = new[:, 5:9] / old[:, 5:9]
    np.testing.assert_allclose(ratio, ratio[:1, :1, :, :1] + 0 * ratio)


def test_long_recordings_are_corrected_in_overlapping_windows():
    found = denoised(walk(30.0, seconds=5), draws=0)
    network = Constant(0.5 * SD)
    corrected = correct_joints(found, fps=30.0, iterations=0, corrector=network)
    assert network.given[0][0].shape == (4, 60, 14, 3)
    np.testing.assert_allclose(corrected.mean, found.mean + 0.5 * SD, atol=1e-12)
    assert corrected.draws.shape == (0, 150, 14, 3)


@pytest.mark.parametrize("frames", [120, 45])
def test_windows_are_interpolated_at_other_rates(frames):
    found = denoised(walk(60.0)[:frames])
    network = Constant(0.5 * SD)
    corrected = correct_joints(found, fps=60.0, iterations=0, corrector=network)
    ((mean, _),) = network.given
    known = min(60, (frames + 1) // 2)
    np.testing.assert_allclose(mean[0, :known], found.mean[: 2 * known : 2], atol=1e-12)
    # Shorter recordings end with their last frame.
    np.testing.assert_allclose(mean[0, known:], found.mean[-1] + 0 * mean[0, known:], atol=1e-12)
    np.testing.assert_allclose(corrected.mean, found.mean + 0.5 * SD, atol=1e-12)
    spectrum = dct(corrected.draws - corrected.mean, axis=1, norm="ortho")
    first = -(-33 * frames // 120)  # the same frequency, in half cycles of the recording
    np.testing.assert_allclose((spectrum[:, first:] ** 2).mean(axis=(0, 1, 3)), 2 * ENERGY)


def test_the_mean_is_kept_where_the_network_fails():
    found = denoised(walk(30.0, seconds=6))
    network = Constant(3 * SD, lambda n: (np.arange(n) == 0).astype(float))
    with pytest.warns(UserWarning, match=r"does not explain [123]\.\d of 6\.0 s"):
        corrected = correct_joints(found, fps=30.0, iterations=0, corrector=network)
    change = corrected.mean - found.mean
    assert (change[:30] == 0).all()
    network = Constant(0.5 * SD)
    corrected = correct_joints(found, fps=30.0, iterations=0, corrector=network)
    np.testing.assert_allclose((corrected.mean - found.mean)[-1], 0.5 * SD)


@pytest.fixture
def predicted(monkeypatch):
    """Replace the Motion-DVAE's motion by that in the list, and record the observations there."""
    values = []

    def predict(sampler, posterior, **options):
        values.append((sampler, posterior))
        return SimpleNamespace(positions=values[0])

    monkeypatch.setattr(DVAEInference, "predict", predict)
    return values


def test_the_optimised_mean_counts_by_the_ratio_of_deviation_and_noise(predicted):
    truth = walk(30.0)
    found = denoised(truth)
    occluded = np.array(found.sd)
    occluded[20:30, 4] = 0.06
    found = replace(found, sd=occluded)
    first = found.mean + 0.5 * SD
    predicted.append(truth)
    corrected = correct_joints(found, fps=30.0, corrector=Constant(0.5 * SD), progress=False)
    share = np.full((90, 14, 1), SD / found.noise)
    share[20:30, 4] = 1.0
    np.testing.assert_allclose(corrected.mean, first + share * (truth - first), atol=1e-12)
    assert corrected.sd is found.sd
    sampler, posterior = predicted[1]
    assert (sampler.mode, sampler.iterations) == ("optimization", 50)
    evidence = posterior.likelihood
    np.testing.assert_allclose(evidence.joints, first)
    deviation = evidence.noise / np.sqrt(evidence.entries.confidence)
    np.testing.assert_allclose(deviation, occluded[..., 0])


def test_optimised_corrections_are_interpolated_at_other_rates(predicted):
    found = denoised(walk(60.0))
    offset = np.linspace(-0.01, 0.01, 90)[:, None, None]
    predicted.append(found.mean[::2] + offset)
    corrected = correct_joints(found, fps=60.0, corrector=Constant(0.0), progress=False)
    change = 3 * (corrected.mean - found.mean)[:179]
    np.testing.assert_allclose(change, np.linspace(-0.01, 0.01, 179)[:, None, None] + 0 * change)


def test_plausible_corrections_are_below_one_standard_deviation():
    size = np.where(np.arange(200) < 100, 0.9, 1.1)[:, None, None] * np.ones((200, 2, 3))
    weight = _weight(size, 30)
    assert (weight[:60] == 1).all()
    assert (weight[100:] == 0).all()
    assert (np.diff(weight) <= 0).all()


def test_the_shipped_network_is_the_default():
    found = denoised(walk(30.0))
    corrected = correct_joints(found, fps=30.0, iterations=0)
    size = np.linalg.norm(corrected.mean - found.mean, axis=-1)
    assert 0.1 * SD < size.mean() < SD


@pytest.mark.parametrize(
    ("joints", "frames", "fps", "message"),
    [
        (13, 90, 30.0, "found must have the 14 joints of the corrector, got 13"),
        (14, 1, 30.0, "the recording must have at least 2 frames, got 1"),
        (14, 2, 120.0, "the recording must last at least 0.067 s, got 0.017 s"),
        (14, 90, 0.0, "fps must be"),
    ],
)
def test_refused_recordings(joints, frames, fps, message):
    found = denoised(walk(30.0)[:frames, :joints])
    with pytest.raises(ValueError, match=message):
        correct_joints(found, fps=fps, corrector=Constant(0.0), progress=False)
