from dataclasses import replace

import numpy as np
import pytest

from probmotion.data.synthetic.gaits import make_gait
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import ANKLES, HIPS, LIMBS, PERSON
from probmotion.lifting.linear_system import (
    Ankles,
    EstimatedDepths,
    LinearKeypoints,
    depth_rows,
    floor_rows,
    linear_system,
)
from probmotion.lifting.window_fit import Observed, lift_window
from probmotion.lifting.window_posterior import FLOOR_SPREAD, Height, WindowGaussian, WindowMode

CAMERA = LevelCamera(900.0, (500.0, 500.0), -0.1)
RAYS = np.repeat(CAMERA.axes[2:], 20, axis=0)


def observed(window_prior, noise: float = 4.0):
    """Return a walk 4 m away, and its keypoints."""
    walk = make_gait("walk", 1, frames=60).retarget(PERSON).positions[1::3]
    walk = walk - walk.mean(axis=(0, 1)) * [1.0, 0.0, 1.0]
    turned = walk @ vector_to_matrix(np.array([0.0, 0.8, 0.0])).T
    truth = turned + np.array([0.3, -1.2, -4.0])
    assert len(truth) == window_prior.frames
    return truth, Observed(CAMERA.project(truth), np.ones(truth.shape[:2]), noise)


def lift(window_prior, camera, seen, depth, **options):
    middle = np.median(seen.points, axis=1)
    return lift_window(window_prior, camera, seen, middle, depth, **options)


def test_a_likely_motion_is_found(window_prior):
    truth, seen = observed(window_prior)
    posterior = lift(window_prior, CAMERA, seen, np.full(20, 4.3))
    mean = posterior.mean(np.arange(20.0))
    error = (mean - mean[:, 8:9]) - (truth - truth[:, 8:9])  # about a hip
    assert np.linalg.norm(error, axis=-1).mean() < 0.08
    assert mean[:, 8, 2].mean() == pytest.approx(truth[:, 8, 2].mean(), rel=0.1)
    assert posterior.best.standardised.mean() < 2
    # The floor of the truth is 1.2 m below the camera.
    assert posterior.floor.mean == pytest.approx(-1.2, abs=0.06)


def test_the_spread_is_that_of_draws_of_visible_joints(window_prior):
    _, seen = observed(window_prior)
    weight = seen.weight.copy()
    weight[:, ANKLES] = 0
    hidden = lift(window_prior, CAMERA, replace(seen, weight=weight), np.full(20, 4.3))
    assert len(hidden.modes) > 1
    drawn = hidden.sample(np.random.default_rng(0), 2000, np.arange(20.0))
    about = drawn[:, :, LIMBS] - drawn[:, :, HIPS].mean(axis=2, keepdims=True)
    sd = np.sqrt(about.var(axis=0).sum(axis=-1))
    seen_sd = sd[:, ~np.isin(LIMBS, ANKLES)].mean()
    assert hidden.summary.spread == pytest.approx(seen_sd, rel=0.03)
    assert seen_sd < 0.9 * sd.mean()
    nobody = lift(window_prior, CAMERA, replace(seen, weight=0 * weight), np.full(20, 4.3))
    assert np.isnan(nobody.summary.spread)


def test_outliers_do_not_move_the_motion(window_prior):
    _, seen = observed(window_prior)
    points = seen.points.copy()
    points[4, 4] += 0.3
    points[11, 10] -= 0.2
    times, depth = np.arange(20.0), np.full(20, 4.3)
    clean = lift(window_prior, CAMERA, seen, depth).mean(times)
    broken = lift(window_prior, CAMERA, Observed(points, seen.weight, 4.0), depth)
    # At 4 m these outliers are 1.2 and .8 m.
    assert np.abs(broken.mean(times) - clean).max() < 0.3
    assert np.median(np.abs(broken.mean(times) - clean)) < 0.03


