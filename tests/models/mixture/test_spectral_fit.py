"""Fitting: recovery of known priors, headings, number of components, degenerate clips."""

import math
from dataclasses import replace

import numpy as np
import pytest

from probmotion import Motion, Skeleton
from probmotion.data.face_points import FACE_POINTS
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.data.synthetic.walks import synthetic_walks
from probmotion.models.mixture import SpectralMixtureMotion, spectral_fit
from probmotion.models.mixture.spectrum import ramp, to_frequencies

TURNS = np.random.default_rng(9).uniform(0, 2 * np.pi, 400)


def facing_prior(make_prior, components=1, sway=1e-10):
    """Return a prior of motions that face +Z; ``sway`` is the variance of the hands' direction.

    Every band has the same directions: sums and differences of joints, which are orthonormal. Their
    variances differ by a factor of 1.4, so that the directions are identified. The two components
    differ in height, and large variances of one are small variances of the other.
    """
    x = np.array([[1, 1, 1, 1], [0, 0, 1, -1], [1, -1, 0, 0], [1, 1, -1, -1]]).T
    x = x / np.linalg.norm(x, axis=0)
    basis = np.zeros((4, 3, 12))
    basis[:, 0, [0, 2, 4, 6]] = basis[:, 2, [1, 3, 5, 7]] = x
    basis[:, 1, 8:] = np.eye(4)
    variances = 0.05 / (1 + np.arange(5.0)[:, None]) / 1.4 ** np.arange(12)
    variances = np.stack([variances, variances[:, ::-1]])[:components]
    variances[..., 2:4] = sway
    poses = np.array([[0, 1.0, 0], [0, 1.6, 0], [0.4, 1.2, 0], [-0.4, 1.2, 0]])
    poses = poses + 2.0 * np.arange(components)[:, None, None] * [0, 1, 0]
    return make_prior(
        components=components,
        azimuths=1,
        poses=poses,
        velocities=np.array([[0.1, 1.3], [-0.2, -0.8]])[:components],
        directions=np.tile(basis.reshape(12, 12), (components, 4, 1, 1)),
        variances=variances,
        scales=np.ones(1),
        scale_weights=np.ones(1),
    )


def clips_of(prior, n, turned=False, seed=0):
    draws = prior.sample(np.random.default_rng(seed), n)
    clips = [Motion(draw, prior.skeleton, prior.fps) for draw in draws]
    return [c.turned(a) for c, a in zip(clips, TURNS, strict=False)] if turned else clips


def covariances(prior):
    """Return the covariance of the coefficients of each component and frequency, (K, L, P, P)."""
    V = prior.directions[:, prior.band]
    return (V * prior.variances[:, :, None]) @ V.swapaxes(2, 3)


def test_fit_recovers_one_component(make_prior):
    prior, n = facing_prior(make_prior), 2000
    fitted = SpectralMixtureMotion.fit(
        clips_of(prior, n), 5, components=1, azimuths=1, progress=False
    )
    # The centroid's mean ground position is removed; the pose's mean height is not.
    deviation = np.sqrt(np.diagonal(covariances(prior)[0, 0])[1::3].max() / 5 / n)
    np.testing.assert_allclose(fitted.poses, prior.poses, atol=5 * deviation)
    slope = ramp(5, 10.0)
    noise = np.sqrt(slope**2 @ prior.variances[0, :, :2] / 4 / n) / (slope @ slope)
    assert (np.abs(fitted.velocities[0] - prior.velocities[0]) < 5 * noise).all()
    # Covariances in whitened coordinates deviate from I by √(1/n), on the diagonal √(2/n). The
    # heading takes the hands' difference, two coordinates.
    V, S = prior.directions[0, 0], prior.variances[0]
    free = np.r_[:2, 4:12]
    for f in range(5):
        keep = free[2:] if f == 0 else free
        white = V[:, keep] / np.sqrt(S[f, keep])
        product = white.T @ covariances(fitted)[0, f] @ white
        np.testing.assert_allclose(product, np.eye(len(keep)), atol=5 * np.sqrt(2 / n))
        mean_variance = np.trace(product) / len(keep)
        assert mean_variance == pytest.approx(1, abs=5 * np.sqrt(2 / n / len(keep)))


