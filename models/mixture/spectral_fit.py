"""Fitting of spectral mixtures: clusters of windows, shrunk moments, held-out likelihood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.arrays import logsumexp
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.models.mixture.conditioning import turned
from probmotion.models.mixture.fit import cut_windows
from probmotion.models.mixture.spectrum import (
    bands,
    principal_directions,
    ramp,
    to_frequencies,
    translations,
)
from probmotion.motion.motion import Motion
from probmotion.posteriors.sampling import progress_bar
from probmotion.validation import check_count

__all__ = ["fit_components"]

_NUMBERS = (1, 4, 8, 16, 32)  # of components to choose from
_SHRINKAGES = (2.5, 10.0, 40.0)  # windows' worth of the moments of all windows
_FOLDS = 3
_GLOBAL_WEIGHT = 0.05  # of the component of all windows
_INDEPENDENT = (0.1, 0.003)
"""Weight of independent coordinates in covariances, at frequency 0 and at others: correlations of
postures are estimated from few clips, and are too large for motion that is unlike them."""
_FLOOR = 1e-8  # keeps activities of still windows finite, square metres
_LOW = 3  # frequencies that describe a window for clustering
SCALES = np.array([0.25, 1.0, 4.0])
"""Factors of the variances: motion is calmer or livelier than that of the component's windows."""


@dataclass(frozen=True)
class Moments:
    """Moments of weighted windows, in the coordinates of a pose.

    ``pose`` (P,), ``velocity`` (2,), and the covariance of the coefficients of each frequency,
    ``bands`` (L, P, P).
    """

    pose: np.ndarray
    velocity: np.ndarray
    bands: np.ndarray

    def shrunk(self, towards: Moments, share: float) -> Moments:
        """Return the weighted average of moments; ``share`` is that of these."""
        pairs = zip(vars(self).values(), vars(towards).values(), strict=True)
        return Moments(*(share * own + (1 - share) * other for own, other in pairs))


def fit_components(
    motions: Sequence[Motion],
    frames: int,
    components: int | None,
    azimuths: int,
    seed: int,
    progress: bool,
) -> dict[str, Any]:
    """Fit the components; arguments and errors as in :meth:`SpectralMixtureMotion.fit`."""
    if components is not None:
        check_count("components", components)
    windows, clip_of = cut_windows(motions, frames, centred=False)
    if components is not None and len(windows) < components:
        raise ValueError(
            f"components must be at most the number of windows, {len(windows)}, got {components}; "
            "use more or longer clips"
        )
    if np.ptp(windows, axis=0).max() < 1e-9:
        raise ValueError(f"motions must contain different windows, got {len(windows)} equal ones")
    coefficients = _canonical(windows, motions[0])
    fps = motions[0].fps
    shrinkage = _SHRINKAGES[1]
    if components is None:
        components, shrinkage = _chosen(coefficients, clip_of, fps, azimuths, seed, progress)
    return _fitted(coefficients, fps, components, shrinkage, azimuths, seed)