def depths(positions: np.ndarray) -> np.ndarray:
    """Return depths of arms and legs behind the middle of the hips."""
    depth = positions @ CAMERA.axes[2]
    return depth[:, LIMBS] - depth[:, HIPS].mean(axis=1, keepdims=True)


def test_estimated_depths_count_by_their_standard_deviations(window_prior):
    truth, seen = observed(window_prior)

    def error(sd: float, depth: np.ndarray) -> float:
        known = replace(seen, depths=EstimatedDepths(depth, np.full(depth.shape, sd), RAYS, 0.0))
        posterior = lift(window_prior, CAMERA, known, np.full(20, 4.3))
        return np.abs(depths(posterior.mean(np.arange(20.0))) - depths(truth)).mean()

    alone = lift(window_prior, CAMERA, seen, np.full(20, 4.3))
    without = np.abs(depths(alone.mean(np.arange(20.0))) - depths(truth)).mean()
    assert error(0.01, depths(truth)) < 0.4 * without
    wrong = depths(truth) + 0.3
    assert error(np.inf, wrong) == pytest.approx(without)
    assert error(0.01, wrong) > 2 * without


def test_scores_of_windows_are_normalised_over_depths(window_prior):
    """Depths with other standard deviations can be compared, as those of exchanged sides."""
    truth, seen = observed(window_prior)

    def score(sd: float) -> float:
        depth = depths(truth)
        known = replace(seen, depths=EstimatedDepths(depth, np.full(depth.shape, sd), RAYS, 0.0))
        return lift(window_prior, CAMERA, known, np.full(20, 4.3), candidates=1).best.score

    assert score(1e6) - score(1e7) == pytest.approx(20 * len(LIMBS) * np.log(10))


def test_rows_of_depths_are_those_of_the_motion(window_prior):
    truth, seen = observed(window_prior)
    rng = np.random.default_rng(0)
    shape = (len(truth), len(LIMBS))
    noisy = depths(truth) + 0.05 * rng.standard_normal(shape)
    given = EstimatedDepths(noisy, rng.uniform(0.05, 0.2, shape), RAYS, 0.0)
    known = replace(seen, depths=given)
    posterior = lift(window_prior, CAMERA, known, np.full(20, 4.3), candidates=1)
    mode = posterior.best
    gaussian = WindowGaussian(window_prior, mode.component, mode.yaw, mode.scale)
    rows, residual = depth_rows(gaussian, given)
    r = rows.shape[1]
    at = np.arange(20.0)

    def off(z: np.ndarray) -> np.ndarray:
        moved = gaussian.positions(window_prior, mode.component, z[None], at)[0] + posterior.origin
        return ((given.values - depths(moved)) / given.sd).ravel()

    assert np.allclose(residual - rows @ mode.mean[:r], off(mode.mean))
    step = np.zeros(len(mode.mean))
    step[3] = 1.0
    assert np.allclose(off(mode.mean) - off(mode.mean + step), rows[:, 3])


def test_rows_of_ankles_are_those_of_the_motion(window_prior):
    _, seen = observed(window_prior)
    mode = lift(window_prior, CAMERA, seen, np.full(20, 4.3), candidates=1).best
    gaussian = WindowGaussian(window_prior, mode.component, mode.yaw, mode.scale)
    z = mode.mean + 0.3 * np.random.default_rng(0).standard_normal(mode.mean.shape)
    moved = gaussian.positions(window_prior, mode.component, z[None], np.arange(20.0))[0]
    r = len(gaussian.deviation)
    moved[..., 1] -= FLOOR_SPREAD * z[r]
    feet = moved[:, ANKLES]
    velocity = (feet[1:] - feet[:-1]) * window_prior.fps
    height = (feet[1:, :, 1] + feet[:-1, :, 1]) / 2
    square = (velocity**2).sum(axis=-1) / 0.12**2 + ((height - 0.075) / 0.015) ** 2
    assert Ankles(gaussian, window_prior.fps).squares(z[:r]) == pytest.approx(square)


