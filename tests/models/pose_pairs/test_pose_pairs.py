"""Physical prior of pose-pairs: eq. 2, its support, and initial points."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from probmotion import MotionPosterior
from probmotion.data.pair_sets import choose_seed
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs.joint_limits import JointLimits
from probmotion.models.pose_pairs.pair_posterior import PairSettings, pair_posterior
from probmotion.models.pose_pairs.penetration import penetration_depth
from probmotion.models.pose_pairs.pose_chart import PoseChart
from probmotion.models.pose_pairs.pose_pairs import PosePairPrior
from probmotion.motion.skeleton import Skeleton
from tests.models.pose_pairs.small_dances import small_likelihood

PAIR = Skeleton.preset("pair17")
DANCES = synthetic_dances(3)
POSES = np.concatenate([dance.positions[::10] for dance in DANCES])


@pytest.fixture(scope="module")
def prior():
    return PosePairPrior(POSES[choose_seed(POSES)], PAIR)


def bent_back(pose):
    """Reverse the shins and forearms of both people."""
    wrong = pose.copy()
    for tip, centre in PAIR.bones:
        if PAIR.joint_names[tip].endswith(("ankle", "wrist")):
            wrong[tip] = 2 * pose[centre] - pose[tip]
    return wrong


BROKEN = bent_back(POSES[0])


def test_density_equals_equation_2(prior):
    """The reference is computed from joint limits and penetration."""
    theta = 0.25 * np.random.default_rng(0).standard_normal((200, prior.dim))
    motion = prior.motion(theta)
    pose = motion[:, 0]
    valid, nearest = JointLimits.shipped(PAIR).project(pose)
    invalid = (~valid).sum(axis=-1)
    squared = ((pose - nearest) ** 2).sum(axis=(-2, -1))
    energy = squared + 10 * penetration_depth(pose, PAIR) ** 2
    expected = np.where(invalid > 8, -np.inf, -energy / (2 * 0.05**2))
    assert (invalid > 8).any()
    assert (invalid <= 8).any()
    assert np.allclose(prior.log_plausibility(motion), expected)
    log_density = prior.log_density(theta)
    assert np.allclose(log_density, expected + prior.log_measure(theta))
    assert prior.log_density(theta[3]) == pytest.approx(log_density[3])
    theta[:2] = 0
    theta[0], theta[1, -1] = 1e5, 1e5  # bone lengths overflow
    assert np.isneginf(prior.log_density(theta)[:2]).all()


def test_posterior_computes_each_pose_once(prior, monkeypatch):
    likelihood = small_likelihood()
    theta = prior.initial(np.random.default_rng(0), 5)
    expected = prior.log_density(theta) + likelihood.log_density(prior.motion(theta))
    computed, positions = [], PoseChart.positions

    def counted(chart, points):
        computed.append(len(points))
        return positions(chart, points)

    monkeypatch.setattr(PoseChart, "positions", counted)
    posterior = MotionPosterior(prior, likelihood)
    np.testing.assert_allclose(posterior.log_density(theta), expected)
    np.testing.assert_allclose(posterior.evaluate(theta)[0], expected)
    assert computed == [5, 5]


def test_plausibility_separates_real_and_broken_poses_and_is_rigidly_invariant(prior):
    log_f = prior.log_plausibility(POSES[:, None])
    assert np.median(log_f) > -5
    assert prior.log_plausibility(BROKEN[None]) < -50
    turn = Rotation.from_rotvec([0.3, -2.0, 0.5])
    moved = turn.apply(POSES[:5].reshape(-1, 3)).reshape(-1, 1, 34, 3) + np.array([1.0, -0.4, 2.0])
    assert np.allclose(prior.log_plausibility(moved), log_f[:5], atol=1e-6)


def test_walkers_start_at_the_seeds():
    prior = PosePairPrior(POSES[:3], PAIR)
    walkers = prior.motion(prior.initial(np.random.default_rng(0), 40))[:, 0]
    distances = np.abs(walkers[:, None] - POSES[:3]).max(axis=(-2, -1))
    assert np.all(distances.min(axis=1) < 0.02)
    assert set(distances.argmin(axis=1)) == {0, 1, 2}
    assert len(np.unique(walkers, axis=0)) == 40
    assert np.allclose(prior.motion(prior.coordinates(POSES[5]))[0], POSES[5])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": BROKEN, "max_invalid": 2}, r"at most 2 .*, got \d+: .*person1:left_ankle"),
        ({"seed": POSES[0, :17]}, "seed must have shape"),
        ({"skeleton": Skeleton(PAIR.joint_names, PAIR.parents)}, "skeleton must have bone radii"),
        ({"position_noise": 0}, "position_noise must be a finite number above 0"),
        ({"max_invalid": -1}, "max_invalid must be an integer of at least 0"),
        ({"seed": POSES[:0]}, "seed must contain at least one pose"),
        ({"seed": 1000 * POSES[0]}, "seed 0 "),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(ValueError, match=message):
        PosePairPrior(**{"seed": POSES[0], "skeleton": PAIR, **arguments})


def test_every_setting_reaches_the_posterior():
    annotations = draw_annotations(DANCES[:1], 30, seed=0, known_views=True).annotations
    settings = PairSettings(
        penetration_weight=3.0, position_noise=0.07, max_invalid=5, view_bandwidth=0.3,
        shortest_edge=0.08, noise=0.04, limit=1e9, n_views=5, n_near=6, measure="cartesian",
        graph="gabriel", bone_noise=0.02, root_noise=0.5,
    )  # fmt: skip
    posterior = pair_posterior(POSES[0], annotations, settings, view_seed=7)
    prior, likelihood = posterior.prior, posterior.likelihood
    for name, value in asdict(settings).items():
        owners = [part for part in (posterior, prior, likelihood) if hasattr(part, name)]
        assert owners
        assert all(getattr(part, name) == value for part in owners)
    assert (likelihood.seed, likelihood.distribution.bandwidth) == (7, 0.3)
    assert (prior.chart.bone_noise, prior.chart.root_noise) == (0.02, 0.5)


def test_paper_preset():
    published = {"penetration_weight": 10, "position_noise": 0.05, "view_bandwidth": 0.5}
    published |= {"shortest_edge": 0.05, "noise": 0.01, "limit": 100, "max_invalid": 8}
    assert published.items() <= asdict(PairSettings.paper()).items()


def test_posterior_without_annotations_and_truncated_seeds():
    settings = PairSettings(limit=100.0, max_invalid=20)
    posterior = pair_posterior(POSES[0], None, settings)
    assert posterior.likelihood is None
    expected = posterior.prior.log_plausibility(POSES[:1, None])[0]
    assert posterior.log_seed == pytest.approx(float(expected))
    with pytest.raises(ValueError, match="seed 1 must have at least 1/100 of the first seed's"):
        pair_posterior(np.stack([POSES[0], bent_back(POSES[1])]), None, settings)