def test_fit_recovers_two_components(make_prior):
    prior = facing_prior(make_prior, components=2)
    fitted = SpectralMixtureMotion.fit(
        clips_of(prior, 900), 5, components=3, azimuths=1, progress=False
    )
    # The first component is that of all windows.
    order = 1 + np.argsort(fitted.poses[1:, 0, 1])
    weights = fitted.weights[order] / fitted.weights[order].sum()
    np.testing.assert_allclose(weights, prior.weights, atol=4 * np.sqrt(2 / 9 / 900))
    np.testing.assert_allclose(fitted.velocities[order], prior.velocities, atol=0.15)
    np.testing.assert_allclose(fitted.poses[order], prior.poses, atol=0.15)


def test_fit_is_invariant_to_clip_headings():
    clips = synthetic_walks(6, seconds=2.0)
    turned = [clip.turned(angle) for clip, angle in zip(clips, TURNS, strict=False)]
    a, b = (
        SpectralMixtureMotion.fit(motions, 12, components=3, progress=False)
        for motions in (clips, turned)
    )
    for name in ("poses", "velocities", "weights"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)
    np.testing.assert_allclose(covariances(a), covariances(b), atol=1e-9)
    # Motions of the fitted prior have any heading: a turned walk is as probable.
    window = np.stack([clips[0].window(0, 12).centred().positions])
    yaw = 2 * np.pi * 5 / 24
    other = Motion(window[0], clips[0].skeleton, 30.0).turned(yaw).positions[None]
    np.testing.assert_allclose(a.log_prior(window), a.log_prior(other), rtol=1e-9)


@pytest.mark.parametrize("components", [1, 2])
def test_number_of_components_is_chosen_by_held_out_likelihood(make_prior, components):
    prior = facing_prior(make_prior, components, sway=1e-3)
    fitted = SpectralMixtureMotion.fit(clips_of(prior, 120, turned=True), 5, progress=False)
    assert (len(fitted.weights) > 1) == (components > 1)


def test_fitted_walks_are_probable():
    """Held-out walks are far more probable than the same walks with shuffled frames."""
    clips = synthetic_walks(8, seconds=2.0)
    prior = SpectralMixtureMotion.fit(clips[:6], 15, components=1, progress=False)
    windows = np.stack([clip.window(0, 15).centred().positions for clip in clips[6:]])
    shuffled = windows[:, np.random.default_rng(0).permutation(15)]
    assert (prior.log_prior(windows) > prior.log_prior(shuffled) + 1000).all()


def test_still_and_coincident_joints_are_no_singularity():
    """Only one hand moves; the head coincides with the hips."""
    body = Skeleton(["hips", "head", "left_hand", "right_hand"], [-1, 0, 0, 0])
    rng = np.random.default_rng(0)
    positions = np.tile([[0.0, 1, 0], [0, 1, 0], [0.4, 1, 0], [-0.4, 1, 0]], (40, 1, 1))
    positions[:, 2, 1] += 0.1 * rng.standard_normal(40)
    fitted = SpectralMixtureMotion.fit(
        [Motion(positions, body, 10.0)], 8, components=2, azimuths=4, progress=False
    )
    assert np.isfinite(fitted.log_prior(positions[None, :8])).all()
    moved = np.sqrt(np.trace(fitted.exact_posterior(None).covariances(), axis1=2, axis2=3))
    assert np.isfinite(moved).all()
    assert np.isfinite(fitted.denoise_motion(positions[None, :8], 0.5)).all()


