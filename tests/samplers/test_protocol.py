"""What every registered sampler is: a frozen dataclass, named, seeded, counted, and polite."""

from __future__ import annotations

import json
from dataclasses import FrozenInstanceError, asdict, fields, is_dataclass, replace
from functools import partial

import numpy as np
import pytest

import probmotion.samplers
from probmotion import Cameras, Keypoints2D, Motion, MotionDraws, MotionPosterior
from probmotion.cli.settings_options import object_from_text, text_of_object
from probmotion.models import GaussianMixtureMotion
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import (
    Sampler,
    UnsupportedPosterior,
    load_sampler,
    sampler_names,
    suited,
)
from probmotion.problems import load_problem
from probmotion.samplers import MultiViewAncestral, MultiViewPredictorCorrector

NAMES = ("exact", "ancestral3d", "mas", "mvpc", "sds", "mh", "nuts", "ensemble", "dvae")
QUICK = {
    "ancestral3d": {"steps": 5},
    "mas": {"steps": 5},
    "mvpc": {"steps": 5},
    "sds": {"iterations": 5},
    "mh": {"warmup": 20, "thin": 2},
    "nuts": {"warmup": 20},
    "ensemble": {"warmup": 20, "thin": 2},
    "dvae": {"training_steps": 5, "training_pairs": 200},
}
CHAINS_THAT_GO_ON = ("mh", "nuts", "ensemble")


@pytest.fixture(params=NAMES)
def sampler(request):
    return load_sampler(request.param)(**QUICK.get(request.param, {}))


@pytest.fixture(scope="module")
def prior():
    rng = np.random.default_rng(1)
    return GaussianMixtureMotion(
        skeleton=Skeleton(["a", "b"], [-1, 0]),
        fps=30.0,
        means=rng.normal(size=(2, 2, 2, 3)),
        factors=rng.normal(size=(2, 2, 2, 2, 3)),
        weights=np.array([0.6, 0.4]),
        noise=0.3,
        azimuths=4,
    )


@pytest.fixture(scope="module")
def observed(prior):
    truth = Motion(prior.sample(np.random.default_rng(2), 1)[0], prior.skeleton, prior.fps)
    camera = Cameras.ring(1, elevation=0.3)
    return MotionPosterior(prior, Keypoints2D.observe(truth, camera, 0.3, seed=0))


@pytest.fixture
def posterior(sampler, prior, observed):
    """The observed one; the prior for `sds`, which has no place for evidence."""
    return MotionPosterior(prior) if sampler.name == "sds" else observed


def test_the_entry_points_name_all_eight():
    assert set(NAMES) <= set(sampler_names())


def test_an_unknown_sampler_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"sampler must be one of .*ensemble, exact, got 'gibbs'"):
        load_sampler("gibbs")


def test_it_is_a_frozen_dataclass_of_settings(sampler):
    assert isinstance(sampler, Sampler)
    assert is_dataclass(sampler)
    assert load_sampler(sampler.name) is type(sampler)
    assert getattr(probmotion.samplers, type(sampler).__name__) is type(sampler)
    with pytest.raises(FrozenInstanceError):
        sampler.name = "other"
    for setting in fields(sampler):
        with pytest.raises(FrozenInstanceError):
            setattr(sampler, setting.name, None)


def test_two_of_the_same_settings_are_equal(sampler):
    again = type(sampler)(**QUICK.get(sampler.name, {}))
    assert again == sampler
    assert hash(again) == hash(sampler)


def test_settings_survive_json_and_words(sampler):
    plain = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in json.loads(json.dumps(asdict(sampler))).items()
        if not isinstance(value, dict)
    }
    objects = {
        setting.name: getattr(sampler, setting.name)
        for setting in fields(sampler)
        if is_dataclass(getattr(sampler, setting.name))
    }
    written = {name: text_of_object(value) for name, value in objects.items()}
    read = {name: object_from_text(text, [type(objects[name])]) for name, text in written.items()}
    assert type(sampler)(**plain, **read) == sampler


def test_the_same_seed_gives_the_same_draws_bars_or_not(sampler, posterior):
    one = sampler.sample(posterior, draws=3, chains=2, seed=9, progress=False)
    two = sampler.sample(posterior, draws=3, chains=2, seed=9, progress=True)
    other = sampler.sample(posterior, draws=3, chains=2, seed=10, progress=False)
    np.testing.assert_array_equal(one.positions.values, two.positions.values)
    assert (one.positions.values != other.positions.values).any()
    assert one.counts == two.counts


def test_chain_k_is_the_same_however_many_run(sampler, posterior):
    few = sampler.sample(posterior, draws=3, chains=1, seed=9, progress=False)
    many = sampler.sample(posterior, draws=3, chains=3, seed=9, progress=False)
    np.testing.assert_allclose(few.positions.values[0], many.positions.values[0], rtol=0, atol=1e-9)


