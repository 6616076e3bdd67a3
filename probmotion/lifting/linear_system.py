"""Linear observations of the standardised coefficients of a window, and their posterior.

The coefficients are those of a component, the floor's height, and the proportions of the bones.
Keypoints and bones are linearised. A foot stands or moves: of an ankle with velocity v and height h
above the floor, u = (v / 12 cm/s, (h − 7.5 cm) / 1.5 cm) has the factor 1 + 90 exp(−|u|² / 2), a
mixture of a normal and a flat density. Only feet that stand on the floor are held.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from probmotion.lifting.keypoints import ANKLES, HIPS, LIMBS
from probmotion.lifting.window_posterior import FLOOR_SPREAD, Height, WindowGaussian
from probmotion.lifting.window_prior import WindowPrior

__all__ = [
    "PROPORTIONS", "Ankles", "EstimatedDepths", "LinearKeypoints", "Solution",
    "depth_rows", "floor_rows", "linear_system", "standing_ankles",
]  # fmt: skip

PROPORTIONS = 0.03
"""Relative standard deviation of a bone's length between people."""
_BONE_NOISE = 0.01  # standard deviation of a bone's length between frames, metres
_SLOW = 0.12  # standard deviation of the velocity of standing ankles, metres per second
_ANKLE, _RISE = 0.075, 0.015  # mean and standard deviation of their height, metres
_ODDS = 90.0  # density of standing where it is largest, relative to that of moving


class LinearKeypoints(NamedTuple):
    """Keypoints A X = t of n positions X about the origin, and precisions of the two sides.

    ``matrix`` is (n, 2, 3), ``target`` (n, 2), ``weight`` (n,), ``places`` their frames and joints.
    """

    matrix: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    places: tuple[np.ndarray, ...]


class EstimatedDepths(NamedTuple):
    """Depths of the joints of arms and legs behind the middle of the hips, as a regression says.

    ``values`` and the standard deviations ``sd`` of their errors, infinite where unknown, are
    (L, 12), metres. ``rays`` are the directions of depth, unit vectors (L, 3). ``disagreement`` is
    that of an image and its mirror image, metres.
    """

    values: np.ndarray
    sd: np.ndarray
    rays: np.ndarray
    disagreement: float


class Ankles:
    """Velocities and heights of the two ankles between neighbouring frames.

    In units of their scales, they are ``design`` z − ``residual`` of the coefficients z of a
    component: (L − 1, 2, 4, r) and (L − 1, 2, 4).
    """

    def __init__(self, gaussian: WindowGaussian, fps: float) -> None:
        basis, mean = gaussian.part.basis[:, ANKLES], gaussian.part.mean[:, ANKLES]
        moved = [np.diff(x, axis=0) * fps / _SLOW for x in (basis * gaussian.deviation, mean)]
        height, middle = ((x[1:, :, 1:2] + x[:-1, :, 1:2]) / 2 for x in (basis, mean))
        rise = height * gaussian.deviation / _RISE
        self.design = np.concatenate([moved[0], rise], axis=2)
        self.residual = -np.concatenate([moved[1], (middle - _ANKLE) / _RISE], axis=2)

    def squares(self, z: np.ndarray) -> np.ndarray:
        """Return |u|² of coefficients, ``(r,) → (L − 1, 2)``."""
        square: np.ndarray = ((self.residual - self.design @ z) ** 2).sum(axis=-1)
        return square

    @staticmethod
    def log_factor(squares: np.ndarray) -> float:
        """Return the logarithm of the factor of all |u|²."""
        return float(np.log1p(_ODDS * np.exp(-squares / 2)).sum())

    @staticmethod
    def standing(squares: np.ndarray) -> np.ndarray:
        """Return the probabilities of standing, which are the expected precisions."""
        odds: np.ndarray = _ODDS * np.exp(-squares / 2)
        return odds / (1 + odds)


