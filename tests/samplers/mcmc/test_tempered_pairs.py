"""Tempering of pose pairs: draws, truncation, resuming and powers."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import replace
from threading import Event
from unittest.mock import Mock

import numpy as np
import pytest

from probmotion import MotionPosterior
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.posteriors.sampling import Interrupted, suited
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem
from probmotion.samplers.mcmc import stored_chain, tempered_pairs
from probmotion.samplers.mcmc.stored_chain import StoredChain
from probmotion.samplers.mcmc.tempered_pairs import TemperedPairs
from tests.models.pose_pairs.small_dances import (
    MAX_Z,
    base_draws,
    small_likelihood,
    small_prior,
    z_scores,
)


@pytest.fixture(scope="module")
def likelihood():
    return small_likelihood()


@pytest.fixture(scope="module")
def prior():
    return small_prior()


@pytest.fixture(scope="module")
def exact(prior):
    return base_draws(prior)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [2.0, math.inf])
def test_draws_match_importance_sampling(prior, likelihood, exact, limit):
    """Limits and penetration are weak, so that draws of the base measure cover the posterior."""
    weak_prior = replace(prior, position_noise=0.7, max_invalid=24)
    log_f = weak_prior.log_plausibility(exact[:, None]) + likelihood.log_density(exact[:, None])
    # Choose a seed of intermediate density, so that both bounds truncate.
    seed = weak_prior.coordinates(exact[np.argsort(log_f)[int(0.97 * len(exact))]])
    posterior = TruncatedPosterior(weak_prior, likelihood, seed=seed, limit=limit)
    log_cut = np.where(log_f < posterior.log_floor, -np.inf, np.minimum(log_f, posterior.log_cap))
    weights = np.exp(log_cut - log_cut.max())
    allowed, weights = exact[weights > 0], weights[weights > 0]
    assert weights.sum() ** 2 / (weights**2).sum() > 400
    sampler = TemperedPairs(levels=5, steps=100, warmup=100, thin=1)
    run = sampler.sample(posterior, draws=600, chains=2, progress=False)
    poses = run.dataset["positions"].values[:, :, 0]
    drawn = _summaries(poses.reshape(-1, *poses.shape[2:]), posterior)
    drawn = drawn.reshape(*poses.shape[:2], -1)
    expected = _summaries(allowed, posterior)
    mean = np.average(expected, axis=0, weights=weights)
    weighted = weights[:, None] * (expected - mean)
    error = np.sqrt((weighted**2).sum(axis=0)) / weights.sum()
    assert np.abs(z_scores(drawn, mean, error)).max() < MAX_Z
    if math.isfinite(limit):
        assert log_f.max() > posterior.log_cap
        assert (drawn[..., :2].sum(axis=-1) >= posterior.log_floor - 1e-6).all()


def test_levels_of_low_powers_take_fewer_steps(prior, likelihood):
    """Powers are 0, 10⁻⁵ and 1 for 16 exchanges; then tuning increases the second."""
    sampler = TemperedPairs(levels=3, steps=100, warmup=16, thin=1)
    run = sampler.sample(MotionPosterior(prior, likelihood), draws=1, progress=False)
    assert run.counts["density"] - 16 * (40 + 40 + 100) in (40 + 40 + 100, 40 + 100 + 100)


def test_error_of_one_chain_stops_all_chains(prior, likelihood, monkeypatch):
    exchange, ladders = tempered_pairs._Ladder._exchange_after_walking, {}

    def failing(ladder, stop):
        if ladders.setdefault(id(ladder), len(ladders)):
            raise MemoryError("no room")
        exchange(ladder, stop)

    monkeypatch.setattr(tempered_pairs._Ladder, "_exchange_after_walking", failing)
    with pytest.raises(MemoryError, match="no room"):
        endless(MotionPosterior(prior, likelihood))


def endless(posterior):
    sampler = TemperedPairs(levels=3, steps=5, warmup=16, thin=1)
    sampler.sample(posterior, draws=10**6, chains=2, progress=False)


@pytest.mark.parametrize("cut", [False, True])
def test_interrupted_run_resumes_bit_identically(prior, likelihood, cut, monkeypatch, tmp_path):
    posterior = MotionPosterior(prior, likelihood)
    if cut:
        posterior = TruncatedPosterior(prior, likelihood, limit=1e3)
    sampler = TemperedPairs(levels=3, steps=30, warmup=20, thin=3)
    options = {"draws": 12, "chains": 2, "seed": 4, "progress": False}
    uninterrupted = sampler.sample(posterior, **options)
    monkeypatch.setattr(stored_chain, "_SECONDS", 0.0)
    save = StoredChain.save

    def stopping(file, state):
        save(file, state)
        if len(state()["draws"]) == 7:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(StoredChain, "save", stopping)
        with pytest.raises(Interrupted) as interruption:
            sampler.sample(posterior, **options, unfinished=tmp_path / "run")
    finished = interruption.value.draws.dataset["positions"]
    assert 0 < finished.sizes["draw"] < 12
    first = {"draw": slice(finished.sizes["draw"])}
    assert np.array_equal(finished, uninterrupted.dataset["positions"].isel(first))
    exchange, calls = tempered_pairs._Ladder._exchange_after_walking, []
    monkeypatch.setattr(
        tempered_pairs._Ladder,
        "_exchange_after_walking",
        lambda *args: calls.append(1) or exchange(*args),
    )
    resumed = sampler.sample(posterior, **options, unfinished=tmp_path / "run")
    assert len(calls) < 2 * (20 + 3 * 12) - 20
    for name in ("positions", "round_trips", "rejected_exchanges"):
        assert np.array_equal(resumed.dataset[name], uninterrupted.dataset[name])
    (tmp_path / "run-0.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"run-0.npz must contain a stored chain"):
        sampler.sample(posterior, **options, unfinished=tmp_path / "run")


def test_ctrl_c_stops_all_chains(prior, likelihood):
    main, before = threading.main_thread().ident, signal.getsignal(signal.SIGINT)
    interrupt = threading.Timer(0.5, signal.pthread_kill, (main, signal.SIGINT))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        interrupt.start()
        with pytest.raises(KeyboardInterrupt):
            endless(MotionPosterior(prior, likelihood))
    finally:
        interrupt.join()
        signal.signal(signal.SIGINT, before)
    assert not [thread for thread in threading.enumerate() if "Executor" in thread.name]


def test_chains_start_at_successive_seeds(prior, likelihood):
    """The base measure is relative to the first seed."""
    two_seeds = np.stack([prior.seed[0], synthetic_dances(2)[1].positions[40]])
    posterior = MotionPosterior(replace(prior, seed=two_seeds), likelihood)
    walks, rng = posterior.prior.walks(likelihood), np.random.default_rng(0)
    for chain, seed in enumerate((0, 1, 0)):
        ladder = tempered_pairs._Ladder(TemperedPairs(), posterior, walks, rng, chain)
        assert (ladder.poses == two_seeds[seed]).all()
        theta = posterior.prior.seed_coordinates()[seed]
        stretches, translations = theta[12:].reshape(-1, 3)[:, 2], theta[6:12]
        normal = -0.5 * ((stretches / prior.bone_noise) ** 2).sum() - 0.5 * (translations**2).sum()
        np.testing.assert_allclose(ladder.parts[:, 0], normal, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_tuned_powers_have_equal_rejection_rates(prior, likelihood):
    posterior = MotionPosterior(prior, replace(likelihood, noise=0.05))
    sampler, rng = TemperedPairs(levels=10, steps=40, warmup=500, thin=1), np.random.default_rng(0)
    ladder = tempered_pairs._Ladder(sampler, posterior, prior.walks(posterior.likelihood), rng, 0)
    ladder._warm_up(Event(), Mock())
    assert (ladder.powers[0], ladder.powers[-1]) == (0.0, 1.0)
    for _ in range(600):
        ladder._exchange_after_walking(Event())
    rates = ladder.rejected / ladder.asked
    assert rates.max() - rates.min() < 0.25
    assert ladder.barrier == pytest.approx(rates.sum())
    # The ideal is one round trip in 2 + 2 Σ r/(1 − r) exchanges (Syed et al. 2022).
    ideal = 600 / (2 + 2 * (rates / (1 - rates)).sum())
    assert 0.1 * ideal < ladder.round_trips < 1.5 * ideal


def test_unsuitable_posteriors_are_rejected(prior, likelihood):
    visible = likelihood.annotations.visible.copy()
    visible[0, 3] = False
    occluded = AnnotatedPairs(replace(likelihood.annotations, visible=visible), n_views=2)
    for posterior, message in (
        (load_problem("gait-monocular").posterior, "needs a prior with HasWalks, got Gaussian"),
        (MotionPosterior(prior), "annotations of all joints, got MotionPosterior with NoneType"),
        (MotionPosterior(prior, occluded), "joints, got MotionPosterior with AnnotatedPairs"),
    ):
        with pytest.raises(ValueError, match=message):
            TemperedPairs().sample(posterior, progress=False)
        assert "tempered-pairs" not in suited(posterior)
    assert "tempered-pairs" in suited(MotionPosterior(prior, likelihood))
    with pytest.raises(ValueError, match="initial must be None, got ndarray"):
        TemperedPairs().sample(MotionPosterior(prior, likelihood), initial=np.zeros((1, 108)))
    with pytest.raises(ValueError, match="levels must be an integer of at least 3, got 2"):
        TemperedPairs(levels=2)


def _summaries(poses: np.ndarray, posterior: MotionPosterior):
    """Return log f, log L, and the distance between and alignment of the two people."""
    skeleton = posterior.likelihood.skeleton
    roots = list(skeleton.roots)
    chests = [k for k, name in enumerate(skeleton.joint_names) if "chest" in name]
    trunks = poses[:, chests] - poses[:, roots]
    log_f = posterior.prior.log_plausibility(poses[:, None])
    log_l = posterior.likelihood.log_density(poses[:, None])
    distance = np.linalg.norm(poses[:, roots[0]] - poses[:, roots[1]], axis=-1)
    return np.stack([log_f, log_l, distance, np.prod(trunks, axis=1).sum(axis=-1)], axis=-1)