def test_the_probability_of_standing_is_the_precision_of_the_factor():
    squares = np.array([[0.0, 0.3], [4.0, 9.0]])
    # A precision is minus twice the derivative of the log factor by the square.
    slopes = [Ankles.log_factor(row + 1e-6) - Ankles.log_factor(row) for row in squares]
    standing = Ankles.standing(squares).sum(axis=1)
    assert np.array(slopes) == pytest.approx(-0.5e-6 * standing, rel=1e-4)
    assert Ankles.standing(np.array([0.0, 900.0])) == pytest.approx([90 / 91, 0.0])


def test_standing_feet_are_held_and_others_are_not(window_prior, monkeypatch):
    walk, _ = observed(window_prior)
    lowest = walk[:, ANKLES, 1].max(axis=1).argmin()
    still = np.repeat(walk[lowest : lowest + 1], len(walk), axis=0)
    noise = 8 / CAMERA.focal * np.random.default_rng(0).standard_normal((*walk.shape[:2], 2))

    def speed(truth: np.ndarray) -> float:
        seen = Observed(CAMERA.project(truth) + noise, np.ones(truth.shape[:2]), 8.0)
        positions = lift(window_prior, CAMERA, seen, np.full(20, 4.3)).mean(np.arange(20.0))
        steps = np.diff(positions[:, ANKLES], axis=0) * window_prior.fps
        return float(np.median(np.linalg.norm(steps, axis=-1)))

    held, swung = speed(still), speed(walk)
    monkeypatch.setattr(Ankles, "standing", staticmethod(np.zeros_like))
    assert held < 0.5 * speed(still)
    assert swung == pytest.approx(speed(walk), rel=0.1)


def test_standing_feet_count_for_the_score(window_prior, monkeypatch):
    monkeypatch.setattr(window_prior, "scales", np.ones(1))
    _, seen = observed(window_prior)

    def mode() -> WindowMode:
        return lift(window_prior, CAMERA, seen, np.full(20, 4.3), candidates=1).best

    usual = mode()
    gaussian = WindowGaussian(window_prior, usual.component, usual.yaw, usual.scale)
    ankles = Ankles(gaussian, window_prior.fps)
    factor = ankles.log_factor(ankles.squares(usual.mean[: len(gaussian.deviation)]))
    monkeypatch.setattr(Ankles, "log_factor", staticmethod(lambda squares: 0.0))
    assert factor > 10
    assert usual.score - mode().score == pytest.approx(factor)


def test_a_known_floor_counts_by_its_standard_deviation(window_prior):
    _, seen = observed(window_prior)

    def floor(height: Height | None) -> Height:
        known = replace(seen, floor=height)
        return lift(window_prior, CAMERA, known, np.full(20, 4.3)).floor

    alone, exact = floor(None), floor(Height(-1.1, 1e-4))
    assert exact.mean == pytest.approx(-1.1, abs=1e-3)
    assert exact.sd < 1e-3 < alone.sd
    assert floor(Height(-1.1, 1e3)) == pytest.approx(alone, rel=1e-3)


def test_the_posterior_at_a_scale_is_that_of_a_system_with_its_deviations(window_prior):
    truth, seen = observed(window_prior)
    seen.weight[3:7, 2:9] = 0.0
    visible = seen.weight > 0
    matrix, target = CAMERA.linearised(truth, seen.points)
    weight = np.full(visible.sum(), 1e4)
    keypoints = LinearKeypoints(matrix[visible], target[visible], weight, np.nonzero(visible))
    force = np.random.default_rng(0).standard_normal(truth.shape)
    held = np.random.default_rng(1).random((len(truth) - 1, 2))
    first, other = (WindowGaussian(window_prior, 2, 5, scale) for scale in (1.0, 2.0))
    solutions = []
    for gaussian in (first, other):
        given = EstimatedDepths(depths(truth), np.full((20, 12), 0.1), RAYS, 0.0)
        floor = floor_rows(gaussian, Height(-1.2, 0.1), -1.3)
        rows = zip(depth_rows(gaussian, given), floor, strict=True)
        others = tuple(map(np.concatenate, rows))
        standing = Ankles(gaussian, window_prior.fps), held
        system = linear_system(window_prior, gaussian, keypoints, standing, others, truth, force)
        solutions.append(system.solution(other.deviation / gaussian.deviation))
    for scaled, built in zip(*solutions, strict=True):
        assert np.allclose(scaled, built)
    # Of the last system: ankles count by the probabilities that they stand.
    rows = slice(system.keypoints, system.robust)
    z = solutions[1].mean
    off = (system.residual[rows] - system.design[rows] @ z).reshape(-1, 4)
    squares = standing[0].squares(z[: len(other.deviation)])
    assert (off**2).sum(axis=1) == pytest.approx((held * squares).ravel())
    leverage = solutions[0].leverage
    design = solutions[0].design
    covariance = np.linalg.inv(solutions[0].lower @ solutions[0].lower.T)
    assert leverage == pytest.approx(np.diag(design @ covariance @ design.T).reshape(-1, 2).sum(1))


