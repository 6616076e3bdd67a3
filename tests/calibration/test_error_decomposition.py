"""Error decomposition against closed forms for a Gaussian prior.

A sampler step is then linear, and the covariance after T steps a product of small matrices.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from probmotion import Keypoints2D, Motion, MotionPosterior, NoiseSchedule, UnsupportedPosterior
from probmotion.calibration.error_decomposition import decompose_error
from probmotion.calibration.error_measures import ErrorMeasures
from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.problem import Problem
from probmotion.problems import load_problem
from probmotion.samplers.diffusion.guidance import WeightedTriangulation

JOINTS = 60
BEFORE = ["remainder", "discretisation", "integrator"]
decompose = partial(decompose_error, progress=False)


@dataclass(frozen=True, eq=False)
class Points:
    """Prior of independent joints N(mean_j, covariance), metres, in one frame."""

    mean: np.ndarray
    covariance: np.ndarray
    fault: float = 1.0
    scale: float = 1.0
    frames: int = 1
    fps: float = 20.0

    @property
    def skeleton(self):
        return Skeleton([f"joint-{j}" for j in range(len(self.mean))], [-1] * len(self.mean))

    @property
    def dim(self):
        return self.mean.size

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 1, *self.mean.shape)

    def sample(self, rng, n):
        root = np.linalg.cholesky(self.covariance)
        return self.mean + rng.standard_normal((n, 1, *self.mean.shape)) @ root.T

    def log_density(self, positions):
        raise NotImplementedError

    def given(self, likelihood):
        axes, target, precision = likelihood.linear()
        information = np.linalg.inv(self.covariance) + precision.flat[0] * axes[0].T @ axes[0]
        covariance = np.linalg.inv(information)
        observed = precision.flat[0] * target[0, 0] @ axes[0]
        mean = (self.mean @ np.linalg.inv(self.covariance) + observed) @ covariance
        return replace(self, mean=mean, covariance=covariance)

    def exact_posterior(self, likelihood):
        return self if likelihood is None else self.given(likelihood)

    def denoise_motion(self, x_t, alpha_bar):
        return self._denoise(np.eye(3), x_t, alpha_bar)

    def denoise(self, x_t, alpha_bar, cameras):
        views = [self._denoise(P, x_t[:, v], alpha_bar) for v, P in enumerate(cameras.image_axes)]
        return self.fault * np.stack(views, axis=1)

    def view_covariance(self, x_t, alpha_bar, cameras):
        views = [P @ self.covariance @ P.T for P in cameras.image_axes]
        matrices = [S - math.sqrt(alpha_bar) * S @ gain(S, alpha_bar) for S in views]
        return lambda vectors: np.stack(
            [vectors[:, v] @ matrix for v, matrix in enumerate(matrices)], axis=1
        )

    def _denoise(self, P, x_t, alpha_bar):
        mean, S = self.mean @ P.T, P @ self.covariance @ P.T
        return mean + (x_t - math.sqrt(alpha_bar) * mean) @ gain(S, alpha_bar)


def gain(S, alpha_bar):
    """Return G with E[x₀ | x_t] = x_t G for x₀ ~ N(0, S)."""
    noisy = alpha_bar * S + (1 - alpha_bar) * np.eye(len(S))
    return math.sqrt(alpha_bar) * np.linalg.solve(noisy, S)


def centred(*variances):
    return Points(np.zeros((JOINTS, 3)), np.diag(variances))


def problem_of(prior, likelihood=None):
    return Problem("points", "joints of one Gaussian", MotionPosterior(prior, likelihood))


def covariance_after(S, T, views=None, shared_noise=True):
    """Return the covariance of a joint after T steps of `ancestral3d`, or of `mas` in views."""
    schedule = NoiseSchedule.cosine(T)
    axes = np.eye(3)[None] if views is None else views
    inverse = np.linalg.inv(np.einsum("vcx,vcy->xy", axes, axes))
    rows = np.concatenate(list(axes))
    # The state is X, or all views side by side; `embed` maps a motion to it.
    embed = np.eye(3) if shared_noise else rows

    def estimate(alpha_bar):
        blocks = [gain(P @ S @ P.T, alpha_bar).T for P in axes]
        if shared_noise:
            parts = [P.T @ G @ P for P, G in zip(axes, blocks, strict=True)]
            return inverse @ np.sum(parts, axis=0)
        parts = [P.T @ G for P, G in zip(axes, blocks, strict=True)]
        return inverse @ np.concatenate(parts, axis=1)

    covariance = np.eye(len(embed))
    for t in range(T, 1, -1):
        step = schedule.posterior(t)
        transition = step.clean * embed @ estimate(schedule.alpha_bar[t])
        transition = transition + step.noisy * np.eye(len(embed))
        covariance = transition @ covariance @ transition.T + step.deviation**2 * np.eye(len(embed))
    last = estimate(schedule.alpha_bar[1])
    return last @ covariance @ last.T


def ring(n_views, elevation):
    return Cameras.ring(n_views, elevation=elevation).image_axes


def log_trace(covariance, S):
    return math.log(np.trace(covariance) / np.trace(S))


def means(decomposition, measure):
    table = decomposition.table()
    return table[table["measure"] == measure].set_index("part")["mean"]


def test_isotropic_prior_shrinks_by_the_integrator_alone():
    # The variance is .955 at T = 100 and .995 at 1000; with independent noise its limit is M⁻¹.
    S, T = np.eye(3), 30
    assert log_trace(covariance_after(S, 100), S) == pytest.approx(math.log(0.955), abs=1e-3)
    assert log_trace(covariance_after(S, 1000), S) == pytest.approx(math.log(0.995), abs=1e-3)
    result = decompose(problem_of(centred(1, 1, 1)), steps=T, seeds=2, draws=100)
    spread = means(result, "spread")
    error = 4 * math.sqrt(2) * math.sqrt(2 / (100 * 2 * JOINTS * 3))
    coarse = log_trace(covariance_after(S, T), S)
    assert spread["remainder"] == pytest.approx(0, abs=error)
    assert abs(spread["discretisation"]) < abs(spread["integrator"]) / 2
    first_order = spread["remainder"] + spread["discretisation"] + spread["integrator"]
    assert first_order == pytest.approx(coarse, abs=error)
    assert coarse < -0.1
    # The denoisers of the views then agree with the 3D denoiser.
    assert spread["single view"] == pytest.approx(0, abs=1e-10)
    views = ring(5, math.pi / 16)
    coarse, here, fine = (covariance_after(S, T, views, shared_noise=False) for T in (200, T, 400))
    limit = np.linalg.inv(np.einsum("vcx,vcy->xy", views, views))
    np.testing.assert_allclose(2 * fine - coarse, limit, atol=3e-3)
    sharing = log_trace(here, covariance_after(S, T))
    assert spread["independent noise"] == pytest.approx(sharing, abs=error)
    assert spread["whole"] == pytest.approx(log_trace(here, S), abs=error)
    assert means(result, "mean").abs().max() < 0.01


@pytest.mark.parametrize(
    ("true", "elevation", "drawn"),
    [
        # Elevation mixes the vertical and horizontal directions.
        ((1, 0.05, 1), math.radians(15), (0.835, 0.114, 0.835)),
        # Directions of large variance shrink and others inflate, also in level views.
        ((0.01, 0.01, 1), 1e-9, (0.055, 0.01, 0.675)),
    ],
)
def test_single_view_conditioning_shrinks_large_and_inflates_small_directions(
    true, elevation, drawn
):
    prior = centred(*true)
    S, T = prior.covariance, 15
    exact = log_trace(covariance_after(S, 60, ring(5, elevation)), covariance_after(S, 60))
    assert exact == pytest.approx(log_trace(np.diag(drawn), S), abs=0.02)
    result = decompose(
        problem_of(prior), steps=T, seeds=2, draws=100, settings={"elevation": elevation}
    )
    after = covariance_after(S, T, ring(5, elevation))
    before = covariance_after(S, T)
    spread = means(result, "spread")
    assert spread["single view"] == pytest.approx(log_trace(after, before), abs=0.01)
    # The directions of small variance mix joints, and axes of equal variance.
    small = ErrorMeasures(problem_of(prior)).small.reshape(JOINTS, 3, -1)
    inflated, right = (
        np.einsum("jxd,xy,jyd->d", small, covariance, small) for covariance in (after, before)
    )
    expected = np.log(inflated / right).mean()
    assert means(result, "small")["single view"] == pytest.approx(expected, abs=0.03)
    assert expected > 0.3


def test_parts_add_up_exactly_seed_by_seed():
    result = decompose(problem_of(centred(1, 0.3, 0.1)), steps=5, seeds=3, draws=20)
    assert result.parts == [*BEFORE, "single view", "independent noise"]
    table = result.table()
    assert list(table.columns) == ["setting", "measure", "part", "mean", "low", "high"]
    assert set(table["setting"]) == {"points, V = 5, T = 5"}
    for measure, links in result.values.items():
        total_error = links["independent noise"] - links["exact"]
        parts = np.sum(list(result.differences(measure).values()), axis=0)
        np.testing.assert_allclose(parts, total_error, atol=1e-12)
        rows = table[table["measure"] == measure].set_index("part")
        np.testing.assert_allclose(rows.loc[result.parts, "mean"].sum(), rows.loc["whole", "mean"])
        assert (rows["low"] < rows["high"]).all()
    sentences = {line.partition(":")[0]: line for line in result.findings}
    assert "integrator -" in sentences["spread"]
    assert sentences["mean"].startswith("mean: total not significant; not significant: ")


def test_measures_of_shifted_and_scaled_draws():
    problem = problem_of(centred(1, 0.3, 0.1))
    measures = ErrorMeasures(problem)
    exact = problem.reference(11, 400)
    total = 1.4 * JOINTS
    floor = measures.of(exact, seed=2)
    shift = np.random.default_rng(0).normal(size=exact.shape[1:])
    shifted = measures.of(exact + shift, seed=2)
    expected_shift = float((shift**2).sum()) / total
    # W₂² of a shift along a direction is its square; the mean over directions is ‖shift‖² / D.
    for measure in ("mean", "distance"):
        assert shifted[measure] - floor[measure] == pytest.approx(expected_shift, rel=0.15)
    stretched = measures.of(1.5 * exact, seed=2)
    for measure in ("spread", "small"):
        assert shifted[measure] == pytest.approx(floor[measure], abs=1e-9)
        assert stretched[measure] - floor[measure] == pytest.approx(2 * math.log(1.5), abs=1e-9)
    # For Gaussians, W₂² is (1.5 σ − σ)² along every direction.
    assert stretched["distance"] - floor["distance"] == pytest.approx(0.25, rel=0.1)
    assert abs(stretched["mean"]) < 0.005
    # The small directions contain the last 5 % of the variance, on the axis of variance .1.
    assert 0.048 * total < measures.small_variances.sum() < 0.051 * total
    small = measures.small.reshape(JOINTS, 3, -1)
    assert (small[:, 2] ** 2).sum() > 0.98 * small.shape[-1]


def test_the_network_part_is_zero_for_an_exact_denoiser_only():
    prior = centred(1, 0.3, 0.1)
    run = partial(decompose, problem_of(prior), steps=10, seeds=2, draws=30)
    right, wrong = run(learnt=prior), run(learnt=replace(prior, fault=0.8))
    for measure in right.values:
        np.testing.assert_array_equal(right.differences(measure)["network"], 0)
        for part in right.parts[:-1]:
            np.testing.assert_array_equal(
                right.differences(measure)[part], wrong.differences(measure)[part]
            )
    assert means(wrong, "spread")["network"] < -0.3
    assert run(shared_noise=True).parts == [*BEFORE, "single view"]


def observed(prior, noise):
    drawn = prior.sample(np.random.default_rng(1), 1)[0]
    motion = Motion(drawn, prior.skeleton, prior.fps)
    return Keypoints2D.observe(motion, Cameras.ring(1, elevation=0.3), noise, seed=0)


def test_guidance():
    prior = centred(1, 0.3, 0.1)
    run = partial(decompose, steps=10, seeds=2, draws=30)
    idle = run(problem_of(prior, observed(prior, 1e5)), learnt=prior)
    assert idle.parts == [*BEFORE, "single view", "guidance", "network"]
    for measure in idle.values:
        np.testing.assert_allclose(idle.differences(measure)["guidance"], 0, atol=1e-6)
        np.testing.assert_array_equal(idle.differences(measure)["network"], 0)
    sharp = problem_of(prior, observed(prior, 0.05))
    result = run(sharp)
    assert abs(means(result, "mean")["floor"]) < 0.02
    assert any("no learnt denoiser" in note for note in result.notes)
    # Treating the observation as one more view is biased.
    naive = run(sharp, settings={"guidance": WeightedTriangulation()})
    row = naive.table().set_index(["measure", "part"]).loc[("mean", "guidance")]
    assert row["low"] > 10 * means(result, "mean")["guidance"] > 0
    for part in (*BEFORE, "single view"):
        np.testing.assert_array_equal(
            naive.differences("mean")[part], result.differences("mean")[part]
        )


def test_interrupted_runs_resume(tmp_path):
    prior = centred(1, 0.3, 0.1)
    run = partial(decompose, problem_of(prior), steps=4, seeds=2, draws=12)
    uninterrupted = run(out=tmp_path / "uninterrupted")
    calls, original = [], ErrorMeasures.of

    def stop_at_the_sixth(self, positions, seed):
        calls.append(seed)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return original(self, positions, seed)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ErrorMeasures, "of", stop_at_the_sixth)
        with pytest.raises(KeyboardInterrupt):
            run(out=tmp_path / "parts")
        resumed = run(out=tmp_path / "parts")
    assert len(calls) == 6 + 12 - 5
    assert resumed.table().equals(uninterrupted.table())
    csv = [path.read_text() for path in tmp_path.rglob("decompose_error.csv")]
    assert len(csv) == 2
    assert len(set(csv)) == 1
    with pytest.raises(ValueError, match="out must be a new folder"):
        decompose(problem_of(prior), steps=5, seeds=2, draws=12, out=tmp_path / "parts")


def test_gaits_have_a_manifold_measure_and_a_plot(tmp_path):
    problem = load_problem("gait", frames=4, components=3)
    result = decompose(problem, steps=8, seeds=2, draws=40)
    assert list(result.values) == ["spread", "small", "off", "mean", "distance"]
    rows = result.table().set_index(["measure", "part"]).loc["off"]
    assert abs(rows.loc["floor", "mean"]) < 0.1
    assert rows.loc["integrator", "high"] < 0
    assert rows.loc["single view", "low"] > 0
    path = result.plot(tmp_path / "budget.png")
    assert path.read_bytes().startswith(b"\x89PNG")


class NoDensity:
    """Prior without density or denoiser."""

    skeleton, frames, fps, dim = centred(1, 1, 1).skeleton, 1, 20.0, 3 * JOINTS

    def motion(self, theta):
        return theta.reshape(*theta.shape[:-1], 1, JOINTS, 3)


def test_invalid_arguments():
    prior = centred(1, 1, 1)
    problem = problem_of(prior)
    with_data = problem_of(prior, observed(prior, 0.1))
    for case, options, message in (
        (problem, {"seeds": 1}, "seeds must be an integer of at least 2, got 1"),
        (problem, {"draws": 3}, "draws must be an integer of at least 10, got 3"),
        (problem, {"settings": {"perspective": True}}, "settings must be among .*, got 'perspec"),
        (problem, {"learnt": replace(prior, mean=np.zeros((3, 3)))}, "got 1 frames and 3 joints"),
        (problem_of(NoDensity()), {}, "problem must have an exact posterior, got 'points'"),
        (with_data, {"shared_noise": False}, "shared_noise must be True with observations"),
    ):
        with pytest.raises(ValueError, match=message):
            decompose(case, **options)
    with pytest.raises(UnsupportedPosterior, match="a prior with Denoises2D, got NoDensity"):
        decompose(problem, learnt=NoDensity())
