"""Fixture of a tiny Motion-DVAE with random weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Skeleton
from probmotion.models.bodies.body_states import BodyStates
from probmotion.models.dvae.motion_dvae import MotionDVAE, description_of
from probmotion.models.dvae.network import DVAEModel
from probmotion.models.dvae.settings import DVAESettings

BODY = Skeleton(
    ["hips", "chest", "left_hand", "right_hand", "left_foot", "right_foot"], [-1, 0, 1, 1, 0, 0]
)
REST = np.array(
    [[0, 0, 0], [0, 0.5, 0], [0.4, 0.1, 0], [-0.4, 0.1, 0], [0.1, -0.8, 0], [-0.1, -0.8, 0]]
)
RANK = 4


def random_prior(frames=5, seed=0, spread_latents=False, changes=None, **options):
    """Return a prior with random weights; its bodies stand upright and move little."""
    size = replace(DVAESettings.tiny(), frames=frames, latent=3, **(changes or {}))
    states = BodyStates(BODY, REST)
    model = DVAEModel(size, states.dim, BODY.n_joints, RANK, seed)
    rng = np.random.default_rng(seed)
    mean = np.concatenate([[0, 0.9, 0], np.tile([1.0, 0, 0, 0, 1, 0], len(states.turning))])
    for name, value in (
        ("state_mean", mean),
        ("state_deviation", rng.uniform(0.1, 0.3, states.dim)),
        ("joint_mean", 0.1 * rng.normal(size=(6, 3))),
        ("joint_deviation", rng.uniform(0.2, 0.5, (6, 3))),
        ("initial_mean", mean),
        ("initial_factor", 0.1 * rng.normal(size=(states.dim, RANK))),
    ):
        getattr(model, name).copy_(torch.as_tensor(value))
    if spread_latents:
        with torch.no_grad():
            model.generative.latent_prior[-1].weight.mul_(3.0)
    card = {"network": description_of(size, states, 30.0, RANK)}
    return MotionDVAE(model, size, states, 30.0, card=card, **options)


@pytest.fixture(scope="session")
def make_prior():
    return random_prior
