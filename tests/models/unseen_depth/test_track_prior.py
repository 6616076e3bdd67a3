"""EM over unseen depth of tracks, against dense linear algebra, known Gaussians and bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from probmotion import Cameras, KeypointTrack, Skeleton
from probmotion.arrays import logsumexp
from probmotion.data.projections import DetectorNoise, Filming
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.data.tracks.learning import film_clips
from probmotion.models.mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectrum import bands, to_frequencies
from probmotion.models.unseen_depth import motion_prior_from_tracks
from probmotion.models.unseen_depth.track_em import expectation, maximisation, moments

BODY = Skeleton(["hips", "head", "left_hand", "right_hand"], [-1, 0, 0, 0])
POSE = np.array([[0, 0, 0.1], [0, 0.6, -0.1], [0.4, 0.1, 0.3], [-0.4, 0.1, 0.3]])
POSE = POSE - POSE.mean(axis=0) * [1, 0, 1]
ELEVATIONS = np.array([0.1, 0.3])


def random_prior(frames: int = 3, components: int = 1, azimuths: int = 12) -> SpectralMixtureMotion:
    """Return a prior around POSE with correlated joints and a mean velocity."""
    rng = np.random.default_rng(1)
    J = len(POSE)
    P, band = 3 * J, bands(frames)
    along = np.zeros((J, 3, 2))
    along[:, 0, 0] = along[:, 2, 1] = 1 / np.sqrt(J)
    directions = np.empty((components, band[-1] + 1, P, P))
    for k in range(components):
        for b in range(band[-1] + 1):
            fixed = along.reshape(P, 2) if b == 0 else np.zeros((P, 0))
            free = rng.normal(size=(P, P - fixed.shape[1]))
            basis = np.linalg.qr(np.concatenate([fixed, free], axis=1))[0]
            directions[k, b] = np.concatenate([fixed, basis[:, fixed.shape[1] :]], axis=1)
    sizes = 0.1 ** np.linspace(0, 3, P) * frames / 20
    weights = np.arange(1, components + 1) / np.arange(1, components + 1).sum()
    return SpectralMixtureMotion(
        BODY,
        20.0,
        POSE + 0.05 * np.arange(components)[:, None, None] * [0, 1, 0],
        np.tile([0.1, 0.9], (components, 1)),
        directions,
        band,
        sizes / (1 + np.arange(frames))[:, None] ** 2 * np.ones((components, 1, 1)),
        weights,
        azimuths=azimuths,
    )


def images_of(
    prior: SpectralMixtureMotion, n: int, noise: float, elevations: np.ndarray = ELEVATIONS
) -> np.ndarray:
    """Return images of draws; the prior's headings are uniform."""
    rng = np.random.default_rng(2)
    cameras = Cameras.around(np.zeros(n), rng.choice(elevations, n)).rotation[:, :2]
    images = np.einsum("nai,nlji->nlja", cameras, prior.sample(rng, n))
    return images + noise * rng.standard_normal(images.shape)


def as_tracks(images: np.ndarray, missing: np.ndarray | None = None) -> list[KeypointTrack]:
    seen = np.ones(images.shape[:3]) if missing is None else 1.0 * ~missing
    shown = np.where(seen[..., None] > 0, images, np.nan)
    return [KeypointTrack(*pair, BODY, 20.0) for pair in zip(shown, seen, strict=True)]


def dense_covariances(prior: SpectralMixtureMotion) -> list[np.ndarray]:
    """Return the covariance of all DCT coefficients (L P, L P) of each component."""
    L, P = prior.variances.shape[1:]
    result = []
    for part in prior.components.gaussians:
        C = np.zeros((L, P, L, P))
        for f in range(L):
            V = part.directions[part.band[f]]
            C[f, :, f] = V @ np.diag(part.variances[f]) @ V.T
        result.append(C.reshape(L * P, L * P))
    return result


