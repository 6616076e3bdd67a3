"""Reference draws of pose-pairs: the density, the measure, the evidence and the cut, each known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from arviz_stats.base import array_stats

from probmotion import MotionPosterior
from probmotion.data.dances import make_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotation_sources import draw_annotations
from probmotion.models.pose_pairs import PosePairPrior
from probmotion.problems import load_problem
from probmotion.problems.pair_walk_kernels import choose_view, log_prior, moves_of, walk, weigh
from probmotion.problems.tempered_pairs import TemperedPairs, pair_arrays
from probmotion.truncation import TruncatedPosterior

# A false alarm in 100 000 numbers.
_APART = 4.4


@pytest.fixture(scope="module")
def dances():
    return make_dances(4)


@pytest.fixture(scope="module")
def evidence(dances) -> AnnotatedPairs:
    drawn = draw_annotations(dances[:3], 40, seed=0, known_views=True)
    return AnnotatedPairs(drawn.annotations, n_views=5, n_near=4, noise=0.1)


@pytest.fixture(scope="module")
def prior(dances) -> PosePairPrior:
    return PosePairPrior(dances[0].positions[30], dances[0].skeleton)


@pytest.fixture(scope="module")
def loose(prior) -> PosePairPrior:
    """The measure alone: nobody has limits, or a body that one could walk into."""
    return replace(prior, position_noise=1e6, max_invalid=32)


@pytest.fixture(scope="module")
def exact(loose) -> np.ndarray:
    """Independent draws of the measure, (n, J, 3)."""
    rng, n = np.random.default_rng(1), 30_000
    seed, skeleton = loose.seed[0], loose.skeleton
    poses = np.empty((n, *seed.shape))
    for root in skeleton.roots:
        poses[:, root] = seed[root] + loose.root_noise * rng.standard_normal((n, 3))
    for joint, parent in skeleton.bones:
        way = rng.standard_normal((n, 3))
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        length = np.linalg.norm(seed[joint] - seed[parent])
        stretch = np.exp(loose.bone_noise * rng.standard_normal((n, 1)))
        poses[:, joint] = poses[:, parent] + length * stretch * way
    return poses


def test_what_compiled_code_weighs_is_the_posterior(prior, evidence):
    posterior = MotionPosterior(prior, replace(evidence, noise=0.01))
    body, physics, sight = pair_arrays(posterior)
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.05, 0.6, (40, 1)) * rng.standard_normal((40, prior.dim))
    poses = np.ascontiguousarray(prior.motion(theta)[:, 0])
    parts, found = np.zeros(6), []
    for pose in poses:
        weigh(pose, body, physics, parts)
        found.append(log_prior(parts, physics) + choose_view(pose, 1.0, body, sight, rng)[2])
    stretches, places = theta[:, 12:].reshape(40, -1, 3)[..., 2], theta[:, 6:12]
    normal = -0.5 * ((stretches / 0.05) ** 2).sum(axis=-1) - 0.5 * (places**2).sum(axis=-1)
    expected = normal + prior.log_plausibility(poses[:, None])
    allowed = np.isfinite(expected)
    assert 5 < allowed.sum() < 40
    expected[allowed] += posterior.likelihood.log_density(poses[allowed][:, None])
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_walk_keeps_its_books(prior, evidence):
    """What a step leaves out, because its move does not change it, is what weighing anew finds."""
    body, physics, sight = pair_arrays(MotionPosterior(prior, evidence))
    rng = np.random.default_rng(0)
    pose, parts, moves = prior.seed[0].copy(), np.zeros(6), moves_of(body)
    weigh(pose, body, physics, parts)
    sizes, tried, taken = np.full(len(moves), 0.1), np.zeros(len(moves)), np.zeros(len(moves))
    view, seen, _ = choose_view(pose, 1.0, body, sight, rng)
    walk(
        pose, parts, seen, view, 1.0, 4000, moves, sizes, tried, taken, body, physics, sight, rng
    )  # fmt: skip
    again = np.zeros(6)
    weigh(pose, body, physics, again)
    np.testing.assert_allclose(parts, again, rtol=1e-9, atol=1e-9)
    assert (taken[tried > 0] > 0).mean() > 0.9
    assert again[4:].sum() <= prior.max_invalid


def test_without_limits_and_evidence_the_measure_is_drawn(loose, evidence):
    """Directions are uniform whatever others are, log lengths and places normal."""
    posterior = MotionPosterior(loose, replace(evidence, noise=1e6))
    sampler = TemperedPairs(levels=3, steps=120, warmup=60, thin=2)
    run = sampler.sample(posterior, draws=300, chains=2, progress=False)
    poses = run.dataset["positions"].values[:, :, 0]
    ends, starts = np.array(loose.skeleton.bones).T
    bones = poses[:, :, ends] - poses[:, :, starts]
    lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
    ways, first = (
        bones / lengths,
        np.linalg.norm(loose.seed[0][ends] - loose.seed[0][starts], axis=1),
    )
    stretches = np.log(lengths[..., 0] / first) / loose.bone_noise
    places = poses[:, :, list(loose.skeleton.roots)] - loose.seed[0][list(loose.skeleton.roots)]
    below = [(k, m) for k, joint in enumerate(ends) for m, end in enumerate(starts) if end == joint]
    bends = np.stack([(ways[:, :, k] * ways[:, :, m]).sum(axis=-1) for k, m in below], axis=-1)
    for known, values, mean in (
        ("directions", ways, 0.0),
        ("their squares", ways**2, 1 / 3),
        ("bends", bends, 0.0),
        ("squared bends", bends**2, 1 / 3),
        ("lengths", stretches, 0.0),
        ("squared lengths", stretches**2, 1.0),
        ("places", places, 0.0),
        ("squared places", places**2, 1.0),
    ):
        assert np.abs(_errors_apart(values, mean)).max() < _APART, known


@pytest.mark.parametrize("limit", [2.0, pytest.param(math.inf, marks=pytest.mark.slow)])
def test_evidence_and_cut_are_those_of_weighted_exact_draws(loose, evidence, exact, limit):
    """Means under the posterior, of the measure's own draws weighted by what is known of it."""
    whole = MotionPosterior(loose, evidence)
    logs, _ = evidence.evaluate(exact[:, None])
    # The seed of the cut is a pose that is neither likely nor not, so that both ends cut.
    middling = exact[np.argsort(logs)[int(0.98 * len(logs))]]
    posterior = TruncatedPosterior(loose, evidence, seed=loose.coordinates(middling), limit=limit)
    log_share = np.where(logs < posterior.log_floor, -np.inf, np.minimum(logs, posterior.log_cap))
    weights = np.exp(log_share - log_share.max())
    sampler = TemperedPairs(levels=5, steps=100, warmup=100, thin=1)
    run = sampler.sample(posterior, draws=600, chains=2, progress=False)
    poses = run.dataset["positions"].values[:, :, 0]
    found = _told(poses.reshape(-1, *poses.shape[2:]), whole)
    found = found.reshape(*poses.shape[:2], -1)
    known = _told(exact, whole)
    mean = np.average(known, axis=0, weights=weights)
    spread = weights[:, None] * (known - mean)
    error = np.sqrt((spread**2).sum(axis=0)) / weights.sum()
    assert np.abs(_errors_apart(found, mean, error)).max() < _APART
    if math.isfinite(limit):
        assert logs.max() > posterior.log_cap
        assert (found[..., 0] >= posterior.log_floor - 1e-9).all()


