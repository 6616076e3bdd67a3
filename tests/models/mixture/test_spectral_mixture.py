"""Spectral mixture: coordinates, gradients, resampling, storage and validation."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from probmotion import Cameras, MotionPosterior
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.files import read_arrays
from probmotion.models.mixture import SpectralMixtureMotion
from probmotion.posteriors import protocols


def test_coordinates_are_whitened_by_the_first_component(prior, dense):
    motions = prior.sample(np.random.default_rng(0), 3)
    theta = prior.theta(motions)
    np.testing.assert_allclose(prior.motion(theta), motions, atol=1e-12)
    mean, covariance = dense.means[0], dense.covariances[0]
    np.testing.assert_allclose(prior.motion(np.zeros(60)).reshape(-1), mean, atol=1e-12)
    factor = prior.motion(np.eye(60)).reshape(60, 60) - mean
    np.testing.assert_allclose(factor.T @ factor, covariance, atol=1e-12)
    # The densities of θ and X differ by the volume of the map.
    volume = np.linalg.slogdet(factor)[1]
    expected = dense.log_density(motions.reshape(3, -1)) + volume
    np.testing.assert_allclose(prior.log_density(theta), expected, rtol=1e-10)
    np.testing.assert_array_equal(prior.initial(np.random.default_rng(0), 3), prior.theta(motions))


def test_gradients_match_finite_differences(prior, differentiable):
    theta = prior.initial(np.random.default_rng(1), 1)[0]
    for function, at in ((prior.log_density, theta), (prior.log_prior, prior.motion(theta))):
        steps = 1e-5 * np.eye(60).reshape(60, *at.shape)
        expected = (function(at + steps) - function(at - steps)) / 2e-5
        gradient = differentiable.gradient(function, at).reshape(-1)
        np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_libraries_agree(prior, make_likelihood, differentiable):
    posterior = prior.exact_posterior(make_likelihood("one view with gaps"))
    theta = prior.initial(np.random.default_rng(1), 2)
    motions = prior.motion(theta)
    for function, at in (
        (prior.log_density, theta),
        (prior.log_prior, motions),
        (posterior.log_density, motions),
    ):
        values = differentiable.compiled(function)(differentiable.array(at))
        differentiable.assert_close(values, function(at))


def test_single_precision_values_are_close(prior):
    import torch

    theta = prior.initial(np.random.default_rng(2), 4)
    values = prior.log_density(torch.tensor(theta, dtype=torch.float32))
    assert values.dtype == torch.float32
    np.testing.assert_allclose(values.numpy(), prior.log_density(theta), atol=1e-3)


def test_implements_the_prior_protocols(prior, dense):
    for name in (
        "MotionPrior", "Samplable", "HasLogDensity", "HasStyles", "Denoises2D", "Denoises3D",
        "DenoiserCovariance2D", "DenoiserCovariance3D", "HasExactPosterior",
    ):  # fmt: skip
        assert isinstance(prior, getattr(protocols, name)), name
    posterior = MotionPosterior(prior)
    assert (posterior.frames, posterior.fps, posterior.dim) == (5, 10.0, 60)
    assert prior.styles == ("component-0", "component-1")
    np.testing.assert_allclose(prior.mean().reshape(-1), dense.moments()[0], atol=1e-12)
    # The scale is the root mean square of all coordinates.
    mean, covariance = dense.moments()
    assert prior.scale == pytest.approx(np.sqrt((mean @ mean + np.trace(covariance)) / 60))


def pose_variance(prior):
    """Return the variance of coordinates around the mean motion, without the ground position."""
    variances = prior.variances.copy()
    variances[:, 0, :2] = 0
    return variances.sum(axis=(1, 2)) / prior.frames


@pytest.mark.parametrize(
    ("frames", "fps", "tolerance"),
    [(5, 10.0, 1e-12), (10, 10.0, 0.2), (40, 10.0, 0.3), (10, 20.0, 0.1), (60, 120.0, 0.1)],
)
def test_resampling_keeps_the_variance_of_positions(prior, frames, fps, tolerance):
    """Exact at the same frequencies; the variances between frequencies 0 and 1 are those of 1."""
    other = prior.resampled(frames, fps)
    assert (other.frames, other.fps, other.dim) == (frames, fps, 12 * frames)
    np.testing.assert_allclose(pose_variance(other), pose_variance(prior), rtol=tolerance)
    # The ground position keeps its deviation, and the mean motion its velocity.
    ground = other.sample(np.random.default_rng(0), 4000).mean(axis=(1, 2))[:, [0, 2]]
    np.testing.assert_allclose(ground.std(axis=0), 0.3, rtol=0.06)
    (start, end), duration = other.motion(np.zeros(other.dim))[[0, -1]].mean(axis=1), frames - 1
    np.testing.assert_allclose((end - start)[[0, 2]] * fps / duration, prior.velocities[0])


def test_resampling_there_and_back(prior):
    assert prior.resampled(5) is prior
    assert prior.resampled(5, 10.0) is prior
    for frames, fps in ((10, 20.0), (10, 10.0), (15, 30.0)):
        back = prior.resampled(frames, fps).resampled(5, 10.0)
        np.testing.assert_allclose(back.variances, prior.variances, rtol=1e-12)
        np.testing.assert_array_equal(back.band, prior.band)


def test_resampled_density_is_normalised(prior, make_dense):
    other = prior.resampled(3, 20.0)
    motions = other.sample(np.random.default_rng(0), 3)
    expected = make_dense(other).log_density(motions.reshape(3, -1))
    np.testing.assert_allclose(other.log_prior(motions), expected, rtol=1e-10)


def test_save_and_load(make_prior, tmp_path):
    prior = make_prior(card={"clips": 3})
    prior.save(tmp_path / "prior.npz")
    back = SpectralMixtureMotion.load(tmp_path / "prior.npz")
    for name in ("poses", "velocities", "directions", "variances"):
        got, wanted = getattr(back, name), getattr(prior, name)
        assert got.dtype == np.float64
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())
    for name in ("band", "weights", "scales", "scale_weights"):
        np.testing.assert_array_equal(getattr(back, name), getattr(prior, name))
    for name in ("skeleton", "fps", "ground", "azimuths", "card"):
        assert getattr(back, name) == getattr(prior, name)
    V = back.directions
    np.testing.assert_allclose(V.swapaxes(2, 3) @ V, np.tile(np.eye(12), (2, 4, 1, 1)), atol=1e-12)
    np.testing.assert_array_equal(V[:, 0, :, :2], prior.directions[:, 0, :, :2])
    motions = prior.sample(np.random.default_rng(1), 3)
    np.testing.assert_allclose(back.log_prior(motions), prior.log_prior(motions), atol=1e-2)


def test_shipped_prior_fits_synthetic_walks():
    """Walks are far more probable than the same walks with shuffled frames."""
    prior = SpectralMixtureMotion.load().resampled(30)
    walk = synthetic_walks(1, seconds=1.0, fps=prior.fps)[0].retarget(prior.skeleton)
    positions = walk.centred().positions
    shuffled = positions[np.random.default_rng(0).permutation(30)]
    values = prior.log_prior(np.stack([positions, shuffled]))
    assert values[0] > values[1] + 1000


def test_unreadable_files_are_rejected(prior, tmp_path):
    text, other, old = (tmp_path / name for name in ("text.npz", "other.npz", "old.npz"))
    text.write_text("no archive")
    np.savez(other, positions=np.zeros(3))
    np.savez(old, **{name: getattr(prior, name) for name in ("poses", "band")}, header="{}")
    for path in (text, other, old):
        with pytest.raises(ValueError, match=f"written by .*save, got {path.name}"):
            SpectralMixtureMotion.load(path)
    with pytest.raises(
        FileNotFoundError, match=r"must be a file or one of .*, got 'no-such-prior'"
    ):
        SpectralMixtureMotion.load("no-such-prior")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("directions", np.inf, "directions must be finite"),  # LAPACK would not end
        ("directions", 1e30, "directions must have orthonormal columns"),
        ("poses", 1e200, "scale must be a finite number"),
        ("band", np.float64(0), "band has the type float64"),
        ("ground", 1e308, "Numerical result out of range"),
        ("format", 0, "format 0: fit and save the prior again"),
    ],
)
def test_damaged_files_are_rejected(name, value, message, prior, tmp_path):
    path = tmp_path / "prior.npz"
    prior.save(path)
    stored = read_arrays(path)
    if name in stored:
        stored[name] = stored[name].astype(np.float64 if value else type(value))
        stored[name].flat[-1] = value
    else:
        stored["header"] = np.array(json.dumps(json.loads(str(stored["header"])) | {name: value}))
    np.savez(path, **stored)
    with pytest.raises(ValueError, match=rf"written by .*save, got prior.npz \(.*{message}"):
        SpectralMixtureMotion.load(path)


def test_pickling_drops_cached_posteriors(prior, make_likelihood):
    likelihood = make_likelihood("joints")
    mean = prior.exact_posterior(likelihood).mean()
    assert prior.exact_posterior(likelihood) is prior.exact_posterior(likelihood)
    copy = pickle.loads(pickle.dumps(prior))
    np.testing.assert_array_equal(copy.exact_posterior(likelihood).mean(), mean)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": np.zeros((2, 3, 3))}, r"poses must have shape \(K, 4, 3\)"),
        ({"velocities": np.zeros((2, 3))}, r"velocities must have shape \(2, 2\)"),
        ({"directions": np.zeros((2, 4, 12, 9))}, r"directions must have shape \(2, B, 12, 12\)"),
        ({"variances": np.ones((3, 5, 12))}, r"variances must have shape \(2, L, 12\)"),
        ({"band": np.zeros(4, int)}, r"band must have shape \(5\)"),
        ({"weights": np.ones(3) / 3}, r"weights must have shape \(2\)"),
        ({"scale_weights": np.ones(3) / 3}, r"scale_weights must have shape \(2\)"),
        ({"poses": np.full((2, 4, 3), np.nan)}, "poses must be finite"),
        ({"variances": -np.ones((2, 5, 12))}, "variances must be positive, got -1"),
        ({"weights": np.array([1.0, 0.0])}, "weights must be positive, got 0"),
        ({"weights": np.array([0.5, 0.4])}, "weights must sum to 1, got 0.9"),
        ({"scales": np.array([1.0, -2.0])}, "scales must be positive, got -2"),
        ({"ground": 0.0}, "ground must be a finite number above 0, got 0"),
        ({"fps": -30.0}, "fps must be a finite number above 0, got -30"),
        ({"azimuths": 0}, "azimuths must be an integer of at least 1, got 0"),
    ],
)
def test_invalid_parameters_are_rejected(make_prior, changes, message):
    with pytest.raises(ValueError, match=message):
        make_prior(**changes)


def test_invalid_arguments_are_rejected(prior, noisy):
    x_t = noisy(0.5)
    perspective = Cameras.around([0.0], [0.1], perspective=True)
    with pytest.raises(protocols.OrthographicOnly, match="got perspective"):
        prior.denoise(x_t[:, None, ..., :2], 0.5, perspective)
    for message, call in (
        (r"alpha_bar must be in \(0, 1\], got 0", lambda: prior.denoise_motion(x_t, 0.0)),
        (r"alpha_bar must be in \(0, 1\], got 1.5", lambda: prior.denoise_motion(x_t, 1.5)),
        (r"got \(3, 2, 4, 3\)", lambda: prior.denoise_motion(x_t[:, :2], 0.5)),
        (r"vectors must have shape", lambda: prior.motion_covariance(x_t, 0.5)(x_t[:1])),
        (r"x_t must have shape \(B, 1", lambda: prior.denoise(x_t[..., :2], 0.5, Cameras.ring(1))),
        (r"got \(3, 2, 4, 3\)", lambda: prior.log_prior(x_t[:, :2])),
        (r"got \(3, 2, 4, 3\)", lambda: prior.theta(x_t[:, :2])),
        (r"got \(3, 2, 4, 3\)", lambda: prior.style_responsibilities(x_t[:, :2])),
        ("frames must be an integer of at least 1", lambda: prior.resampled(0)),
        ("fps must be a finite number above 0", lambda: prior.resampled(5, 0.0)),
    ):
        with pytest.raises(ValueError, match=message):
            call()
