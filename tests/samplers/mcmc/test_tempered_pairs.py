"""Tempering of pose pairs: density, measure, moves, truncation and resuming."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import replace
from threading import Event
from unittest.mock import Mock

import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy.special import log_softmax, logsumexp

from probmotion import MotionPosterior
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs import pair_walk_kernels
from probmotion.models.pose_pairs.annotation_moves import approach, scaled_depths, transfer
from probmotion.models.pose_pairs.pair_densities import (
    image_axes,
    log_annotations,
    log_prior,
    log_prior_terms,
    log_surrogate,
    log_views,
    project_to_view,
)
from probmotion.models.pose_pairs.pair_moves import APPROACH, HINGE, STRETCH, moves_of, propose
from probmotion.models.pose_pairs.pair_walk_kernels import walk
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.posteriors.sampling import Interrupted, suited
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem
from probmotion.samplers.mcmc import stored_chain, tempered_pairs
from probmotion.samplers.mcmc.stored_chain import StoredChain
from probmotion.samplers.mcmc.tempered_pairs import TemperedPairs

# One in 100 000 normal variables exceeds this z-score.
_MAX_Z = 4.4


@pytest.fixture(scope="module")
def dances():
    return synthetic_dances(4)


@pytest.fixture(scope="module")
def likelihood(dances):
    drawn = draw_annotations(dances[:3], 40, seed=0, known_views=True)
    return AnnotatedPairs(drawn.annotations, n_views=5, n_near=4, noise=0.15)


@pytest.fixture(scope="module")
def prior(dances):
    return PosePairPrior(dances[0].positions[30], dances[0].skeleton)


@pytest.fixture(scope="module")
def exact(prior):
    """Return independent draws of the base measure, without limits or penetration, (n, J, 3)."""
    rng, n = np.random.default_rng(1), 30_000
    seed, skeleton = prior.seed[0], prior.skeleton
    poses = np.empty((n, *seed.shape))
    for root in skeleton.roots:
        poses[:, root] = seed[root] + prior.root_noise * rng.standard_normal((n, 3))
    for joint, parent in skeleton.bones:
        direction = rng.standard_normal((n, 3))
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        length = np.linalg.norm(seed[joint] - seed[parent])
        length = length * np.exp(prior.bone_noise * rng.standard_normal((n, 1)))
        poses[:, joint] = poses[:, parent] + length * direction
    return poses


def pair_arrays(posterior):
    walks = posterior.prior.walks(posterior.likelihood)
    return walks.body, walks.physics, walks.views


def test_compiled_density_matches_the_posterior(prior, likelihood):
    posterior = MotionPosterior(prior, replace(likelihood, noise=0.01))
    body, physics, views = pair_arrays(posterior)
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.05, 0.6, (40, 1)) * rng.standard_normal((40, prior.dim))
    poses = np.ascontiguousarray(prior.motion(theta)[:, 0])
    parts, logs = np.zeros(6), []
    for pose in poses:
        log_prior_terms(pose, body, physics, parts)
        logs.append(log_prior(parts, physics) + logsumexp(log_views(pose, body, views)))
    stretches, translations = theta[:, 12:].reshape(40, -1, 3)[..., 2], theta[:, 6:12]
    normal = -0.5 * ((stretches / 0.05) ** 2).sum(axis=-1) - 0.5 * (translations**2).sum(axis=-1)
    expected = normal + prior.log_plausibility(poses[:, None])
    allowed = np.isfinite(expected)
    assert 5 < allowed.sum() < 40
    expected[allowed] += posterior.likelihood.log_density(poses[allowed][:, None])
    np.testing.assert_allclose(np.array(logs) - math.log(5), expected, rtol=1e-9)


@pytest.mark.parametrize("measure", ["interaction", "cartesian"])
def test_surrogate_matches_an_explicit_distance(prior, likelihood, measure):
    """The reference uses complex numbers; without a graph, the surrogate is exact."""
    likelihood = replace(likelihood, measure=measure)
    body, _, views = pair_arrays(MotionPosterior(prior, likelihood))
    prepared, view, rng = views.prepared, 3, np.random.default_rng(0)
    pose = prior.seed[0] + 0.1 * rng.standard_normal(prior.seed[0].shape)
    diffs, terms, logs = np.empty((2, len(pose))), np.empty(200), np.empty(views.near.shape[1])
    log_annotations(pose, view, body, views, logs)
    points = project_to_view(pose, view, body, views) @ [1, 1j]
    points -= points.mean()
    for annotation, exact in zip(views.near[view], logs, strict=True):
        target = prepared.joints[annotation].T @ [1, 1j]
        product = np.vdot(points, target)
        error = points * product / abs(product) - target
        surrogate = log_surrogate(pose, view, annotation, body, views, diffs, terms)
        if measure == "cartesian":
            distance = math.sqrt(np.mean(np.abs(error) ** 2))
            assert exact == pytest.approx(surrogate, rel=1e-9)
        else:
            edges = slice(*prepared.edge_start[annotation : annotation + 2])
            i, j = prepared.edges[:, edges]
            distance = 2 * np.sum(prepared.weights[edges] * np.abs(error[i] - error[j]))
        assert surrogate == pytest.approx(-0.5 * (distance / likelihood.noise) ** 2, rel=1e-9)


def test_moves_preserve_bone_lengths(prior, likelihood):
    """Only stretches change bone lengths; hinges also preserve the distance between joints."""
    body, _, _ = pair_arrays(MotionPosterior(prior, likelihood))
    pose, rng = prior.seed[0], np.random.default_rng(0)
    ends, starts = np.array(prior.skeleton.bones).T
    before = np.linalg.norm(pose[ends] - pose[starts], axis=1)
    proposed = np.empty_like(pose)
    for move in moves_of(body):
        kind, joint, other = move
        if kind == APPROACH:
            continue
        propose(pose, move, 0.5, body, rng, proposed)
        assert np.abs(proposed - pose).max() > 1e-6
        after = np.linalg.norm(proposed[ends] - proposed[starts], axis=1)
        rigid = (ends != joint) | (kind != STRETCH)
        np.testing.assert_allclose(after[rigid], before[rigid], rtol=1e-12)
        assert rigid.all() or after[~rigid] != pytest.approx(before[~rigid], rel=1e-9)
        if kind == HINGE:
            shift = proposed[[joint, other]] - pose[[joint, other]]
            np.testing.assert_allclose(shift[0], shift[1], atol=1e-12)


@pytest.mark.parametrize("person", [-1, 0, 1])
def test_an_approach_is_inverted_by_its_inverse(prior, likelihood, person):
    """Angles to the annotation's bones are scaled; the frame and bone lengths stay."""
    body, _, views = pair_arrays(MotionPosterior(prior, likelihood))
    rng, done = np.random.default_rng(0), 0
    root = -1 if person < 0 else int(body.roots[person])
    for number in range(60):
        view, annotation = number % 5, views.near[number % 5, number % 4]
        pose = prior.seed[0] + 0.02 * rng.standard_normal(prior.seed[0].shape)
        new, back = np.empty_like(pose), np.empty_like(pose)
        log_volume = approach(pose, root, 0.8, view, annotation, body, views, new)
        if log_volume == -np.inf:
            continue
        done += 1
        inverse = approach(new, root, 1 / 0.8, view, annotation, body, views, back)
        assert inverse == pytest.approx(-log_volume, rel=1e-6)
        np.testing.assert_allclose(back, pose, atol=1e-9)
        axes = image_axes(pose, view, body, views)
        np.testing.assert_allclose(image_axes(new, view, body, views), axes, atol=1e-12)
        ends, starts = np.array(prior.skeleton.bones).T
        before, after = pose[ends] - pose[starts], new[ends] - new[starts]
        np.testing.assert_allclose(*(np.linalg.norm(b, axis=1) for b in (before, after)))
        moved = np.abs(after - before).max(axis=1) > 1e-9
        own = np.ones(len(ends), bool) if person < 0 else body.person[ends] == person
        assert (moved == (own & ~body.framing[ends])).all()
    assert done > 20


