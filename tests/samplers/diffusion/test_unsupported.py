"""Tests of warnings and of unsupported posteriors of the denoising samplers."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion import Cameras, Joints3D, Keypoints2D, MotionPosterior, UnsupportedPosterior
from probmotion.posteriors.protocols import OrthographicOnly
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem
from probmotion.samplers import (
    Ancestral3D,
    MultiViewAncestral,
    MultiViewPredictorCorrector,
    ScoreDistillation,
)
from probmotion.samplers.conditional import SplitGibbs
from probmotion.samplers.diffusion.ancestral2d import Ancestral2D
from probmotion.samplers.diffusion.guidance import ExactGuidance, MomentMatched
from probmotion.samplers.diffusion.sync_tweedies import SyncTweedies


@pytest.mark.parametrize(
    "sampler",
    [
        MultiViewAncestral(steps=3, elevation=0.0),
        MultiViewPredictorCorrector(steps=3, elevation=0.0),
        SplitGibbs(steps=0, sweeps=1, start_steps=2, particles=2, denoiser="2d", elevation=0.0),
    ],
    ids=lambda sampler: sampler.name,
)
def test_elevation_0_warns(gaussian, sampler):
    posterior = MotionPosterior(gaussian, Joints3D(gaussian.mean, noise=0.1))
    message = f"{sampler.name} cannot distinguish a motion from its mirror image with elevation 0"
    with pytest.warns(UserWarning, match=message) as warned:
        sampler.sample(posterior, draws=1, progress=False)
    assert warned[0].filename == __file__


@pytest.mark.parametrize("kind", [MultiViewAncestral, MultiViewPredictorCorrector, SyncTweedies])
def test_views_that_leave_a_dimension_open_are_refused(gaussian, kind):
    sampler = kind(steps=3, elevation=np.pi / 2)
    with pytest.raises(ValueError, match=r"determine all three dim.* elevations 1\.57, 1\.57"):
        sampler.sample(MotionPosterior(gaussian), draws=1, progress=False)


def test_one_view_is_refused(gaussian):
    with pytest.raises(ValueError, match="n_views must be an integer of at least 2, got 1"):
        SyncTweedies(steps=3, n_views=1).sample(MotionPosterior(gaussian), draws=1, progress=False)


def test_likelihoods_that_are_not_linear_gaussian_are_refused(gaussian):
    cameras = Cameras.ring(1, distance=9.0, perspective=True)

    class Other(Joints3D):
        linear = None

    for likelihood, reason in (
        (Keypoints2D(np.zeros((1, 2, 2, 2)), cameras, noise=0.1), "the cameras are perspective"),
        (Joints3D(gaussian.mean, 0.1, degrees_of_freedom=3), "Student-t with 3 degrees"),
        (Other(gaussian.mean, 0.1), r"but Other has no method linear\(\)"),
    ):
        for sampler in (
            Ancestral3D(),
            Ancestral3D(guidance=ExactGuidance()),
            MultiViewAncestral(),
            MultiViewPredictorCorrector(),
        ):
            with pytest.raises(UnsupportedPosterior, match=reason) as refused:
                sampler.sample(MotionPosterior(gaussian, likelihood), draws=1, progress=False)
            assert refused.value.word == "observations"


def test_samplers_without_guidance_refuse_observations(gaussian):
    posterior = MotionPosterior(gaussian, Joints3D(gaussian.mean, noise=0.1))
    for sample in (ScoreDistillation().sample, Ancestral2D().sample_views):
        with pytest.raises(
            UnsupportedPosterior, match=r"does not support observations.*; try .*mas, .*mvpc"
        ) as refused:
            sample(posterior, draws=1, progress=False)
        assert refused.value.word == "observations"
    for options in ({"perspective": True}, {"shared_noise": False}):
        with pytest.raises(UnsupportedPosterior, match="observations only with perspective=False"):
            MultiViewAncestral(**options).sample(posterior, progress=False)


def test_perspective_views_need_a_denoiser_that_supports_them(gaussian, gaussian_motion):
    class Orthographic(gaussian_motion):
        def denoise(self, x_t, alpha_bar, cameras):
            raise OrthographicOnly("cameras must be orthographic")

    posterior = MotionPosterior(Orthographic(gaussian.mean, gaussian.covariance))
    with pytest.raises(UnsupportedPosterior, match="Orthographic raised: cameras must be ortho"):
        MultiViewAncestral(perspective=True).sample(posterior, draws=1, progress=False)


def test_truncated_posteriors_are_refused():
    """Neither guidance nor a conditioned prior knows the truncation."""
    whole = load_problem("gait-sparse", frames=3, components=6, noise=0.1).posterior
    truncated = TruncatedPosterior(whole.prior, whole.likelihood, limit=10.0)
    for guidance in (MomentMatched(), ExactGuidance()):
        with pytest.raises(UnsupportedPosterior, match="but the posterior is truncated"):
            Ancestral3D(guidance=guidance).sample(truncated, draws=1, progress=False)
    with pytest.raises(ValueError, match="a truncated posterior has no exact denoisers"):
        truncated.conditioned()