def _canonical(windows: np.ndarray, motion: Motion) -> np.ndarray:
    """Return the DCT coefficients of windows that face +Z in their middle, (n, L, P).

    The centroid's mean ground position is removed.
    """
    n, L, J, _ = windows.shape
    ground = windows.mean(axis=(1, 2), keepdims=True) * [1.0, 0.0, 1.0]
    middle = slice(max(L // 2 - 2, 0), L // 2 + 3)
    pairs = motion.skeleton.mirrored_pairs
    if pairs:
        left, right = np.array(pairs).T
        side = (windows[:, middle, right] - windows[:, middle, left]).mean(axis=(1, 2))
        # With +Y up, a body that faces +Z has its right side at −X.
        angles = np.arctan2(-side[:, 2], -side[:, 0])
    else:
        # Without left and right, the direction of travel, else the longest horizontal axis.
        travel = windows[:, -1].mean(axis=1) - windows[:, 0].mean(axis=1)
        angles = np.arctan2(-travel[:, 0], travel[:, 2])
    turned = turned_about_vertical(windows - ground, angles)
    return to_frequencies(turned.reshape(n, L, 3 * J), axis=1)


def _moments(coefficients: np.ndarray, fps: float, azimuths: int) -> Moments:
    """Return the moments of windows whose heading is uniform within a cell of the azimuths."""
    n, L, P = coefficients.shape
    if azimuths > 1:
        # Two headings at ± the standard deviation of a uniform distribution.
        fields = coefficients.reshape(n, L, P // 3, 3)
        angle = math.pi / (azimuths * math.sqrt(3))
        both = [turned(fields, sign * angle) for sign in (-1, 1)]
        coefficients = np.concatenate(both).reshape(2 * n, L, P)
        n *= 2
    pose = coefficients[:, 0].mean(axis=0) / math.sqrt(L)
    slope = ramp(L, fps)
    along = translations(P // 3)
    # Least squares of the mean path's coefficients on those of a ramp.
    path = coefficients.mean(axis=0) @ along / math.sqrt(P // 3)
    square = slope @ slope
    velocity = slope @ path / square if square > 0 else np.zeros(2)
    deviation = coefficients - _mean(pose, velocity, L, fps)
    covariance = np.matmul(deviation.transpose(1, 2, 0), deviation.swapaxes(0, 1)) / n
    return Moments(pose, velocity, covariance)


def _mean(pose: np.ndarray, velocity: np.ndarray, L: int, fps: float) -> np.ndarray:
    """Return the coefficients of a pose that moves at a velocity, (L, P)."""
    J = len(pose) // 3
    mean = math.sqrt(J) * ramp(L, fps)[:, None] * (translations(J) @ velocity)
    mean[0] += math.sqrt(L) * pose
    return mean


def _component(moments: Moments) -> dict[str, np.ndarray]:
    """Return the parameters of one component, with correlations reduced by ``_INDEPENDENT``."""
    L, P, _ = moments.bands.shape
    share = np.where(np.arange(L) == 0, *_INDEPENDENT)[:, None, None]
    covariances = moments.bands * (1 - share + share * np.eye(P))
    directions, variances = principal_directions(covariances, bands(L))
    # Windows are centred: the prior sets the variance of the ground position by ``ground``.
    variances[0, :2] = 1.0
    return {
        "poses": moments.pose.reshape(-1, 3),
        "velocities": moments.velocity,
        "directions": directions,
        "variances": variances,
    }


def _fitted(
    coefficients: np.ndarray,
    fps: float,
    components: int,
    shrinkage: float,
    azimuths: int,
    seed: int,
) -> dict[str, Any]:
    everything = _moments(coefficients, fps, azimuths)
    parts, weights = [_component(everything)], [1.0]
    if components > 1:
        labels = _cluster(coefficients, components - 1, seed)
        counts = np.bincount(labels, minlength=components - 1)
        weights = [_GLOBAL_WEIGHT, *(1 - _GLOBAL_WEIGHT) * counts / len(labels)]
        for k, count in enumerate(counts):
            own = _moments(coefficients[labels == k], fps, azimuths)
            parts.append(_component(own.shrunk(everything, count / (count + shrinkage))))
    fitted: dict[str, Any] = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    return fitted | {
        "band": bands(coefficients.shape[1]),
        "weights": np.array(weights),
        "scales": SCALES,
        "scale_weights": np.full(len(SCALES), 1 / len(SCALES)),
    }


def _cluster(coefficients: np.ndarray, clusters: int, seed: int) -> np.ndarray:
    """Return k-means labels by pose, slow movement and activity; no cluster is empty."""
    if clusters == 1:
        return np.zeros(len(coefficients), dtype=int)
    from scipy.cluster.vq import kmeans2

    low = coefficients[:, :_LOW].reshape(len(coefficients), -1)
    low = low - low.mean(axis=0)
    activity = np.log((coefficients[:, 1:] ** 2).sum(axis=(1, 2)) + _FLOOR)
    activity = (activity - activity.mean()) / (activity.std() + _FLOOR)
    features = np.concatenate(
        [low / (np.sqrt((low**2).sum(axis=1).mean()) + _FLOOR), 0.5 * activity[:, None]], axis=1
    )
    best, least = None, np.inf
    for start in range(5):
        rng = seeds.generator(seed, f"k-means {start}")
        centres, labels = kmeans2(features, clusters, minit="++", iter=50, rng=rng)
        cost = float(((features - centres[labels]) ** 2).sum())
        if cost < least and len(np.unique(labels)) == clusters:
            best, least = labels, cost
    if best is None:
        raise ValueError(
            f"components must be at most the number of clusters in the windows, got "
            f"{clusters + 1}; use fewer components or clips that differ more"
        )
    return best


def _chosen(
    coefficients: np.ndarray,
    clip_of: np.ndarray,
    fps: float,
    azimuths: int,
    seed: int,
    progress: bool,
) -> tuple[int, float]:
    """Return the number of components and the shrinkage of the largest held-out likelihood."""
    clips = seeds.generator(seed, "folds").permutation(np.unique(clip_of))
    held_out = [np.isin(clip_of, part) for part in np.array_split(clips, _FOLDS) if len(part)]
    if len(held_out) < 2:
        # One clip: hold out consecutive windows.
        parts = np.arange(len(clip_of)) * _FOLDS // len(clip_of)
        held_out = [parts == part for part in np.unique(parts)]
    if len(held_out) < 2:
        return 1, _SHRINKAGES[1]
    fewest = min(int((~mask).sum()) for mask in held_out)
    numbers = [number for number in _NUMBERS if 3 * number <= fewest] or [1]

    def score(number: int, shrinkage: float, bar: Any) -> float:
        """Return the mean log density of held-out windows, given their headings."""
        total = 0.0
        for mask in held_out:
            fitted = _fitted(coefficients[~mask], fps, number, shrinkage, azimuths, seed)
            total += float(_log_density(fitted, coefficients[mask], fps).sum())
        bar.update()
        return total / len(coefficients)

    middle = _SHRINKAGES[1]
    with progress_bar(len(numbers) + len(_SHRINKAGES) - 1, "fit", progress) as bar:
        scores = {number: score(number, middle, bar) for number in numbers}
        number = max(scores, key=scores.__getitem__)
        if number == 1:
            return number, middle
        shrunk = {value: score(number, value, bar) for value in _SHRINKAGES if value != middle}
        shrunk[middle] = scores[number]
        return number, max(shrunk, key=shrunk.__getitem__)


def _log_density(fitted: dict[str, Any], coefficients: np.ndarray, fps: float) -> np.ndarray:
    """Return log densities of canonical windows (n, L, P) at heading 0, (n,)."""
    L, P = coefficients.shape[1:]
    terms = []
    parts = ("poses", "velocities", "directions", "variances", "weights")
    for pose, velocity, directions, variances, weight in zip(
        *(fitted[name] for name in parts), strict=True
    ):
        deviation = coefficients - _mean(pose.reshape(-1), velocity, L, fps)
        scores = np.matmul(deviation.swapaxes(0, 1), directions[fitted["band"]])  # (L, n, P)
        square = np.einsum("fnp,fp->n", scores**2, 1 / variances)
        log_det = np.log(variances).sum()
        for scale, scale_weight in zip(fitted["scales"], fitted["scale_weights"], strict=True):
            log_norm = log_det + L * P * math.log(2 * math.pi * scale)
            terms.append(math.log(weight * scale_weight) - 0.5 * (square / scale + log_norm))
    values: np.ndarray = logsumexp(np.stack(terms, axis=-1))
    return values