def test_the_volume_of_an_approach_is_that_of_solid_angles(prior, likelihood):
    """The area of a small triangle of directions of each bone changes by a known factor."""
    body, _, views = pair_arrays(MotionPosterior(prior, likelihood))
    pose, view = prior.seed[0], 1
    annotation, new = views.near[view, 0], np.empty_like(pose)
    total = approach(pose, -1, 1.1, view, annotation, body, views, new)
    assert np.isfinite(total)
    factors, size = [], 1e-5
    for joint in np.flatnonzero(~body.framing):
        bone = pose[joint] - pose[body.parents[joint]]
        first = np.cross(bone, [0.3, 0.5, 0.8])
        first /= np.linalg.norm(first)
        second = np.cross(bone, first) / np.linalg.norm(bone)
        mapped = []
        for side in (np.zeros(3), first, second):
            turned = bone + size * np.linalg.norm(bone) * side
            turned *= np.linalg.norm(bone) / np.linalg.norm(turned)
            moved = pose + np.where(body.below[joint], 1, 0)[:, None] * (turned - bone)
            approach(moved, -1, 1.1, view, annotation, body, views, new)
            mapped.append((new[joint] - new[body.parents[joint]]) / np.linalg.norm(bone))
        area = np.linalg.norm(np.cross(mapped[1] - mapped[0], mapped[2] - mapped[0]))
        factors.append(math.log(area / size**2))
    assert total == pytest.approx(sum(factors), abs=1e-2)


