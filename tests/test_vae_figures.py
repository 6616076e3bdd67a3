"""Codes drawn given motions: against a Gaussian, and against codes that are known."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch

from probmotion.models.vae.motion_vae import MotionVAE

SCRIPTS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def script():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        yield importlib.import_module("vae_figures")


def test_draws_of_a_gaussian_have_its_moments(script):
    covariance = torch.tensor([[1.0, 0.09], [0.09, 0.01]], dtype=torch.float64)
    precision = torch.linalg.inv(covariance)
    mean = torch.tensor([2.0, -1.0], dtype=torch.float64)

    def energy(x):
        return 0.5 * ((x - mean) @ precision * (x - mean)).sum(dim=1)

    n = 2000
    start = torch.zeros((n, 2), dtype=torch.float64)
    draws = script.hamiltonian_draws(energy, start, np.random.default_rng(0))
    scale = covariance.diagonal().sqrt()
    standard = ((draws - mean) / scale).numpy()
    np.testing.assert_allclose(standard.mean(axis=0), 0, atol=4 / np.sqrt(n))
    np.testing.assert_allclose(np.cov(standard.T), [[1, 0.9], [0.9, 1]], atol=6 / np.sqrt(n))


@pytest.mark.slow
def test_codes_drawn_given_simulated_motion_vary_as_those_simulated(script):
    prior, rng, n = MotionVAE.load("walk-vae"), np.random.default_rng(0), 16
    z = prior.initial(rng, n)
    posed, image = script.filmed(prior, z, rng)
    truth = posed + prior.card["deviation"] * rng.standard_normal(posed.shape)
    drawn = script.codes_of(prior, truth, script.centred(prior, image), rng).numpy()
    assert np.mean(drawn**2) == pytest.approx(np.mean(z**2), rel=0.15)
    assert np.corrcoef(drawn.ravel(), z.ravel())[0, 1] > 0.1
