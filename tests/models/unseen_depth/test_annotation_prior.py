"""The annotation prior against brute force, known Gaussians and bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from probmotion.data.downloads import salsa_pairs
from probmotion.data.pair_sets import (
    SALSA_HELD_OUT,
    choose_seed,
    dance_frames,
    ground_truth,
    hold_out,
)
from probmotion.interaction.annotations.sources import draw_annotations, world_axes
from probmotion.interaction.geometry.coordinates import align_rigidly
from probmotion.metrics.coverage import coverage
from probmotion.models.unseen_depth import AnnotationPrior

J = 5
START = np.array([[0, 0.9, 0], [0.3, 0.6, 0.1], [-0.3, 0.6, 0.1], [0.2, 0, 0.3], [-0.2, 0, -0.2]])
START = START - START.mean(axis=0)


def random_prior(components: int = 1, azimuths: int = 12, noise: float = 0.02) -> AnnotationPrior:
    """Return a prior around START with correlated joints."""
    rng = np.random.default_rng(3)
    means = START + 0.15 * (np.arange(components) > 0)[:, None, None] * rng.normal(size=(J, 3))
    means -= means.mean(axis=1, keepdims=True)
    factors = 0.04 * rng.normal(size=(components, 3 * J, 6))
    factors = factors.reshape(components, J, 3, 6)
    factors = (factors - factors.mean(axis=1, keepdims=True)).reshape(components, 3 * J, 6)
    covariances = factors @ np.swapaxes(factors, 1, 2) + 0.005**2 * np.eye(3 * J)
    # Positions are unknown, so that a common displacement must not matter.
    covariances += 0.1**2 * np.kron(np.ones((J, J)), np.eye(3))
    circle = 2 * np.pi * np.arange(azimuths) / azimuths
    views = np.concatenate([np.stack([circle, 0 * circle + e], axis=1) for e in (0.0, 0.3)])
    weights = np.arange(1, components + 1) / np.arange(1, components + 1).sum()
    return AnnotationPrior(weights, means, covariances, noise, views)


def annotated(
    poses: np.ndarray, views: np.ndarray, noise: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints at random positions, and the poses in camera axes."""
    seen = np.einsum("nai,nji->nja", world_axes(views), poses)
    seen[..., 2] -= seen[..., 2].mean(axis=1, keepdims=True)
    seen[..., :2] += rng.normal(size=(len(poses), 1, 2))
    return seen[..., :2] + noise * rng.standard_normal(seen[..., :2].shape), seen


def from_model(prior: AnnotationPrior, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    views = prior.views[rng.integers(len(prior.views), size=n)]
    return annotated(prior.sample(rng, n), views, prior.noise, rng)


def any_views(n: int, rng: np.random.Generator) -> np.ndarray:
    return np.stack([rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.17, 0.7, n)], axis=1)


