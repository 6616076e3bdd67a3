"""Reference draws of pose-pairs: the density, the measure, the evidence and the cut, each known."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import replace
from threading import Event

import numpy as np
import pytest
from arviz_stats.base import array_stats
from scipy.special import logsumexp

from probmotion import MotionPosterior
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotated_pairs import AnnotatedPairs
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.problems import load_problem
from probmotion.problems.references import chains as kept_chains, tempered_pairs
from probmotion.problems.references.chains import StoredChain
from probmotion.problems.references.pair_densities import (
    log_annotations,
    log_prior,
    log_sketch,
    log_views,
    picture_of,
    weigh,
)
from probmotion.problems.references.pair_moves import HINGE, STRETCH, moves_of, propose
from probmotion.problems.references.pair_walk_kernels import walk
from probmotion.problems.references.tempered_pairs import TemperedPairs, pair_arrays

# A false alarm in 100 000 numbers.
_APART = 4.4


@pytest.fixture(scope="module")
def dances():
    return synthetic_dances(4)


@pytest.fixture(scope="module")
def evidence(dances) -> AnnotatedPairs:
    drawn = draw_annotations(dances[:3], 40, seed=0, known_views=True)
    return AnnotatedPairs(drawn.annotations, n_views=5, n_near=4, noise=0.15)


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
        found.append(log_prior(parts, physics) + logsumexp(log_views(pose, body, sight)))
    stretches, places = theta[:, 12:].reshape(40, -1, 3)[..., 2], theta[:, 6:12]
    normal = -0.5 * ((stretches / 0.05) ** 2).sum(axis=-1) - 0.5 * (places**2).sum(axis=-1)
    expected = normal + prior.log_plausibility(poses[:, None])
    allowed = np.isfinite(expected)
    assert 5 < allowed.sum() < 40
    expected[allowed] += posterior.likelihood.log_density(poses[allowed][:, None])
    np.testing.assert_allclose(np.array(found) - math.log(5), expected, rtol=1e-9)


@pytest.mark.parametrize("measure", ["interaction", "cartesian"])
def test_a_sketch_is_of_one_annotation_and_its_own_graph(prior, evidence, measure):
    """Joints in the complex plane: where there is no graph, the sketch is the distance itself."""
    evidence = replace(evidence, measure=measure)
    body, _, sight = pair_arrays(MotionPosterior(prior, evidence))
    held, view, rng = sight.prepared, 3, np.random.default_rng(0)
    pose = prior.seed[0] + 0.1 * rng.standard_normal(prior.seed[0].shape)
    apart, terms, logs = np.empty((2, len(pose))), np.empty(200), np.empty(sight.near.shape[1])
    log_annotations(pose, view, body, sight, logs)
    picture = picture_of(pose, view, body, sight) @ [1, 1j]
    picture -= picture.mean()
    for annotation, exact in zip(sight.near[view], logs, strict=True):
        target = held.joints[annotation].T @ [1, 1j]
        turn = np.vdot(picture, target)
        error = picture * turn / abs(turn) - target
        if measure == "cartesian":
            known = math.sqrt(np.mean(np.abs(error) ** 2))
            assert exact == pytest.approx(-0.5 * (known / evidence.noise) ** 2, rel=1e-9)
        else:
            edges = slice(*held.edge_start[annotation : annotation + 2])
            i, j = held.edges[:, edges]
            known = 2 * np.sum(held.weights[edges] * np.abs(error[i] - error[j]))
        found = log_sketch(pose, view, annotation, body, sight, apart, terms)
        assert found == pytest.approx(-0.5 * (known / evidence.noise) ** 2, rel=1e-9)


def test_moves_keep_the_lengths_of_bones(prior, evidence):
    """But for the one that a stretch is of; a hinge keeps how far apart its two joints are."""
    body, _, _ = pair_arrays(MotionPosterior(prior, evidence))
    pose, rng = prior.seed[0], np.random.default_rng(0)
    ends, starts = np.array(prior.skeleton.bones).T
    before = np.linalg.norm(pose[ends] - pose[starts], axis=1)
    proposed = np.empty_like(pose)
    for move in moves_of(body):
        kind, joint, other = move
        propose(pose, move, 0.5, body, rng, proposed)
        assert np.abs(proposed - pose).max() > 1e-6
        after = np.linalg.norm(proposed[ends] - proposed[starts], axis=1)
        kept = (ends != joint) | (kind != STRETCH)
        np.testing.assert_allclose(after[kept], before[kept], rtol=1e-12)
        assert kept.all() or after[~kept] != pytest.approx(before[~kept], rel=1e-9)
        if kind == HINGE:
            shift = proposed[[joint, other]] - pose[[joint, other]]
            np.testing.assert_allclose(shift[0], shift[1], atol=1e-12)


def test_a_walk_keeps_its_books(prior, evidence):
    """What a step leaves out, because its move does not change it, is what weighing anew finds."""
    body, physics, sight = pair_arrays(MotionPosterior(prior, evidence))
    rng = np.random.default_rng(0)
    pose, parts, moves = prior.seed[0].copy(), np.zeros(6), moves_of(body)
    weigh(pose, body, physics, parts)
    sizes, tried, taken = np.full(len(moves), 0.1), np.zeros(len(moves)), np.zeros(len(moves))
    view, log_l = walk(
        pose, parts, 2, 1.0, 4000, moves, sizes, tried, taken, body, physics, sight, rng
    )
    again = np.zeros(6)
    assert log_l == pytest.approx(log_views(pose, body, sight)[view], rel=1e-9)
    weigh(pose, body, physics, again)
    np.testing.assert_allclose(parts, again, rtol=1e-9, atol=1e-9)
    assert (taken[tried > 0] > 0).mean() > 0.9
    assert again[4:].sum() <= prior.max_invalid


@pytest.mark.slow
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
    beside = [(k, m) for m in range(len(starts)) for k in range(m) if starts[k] == starts[m]]
    bends, spreads = (
        np.stack([(ways[:, :, k] * ways[:, :, m]).sum(axis=-1) for k, m in pairs], axis=-1)
        for pairs in (below, beside)
    )
    for known, values, mean in (
        ("directions", ways, 0.0),
        ("their squares", ways**2, 1 / 3),
        ("bends", bends, 0.0),
        ("squared bends", bends**2, 1 / 3),
        ("spreads", spreads, 0.0),
        ("squared spreads", spreads**2, 1 / 3),
        ("lengths", stretches, 0.0),
        ("squared lengths", stretches**2, 1.0),
        ("places", places, 0.0),
        ("squared places", places**2, 1.0),
    ):
        assert np.abs(_errors_apart(values, mean)).max() < _APART, known


@pytest.mark.slow
def test_a_walk_draws_pose_and_view_at_its_power(prior, evidence, exact):
    """Weights of exact draws, each in every view, say what prior · L_v^power holds.

    Many annotations are near, for that the nearest alone counts is what lots must not forget.
    """
    gentle, power = replace(prior, position_noise=0.7, max_invalid=24), 0.6
    posterior = MotionPosterior(gentle, replace(evidence, n_near=30, noise=0.3))
    body, physics, sight = pair_arrays(posterior)

    def told(poses: np.ndarray) -> np.ndarray:
        """Log L_v, how many annotations are as near, log L_v less the mean view's: (n, V, 3)."""
        logs = np.empty((len(poses), *sight.near.shape))
        for pose, of_pose in zip(poses, logs, strict=True):
            for view, of_view in enumerate(of_pose):
                log_annotations(pose, view, body, sight, of_view)
        best = logs.max(axis=-1)
        as_near = logsumexp(power * logs, axis=-1) - power * best
        return np.stack([best, as_near, best - best.mean(axis=1, keepdims=True)], axis=-1)

    known = told(exact)
    log_weight = gentle.log_plausibility(exact[:, None])[:, None] + power * known[..., 0]
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    mean = np.einsum("nv,nvk->k", weight, known)
    error = np.sqrt((np.einsum("nv,nvk->nk", weight, known - mean) ** 2).sum(axis=0))

    moves, found = moves_of(body), []
    sizes, tried, taken = np.full(len(moves), 0.7), np.zeros(len(moves)), np.zeros(len(moves))
    for chain in range(2):
        rng, pose, parts, view = np.random.default_rng(chain), prior.seed[0].copy(), np.zeros(6), 0
        weigh(pose, body, physics, parts)
        walked = []
        for _ in range(1100):
            view, _ = walk(
                pose, parts, view, power, 400, moves, sizes, tried, taken, body, physics, sight, rng
            )
            walked.append((pose.copy(), view))
        poses, views = zip(*walked[100:], strict=True)
        found.append(told(np.array(poses))[np.arange(len(views)), list(views)])
    assert np.abs(_errors_apart(np.array(found), mean, error)).max() < _APART


