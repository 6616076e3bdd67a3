"""The physical prior of pose-pairs: eq. 2 by hand, its support, and where chains start."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import MotionPosterior, UnsupportedPosterior
from probmotion.data.pair_sets import choose_seed
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.models.pose_pairs.penetration import penetration_depth
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.protocols import (
    HasCoordinateSpeeds,
    HasLogDensity,
    MotionPrior,
    Samplable,
)
from probmotion.samplers import NUTS, Ensemble, MetropolisHastings, MultiViewAncestral
from probmotion.samplers.mcmc.proposals import Isotropic

PAIR = Skeleton.preset("pair17")


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    return np.concatenate([dance.positions[::10] for dance in synthetic_dances(3)])


@pytest.fixture(scope="module")
def prior(poses) -> PosePairPrior:
    return PosePairPrior(poses[choose_seed(poses)], PAIR)


def bent_back(pose: np.ndarray) -> np.ndarray:
    """Both people's knees bent forwards, and their elbows backwards, as no one's do."""
    wrong = pose.copy()
    for person in ("person0", "person1"):
        across = pose[PAIR.index(f"{person}:left_hip")] - pose[PAIR.index(f"{person}:right_hip")]
        for side in ("left", "right"):
            for middle, end in (("knee", "ankle"), ("elbow", "wrist")):
                centre = PAIR.index(f"{person}:{side}_{middle}")
                tip = PAIR.index(f"{person}:{side}_{end}")
                angle = np.radians(-100 if middle == "knee" else 120)
                turn = Rotation.from_rotvec(angle * across / np.linalg.norm(across))
                wrong[tip] = wrong[centre] + turn.apply(pose[tip] - pose[centre])
    return wrong


def test_it_is_a_prior_that_samplers_know(prior):
    assert isinstance(prior, MotionPrior)
    assert isinstance(prior, HasLogDensity)
    assert isinstance(prior, HasCoordinateSpeeds)
    assert not isinstance(prior, Samplable)
    assert prior.dim == 108
    assert prior.frames == 1


def test_the_density_is_equation_2(prior, poses):
    """Recomputed from the limits and the penetration, which have tests of their own."""
    rng = np.random.default_rng(0)
    theta = 0.25 * rng.standard_normal((200, prior.dim))
    motion = prior.motion(theta)
    pose = motion[:, 0]
    limits = JointLimits.shipped(PAIR)
    invalid = (~limits.is_valid(pose)).sum(axis=-1)
    apart = ((pose - limits.nearest_valid(pose)) ** 2).sum(axis=(-2, -1))
    energy = apart + 10 * penetration_depth(pose, PAIR) ** 2
    expected = np.where(invalid > 8, -np.inf, -energy / (2 * 0.05**2))
    assert (invalid > 8).any()
    assert (invalid <= 8).any()
    assert np.allclose(prior.log_plausibility(motion), expected)
    assert np.allclose(prior.log_density(theta), expected + prior.log_measure(theta))
    # One at a time as well.
    assert prior.log_density(theta[3]) == pytest.approx(prior.log_density(theta)[3])


def test_real_looking_pairs_are_plausible_and_broken_ones_are_not(prior, poses):
    log_f = prior.log_plausibility(poses[:, None])
    assert np.median(log_f) > -5
    assert prior.log_plausibility(bent_back(poses[0])[None]) < -50


def test_where_the_pair_stands_and_faces_is_no_matter(prior, poses):
    turn = Rotation.from_rotvec([0.3, -2.0, 0.5])
    moved = turn.apply(poses[:5].reshape(-1, 3)).reshape(-1, 1, 34, 3) + np.array([1.0, -0.4, 2.0])
    expected = prior.log_plausibility(poses[:5, None])
    assert np.allclose(prior.log_plausibility(moved), expected, atol=1e-6)


def test_chains_start_at_the_seeds(poses):
    prior = PosePairPrior(poses[:3], PAIR)
    sampler = MetropolisHastings(Isotropic(1e-9, None), warmup=0, thin=1)
    draws = sampler.sample(MotionPosterior(prior), draws=1, chains=4, progress=False)
    start = draws.positions.values[:, 0, 0]
    assert np.allclose(start, poses[[0, 1, 2, 0]], atol=1e-6)
    # Walkers of one ensemble are spread over the seeds, and no two are the same.
    walkers = prior.motion(prior.initial(np.random.default_rng(0), 40))[:, 0]
    apart = np.abs(walkers[:, None] - poses[:3]).max(axis=(-2, -1))
    assert np.all(apart.min(axis=1) < 0.02)
    assert set(apart.argmin(axis=1)) == {0, 1, 2}
    assert len(np.unique(walkers, axis=0)) == 40
    assert np.allclose(prior.motion(prior.coordinates(poses[5]))[0], poses[5])


def test_a_seed_outside_the_support_is_refused_by_its_joints(poses):
    with pytest.raises(ValueError, match=r"seed 0 has \d+ joint angles.*person1:left_ankle"):
        PosePairPrior(bent_back(poses[0]), PAIR, max_invalid=2)


def test_wrong_input_is_named(poses):
    bare = Skeleton(PAIR.joint_names, PAIR.parents)
    for match, arguments in {
        "seed has shape": {"seed": poses[0, :17]},
        "skeleton has no bone radii": {"skeleton": bare},
        "position_noise is 0": {"position_noise": 0},
        "max_invalid is -1": {"max_invalid": -1},
        "seed has no pose": {"seed": poses[:0]},
        "seed 0 has people 1.* m tall, expected 0.5 to 3 m: pos": {"seed": 1000 * poses[0]},
        "seed 0 has people 50.* m apart, expected at most 5 m": {
            "seed": poses[0] + np.repeat([[0.0, 0, 0], [50, 0, 0]], 17, axis=0)
        },
    }.items():
        with pytest.raises(ValueError, match=match):
            PosePairPrior(**{"seed": poses[0], "skeleton": PAIR, **arguments})


def test_samplers_that_cannot_say_why(prior):
    for sampler, why in (
        (NUTS(), "needs a density with a gradient, which PosePairPrior has not; mh would do"),
        (Ensemble(), "at most 20 dimensions"),
        (MultiViewAncestral(), "needs a prior with Denoises2D"),
    ):
        with pytest.raises(UnsupportedPosterior, match=why):
            sampler.sample(MotionPosterior(prior), draws=2, progress=False)


def test_the_ensemble_runs_where_it_is_let(prior):
    start = prior.initial(np.random.default_rng(0), 216)[None]
    sampler = Ensemble(largest_dim=108, walkers=216, warmup=2)
    draws = sampler.sample(MotionPosterior(prior), draws=216, initial=start, progress=False)
    assert draws.positions.shape == (1, 216, 1, 34, 3)


def test_a_chain_keeps_to_the_support(prior):
    sampler = MetropolisHastings(Isotropic(0.02), warmup=200, thin=5)
    draws = sampler.sample(MotionPosterior(prior), draws=20, chains=2, progress=False)
    log_f = prior.log_plausibility(draws.flat())
    assert np.isfinite(log_f).all()
    again = prior.log_density(draws.dataset["theta"].values)
    assert np.allclose(again, draws.dataset["log_density"].values)


def test_every_setting_reaches_the_posterior(poses):
    drawn = draw_annotations([synthetic_dances(1)[0]], 30, seed=0, known_views=True)
    settings = PairSettings(
        penetration_weight=3.0,
        position_noise=0.07,
        max_invalid=5,
        view_bandwidth=0.3,
        shortest_edge=0.08,
        noise=0.04,
        limit=1e9,
        n_views=5,
        n_near=6,
        measure="cartesian",
        graph="gabriel",
        bone_noise=0.02,
        root_noise=0.5,
    )
    posterior = pair_posterior(poses[0], drawn.annotations, settings, view_seed=7)
    prior, evidence = posterior.prior, posterior.likelihood
    found = {
        name: getattr(holder, name)
        for holder, names in (
            (prior, "penetration_weight position_noise max_invalid bone_noise root_noise"),
            (evidence, "view_bandwidth shortest_edge noise n_views n_near measure graph"),
            (posterior, "limit"),
        )
        for name in names.split()
    }
    assert found == asdict(settings)
    assert (evidence.seed, evidence.distribution.bandwidth) == (7, 0.3)
    assert (prior.chart.bone_noise, prior.chart.root_noise) == (0.02, 0.5)


def test_a_seed_that_truncation_leaves_nothing_of_is_named(poses):
    broken = bent_back(poses[1])
    with pytest.raises(ValueError, match="seed 1 is below 1/100 of the first seed's density"):
        pair_posterior(poses[:1].repeat(2, 0) * 0 + np.stack([poses[0], broken]), None,
                       PairSettings(limit=100.0, max_invalid=20))  # fmt: skip


def test_absurd_points_have_no_density(prior):
    theta = np.zeros((3, prior.dim))
    theta[1], theta[2, -1] = 1e5, 1e5
    log_density = prior.log_density(theta)
    assert np.isfinite(log_density[0])
    assert np.isneginf(log_density[1:]).all()


def test_the_papers_numbers_are_a_preset():
    paper = PairSettings.paper()
    assert (paper.penetration_weight, paper.position_noise, paper.view_bandwidth) == (10, 0.05, 0.5)
    assert (paper.shortest_edge, paper.noise, paper.limit, paper.max_invalid) == (
        0.05,
        0.01,
        100,
        8,
    )


def test_the_prior_alone_is_a_posterior(poses):
    posterior = pair_posterior(poses[0], None, PairSettings(limit=100.0))
    assert posterior.likelihood is None
    expected = posterior.prior.log_plausibility(poses[:1, None])[0]
    assert posterior.log_seed == pytest.approx(float(expected))