def brute_force(
    prior: AnnotationPrior, keypoints: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean, sd and log evidence of one annotation from dense Gaussians of every view."""
    visible = ~np.isnan(keypoints[:, 0])
    sd = 300.0  # of the position: nearly flat
    logs, means, squares = [], [], []
    flat = np.kron(np.ones((J, J)), np.diag([sd**2, sd**2, 0.0]))
    centre = np.eye(3 * J) - np.kron(np.full((J, J), 1 / J), np.diag([0.0, 0.0, 1.0]))
    for weight, mean, covariance in zip(prior.weights, prior.means, prior.covariances, strict=True):
        for axes in world_axes(prior.views):
            turn = centre @ np.kron(np.eye(J), axes)
            mu, sigma = turn @ mean.reshape(-1), turn @ covariance @ turn.T + flat
            at = [3 * j + a for j in range(J) if visible[j] for a in (0, 1)]
            image = sigma[np.ix_(at, at)] + prior.noise**2 * np.eye(len(at))
            value = keypoints[visible].reshape(-1)
            density = stats.multivariate_normal(mu[at], image).logpdf(value)
            logs.append(np.log(weight / len(prior.views)) + density)
            gain = np.linalg.solve(image, sigma[at])
            means.append(mu + (value - mu[at]) @ gain)
            squares.append(means[-1] ** 2 + (sigma - sigma[at].T @ gain).diagonal())
    p = np.exp(np.array(logs) - max(logs))
    evidence = max(logs) + np.log(p.sum()) + np.log(2 * np.pi * sd**2)
    p /= p.sum()
    mean = p @ np.array(means)
    return (
        mean.reshape(J, 3),
        np.sqrt(p @ np.array(squares) - mean**2).reshape(J, 3),
        float(evidence),
    )


@pytest.mark.parametrize("hidden", [(), (1,), (0, 4)])
def test_lift_and_evidence_are_those_of_brute_force(hidden: tuple[int, ...]) -> None:
    prior = random_prior(components=2)
    keypoints, _ = from_model(prior, 3, seed=1)
    keypoints[:, list(hidden)] = np.nan
    lifts, evidence = prior.lift(keypoints), prior.log_evidence(keypoints)
    for index, image in enumerate(keypoints):
        mean, sd, log_evidence = brute_force(prior, image)
        # Cells of probability below 1e-3 are left out.
        np.testing.assert_allclose(lifts.positions[index], mean, atol=2e-3)
        np.testing.assert_allclose(lifts.sd[index], sd, atol=4e-3)
        assert evidence[index] == pytest.approx(log_evidence, abs=1e-3)


def test_annotations_that_hide_different_joints_are_lifted_as_if_alone() -> None:
    prior = random_prior()
    keypoints, _ = from_model(prior, 6, seed=2)
    keypoints[[0, 3], [1, 2]] = np.nan
    together = prior.lift(keypoints)
    for index in range(6):
        alone = prior.lift(keypoints[[index]])
        np.testing.assert_allclose(together.positions[index], alone.positions[0], atol=1e-9)
        np.testing.assert_allclose(together.sd[index], alone.sd[0], atol=1e-7)


def test_log_density_is_that_of_scipy() -> None:
    prior = random_prior(components=2)
    poses = prior.sample(np.random.default_rng(0), 4)
    expected = np.logaddexp.reduce(
        [
            np.log(w) + stats.multivariate_normal(m.reshape(-1), c).logpdf(poses.reshape(4, -1))
            for w, m, c in zip(prior.weights, prior.means, prior.covariances, strict=True)
        ]
    )
    np.testing.assert_allclose(prior.log_density(poses), expected, rtol=1e-9)


def test_ranks_of_truths_among_draws_are_uniform_and_intervals_calibrated() -> None:
    prior = random_prior(components=2)
    keypoints, truths = from_model(prior, 500, seed=5)
    keypoints[::3, 2] = np.nan
    rng = np.random.default_rng(8)
    draws = prior.sample_lifts(keypoints, rng, 99)
    ranks = (draws < truths).sum(axis=0) + rng.random(truths.shape)
    for joint, axis in ((0, 2), (2, 0), (3, 2)):
        assert stats.kstest(ranks[:, joint, axis] / 100, "uniform").pvalue > 1e-3
    lifts = prior.lift(keypoints)
    np.testing.assert_allclose(draws.mean(axis=0), lifts.positions, atol=0.1)
    within = np.abs(truths - lifts.positions) < 1.645 * lifts.sd
    assert 0.87 < within.mean() < 0.95


@pytest.mark.parametrize("hidden", [(), (3,)])
def test_evidence_of_an_unknown_scale_is_the_integral_over_log_scale(hidden: tuple) -> None:
    prior = random_prior(noise=0.01)
    keypoints, _ = from_model(prior, 2, seed=4)
    keypoints[:, list(hidden)] = np.nan
    keypoints -= np.nanmean(keypoints, axis=1, keepdims=True)
    seen = [joint for joint in range(J) if joint not in hidden]
    d = 2 * len(seen) - 2
    mean = prior.means[0, seen] - prior.means[0, seen].mean(axis=0)
    size = np.sqrt((mean**2 @ [0.05, 1, 0.05]).sum())
    shown = keypoints[:, seen] - keypoints[:, seen].mean(axis=1, keepdims=True)
    medians = np.log(size / np.sqrt((shown**2 @ [0.1, 1]).sum(axis=1)))
    logs = np.linspace(-0.6, 0.6, 201)
    # p(y | u) = u^d p(u y), up to the position, which is flat.
    values = np.stack([d * u + prior.log_evidence(np.exp(u) * keypoints) for u in logs])
    values += stats.norm(medians, 0.1).logpdf(logs[:, None])
    expected = np.log(np.trapezoid(np.exp(values), logs, axis=0))
    evidence = prior.log_evidence(keypoints, unknown_scale=True)
    np.testing.assert_allclose(evidence, expected, atol=0.03)
    lifts = prior.lift(keypoints, unknown_scale=True)
    weights = np.exp(values - values.max(axis=0))[:, :, None, None]
    weights /= weights.sum(axis=0)
    of_scales = [prior.lift(np.exp(u) * keypoints) for u in logs]
    means = np.stack([part.positions for part in of_scales])
    squares = np.stack([part.sd**2 for part in of_scales]) + means**2
    mean = (weights * means).sum(axis=0)
    # Cells of probability below 1e-3 are left out, and Laplace's method is approximate.
    np.testing.assert_allclose(lifts.positions, mean, atol=0.01)
    sd = np.sqrt((weights * squares).sum(axis=0) - mean**2)
    np.testing.assert_allclose(lifts.sd, sd, atol=0.01, rtol=0.1)
    rng = np.random.default_rng(1)
    draws = prior.sample_lifts(keypoints, rng, 4000, unknown_scale=True)
    np.testing.assert_allclose(draws.std(axis=0), lifts.sd, atol=0.01, rtol=0.1)
    moved = keypoints + np.array([3.0, 1.0])
    draws = prior.sample_lifts(moved, rng, 4000, unknown_scale=True)
    expected = prior.lift(moved, unknown_scale=True).positions
    np.testing.assert_allclose(draws.mean(axis=0), expected, atol=0.02)
    scaled = prior.lift(1000 * keypoints, unknown_scale=True)
    np.testing.assert_allclose(scaled.positions, lifts.positions, atol=1e-6)
    np.testing.assert_allclose(scaled.scales, lifts.scales / 1000)


def test_perspective_is_linearised() -> None:
    prior = random_prior(azimuths=36, noise=0.005)
    rng = np.random.default_rng(2)
    _, seen = from_model(prior, 100, seed=7)
    # People are 2 m away, within about 10 degrees of the optical axis.
    seen[..., :2] += rng.uniform(-0.3, 0.3, (100, 1, 2)) - seen[..., :2].mean(axis=1, keepdims=True)
    keypoints = 500 * seen[..., :2] / (2.0 - seen[..., 2:])
    keypoints += rng.normal(size=keypoints.shape)
    errors = [
        np.linalg.norm(lifts.positions - seen, axis=-1).mean()
        for lifts in (
            prior.lift(keypoints, focal=500.0),
            prior.lift(keypoints, unknown_scale=True),
        )
    ]
    assert errors[0] < 0.7 * errors[1]


def test_em_recovers_the_covariance_up_to_a_heading() -> None:
    truth = random_prior()
    rng = np.random.default_rng(6)
    poses = truth.sample(rng, 1600)
    keypoints, seen = annotated(poses, any_views(1600, rng), 0.02, rng)
    few = [
        AnnotationPrior.fit(keypoints[:400], START, noise=0.02, iterations=count, azimuths=24)
        for count in (1, 4, 12)
    ]
    evidence = [prior.log_evidence(keypoints[1200:]).mean() for prior in few]
    assert evidence == sorted(evidence)
    fitted = AnnotationPrior.fit(keypoints, START, noise=0.02, iterations=25)
    fine = AnnotationPrior(truth.weights, truth.means, truth.covariances, truth.noise, fitted.views)
    errors = [
        np.linalg.norm(prior.lift(keypoints[:500]).positions - seen[:500], axis=-1).mean()
        for prior in (fitted, fine)
    ]
    assert errors[0] < 1.1 * errors[1]
    # Distances between joints are free of heading: their means and variances are recovered.
    first, second = np.triu_indices(J, 1)
    lengths = [
        np.linalg.norm(drawn[:, first] - drawn[:, second], axis=-1)
        for drawn in (fitted.sample(rng, 20_000), truth.sample(rng, 20_000))
    ]
    np.testing.assert_allclose(lengths[0].mean(axis=0), lengths[1].mean(axis=0), atol=0.015)
    np.testing.assert_allclose(lengths[0].std(axis=0), lengths[1].std(axis=0), atol=0.015)


def test_two_components_explain_two_kinds_of_poses_better() -> None:
    truth = random_prior(components=2)
    rng = np.random.default_rng(9)
    keypoints, _ = annotated(truth.sample(rng, 600), any_views(600, rng), 0.02, rng)
    keypoints[:40, 4] = np.nan
    priors = [
        AnnotationPrior.fit(keypoints[:400], START, noise=0.02, components=count, azimuths=24)
        for count in (1, 2)
    ]
    one, two = (prior.log_evidence(keypoints[400:]).mean() for prior in priors)
    assert two > one + 0.2


def test_a_prior_is_saved_and_loaded(tmp_path: Path) -> None:
    prior = random_prior(components=2)
    prior.save(tmp_path / "prior.npz")
    again = AnnotationPrior.load(tmp_path / "prior.npz")
    keypoints, _ = from_model(prior, 3, seed=0)
    assert np.array_equal(again.lift(keypoints).positions, prior.lift(keypoints).positions)
    (tmp_path / "bad.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"written by AnnotationPrior\.save"):
        AnnotationPrior.load(tmp_path / "bad.npz")


def bad_annotations() -> dict[str, tuple[np.ndarray, dict, str]]:
    rng = np.random.default_rng(0)
    poses = random_prior().sample(rng, 60)
    good, _ = annotated(poses, any_views(60, rng), 0.01, rng)
    infinite, unseen, lonely, point = good.copy(), good.copy(), good.copy(), good.copy()
    infinite[3, 2, 0] = np.inf
    unseen[:, 2] = np.nan
    lonely[7, 1:] = np.nan
    point[4] = 1.0
    views = np.stack([0.1 * rng.normal(size=60), rng.uniform(-0.17, 0.7, 60)], axis=1)
    views[::2, 0] += np.pi
    along, _ = annotated(poses, views, 0.01, rng)
    return {
        "joints": (good[:, :4], {}, r"annotations must have shape"),
        "none": (good[:0], {}, "at least one annotation"),
        "few": (good[:2], {"components": 3}, r"at least as many as components \(3\), got 2"),
        "infinite": (infinite, {}, "must be finite"),
        "unseen": (unseen, {}, "every joint at least once, got none of joint 2"),
        "lonely": (lonely, {}, "at least 2 joints each, got 1 in annotation 7"),
        "point": (point, {}, "all at one point in annotation 4"),
        "pixels": (200 * good, {}, "use unknown_scale=True"),
        "noise": (good, {"noise": 0.0}, "noise must be"),
        "elevations": (good, {"elevations": (1.0, 0.0)}, "elevations must be ordered"),
        "one direction": (along, {}, "one view direction only: the depth is not identifiable"),
    }


@pytest.mark.parametrize("case", list(bad_annotations()))
def test_bad_input_is_refused_in_one_sentence(case: str) -> None:
    keypoints, settings, message = bad_annotations()[case]
    with pytest.raises(ValueError, match=message):
        AnnotationPrior.fit(keypoints, START, **settings)


def test_a_joint_that_never_moves_is_no_problem() -> None:
    rng = np.random.default_rng(1)
    poses = np.repeat(START[None], 200, axis=0)
    keypoints, seen = annotated(poses, any_views(200, rng), 0.0, rng)
    lifts = AnnotationPrior.fit(keypoints, START).lift(keypoints)
    assert np.isfinite(lifts.positions).all()
    assert np.linalg.norm(lifts.positions - seen, axis=-1).mean() < 0.03


def test_salsa_is_covered_by_lifted_annotations(real_data: Path) -> None:
    shown, held_out = hold_out(salsa_pairs(real_data), SALSA_HELD_OUT)
    poses = ground_truth(shown)[0]
    frames = [dance_frames(motion) for motion in shown]
    drawn = draw_annotations(shown, 300, 1, frames=frames)
    prior = AnnotationPrior.fit(drawn.annotations, poses[choose_seed(poses)])
    lifts = prior.lift(drawn.annotations)
    aligned = align_rigidly(lifts.positions, drawn.positions)
    assert np.sqrt(((aligned - drawn.positions) ** 2).sum(axis=-1).mean()) < 0.095
    assert coverage(ground_truth(held_out, 100)[0], lifts.positions, "interaction") < 0.20
