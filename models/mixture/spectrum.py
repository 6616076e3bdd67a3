"""Discrete cosine transform over frames, and spectra at other numbers of frames and frame rates.

The orthonormal DCT-II of L frames has the frequencies ν_f = f · fps / (2 L), f < L.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.fft import dct, idct

__all__ = [
    "bands",
    "from_frequencies",
    "principal_directions",
    "ramp",
    "resampled",
    "to_frequencies",
    "translations",
]

_FLOOR = 1e-8  # smallest variance of a coefficient, square metres


def to_frequencies(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the orthonormal DCT-II along an axis of frames."""
    return dct(values, axis=axis, norm="ortho")


def from_frequencies(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the inverse of :func:`to_frequencies`."""
    return idct(values, axis=axis, norm="ortho")


def ramp(frames: int, fps: float) -> np.ndarray:
    """Return the coefficients of a motion at unit velocity, centred in time, (L,), seconds."""
    times = (np.arange(frames) - (frames - 1) / 2) / fps
    return to_frequencies(times, axis=0)


def bands(frames: int) -> np.ndarray:
    """Return the band of each frequency, (L,): frequency 0, then octaves from frequency 1 on.

    The octaves are 1, 2, 3–4, 5–8, …: their upper edges are powers of two.
    """
    frequencies = np.arange(1, frames)
    return np.concatenate([[0], np.ceil(np.log2(frequencies)).astype(int) + 1])


def resampled(
    variances: np.ndarray, band: np.ndarray, fps: float, frames: int, new_fps: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return variances (K, L', P) and bands (L',) for other numbers of frames and frame rates.

    The variance of a coefficient is proportional to the spectral density times the frame rate. The
    density is that of the nearest old frequency, since neighbouring bands have different
    directions. Above the old range, it falls with the fourth power of the frequency, as that of
    white acceleration. The variance of the mean over frames is unchanged.
    """
    old = np.arange(variances.shape[1]) * fps / (2 * variances.shape[1])
    new = np.arange(frames) * new_fps / (2 * frames)
    nearest = np.abs(new[:, None] - old[None, 1:]).argmin(axis=1) + 1 if len(old) > 1 else 0 * new
    nearest = np.where(np.arange(frames) == 0, 0, nearest).astype(int)
    factor = np.full(frames, new_fps / fps)
    above = new > fps / 2
    factor[above] *= (fps / 2 / new[above]) ** 4
    factor[0] = frames / variances.shape[1]
    return variances[:, nearest] * factor[:, None], band[nearest]


def translations(n_joints: int) -> np.ndarray:
    """Return the unit translations of all joints along x and z, (3 J, 2)."""
    out = np.zeros((n_joints, 3, 2))
    out[:, 0, 0] = out[:, 2, 1] = 1 / math.sqrt(n_joints)
    return out.reshape(-1, 2)


def principal_directions(
    covariances: np.ndarray, band: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return directions of each band, (B, P, P), and variances in them, (L, P).

    ``covariances`` (L, P, P) are those of the coefficients of each frequency, ``band`` (L,) its
    band. Directions are the principal ones of a band's mean covariance; at frequency 0 the ground
    translations come first. Variances are at least 10⁻⁸ m².
    """
    L, P, _ = covariances.shape
    directions, variances = np.empty((band[-1] + 1, P, P)), np.empty((L, P))
    along = translations(P // 3)
    complement = np.linalg.qr(along, mode="complete")[0][:, 2:]
    axes = np.linalg.eigh(complement.T @ covariances[0] @ complement)[1]
    directions[0] = np.concatenate([along, complement @ axes[:, ::-1]], axis=1)
    for index in range(band[-1] + 1):
        own = covariances[band == index]
        if index > 0:
            directions[index] = np.linalg.eigh(own.mean(axis=0))[1][:, ::-1]
        V = directions[index]
        variances[band == index] = np.einsum("pi,fpi->fi", V, own @ V)
    return directions, np.maximum(variances, _FLOOR)
