"""Denoising problems: observations, estimated bodies and supported samplers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from probmotion import seeds
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
SIZE = replace(DVAESettings.tiny(), latent=2)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    with one_thread():
        yield


@pytest.fixture(scope="module")
def walks():
    return [clip.retarget(BODY) for clip in synthetic_walks(6, BODY, seconds=3.0)]


def trained(trainee, steps=30):
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
    dvae = MotionDVAE(trained(trainee), SIZE, states, 30.0, card=card)
    denoiser_trainee = DenoiserTrainee(walks[2:], walks[:2], dvae)
    card = {"network": denoiser_trainee.settings}
    return dvae.of(inference_network=MotionDenoiser(trained(denoiser_trainee), dvae, card))


def bones(positions):
    """Return bone lengths, (…, bones)."""
    child, parent = np.array(BODY.bones).T
    return np.linalg.norm(positions[..., child, :] - positions[..., parent, :], axis=-1)


def test_observations_have_the_stated_noise(prior, walks):
    truth = walks[0]
    problem = denoising_problem(truth, prior, noise=0.04, name="some", description="a sentence")
    assert (problem.name, problem.description) == ("some", "a sentence")
    assert not problem.has_reference
    np.testing.assert_array_equal(problem.truth, truth.positions)
    adapted = problem.posterior.prior
    assert adapted.frames == truth.frames
    assert adapted.inference_network is prior.inference_network
    likelihood = problem.posterior.likelihood
    residual = (likelihood.joints - truth.positions) / 0.04
    assert abs(residual.var() - 1) < 5 * np.sqrt(2 / residual.size)
    repeated = denoising_problem(truth, prior, noise=0.04).posterior.likelihood
    np.testing.assert_array_equal(repeated.joints, likelihood.joints)
    other = denoising_problem(truth, prior, noise=0.04, seed=1).posterior.likelihood
    assert (other.joints != likelihood.joints).all()
    heavy_tailed = denoising_problem(truth, prior, noise=0.04, degrees_of_freedom=3.0)
    outliers = abs(heavy_tailed.posterior.likelihood.joints - truth.positions) > 5 * 0.04
    # P(|t| > 5) is 1.5 % with 3 degrees of freedom and negligible for a Gaussian.
    assert outliers.mean() == pytest.approx(0.0154, abs=0.006)
    assert (abs(residual) < 5).all()
    simulated = problem.simulate(3)
    assert simulated.posterior.prior is adapted
    assert (simulated.truth != truth.positions).any()


@pytest.mark.parametrize(("freedom", "error"), [(None, 0.0045), (3.0, 0.006)])
def test_body_has_the_observed_bone_lengths(prior, walks, freedom, error):
    """Standard errors of 90 lengths are √2 σ/√90 (mean) and 1/(2 p √90) (median, density p)."""
    truth = replace(walks[1], positions=1.15 * walks[1].positions)
    problem = denoising_problem(truth, prior, noise=0.03, degrees_of_freedom=freedom)
    body = problem.posterior.prior.body
    expected = bones(truth.positions).mean(axis=0)
    lengths = np.linalg.norm(body, axis=-1)[[joint for joint, _ in BODY.bones]]
    np.testing.assert_allclose(lengths, expected, atol=4.5 * error)
    assert abs(lengths - bones(walks[1].positions).mean(axis=0)).max() > 0.03
    true_body = prior.states.body(truth.positions)
    assert np.linalg.norm(body - true_body, axis=-1).max() < 0.035
    short = denoising_problem(truth.window(0, 12), prior.of(body=body), noise=0.02)
    draws = run(short, DVAEInference(), draws=2, chains=1).flat()
    np.testing.assert_allclose(bones(draws).mean(axis=(0, 1)), expected, atol=0.03)


def test_body_has_the_observed_hips(prior, walks):
    """The hips are lower than in training, which bone lengths alone do not determine."""
    legs = [n.endswith(("hip", "knee", "ankle")) for n in BODY.joint_names]
    positions = walks[1].positions.copy()
    positions[:, legs, 1] -= 0.08
    low = replace(walks[1], positions=positions)
    likelihood = Joints3D.observe(low, 0.02, seed=0)
    true_body = prior.states.body(positions)
    by_lengths = prior.states.of_lengths(np.linalg.norm(true_body, axis=-1))
    error, by_lengths_error = (
        np.linalg.norm(body - true_body) for body in (body_of(likelihood, prior), by_lengths)
    )
    assert by_lengths_error > 0.05
    assert error < 0.6 * by_lengths_error
    hidden = np.zeros(positions.shape[:2], dtype=bool)
    hidden[:, BODY.index("left_ankle")] = True
    body = body_of(Joints3D.observe(low, 0.02, seed=0, hidden=hidden), prior)
    lengths = np.linalg.norm(body, axis=-1)
    np.testing.assert_allclose(body, prior.states.of_lengths(lengths), atol=1e-12)


def test_invisible_limb_has_the_length_of_its_mirror_image(prior, walks):
    """If both are occluded, the length is that of the prior."""
    truth = replace(walks[1], positions=1.2 * walks[1].positions)
    hidden = np.zeros(truth.positions.shape[:2], dtype=bool)
    wrists = [BODY.index("left_wrist"), BODY.index("right_wrist")]
    for n_hidden in (1, 2):
        hidden[:, wrists[:n_hidden]] = True
        body = denoising_problem(truth, prior, noise=0.02, hidden=hidden).posterior.prior.body
        left, right = np.linalg.norm(body[wrists], axis=-1)
        expected = right if n_hidden == 1 else np.linalg.norm(prior.body[wrists[0]])
        assert left == pytest.approx(expected, rel=1e-9)


def test_arm_and_leg_are_occluded_in_turn(walks):
    arm, leg = (
        [BODY.index(f"{side}_{joint}") for joint in joints]
        for side, joints in (("right", ("elbow", "wrist")), ("left", ("knee", "ankle")))
    )
    for frames, cut_off, first, last in ((30, False, 5, 25), (31, False, 5, 25), (30, True, 0, 30)):
        expected = np.zeros((frames, 14), dtype=bool)
        expected[first:15, arm] = expected[15:last, leg] = True
        hidden = limb_occlusions(walks[0].window(0, frames), cut_off=cut_off)
        np.testing.assert_array_equal(hidden, expected)


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


def run(problem, sampler, draws, chains=2):
    return sampler.sample(problem.posterior, draws=draws, chains=chains, seed=1, progress=False)


@pytest.mark.parametrize(
    "sampler",
    [
        MetropolisHastings(warmup=100, thin=1, candidates=50),
        DVAEInference(),
        DVAEInference(mode="optimization", iterations=3),
    ],
    ids=["mh", "regression", "optimization"],
)
def test_samplers_improve_on_the_prior(prior, walks, sampler):
    """For three frames, all draws are closer to the truth than prior draws."""
    truth = walks[0].window(20, 3)
    problem = denoising_problem(truth, prior, noise=0.04)
    posterior, draws = problem.posterior, run(problem, sampler, draws=8)
    theta = draws.dataset["theta"].values
    np.testing.assert_allclose(posterior.motion(theta), draws.positions.values, atol=1e-4)
    np.testing.assert_allclose(
        draws.dataset["log_density"].values, posterior.log_density(theta), rtol=1e-6, atol=1e-4
    )
    error, prior_error = (
        np.linalg.norm(motions - truth.positions, axis=-1).mean()
        for motions in (draws.flat(), posterior.prior.sample(np.random.default_rng(0), 16))
    )
    assert error < 0.3 * prior_error


@pytest.mark.parametrize(
    ("name", "noise", "freedom", "n_hidden"),
    [
        ("denoise-cmu", 0.04, None, 0),
        ("denoise-cmu-outliers", 0.03, 3.0, 0),
        ("denoise-cmu-occluded", 0.04, None, 16),
    ],
)
def test_truth_is_the_middle_of_the_clip_at_the_origin(
    prior, monkeypatch, name, noise, freedom, n_hidden
):
    """The clip is synthetic and far from the origin."""
    clip = synthetic_walks(1, BODY, seconds=3.0)[0]
    distant = replace(clip, positions=clip.positions + np.array([70.0, 0.3, -20.0]))
    monkeypatch.setattr(denoising, "body_prior", lambda: prior)
    monkeypatch.setattr(denoising, "cmu_clip", {"cmu_02_02": distant}.__getitem__)
    description, make = DENOISING_PROBLEMS[name]
    problem = make()
    assert (problem.name, problem.description) == (name, description)
    window = distant.retarget(BODY).positions[39:51]
    ground = window[:, 0].mean(axis=0) * [1.0, 0.0, 1.0]
    np.testing.assert_allclose(problem.truth, window - ground, atol=1e-9)
    likelihood = problem.posterior.likelihood
    assert (likelihood.noise, likelihood.entries.degrees_of_freedom) == (noise, freedom)
    assert (~likelihood.entries.visible).sum() == n_hidden


def test_prior_is_loaded_with_its_network(prior, tmp_path):
    for name, part in (("body", prior), ("body-denoiser", prior.inference_network)):
        (tmp_path / name).mkdir()
        part.save(tmp_path / name / "model.safetensors")
    loaded = body_prior(str(tmp_path / "body"))
    assert weights_digest(loaded.model) == weights_digest(prior.model)
    digests = [weights_digest(each.inference_network.networks) for each in (loaded, prior)]
    assert digests[0] == digests[1]
    with pytest.raises(FileNotFoundError, match="no-such-prior"):
        body_prior("no-such-prior")


@pytest.mark.parametrize("name", DENOISING_PROBLEMS)
def test_named_problems_use_a_held_out_clip(real_data, monkeypatch, name):
    monkeypatch.setenv("PROBMOTION_DATA", str(real_data))
    problem = load_problem(name)
    assert problem.truth.shape == (30, 14, 3)
    prior, likelihood = problem.posterior.prior, problem.posterior.likelihood
    card, denoiser_card = prior.card["network"], prior.inference_network.card["network"]
    clips = [
        *card["data"]["clips"], *card["validation_data"]["clips"], *denoiser_card["clips"],
    ]  # fmt: skip
    assert clips
    assert not any("02_02" in clip for clip in clips)
    metrics = measure(problem, run(problem, DVAEInference(), draws=10), 0)
    error = np.linalg.norm(likelihood.joints - problem.truth, axis=-1)
    assert metrics["g_mpjpe_mean_mm"] < 1000 * error[likelihood.entries.visible].mean()
    lengths = np.linalg.norm(prior.body, axis=-1)[[joint for joint, _ in BODY.bones]]
    np.testing.assert_allclose(bones(problem.truth).mean(axis=0), lengths, atol=0.04)
