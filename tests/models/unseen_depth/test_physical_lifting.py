"""Physically plausible lifts: against importance weights, bad input, reproducibility."""

from __future__ import annotations

import numpy as np
import pytest

from probmotion.data.pair_sets import choose_seed, dance_frames, ground_truth
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.interaction.annotations.sources import draw_annotations
from probmotion.models.pose_pairs import PosePairPrior, penetration_depth
from probmotion.models.unseen_depth import AnnotationPrior, physical_lifting as physical
from probmotion.models.unseen_depth.physical_lifting import physical_lifts
from probmotion.motion.skeleton import Skeleton
from probmotion.threads import one_thread

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
    ("bone_noise", "position_noise"), [(1e3, 1e3), (0.6, 0.3)], ids=["gaussian", "physical"]
)
def test_draws_match_importance_weighted_lifts(
    prior, keypoints, pose, bone_noise, position_noise, monkeypatch
):
    """The weights are the physical prior; without it, draws have the closed-form posterior."""
    mixtures = physical._mixtures

    def in_one_view(prior, images):
        """Yield mixtures that start in their most probable view."""
        for group in mixtures(prior, images):
            yield [
                each._replace(weights=1.0 * (each.weights == each.weights.max())) for each in group
            ]

    if position_noise == 1e3:  # Others start in the exact views, which are nearly theirs.
        monkeypatch.setattr(physical, "_mixtures", in_one_view)
    physics = PosePairPrior(
        pose,
        SKELETON,
        max_invalid=99,
        penetration_weight=30.0,
        bone_noise=bone_noise,
        position_noise=position_noise,
    )
    evidence = prior.cells.evidence(*shown(keypoints[:1]), False)
    assert np.sort(evidence.weights()[0])[-2] > 0.02, "several views must be probable"
    exact = prior.sample_lifts(keypoints[:1], np.random.default_rng(0), 60_000)[:, 0]
    lengths = log_lengths(exact, pose)
    log_weights = physics.log_plausibility(exact[:, None])
    log_weights = log_weights - 0.5 * (lengths / bone_noise) ** 2 @ np.ones(lengths.shape[1])
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    assert 1 / (weights**2).sum() > 1000
    many = np.repeat(keypoints[:1], 200, axis=0)
    draws = physical_lifts(prior, many, physics, steps=5000)[0]
    for values, of_exact in (
        (log_lengths(draws, pose), lengths),
        (draws[..., 2], exact[..., 2]),
        (draws[..., 0], exact[..., 0]),
        (draws[..., 2] ** 2, exact[..., 2] ** 2),
        (physics.log_plausibility(draws[:, None]), physics.log_plausibility(exact[:, None])),
    ):
        mean = weights @ of_exact
        variance = weights**2 @ (of_exact - mean) ** 2 + values.var(axis=0) / len(values)
        z = (values.mean(axis=0) - mean) / np.sqrt(variance)
        assert abs(z).max() < 4.5


def shown(keypoints):
    """Return centred images (n, 2 J) and the mask of visible coordinates."""
    centred = keypoints - keypoints.mean(axis=1, keepdims=True)
    return np.swapaxes(centred, 1, 2).reshape(len(centred), -1), np.ones(
        centred[0].size, dtype=bool
    )


def test_draws_have_the_bones_of_the_people_and_keep_to_the_image(prior, keypoints, pose):
    physics = PosePairPrior(pose, SKELETON)
    few = keypoints[:30].copy()
    few[::3, 4] = np.nan
    draws = physical_lifts(prior, few, physics, draws=2, steps=3000).reshape(-1, 34, 3)
    gaussian = prior.sample_lifts(few, np.random.default_rng(0), 2).reshape(-1, 34, 3)
    deviations = [log_lengths(each, pose).std() for each in (draws, gaussian)]
    assert deviations[0] < 0.08 < 0.15 < deviations[1]
    depths = [penetration_depth(each, SKELETON).mean() for each in (draws, gaussian)]
    assert depths[0] < 0.5 * depths[1]
    assert max(len(physics.invalid_joints(each)) for each in draws) <= physics.max_invalid
    apart = draws.reshape(2, 30, 34, 3)[..., :2] - few
    assert np.sqrt(np.nanmean(apart**2)) < 2 * prior.noise
    np.testing.assert_allclose(draws[..., 2].mean(axis=1), 0, atol=1e-9)


def test_draws_do_not_depend_on_other_annotations_or_threads(prior, keypoints, pose):
    physics = PosePairPrior(pose, SKELETON)
    every = physical_lifts(prior, keypoints[:5], physics, steps=100, seed=3)
    with one_thread():
        some = physical_lifts(prior, keypoints[:3], physics, steps=100, draws=2, seed=3)
    np.testing.assert_allclose(some[0], every[0, :3], atol=1e-9)
    assert abs(some[1] - some[0]).max() > 0.01


def test_wrong_input(prior, keypoints, pose):
    other = AnnotationPrior(
        prior.weights, prior.means[:, 1:], prior.covariances[:, 3:, 3:], prior.noise, prior.views
    )
    with pytest.raises(ValueError, match="physics must have the prior's 33 joints, got 34"):
        physical_lifts(other, keypoints[:, 1:], PosePairPrior(pose, SKELETON))
