"""Verdicts: exact draws are right, each fault is wrong for its own reason."""

from collections import Counter
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from sklearn.decomposition import PCA

import probmotion as pm
from probmotion.metrics.chains import chain_diagnostics
from probmotion.metrics.measures import measure
from probmotion.metrics.run_statistics import DrawStatistics, draw_statistics
from probmotion.metrics.verdict import Verdict, judge
from probmotion.posteriors.draws import MotionDraws
from probmotion.problems import load_problem
from probmotion.samplers.diffusion import DDPM, Cosine

N, REPEATS = 400, 10
FIRST_ORDER = {"levels": Cosine(), "integrator": DDPM()}


@dataclass(frozen=True)
class Sampler:
    name: ClassVar[str] = "sampler"


def statistics_of(problem, motions, chains=1, independent=True, seed=0):
    shape = (chains, len(motions) // chains, *motions.shape[1:])
    draws = MotionDraws.of(
        problem.posterior, Sampler(), motions.reshape(shape), seed=0, seconds=0.0,
        independent=independent,
    )  # fmt: skip
    return draw_statistics(problem, draws, seed, chain_diagnostics(draws))


def verdict_of(problem, motions, **options) -> Verdict:
    return judge([statistics_of(problem, motions, **options)])


@pytest.fixture(scope="module")
def monocular():
    return load_problem("gait-monocular", frames=10)


@pytest.fixture(scope="module")
def gait():
    return load_problem("gait", frames=10)


def exact_sets(problem, repeats=REPEATS, n=N, seed=99):
    return np.split(problem.reference(seed, repeats * n), repeats)


def words(problem, sets):
    return Counter(verdict_of(problem, motions).word for motions in sets)


def test_exact_draws_are_right(gait, monocular):
    found = words(gait, exact_sets(gait)) + words(monocular, exact_sets(monocular))
    # At a rate of .8, fewer than 13 of 20 sets are right in 3 % of cases.
    assert found["right"] >= 0.65 * 2 * REPEATS, found
    assert found["right"] + found["undecided"] >= 0.93 * 2 * REPEATS, found


def shrunk(problem, sets):
    mean = problem.reference(1, 2000).mean(axis=0)
    return [mean + (motions - mean) / 1.3 for motions in sets]


def shifted(problem, sets):
    """Shift by .3 sd along the leading principal direction."""
    reference = problem.reference(1, 4000)
    flat = reference.reshape(len(reference), -1)
    found = PCA(1, random_state=0).fit(flat)
    step = 0.3 * np.sqrt(found.explained_variance_[0]) * found.components_[0]
    return [motions + step.reshape(motions.shape[1:]) for motions in sets]


def off_manifold(problem, sets):
    rng = np.random.default_rng(5)
    noise = problem.posterior.prior.noise * np.sqrt(0.5)
    return [motions + rng.normal(0, noise, motions.shape) for motions in sets]


@pytest.mark.parametrize(
    ("fault", "word"),
    [(shrunk, "overconfident"), (shifted, "biased"), (off_manifold, "off the manifold")],
)
def test_a_fault_is_named(monocular, fault, word):
    found = words(monocular, fault(monocular, exact_sets(monocular)))
    assert found[word] >= 0.9 * REPEATS, found


def test_equal_draws_are_overconfident(monocular):
    motions = np.ones_like(exact_sets(monocular, repeats=1)[0])  # no variance, not even of rounding
    assert verdict_of(monocular, motions, independent=True).word in ("biased", "overconfident")


def test_a_missing_mode_is_named(gait):
    prior = gait.posterior.prior
    lost = []
    for motions in exact_sets(gait, repeats=5, n=600):
        style = prior.style_responsibilities(motions).argmax(axis=1)
        lost.append(motions[style != 0][:N])
    verdicts = [verdict_of(gait, motions) for motions in lost]
    assert all(verdict.word == "misses modes" for verdict in verdicts)
    assert str(prior.styles[0]) in verdicts[0].sentence


def test_few_draws_are_undecided_and_the_required_number_is_reported(monocular):
    verdict = verdict_of(monocular, monocular.reference(3, 20))
    assert verdict.word == "undecided"
    assert "at 20 draws" in verdict.sentence
    needed = max(q.draws for q in verdict.quantities if q.p_outside > 0.05)
    assert 50 < needed < 5000
    assert not verdict.is_right
    assert not verdict.is_wrong


def test_few_independent_draws_are_not_right(monocular):
    sets = [statistics_of(monocular, motions) for motions in exact_sets(monocular, 20, 40)]
    assert not any(judge([run]).is_right for run in sets)
    assert sum(judge(sets[i : i + 2]).is_wrong for i in range(0, 20, 2)) <= 1


def test_metrics_of_a_run_save_their_computation(gait):
    draws = pm.sample(gait, "exact", draws=200, progress=False)
    metrics = measure(gait, draws, 3)
    saved = draw_statistics(gait, draws, 3, metrics)
    assert saved.classifier[0] == metrics["c2st"]
    assert saved == draw_statistics(gait, draws, 3, {})
    # Of correlated draws, the classifier has fewer.
    correlated = {"rhat": 1.0, "ess_bulk": 120.0}
    thinned = draw_statistics(gait, draws, 3, metrics | correlated)
    assert thinned == draw_statistics(gait, draws, 3, correlated)


def test_seeds_are_pooled(monocular):
    sets = [statistics_of(monocular, motions) for motions in exact_sets(monocular, 4, 100)]
    pooled = judge([DrawStatistics(**run.to_json()) for run in sets])
    assert pooled.n == 400
    assert pooled.is_right
    assert not judge(sets[:1]).is_wrong
    assert judge(sets[:1] * 4).n == 100


@pytest.mark.parametrize("missing", ["classifier", "distance"])
def test_runs_with_too_few_or_too_many_effective_draws_are_pooled(monocular, missing):
    """Such a run has no classifier, or no reference sets of its size."""
    sets = [statistics_of(monocular, motions) for motions in exact_sets(monocular, 4, 100)]
    without = replace(sets[0], digest="other", **{missing: []})
    name = {"classifier": "classifier", "distance": "swd ratio"}[missing]

    def estimates(runs):
        verdict = judge(runs)
        return verdict.n, {q.name: q.estimate for q in verdict.quantities}[name]

    _, expected = estimates(sets[1:])
    assert estimates([without, *sets[1:]]) == (400, pytest.approx(expected))
    assert estimates([*sets[1:], without]) == (400, pytest.approx(expected))


def test_chains_that_disagree_are_not_mixed(gait):
    motions = gait.reference(4, 400)
    style = gait.posterior.prior.style_responsibilities(motions).argmax(axis=1)
    motions = motions[np.argsort(style, kind="stable")]
    verdict = verdict_of(gait, motions, chains=4, independent=False)
    assert verdict.word == "not mixed"
    assert "R-hat" in verdict.sentence


@pytest.mark.parametrize(
    ("name", "sampler", "settings", "fault"),
    [
        ("gait", "dvae", {"training_steps": 20, "training_pairs": 200}, "off the manifold"),
        ("monocular", "ancestral3d", {"steps": 20, **FIRST_ORDER}, "overconfident"),
    ],
)
def test_a_wrong_sampler_is_not_right(name, sampler, settings, fault, request):
    problem = request.getfixturevalue(name)
    draws = pm.sample(problem, sampler, draws=200, progress=False, **settings)
    verdict = pm.score(problem, draws).verdict
    assert verdict.is_wrong
    assert fault in verdict.sentence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sampler", "settings"),
    [("gait", "dvae", {}), ("gait-monocular", "ancestral3d", {"steps": 100, **FIRST_ORDER})],
)
def test_a_wrong_sampler_is_never_right(name, sampler, settings):
    problem = load_problem(name)
    for seed in range(3):
        draws = pm.sample(problem, sampler, draws=N, seed=seed, progress=False, **settings)
        assert pm.score(problem, draws, seed=seed).verdict.is_wrong
