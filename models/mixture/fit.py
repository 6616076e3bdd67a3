"""Fitting the mixture: windows of clips, a common heading, one probabilistic PCA per style."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.motion.motion import Motion
from probmotion.validation import check_count

__all__ = ["FittedStyles", "cut_windows", "fit_styles", "turn_to"]


class FittedStyles(NamedTuple):
    """Means (K, L, J, 3), factors (K, r, L, J, 3), δ, the styles' names and shares (K,)."""

    means: np.ndarray
    factors: np.ndarray
    noise: float
    names: tuple[str, ...]
    shares: np.ndarray


def fit_styles(
    motions: Sequence[Motion],
    frames: int,
    rank: int,
    styles: int | Sequence[str],
    stride: int | None,
    seed: int,
) -> FittedStyles:
    """Return the styles of :meth:`GaussianMixtureMotion.fit`, whose arguments these are.

    Notes
    -----
    Each style is a probabilistic PCA (Tipping and Bishop 1999): the r largest principal
    directions, shortened by δ², and δ² the mean variance of all others, pooled over styles.
    """
    check_count("rank", rank)
    windows, clip_of = cut_windows(motions, frames, stride)
    windows = _common_heading(windows, motions[0])
    flat = windows.reshape(len(windows), -1)
    if np.ptp(flat, axis=0).max() < 1e-9:
        raise ValueError(
            f"motions has {len(windows)} windows that are all alike, expected clips that differ"
        )
    if isinstance(styles, int):
        check_count("styles", styles)
        labels = _cluster(flat, styles, rank, seed)
        names = tuple(f"style-{k}" for k in range(styles))
    else:
        if len(styles) != len(motions):
            raise ValueError(
                f"styles has {len(styles)} labels, expected {len(motions)}, one per motion"
            )
        names = tuple(sorted(set(styles)))
        labels = np.array([names.index(styles[clip]) for clip in clip_of])
    shape = windows.shape[1:]
    means, spectra, directions = [], [], []
    for k, name in enumerate(names):
        members = windows[labels == k]
        if len(members) < rank + 2:
            raise ValueError(
                f"styles puts {len(members)} windows into {name}, expected at least {rank + 2} "
                f"for rank {rank}; give more or longer clips, fewer styles or a lower rank"
            )
        members = _turned_to_mean(members)
        mean = members.mean(axis=0)
        _, size, axes = np.linalg.svd(
            (members - mean).reshape(len(members), -1), full_matrices=False
        )
        means.append(mean)
        spectra.append(size**2 / (len(members) - 1))
        directions.append(axes[:rank])
    shares = np.bincount(labels, minlength=len(names)) / len(labels)
    left_over = np.array([spectrum[rank:].sum() for spectrum in spectra])
    variance = float(shares @ left_over) / (flat.shape[1] - rank)
    if not variance > 0:
        raise ValueError(
            f"rank is {rank}, which explains the clips to the last digit and leaves no noise, "
            "expected fewer directions than the windows span"
        )
    factors = [
        np.sqrt(np.maximum(spectrum[:rank] - variance, 0.0))[:, None] * axes
        for spectrum, axes in zip(spectra, directions, strict=True)
    ]
    return FittedStyles(
        means=np.stack(means),
        factors=np.stack(factors).reshape(len(names), rank, *shape),
        noise=float(np.sqrt(variance)),
        names=names,
        shares=shares,
    )


def cut_windows(
    motions: Sequence[Motion], frames: int, stride: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return all windows of ``frames`` frames, centred on the root, and each one's clip.

    Parameters
    ----------
    motions : sequence of Motion
        Clips of one skeleton and frame rate; those shorter than ``frames`` give no window.
    frames : int
        Frames per window.
    stride : int, optional
        Frames from one window's start to the next; a quarter of ``frames`` by default.

    Returns
    -------
    windows : ndarray, (n, frames, J, 3)
        Metres.
    clip_of : ndarray of int, (n,)
        Index of the clip that each window is from.

    Raises
    ------
    ValueError
        If there is no clip, they do not share skeleton and frame rate, or all are too short.
    """
    check_count("frames", frames)
    step = max(1, frames // 4) if stride is None else stride
    check_count("stride", step)
    if not motions:
        raise ValueError("motions must contain at least one clip, got none")
    first = motions[0]
    for motion in motions:
        if motion.skeleton != first.skeleton:
            raise ValueError(
                f"motions has {motion} beside {first}, expected clips of one skeleton; retarget "
                "them to their common joints"
            )
        if motion.fps != first.fps:
            raise ValueError(
                f"motions has {motion} beside {first}, expected clips of one frame rate; resample "
                "them"
            )
    windows, clip_of = [], []
    for clip, motion in enumerate(motions):
        for start in range(0, motion.frames - frames + 1, step):
            windows.append(motion.window(start, frames).centred().positions)
            clip_of.append(clip)
    if not windows:
        longest = max(motion.frames for motion in motions)
        raise ValueError(
            f"motions has at most {longest} frames in a clip, expected at least frames={frames}"
        )
    return np.stack(windows), np.array(clip_of)


def turn_to(motions: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the motions, each turned about the vertical to be nearest ``target``.

    Least squares over the yaw: tan ψ = Σ (x·target_z-part) / Σ (…), in closed form.
    ``(n, L, J, 3), (L, J, 3) → (n, L, J, 3)``.
    """
    x, z = motions[..., 0], motions[..., 2]
    along = (x * target[..., 0] + z * target[..., 2]).sum(axis=(1, 2))
    across = (z * target[..., 0] - x * target[..., 2]).sum(axis=(1, 2))
    return _turned(motions, np.arctan2(across, along))


def _turned(motions: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    c, s = np.cos(yaw)[:, None, None], np.sin(yaw)[:, None, None]
    x, y, z = motions[..., 0], motions[..., 1], motions[..., 2]
    return np.stack([c * x + s * z, y, c * z - s * x], axis=-1)


def _common_heading(windows: np.ndarray, motion: Motion) -> np.ndarray:
    """Turn every window so that its mean left-to-right axis points along −X.

    Skeletons without named sides are turned to the first window instead.
    """
    pairs = motion.skeleton.mirrored_pairs
    if not pairs:
        return turn_to(windows, windows[0])
    left, right = np.array(pairs).T
    side = (windows[:, :, right] - windows[:, :, left]).mean(axis=(1, 2))
    # A body that faces +Z, its up being +Y, has its right on −X.
    return _turned(windows, np.arctan2(-side[:, 2], -side[:, 0]))


def _turned_to_mean(windows: np.ndarray, sweeps: int = 5) -> np.ndarray:
    for _ in range(sweeps):
        windows = turn_to(windows, windows.mean(axis=0))
    return windows


def _cluster(flat: np.ndarray, styles: int, rank: int, seed: int) -> np.ndarray:
    """k-means on the principal coordinates, labels ordered from the largest cluster down."""
    if styles == 1:
        return np.zeros(len(flat), dtype=int)
    from scipy.cluster.vq import ClusterError, kmeans2

    centred = flat - flat.mean(axis=0)
    left, size, _ = np.linalg.svd(centred, full_matrices=False)
    scores = (left * size)[:, :rank]
    rng = seeds.generator(seed, "k-means")
    try:
        _, labels = kmeans2(scores, styles, minit="++", iter=50, rng=rng, missing="raise")
    except ClusterError as error:
        raise ValueError(
            f"styles is {styles}, but the windows of the clips fall into fewer clusters, expected "
            "a smaller number or clips that differ more"
        ) from error
    order = np.argsort(-np.bincount(labels, minlength=styles), kind="stable")
    return np.argsort(order)[labels]