def test_draws_have_the_moments_of_the_modes(window_prior):
    _, seen = observed(window_prior, noise=4.0)
    posterior = lift(window_prior, CAMERA, seen, np.full(20, 4.0), candidates=1)
    times = np.arange(20.0)
    draws = posterior.sample(np.random.default_rng(0), 4000, times)
    spread = draws.std(axis=0)
    assert np.abs(draws.mean(axis=0) - posterior.mean(times)).max() < 5 * spread.max() / 63
    # More noise, more spread.
    wide = lift(window_prior, CAMERA, observed(window_prior, 40.0)[1], np.full(20, 4.0))
    assert wide.sample(np.random.default_rng(0), 400, times).std(axis=0).mean() > spread.mean()


def test_postures_unlike_the_clips_have_wider_intervals(window_prior, monkeypatch):
    monkeypatch.setattr(window_prior, "scales", np.array([5.0]))
    truth, seen = observed(window_prior, noise=4.0)
    posterior = lift(window_prior, CAMERA, seen, np.full(20, 4.0), candidates=1)
    mode, part = posterior.best, window_prior.component(posterior.best.component)
    square = [
        mode.scale * z**2
        for z, frequency, ground in zip(mode.mean, part.frequency, part.ground, strict=False)
        if frequency == 0 and not ground
    ]
    assert np.mean(square) > 1.5
    assert mode.inflation == pytest.approx(1.7 * np.sqrt(np.mean(square)))
    for disagreement, factor in ((0.005, 1.0), (0.009, 2.25), (0.1, 3.0)):
        unknown = np.full((len(truth), len(LIMBS)), np.inf)
        given = replace(seen, depths=EstimatedDepths(depths(truth), unknown, RAYS, disagreement))
        wider = lift(window_prior, CAMERA, given, np.full(20, 4.0), candidates=1).best
        assert wider.inflation == pytest.approx(factor * mode.inflation)

    def spread(inflation: float) -> float:
        changed = replace(posterior, modes=(replace(mode, inflation=inflation),))
        return changed.sample(np.random.default_rng(0), 50, np.arange(20.0)).std(axis=0).mean()

    assert spread(4.0) == pytest.approx(2 * spread(2.0))


def test_draws_continue_earlier_ones(window_prior):
    _, seen = observed(window_prior, noise=4.0)
    posterior = lift(window_prior, CAMERA, seen, np.full(20, 4.0))
    times, joined = np.arange(20.0), np.array([3.0, 4.0])
    rng = np.random.default_rng(0)
    earlier = posterior.sample(rng, 50, joined)
    draws = posterior.sample(rng, 50, times, joined, earlier)
    assert np.abs(draws[:, 3:5] - earlier).mean() < 0.015
    free = posterior.sample(rng, 50, times)
    assert np.abs(free[:, 3:5] - earlier).mean() > 0.015
    assert draws[:, 15:].std(axis=0).mean() > 0.5 * free[:, 15:].std(axis=0).mean()