@pytest.mark.slow
@pytest.mark.parametrize("limit", [2.0, math.inf])
def test_all_that_counts_is_that_of_weighted_exact_draws(prior, evidence, exact, limit):
    """Means under the posterior, of the measure's own draws weighted by what is known of it.

    Limits and bodies push gently here, so that exact draws reach where the posterior is.
    """
    gentle = replace(prior, position_noise=0.7, max_invalid=24)
    log_f = gentle.log_plausibility(exact[:, None]) + evidence.log_density(exact[:, None])
    # The seed of the cut is a pose that is neither likely nor not, so that both ends cut.
    middling = exact[np.argsort(log_f)[int(0.97 * len(exact))]]
    posterior = TruncatedPosterior(gentle, evidence, seed=gentle.coordinates(middling), limit=limit)
    log_share = np.where(log_f < posterior.log_floor, -np.inf, np.minimum(log_f, posterior.log_cap))
    weights = np.exp(log_share - log_share.max())
    allowed, weights = exact[weights > 0], weights[weights > 0]
    assert weights.sum() ** 2 / (weights**2).sum() > 400
    sampler = TemperedPairs(levels=5, steps=100, warmup=100, thin=1)
    run = sampler.sample(posterior, draws=600, chains=2, progress=False)
    poses = run.dataset["positions"].values[:, :, 0]
    found = _told(poses.reshape(-1, *poses.shape[2:]), posterior)
    found = found.reshape(*poses.shape[:2], -1)
    known = _told(allowed, posterior)
    mean = np.average(known, axis=0, weights=weights)
    spread = weights[:, None] * (known - mean)
    error = np.sqrt((spread**2).sum(axis=0)) / weights.sum()
    assert np.abs(_errors_apart(found, mean, error)).max() < _APART
    if math.isfinite(limit):
        assert log_f.max() > posterior.log_cap
        assert (found[..., :2].sum(axis=-1) >= posterior.log_floor - 1e-6).all()


