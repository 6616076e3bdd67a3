"""Spectral prior of short windows of motion, in coordinates that keypoints can determine."""

from __future__ import annotations

from functools import cached_property
from threading import Lock
from typing import NamedTuple

import numpy as np

from probmotion.models.mixture.conditioning import rotation
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion

__all__ = ["ReducedComponent", "WindowPrior"]

_SCREENS = 6  # cameras and sets of joints whose screening is kept
_LOW = 12  # frequencies by which components are screened
_SCREEN_NOISE = 0.03  # of the screened keypoints with the neglected perspective, metres
_PITCH_STEP = np.radians(20.0)  # between the cameras of the screening


class ReducedComponent(NamedTuple):
    """Gaussian component X(t) = m(t) + Σ_r s_r z_r c_r(t) V_r, with standard normal z.

    Attributes
    ----------
    mean : ndarray, (L, J, 3)
        m, metres, in the canonical heading.
    basis : ndarray, (L, J, 3, r)
        c_r(t) V_r at the window's frames.
    directions : ndarray, (J, 3, r)
        V_r.
    frequency : ndarray of int, (r,)
        Frequency of the cosine c_r.
    variance : ndarray, (r,)
        s_r² at scale 1, square metres; that of ground translations at every scale.
    ground : ndarray of bool, (r,)
        Whether the coefficient is a translation on the ground.
    bones : ndarray, (J − 1,)
        Root mean square length of each joint's bone to its parent, metres.
    """

    mean: np.ndarray
    basis: np.ndarray
    directions: np.ndarray
    frequency: np.ndarray
    variance: np.ndarray
    ground: np.ndarray
    bones: np.ndarray


