"""Compiled densities, moves and walks of pose pairs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import log_softmax, logsumexp

from probmotion import MotionPosterior
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
    workspace,
)
from probmotion.models.pose_pairs.pair_moves import APPROACH, HINGE, STRETCH, moves_of, propose
from probmotion.models.pose_pairs.pair_walk_kernels import walk
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


def pair_arrays(posterior):
    walks = posterior.prior.walks(posterior.likelihood)
    body, physics = walks.body, walks.physics
    return body, physics, walks.views, workspace(body, physics, 200)


def test_compiled_density_matches_the_posterior(prior, likelihood):
    posterior = MotionPosterior(prior, replace(likelihood, noise=0.01))
    body, physics, views, work = pair_arrays(posterior)
    rng = np.random.default_rng(0)
    theta = rng.uniform(0.05, 0.6, (40, 1)) * rng.standard_normal((40, prior.dim))
    poses = np.ascontiguousarray(prior.motion(theta)[:, 0])
    parts, logs = np.zeros(6), []
    for pose in poses:
        log_prior_terms(pose, body, physics, parts, work)
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
    body, _, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    prepared, view, rng = views.prepared, 3, np.random.default_rng(0)
    pose = prior.seed[0] + 0.1 * rng.standard_normal(prior.seed[0].shape)
    logs = np.empty(views.near.shape[1])
    log_annotations(pose, view, body, views, logs)
    points = project_to_view(pose, view, body, views) @ [1, 1j]
    points -= points.mean()
    for annotation, exact in zip(views.near[view], logs, strict=True):
        target = prepared.joints[annotation].T @ [1, 1j]
        product = np.vdot(points, target)
        error = points * product / abs(product) - target
        surrogate = log_surrogate(pose, view, annotation, body, views, work)
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
    body, *_ = pair_arrays(MotionPosterior(prior, likelihood))
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
    body, _, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    rng, done = np.random.default_rng(0), 0
    root = -1 if person < 0 else int(body.roots[person])
    for number in range(60):
        view, annotation = number % 5, views.near[number % 5, number % 4]
        pose = prior.seed[0] + 0.02 * rng.standard_normal(prior.seed[0].shape)
        new, back = np.empty_like(pose), np.empty_like(pose)
        log_volume = approach(pose, root, 0.8, view, annotation, body, views, work.image, new)
        if log_volume == -np.inf:
            continue
        done += 1
        inverse = approach(new, root, 1 / 0.8, view, annotation, body, views, work.image, back)
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
    body, _, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    pose, view = prior.seed[0], 1
    annotation, new = views.near[view, 0], np.empty_like(pose)
    total = approach(pose, -1, 1.1, view, annotation, body, views, work.image, new)
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
            approach(moved, -1, 1.1, view, annotation, body, views, work.image, new)
            mapped.append((new[joint] - new[body.parents[joint]]) / np.linalg.norm(bone))
        area = np.linalg.norm(np.cross(mapped[1] - mapped[0], mapped[2] - mapped[0]))
        factors.append(math.log(area / size**2))
    assert total == pytest.approx(sum(factors), abs=1e-2)


def test_a_transfer_is_inverted_by_its_inverse(prior, likelihood):
    """Frame and bone lengths stay; the roots' distance and its volume are scaled."""
    body, _, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    rng, (first, second) = np.random.default_rng(0), body.roots
    ends, starts = np.array(prior.skeleton.bones).T
    for view in range(5):
        start, end = views.near[view, :2]
        pose = prior.seed[0] + 0.02 * rng.standard_normal(prior.seed[0].shape)
        sides = rng.choice([-1.0, 1.0], size=len(pose))
        new, back = np.empty_like(pose), np.empty_like(pose)
        log_volume = transfer(pose, sides, view, start, end, body, views, work.image, new)
        inverse = transfer(new, sides, view, end, start, body, views, work.image, back)
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
    body, physics, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    pose, new, parts = prior.seed[0].copy(), np.empty_like(prior.seed[0]), np.zeros(6)
    joints = views.prepared.joints.copy()
    start, end = views.near[0, :2]
    joints[end, :, body.roots[1]] = joints[end, :, body.roots[0]]
    together = views._replace(prepared=views.prepared._replace(joints=joints))
    for pair in ((start, end), (end, start)):
        arguments = (body, together, work.image, new)
        assert transfer(pose, np.ones(len(pose)), 0, *pair, *arguments) == -np.inf
    moves, rng = moves_of(body), np.random.default_rng(0)
    log_prior_terms(pose, body, physics, parts, work)
    counters = (moves, np.full(len(moves), 0.1), np.zeros(len(moves)), np.zeros(len(moves)))
    walk(pose, parts, 0, 0.1, 2000, *counters, body, physics, together, rng)
    assert np.isfinite(pose).all()


