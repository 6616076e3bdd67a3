"""Posterior of a window as a mixture of Gaussian modes, and its draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from probmotion.lifting.keypoints import HIPS, LIMBS
from probmotion.lifting.window_prior import WindowPrior
from probmotion.models.mixture.conditioning import rotation

__all__ = [
    "FLOOR_SPREAD", "TEMPER", "Height", "WindowGaussian", "WindowMode", "WindowPosterior",
    "WindowSummary",
]  # fmt: skip

FLOOR_SPREAD = 0.3
"""Standard deviation of the floor's height about the window's origin, metres."""
TEMPER = 0.03
"""Power of the modes' probabilities.

Below 1, it makes them more even. Chosen on validation clips, because motion unlike the clips makes
the exact posterior too narrow.
"""
_EVERY = 4  # of the frames with visible joints, one is used for the spread
_JOIN_NOISE = 0.01  # standard deviation with which draws continue earlier ones, metres


@dataclass(frozen=True, eq=False)
class WindowMode:
    """Gaussian approximation of the posterior near one mode.

    ``score`` is its log posterior mass up to a constant. ``mean``, (q,), and ``lower``, (q, q), are
    the mean and the Cholesky factor of the precision of standardised coefficients: those of the
    component, then the floor's height, then the proportions. ``positions``, (L, J, 3), are those of
    the mean, metres, and ``standardised``, (L, J) or (V, L, J), squared residuals in units of the
    noise. ``inflation`` is the factor of the draws' standard deviations.
    """

    score: float
    component: int
    yaw: int
    scale: float
    mean: np.ndarray
    lower: np.ndarray
    positions: np.ndarray
    standardised: np.ndarray
    inflation: float


class WindowGaussian:
    """One component at one heading and scale, linear in standardised coefficients."""

    def __init__(self, prior: WindowPrior, k: int, yaw: int, scale: float) -> None:
        part = prior.component(k)
        self.part, self.rotation = part, rotation(prior.yaws[yaw])
        self.deviation = np.sqrt(part.variance * np.where(part.ground, 1.0, scale))

    def positions(self, prior: WindowPrior, k: int, z: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the motions of coefficients: ``(n, q), (T,) → (n, T, J, 3)``, about the origin."""
        part, r = self.part, len(self.deviation)
        J = part.directions.shape[0]
        cosines = prior.cosines(times)[:, part.frequency]  # (T, r)
        scores = z[:, :r] * self.deviation
        flat = (scores[:, None, :] * cosines) @ part.directions.reshape(3 * J, r).T
        motions = flat.reshape(len(z), len(times), J, 3) + prior.mean_at(k, times)
        turned: np.ndarray = motions @ self.rotation.T
        turned[..., 1] += FLOOR_SPREAD * z[:, r, None, None]
        return turned

    def design(self, prior: WindowPrior, times: np.ndarray) -> np.ndarray:
        """Return d positions / d coefficients at times, (T J 3, q)."""
        part, r = self.part, len(self.deviation)
        J = part.directions.shape[0]
        cosines = prior.cosines(times)[:, part.frequency] * self.deviation
        turned = np.tensordot(self.rotation, part.directions, axes=(1, 1)).swapaxes(0, 1)
        out = np.zeros((len(times), J, 3, r + 1 + len(prior.children)))
        out[..., :r] = turned * cosines[:, None, None, :]
        out[:, :, 1, r] = FLOOR_SPREAD
        return out.reshape(len(times) * J * 3, -1)


class Height(NamedTuple):
    """Mean and standard deviation of a height, metres."""

    mean: float
    sd: float


class WindowSummary(NamedTuple):
    """Summary of the posterior of a window.

    ``floor`` and ``proportions``, the mean square of standardised bone lengths, are those of the
    most probable mode. ``spread`` is the mean standard deviation of visible joints relative to the
    middle of the hips, metres; NaN if none is visible.
    """

    floor: Height
    spread: float
    proportions: float


def _about_hips(joints: np.ndarray) -> np.ndarray:
    """Return joints of arms and legs relative to the middle of the hips, (T, J, …) → (T, 12, …)."""
    relative: np.ndarray = joints[:, LIMBS] - joints[:, HIPS].mean(axis=1, keepdims=True)
    return relative


