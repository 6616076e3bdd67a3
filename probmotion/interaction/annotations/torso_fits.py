"""Rotation of a rigid body from orthographic projections, vectorised over projections.

The rotation R and the image translation c solve the least-squares problem

    min Σ_m ‖x_m − P R t_m − c‖²,   P = the first two rows of I,

where x_m is the projection of the body's visible point t_m. The in-plane rotation has a closed form
for each viewing direction. A grid search over directions gives the initial rotation, which
Levenberg-Marquardt steps refine. A nearly flat body has a second minimum, its reflection in the
image plane; both minima are refined.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from probmotion.geometry.rotations import vector_to_matrix
from probmotion.interaction.annotations.local_frames import cross

__all__ = ["BodyFit", "fit_body"]

_DIRECTIONS = 200  # number of viewing directions in the grid, about 14 degrees apart
_STEPS = 20  # number of Levenberg-Marquardt steps
_DAMPING = 1e-3  # initial damping relative to the mean curvature
_MIN_DAMPING = 1e-12  # minimum damping relative to the mean curvature
_ROWS = 1024  # number of projections per block


class BodyFit(NamedTuple):
    """Rigid-body fits of n projections."""

    rotations: np.ndarray  # R, (n, 3, 3), from the body's axes to the image's
    translations: np.ndarray  # c, (n, 2)
    residuals: np.ndarray  # (n,), root-mean-square residual of the visible points


def fit_body(points: np.ndarray, visible: np.ndarray, body: np.ndarray) -> BodyFit:
    """Return the least-squares rotation and translation of a rigid body for each projection.

    ``points`` (n, M, 2) have axes x right and y up; ``visible`` (n, M) marks at least one point per
    projection; ``body`` (M, 3) is in the unit of the projections.
    """
    starts = range(0, max(len(points), 1), _ROWS)
    blocks = [_fit(points[s : s + _ROWS], visible[s : s + _ROWS], body) for s in starts]
    return BodyFit(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))


def _fit(points: np.ndarray, visible: np.ndarray, body: np.ndarray) -> BodyFit:
    weights = visible.astype(np.float64)
    count = weights.sum(axis=-1)
    points = np.where(visible[..., np.newaxis], points, 0.0)
    point_mean = points.sum(axis=1) / count[:, np.newaxis]
    body_mean = weights @ body / count[:, np.newaxis]
    # Centring both point sets eliminates c.
    x = (points - point_mean[:, np.newaxis]) * weights[..., np.newaxis]
    t = (body - body_mean[:, np.newaxis]) * weights[..., np.newaxis]
    start = _best_start(x, t)
    rotations, squares = _descend(start, x, t)
    mirrored, mirrored_squares = _descend(_mirrored(start, t), x, t)
    rotations = np.where((mirrored_squares < squares)[:, None, None], mirrored, rotations)
    squares = np.minimum(squares, mirrored_squares)
    translations = point_mean - np.einsum("naj,nj->na", rotations[:, :2], body_mean)
    return BodyFit(rotations, translations, np.sqrt(squares / count))


@lru_cache(maxsize=1)
def _directions() -> np.ndarray:
    """Return rotations (G, 3, 3) whose third rows, the viewing directions, lie on a spiral."""
    index = np.arange(_DIRECTIONS) + 0.5
    z = 1 - 2 * index / _DIRECTIONS
    azimuth = np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z**2)
    third = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=-1)
    helper = np.where(np.abs(third[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(helper, third)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _best_start(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the best rotation (n, 3, 3) over all directions A and in-plane rotations Q."""
    grid = _directions()
    axes = grid[:, :2]
    # Σ‖x − Q A t‖² = Σ‖x‖² + ⟨AᵀA, Σ t tᵀ⟩ − 2 ⟨Q, Σ x (A t)ᵀ⟩; the last term is a cos + b sin.
    size = np.einsum("gai,gaj,nmi,nmj->ng", axes, axes, t, t, optimize=True)
    product = np.einsum("nma,nmj,gbj->ngab", x, t, axes, optimize=True)
    cosine = product[..., 0, 0] + product[..., 1, 1]
    sine = product[..., 1, 0] - product[..., 0, 1]
    best = np.argmin(size - 2 * np.hypot(cosine, sine), axis=-1)
    row = np.arange(len(x))
    angle = np.arctan2(sine[row, best], cosine[row, best])
    return vector_to_matrix(np.stack([0 * angle, 0 * angle, angle], axis=-1)) @ grid[best]


def _mirrored(rotations: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return D R S with reflections D in the image plane and S in the body's best-fit plane."""
    _, axes = np.linalg.eigh(np.einsum("nmi,nmj->nij", t, t))
    normal = axes[..., 0]
    reflection = np.eye(3) - 2 * normal[:, :, np.newaxis] * normal[:, np.newaxis, :]
    return np.diag([1.0, 1.0, -1.0]) @ rotations @ reflection


def _descend(rotations: np.ndarray, x: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations after Levenberg-Marquardt steps, and their sums of squares.

    Gauss-Newton would overshoot for flat bodies in frontal view: tilt has no first-order effect.
    """
    residual, squares = _residuals(rotations, x, t)
    damping = np.full(len(x), _DAMPING)
    for _ in range(_STEPS):
        # P R exp([ω]) t ≈ P R t + P R (ω × t), and a · (ω × t) = ω · (t × a).
        jacobian = cross(t[:, :, np.newaxis], rotations[:, np.newaxis, :2])
        normal = np.einsum("nmai,nmaj->nij", jacobian, jacobian)
        scale = damping * np.trace(normal, axis1=1, axis2=2) / 3 + np.finfo(float).tiny
        normal += scale[:, np.newaxis, np.newaxis] * np.eye(3)
        slope = np.einsum("nmai,nma->ni", jacobian, residual)
        step = np.linalg.solve(normal, slope[..., np.newaxis])[..., 0]
        trial = rotations @ vector_to_matrix(step)
        trial_residual, trial_squares = _residuals(trial, x, t)
        better = trial_squares < squares
        rotations = np.where(better[:, np.newaxis, np.newaxis], trial, rotations)
        residual = np.where(better[:, np.newaxis, np.newaxis], trial_residual, residual)
        squares = np.where(better, trial_squares, squares)
        damping = np.maximum(np.where(better, damping / 10, damping * 10), _MIN_DAMPING)
    return rotations, squares


def _residuals(
    rotations: np.ndarray, x: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return x − P R t, (n, M, 2), and the sums of its squares, (n,)."""
    residual = x - np.matmul(t, np.swapaxes(rotations[:, :2], 1, 2))
    return residual, (residual**2).sum(axis=(1, 2))
