"""Fitting of Gaussian mixtures: windows, heading alignment, probabilistic PCA per style."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from probmotion import seeds
from probmotion.models.bodies.body_states import turned_about_vertical
from probmotion.motion.motion import Motion
from probmotion.validation import check_count

__all__ = ["cut_windows", "fit_styles"]


def fit_styles(
    motions: Sequence[Motion],
    frames: int,
    rank: int,
    styles: int | Sequence[str],
    stride: int | None,
    seed: int,
) -> dict[str, Any]:
    """Fit a mixture and return its fields; arguments as in :meth:`GaussianMixtureMotion.fit`.

    Each style is a probabilistic PCA (Tipping and Bishop 1999) with r principal directions. Their
    variances are reduced by δ², the mean variance of all other directions, pooled over styles.
    """
    check_count("rank", rank)
    windows, clip_of = cut_windows(motions, frames, stride)
    windows = _common_heading(windows, motions[0])
    flat = windows.reshape(len(windows), -1)
    if np.ptp(flat, axis=0).max() < 1e-9:
        raise ValueError(f"motions must contain different windows, got {len(windows)} equal ones")
    if isinstance(styles, int):
        check_count("styles", styles)
        labels = _cluster(flat, styles, rank, seed)
        names = tuple(f"style-{k}" for k in range(styles))
    else:
        if len(styles) != len(motions):
            raise ValueError(
                f"styles must contain {len(motions)} labels, one per motion, got {len(styles)}"
            )
        names = tuple(sorted(set(styles)))
        labels = np.array([names.index(styles[clip]) for clip in clip_of])
    shape = windows.shape[1:]
    means, spectra, directions = [], [], []
    for k, name in enumerate(names):
        members = windows[labels == k]
        if len(members) < rank + 2:
            raise ValueError(
                f"style {name} must have at least {rank + 2} windows for rank {rank}, got "
                f"{len(members)}; use more or longer clips, fewer styles or a lower rank"
            )
        members = _rotated_to_mean(members)
        mean = members.mean(axis=0)
        centred = (members - mean).reshape(len(members), -1)
        _, size, axes = np.linalg.svd(centred, full_matrices=False)
        means.append(mean)
        spectra.append(size**2 / (len(members) - 1))
        directions.append(axes[:rank])
    proportions = np.bincount(labels, minlength=len(names)) / len(labels)
    remainder = np.array([spectrum[rank:].sum() for spectrum in spectra])
    variance = float(proportions @ remainder) / (flat.shape[1] - rank)
    if not variance > 0:
        raise ValueError(f"rank must be below the dimension of the windows' span, got {rank}")
    factors = [
        np.sqrt(np.maximum(spectrum[:rank] - variance, 0.0))[:, None] * axes
        for spectrum, axes in zip(spectra, directions, strict=True)
    ]
    return {
        "means": np.stack(means),
        "factors": np.stack(factors).reshape(len(names), rank, *shape),
        "noise": float(np.sqrt(variance)),
        "styles": names,
        "weights": proportions,
    }


def cut_windows(
    motions: Sequence[Motion], frames: int, stride: int | None = None, *, centred: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return all windows of clips, (n, frames, J, 3), and clip indices (n,).

    ``stride`` is the number of frames between window starts, by default ``frames // 4``. Clips
    shorter than ``frames`` are skipped. With ``centred``, the root's mean position is the origin.

    Raises
    ------
    ValueError
        If there is no clip, clips differ in skeleton or frame rate, or all are too short.
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
                f"motions must share one skeleton, got {motion} and {first}; retarget them to "
                "their common joints"
            )
        if motion.fps != first.fps:
            raise ValueError(
                f"motions must share one frame rate, got {motion} and {first}; resample them"
            )
    windows, clip_of = [], []
    for clip, motion in enumerate(motions):
        for start in range(0, motion.frames - frames + 1, step):
            window = motion.window(start, frames)
            windows.append((window.centred() if centred else window).positions)
            clip_of.append(clip)
    if not windows:
        longest = max(motion.frames for motion in motions)
        raise ValueError(
            f"motions must contain a clip of at least {frames} frames, got at most {longest}"
        )
    return np.stack(windows), np.array(clip_of)


def turn_to(motions: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return motions rotated about the vertical to fit ``target`` by least squares.

    ``(n, L, J, 3), (L, J, 3) → (n, L, J, 3)``.
    """
    x, z = motions[..., 0], motions[..., 2]
    along = (x * target[..., 0] + z * target[..., 2]).sum(axis=(1, 2))
    across = (z * target[..., 0] - x * target[..., 2]).sum(axis=(1, 2))
    return turned_about_vertical(motions, np.arctan2(across, along))


def _common_heading(windows: np.ndarray, motion: Motion) -> np.ndarray:
    """Rotate every window so that its mean left-to-right axis points along −X.

    Without left-right pairs, windows are aligned with the first window instead.
    """
    pairs = motion.skeleton.mirrored_pairs
    if not pairs:
        return turn_to(windows, windows[0])
    left, right = np.array(pairs).T
    side = (windows[:, :, right] - windows[:, :, left]).mean(axis=(1, 2))
    # With +Y up, a body that faces +Z has its right side at −X.
    return turned_about_vertical(windows, np.arctan2(-side[:, 2], -side[:, 0]))


def _rotated_to_mean(windows: np.ndarray, sweeps: int = 5) -> np.ndarray:
    for _ in range(sweeps):
        windows = turn_to(windows, windows.mean(axis=0))
    return windows


def _cluster(flat: np.ndarray, styles: int, rank: int, seed: int) -> np.ndarray:
    """Return k-means labels in principal coordinates, largest cluster first."""
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
            f"styles must be at most the number of clusters in the windows, got {styles}; use "
            "fewer styles or clips that differ more"
        ) from error
    order = np.argsort(-np.bincount(labels, minlength=styles), kind="stable")
    return np.argsort(order)[labels]
