"""Posterior of pose-pairs: draws, pseudo-marginal chains and unusual rigs."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.pair_sets import choose_seed
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs.joint_limits_learning import learn_limits
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.motion.motion import Motion
from probmotion.samplers import MetropolisHastings
from probmotion.samplers.mcmc.proposals import Isotropic

SETTINGS = PairSettings(n_views=4, n_near=8)
DANCE = synthetic_dances(1)[0]
SEED = DANCE.positions[choose_seed(DANCE.positions)]


@pytest.fixture(scope="module")
def posterior():
    return pair_posterior(SEED, draw_annotations([DANCE], 40, seed=0).annotations, SETTINGS)


def run(posterior, **settings):
    sampler = MetropolisHastings(Isotropic(0.02), warmup=30, thin=1, **settings)
    return sampler.sample(posterior, draws=10, chains=2, progress=False)


def test_pseudo_marginal_chains_use_fresh_views(posterior):
    fixed = posterior.likelihood.views.copy()
    draws = run(posterior, pseudo_marginal=True)
    assert np.array_equal(posterior.likelihood.views, fixed)
    with_fixed_views = posterior.log_density(draws.dataset["theta"].values)
    assert np.abs(with_fixed_views - draws.dataset["log_density"].values).max() > 0.1
    assert np.array_equal(run(posterior, pseudo_marginal=True).flat(), draws.flat())
    citations = " ".join(draws.citations())
    assert "Andrieu, Roberts" in citations
    assert "3D pose-pairs from 2D annotations" in citations
    assert "Andrieu" not in " ".join(run(posterior).citations())


def test_unusual_rig_needs_its_own_limits():
    """The hips are far below the pelvis, unlike in the clips of the shipped limits."""
    unusual = DANCE.positions.copy()
    parts = ("hip", "knee", "ankle")
    legs = [k for k, name in enumerate(DANCE.skeleton.joint_names) if name.endswith(parts)]
    unusual[:, legs] -= [0.0, 0.25, 0.0]
    motion = Motion(unusual, DANCE.skeleton, 30.0)
    annotations = draw_annotations([motion], 30, seed=0).annotations
    settings = PairSettings(n_views=4, n_near=8, max_invalid=1)
    with pytest.raises(ValueError, match=r"seed 0 must have at most 1 joint angles .*left_hip"):
        pair_posterior(unusual[0], annotations, settings)
    limits = learn_limits([unusual[:, :17], unusual[:, 17:]])
    posterior = pair_posterior(unusual[0], annotations, settings, limits=limits)
    assert posterior.prior.invalid_joints(unusual[0]) == []