class WindowPrior:
    """Components of a spectral prior for windows of L frames at a lower frame rate.

    Parameters
    ----------
    prior : SpectralMixtureMotion
    frames : int
        L.
    fps : float
        Frame rate of the windows.
    smallest : float
        Prior standard deviation below which coefficients are set to 0, metres: keypoints of one
        camera hardly determine those below 2 cm.
    """

    def __init__(
        self, prior: SpectralMixtureMotion, frames: int, fps: float, smallest: float = 0.02
    ) -> None:
        self.prior = prior.resampled(frames, fps)
        self.frames, self.fps, self.smallest = frames, fps, smallest
        self.low = min(_LOW, frames)
        self.log_weights = np.log(prior.weights)
        self.yaws = prior.yaws
        self.scales = prior.scales
        parents = np.array(prior.skeleton.parents)
        self.children = np.flatnonzero(parents >= 0)
        self.parents = parents[self.children]
        self._reduced: dict[int, ReducedComponent] = {}
        self._lock = Lock()  # two threads fit windows
        self._screens: dict[tuple[int, ...], tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def cosines(self, times: np.ndarray) -> np.ndarray:
        """Return the orthonormal cosines at times in frames of the window, (T, L)."""
        L = self.frames
        values = np.cos(np.pi * np.arange(L) * (2 * times[:, None] + 1) / (2 * L))
        norms = np.full(L, np.sqrt(2 / L))
        norms[0] = np.sqrt(1 / L)
        return values * norms

    def component(self, k: int) -> ReducedComponent:
        """Return component k in the coefficients that are kept."""
        if k not in self._reduced:
            self._reduced[k] = self._reduce(k)
        return self._reduced[k]

    def _reduce(self, k: int) -> ReducedComponent:
        prior, L = self.prior, self.frames
        J = prior.skeleton.n_joints
        variances = prior.variances[k]
        kept = np.sqrt(variances) > self.smallest
        kept[0, :2] = True
        frequency, direction = np.nonzero(kept)
        V = prior.directions[k][prior.band[frequency], :, direction]  # (r, 3 J)
        ground = (frequency == 0) & (direction < 2)
        variance = variances[frequency, direction].copy()
        variance[ground] = J * L * prior.ground**2
        basis = np.einsum("tr,rp->tpr", self._cosines[:, frequency], V).reshape(L, J, 3, -1)
        mean = self._means[k]
        every = prior.directions[k][prior.band].reshape(L, J, 3, -1)
        along = every[:, self.children] - every[:, self.parents]
        square = np.einsum("ljcp,lp->j", along**2, variances) / L
        average = (mean[:, self.children] - mean[:, self.parents]).mean(axis=0)
        bones = np.sqrt((average**2).sum(axis=-1) + square)
        directions = V.T.reshape(J, 3, -1)
        return ReducedComponent(mean, basis, directions, frequency, variance, ground, bones)

    def mean_at(self, k: int, times: np.ndarray) -> np.ndarray:
        """Return the mean motion of component k at times in frames of the window, (T, J, 3)."""
        poses = np.repeat(self.prior.poses[k][None], len(times), axis=0)
        seconds = (times - (self.frames - 1) / 2) / self.fps
        poses[..., [0, 2]] += seconds[:, None, None] * self.prior.velocities[k]
        return poses

    @cached_property
    def _cosines(self) -> np.ndarray:
        return self.cosines(np.arange(self.frames))

    @cached_property
    def _means(self) -> list[np.ndarray]:
        times = np.arange(self.frames)
        return [self.mean_at(k, times) for k in range(len(self.log_weights))]

    def screen(self, points: np.ndarray, joints: list[int], pitch: float) -> np.ndarray:
        """Return approximate log p(points, component, heading), (K, A), up to a constant.

        Parameters
        ----------
        points : ndarray, (L, n, 2)
            Keypoints as orthographic projections in metres, right and up, without gaps, relative
            to the projection of the prior's origin.
        joints : list of int
            Their joints.
        pitch : float
            Pitch of the camera, radians.
        """
        step = round(pitch / _PITCH_STEP)
        key = (step, *joints)
        with self._lock:
            if key not in self._screens:
                while len(self._screens) >= _SCREENS:
                    self._screens.pop(next(iter(self._screens)))
                self._screens[key] = self._views(step * _PITCH_STEP, joints)
            precision, mean, offset = self._screens[key]
        low = self.low
        coefficients = np.tensordot(self._cosines[:, :low], points, axes=(0, 0)).reshape(low, -1)
        deviation = (coefficients - mean).astype(np.float32)
        square = ((precision @ deviation[..., None])[..., 0] * deviation).sum(axis=(2, 3))
        return offset - 0.5 * square

    def _views(self, pitch: float, joints: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return precisions (K, A, F, 2J, 2J), means and log weights of orthographic views."""
        prior, low = self.prior, self.low
        K, A, J = len(self.log_weights), len(self.yaws), len(joints)
        camera = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(pitch), np.sin(pitch)]])
        precision = np.empty((K, A, low, 2 * J, 2 * J), np.float32)
        mean = np.empty((K, A, low, 2 * J), np.float32)
        offset = np.empty((K, A))
        for k in range(K):
            V = prior.directions[k][prior.band[:low]]
            V = V.reshape(low, -1, 3, V.shape[-1])[:, joints]
            variances = prior.variances[k][:low].copy()
            variances[0, :2] = prior.skeleton.n_joints * self.frames * prior.ground**2
            means = self._means[k][:, joints]
            motion = np.tensordot(self._cosines[:, :low], means, axes=(0, 0))
            for a, yaw in enumerate(self.yaws):
                view = camera @ rotation(yaw)
                seen = (view @ V).reshape(low, 2 * J, -1)
                covariance = (seen * variances[:, None]) @ seen.swapaxes(1, 2)
                covariance += _SCREEN_NOISE**2 * np.eye(2 * J)
                precision[k, a] = np.linalg.inv(covariance)
                mean[k, a] = (motion @ view.T).reshape(low, -1)
                offset[k, a] = -0.5 * np.linalg.slogdet(covariance)[1].sum()
        return precision, mean, offset + self.log_weights[:, None]