def test_a_chain_that_fails_stops_all(prior, evidence, monkeypatch):
    """The others would go on for hours; what is said is what went wrong."""
    posterior = MotionPosterior(prior, evidence)
    warm_up = tempered_pairs._Ladder._warm_up

    def failing(ladder, stop):
        warm_up(ladder, stop)
        if ladder is not first[0]:
            raise MemoryError("no room")

    first: list = []
    make = tempered_pairs._Ladder.__init__

    def noted(ladder, *given):
        make(ladder, *given)
        first.append(ladder)

    monkeypatch.setattr(tempered_pairs._Ladder, "__init__", noted)
    monkeypatch.setattr(tempered_pairs._Ladder, "_warm_up", failing)
    sampler = TemperedPairs(levels=3, steps=5, warmup=16, thin=1)
    with pytest.raises(MemoryError, match="no room"):
        sampler.sample(posterior, draws=10**6, chains=2, progress=False)


@pytest.mark.parametrize("cut", [False, True])
def test_a_run_that_was_stopped_goes_on_with_the_same_bits(
    prior, evidence, cut, monkeypatch, tmp_path
):
    posterior = MotionPosterior(prior, evidence)
    if cut:
        posterior = TruncatedPosterior(prior, evidence, limit=1e3)
    sampler = TemperedPairs(levels=3, steps=30, warmup=20, thin=3)
    asked = {"draws": 12, "chains": 2, "seed": 4, "progress": False}
    whole = sampler.sample(posterior, **asked)
    monkeypatch.setattr(kept_chains, "_SECONDS", 0.0)
    save = StoredChain.save

    def stopping(kept, held):
        save(kept, held)
        if len(held()["draws"]) == 7:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(StoredChain, "save", stopping)
        with pytest.raises(KeyboardInterrupt):
            sampler.sample(posterior, **asked, unfinished=tmp_path / "run")
    kept = sorted(tmp_path.iterdir())
    assert "run-0.npz" in [path.name for path in kept]
    walked = []
    exchange = tempered_pairs._Ladder._exchange_after_walking

    def counted(ladder, stop):
        walked.append(ladder)
        exchange(ladder, stop)

    monkeypatch.setattr(tempered_pairs._Ladder, "_exchange_after_walking", counted)
    again = sampler.sample(posterior, **asked, unfinished=tmp_path / "run")
    assert len(walked) < 2 * (20 + 3 * 12) - 20
    assert np.array_equal(again.dataset["positions"], whole.dataset["positions"])
    for name in ("round_trips", "rejected_exchanges"):
        assert np.array_equal(again.dataset[name], whole.dataset[name])
    kept[0].write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"run-0.npz holds no chain \(.*, expected one that was"):
        sampler.sample(posterior, **asked, unfinished=tmp_path / "run")