def test_e_step_agrees_with_dense_linear_algebra() -> None:
    prior, noise = random_prior(components=2, azimuths=3), 0.05
    images = images_of(prior, 5, noise)
    n, L, J, _ = images.shape
    got = expectation(prior, images, ELEVATIONS, noise)
    y = to_frequencies(images, axis=1).reshape(n, -1)
    cells = []
    for k, (part, C) in enumerate(
        zip(prior.components.gaussians, dense_covariances(prior), strict=True)
    ):
        mean = to_frequencies(part.mean, axis=0).reshape(-1)
        for azimuth in prior.yaws:
            for elevation in ELEVATIONS:
                # A camera at −ψ sees the motion as one at 0 sees it rotated by ψ.
                camera = Cameras.around(-azimuth, elevation).rotation[0, :2]
                A = np.kron(np.eye(L * J), camera)
                S = A @ C @ A.T + noise**2 * np.eye(len(A))
                log = multivariate_normal(A @ mean, S).logpdf(y) + np.log(prior.weights[k] / 6)
                gain = C @ A.T @ np.linalg.inv(S)
                cells.append((k, log, (y - A @ mean) @ gain.T, C - gain @ A @ C, mean, A))
    logs = np.stack([cell[1] for cell in cells])
    total = logsumexp(logs, axis=0)
    assert got.log_density == pytest.approx(total.mean(), abs=1e-8)
    weights = np.exp(logs - logs.max(axis=0))
    weights[weights < 1e-3] = 0  # as in the E step
    weights /= weights.sum(axis=0)
    sums, squares = np.zeros((2, L * 3 * J)), np.zeros((2, L * 3 * J, L * 3 * J))
    coefficients, seen = np.zeros((n, L * 3 * J)), np.zeros_like(y)
    for w, (k, _, deviation, within, mean, A) in zip(weights, cells, strict=True):
        sums[k] += w @ deviation
        squares[k] += (w[:, None] * deviation).T @ deviation + w.sum() * within
        coefficients += w[:, None] * (mean + deviation)
        seen += w[:, None] * (mean + deviation) @ A.T
    blocks = np.stack([squares.reshape(2, L, 3 * J, L, 3 * J)[:, f, :, f] for f in range(L)], 1)
    np.testing.assert_allclose(got.sums, sums.reshape(got.sums.shape), atol=1e-8)
    np.testing.assert_allclose(got.squares, blocks, atol=1e-8)
    np.testing.assert_allclose(got.coefficients.reshape(n, -1), coefficients, atol=1e-8)
    np.testing.assert_allclose(to_frequencies(got.images, axis=1).reshape(n, -1), seen, atol=1e-8)


def test_moments_are_those_about_the_fitted_mean() -> None:
    prior, rng = random_prior(10), np.random.default_rng(6)
    expected = expectation(prior, images_of(prior, 30, 0.05), ELEVATIONS, 0.05)
    motions = expected.means[0] + 0.1 + rng.normal(size=(30, 10, 12))
    deviations = motions - expected.means[0]
    squares = np.einsum("nfp,nfq->fpq", deviations, deviations)
    sums = deviations.sum(axis=0)[None]
    expected = expected._replace(counts=np.array([30.0]), sums=sums, squares=squares[None])
    fitted = maximisation(expected, prior)
    mean = to_frequencies(fitted.components.gaussians[0].mean, axis=0).reshape(10, 12)
    known = np.einsum("nfp,nfq->fpq", motions - mean, motions - mean)
    bands = moments(expected, prior.fps)[0].bands
    np.testing.assert_allclose(40 * bands - 10 * 0.005**2 * np.eye(12), known, atol=1e-9)


@pytest.mark.parametrize("components", [1, 2])
def test_likelihood_increases(components: int) -> None:
    images = images_of(random_prior(10, 2), 300, 0.02)
    prior = random_prior(10, components)
    prior = replace(prior, variances=np.full_like(prior.variances, 0.05))  # white
    values = []
    for _ in range(8):
        expected = expectation(prior, images, ELEVATIONS, 0.02)
        values.append(expected.log_density)
        prior = maximisation(expected, prior)
    assert values[-1] > values[0] + 10
    assert (np.diff(values) > 0).all()


