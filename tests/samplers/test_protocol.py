"""Tests of the protocol that every registered sampler satisfies."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, fields, is_dataclass, replace

import numpy as np
import pytest

import probmotion.samplers
from probmotion import MotionDraws, MotionPosterior
from probmotion.cli.settings_options import object_from_text, text_of_object
from probmotion.posteriors.sampling import (
    Sampler,
    UnsupportedPosterior,
    load_sampler,
    progress_bar,
    suited,
)
from probmotion.problems import load_problem
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector
from probmotion.samplers.independent import IndependentSampler

QUICK = {
    "exact": {},
    "ancestral3d": {"steps": 5},
    "mas": {"steps": 5},
    "mvpc": {"steps": 5},
    "split-gibbs": {"steps": 5, "sweeps": 1, "start_steps": 3},
    "sds": {"iterations": 5, "n_views": 2},
    "mh": {"warmup": 20, "thin": 2},
    "nuts": {"warmup": 20},
    "ensemble": {"warmup": 20, "thin": 2},
    "tempered": {"warmup": 5, "thin": 1, "particles": 16},
    "smc": {"particles": 16, "thin": 1},
    "dvae": {"training_steps": 5, "training_pairs": 200},
}


@pytest.fixture(params=QUICK)
def sampler(request):
    return load_sampler(request.param)(**QUICK[request.param])


@pytest.fixture
def run(sampler, mixture_posterior):
    """Return a function that draws given observations, or with `sds` from the prior."""
    posterior = mixture_posterior
    if sampler.name == "sds":
        posterior = MotionPosterior(posterior.prior)

    def draw(other=sampler, **options):
        return other.sample(posterior, **{"draws": 3, "seed": 9, "progress": False} | options)

    return draw


def test_samplers_are_registered_and_their_settings_round_trip(sampler):
    """The settings round-trip through JSON and text."""
    assert isinstance(sampler, Sampler)
    assert load_sampler(sampler.name) is type(sampler)
    assert getattr(probmotion.samplers, type(sampler).__name__) is type(sampler)
    assert hash(replace(sampler)) == hash(sampler)
    plain = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in json.loads(json.dumps(asdict(sampler))).items()
        if not isinstance(value, dict)
    }
    values = {setting.name: getattr(sampler, setting.name) for setting in fields(sampler)}
    read = {
        name: object_from_text(text_of_object(value), [type(value)])
        for name, value in values.items()
        if is_dataclass(value)
    }
    assert type(sampler)(**plain, **read) == sampler


def test_a_draw_depends_only_on_its_seed_chain_and_number(sampler, run):
    full = run(draws=5, chains=3)
    values = full.positions.values
    assert len(np.unique(values.reshape(15, -1), axis=0)) > 1
    repeated = run(draws=5, chains=3, progress=True)
    np.testing.assert_array_equal(repeated.positions.values, values)
    assert repeated.counts == full.counts
    assert (run(draws=5, chains=3, seed=10).positions.values != values).any()
    for draws, chains in ((5, 1), (2, 3)):
        subset = run(draws=draws, chains=chains).positions.values
        np.testing.assert_allclose(subset, values[:chains, :draws], rtol=0, atol=1e-9)
    if hasattr(sampler, "batch"):
        batched = run(replace(sampler, batch=2), draws=5, chains=3)
        np.testing.assert_allclose(batched.positions.values, values, rtol=0, atol=1e-9)
        assert batched.counts == full.counts


def test_saving_and_continuing(sampler, run, tmp_path):
    """Positions that are random given θ also continue."""
    draws = run(chains=2)
    draws.save(tmp_path / "draws.nc")
    loaded = MotionDraws.load(tmp_path / "draws.nc")
    np.testing.assert_array_equal(loaded.positions.values, draws.positions.values)
    assert loaded.counts == draws.counts
    assert set(loaded.state) == set(draws.state)
    rest = run(draws=2, chains=2, initial=loaded)
    parts = np.concatenate([draws.positions.values, rest.positions.values], axis=1)
    complete = run(draws=5, chains=2).positions.values
    # Rounding of matrix products depends on the batch.
    tolerance = 1e-9 if isinstance(sampler, IndependentSampler) else 1e-12
    np.testing.assert_allclose(parts, complete, rtol=0, atol=tolerance)
    with pytest.raises(ValueError, match=r"seed must be 9, as in the run to be continued, got 1"):
        run(chains=2, seed=1, initial=loaded)
    if isinstance(sampler, IndependentSampler):
        message = f"initial must be None or an earlier run, got ndarray: {sampler.name} has no"
        with pytest.raises(ValueError, match=message):
            run(initial=np.zeros(3))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"draws": 0}, "draws must be an integer of at least 1, got 0"),
        ({"chains": 1.5}, "chains must be an integer of at least 1, got 1.5"),
        ({"seed": -1}, "seed must be an integer of at least 0, got -1"),
    ],
)
def test_arguments_out_of_range(run, options, message):
    with pytest.raises(ValueError, match=message):
        run(**options)


def test_missing_protocols_are_named(sampler, minimal):
    posterior = MotionPosterior(minimal())
    assert suited(posterior) == []
    with pytest.raises(
        UnsupportedPosterior,
        match=rf"^{sampler.name} needs a prior with \w+( (or|and) \w+)*, got Mi",
    ):
        sampler.sample(posterior, draws=1, progress=False)


@pytest.mark.parametrize("kind", [MultiViewAncestral, MultiViewPredictorCorrector])
def test_draws_with_an_exact_denoiser_are_bit_identical_for_any_batch(kind):
    """Rounding errors would be amplified by the steps."""
    posterior, sampler = load_problem("gait").posterior, kind(steps=15)
    full = sampler.sample(posterior, draws=3, chains=3, progress=False).positions.values
    subset = replace(sampler, batch=2).sample(posterior, draws=2, progress=False)
    np.testing.assert_array_equal(subset.positions.values[0], full[0, :2])


@pytest.mark.parametrize("name", ["exact", "ancestral3d", "mas", "mvpc", "split-gibbs", "sds"])
@pytest.mark.parametrize("problem", ["gait", "gait-monocular", "gait-noisy3d"])
def test_suited_samplers_are_those_that_sample(problem, name):
    posterior = load_problem(f"{problem}(frames=4, components=3)").posterior
    kind = load_sampler(name)
    effort = {field: getattr(kind, "least_effort", 1) for field in getattr(kind, "effort", ())}
    if name in suited(posterior):
        kind(**effort).sample(posterior, draws=1, progress=False)
        return
    with pytest.raises(
        UnsupportedPosterior, match=r"; try .*dvae, .*mh, .*nuts(, sds)?(, split-gibbs)?, .*smc.*"
    ):
        kind(**effort).sample(posterior, draws=1, progress=False)


def test_dvae_is_not_suited_to_observations_it_cannot_be_trained_on(mixture_posterior):
    class Flat:
        def log_density(self, positions):
            return 0 * positions.sum(axis=(-3, -2, -1))

        def simulate(self, rng, positions):
            return self

    flat = replace(mixture_posterior, likelihood=Flat())
    assert "dvae" in suited(mixture_posterior)
    assert "dvae" not in suited(flat)
    with pytest.raises(UnsupportedPosterior, match="needs observed keypoints or joints, got Flat"):
        load_sampler("dvae")().sample(flat, draws=1, progress=False)


def test_hidden_progress_bars_create_no_semaphore(monkeypatch):
    """Worker processes do not release it and would warn of a leak when they end."""
    monkeypatch.setitem(sys.modules, "tqdm", None)
    with progress_bar(3, "hidden", show=False) as bar:
        bar.update()
        bar.update(2)
    with pytest.raises(ImportError), progress_bar(3, "shown", show=True):
        pass
