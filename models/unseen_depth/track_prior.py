"""3D motion prior learnt from 2D tracks alone: EM over unseen depth, with spectra over time.

Every window of a track is an orthographic image of a motion from an unknown azimuth and elevation,
constant over the window. This is the counterpart of multi-view ancestral sampling (Kapon et al.
2024) with an exact density, denoiser and posterior in place of a network.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from probmotion import seeds
from probmotion.models.mixture.spectral_fit import Moments
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectrum import bands, to_frequencies
from probmotion.models.unseen_depth.track_em import (
    Expectation,
    expectation,
    maximisation,
    moments,
    prior_of,
)
from probmotion.models.unseen_depth.view_cells import check_view_directions, elevation_levels
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.rest_poses import estimate_rest_pose, joint_positions
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.sampling import progress_bar
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["motion_prior_from_tracks"]

_ELEVATIONS = (0.0, math.pi / 8)
_SPREAD = 0.04  # initial standard deviation of mean poses of windows, metres
_PSEUDO_WINDOWS = 20.0  # windows' worth of the moments of all windows, in each component
_LEAST_SEEN = 0.5  # of the frames of a window, for each joint
_LOW = 3  # frequencies that describe a window for clustering
_SMALL = 1e-8  # square metres


def motion_prior_from_tracks(
    tracks: Sequence[KeypointTrack],
    frames: int = 40,
    *,
    components: int = 8,
    start: np.ndarray | None = None,
    noise: float = 0.01,
    elevations: tuple[float, float] = _ELEVATIONS,
    distance: float | None = None,
    azimuths: int = 24,
    iterations: int = 12,
    seed: int = 0,
    progress: bool = False,
) -> SpectralMixtureMotion:
    """Learn a 3D motion prior from 2D tracks in unknown views by EM.

    The E step integrates over depth exactly and over views on a grid. Missing joints are replaced
    by their posterior means in each iteration. Motions of the prior are relative to the same origin
    as the tracks, usually the root.

    Parameters
    ----------
    tracks : sequence of KeypointTrack
        Prepared tracks of one skeleton and frame rate, metres, x right and y down; confidence 0
        where a joint is missing (:func:`~probmotion.data.tracks.preparation.prepare_tracks`). They
        are cut into consecutive windows. Windows in which a joint is seen in fewer than half of the
        frames are left out.
    frames : int
        Length L of the windows and of the prior's motions.
    components : int
        K: number of components.
    start : ndarray, (J, 3), optional
        Initial mean pose, metres, facing +Z with +Y up. It resolves the ambiguities of orthographic
        images, a common rotation about the vertical and a reflection in depth. By default, the rest
        pose that the tracks determine
        (:func:`~probmotion.motion.rest_poses.estimate_rest_pose`).
    noise : float
        Standard deviation σ of the keypoints, metres.
    elevations : tuple of float
        Range of the cameras' elevations above the horizon, radians.
    distance : float, optional
        Distance of perspective cameras from the origin, metres; the projection is linearised at the
        posterior mean. Orthographic by default.
    azimuths : int
        Number of azimuths in the grid of views, and of the prior's headings.
    iterations : int
        Number of EM iterations with one component, and again with K.
    seed : int
        Seed of the components' initialisation.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If tracks differ in skeleton or frame rate, there are fewer windows than components, all
        views have one direction, or the tracks do not determine a rest pose.
    """
    windows = _windows(tracks, frames)
    skeleton, fps = tracks[0].skeleton, tracks[0].fps
    check_count("components", components)
    check_count("iterations", iterations)
    check_count("azimuths", azimuths, 4)
    check_positive("noise", noise)
    if distance is not None:
        check_positive("distance", distance)
    if len(windows) < components:
        raise ValueError(
            f"components must be at most the number of windows, {len(windows)}, got {components}; "
            "use more or longer tracks"
        )
    if start is None:
        start = joint_positions(skeleton, estimate_rest_pose(tracks))
    check_shape("start", start, (skeleton.n_joints, 3))
    check_finite("start", start)
    levels = elevation_levels(elevations)
    missing = np.isnan(windows)
    images = keypoints = _interpolated(windows)
    prior = _initial(images, start, skeleton, fps, azimuths)
    towards = None
    with progress_bar(iterations * (1 if components == 1 else 2), "EM", progress) as bar:
        for number in [1] if components == 1 else [1, components]:
            if number > 1:
                expected = expectation(prior, images, levels, noise)
                towards = moments(expected, fps)[0]
                clusters = _split(expected, number, seed)
                prior = maximisation(clusters, prior, towards, _PSEUDO_WINDOWS)
            for _ in range(iterations):
                expected = expectation(prior, images, levels, noise)
                check_view_directions("tracks", expected.azimuth_concentration)
                if distance is not None:
                    # A pinhole at distance D sees x D / (D + z) at depth z.
                    ratios = np.maximum(1 + expected.depths / distance, 0.1)
                    images = keypoints * ratios[..., None]
                images = np.where(missing, expected.images, images)
                prior = maximisation(expected, prior, towards, _PSEUDO_WINDOWS)
                bar.update()
    prior.card.update(
        tracks=len(tracks),
        windows=len(windows),
        noise=noise,
        distance=distance,
        elevations=[float(level) for level in levels],
        log_density=expected.log_density,
    )
    return prior


def _windows(tracks: Sequence[KeypointTrack], frames: int) -> np.ndarray:
    """Return consecutive windows of tracks, (n, L, J, 2), NaN where a joint is missing."""
    check_count("frames", frames, least=2)
    if not tracks:
        raise ValueError("tracks must contain at least one track, got none")
    for name in ("skeleton", "fps"):
        if any(getattr(track, name) != getattr(tracks[0], name) for track in tracks):
            raise ValueError(f"tracks must share one {name}, got several; prepare them together")
    windows = [
        np.where(track.confidence[rows, :, None] > 0, track.keypoints[rows], np.nan)
        for track in tracks
        for first in range(0, track.frames - frames + 1, frames)
        for rows in (slice(first, first + frames),)
    ]
    if not windows:
        longest = max(track.frames for track in tracks)
        raise ValueError(f"tracks must have at least {frames} frames, got at most {longest}")
    seen = np.mean([~np.isnan(window[..., 0]) for window in windows], axis=1)  # (n, J)
    kept = (seen >= _LEAST_SEEN).all(axis=1)
    if not kept.any():
        rarest = tracks[0].skeleton.joint_names[int(seen.mean(axis=0).argmin())]
        raise ValueError(
            f"tracks must show all joints in half of the frames of a window, got no such window of "
            f"{frames} frames; leave out joints that are rarely seen, such as {rarest}"
        )
    return np.stack(windows)[kept]


def _interpolated(windows: np.ndarray) -> np.ndarray:
    """Return windows with missing entries interpolated linearly over time."""
    out = windows.copy()
    frames = np.arange(windows.shape[1])
    for row, joint in np.argwhere(np.isnan(windows[..., 0]).any(axis=1)):
        seen = ~np.isnan(windows[row, :, joint, 0])
        for axis in range(2):
            values = windows[row, seen, joint, axis]
            out[row, :, joint, axis] = np.interp(frames, frames[seen], values)
    return out


def _initial(
    images: np.ndarray, start: np.ndarray, skeleton: Skeleton, fps: float, azimuths: int
) -> SpectralMixtureMotion:
    """Return a pose at rest, moved by independent coordinates with the spectra of the images."""
    _, L, J, _ = images.shape
    variances = (to_frequencies(images, axis=1) ** 2).mean(axis=(0, 3))  # (L, J)
    variances[0] = L * _SPREAD**2
    variances = np.repeat(variances, 3, axis=1) + _SMALL
    pose = np.asarray(start, dtype=np.float64) - start.mean(axis=0) * [1.0, 0.0, 1.0]
    still = Moments(pose.reshape(-1), np.zeros(2), variances[:, :, None] * np.eye(3 * J))
    band = bands(L)
    blank = SpectralMixtureMotion(
        skeleton,
        fps,
        pose[None],
        np.zeros((1, 2)),
        np.tile(np.eye(3 * J), (1, band[-1] + 1, 1, 1)),
        band,
        np.ones((1, L, 3 * J)),
        np.ones(1),
        azimuths=azimuths,
    )
    return prior_of([still], np.ones(1), blank)


def _split(expected: Expectation, components: int, seed: int) -> Expectation:
    """Return the moments of k-means clusters of motions, by pose, slow movement and activity."""
    from scipy.cluster.vq import kmeans2

    motions = expected.coefficients
    low = motions[:, :_LOW].reshape(len(motions), -1)
    low = low - low.mean(axis=0)
    activity = np.log((motions[:, 1:] ** 2).sum(axis=(1, 2)) + _SMALL)
    activity = (activity - activity.mean()) / (activity.std() + _SMALL)
    features = np.concatenate(
        [low / np.sqrt((low**2).sum(axis=1).mean() + _SMALL), 0.5 * activity[:, None]], axis=1
    )
    rng = seeds.generator(seed, "components")
    labels = kmeans2(features, components, minit="++", iter=50, rng=rng)[1]
    deviations = motions - expected.means[0]
    within = expected.squares[0] - _squares(deviations)
    counts = np.bincount(labels, minlength=components).astype(float)
    parts = [deviations[labels == k] for k in range(components)]
    shares = counts / len(motions)
    return expected._replace(
        counts=counts,
        sums=np.stack([part.sum(axis=0) for part in parts]),
        squares=np.stack(
            [_squares(part) + share * within for part, share in zip(parts, shares, strict=True)]
        ),
        means=np.repeat(expected.means, components, axis=0),
    )


def _squares(deviations: np.ndarray) -> np.ndarray:
    """Return sums of outer products at each frequency, ``(n, L, P) → (L, P, P)``."""
    return np.matmul(deviations.transpose(1, 2, 0), deviations.swapaxes(0, 1))
