"""Tests of `DVAEInference` with a tiny Motion-DVAE: draws, optimisation, windows, provenance."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from probmotion import Cameras, Joints3D, Keypoints2D, MotionDraws, MotionPosterior, seeds
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.models.bodies.body_states import BodyStates, rest_pose
from probmotion.models.dvae.denoiser_training import DenoiserTrainee
from probmotion.models.dvae.motion_denoiser import MotionDenoiser
from probmotion.models.dvae.motion_dvae import MotionDVAE
from probmotion.models.dvae.network import DVAESettings
from probmotion.models.dvae.training import DVAETrainee
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import Interrupted
from probmotion.samplers import DVAEInference
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread

FIT = DVAEInference(mode="optimization", iterations=25, learning_rate=3e-3)
QUICK = DVAEInference(training_steps=20, training_pairs=150)
BODY = Skeleton.preset("person14")
WINDOW = 12


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    """Small networks are faster on one thread."""
    with one_thread():
        yield


def trained(trainee, steps):
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
def walks():
    return [clip.retarget(BODY) for clip in synthetic_walks(8, BODY, seconds=3.0)]


@pytest.fixture(scope="module")
def base(walks):
    """Return a briefly trained prior without an inference network."""
    states = BodyStates(BODY, rest_pose(BODY, [clip.positions for clip in walks]))
    trainee = DVAETrainee(walks[2:], walks[:2], DVAESettings.tiny(), states)
    return MotionDVAE(
        trained(trainee, 30), trainee.size, states, 30.0, card={"network": trainee.settings}
    )


@pytest.fixture(scope="module")
def denoiser(base, walks):
    trainee = DenoiserTrainee(walks[2:], walks[:2], base)
    return MotionDenoiser(trained(trainee, 30), base, {"network": trainee.settings})


@pytest.fixture(scope="module")
def prior(base, denoiser):
    return base.of(inference_network=denoiser)


def observed(prior, walks, frames=WINDOW, freedom=None, noise=0.04):
    truth = walks[0].window(10, frames)
    hidden = np.zeros((frames, BODY.n_joints), dtype=bool)
    hidden[3:8, BODY.index("left_knee")] = True
    likelihood = Joints3D.observe(truth, noise, 0, hidden=hidden, degrees_of_freedom=freedom)
    return MotionPosterior(prior.of(frames=frames), likelihood)


@pytest.fixture(scope="module")
def posterior(prior, walks):
    return observed(prior, walks)


def run(sampler, posterior, draws=3, chains=2, seed=9, **options):
    return sampler.sample(
        posterior, draws=draws, chains=chains, seed=seed, progress=False, **options
    )


class Recorder:
    """Network that records its inference and interrupts after a number of batches."""

    def __init__(self, network, batches=10**9):
        self.network, self.batches, self.reads = network, batches, network.reads

    def on(self, prior, likelihood, **options):
        self.inference = self.network.on(prior, likelihood, **options)
        draw = self.inference.draw

        def interrupted(streams, n):
            self.batches -= 1
            if self.batches < 0:
                raise KeyboardInterrupt
            return draw(streams, n)

        self.inference.draw = interrupted
        return self.inference


def optimised(posterior, denoiser, sampler=FIT):
    """Return the optimised inference and its draws."""
    recorder = Recorder(denoiser)
    draws = run(replace(sampler, network=recorder), posterior, draws=40, chains=1)
    return recorder.inference, draws


def term(inference, name, n):
    """Return a term of the bound, summed over windows and averaged over noise."""
    with torch.no_grad():
        bounds = [inference.bound(np.random.default_rng(seed)) for seed in range(n)]
    return float(np.mean([float(getattr(bound, name).sum()) for bound in bounds]))


def test_draws_are_accurate_and_have_theta_and_its_log_density(posterior, prior, walks):
    truth = walks[0].window(10, WINDOW).positions
    visible = posterior.likelihood.entries.visible
    draws = run(DVAEInference(), posterior, draws=5)
    errors = [draws.flat().mean(axis=0) - truth, posterior.likelihood.joints - truth]
    mean_error, noise = (np.linalg.norm(error[visible], axis=-1).mean() for error in errors)
    assert mean_error < 0.9 * noise
    assert draws.positions.shape == (2, 5, WINDOW, 14, 3)
    theta = draws.dataset["theta"].values
    assert theta.shape == (2, 5, prior.dim)
    np.testing.assert_allclose(prior.motion(theta), draws.positions.values, atol=1e-4)
    np.testing.assert_allclose(
        draws.dataset["log_density"].values, posterior.log_density(theta), rtol=1e-9
    )
    assert draws.independent
    assert draws.counts == {"gradient": 0}
    assert len(np.unique(theta[..., 0])) == 10


@pytest.mark.parametrize(
    ("sampler", "frames"),
    [(DVAEInference(overlap=3), WINDOW), (replace(FIT, iterations=3, overlap=3), 20)],
)
def test_a_draw_depends_only_on_its_seed_chain_and_number(prior, walks, sampler, frames):
    posterior = observed(prior, walks, frames)
    full = run(sampler, posterior, draws=7, chains=3)
    names = [name for name in ("theta", "log_density") if name in full.dataset]
    assert bool(names) == (frames == WINDOW)
    try:
        torch.set_num_threads(2)
        for other, draws, chains in ((sampler, 4, 1), (replace(sampler, batch=2), 3, 2)):
            subset = run(other, posterior, draws=draws, chains=chains)
            assert subset.counts == full.counts
            for name in ("positions", *names):
                expected = full.dataset[name].values[:chains, :draws]
                np.testing.assert_array_equal(subset.dataset[name].values, expected)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert (run(sampler, posterior, seed=10).positions != full.positions[:2, :3]).any()


def test_optimisation_increases_the_bound_of_a_copy(posterior, denoiser):
    before = {name: value.clone() for name, value in denoiser.networks.state_dict().items()}
    inference, draws = optimised(posterior, denoiser)
    assert draws.counts == {"gradient": FIT.iterations}
    initial = denoiser.on(posterior.prior, posterior.likelihood)

    @torch.no_grad()
    def losses(inference):
        loss = partial(inference.loss, initial_entropy=True, latent_weight=1.0)
        return np.array([float(loss(np.random.default_rng(seed))) for seed in range(15)])

    gain = losses(initial) - losses(inference)
    assert gain.mean() > 5 * gain.std() / math.sqrt(15)
    assert term(inference, "data", 15) > term(initial, "data", 15)
    after = inference.denoiser.networks.state_dict()
    assert any(not torch.equal(value, before[name]) for name, value in after.items())
    for name, value in denoiser.networks.state_dict().items():
        assert torch.equal(value, before[name])
        assert not value.requires_grad
    assert not any(value.requires_grad for value in posterior.prior.model.parameters())


@pytest.mark.parametrize(
    ("observed_freedom", "freedom", "heavy_tailed"),
    [(None, 4.0, True), (4.0, math.inf, False), (4.0, None, True)],
)
def test_degrees_of_freedom_override_those_of_the_likelihood(
    prior, walks, denoiser, observed_freedom, freedom, heavy_tailed
):
    posterior = observed(prior, walks, freedom=observed_freedom)
    sampler = replace(FIT, iterations=2, degrees_of_freedom=freedom)
    inference, _ = optimised(posterior, denoiser, sampler)
    assert (term(inference, "noise", 2) > 0) == heavy_tailed
    assert float(inference.windows.tails[0]) == (0.25 if heavy_tailed else 0.0)


@pytest.mark.slow
def test_without_the_initial_entropy_first_frames_are_overconfident(posterior, denoiser):
    sampler = replace(FIT, iterations=40, learning_rate=0.01)
    fits = [
        optimised(posterior, denoiser, replace(sampler, initial_entropy=entropy))
        for entropy in (False, True)
    ]
    without, including = (draws.flat()[:, 0].std(axis=0).mean() for _, draws in fits)
    assert without < 0.8 * including


@pytest.mark.parametrize("sampler", [DVAEInference(), replace(FIT, iterations=4)])
def test_predict(posterior, denoiser, sampler):
    motion = sampler.predict(posterior, seed=3, progress=False)
    again = sampler.predict(posterior, seed=3, progress=True)
    np.testing.assert_array_equal(again.positions, motion.positions)
    assert (motion.frames, motion.skeleton, motion.fps) == (WINDOW, BODY, 30.0)
    decoded = sampler.predict(posterior, seed=3, average=False, progress=False)
    assert abs(decoded.positions - motion.positions).max() > 1e-3
    if sampler.mode == "regression":
        inference = denoiser.on(posterior.prior, posterior.likelihood)
        expected = inference.predict(seeds.generator(3, "predict"), average=True)
        np.testing.assert_allclose(motion.positions, expected, atol=1e-6)


@pytest.mark.parametrize("frames", [2, 13, 75])
def test_motions_of_any_length(prior, walks, frames):
    truth = walks[0].window(3, frames)
    posterior = MotionPosterior(prior.of(frames=frames), Joints3D.observe(truth, 0.02, 0))
    draws = run(replace(DVAEInference(), overlap=4), posterior)
    assert draws.positions.shape == (2, 3, frames, 14, 3)
    assert ("theta" in draws.dataset) == (frames <= WINDOW)
    predicted = DVAEInference(overlap=4).predict(posterior, progress=False)
    assert predicted.frames == frames
    error = np.linalg.norm(draws.flat() - truth.positions, axis=-1).mean()
    assert error < 0.15


@pytest.mark.parametrize("overlap", [5, 0])
def test_windows_join_without_jumps(prior, walks, overlap):
    """Accelerations at the edges of windows are like those inside, except without overlap."""
    posterior = observed(prior, walks, 75)
    sampler = DVAEInference(overlap=1)
    object.__setattr__(sampler, "overlap", overlap)  # the sampler rejects 0 for this reason
    draws = run(sampler, posterior, draws=20).flat()
    predicted = sampler.predict(posterior, average=False, progress=False).positions
    starts = range(WINDOW - overlap, 75 - WINDOW, WINDOW - overlap)
    # Select the frames before and after the edges of overlaps.
    edges = {edge for start in starts for edge in (start, start + overlap)}
    indices = np.array([edge + step for edge in sorted(edges) for step in (-1, 0)]) - 1
    for motions in (draws, predicted[None]):
        size = np.linalg.norm(np.diff(motions, 2, axis=1), axis=-1).mean(axis=(0, 2))
        inside = np.delete(size, indices)
        smooth = size[indices].max() < 1.5 * inside.max()
        smooth &= np.median(size[indices]) < 1.5 * np.median(inside)
        assert smooth == (overlap > 0)


@pytest.mark.parametrize("with_network", [True, False])
def test_without_observations_draws_are_those_of_the_prior(prior, base, trainings, with_network):
    draws = run(replace(FIT, batch=4), MotionPosterior(prior if with_network else base))
    for chain, draw in np.ndindex(2, 3):
        rng = NormalStreams.of_draws(9, [(chain, draw)]).generators[0]
        expected = prior.sample(rng, 1)[0]
        np.testing.assert_allclose(draws.positions.values[chain, draw], expected, atol=1e-9)
    assert draws.counts == {"gradient": 0}
    assert trainings == []


def test_a_network_is_trained_if_none_supports_the_observations(prior, base, walks, trainings):
    camera = Cameras.ring(1, elevation=0.3)
    keypoints = Keypoints2D.observe(walks[0].window(0, WINDOW), camera, 0.05, seed=0)
    for posterior in (observed(base, walks), MotionPosterior(prior, keypoints)):
        draws = run(QUICK, posterior)
        assert draws.positions.shape == (2, 3, WINDOW, 14, 3)
        assert "theta" not in draws.dataset
    assert [(settings.steps, settings.pairs) for settings in trainings] == [(20, 150)] * 2


def test_invalid_windows_are_refused(prior, walks, posterior):
    hidden = np.zeros((40, 14), dtype=bool)
    hidden[8:34] = True
    occluded = Joints3D.observe(walks[0].window(0, 40), 0.04, 0, hidden=hidden)
    with pytest.raises(ValueError, match="joints"):
        run(DVAEInference(overlap=4), MotionPosterior(prior.of(frames=40), occluded))
    run(DVAEInference(overlap=WINDOW - 1), posterior)
    with pytest.raises(ValueError, match=r"^overlap must be .*12.*, got 12"):
        run(DVAEInference(overlap=WINDOW), posterior)


def test_an_interrupted_run_has_the_finished_draws(posterior, denoiser):
    complete = run(DVAEInference(batch=4), posterior, draws=6, chains=3)
    stopping = DVAEInference(batch=4, network=Recorder(denoiser, batches=2))
    with pytest.raises(Interrupted, match="interrupted after 2 draws per chain") as stopped:
        run(stopping, posterior, draws=6, chains=3)
    # Two batches of four contain two draws of all three chains.
    for name in ("positions", "theta", "log_density"):
        finished = stopped.value.draws.dataset[name].values
        np.testing.assert_array_equal(finished, complete.dataset[name].values[:, :2])
    stopping_early = DVAEInference(batch=2, network=Recorder(denoiser, batches=1))
    with pytest.raises(KeyboardInterrupt) as early:
        run(stopping_early, posterior, draws=6, chains=3)
    assert not isinstance(early.value, Interrupted)


def test_provenance_of_draws(posterior, denoiser, tmp_path):
    for network, expected in ((None, None), (denoiser, repr(denoiser))):
        sampler = replace(FIT, iterations=2, network=network)
        draws = run(sampler, posterior)
        settings = json.loads(draws.dataset.attrs["settings"])
        assert settings["network"] == expected
        assert settings["mode"] == "optimization"
        draws.save(tmp_path / "draws.nc")
        loaded = MotionDraws.load(tmp_path / "draws.nc")
        np.testing.assert_array_equal(loaded.dataset["theta"], draws.dataset["theta"])
        assert loaded.dataset.attrs["settings"] == draws.dataset.attrs["settings"]
        np.testing.assert_array_equal(
            run(pickle.loads(pickle.dumps(sampler)), posterior).flat(), draws.flat()
        )
    assert " at 0x" not in repr(denoiser)