def test_ctrl_c_stops_every_chain(prior, evidence):
    sampler = TemperedPairs(levels=3, steps=5, warmup=16, thin=1)
    main, before = threading.main_thread().ident, signal.getsignal(signal.SIGINT)
    pressed = threading.Timer(0.5, signal.pthread_kill, (main, signal.SIGINT))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        pressed.start()
        with pytest.raises(KeyboardInterrupt):
            sampler.sample(MotionPosterior(prior, evidence), draws=10**6, chains=3, progress=False)
    finally:
        pressed.join()
        signal.signal(signal.SIGINT, before)
    assert not [thread for thread in threading.enumerate() if "Executor" in thread.name]


def test_chains_start_at_the_seeds_in_turn(prior, evidence, dances):
    """The measure is that of the first seed, wherever a chain begins."""
    both = np.stack([prior.seed[0], dances[1].positions[40]])
    posterior = MotionPosterior(replace(prior, seed=both), evidence)
    arrays, rng = pair_arrays(posterior), np.random.default_rng(0)
    for chain, seed in enumerate((0, 1, 0)):
        ladder = tempered_pairs._Ladder(TemperedPairs(), posterior, arrays, rng, chain)
        assert (ladder.poses == both[seed]).all()
        theta = posterior.prior.seed_coordinates()[seed]
        stretches, places = theta[12:].reshape(-1, 3)[:, 2], theta[6:12]
        normal = -0.5 * ((stretches / prior.bone_noise) ** 2).sum() - 0.5 * (places**2).sum()
        np.testing.assert_allclose(ladder.parts[:, 0], normal, rtol=1e-9, atol=1e-9)


def test_a_cut_above_all_that_was_met_is_said(prior, evidence):
    posterior = TruncatedPosterior(prior, evidence, limit=2.0)
    object.__setattr__(posterior, "log_seed", 5.0)
    sampler = TemperedPairs(levels=3, steps=5, warmup=16, thin=1)
    with pytest.raises(ValueError, match="nothing above that was met in the warm-up"):
        sampler.sample(posterior, draws=2, progress=False)


