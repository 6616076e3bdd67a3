"""One rigid body turned to fit orthographic pictures of it, many pictures at once.

Least squares over rotations R and image translations c,

    min Σ_m ‖x_m − P R t_m − c‖²,   P = the first two rows of I,

over the visible points m. For a given viewing direction the best turn in the image has a closed
form, so that starts are searched on a sphere of directions alone; damped least squares do the rest.
An almost flat body and its reflection in the image plane have almost the same picture, which makes
two minima: the search descends into both and keeps the better.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from probmotion.geometry.rotations import vector_to_matrix
from probmotion.interaction.annotations.local_frames import cross

__all__ = ["BodyFit", "fit_body"]

_DIRECTIONS = 200  # about 14 degrees apart
_STEPS = 20
_DAMPING = 1e-3  # of the mean curvature, at first; ten times less after each step that helped
_LEAST_DAMPING = 1e-12
_ROWS = 1024


class BodyFit(NamedTuple):
    """What :func:`fit_body` found for n pictures.

    Attributes
    ----------
    rotations : ndarray, (n, 3, 3)
        R, from the body's axes to the image's.
    translations : ndarray, (n, 2)
        c, where the body's origin appears.
    residuals : ndarray, (n,)
        Root-mean-square distance of the visible points from the fit.
    """

    rotations: np.ndarray
    translations: np.ndarray
    residuals: np.ndarray


def fit_body(points: np.ndarray, visible: np.ndarray, body: np.ndarray) -> BodyFit:
    """Return the rotation and translation of a rigid body that fit each picture best.

    Parameters
    ----------
    points : ndarray, (n, M, 2)
        The pictures, x right and y up; hidden points are not read.
    visible : ndarray, (n, M)
        Which points are seen, at least one in each picture.
    body : ndarray, (M, 3)
        The body, in the pictures' unit.
    """
    n = len(points)
    fit = BodyFit(np.empty((n, 3, 3)), np.empty((n, 2)), np.empty(n))
    for start in range(0, n, _ROWS):
        rows = slice(start, start + _ROWS)
        for whole, part in zip(fit, _fit(points[rows], visible[rows], body), strict=True):
            whole[rows] = part
    return fit


def _fit(points: np.ndarray, visible: np.ndarray, body: np.ndarray) -> BodyFit:
    weights = visible.astype(np.float64)
    count = weights.sum(axis=-1)
    points = np.where(visible[..., np.newaxis], points, 0.0)
    point_mean = points.sum(axis=1) / count[:, np.newaxis]
    body_mean = weights @ body / count[:, np.newaxis]
    # The best c for any R is what the means say: centred points have none.
    x = (points - point_mean[:, np.newaxis]) * weights[..., np.newaxis]
    t = (body - body_mean[:, np.newaxis]) * weights[..., np.newaxis]
    start = _best_start(x, t)
    rotations, squares = _descend(start, x, t)
    mirrored, squares_mirrored = _descend(_mirrored(start, t), x, t)
    better = squares_mirrored < squares
    rotations = np.where(better[:, np.newaxis, np.newaxis], mirrored, rotations)
    squares = np.where(better, squares_mirrored, squares)
    translations = point_mean - np.einsum("naj,nj->na", rotations[:, :2], body_mean)
    return BodyFit(rotations, translations, np.sqrt(squares / count))


@lru_cache(maxsize=1)
def _directions() -> np.ndarray:
    """Return rotations (G, 3, 3) whose third rows lie evenly on the sphere (a spiral)."""
    number = np.arange(_DIRECTIONS) + 0.5
    z = 1 - 2 * number / _DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * number
    ring = np.sqrt(1 - z**2)
    third = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
    aside = np.where(np.abs(third[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    first = np.cross(aside, third)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(third, first), third], axis=1)


def _best_start(x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the best rotation (n, 3, 3) over all directions, each turned best in the image."""
    grid = _directions()
    axes = grid[:, :2]
    # Σ‖x − Q A t‖² = Σ‖x‖² + ⟨AᵀA, Σ t tᵀ⟩ − 2 ⟨Q, Σ x (A t)ᵀ⟩; the last is a cos + b sin.
    size = np.einsum("gai,gaj,nmi,nmj->ng", axes, axes, t, t, optimize=True)
    product = np.einsum("nma,nmj,gbj->ngab", x, t, axes, optimize=True)
    cosine = product[..., 0, 0] + product[..., 1, 1]
    sine = product[..., 1, 0] - product[..., 0, 1]
    best = np.argmin(size - 2 * np.hypot(cosine, sine), axis=-1)
    row = np.arange(len(x))
    angle = np.arctan2(sine[row, best], cosine[row, best])
    return vector_to_matrix(np.stack([0 * angle, 0 * angle, angle], axis=-1)) @ grid[best]


def _mirrored(rotations: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return D R S, D the reflection in the image plane, S that in the body's flattest plane.

    Where the body is flat S changes no point, and D changes no picture.
    """
    _, axes = np.linalg.eigh(np.einsum("nmi,nmj->nij", t, t))
    normal = axes[..., 0]
    reflection = np.eye(3) - 2 * normal[:, :, np.newaxis] * normal[:, np.newaxis, :]
    return np.diag([1.0, 1.0, -1.0]) @ rotations @ reflection


def _descend(rotations: np.ndarray, x: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations after Levenberg-Marquardt steps, and their sums of squares; none rises.

    Plain Gauss-Newton overshoots where a flat body is seen from its front: to first order no
    tilt shows there.
    """
    residual = x - _pictures(rotations, t)
    squares = (residual**2).sum(axis=(1, 2))
    damping = np.full(len(x), _DAMPING)
    for _ in range(_STEPS):
        # P R exp([ω]) t ≈ P R t + P R (ω × t), and a · (ω × t) = ω · (t × a).
        jacobian = cross(t[:, :, np.newaxis], rotations[:, np.newaxis, :2])
        normal = np.einsum("nmai,nmaj->nij", jacobian, jacobian)
        scale = damping * np.trace(normal, axis1=1, axis2=2) / 3 + np.finfo(float).tiny
        normal += scale[:, np.newaxis, np.newaxis] * np.eye(3)
        slope = np.einsum("nmai,nma->ni", jacobian, residual)
        step = np.linalg.solve(normal, slope[..., np.newaxis])[..., 0]
        tried = rotations @ vector_to_matrix(step)
        left = x - _pictures(tried, t)
        tried_squares = (left**2).sum(axis=(1, 2))
        better = tried_squares < squares
        rotations = np.where(better[:, np.newaxis, np.newaxis], tried, rotations)
        residual = np.where(better[:, np.newaxis, np.newaxis], left, residual)
        squares = np.where(better, tried_squares, squares)
        damping = np.maximum(np.where(better, damping / 10, damping * 10), _LEAST_DAMPING)
    return rotations, squares


def _pictures(rotations: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return P R t: ``(n, M, 2)``."""
    return np.matmul(t, np.swapaxes(rotations[:, :2], 1, 2))
