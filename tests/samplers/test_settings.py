"""Tests of the validation of settings, the presets, and strided schedules."""

from __future__ import annotations

import math

import numpy as np
import pytest

from probmotion import NoiseSchedule
from probmotion.samplers import (
    NUTS,
    Ancestral3D,
    DVAEInference,
    Ensemble,
    MetropolisHastings,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
    ParallelTempering,
    ScoreDistillation,
    SequentialMonteCarlo,
)
from probmotion.samplers.diffusion import SecondOrderSDE, StochSync
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.guidance import DPS, MomentMatched, WeightedTriangulation
from probmotion.samplers.diffusion.noise_levels import Cosine
from probmotion.samplers.mcmc.proposals import AdaptiveCovariance, Isotropic, VelocityBiased
from probmotion.samplers.variational.amortised import AmortisedSettings

COUNT = "must be an integer of at least"
POSITIVE = "must be a finite number above 0"
FROM_0 = "must be a finite number of at least 0"
FREEDOM = "degrees_of_freedom must be a number above 0 or inf"


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (MetropolisHastings, {"warmup": -1}, f"warmup {COUNT} 0"),
        (MetropolisHastings, {"thin": 0}, f"thin {COUNT} 1"),
        (MetropolisHastings, {"candidates": 0}, f"candidates {COUNT} 1"),
        (MetropolisHastings, {"proposal": VelocityBiased}, "proposal must be a proposal object"),
        (MetropolisHastings, {"proposal": "isotropic"}, r"such as Isotropic\(\), got 'isotropic'"),
        (Ensemble, {"walkers": 1}, f"walkers {COUNT} 2"),
        (ParallelTempering, {"rungs": 1}, f"rungs {COUNT} 2, got 1"),
        (ParallelTempering, {"warmup": -1}, f"warmup {COUNT} 0"),
        (SequentialMonteCarlo, {"particles": 1}, f"particles {COUNT} 2"),
        (SequentialMonteCarlo, {"moves": 0}, f"moves {COUNT} 1"),
        (NUTS, {"warmup": 0}, f"warmup {COUNT} 1"),
        (NUTS, {"target_acceptance": 1.0}, "target_acceptance must be between 0 and 1, got 1.0"),
        (Isotropic, {"scale": 0.0}, f"scale {POSITIVE}"),
        (AdaptiveCovariance, {"scale": np.inf}, f"scale {POSITIVE}"),
        (VelocityBiased, {"target": "0.2"}, "target must be between 0 and 1, got '0.2'"),
        (VelocityBiased, {"bias": 0.0}, f"bias {POSITIVE}"),
        (Ancestral2D, {"batch": 0}, f"batch {COUNT} 1"),
        (
            Ancestral3D,
            {"steps": 200, "levels": Cosine(trained_steps=100)},
            "steps must be at most the sched.*100",
        ),
        (MultiViewAncestral, {"n_views": 1}, f"n_views {COUNT} 2"),
        (MultiViewAncestral, {"stop_level": 101}, "stop_level must be at most steps, 100, got 101"),
        (MultiViewAncestral, {"view_weights": (1.0, 2.0)}, r"view_weights must have shape \(5\)"),
        (MultiViewAncestral, {"view_weights": (0.0,) * 5}, f"view_weights {POSITIVE}"),
        (MultiViewPredictorCorrector, {"corrector_size": 1.5}, "corrector_size must be at most 1"),
        (MultiViewPredictorCorrector, {"gamma": 2.0}, "gamma must be at most 1"),
        (MultiViewPredictorCorrector, {"corrector_steps": -1}, f"corrector_steps {COUNT} 0"),
        (MultiViewPredictorCorrector, {"gamma_from": math.nan}, f"gamma_from {FROM_0}"),
        (MultiViewPredictorCorrector, {"gamma": -1.0}, f"gamma {FROM_0}"),
        (MultiViewPredictorCorrector, {"gamma": "1"}, f"gamma {FROM_0}, got '1'"),
        (
            MultiViewAncestral,
            {"stop_level": 99, "integrator": SecondOrderSDE()},
            r"steps must be at least 3 with integrator SecondOrderSDE\(\), got 2",
        ),
        (Ancestral3D, {"guidance": "dps"}, r"guidance must be MomentMatched\(\), DPS\(\), Repl"),
        (
            MultiViewAncestral,
            {"guidance": DPS},
            r"guidance must be MomentMatched\(\), DPS\(\), Repl",
        ),
        (StochSync, {"guidance": DPS()}, r"must be WeightedTriangulation\(\) or Replacement\(\)"),
        (Cosine, {"power": 0}, f"power {POSITIVE}"),
        (ScoreDistillation, {"levels": "falling"}, "levels must be one of uniform, annealed, got"),
        (ScoreDistillation, {"weighting": "none"}, "weighting must be one of constant, variance,"),
        (ScoreDistillation, {"azimuths": 2, "n_views": 3}, f"azimuths {COUNT} 3"),
        (ScoreDistillation, {"steps": 1}, f"steps {COUNT} 2"),
        (ScoreDistillation, {"learning_rate": 0.0}, f"learning_rate {POSITIVE}"),
        (ScoreDistillation, {"arc": 7.0}, "arc must be at most 2 pi, got 7.0"),
        (MomentMatched, {"steps": 0}, f"steps {COUNT} 1"),
        (DPS, {"step_size": -1.0}, f"step_size {POSITIVE}"),
        (WeightedTriangulation, {"weight": 0.0}, f"weight {POSITIVE}"),
        (AmortisedSettings, {"pairs": 99}, f"pairs {COUNT} 100"),
        (DVAEInference, {"mode": "both"}, "mode must be one of regression, optimization, got 'bo"),
        (DVAEInference, {"training_pairs": 99}, f"training_pairs {COUNT} 100"),
        (DVAEInference, {"learning_rate": 0.0}, f"learning_rate {POSITIVE}"),
        (DVAEInference, {"degrees_of_freedom": 0.0}, f"{FREEDOM}, got 0.0"),
        (DVAEInference, {"degrees_of_freedom": "4"}, f"{FREEDOM}, got '4'"),
        (DVAEInference, {"latent_weight": -0.1}, f"latent_weight {FROM_0}, got -0.1"),
        (DVAEInference, {"network": "body-dvae"}, "network must be an InferenceNetwork, got 'body"),
    ],
)
def test_settings_out_of_range(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind(**settings)


def test_presets():
    code = MultiViewAncestral.reference_code()
    assert code == MultiViewAncestral(
        n_views=7, perspective=True, levels=Cosine(power=4), stop_level=2
    )
    assert MultiViewPredictorCorrector.accurate() == MultiViewPredictorCorrector(
        steps=200, corrector_steps=2, corrector_size=0.4
    )
    assert MultiViewPredictorCorrector.learnt().levels == Cosine()
    assert ScoreDistillation.reference_code() == ScoreDistillation(
        iterations=1000, weighting="residual", arc=1.0, schedule_power=4
    )
    assert DVAEInference.paper() == DVAEInference(
        mode="optimization", iterations=50, degrees_of_freedom=4.0, initial_entropy=False
    )


@pytest.mark.parametrize(
    "kind", [Ancestral2D, Ancestral3D, MultiViewAncestral, MultiViewPredictorCorrector]
)
def test_levels_are_strided_from_a_longer_schedule(kind):
    schedule = kind(steps=20, levels=Cosine(power=4, trained_steps=100)).schedule
    expected = NoiseSchedule.cosine(100, power=4).alpha_bar[::5]
    np.testing.assert_array_equal(schedule.alpha_bar, expected)