def test_a_transfer_is_inverted_by_its_inverse(prior, likelihood):
    """Frame and bone lengths stay; the roots' distance and its volume are scaled."""
    body, _, views = pair_arrays(MotionPosterior(prior, likelihood))
    rng, (first, second) = np.random.default_rng(0), body.roots
    ends, starts = np.array(prior.skeleton.bones).T
    for view in range(5):
        start, end = views.near[view, :2]
        pose = prior.seed[0] + 0.02 * rng.standard_normal(prior.seed[0].shape)
        sides = rng.choice([-1.0, 1.0], size=len(pose))
        new, back = np.empty_like(pose), np.empty_like(pose)
        log_volume = transfer(pose, sides, view, start, end, body, views, new)
        inverse = transfer(new, sides, view, end, start, body, views, back)
        assert inverse == pytest.approx(-log_volume, rel=1e-9)
        np.testing.assert_allclose(back, pose, atol=1e-9)
        axes = image_axes(pose, view, body, views)
        np.testing.assert_allclose(image_axes(new, view, body, views), axes, atol=1e-9)
        before, after = pose[ends] - pose[starts], new[ends] - new[starts]
        np.testing.assert_allclose(*(np.linalg.norm(b, axis=1) for b in (before, after)))
        apart = [np.linalg.norm(p[second] - p[first]) for p in (pose, new)]
        assert log_volume == pytest.approx(3 * math.log(apart[1] / apart[0]))
        seen = [views.prepared.joints[k][:, [first, second]] for k in (start, end)]
        widths = [np.linalg.norm(joints[:, 1] - joints[:, 0]) for joints in seen]
        assert apart[1] / apart[0] == pytest.approx(widths[1] / widths[0])


def test_a_transfer_needs_roots_apart(prior, likelihood):
    """If roots of an annotation coincide, no distance can be scaled, and the walk goes on."""
    body, physics, views = pair_arrays(MotionPosterior(prior, likelihood))
    pose, new, parts = prior.seed[0].copy(), np.empty_like(prior.seed[0]), np.zeros(6)
    joints = views.prepared.joints.copy()
    start, end = views.near[0, :2]
    joints[end, :, body.roots[1]] = joints[end, :, body.roots[0]]
    together = views._replace(prepared=views.prepared._replace(joints=joints))
    for pair in ((start, end), (end, start)):
        assert transfer(pose, np.ones(len(pose)), 0, *pair, body, together, new) == -np.inf
    moves, rng = moves_of(body), np.random.default_rng(0)
    log_prior_terms(pose, body, physics, parts)
    counters = (moves, np.full(len(moves), 0.1), np.zeros(len(moves)), np.zeros(len(moves)))
    walk(pose, parts, 0, 0.1, 2000, *counters, body, physics, together, rng)
    assert np.isfinite(pose).all()