@pytest.mark.slow
def test_powers_reject_alike_and_states_go_up_and_down(prior, evidence):
    posterior = MotionPosterior(prior, replace(evidence, noise=0.05))
    sampler = TemperedPairs(levels=10, steps=40, warmup=500, thin=1)
    arrays = pair_arrays(posterior)
    ladder = tempered_pairs._Ladder(sampler, posterior, arrays, np.random.default_rng(0), 0)
    ladder._warm_up(Event())
    assert (ladder.powers[0], ladder.powers[-1]) == (0.0, 1.0)
    for _ in range(600):
        ladder._exchange_after_walking(Event())
    rejected = ladder.rejected / ladder.asked
    assert rejected.max() - rejected.min() < 0.25
    assert ladder.barrier == pytest.approx(rejected.sum())
    # At most one in 2 + 2 Σ r/(1 − r) exchanges (Syed et al. 2022), where levels forget at once.
    most = 600 / (2 + 2 * (rejected / (1 - rejected)).sum())
    assert 0.1 * most < ladder.round_trips < 1.5 * most


def test_chains_are_the_same_whatever_their_number(prior, evidence):
    posterior = MotionPosterior(prior, evidence)
    sampler = TemperedPairs(levels=3, steps=5, warmup=20, thin=1)
    both = sampler.sample(posterior, draws=4, chains=2, seed=3, progress=False)
    alone = sampler.sample(posterior, draws=4, chains=1, seed=3, progress=False)
    assert np.array_equal(both.dataset["positions"][0], alone.dataset["positions"][0])
    assert not np.array_equal(both.dataset["positions"][0], both.dataset["positions"][1])


def test_what_it_cannot_draw_from_is_said(prior, evidence):
    sampler = TemperedPairs()
    with pytest.raises(ValueError, match="and Keypoints2D with 0 hidden joints"):
        sampler.sample(load_problem("gait-monocular").posterior, progress=False)
    with pytest.raises(
        ValueError, match="posterior is a MotionPosterior of PosePairPrior and NoneType"
    ):
        sampler.sample(MotionPosterior(prior), progress=False)
    hidden = evidence.annotations.visible.copy()
    hidden[0, 3] = False
    partly = AnnotatedPairs(replace(evidence.annotations, visible=hidden), n_views=2)
    with pytest.raises(ValueError, match="AnnotatedPairs with 1 hidden joints, expected"):
        sampler.sample(MotionPosterior(prior, partly), progress=False)
    with pytest.raises(ValueError, match="initial must be None, got ndarray"):
        sampler.sample(MotionPosterior(prior, evidence), initial=np.zeros((1, 108)), progress=False)
    with pytest.raises(ValueError, match="levels is 2, expected"):
        TemperedPairs(levels=2)


def _told(poses: np.ndarray, posterior: MotionPosterior) -> np.ndarray:
    """Return what prior and evidence change: log f, log L, and how the two people stand."""
    skeleton = posterior.likelihood.skeleton
    roots = list(skeleton.roots)
    chests = [k for k, name in enumerate(skeleton.joint_names) if "chest" in name]
    trunks = poses[:, chests] - poses[:, roots]
    return np.stack(
        [
            posterior.prior.log_plausibility(poses[:, None]),
            posterior.likelihood.log_density(poses[:, None]),
            np.linalg.norm(poses[:, roots[0]] - poses[:, roots[1]], axis=-1),
            (trunks[:, 0] * trunks[:, 1]).sum(axis=-1),
        ],
        axis=-1,
    )


def _errors_apart(values: np.ndarray, mean: float | np.ndarray, error: float = 0.0) -> np.ndarray:
    """Return how far means of chains are from what is known, in standard errors."""
    flat = values.reshape(*values.shape[:2], -1)
    effective = np.asarray(array_stats.ess(flat, method="mean", chain_axis=0, draw_axis=1))
    own = flat.var(axis=(0, 1), ddof=1) / effective
    return (flat.mean(axis=(0, 1)) - np.ravel(mean)) / np.sqrt(own + np.ravel(error) ** 2)