def standing_ankles(ankles: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Return how much higher than on the floor y = 0 ankles (L, 2, 3) are, and whether they stand.

    Heights are in metres; of standing, it is the probability, (L, 2).
    """
    speed = np.linalg.norm(np.gradient(ankles, 1 / fps, axis=0), axis=-1)
    height = ankles[..., 1] - _ANKLE
    return height, Ankles.standing((speed / _SLOW) ** 2 + (height / _RISE) ** 2)


class Solution(NamedTuple):
    """Gaussian posterior of the coefficients, its log mass, and the design of the keypoints."""

    mean: np.ndarray
    lower: np.ndarray
    score: float
    design: np.ndarray

    @property
    def leverage(self) -> np.ndarray:
        """Leverages of the keypoints, (n,)."""
        half = solve_triangular(self.lower, self.design.T, lower=True)
        total: np.ndarray = (half**2).sum(axis=0).reshape(-1, 2).sum(axis=1)
        return total


class _System(NamedTuple):
    """Linear observations of a Gaussian's standard normal coefficients, in units of their noise.

    The first ``keypoints`` rows are those of keypoints. Residuals of the first ``robust`` rows do
    not count for the score. ``gram`` is Dᵀ D of the design D, ``pull`` is Dᵀ y for the residual y,
    plus the force.
    """

    design: np.ndarray
    residual: np.ndarray
    gram: np.ndarray
    pull: np.ndarray
    keypoints: int
    robust: int

    def solution(self, factor: np.ndarray) -> Solution:
        """Return the posterior with the component's deviations multiplied by a factor, (r,)."""
        factors = np.ones(len(self.pull))
        factors[: len(factor)] = factor
        precision = factors[:, None] * self.gram * factors
        precision[np.diag_indices(len(factors))] += 1.0
        lower = np.linalg.cholesky(precision)
        z = solve_triangular(lower, factors * self.pull, lower=True)
        z = solve_triangular(lower, z, lower=True, trans=1)
        off = self.residual[self.robust :] - self.design[self.robust :] @ (factors * z)
        score = -0.5 * (z @ z + off @ off) - np.log(np.diag(lower)).sum()
        return Solution(z, lower, score, self.design[: self.keypoints] * factors)


def depth_rows(
    gaussian: WindowGaussian, depths: EstimatedDepths | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return design (m, r + 1) and residuals (m,) of estimated depths, in units of their noise.

    The last coefficient is the floor's height.
    """
    part, sd = gaussian.part, gaussian.deviation
    if depths is None:
        return np.zeros((0, len(sd) + 1)), np.zeros(0)
    frames, limbs = np.nonzero(np.isfinite(depths.sd))
    rays, spread = (depths.rays @ gaussian.rotation)[frames], depths.sd[frames, limbs]
    joints = np.array(LIMBS)[limbs]
    basis, mean = (
        values[frames, joints] - values[:, HIPS].mean(axis=1)[frames]
        for values in (part.basis, part.mean)
    )
    design = (rays[:, None] @ basis)[:, 0] * sd / spread[:, None]
    residual = (depths.values[frames, limbs] - (mean * rays).sum(axis=-1)) / spread
    return np.pad(design, ((0, 0), (0, 1))), residual


def floor_rows(
    gaussian: WindowGaussian, floor: Height | None, origin: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return design (m, r + 1) and residuals (m,) of the floor above the height of the origin."""
    if floor is None:
        return np.zeros((0, len(gaussian.deviation) + 1)), np.zeros(0)
    design = np.zeros((1, len(gaussian.deviation) + 1))
    design[0, -1] = FLOOR_SPREAD / floor.sd
    return design, np.array([(floor.mean - origin) / floor.sd])


def linear_system(
    prior: WindowPrior,
    gaussian: WindowGaussian,
    keypoints: LinearKeypoints,
    feet: tuple[Ankles, np.ndarray],
    known: tuple[np.ndarray, np.ndarray],
    pose: np.ndarray,
    force: np.ndarray,
) -> _System:
    """Return the system of linear observations and a force.

    ``feet`` are the ankles and the probabilities that they stand, ``known`` is the design and the
    residuals of depths and the floor. Bones are linearised about a pose.
    """
    part, R, sd = gaussian.part, gaussian.rotation, gaussian.deviation
    matrix, target, weight, places = keypoints
    L, J = pose.shape[:2]
    r, bones = len(sd), J - 1
    (ankles, standing), (lines, left) = feet, known
    q, k = r + 1 + bones, 2 * len(weight)
    n = k + ankles.residual.size
    m = n + L * bones
    root = np.sqrt(weight)[..., None]
    turned = (matrix * root[..., None]) @ R
    design, residual = np.zeros((m + len(left), q)), np.empty(m + len(left))
    design[:k, :r] = ((turned @ part.basis[places]) * sd).reshape(k, r)
    design[:k, r] = (matrix[..., 1] * root).ravel() * FLOOR_SPREAD
    residual[:k] = (target * root - (turned @ part.mean[places][..., None])[..., 0]).ravel()
    held = np.sqrt(standing)[..., None]
    design[k:n, :r] = (ankles.design * held[..., None]).reshape(n - k, r)
    residual[k:n] = (ankles.residual * held).ravel()
    # Bones, linearised along their current directions.
    along = pose[:, prior.children] - pose[:, prior.parents]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), _BONE_NOISE) @ R
    spread = (part.directions[prior.children] - part.directions[prior.parents]) * sd
    cosines = prior.cosines(np.arange(L))[:, part.frequency] / _BONE_NOISE
    rows = (along.swapaxes(0, 1) @ spread).swapaxes(0, 1) * cosines[:, None]
    design[n:m, :r] = rows.reshape(L * bones, r)
    own = np.arange(L * bones)
    design[n + own, r + 1 + own % bones] = -np.tile(part.bones, L) * PROPORTIONS / _BONE_NOISE
    average = part.mean[:, prior.children] - part.mean[:, prior.parents]
    residual[n:m] = (part.bones - (along * average).sum(axis=-1)).ravel() / _BONE_NOISE
    design[m:, : r + 1], residual[m:] = lines, left
    pull = design.T @ residual
    pull[:r] += np.tensordot(force @ R, part.basis, axes=3) * sd
    pull[r] += force[..., 1].sum() * FLOOR_SPREAD
    return _System(design, residual, design.T @ design, pull, k, n)