def test_a_transfer_leads_from_one_annotation_to_the_other(prior, likelihood):
    """A pose whose bones lie on the first annotation's comes to lie on the second's."""
    body, _, views = pair_arrays(MotionPosterior(prior, likelihood))
    rng, done = np.random.default_rng(0), 0
    for number in range(30):
        view, start, end = number % 5, *views.near[number % 5, :2]
        pose = prior.seed[0] + 0.02 * rng.standard_normal(prior.seed[0].shape)
        near, new, nearer = (np.empty_like(pose) for _ in range(3))
        if approach(pose, -1, 1e-4, view, start, body, views, near) == -np.inf:
            continue
        towards = image_axes(pose, view, body, views)[2]
        sides = np.sign((near - near[body.parents]) @ np.array(towards))
        assert (sides * scaled_depths(near, view, body, views) >= 0).all()
        transfer(near, sides, view, start, end, body, views, new)
        if approach(new, -1, 0.5, view, end, body, views, nearer) == -np.inf:
            continue
        done += 1
        np.testing.assert_allclose(nearer, new, atol=1e-3)
        assert np.abs(new - near).max() > 0.05
    assert done > 5


def test_ratio_of_annotations_has_their_probabilities():
    """The ratio is that of L_v^power, the largest of the likelihoods, times P(annotation)."""
    old, new = np.random.default_rng(0).normal(-5.0, 3.0, (2, 6))

    def log_joint(logs: np.ndarray, chosen: int) -> float:
        return 0.7 * logs.max() + log_softmax(0.7 * logs)[chosen]

    expected = log_joint(new, 4) - log_joint(old, 1)
    assert pair_walk_kernels._log_ratio(old, new, 1, 4, 0.7) == pytest.approx(expected)


def test_walk_updates_its_terms_correctly(prior, likelihood):
    """Incrementally updated terms equal recomputed ones."""
    body, physics, views = pair_arrays(MotionPosterior(prior, likelihood))
    rng = np.random.default_rng(0)
    pose, parts, moves = prior.seed[0].copy(), np.zeros(6), moves_of(body)
    log_prior_terms(pose, body, physics, parts)
    sizes, trials, accepted = np.full(len(moves), 0.1), np.zeros(len(moves)), np.zeros(len(moves))
    counters = (moves, sizes, trials, accepted)
    view, log_l = walk(pose, parts, 2, 1.0, 4000, *counters, body, physics, views, rng)
    assert log_l == pytest.approx(log_views(pose, body, views)[view], rel=1e-9)
    expected = np.zeros(6)
    log_prior_terms(pose, body, physics, expected)
    np.testing.assert_allclose(parts, expected, rtol=1e-9, atol=1e-9)
    assert (accepted[trials > 0] > 0).mean() > 0.9
    assert expected[4:].sum() <= prior.max_invalid


