"""Physically plausible lifts: against importance weights, bad input, reproducibility."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from probmotion import MotionPosterior
from probmotion.data.pair_sets import choose_seed, dance_frames, ground_truth
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs import PosePairPrior, penetration_depth
from probmotion.models.pose_pairs.pair_moves import (
    APPROACH,
    SHIFT,
    SLIDE,
    SWING,
    TURN,
    propose,
)
from probmotion.models.unseen_depth import (
    AnnotationPrior,
    PhysicalLift,
    physical_lift,
    physical_lifting as physical,
)
from probmotion.models.unseen_depth.keypoints import centred_images
from probmotion.models.unseen_depth.physical_lift import DEPTH_SD
from probmotion.models.unseen_depth.physical_lifting import physical_lifts
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.truncation import TruncatedPosterior
from probmotion.samplers import TemperedPairs
from probmotion.threads import one_thread
from tests.models.pose_pairs.small_dances import small_likelihood, z_scores

SKELETON = Skeleton.preset("pair17")


@pytest.fixture(scope="module")
def pose():
    """Return the medoid of dances."""
    poses = ground_truth(synthetic_dances(8, seed=0))[0]
    return poses[choose_seed(poses)]


@pytest.fixture(scope="module")
def keypoints():
    dances = synthetic_dances(8, seed=0)
    frames = [dance_frames(motion) for motion in dances]
    return draw_annotations(dances, 300, 0, frames=frames).annotations.keypoints


@pytest.fixture(scope="module")
def prior(pose, keypoints):
    return AnnotationPrior.fit(keypoints, pose)


def log_lengths(poses, pose):
    """Return the log bone lengths relative to those of a pose, (…, bones)."""
    bones = np.array(SKELETON.bones)
    lengths = [
        np.linalg.norm(each[..., bones[:, 0], :] - each[..., bones[:, 1], :], axis=-1)
        for each in (poses, pose)
    ]
    return np.log(lengths[0] / lengths[1])


@pytest.mark.parametrize(
    ("bone_noise", "position_noise", "hidden"),
    [(1e3, 1e3, []), (1e3, 1e3, [8, *range(17, 34)]), (0.6, 0.3, [])],
    ids=["gaussian", "missing", "physical"],
)
def test_draws_match_importance_weighted_lifts(
    prior, keypoints, pose, bone_noise, position_noise, hidden, monkeypatch
):
    """The weights are the physical prior; without it, draws have the closed-form posterior."""
    annotation = keypoints[:1].copy()
    annotation[:, hidden] = np.nan
    mixtures = physical.lift_mixtures

    def in_one_view(prior, images):
        """Yield mixtures that start in their most probable view."""
        for group in mixtures(prior, images):
            yield [
                each._replace(weights=1.0 * (each.weights == each.weights.max())) for each in group
            ]

    if bone_noise == 1e3 and not hidden:  # Others need more steps from there.
        monkeypatch.setattr(physical, "lift_mixtures", in_one_view)
    physics = PosePairPrior(
        pose,
        SKELETON,
        max_invalid=99,
        penetration_weight=30.0,
        bone_noise=bone_noise,
        position_noise=position_noise,
    )
    exact, weights = weighted_lifts(prior, annotation, physics)
    monkeypatch.setattr(physical, "_POWERS", np.array([0.4, 1.0]))  # Two replicas are faster.
    many = np.repeat(annotation, 120, axis=0)
    draws = physical_lifts(prior, many, physics, warmup=60, sweeps=1)[0]
    values, expected = (summaries(poses, physics) for poses in (draws, exact))
    mean = weights @ expected
    variance = weights**2 @ (expected - mean) ** 2 + values.var(axis=0) / len(values)
    z = (values.mean(axis=0) - mean) / np.sqrt(variance)
    assert abs(z).max() < 4.5


def test_tempered_draws_match_importance_weighted_lifts(prior, keypoints, pose):
    physics = PosePairPrior(
        pose, SKELETON, max_invalid=99, penetration_weight=30.0, bone_noise=0.6, position_noise=0.3
    )
    lift = PhysicalLift(prior, keypoints[0], physics)
    sampler = TemperedPairs(levels=3, steps=100, warmup=64, thin=4)
    run = sampler.sample(MotionPosterior(lift), draws=150, chains=4, progress=False)
    poses = run.positions.values[:, :, 0]
    depths = poses[..., 2].mean(axis=-1)
    assert depths.std() == pytest.approx(DEPTH_SD, rel=0.15)
    poses[..., 2] -= depths[..., None]
    exact, weights = weighted_lifts(prior, keypoints[:1], physics)
    expected = summaries(exact, physics)
    mean = weights @ expected
    error = np.sqrt(weights**2 @ (expected - mean) ** 2)
    assert abs(z_scores(summaries(poses, physics), mean, error)).max() < 4.5


def weighted_lifts(prior, annotation, physics):
    """Return lifts without the physical prior, and their importance weights, which it is."""
    exact = prior.sample_lifts(annotation, np.random.default_rng(0), 20_000)[:, 0]
    lengths = log_lengths(exact, physics.chart.seed)
    log_weights = physics.log_plausibility(exact[:, None])
    log_weights = log_weights - 0.5 * (lengths**2).sum(axis=-1) / physics.bone_noise**2
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    assert 1 / (weights**2).sum() > 1000
    return exact, weights


def summaries(poses, physics):
    """Return log bone lengths, x, depths and their squares, and log plausibility: (…, k)."""
    lengths, depths = log_lengths(poses, physics.chart.seed), poses[..., 2]
    plausibility = physics.log_plausibility(poses[..., None, :, :])[..., None]
    return np.concatenate([lengths, poses[..., 0], depths, depths**2, plausibility], axis=-1)


def test_powers_of_walks_are_those_of_the_likelihood(prior, keypoints, pose, monkeypatch):
    """The least power is part of the prior, and walks at power 1 target the density."""
    kept = []

    def watched(pose, log_weights, means, cells, roots, power, *others):
        kept.append(power)

    monkeypatch.setattr(physical_lift, "walk_replica", watched)
    lift = PhysicalLift(prior, keypoints[0], PosePairPrior(pose, SKELETON))
    walks, powers = lift.walks(None), np.array([0.0, 0.4, 1.0])
    sizes, counts = np.ones(len(walks.moves)), np.zeros((2, len(walks.moves)))
    for power in powers:
        walks.walk(
            lift.seed[0].copy(), np.empty(0), 0, power, 1, sizes, *counts, np.random.default_rng(0)
        )
    log_bones = lift.log_bones(lift.seed[0])
    expected = physical.LEAST_POWER * log_bones + powers * walks.log_view(lift.seed[0], 0)
    np.testing.assert_allclose(np.array(kept) * log_bones, expected)
    assert kept[-1] == pytest.approx(1.0)


@pytest.mark.parametrize("hidden", [[], [8, 20]], ids=["visible", "missing"])
def test_density_is_that_of_the_mixture_and_the_physical_prior(prior, keypoints, pose, hidden):
    annotation = keypoints[0].copy()
    annotation[hidden] = np.nan
    lift = PhysicalLift(prior, annotation, PosePairPrior(pose, SKELETON))
    poses, mixture = lift.seed, lift.mixture
    flat = np.swapaxes(poses, 1, 2).reshape(len(poses), -1)
    in_depth = np.repeat([0.0, 0.0, 1.0], 34)
    logs = []
    for weight, mean, cell in zip(mixture.weights, mixture.means, mixture.cells, strict=True):
        spread = mixture.spreads[cell]
        covariance = spread @ spread.T + DEPTH_SD**2 * np.outer(in_depth, in_depth)
        logs.append(np.log(weight) + multivariate_normal(mean, covariance).logpdf(flat))
    expected = logsumexp(logs, axis=0) + lift.physics.log_plausibility(poses[:, None])
    expected -= 0.5 * (log_lengths(poses, pose) ** 2).sum(axis=-1) / lift.physics.bone_noise**2
    np.testing.assert_allclose(np.diff(lift.log_prior(poses[:, None])), np.diff(expected))
    theta = lift.physics.coordinates(poses)
    log_volume = lift.physics.chart.log_volume(theta)
    np.testing.assert_allclose(lift.log_density(theta) - log_volume, lift.log_prior(poses[:, None]))
    # A rotation beyond π, and lengths of which the squares, or themselves, are infinite.
    theta[0, 0], theta[1, 14::3], theta[2, 14::3] = 4.0, 400.0, 800.0
    assert (lift.log_density(theta[:3]) == -np.inf).all()


def test_truncated_lifts_are_within_the_bounds(prior, keypoints, pose):
    lift = PhysicalLift(prior, keypoints[0], PosePairPrior(pose, SKELETON))
    sampler = TemperedPairs(levels=3, steps=100, warmup=64, thin=4)
    poses = sampler.sample(MotionPosterior(lift), draws=20, progress=False).positions.values[0]
    log_densities = lift.log_prior(poses)
    middle = np.argsort(log_densities)[10]
    seed = lift.physics.coordinates(poses[middle, 0])
    posterior = TruncatedPosterior(lift, seed=seed, limit=np.exp(5.0))
    assert posterior.log_seed == pytest.approx(log_densities[middle])
    run = sampler.sample(posterior, draws=20, progress=False)
    log_densities = lift.log_prior(run.positions.values[0])
    assert (log_densities > posterior.log_floor).all()
    assert len(np.unique(log_densities)) > 5


def test_draws_have_the_bones_of_the_people_and_keep_to_the_image(prior, keypoints, pose):
    physics = PosePairPrior(pose, SKELETON)
    few = keypoints[:30].copy()
    few[::3, 4] = np.nan
    draws = physical_lifts(prior, few, physics, draws=2).reshape(-1, 34, 3)
    gaussian = prior.sample_lifts(few, np.random.default_rng(0), 2).reshape(-1, 34, 3)
    deviations = [log_lengths(each, pose).std() for each in (draws, gaussian)]
    assert deviations[0] < 0.055 < 0.15 < deviations[1]
    depths = [penetration_depth(each, SKELETON).mean() for each in (draws, gaussian)]
    assert depths[0] < 0.5 * depths[1]
    assert max(len(physics.invalid_joints(each)) for each in draws) <= physics.max_invalid
    apart = draws.reshape(2, 30, 34, 3)[..., :2] - few
    assert np.sqrt(np.nanmean(apart**2)) < 2 * prior.noise
    np.testing.assert_allclose(draws[..., 2].mean(axis=1), 0, atol=1e-9)


def test_moves_in_depth(pose):
    """Shifts are along z; the matrix of a turn about an axis without z is symmetric in x and y."""
    body, rng, moved = (
        PosePairPrior(pose, SKELETON).body,
        np.random.default_rng(0),
        np.empty((34, 3)),
    )
    for kind in (SHIFT, TURN):
        person = body.below[body.roots[1]]
        propose(pose, np.array([kind, body.roots[1], -1]), 0.3, body, rng, moved, True)
        change = moved - pose
        assert np.abs(change[person, 2]).max() > 0.01
        np.testing.assert_array_equal(change[~person], 0)
        if kind == SHIFT:
            np.testing.assert_array_equal(change[:, :2], 0)
        else:
            before, after = (each[person] - each[person].mean(axis=0) for each in (pose, moved))
            rotation = np.linalg.lstsq(before, after, rcond=None)[0]
            assert rotation[0, 1] == pytest.approx(rotation[1, 0], abs=1e-9)


def test_steps_in_depth_are_larger(prior, keypoints, pose, monkeypatch):
    """Images determine depth least."""
    kept, walk_lift = [], physical.walk_lift

    def watched(*arguments):
        kept.append(arguments[9])
        return walk_lift(*arguments)

    monkeypatch.setattr(physical, "walk_lift", watched)
    physical_lifts(prior, keypoints[:3], PosePairPrior(pose, SKELETON), sweeps=1)
    everywhere, in_depth = np.exp(np.mean(kept, axis=(0, 1)))
    kinds = [SHIFT, TURN, SWING, SLIDE]
    assert (in_depth[kinds] > 1.2 * everywhere[kinds]).all()


def test_swaps_have_the_densities_of_the_replicas(prior, keypoints, pose):
    """Two poses whose bones keep their lengths are exchanged between powers 0.2 and 1."""
    physics = PosePairPrior(pose, SKELETON)
    [[mixture]] = physical.lift_mixtures(prior, centred_images(keypoints[:1])[0])
    given = mixture.log_weights, mixture.means, mixture.cells, mixture.roots
    moves, powers = physical.lift_moves(physics.body), np.array([0.2, 1.0])
    rigid = np.full((2, 2, APPROACH), -60.0)
    longer, rng = 1.02 * pose, np.random.default_rng(0)
    poses, cold = np.stack([pose, longer]), []
    for _ in range(1500):
        physical.walk_lift(
            poses, powers, *given, 0, 2, moves, rigid, False, physics.body, physics.physics, rng
        )
        cold.append(abs(log_lengths(poses[1], pose)).max() < 1e-6)
    energy = 0.5 * (log_lengths(longer, pose) ** 2).sum() / physics.body.bone_noise**2
    assert np.mean(cold) == pytest.approx(1 / (1 + np.exp(-0.8 * energy)), abs=0.05)


def test_draws_do_not_depend_on_other_annotations_or_threads(prior, keypoints, pose):
    physics = PosePairPrior(pose, SKELETON)
    every = physical_lifts(prior, keypoints[:5], physics, warmup=2, sweeps=2, draws=2, seed=3)
    with one_thread():
        some = physical_lifts(prior, keypoints[:3], physics, warmup=2, sweeps=2, draws=2, seed=3)
    np.testing.assert_allclose(some, every[:, :3], atol=1e-9)
    assert abs(some[1] - some[0]).max() > 0.01


def test_wrong_input(prior, keypoints, pose):
    other = AnnotationPrior(
        prior.weights, prior.means[:, 1:], prior.covariances[:, 3:, 3:], prior.noise, prior.views
    )
    physics = PosePairPrior(pose, SKELETON)
    for function, given in ((physical_lifts, keypoints[:, 1:]), (PhysicalLift, keypoints[0, 1:])):
        with pytest.raises(ValueError, match="physics must have the prior's 33 joints, got 34"):
            function(other, given, physics)
    with pytest.raises(ValueError, match=r"keypoints must have shape \(J, 2\)"):
        PhysicalLift(prior, keypoints[:1], physics)
    with pytest.raises(ValueError, match="likelihood must be None, since the annotation"):
        MotionPosterior(PhysicalLift(prior, keypoints[0], physics), small_likelihood())
    with pytest.raises(ValueError, match=r"scale of the people, .* multiply them by lift\("):
        physical_lifts(prior, 200 * keypoints, physics)
    with pytest.raises(ValueError, match="must have variances of at least 1e-09 of the largest"):
        physical_lifts(replace(prior, noise=1e-5), keypoints[:1], physics)
    neighbours = np.repeat(keypoints[:2, None], 2, axis=1)
    exchanged = SKELETON.subset([*range(17, 34), *range(17)])
    seen = np.ones((2, 34), dtype=bool)
    mirrored = Annotations(keypoints[:2], seen, exchanged, neighbours, 30.0)
    with pytest.raises(ValueError, match="annotations must have the joints of physics, "):
        physical_lifts(prior, mirrored, physics)
