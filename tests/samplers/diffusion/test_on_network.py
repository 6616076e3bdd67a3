"""Tests of all samplers of 2D denoisers with a small network as the prior."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, Keypoints2D, MotionPosterior
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector, ScoreDistillation
from probmotion.samplers.conditional.split_gibbs import SplitGibbs
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.guidance import (
    DPS,
    MomentMatched,
    Replacement,
    WeightedTriangulation,
)
from probmotion.samplers.diffusion.noise_levels import Cosine
from probmotion.threads import one_thread

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
SIZE = replace(DiffusionSettings.tiny(frames=10), width=24, heads=2, feedforward=48)


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    """Return a small network trained on random views of waving bodies."""
    rng = np.random.default_rng(0)
    time, tracks = np.arange(10) / 10, []
    for number in range(200):
        phase, azimuth = rng.uniform(0, 2 * np.pi, 2)
        wave = 0.2 * np.sin(2 * np.pi * time + phase)
        positions = np.zeros((10, 4, 3))
        positions[:, 1] = np.stack([0.4 + 0 * wave, 0.2 + wave, wave], axis=-1)
        positions[:, 2] = np.stack([-0.4 + 0 * wave, 0.2 - wave, wave], axis=-1)
        positions[:, 3, 1] = 0.6
        camera = Cameras.around([azimuth], [math.pi / 16])
        keypoints = camera.project(positions)[0] + 0.01 * rng.standard_normal((10, 4, 2))
        keypoints[:, 0] = 0
        tracks.append(KeypointTrack(keypoints, np.ones((10, 4)), BODY, 20.0, f"clip-{number}/0"))
    trainee = DiffusionTrainee(
        tracks[:180], tracks[180:], SIZE, augmentation=Augmentation(scale=0.0)
    )
    settings = TrainingSettings(steps=300, batch=16, learning_rate=5e-3, ema=0.9)
    with one_thread():
        result = train(trainee, settings, tmp_path_factory.mktemp("wave"), progress=False)
    return MotionDiffusion.load(result.model)


def draw(sampler, prior, likelihood=None, draws=3, seed=0):
    posterior = MotionPosterior(prior, likelihood)
    result = sampler.sample(posterior, draws=draws, seed=seed, progress=False)
    motions = result.positions.values[0]
    assert motions.shape == (draws, prior.frames, 4, 3)
    assert np.isfinite(motions).all()
    return motions


OPTIONS = [
    (MultiViewAncestral, {"n_views": 2}),
    (MultiViewAncestral, {"shared_noise": False}),
    (MultiViewAncestral, {"perspective": True, "distance": 4.0}),
    (MultiViewAncestral, {"perspective": True, "view_weights": (5.0, 1.0, 1.0, 1.0, 1.0)}),
    (MultiViewAncestral, {"perspective": True, "shared_noise": False}),
    (MultiViewAncestral, {"perspective": True, "levels": Cosine(trained_steps=100)}),
    (MultiViewAncestral, {"stop_level": 2}),
    (
        MultiViewPredictorCorrector,
        {"corrector_steps": 2, "n_views": 3},
    ),
    (ScoreDistillation, {"levels": "annealed"}),
    (ScoreDistillation, {"shared_noise": True, "n_views": 3}),
    (ScoreDistillation, {"weighting": "residual"}),
]


@pytest.mark.parametrize(
    ("kind", "options"), OPTIONS, ids=[f"{kind.name}-{'-'.join(o)}" for kind, o in OPTIONS]
)
def test_every_option_changes_the_draws(prior, kind, options):
    effort = {"iterations": 20} if kind is ScoreDistillation else {"steps": 6}
    default, changed = (draw(kind(**effort, **o), prior) for o in ({}, options))
    assert 0.05 < changed.std() < 2
    assert abs(changed[0] - changed[1]).max() > 1e-3
    assert abs(changed - default).max() > 1e-4


def test_motions_are_upright(prior):
    levels = Cosine(trained_steps=100)
    for perspective in (False, True):
        sampler = MultiViewAncestral(steps=25, levels=levels, perspective=perspective)
        motions = draw(sampler, prior, draws=4)
        height = motions[..., 3, 1] - motions[..., 0, 1]
        # Y is up in 3D and down in images.
        assert height.mean() == pytest.approx(0.6, abs=0.15)
        np.testing.assert_allclose(motions[..., 0, :], 0, atol=0.02)


def test_single_views(prior):
    sampler, posterior = (
        Ancestral2D(steps=20, levels=Cosine(trained_steps=100)),
        MotionPosterior(prior),
    )
    views = sampler.sample_views(posterior, draws=4, progress=False)
    assert views.shape == (4, 10, 4, 2)
    assert views[:, :, 3, 1].mean() == pytest.approx(-0.6, abs=0.15)
    single = replace(sampler, batch=1).sample_views(posterior, draws=4, progress=False)
    np.testing.assert_array_equal(single, views)


def label(sampler):
    guidance = getattr(sampler, "guidance", None)
    return sampler.name if guidance is None else f"{sampler.name}-{guidance.kind}"


GUIDED = [
    *(
        MultiViewAncestral(steps=15, levels=Cosine(trained_steps=100), guidance=guidance)
        for guidance in (MomentMatched(), Replacement(), WeightedTriangulation(20.0), DPS(0.5))
    ),
    MultiViewPredictorCorrector(steps=15),
    SplitGibbs(steps=10, sweeps=2),
]


@pytest.mark.parametrize("kind", ["keypoints", "joints"])
@pytest.mark.parametrize("sampler", GUIDED, ids=label)
def test_guided_draws_are_closer_to_the_observations(prior, sampler, kind):
    # Split Gibbs sampling requires observations.
    free = MultiViewPredictorCorrector(steps=15) if isinstance(sampler, SplitGibbs) else sampler
    truth = draw(free, prior, draws=1, seed=9)[0]
    cameras = Cameras.around([0.3], [0.1])
    project = cameras.project if kind == "keypoints" else np.asarray
    likelihood = Joints3D(truth, noise=0.02)
    if kind == "keypoints":
        likelihood = Keypoints2D(cameras.project(truth), cameras, noise=0.02)
    unguided, guided = (
        np.sqrt(np.mean([(project(motion) - project(truth)) ** 2 for motion in motions]))
        for motions in (draw(free, prior, seed=1), draw(sampler, prior, likelihood, seed=1))
    )
    assert guided < 0.7 * unguided


OBSERVED = Joints3D(np.zeros((10, 4, 3)), noise=0.1)
FEW_STEPS = SplitGibbs(steps=4, sweeps=2, inner_steps=4, start_steps=8, particles=3)
SAMPLERS = [
    MultiViewAncestral(steps=6),
    MultiViewAncestral(steps=6, perspective=True),
    MultiViewAncestral(steps=6, shared_noise=False),
    MultiViewPredictorCorrector(steps=6),
    ScoreDistillation(iterations=8),
]


@pytest.mark.parametrize("sampler", [*SAMPLERS, FEW_STEPS])
def test_draws_are_bit_identical_for_any_batch(prior, sampler):
    likelihood = OBSERVED if isinstance(sampler, SplitGibbs) else None
    motions = draw(sampler, prior, likelihood, draws=13)
    batched = draw(replace(sampler, batch=5), prior, likelihood, draws=13)
    np.testing.assert_array_equal(batched, motions)


@pytest.mark.parametrize("perspective", [False, True])
def test_levels_above_the_trained_range_are_refused(prior, perspective):
    with pytest.raises(ValueError, match=r"^noise levels must be at most .*; use levels=Cosine"):
        draw(MultiViewAncestral(steps=101, perspective=perspective), prior, draws=1)


def test_short_motions(prior):
    for sampler in SAMPLERS:
        draw(sampler, prior.of_length(2), draws=2)
    likelihood = Joints3D(np.zeros((7, 4, 3)), noise=0.1)
    draw(MultiViewAncestral(steps=6), prior.of_length(7), likelihood, draws=2)