def test_the_first_draws_do_not_depend_on_how_many_follow(sampler, posterior):
    few = sampler.sample(posterior, draws=2, seed=9, progress=False)
    many = sampler.sample(posterior, draws=5, seed=9, progress=False)
    np.testing.assert_allclose(
        few.positions.values, many.positions.values[:, :2], rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("name", CHAINS_THAT_GO_ON)
def test_a_chain_goes_on_with_the_motions_of_an_uninterrupted_one(name, observed):
    """Also where a motion at θ is itself a draw."""
    sampler = load_sampler(name)(**QUICK[name])
    run = partial(sampler.sample, observed, chains=2, seed=9, progress=False)
    first = run(draws=3)
    second = run(draws=2, initial=first)
    parts = np.concatenate([first.positions.values, second.positions.values], axis=1)
    np.testing.assert_allclose(parts, run(draws=5).positions.values, rtol=0, atol=1e-12)


def test_draws_are_saved_whole(sampler, posterior, tmp_path):
    draws = sampler.sample(posterior, draws=2, chains=2, seed=9, progress=False)
    draws.save(tmp_path / "draws.nc")
    loaded = MotionDraws.load(tmp_path / "draws.nc")
    assert loaded.positions.shape == (2, 2, 2, 2, 3)
    np.testing.assert_array_equal(loaded.positions.values, draws.positions.values)
    assert loaded.counts == draws.counts
    assert set(loaded.state) == set(draws.state)
    assert bool(draws.state) == (sampler.name in CHAINS_THAT_GO_ON)


def test_what_does_not_fit_is_refused_in_one_sentence(sampler):
    class Bare:
        skeleton, frames, fps, dim = Skeleton(["a"], [-1]), 1, 30.0, 3

        def motion(self, theta):
            return theta.reshape(*theta.shape[:-1], 1, 1, 3)

    posterior = MotionPosterior(Bare())
    assert suited(posterior) == []
    protocols = r"\w+( or \w+)?"
    with pytest.raises(
        UnsupportedPosterior,
        match=rf"^{sampler.name} needs a prior with {protocols}, which Bare is not$",
    ):
        sampler.sample(posterior, draws=1, progress=False)


@pytest.mark.parametrize("name", ["draws", "chains"])
@pytest.mark.parametrize("bad", [0, 1.5])
def test_wrong_numbers_of_draws_are_refused(sampler, posterior, name, bad):
    with pytest.raises(ValueError, match=f"{name} must be an integer of at least 1, got {bad}"):
        sampler.sample(posterior, progress=False, **{name: bad})


def test_wrong_seeds_are_refused(sampler, posterior):
    with pytest.raises(ValueError, match="seed must be an integer of at least 0, got -1"):
        sampler.sample(posterior, draws=1, seed=-1, progress=False)


@pytest.mark.parametrize("sampler", [MultiViewAncestral(), MultiViewPredictorCorrector()])
def test_a_draw_of_the_exact_prior_is_the_same_in_any_company(sampler):
    """To the last bit: a hundred steps would make a large difference of a small one."""
    posterior = load_problem("gait").posterior
    whole = sampler.sample(posterior, draws=5, chains=3, seed=0, progress=False).positions.values
    alone = sampler.sample(posterior, draws=5, chains=1, seed=0, progress=False).positions.values
    np.testing.assert_array_equal(alone[0], whole[0])
    small = replace(sampler, batch=2).sample(posterior, draws=2, chains=1, seed=0, progress=False)
    np.testing.assert_array_equal(small.positions.values[0], whole[0, :2])


@pytest.mark.parametrize("name", ["exact", "ancestral3d", "mas", "mvpc", "sds"])
@pytest.mark.parametrize("problem", ["gait", "gait-monocular", "gait-noisy3d"])
def test_whoever_is_said_to_do_does(problem, name):
    posterior = load_problem(f"{problem}(frames=4, components=3)").posterior
    kind = load_sampler(name)
    effort = {one: getattr(kind, "least_effort", 1) for one in getattr(kind, "effort", ())}
    if name in suited(posterior):
        kind(**effort).sample(posterior, draws=1, progress=False)
        return
    with pytest.raises(UnsupportedPosterior, match=r"; .*dvae, .*mh, .*nuts would do$"):
        kind(**effort).sample(posterior, draws=1, progress=False)


def test_a_network_is_trained_only_for_evidence_that_it_can_be_shown():
    posterior = load_problem("gait-monocular(frames=4, components=3)").posterior
    own = replace(posterior, likelihood=Quiet())
    assert "dvae" in suited(posterior)
    assert "dvae" not in suited(own)
    with pytest.raises(UnsupportedPosterior, match="needs evidence of keypoints or joints"):
        load_sampler("dvae")().sample(own, draws=1, progress=False)


class Quiet:
    """Evidence of one's own, that says nothing."""

    def log_density(self, positions):
        return 0 * positions.sum(axis=(-3, -2, -1))

    def simulate(self, rng, positions):
        return self