def test_invalid_clips_are_rejected():
    clips = synthetic_walks(2, seconds=1.0)
    dogs = make_gaits(1, styles={"quadruped-trot": 1.0})
    broken = clips[0].positions.copy()
    broken[3, 2] = np.nan
    still = np.tile(clips[0].positions[:1], (40, 1, 1))
    skeleton = clips[0].skeleton
    for motions, options, message in (
        ([], {}, "motions must contain at least one clip, got none"),
        ([*clips, *dogs], {}, "motions must share one skeleton"),
        ([*clips, *synthetic_walks(1, fps=25.0)], {}, "motions must share one frame rate"),
        (clips, {"frames": 99}, "motions must contain a clip of at least 99 frames, got at most"),
        (clips, {"components": 0}, "components must be an integer of at least 1, got 0"),
        (clips, {"components": 99}, "components must be at most the number of windows, 22, got 99"),
        ([Motion(still, skeleton, 30.0)], {}, "motions must contain different windows"),
    ):
        with pytest.raises(ValueError, match=message):
            SpectralMixtureMotion.fit(motions, **{"frames": 10, "progress": False} | options)
    with pytest.raises(ValueError, match="finite"):
        SpectralMixtureMotion.fit([Motion(broken, skeleton, 30.0)], 10, progress=False)


def test_held_out_density_is_that_of_the_prior():
    person = Skeleton.preset("person14")
    clips = [clip.retarget(person) for clip in synthetic_walks(3, person, seconds=2.0)]
    prior = SpectralMixtureMotion.fit(clips, 8, components=3, azimuths=1, progress=False)
    # The fit takes a variance of 1 for the coefficient of the ground position.
    ground = 1 / math.sqrt(person.n_joints * 8)
    one = replace(prior, scales=np.ones(1), scale_weights=np.ones(1), ground=ground)
    windows = one.sample(np.random.default_rng(0), 5)
    coefficients = to_frequencies(windows.reshape(5, 8, -1), axis=1)
    names = ("poses", "velocities", "directions", "band", "variances", "weights")
    fitted = {name: getattr(one, name) for name in (*names, "scales", "scale_weights")}
    density = spectral_fit._log_density(fitted, coefficients, one.fps)
    np.testing.assert_allclose(density, one.log_prior(windows), rtol=1e-9)


@pytest.mark.parametrize("name", ["cmu-motion", "cmu-motion-coco17"])
def test_shipped_prior_of_all_clips_is_symmetric(name):
    """It is fitted to clips and their mirror images; the first component is that of all windows."""
    prior = SpectralMixtureMotion.load(name)
    order = list(prior.skeleton.mirrored_order)
    images = prior.poses[:, order] * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(images[0], prior.poses[0], atol=1e-6)
    assert abs(prior.velocities[0, 0]) < 1e-6


def test_faces_of_the_shipped_prior_are_in_front():
    """Mean poses face +Z, and random turns of the head are as often to the left as to the right."""
    prior = SpectralMixtureMotion.load("cmu-motion-coco17").resampled(20, 10.0)
    assert prior.skeleton == Skeleton.preset("coco17")
    draws = prior.sample(np.random.default_rng(0), 8)
    assert np.isfinite(prior.log_prior(draws)).all()
    points = {name: prior.poses[:, prior.skeleton.index(name)] for name in FACE_POINTS}
    ears = (points["left_ear"] + points["right_ear"]) / 2
    for name, place in FACE_POINTS.items():
        # The mean of rotated vectors is shorter than they are.
        assert (np.linalg.norm(points[name] - ears, axis=1) < np.linalg.norm(place) + 1e-6).all()
    ahead = prior.weights @ (points["nose"] - ears)
    assert ahead[2] > 0.06  # half of the distance, as heads are bent
    assert abs(ahead[0]) < 0.01
    left = prior.weights @ (points["left_ear"] - points["right_ear"])
    assert left[0] > 0.1