@dataclass(frozen=True, eq=False)
class WindowPosterior:
    """Mixture of modes of one window.

    Positions are relative to the camera, or in the world of several cameras, metres. ``visible``,
    (L, J), is whether a joint is visible in some view.
    """

    prior: WindowPrior
    origin: np.ndarray
    modes: tuple[WindowMode, ...]
    visible: np.ndarray

    @property
    def probabilities(self) -> np.ndarray:
        """Probabilities of the modes."""
        scores = np.array([mode.score for mode in self.modes])
        weights = np.exp(TEMPER * (scores - scores.max()))
        return weights / weights.sum()

    @property
    def best(self) -> WindowMode:
        """The most probable mode."""
        return max(self.modes, key=lambda mode: mode.score)

    @property
    def floor(self) -> Height:
        """Height of the floor in the most probable mode, metres."""
        mode = self.best
        place = len(self.prior.component(mode.component).variance)
        unit = np.zeros(len(mode.mean))
        unit[place] = FLOOR_SPREAD
        half = solve_triangular(mode.lower, unit, lower=True)
        height = self.origin[1] + FLOOR_SPREAD * mode.mean[place]
        return Height(float(height), float(mode.inflation * np.sqrt(half @ half)))

    @property
    def summary(self) -> WindowSummary:
        """Floor, spread and proportions."""
        bones = len(self.prior.children)
        proportions = float((self.best.mean[-bones:] ** 2).mean())
        return WindowSummary(self.floor, self._spread(), proportions)

    def _spread(self) -> float:
        """Return the mean standard deviation of visible joints about the hips, metres."""
        shown = self.visible[:, LIMBS]
        frames = np.flatnonzero(shown.any(axis=1))[::_EVERY]
        if not len(frames):
            return np.nan
        first = second = np.zeros((len(frames), len(LIMBS), 3))  # moments
        for p, mode in zip(self.probabilities, self.modes, strict=True):
            gaussian = self._gaussian(mode)
            at = gaussian.positions(self.prior, mode.component, mode.mean[None], frames)
            design = gaussian.design(self.prior, frames).reshape(*at.shape[1:], -1)
            mean, rows = _about_hips(at[0]), _about_hips(design)
            half = solve_triangular(mode.lower, rows.reshape(mean.size, -1).T, lower=True)
            variance = (mode.inflation * half).reshape(-1, *mean.shape) ** 2
            first = first + p * mean
            second = second + p * (mean**2 + variance.sum(axis=0))
        return float(np.sqrt((second - first**2).sum(axis=-1))[shown[frames]].mean())

    def mean(self, times: np.ndarray) -> np.ndarray:
        """Return the posterior mean at times in frames of the window, (T, J, 3)."""
        parts = [
            p * self._gaussian(mode).positions(self.prior, mode.component, mode.mean[None], times)
            for p, mode in zip(self.probabilities, self.modes, strict=True)
        ]
        mean: np.ndarray = np.sum(parts, axis=0)[0] + self.origin
        return mean

    def sample(
        self,
        rng: np.random.Generator,
        n: int,
        times: np.ndarray,
        joined: np.ndarray | None = None,
        earlier: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return posterior draws at times, (n, T, J, 3).

        ``earlier``, (n, O, J, 3), are draws at the times ``joined``, (O,), that the draws
        continue: they are observed to within a centimetre.
        """
        units = rng.standard_normal((n, max(len(mode.mean) for mode in self.modes)))
        chances = rng.random(n)
        slack = _JOIN_NOISE * rng.standard_normal((n, 0 if earlier is None else earlier[0].size))
        log_weights = np.repeat(np.log(self.probabilities)[None], n, axis=0)
        corrections = []
        if joined is not None and earlier is not None:
            target = (earlier - self.origin).reshape(n, -1)
            for index, mode in enumerate(self.modes):
                gaussian = self._gaussian(mode)
                design = gaussian.design(self.prior, joined)
                half = mode.inflation * solve_triangular(mode.lower, design.T, lower=True)
                covariance = half.T @ half + _JOIN_NOISE**2 * np.eye(half.shape[1])
                factor = np.linalg.cholesky(covariance)
                centre = gaussian.positions(self.prior, mode.component, mode.mean[None], joined)
                off = solve_triangular(factor, (target - centre.reshape(1, -1)).T, lower=True)
                log_weights[:, index] -= 0.5 * (off**2).sum(axis=0) + np.log(np.diag(factor)).sum()
                corrections.append((half, factor, target))
        weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
        cumulative = np.cumsum(weights, axis=1)
        chosen = (cumulative < chances[:, None] * cumulative[:, -1:]).sum(axis=1)
        out = np.empty((n, len(times), len(self.prior.children) + 1, 3))
        for index in np.unique(chosen).tolist():
            mode, rows = self.modes[index], np.flatnonzero(chosen == index)
            gaussian, q = self._gaussian(mode), len(mode.mean)
            unit = mode.inflation * units[rows, :q].T
            z = mode.mean + solve_triangular(mode.lower, unit, lower=True, trans=1).T
            if corrections and joined is not None:
                half, factor, target = corrections[index]
                at = gaussian.positions(self.prior, mode.component, z, joined)
                gap = target[rows] + slack[rows] - at.reshape(len(rows), -1)
                inner = solve_triangular(factor, gap.T, lower=True)
                inner = solve_triangular(factor, inner, lower=True, trans=1)
                change = solve_triangular(mode.lower, half @ inner, lower=True, trans=1).T
                z = z + mode.inflation * change
            out[rows] = gaussian.positions(self.prior, mode.component, z, times) + self.origin
        return out

    def _gaussian(self, mode: WindowMode) -> WindowGaussian:
        return WindowGaussian(self.prior, mode.component, mode.yaw, mode.scale)
