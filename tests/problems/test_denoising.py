"""Denoising problems: observations, estimated bodies and supported samplers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from probmotion import models, seeds
from probmotion.data.cmu_clips import cmu_clip
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.metrics.measures import measure
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.dvae.denoiser_training import DenoiserTrainee
from probmotion.models.dvae.motion_denoiser import MotionDenoiser
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.network import DVAESettings
from probmotion.models.dvae.training import DVAETrainee
from probmotion.models.training.checkpoints import weights_digest
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.problem import Problem
from probmotion.problems import denoising, load_problem
from probmotion.problems.denoising import (
    DENOISING_PROBLEMS,
    body_of,
    body_prior,
    denoising_problem,
    limb_occlusions,
)
from probmotion.samplers import DVAEInference, MetropolisHastings
from probmotion.threads import one_thread

BODY = Skeleton.preset("person14")
WEIGHTS = Path(models.__file__).parent / "weights"
SIZE = replace(DVAESettings.tiny(), latent=2)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    with one_thread():
        yield


@pytest.fixture(scope="module")
def walks():
    return [clip.retarget(BODY) for clip in synthetic_walks(6, BODY, seconds=3.0)]


def learnt(trainee, steps=30):
    network = trainee.network.train()
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for step in range(steps):
        rng = seeds.generator(0, "step", step)
        loss = trainee.training_loss(network, rng, 16, torch.device("cpu"))
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
    return network


@pytest.fixture(scope="module")
def prior(walks):
    """Briefly trained prior with its inference network."""
    states = BodyStates(BODY, rest_pose(BODY, [clip.positions for clip in walks]))
    trainee = DVAETrainee(walks[2:], walks[:2], SIZE, states)
    card = {"network": trainee.settings}
    found = MotionDVAE(learnt(trainee), SIZE, states, 30.0, card=card)
    inner = DenoiserTrainee(walks[2:], walks[:2], found)
    denoiser = MotionDenoiser(learnt(inner), found, {"network": inner.settings})
    return found.of(inference_network=denoiser)


@pytest.fixture(scope="module")
def occluded(prior, walks):
    truth = walks[0].window(20, 12)
    return denoising_problem(truth, prior, noise=0.04, hidden=limb_occlusions(truth))


def bones(positions):
    """Lengths (…, bones) along the skeleton."""
    child, parent = (list(ends) for ends in zip(*BODY.bones, strict=True))
    return np.linalg.norm(positions[..., child, :] - positions[..., parent, :], axis=-1)


def test_observations_have_the_stated_noise(prior, walks):
    truth = walks[0]
    problem = denoising_problem(truth, prior, noise=0.04, name="some", description="a sentence")
    assert isinstance(problem, Problem)
    assert (problem.name, problem.description) == ("some", "a sentence")
    np.testing.assert_array_equal(problem.truth, truth.positions)
    assert not problem.has_reference
    adapted = problem.posterior.prior
    assert adapted.frames == truth.frames
    assert adapted.inference_network is prior.inference_network
    assert adapted.model is prior.model
    likelihood = problem.posterior.likelihood
    residual = (likelihood.joints - truth.positions) / 0.04
    assert abs(residual.var() - 1) < 5 * np.sqrt(2 / residual.size)
    again = denoising_problem(truth, prior, noise=0.04).posterior.likelihood
    np.testing.assert_array_equal(again.joints, likelihood.joints)
    other = denoising_problem(truth, prior, noise=0.04, seed=1).posterior.likelihood
    assert (other.joints != likelihood.joints).all()
    heavy = denoising_problem(truth, prior, noise=0.04, degrees_of_freedom=3.0)
    assert heavy.posterior.likelihood.entries.degrees_of_freedom == 3.0
    outliers = abs(heavy.posterior.likelihood.joints - truth.positions) / 0.04
    # P(|t| > 5) of 3 degrees of freedom is 1.5 %, of a Gaussian nothing.
    assert (outliers > 5).mean() == pytest.approx(0.0154, abs=0.006)
    assert (abs(residual) < 5).all()


def test_simulated_problem_has_its_own_truth(prior, walks):
    """The body, occlusions and noise scale are those of the problem."""
    hidden = np.zeros(walks[0].positions.shape[:2], dtype=bool)
    hidden[3:9, 4] = True
    problem = denoising_problem(walks[0], prior, noise=0.04, hidden=hidden)
    again = problem.simulate(3)
    np.testing.assert_array_equal(again.truth, problem.simulate(3).truth)
    assert (again.truth != problem.simulate(4).truth).any()
    likelihood = again.posterior.likelihood
    np.testing.assert_array_equal(likelihood.entries.visible, ~hidden)
    residual = (likelihood.joints - again.truth)[~hidden] / 0.04
    assert abs(residual.var() - 1) < 5 * np.sqrt(2 / residual.size)
    assert again.posterior.prior is problem.posterior.prior


@pytest.mark.parametrize(("freedom", "error"), [(None, 0.0045), (3.0, 0.006)])
@pytest.mark.parametrize("size", [1.15])
def test_body_has_the_observed_bone_lengths(prior, walks, size, freedom, error):
    """The standard error of a mean of 90 bone lengths is √2 σ/√90; that of a median is
    1/(2 p √90) with density p.
    """
    truth = replace(walks[1], positions=size * walks[1].positions)
    problem = denoising_problem(truth, prior, noise=0.03, degrees_of_freedom=freedom)
    body = problem.posterior.prior.body
    own, usual = bones(truth.positions).mean(axis=0), bones(walks[1].positions).mean(axis=0)
    child = [joint for joint, _ in BODY.bones]
    found = np.linalg.norm(body, axis=-1)[child]
    np.testing.assert_allclose(found, own, atol=4.5 * error)
    assert abs(found - usual).max() > 0.03
    true = prior.states.body(truth.positions)
    assert np.linalg.norm(body - true, axis=-1).max() < 0.035
    np.testing.assert_array_equal(body, body_of(problem.posterior.likelihood, prior))
    draws = DVAEInference().sample(
        denoising_problem(truth.window(0, 12), prior.of(body=body), noise=0.02).posterior,
        draws=2,
        progress=False,
    )
    np.testing.assert_allclose(bones(draws.flat()).mean(axis=(0, 1)), own, atol=0.03)


def test_body_has_the_observed_hips(prior, walks):
    """The hips are lower than in training, which bone lengths alone do not determine."""
    legs = [
        BODY.index(f"{side}_{j}") for side in ("left", "right") for j in ("hip", "knee", "ankle")
    ]
    lower = walks[1].positions.copy()
    lower[:, legs, 1] -= 0.08
    wide = replace(walks[1], positions=lower)
    likelihood = Joints3D.observe(wide, 0.02, seed=0)
    true = prior.states.body(wide.positions)
    usual = prior.states.of_lengths(np.linalg.norm(true, axis=-1))
    found = body_of(likelihood, prior)
    assert np.linalg.norm(usual - true) > 0.05
    assert np.linalg.norm(found - true) < 0.6 * np.linalg.norm(usual - true)
    unseen = np.zeros(wide.positions.shape[:2], dtype=bool)
    unseen[:, BODY.index("left_ankle")] = True
    rough = body_of(Joints3D.observe(wide, 0.02, seed=0, hidden=unseen), prior)
    lengths = np.linalg.norm(rough, axis=-1)
    np.testing.assert_allclose(rough, prior.states.of_lengths(lengths), atol=1e-12)


def test_invisible_limb_has_the_length_of_its_mirror_image(prior, walks):
    truth = replace(walks[1], positions=1.2 * walks[1].positions)
    hidden = np.zeros(truth.positions.shape[:2], dtype=bool)
    hidden[:, BODY.index("left_wrist")] = True
    body = denoising_problem(truth, prior, noise=0.02, hidden=hidden).posterior.prior.body
    left, right = (np.linalg.norm(body[BODY.index(f"{side}_wrist")]) for side in ("left", "right"))
    assert left == pytest.approx(right, rel=1e-9)
    # If both are occluded, the length is the prior's.
    hidden[:, BODY.index("right_wrist")] = True
    body = denoising_problem(truth, prior, noise=0.02, hidden=hidden).posterior.prior.body
    wrist = BODY.index("left_wrist")
    assert np.linalg.norm(body[wrist]) == pytest.approx(np.linalg.norm(prior.body[wrist]))


def test_arm_and_leg_are_occluded_in_turn(walks):
    for frames in (30, 31):
        hidden = limb_occlusions(walks[0].window(0, frames))
        assert hidden.shape == (frames, 14)
        names = np.array(BODY.joint_names)
        assert set(names[hidden[:15].any(axis=0)]) == {"right_elbow", "right_wrist"}
        assert set(names[hidden[15:].any(axis=0)]) == {"left_knee", "left_ankle"}
        assert hidden.sum() == 40
        assert not hidden[[0, 4, 25, -1]].any()
        assert hidden[5:15, BODY.index("right_wrist")].all()
        assert hidden[15:25, BODY.index("left_ankle")].all()
    ends = limb_occlusions(walks[0].window(0, 30), cut_off=True)
    assert ends[:15, BODY.index("right_wrist")].all()
    assert ends[15:, BODY.index("left_ankle")].all()
    assert ends.sum() == 60


def test_invalid_arguments_are_rejected(prior, walks):
    wrong = synthetic_walks(1, BODY, seconds=3.0)[0]
    for truth, options, message in (
        (replace(walks[0], fps=60.0), {}, "60"),
        (wrong, {}, r"joints must have shape \(L, 14, 3\), got \(90, 17, 3\)"),
        (walks[0], {"noise": 0.0}, "noise must be a finite number above 0, got 0.0"),
        (walks[0], {"hidden": np.ones((3, 14), dtype=bool)}, r"hidden must have shape \(90, 14\)"),
    ):
        with pytest.raises(ValueError, match=message):
            denoising_problem(truth, prior, **{"noise": 0.04} | options)


def run(problem, sampler, draws=4, chains=2):
    return sampler.sample(problem.posterior, draws=draws, chains=chains, seed=1, progress=False)


def test_metrics_separate_visible_and_occluded_joints(occluded):
    found = measure(occluded, run(occluded, DVAEInference(), draws=10), 0)
    names = {f"{error}_{where}_mm" for error in ("mpjpe", "g_mpjpe", "g_mpjpe_mean")
             for where in ("visible", "occluded")}  # fmt: skip
    assert names <= set(found)
    assert all(0 < found[name] < 500 for name in names)
    assert found["acceleration_ratio"] > 0
    hidden = ~occluded.posterior.likelihood.entries.visible
    assert hidden.sum() == 16
    parts = hidden.mean() * found["g_mpjpe_occluded_mm"]
    parts += (1 - hidden.mean()) * found["g_mpjpe_visible_mm"]
    assert found["g_mpjpe_mm"] == pytest.approx(parts)


@pytest.mark.parametrize(
    ("sampler", "chains"),
    [
        (MetropolisHastings(warmup=100, thin=1, candidates=50), 2),
        (DVAEInference(), 2),
        (DVAEInference(mode="optimization", iterations=3), 2),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_samplers_improve_on_the_prior(prior, walks, sampler, chains):
    """For three frames, all draws are closer to the truth than prior draws."""
    truth = walks[0].window(20, 3)
    problem = denoising_problem(truth, prior, noise=0.04)
    posterior = problem.posterior
    draws = run(problem, sampler, draws=8, chains=chains)
    assert draws.positions.shape == (chains, 8, 3, 14, 3)
    theta = draws.dataset["theta"].values
    np.testing.assert_allclose(posterior.motion(theta), draws.positions.values, atol=1e-4)
    np.testing.assert_allclose(
        draws.dataset["log_density"].values, posterior.log_density(theta), rtol=1e-6, atol=1e-4
    )
    outliers = posterior.prior.sample(np.random.default_rng(0), 16)

    def error(motions):
        return np.linalg.norm(motions - truth.positions, axis=-1).mean()

    assert error(draws.flat()) < 0.3 * error(outliers)


@pytest.mark.parametrize("name", DENOISING_PROBLEMS)
def test_truth_is_the_middle_of_the_clip_at_the_origin(prior, monkeypatch, name):
    """Uses a synthetic clip far from the origin."""
    clip = synthetic_walks(1, BODY, seconds=3.0)[0]
    far = replace(clip, positions=clip.positions + np.array([70.0, 0.3, -20.0]))
    monkeypatch.setattr(denoising, "body_prior", lambda: prior)
    monkeypatch.setattr(denoising, "cmu_clip", {"cmu_02_02": far}.__getitem__)
    description, make = DENOISING_PROBLEMS[name]
    problem = make()
    assert (problem.name, problem.description) == (name, description)
    assert "cmu_02_02" in description or description.startswith("the same")
    middle = far.retarget(BODY).positions[39:51]
    apart = problem.truth - middle
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0, 0], apart.shape), atol=1e-9)
    assert apart[0, 0, 1] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(problem.truth[:, 0, [0, 2]].mean(axis=0), 0.0, atol=1e-9)
    likelihood = problem.posterior.likelihood
    wanted = {
        "denoise-cmu": (0.04, None, 0),
        "denoise-cmu-outliers": (0.03, 3.0, 0),
        "denoise-cmu-occluded": (0.04, None, 16),
    }[name]
    hidden = (~likelihood.entries.visible).sum()
    assert (likelihood.noise, likelihood.entries.degrees_of_freedom, hidden) == wanted
    np.testing.assert_array_equal(make().posterior.likelihood.joints, likelihood.joints)


def test_prior_is_loaded_with_its_network(prior, tmp_path):
    for name, part in (("body", prior), ("body-denoiser", prior.inference_network)):
        (tmp_path / name).mkdir()
        part.save(tmp_path / name / "model.safetensors")
    found = body_prior(str(tmp_path / "body"))
    assert weights_digest(found.model) == weights_digest(prior.model)
    assert weights_digest(found.inference_network.networks) == weights_digest(
        prior.inference_network.networks
    )
    with pytest.raises(FileNotFoundError, match="no-such-prior"):
        body_prior("no-such-prior")


@pytest.fixture(scope="module")
def shipped(real_data):
    for name in ("body-dvae", "body-dvae-denoiser"):
        assert (WEIGHTS / f"{name}.safetensors").is_file()
    try:
        cmu_clip("cmu_02_02", real_data)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    return real_data


@pytest.mark.parametrize("name", DENOISING_PROBLEMS)
def test_named_problems_use_a_held_out_clip(shipped, name):
    problem = load_problem(name)
    assert problem.truth.shape == (30, 14, 3)
    adapted = problem.posterior.prior
    card, beside = adapted.card["network"], adapted.inference_network.card["network"]
    learnt_from = [*card["data"]["clips"], *card["validation_data"]["clips"], *beside["clips"]]
    assert learnt_from
    assert not any("02_02" in clip for clip in learnt_from)
    draws = run(problem, DVAEInference(), draws=10)
    found = measure(problem, draws, 0)
    likelihood = problem.posterior.likelihood
    seen = likelihood.entries.visible
    noisy = np.linalg.norm(likelihood.joints - problem.truth, axis=-1)[seen].mean()
    assert found["g_mpjpe_mean_mm"] < 1000 * noisy
    np.testing.assert_allclose(
        bones(problem.truth).mean(axis=0),
        np.linalg.norm(adapted.body, axis=-1)[[joint for joint, _ in BODY.bones]],
        atol=0.04,
    )