def test_chains_are_the_same_whatever_their_number(prior, evidence):
    posterior = MotionPosterior(prior, evidence)
    sampler = TemperedPairs(levels=3, steps=5, warmup=20, thin=1)
    both = sampler.sample(posterior, draws=4, chains=2, seed=3, progress=False)
    alone = sampler.sample(posterior, draws=4, chains=1, seed=3, progress=False)
    assert np.array_equal(both.dataset["positions"][0], alone.dataset["positions"][0])
    assert not np.array_equal(both.dataset["positions"][0], both.dataset["positions"][1])


def test_what_it_cannot_draw_from_is_said(prior, evidence):
    sampler = TemperedPairs()
    with pytest.raises(ValueError, match="posterior has Keypoints2D evidence"):
        sampler.sample(load_problem("gait-monocular").posterior, progress=False)
    with pytest.raises(ValueError, match="posterior has NoneType evidence"):
        sampler.sample(MotionPosterior(prior), progress=False)
    hidden = evidence.annotations.visible.copy()
    hidden[0, 3] = False
    partly = AnnotatedPairs(replace(evidence.annotations, visible=hidden), n_views=2)
    with pytest.raises(ValueError, match="all of whose joints are visible"):
        sampler.sample(MotionPosterior(prior, partly), progress=False)
    with pytest.raises(ValueError, match="initial is ndarray, expected None"):
        sampler.sample(MotionPosterior(prior, evidence), initial=np.zeros((1, 108)), progress=False)
    with pytest.raises(ValueError, match="levels is 2, expected"):
        TemperedPairs(levels=2)


def _told(poses: np.ndarray, posterior: MotionPosterior) -> np.ndarray:
    """Return what evidence changes: log L, how likely each view is, and how people stand."""
    evidence = posterior.likelihood
    logs, _ = evidence.evaluate(poses[:, None])
    roots, skeleton = list(evidence.skeleton.roots), evidence.skeleton
    apart = np.linalg.norm(poses[:, roots[0]] - poses[:, roots[1]], axis=-1)
    chests = [skeleton.joint_names.index(name) for name in skeleton.joint_names if "chest" in name]
    trunks = poses[:, chests] - poses[:, roots]
    alike = (trunks[:, 0] * trunks[:, 1]).sum(axis=-1)
    return np.stack([logs, apart, alike], axis=-1)


def _errors_apart(values: np.ndarray, mean: float | np.ndarray, error: float = 0.0) -> np.ndarray:
    """Return how far means of chains are from what is known, in standard errors."""
    flat = values.reshape(*values.shape[:2], -1)
    effective = np.asarray(array_stats.ess(flat, method="mean", chain_axis=0, draw_axis=1))
    own = flat.var(axis=(0, 1), ddof=1) / effective
    return (flat.mean(axis=(0, 1)) - np.ravel(mean)) / np.sqrt(own + np.ravel(error) ** 2)
