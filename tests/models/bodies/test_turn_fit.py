"""Bone rotations that reproduce joints."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")
from probmotion.data.synthetic import synthetic_animals
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.models.bodies.turn_fit import fit_turns
from probmotion.models.vae.motion_vae import MotionVAE


def test_joints_of_made_animals_are_reproduced_within_millimetres() -> None:
    """Of other proportions than the body, facing anywhere."""
    body = MotionVAE.load("animal-vae").body
    clips = [clip.turned(1.0 + k).resample(10.0) for k, clip in enumerate(synthetic_animals(2))]
    positions = np.array([clip.positions[:4] for clip in clips])
    fit = fit_turns(body, positions)
    again = body.positions(fit.turns, fit.rotation, fit.translation, fit.log_lengths)
    distances = np.linalg.norm(again - positions, axis=-1)
    assert distances.mean() == pytest.approx(fit.error, rel=1e-6)
    assert distances.mean() < 0.005
    assert float(body.range_excess(fit.turns).max()) < 0.05


def test_small_rotations_are_preferred() -> None:
    body = MotionVAE.load("animal-vae").body
    shape = (1, 1, len(body.bones), 3)
    rest = body.positions(
        np.zeros(shape), vector_to_matrix(np.zeros((1, 1, 3))), np.zeros((1, 1, 3))
    )
    assert np.abs(fit_turns(body, rest).turns).max() < 0.01
