"""Devices: choice, random numbers and precision, with shapes alone or a second precision on a CPU.

Tests with the marker ``gpu`` compare CUDA with the CPU; ``make gpu`` runs them.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import probmotion as pm
from probmotion.data.projections import DetectorNoise, project_clips
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.tracks.learning import film_clips
from probmotion.models.bodies.articulated_body import ArticulatedBody
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.diffusion.motion_diffusion import MotionDiffusion
from probmotion.models.diffusion.settings import DiffusionSettings
from probmotion.models.diffusion.training import DiffusionTrainee
from probmotion.models.dvae.denoiser_training import DenoiserTrainee
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.settings import DVAESettings
from probmotion.models.dvae.training import DVAETrainee
from probmotion.models.evaluation.evaluator import TrackEvaluator
from probmotion.models.evaluation.evaluator_training import EvaluatorTrainee
from probmotion.models.evaluation.lifter import LifterNetwork, LifterSettings, PoseLifter
from probmotion.models.evaluation.lifter_training import LifterTrainee
from probmotion.models.evaluation.pose_flow import FlowSettings
from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee
from probmotion.models.evaluation.track_autoencoder import EvaluatorSettings
from probmotion.models.training.devices import (
    check_device,
    half_precision,
    inference,
    is_half_precision,
)
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.vae.settings import MotionVAESettings
from probmotion.models.vae.training import MotionVAETrainee, PoseTrainee
from probmotion.motion.rest_poses import estimate_rest_pose
from probmotion.motion.skeleton import Skeleton

CPU, META = torch.device("cpu"), torch.device("meta")
PERSON = Skeleton.preset("person14")
TRAINEES = ("diffusion", "evaluator", "flow", "lifter", "dvae", "denoiser", "poses", "vae")
SAMPLERS = {
    "mas": pm.samplers.MultiViewAncestral(steps=10),
    "mvpc": pm.samplers.MultiViewPredictorCorrector(steps=10),
}
CAMERAS = pm.Cameras.ring(2, elevation=math.pi / 16)
TOLERANCE = 1e-4  # metres, and of normalised units and losses


@cache
def clips():
    made = make_gaits(6, styles={"walk": 1}, frames=60, fps=20.0, seed=1)
    return [clip.retarget(PERSON) for clip in made]


@cache
def trainee(name):
    """Return a trainee of the smallest size."""
    data = project_clips(clips()[:4], views=2), project_clips(clips()[4:], views=2)
    if name == "diffusion":
        return DiffusionTrainee(*data, DiffusionSettings.tiny(frames=10))
    if name == "evaluator":
        return EvaluatorTrainee(*data, EvaluatorSettings.tiny(10))
    if name == "flow":
        return PoseFlowTrainee(*data, FlowSettings.tiny())
    if name == "lifter":
        return LifterTrainee(*data, trainee("flow").network, LifterSettings.tiny())
    motions = clips()[1:], clips()[:1]
    if name == "dvae":
        states = BodyStates(PERSON, rest_pose(PERSON, [clip.positions for clip in clips()]))
        return DVAETrainee(*motions, replace(DVAESettings.tiny(), frames=6), states)
    if name == "denoiser":
        dvae = trainee("dvae")
        model = copy.deepcopy(dvae.network)
        card = {"network": dict(dvae.settings)}
        prior = MotionDVAE(model, dvae.size, dvae.states, 20.0, card=card)
        return DenoiserTrainee(*motions, prior)
    films = [
        film_clips(group, PERSON, 10.0, views=2, noise=DetectorNoise(share=0.0)).tracks
        for group in (clips()[:4], clips()[4:])
    ]
    given = {
        "tracks": films[0],
        "validation": films[1],
        "size": replace(MotionVAESettings.tiny(), frames=20),
        "body": ArticulatedBody(PERSON, estimate_rest_pose(films[0])),
        "distance": 7.0,
    }
    if name == "poses":
        return PoseTrainee(**given)
    return MotionVAETrainee(**given, pose_network=copy.deepcopy(trainee("poses").network))


def walk2d(**options):
    return MotionDiffusion.load("walk2d", frames=8, **options)


def loss_on(name, device, rng):
    """Return the loss of a batch in single precision, without dropout."""
    learner = copy.deepcopy(trainee(name))
    return learner.training_loss(learner.network.to(device).eval(), rng, 8, device)


def test_auto_is_cuda_where_it_is_available(monkeypatch):
    for available, device in ((True, "cuda"), (False, "cpu")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda available=available: available)
        assert check_device("auto") == torch.device(device)
        assert check_device("cpu") == CPU
    with pytest.raises(ValueError, match="device must be cpu, got cuda, which is not available"):
        check_device("cuda")
    with pytest.raises(ValueError, match="device must be auto, cpu or cuda, got 'tpu'"):
        check_device("tpu")


def test_half_precision_is_that_of_matrix_products():
    numbers = torch.ones(2, 2)
    with half_precision(CPU, True):
        assert is_half_precision(CPU)
        assert (numbers @ numbers).dtype == torch.bfloat16
        with half_precision(CPU, False):
            assert (numbers @ numbers).dtype == torch.float32
    assert not is_half_precision(CPU)
    with half_precision(META, True):
        assert not is_half_precision(META)


# The denoiser's loss branches on its data, which the device meta does not have.
@pytest.mark.parametrize("name", [name for name in TRAINEES if name != "denoiser"])
def test_losses_are_on_the_device_and_draw_its_random_numbers_on_the_cpu(name):
    """On meta, an operation with a tensor of another device is an error."""
    states = []
    for device in (CPU, META):
        rng = np.random.default_rng(0)
        before = torch.get_rng_state()
        assert loss_on(name, device, rng).device == device
        assert torch.equal(torch.get_rng_state(), before)
        states.append(rng.bit_generator.state)
    assert states[0] == states[1]


def test_denoisers_are_in_single_precision_whatever_the_input():
    prior = walk2d()
    x_t = np.random.default_rng(0).standard_normal((2, 2, 8, prior.skeleton.n_joints, 2))
    single = prior.denoise(x_t.astype(np.float32), 0.4, CAMERAS)
    assert single.dtype == np.float32
    double = prior.denoise(x_t, 0.4, CAMERAS)
    assert double.dtype == np.float64
    np.testing.assert_array_equal(double, single)
    assert {weight.dtype for weight in prior._network.parameters()} == {torch.float32}


class Rounded(MotionDiffusion):
    """Prior with other rounding errors in its network, as on another device."""

    def __init__(self, network, *data, **options):
        super().__init__(network, *data, **options)
        rng = torch.Generator().manual_seed(1)

        def rounded(motions, levels):
            clean = network(motions, levels)
            return clean * (1 + 1e-6 * torch.randn(clean.shape, generator=rng))

        self._network = rounded


def draws_of(name, prior):
    sampler = SAMPLERS[name]
    return sampler.sample(pm.posterior(prior), draws=2, chains=2, progress=False).flat()


@pytest.mark.parametrize("name", SAMPLERS)
def test_draws_do_not_amplify_rounding(name):
    prior = walk2d()
    data = (prior._network, prior.settings, prior.standards, prior.skeleton, prior.fps)
    draws = draws_of(name, Rounded(*data, frames=prior.frames))
    assert 0 < abs(draws - draws_of(name, prior)).max() < TOLERANCE


def test_fused_layers_are_not_used_on_cuda():
    enabled = torch.backends.mha.get_fastpath_enabled
    assert enabled()
    with inference("cpu"):
        assert enabled()
    with inference("cuda"):
        assert not enabled()
    assert enabled()


@pytest.mark.gpu
@pytest.mark.parametrize("name", SAMPLERS)
def test_draws_are_those_of_the_cpu(name):
    draws = draws_of(name, walk2d(device="cuda"))
    np.testing.assert_allclose(draws, draws_of(name, walk2d()), rtol=0, atol=TOLERANCE)


@pytest.mark.gpu
def test_networks_compute_what_they_compute_on_the_cpu():
    rng = np.random.default_rng(0)
    x_t, vectors = rng.standard_normal((2, 3, 2, 8, walk2d().skeleton.n_joints, 2))
    lifter = LifterNetwork(LifterSettings.tiny(), PERSON.n_joints, 0)
    tracks = project_clips(clips(), views=1)
    views = np.stack([np.nan_to_num(track.keypoints[:8]) for track in tracks])
    results = []
    for device in ("cpu", "cuda"):
        prior = walk2d(device=device)
        evaluator = TrackEvaluator.load("walk2d-evaluator", device=device)
        moved = copy.deepcopy(lifter)
        centred = views - views[:, :, :1]
        results.append(
            [
                prior.denoise(x_t, 0.4, CAMERAS),
                prior.view_covariance(x_t, 0.4, CAMERAS)(vectors),
                evaluator.features(centred),
                PoseLifter(moved, PERSON, device=device).lift(views),
            ]
        )
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=0, atol=TOLERANCE)


@pytest.mark.gpu
@pytest.mark.parametrize("name", TRAINEES)
def test_losses_are_those_of_the_cpu(name):
    losses = [
        float(loss_on(name, torch.device(device), np.random.default_rng(0)).detach())
        for device in ("cpu", "cuda")
    ]
    assert losses[1] == pytest.approx(losses[0], rel=TOLERANCE)


@pytest.mark.gpu
def test_networks_are_trained_resumed_and_loaded(tmp_path):
    settings = TrainingSettings(steps=4, batch=8, warmup=1, checkpoint_every=2)
    for steps in (2, 4):
        learner = copy.deepcopy(trainee("diffusion"))
        result = train(
            learner, replace(settings, steps=steps), tmp_path, device="cuda", progress=False
        )
    assert [row["step"] for row in result.history] == [2, 4]
    assert {weight.device.type for weight in learner.network.parameters()} == {"cuda"}
    prior = MotionDiffusion.load(result.model)
    assert prior._device == "cpu"