@pytest.mark.slow
def test_walk_samples_the_tempered_density(prior, likelihood, exact):
    """Compare with importance-weighted draws of the base measure in every view.

    Many annotations per view test that only the nearest one counts.
    """
    weak_prior, power = replace(prior, position_noise=0.7, max_invalid=24), 0.6
    posterior = MotionPosterior(weak_prior, replace(likelihood, n_near=30, noise=0.3))
    body, physics, views = pair_arrays(posterior)

    def summary(poses: np.ndarray):
        """Return log L_v, the number of equally near annotations and log L_v − mean, (n, V, 3)."""
        logs = np.empty((len(poses), *views.near.shape))
        for pose, of_pose in zip(poses, logs, strict=True):
            for view, of_view in enumerate(of_pose):
                log_annotations(pose, view, body, views, of_view)
        best = logs.max(axis=-1)
        n_near = logsumexp(power * logs, axis=-1) - power * best
        return np.stack([best, n_near, best - best.mean(axis=1, keepdims=True)], axis=-1)

    expected = summary(exact)
    log_weight = weak_prior.log_plausibility(exact[:, None])[:, None] + power * expected[..., 0]
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = np.einsum("nv,nvk->k", weight, expected)
    error = np.sqrt((np.einsum("nv,nvk->nk", weight, expected - mean) ** 2).sum(axis=0))

    moves, summaries = moves_of(body), []
    counters = (moves, np.full(len(moves), 0.7), np.zeros(len(moves)), np.zeros(len(moves)))
    for chain in range(2):
        rng, pose, parts, view = np.random.default_rng(chain), prior.seed[0].copy(), np.zeros(6), 0
        log_prior_terms(pose, body, physics, parts)
        states = []
        for _ in range(1100):
            view, _ = walk(pose, parts, view, power, 400, *counters, body, physics, views, rng)
            states.append((pose.copy(), view))
        poses, chosen = zip(*states[100:], strict=True)
        summaries.append(summary(np.array(poses))[np.arange(len(chosen)), list(chosen)])
    assert np.abs(_z_scores(np.array(summaries), mean, error)).max() < _MAX_Z


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.15, 0.3])
def test_transfers_preserve_the_tempered_density(prior, likelihood, exact, noise):
    """Expectations of weighted draws do not change, although many of the draws do.

    With less noise, annotations differ more in probability; with more, more draws count.
    """
    weak_prior, power = replace(prior, position_noise=0.7, max_invalid=24), 0.6
    posterior = MotionPosterior(weak_prior, replace(likelihood, n_near=8, noise=noise))
    body, physics, views = pair_arrays(posterior)
    rng, (n_views, n_near), n = np.random.default_rng(0), views.near.shape, len(exact)
    log_weight = weak_prior.log_plausibility(exact[:, None])
    summaries, poses = np.empty((2, n, 4)), exact.copy()
    parts, logs = np.empty(6), np.empty(n_near)
    workspace = (np.empty_like(poses[0]), np.empty(6), np.empty(n_near))

    def summary(pose: np.ndarray, view: int, logs: np.ndarray) -> list[float]:
        """Return log L_v, distance of roots, bones near the image plane and annotations in use."""
        bones = (pose - pose[body.parents])[body.parents >= 0]
        sines = bones @ image_axes(pose, view, body, views)[2] / np.linalg.norm(bones, axis=1)
        apart = np.linalg.norm(np.subtract(*pose[body.roots]))
        in_use = logsumexp(power * (logs - logs.max()))
        return [logs.max(), apart, np.exp(-((sines / 0.2) ** 2)).mean(), in_use]

    for k, pose in enumerate(poses):
        view = int(rng.integers(n_views))
        log_prior_terms(pose, body, physics, parts)
        log_annotations(pose, view, body, views, logs)
        log_weight[k] += power * logs.max()
        summaries[0, k] = summary(pose, view, logs)
        for _ in range(20):
            pair_walk_kernels._propose_transfer(
                pose, parts, logs, view, power, body, physics, views, *workspace, rng
            )
        summaries[1, k] = summary(pose, view, logs)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    moved = (poses != exact).any(axis=(1, 2))
    assert weight[moved].sum() ** 2 / (weight[moved] ** 2).sum() > 300
    change = summaries[1] - summaries[0]
    z = weight @ change / np.sqrt(weight**2 @ change**2)
    assert np.abs(z).max() < _MAX_Z


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
    assert np.abs(_z_scores(drawn, mean, error)).max() < _MAX_Z
    if math.isfinite(limit):
        assert log_f.max() > posterior.log_cap
        assert (drawn[..., :2].sum(axis=-1) >= posterior.log_floor - 1e-6).all()


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


def test_chains_start_at_successive_seeds(prior, likelihood, dances):
    """The base measure is relative to the first seed."""
    two_seeds = np.stack([prior.seed[0], dances[1].positions[40]])
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


def _z_scores(values, mean, error):
    """Return deviations of the chains' means (chain, draw, k) in standard errors."""
    ess = np.asarray(array_stats.ess(values, method="mean", chain_axis=0, draw_axis=1))
    variance = values.var(axis=(0, 1), ddof=1) / ess
    return (values.mean(axis=(0, 1)) - mean) / np.sqrt(variance + error**2)