def test_a_transfer_leads_from_one_annotation_to_the_other(prior, likelihood):
    """A pose whose bones lie on the first annotation's comes to lie on the second's."""
    body, _, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    rng, done = np.random.default_rng(0), 0
    for number in range(30):
        view, start, end = number % 5, *views.near[number % 5, :2]
        pose = prior.seed[0] + 0.02 * rng.standard_normal(prior.seed[0].shape)
        near, new, nearer = (np.empty_like(pose) for _ in range(3))
        if approach(pose, -1, 1e-4, view, start, body, views, work.image, near) == -np.inf:
            continue
        towards = image_axes(pose, view, body, views)[2]
        sides = np.sign((near - near[body.parents]) @ np.array(towards))
        assert (sides * scaled_depths(near, view, body, views) >= 0).all()
        transfer(near, sides, view, start, end, body, views, work.image, new)
        if approach(new, -1, 0.5, view, end, body, views, work.image, nearer) == -np.inf:
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
    body, physics, views, work = pair_arrays(MotionPosterior(prior, likelihood))
    rng = np.random.default_rng(0)
    pose, parts, moves = prior.seed[0].copy(), np.zeros(6), moves_of(body)
    log_prior_terms(pose, body, physics, parts, work)
    sizes, trials, accepted = np.full(len(moves), 0.1), np.zeros(len(moves)), np.zeros(len(moves))
    counters = (moves, sizes, trials, accepted)
    view, log_l = walk(pose, parts, 2, 1.0, 4000, *counters, body, physics, views, rng)
    assert log_l == pytest.approx(log_views(pose, body, views)[view], rel=1e-9)
    expected = np.zeros(6)
    log_prior_terms(pose, body, physics, expected, work)
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
    body, physics, views, work = pair_arrays(posterior)

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
        log_prior_terms(pose, body, physics, parts, work)
        states = []
        for _ in range(1100):
            view, _ = walk(pose, parts, view, power, 400, *counters, body, physics, views, rng)
            states.append((pose.copy(), view))
        poses, chosen = zip(*states[100:], strict=True)
        summaries.append(summary(np.array(poses))[np.arange(len(chosen)), list(chosen)])
    assert np.abs(z_scores(np.array(summaries), mean, error)).max() < MAX_Z


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.15, 0.3])
def test_transfers_preserve_the_tempered_density(prior, likelihood, exact, noise):
    """Expectations of weighted draws do not change, although many of the draws do.

    With less noise, annotations differ more in probability; with more, more draws count.
    """
    weak_prior, power = replace(prior, position_noise=0.7, max_invalid=24), 0.6
    posterior = MotionPosterior(weak_prior, replace(likelihood, n_near=8, noise=noise))
    body, physics, views, work = pair_arrays(posterior)
    rng, (n_views, n_near), n = np.random.default_rng(0), views.near.shape, len(exact)
    log_weight = weak_prior.log_plausibility(exact[:, None])
    summaries, poses = np.empty((2, n, 4)), exact.copy()
    parts, logs = np.empty(6), np.empty(n_near)
    arrays = (work, np.empty_like(poses[0]), np.empty(6), np.empty(n_near))

    def summary(pose: np.ndarray, view: int, logs: np.ndarray) -> list[float]:
        """Return log L_v, distance of roots, bones near the image plane and annotations in use."""
        bones = (pose - pose[body.parents])[body.parents >= 0]
        sines = bones @ image_axes(pose, view, body, views)[2] / np.linalg.norm(bones, axis=1)
        apart = np.linalg.norm(np.subtract(*pose[body.roots]))
        in_use = logsumexp(power * (logs - logs.max()))
        return [logs.max(), apart, np.exp(-((sines / 0.2) ** 2)).mean(), in_use]

    for k, pose in enumerate(poses):
        view = int(rng.integers(n_views))
        log_prior_terms(pose, body, physics, parts, work)
        log_annotations(pose, view, body, views, logs)
        log_weight[k] += power * logs.max()
        summaries[0, k] = summary(pose, view, logs)
        for _ in range(20):
            pair_walk_kernels._propose_transfer(
                pose, parts, logs, view, power, body, physics, views, *arrays, rng
            )
        summaries[1, k] = summary(pose, view, logs)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    moved = (poses != exact).any(axis=(1, 2))
    assert weight[moved].sum() ** 2 / (weight[moved] ** 2).sum() > 300
    change = summaries[1] - summaries[0]
    z = weight @ change / np.sqrt(weight**2 @ change**2)
    assert np.abs(z).max() < MAX_Z
