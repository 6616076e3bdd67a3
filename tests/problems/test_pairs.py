"""Pose-pair problems: held-out clips, coverage and comparison."""

from __future__ import annotations

import numpy as np
import pytest

import probmotion as pm
from probmotion import MotionDraws
from probmotion.data.pair_sets import SALSA_HELD_OUT
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.metrics.coverage import coverage
from probmotion.metrics.measures import measure
from probmotion.models.unseen_depth import physical_lifts
from probmotion.models.unseen_depth.physical_lift import DEPTH_SD
from probmotion.posteriors.problem import Problem
from probmotion.posteriors.reference import fingerprint_of
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem, pairs_problem, problem_descriptions, problem_names
from probmotion.problems.references import making
from probmotion.samplers import MetropolisHastings, TemperedPairs
from probmotion.samplers.mcmc.proposals import Isotropic


@pytest.fixture(scope="module")
def problem() -> Problem:
    return load_problem("dance-pairs")


def test_problems_are_listed_with_descriptions(problem):
    assert {"dance-pairs", "salsa-pairs", "salsa-pairs-paper"} <= set(problem_names())
    descriptions = problem_descriptions()
    assert set(descriptions) == set(problem_names())
    for loaded in (problem, load_problem("gait")):
        assert loaded.description == descriptions[loaded.name]


def test_clips_are_held_out_completely(problem):
    """Neither the annotations nor the seed come from held-out clips."""
    dances = [dance.positions for dance in synthetic_dances(8)]
    training, test = np.concatenate(dances[:6]), np.concatenate(dances[6:])
    assert problem.held_out.shape == (60, 1, 34, 3)
    for pose in problem.held_out[:, 0]:
        assert np.abs(test - pose).max(axis=(1, 2)).min() == 0
        assert np.abs(training - pose).max(axis=(1, 2)).min() > 1e-3
    seed = problem.posterior.prior.seed[0]
    assert np.abs(training - seed).max(axis=(1, 2)).min() == 0
    sources = set(problem.posterior.likelihood.annotations.sources)
    assert sources <= {f"dance-{number}" for number in range(6)}


@pytest.fixture
def lifted(real_data, monkeypatch, tmp_path) -> Problem:
    """Return the problem of one lift, with the shipped reference draws."""
    monkeypatch.setenv("PROBMOTION_DATA", str(tmp_path))
    (tmp_path / "cmu_salsa_pairs").symlink_to(real_data / "cmu_salsa_pairs")
    return load_problem("salsa-physical")


def test_lifted_annotation_is_of_the_truth(lifted):
    lift = lifted.posterior.prior
    deviations = (lift.keypoints - lifted.truth[0, :, :2]).ravel()
    assert deviations.std() == pytest.approx(lift.learnt.noise, rel=0.3)
    # Noise and joints: the truth has the density of draws.
    log_density = lift.log_prior(lifted.stored.positions.astype(float))
    z = (lift.log_prior(lifted.truth) - log_density.mean()) / log_density.std()
    assert abs(z) < 6


def test_unfinished_references_of_lifts_are_told_apart(lifted, monkeypatch):
    """The density of a physical lift is 0 at random motions, which identify no lift."""
    kept = []

    def watched(posterior, probes):
        kept.extend(fingerprint_of(posterior, probes))
        raise InterruptedError

    monkeypatch.setattr(making, "fingerprint_of", watched)
    with pytest.raises(InterruptedError):
        making.make_reference(lifted)
    assert np.isfinite(kept).all()


@pytest.mark.slow
def test_physical_lifts_agree_with_the_reference(lifted):
    """After more sweeps than by default, which do not forget the start entirely."""
    lift, rng = lifted.posterior.prior, np.random.default_rng(0)
    annotations = np.repeat(lift.keypoints[None], 200, axis=0)
    right = physical_lifts(lift.learnt, annotations, lift.physics, warmup=256, sweeps=512)[0]
    wrong = lift.learnt.sample_lifts(annotations, rng, 1)[0]  # without the physical prior
    verdicts = []
    for poses in (right, wrong):
        poses[..., 2] += DEPTH_SD * rng.standard_normal((200, 1))
        draws = MotionDraws.of(
            lifted.posterior, TemperedPairs(), poses[None, :, None], seed=0, seconds=1.0,
            independent=True,
        )  # fmt: skip
        verdicts.append(pm.score(lifted, draws).verdict)
    assert [verdict.is_wrong for verdict in verdicts] == [False, True]