def test_recovers_a_known_gaussian() -> None:
    truth = random_prior(10)
    elevations = np.array([0.15])
    images = images_of(truth, 1000, 0.01, elevations)
    rng = np.random.default_rng(4)
    missing = rng.random(images.shape[:3]) < 0.02
    fitted = motion_prior_from_tracks(
        as_tracks(images, missing),
        10,
        components=1,
        start=POSE + 0.03 * rng.normal(size=POSE.shape),
        elevations=(0.14, 0.16),
        azimuths=12,
        iterations=30,
    )
    np.testing.assert_allclose(fitted.poses, truth.poses, atol=0.02)
    np.testing.assert_allclose(fitted.velocities, truth.velocities, atol=0.1)
    for f in range(4):
        V, W = truth.directions[0, truth.band[f]], fitted.directions[0, fitted.band[f]]
        known = V @ np.diag(truth.variances[0, f]) @ V.T
        found = W @ np.diag(fitted.variances[0, f]) @ W.T
        if f == 0:  # the translations are not learnt
            known, found = (V[:, 2:].T @ part @ V[:, 2:] for part in (known, found))
        assert np.linalg.norm(found - known) < 0.2 * np.linalg.norm(known)


def test_perspective_of_a_known_distance_is_corrected() -> None:
    rng = np.random.default_rng(5)
    truth = random_prior(10)
    truth = replace(truth, velocities=np.zeros((1, 2)), ground=0.01)
    n = 300
    cameras = Cameras.around(np.zeros(n), np.full(n, 0.15), distance=2.0, perspective=True)
    motions = truth.sample(rng, n)
    images = np.stack([cameras.project(x)[i] for i, x in enumerate(motions)])
    options = {"components": 1, "start": POSE, "elevations": (0.14, 0.16), "azimuths": 12}
    plain, corrected = (
        motion_prior_from_tracks(as_tracks(images), 10, distance=distance, **options)
        for distance in (None, 2.0)
    )
    scores = [prior.log_prior(motions).mean() for prior in (plain, corrected, truth)]
    assert scores[0] < scores[1] < scores[2]
    errors = [np.abs(prior.poses - truth.poses).max() for prior in (plain, corrected)]
    assert errors[1] < errors[0] / 2


def test_draws_of_walks_move_at_the_speed_of_the_walks() -> None:
    walks = synthetic_walks(6, seconds=4)
    skeleton = Skeleton.preset("person14")
    filming = Filming(perspective=False, centre="sequence")
    filmed = film_clips(walks, skeleton, 10.0, views=4, filming=filming, noise=DetectorNoise())
    prior = motion_prior_from_tracks(
        filmed.tracks, 20, components=1, elevations=(0.14, 0.26), azimuths=12, iterations=6
    )
    draws = prior.sample(np.random.default_rng(0), 200)

    def speed(motion: np.ndarray) -> np.ndarray:
        return np.linalg.norm((motion[..., -1, 0, :] - motion[..., 0, 0, :])[..., [0, 2]], axis=-1)

    clips = np.concatenate(
        [
            np.stack([clip[:20], clip[20:40]])
            for walk in walks
            for clip in [walk.retarget(skeleton).resample(10.0).positions]
            if len(clip) >= 40
        ]
    )
    assert np.median(speed(draws)) == pytest.approx(np.median(speed(clips)), rel=0.15)
    # Walks are forwards: mean velocities are along +Z, where the pose faces.
    assert (prior.velocities[:, 1] > 3 * abs(prior.velocities[:, 0])).all()


def test_one_view_direction_is_refused() -> None:
    truth = replace(random_prior(10), azimuths=1)
    tracks = as_tracks(images_of(truth, 200, 0.01))
    with pytest.raises(ValueError, match="tracks must show the poses from several directions"):
        motion_prior_from_tracks(tracks, 10, components=1, start=POSE)


def test_bad_input_is_refused_with_one_sentence() -> None:
    images = images_of(random_prior(10), 4, 0.01)
    tracks = as_tracks(images)
    unseen = np.zeros(images.shape[:3], bool)
    unseen[:, :, 1] = True
    for bad, options, message in [
        ([], {}, "tracks must contain at least one track"),
        ([*tracks, replace(tracks[0], fps=10.0)], {}, "tracks must share one fps"),
        (tracks, {"frames": 11}, "tracks must have at least 11 frames, got at most 10"),
        (tracks, {"components": 5}, "components must be at most the number of windows, 4, got 5"),
        (as_tracks(images, unseen), {}, "no such window of 10 frames.*such as head"),
        (tracks, {"start": POSE[:3]}, "start must have shape"),
        (tracks, {"elevations": (1.0, 0.0)}, "elevations must be ordered"),
        (tracks, {"noise": 0.0}, "noise must be"),
    ]:
        with pytest.raises(ValueError, match=message):
            motion_prior_from_tracks(
                bad, **{"frames": 10, "components": 1, "start": POSE} | options
            )
