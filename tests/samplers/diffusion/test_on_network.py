"""Every 2D sampler on a network in the exact prior's place, with every option.

The network is tiny and learnt for a moment: what is tested is the door between the two.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, MotionPosterior
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.track_batches import Augmentation
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import Interrupted
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector, ScoreDistillation
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.guidance import (
    DPS,
    MomentMatched,
    Replacement,
    WeightedTriangulation,
)

BODY = Skeleton(["root", "left_hand", "right_hand", "head"], [-1, 0, 0, 0])
SIZE = replace(DiffusionSettings.tiny(frames=10), width=24, heads=2, feedforward=48)
FEW = {"steps": 6}


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    """What two seconds teach of figures that wave, seen from all sides."""
    rng = np.random.default_rng(0)
    time = np.arange(10) / 10
    tracks = []
    for number in range(200):
        phase, azimuth = rng.uniform(0, 2 * np.pi, 2)
        wave = 0.2 * np.sin(2 * np.pi * time + phase)
        positions = np.zeros((10, 4, 3))
        positions[:, 1] = np.stack([0.4 + 0 * wave, 0.2 + wave, wave], axis=-1)
        positions[:, 2] = np.stack([-0.4 + 0 * wave, 0.2 - wave, wave], axis=-1)
        positions[:, 3, 1] = 0.6
        camera = Cameras.around([azimuth], [math.pi / 16])
        seen = camera.project(positions)[0] + 0.01 * rng.standard_normal((10, 4, 2))
        seen[:, 0] = 0
        tracks.append(KeypointTrack(seen, np.ones((10, 4)), BODY, 20.0, f"clip-{number}/0"))
    trainee = DiffusionTrainee(
        tracks[:180], tracks[180:], SIZE, augmentation=Augmentation(scale=0.0)
    )
    settings = TrainingSettings(steps=300, batch=16, learning_rate=5e-3, ema=0.9)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result = train(trainee, settings, tmp_path_factory.mktemp("wave"), progress=False)
    finally:
        torch.set_num_threads(before)
    return MotionDiffusion.load(result.model)


def drawn(sampler, prior, likelihood=None, draws=3, seed=0):
    posterior = MotionPosterior(prior, likelihood)
    result = sampler.sample(posterior, draws=draws, seed=seed, progress=False)
    found = result.positions.values[0]
    assert found.shape == (draws, prior.frames, 4, 3)
    assert np.isfinite(found).all()
    return found


OPTIONS = {
    "default": {},
    "two views": {"n_views": 2},
    "three": {"n_views": 3},
    "seven": {"n_views": 7},
    "level": {"elevation": 0.0},
    "high": {"elevation": 0.6},
    "independent noise": {"shared_noise": False},
    "prominent": {"view_weights": (5.0, 1.0, 1.0, 1.0, 1.0)},
    "perspective": {"perspective": True},
    "near": {"perspective": True, "distance": 4.0},
    "perspective, prominent": {"perspective": True, "view_weights": (5.0, 1.0, 1.0, 1.0, 1.0)},
    "perspective, independent noise": {"perspective": True, "shared_noise": False},
    "strided": {"trained_steps": 100},
    "perspective, strided": {"perspective": True, "trained_steps": 100},
    "variance": {"variance_for_deviation": True},
    "last": {"stop_level": 2},
    "fourth power": {"schedule_power": 4},
}


@pytest.mark.filterwarnings("ignore:elevation is 0")
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_mas_takes_a_network_with_every_option(prior, options):
    sampler = MultiViewAncestral(**FEW, **options)
    found = drawn(sampler, prior)
    # Draws are motions of this body, in metres, and each is another.
    assert 0.05 < found.std() < 1
    assert abs(found[0] - found[1]).max() > 1e-3
    if options:
        assert abs(found - drawn(MultiViewAncestral(**FEW), prior)).max() > 1e-4


def test_the_authors_settings_run(prior):
    sampler = replace(MultiViewAncestral.reference_code(), steps=8, trained_steps=100)
    assert (sampler.n_views, sampler.schedule_power) == (7, 4)
    drawn(sampler, prior, draws=2)


def test_motions_stand_upright_after_all_steps(prior):
    for perspective in (False, True):
        sampler = MultiViewAncestral(steps=25, trained_steps=100, perspective=perspective)
        found = drawn(sampler, prior, draws=4)
        height = found[..., 3, 1] - found[..., 0, 1]
        # Y is up in the world, down in the pictures: a sign that is wrong turns heads down.
        assert height.mean() == pytest.approx(0.6, abs=0.15)
        np.testing.assert_allclose(found[..., 0, :], 0, atol=0.02)


@pytest.mark.parametrize("perspective", [False, True])
def test_a_new_view_is_replayed(prior, perspective):
    sampler = MultiViewAncestral(steps=5, perspective=perspective)
    posterior = MotionPosterior(prior)
    trace = sampler.trace(posterior, draws=2, seed=3)
    finished = drawn(sampler, prior, draws=2, seed=3) / prior.scale
    np.testing.assert_allclose(trace.estimates[-1], finished, atol=1e-6)
    new = Cameras.around([0.7], [0.2], perspective=perspective)
    seen = trace.replay(new)
    assert seen.shape == (2, 1, 10, 4, 2)
    wanted = np.stack([new.project(motion * prior.scale) for motion in finished]) / prior.scale
    np.testing.assert_allclose(seen, wanted, atol=1e-6)
    for level in (1, 3, 5):
        noisy = trace.replay(new, level=level)
        # A view that no one denoised can be denoised in its place.
        clean = prior.denoise(noisy, float(sampler.schedule.alpha_bar[level]), new)
        assert np.isfinite(clean).all()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"levels": "annealed"},
        {"shared_noise": True, "n_views": 3},
        {"weighting": "variance", "n_views": 2},
        {"weighting": "residual"},
    ],
    ids=["uniform", "annealed", "shared noise", "variance", "residual"],
)
def test_sds_takes_a_network(prior, options):
    still = drawn(ScoreDistillation(iterations=1, learning_rate=1e-9), prior, draws=2)
    found = drawn(ScoreDistillation(iterations=20, **options), prior, draws=2)
    assert abs(found - still).max() > 0.01


@pytest.mark.parametrize(
    "sampler",
    [
        replace(MultiViewPredictorCorrector(), steps=6),
        replace(MultiViewPredictorCorrector.accurate(), steps=6),
        replace(MultiViewPredictorCorrector.accurate(), steps=6, trained_steps=100, n_views=3),
    ],
    ids=["default", "accurate", "strided"],
)
def test_mvpc_takes_a_network(prior, sampler):
    found = drawn(sampler, prior)
    assert 0.05 < found.std() < 1
    without = replace(sampler, corrector_steps=0)
    assert abs(drawn(without, prior) - found).max() > 1e-3


def test_single_views_take_a_network(prior):
    sampler = Ancestral2D(steps=20, trained_steps=100)
    posterior = MotionPosterior(prior)
    views = sampler.sample_views(posterior, draws=4, progress=False)
    assert views.shape == (4, 10, 4, 2)
    assert views[:, :, 3, 1].mean() == pytest.approx(-0.6, abs=0.15)
    small = replace(sampler, batch=1).sample_views(posterior, draws=4, progress=False)
    np.testing.assert_array_equal(small, views)


GUIDANCES = {
    "moment-matched": MomentMatched(),
    "replacement": Replacement(),
    "weighted triangulation": WeightedTriangulation(weight=20.0),
    "dps": DPS(step_size=0.5),
}


@pytest.mark.parametrize("kind", ["keypoints", "joints"])
@pytest.mark.parametrize("guidance", GUIDANCES.values(), ids=GUIDANCES)
def test_evidence_pulls_draws_towards_it(prior, guidance, kind):
    sampler = MultiViewAncestral(steps=20, trained_steps=100, guidance=guidance)
    truth = drawn(sampler, prior, draws=1, seed=9)[0]
    if kind == "keypoints":
        cameras = Cameras.around([0.3], [0.1])
        evidence = Keypoints2D(cameras.project(truth), cameras, noise=0.02)

        def distance(motions):
            seen = np.stack([cameras.project(motion) for motion in motions])
            return np.sqrt(((seen - cameras.project(truth)) ** 2).mean())
    else:
        evidence = Joints3D(truth, noise=0.02)

        def distance(motions):
            return np.sqrt(((motions - truth) ** 2).mean())

    free = drawn(sampler, prior, draws=4, seed=1)
    pulled = drawn(sampler, prior, evidence, draws=4, seed=1)
    assert distance(pulled) < 0.7 * distance(free)


def test_mvpc_is_guided_too(prior):
    sampler = MultiViewPredictorCorrector(steps=15)
    truth = drawn(sampler, prior, draws=1, seed=9)[0]
    evidence = Joints3D(truth, noise=0.02)
    gaps = [
        np.sqrt(((drawn(sampler, prior, given, draws=4, seed=1) - truth) ** 2).mean())
        for given in (None, evidence)
    ]
    assert gaps[1] < 0.7 * gaps[0]


@pytest.mark.parametrize("frames", [2, 7])
def test_other_lengths(prior, frames):
    short = prior.of_length(frames)
    for sampler in (
        MultiViewAncestral(**FEW),
        MultiViewAncestral(perspective=True, **FEW),
        MultiViewPredictorCorrector(**FEW),
        ScoreDistillation(iterations=5),
    ):
        drawn(sampler, short, draws=2)
    evidence = Joints3D(np.zeros((frames, 4, 3)), noise=0.1)
    drawn(MultiViewAncestral(**FEW), short, evidence, draws=2)


@pytest.mark.parametrize(
    "sampler",
    [
        MultiViewAncestral(**FEW),
        MultiViewAncestral(perspective=True, **FEW),
        MultiViewAncestral(shared_noise=False, **FEW),
        MultiViewPredictorCorrector(**FEW),
        ScoreDistillation(iterations=8),
    ],
    ids=["mas", "perspective", "independent noise", "mvpc", "sds"],
)
def test_draws_do_not_depend_on_the_batch_to_the_last_bit(prior, sampler):
    whole = drawn(sampler, prior, draws=23)
    for batch in (1, 10):
        np.testing.assert_array_equal(drawn(replace(sampler, batch=batch), prior, draws=23), whole)


def test_guided_draws_do_not_depend_on_the_batch(prior):
    evidence = Joints3D(np.zeros((10, 4, 3)), noise=0.1)
    sampler = MultiViewAncestral(**FEW)
    whole = drawn(sampler, prior, evidence, draws=13)
    alone = drawn(replace(sampler, batch=1), prior, evidence, draws=13)
    np.testing.assert_allclose(alone, whole, atol=1e-5)


def test_ctrl_c_keeps_the_finished_batches(prior):
    class Stops(MotionDiffusion):
        calls = 0

        def denoise(self, x_t, alpha_bar, cameras):
            self.calls += 1
            if self.calls == 15:
                raise KeyboardInterrupt
            return super().denoise(x_t, alpha_bar, cameras)

    stopping = prior.of_length(prior.frames)
    stopping.__class__ = Stops
    sampler = MultiViewAncestral(batch=2, **FEW)
    with pytest.raises(Interrupted) as stopped:
        sampler.sample(MotionPosterior(stopping), draws=9, seed=0, progress=False)
    kept = stopped.value.draws.positions.values[0]
    np.testing.assert_array_equal(kept, drawn(sampler, prior, draws=4))