def test_metrics_include_coverage_and_are_invariant_to_translation(problem):
    sampler = MetropolisHastings(Isotropic(0.02), warmup=300, thin=2)
    draws = sampler.sample(problem.posterior, draws=30, chains=2, progress=False)
    metrics = measure(problem, draws, seed=0)
    poses = draws.flat()[:, 0]
    for kind in ("interaction", "cartesian", "shape-context"):
        expected = coverage(problem.held_out[:, 0], poses, kind)
        assert metrics[f"coverage_{kind}"] == pytest.approx(expected)
    assert 0 <= metrics["at_cap"] <= 1
    assert 0 <= metrics["near_floor"] <= 1
    positions = draws.dataset["positions"].values + np.array([50.0, 0.0, -50.0])
    translated = MotionDraws.of(problem.posterior, sampler, positions, seed=0, seconds=1.0)
    swd_ratio = measure(problem, translated, seed=0)["swd_ratio"]
    assert swd_ratio == pytest.approx(metrics["swd_ratio"], rel=1e-6)
    assert swd_ratio > 1.5


@pytest.mark.slow
def test_posterior_draws_cover_better_than_seed_and_prior(problem):
    """This test uses synthetic data; the ablations use real data."""
    sampler = MetropolisHastings(Isotropic(0.02), warmup=1000, thin=4)
    truth, prior = problem.held_out[:, 0], problem.posterior.prior
    posterior_coverage, prior_coverage = (
        coverage(truth, sampler.sample(posterior, draws=150, chains=4, progress=False).flat()[:, 0])
        for posterior in (problem.posterior, TruncatedPosterior(prior))
    )
    assert posterior_coverage < coverage(truth, prior.seed)
    assert posterior_coverage < 0.8 * prior_coverage


def test_compare_reports_unsupported_samplers(problem, tmp_path):
    samplers = {"mh": MetropolisHastings(Isotropic(0.02), warmup=200, thin=2)}
    comparison = pm.compare(
        problem,
        samplers | {name: name for name in ("nuts", "ensemble", "mas")},
        draws=20,
        chains=2,
        out=tmp_path,
        workers=0,
        progress=False,
    )
    text = str(comparison.table())
    assert "held-out poses" in text
    for words in ("D_IC", "near floor", "Denoises2D", "gradient", "dimension"):
        assert words in text
    assert "needs a differentiable density, which PosePairPrior does not have; try mh" in text


def test_invalid_inputs_are_rejected():
    dances = synthetic_dances(2)
    with pytest.raises(ValueError, match="dance-9"):
        pairs_problem(dances, ["dance-9"])
    with pytest.raises(ValueError, match="held_out must have shape"):
        Problem("p", "", load_problem("gait").posterior, held_out=np.zeros((3, 1, 34, 3)))


def test_salsa_problem_matches_the_paper(real_data, monkeypatch):
    monkeypatch.setenv("PROBMOTION_DATA", str(real_data))
    problem = load_problem("salsa-pairs")
    paper = load_problem("salsa-pairs-paper").posterior
    assert (paper.limit, paper.likelihood.noise) == (100, 0.01)
    assert problem.posterior.limit == np.inf
    likelihood = problem.posterior.likelihood
    assert len(likelihood.annotations) == 5599
    assert not set(likelihood.annotations.sources) & set(SALSA_HELD_OUT)
    assert problem.held_out.shape == (300, 1, 34, 3)
    assert problem.posterior.dim == 108
    # Views of the annotations are estimated; the seed must be within the prior's support.
    assert np.isfinite(problem.posterior.log_seed)
    log_f = problem.posterior.prior.log_plausibility(problem.held_out)
    assert np.median(log_f) > -2
    assert np.quantile(log_f, 0.1) > -20
