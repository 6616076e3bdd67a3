"""Tests of the network that corrects spectral posteriors."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.extras import torch
from probmotion.models.dvae.joint_corrector import (
    CorrectorNetwork,
    CorrectorSettings,
    JointCorrector,
)
from probmotion.models.training.checkpoints import CheckpointError
from probmotion.motion.skeleton import Skeleton

PERSON = Skeleton.preset("person14")
TINY = CorrectorSettings(frames=20, width=16, layers=1, heads=2)


@pytest.fixture
def windows():
    rng = np.random.default_rng(0)
    walk = make_gait("walk", frames=40, fps=30.0).retarget(PERSON).positions
    mean = np.stack([walk[:20], walk[20:]]) + 0.01 * rng.standard_normal((2, 20, 14, 3))
    return mean, np.full((2, 20, 14), 0.02)


def corrector(trained: bool = True) -> JointCorrector:
    torch.manual_seed(0)
    network = CorrectorNetwork(TINY, PERSON)
    if trained:
        for part in (network.head, network.energy):
            torch.nn.init.normal_(part.weight)
    return JointCorrector(network, TINY, PERSON, 30.0)


def turned(positions, angle):
    c, s = np.cos(angle), np.sin(angle)
    return positions @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T


def test_an_untrained_network_corrects_nothing(windows):
    correction, energy = corrector(trained=False).correct(*windows)
    assert (correction == 0).all()
    assert energy.shape == (2, 3, 14)


def test_corrections_are_bounded_by_three_standard_deviations(windows):
    mean, sd = windows
    correction, _ = corrector().correct(mean, sd)
    size = np.linalg.norm(correction, axis=-1) / np.sqrt(3)
    assert 2 * sd.max() < size.max() < 3 * sd.max()


def test_corrections_turn_and_move_with_the_recording(windows):
    mean, sd = windows
    network = corrector()
    correction, energy = network.correct(mean, sd)
    moved, same = network.correct(turned(mean, 2.0) + np.array([5.0, 0.0, -3.0]), sd)
    np.testing.assert_allclose(moved, turned(correction, 2.0), atol=2e-5)
    np.testing.assert_allclose(same, energy, rtol=1e-3)
    raised, _ = network.correct(mean + np.array([0.0, 0.5, 0.0]), sd)
    assert abs(raised - correction).max() > 1e-3  # heights matter


def test_bands_of_energies_start_above_one_hertz():
    assert corrector().band_edges.tolist() == [5, 9, 17]
    assert JointCorrector.load("joint-corrector").band_edges.tolist() == [5, 9, 17, 33]


def test_saved_correctors_are_loaded(windows, tmp_path):
    network = corrector()
    network.save(tmp_path / "corrector.safetensors")
    loaded = JointCorrector.load(tmp_path / "corrector.safetensors")
    assert (loaded.settings, loaded.skeleton, loaded.fps) == (TINY, PERSON, 30.0)
    for got, expected in zip(loaded.correct(*windows), network.correct(*windows), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_other_networks_are_refused():
    with pytest.raises(CheckpointError, match="must contain a joint-corrector, got a motion-dvae"):
        JointCorrector.load("body-dvae")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 10, "heads": 4}, "width must be a multiple of heads=4, got 10"),
        ({"dropout": 1.0}, "dropout must be at least 0 and below 1, got 1.0"),
        ({"layers": 0}, "layers"),
    ],
)
def test_invalid_settings(changes, message):
    with pytest.raises(ValueError, match=message):
        CorrectorSettings(**changes)
