"""Conditioning of rotated spectral components on linear Gaussian observations, with gaps.

At each frame and joint the likelihood of a position x is exp(−½ xᵀΛx + ηᵀx). Most entries have the
same information Λ₀, under which frequencies are independent: the conditional covariance P₀ is a
3J × 3J matrix K_f for each frequency. The other entries, such as gaps, differ by Δ = Λ − Λ₀, which
the Woodbury identity takes into account exactly,

    P = P₀ − P₀ S Z Sᵀ P₀,  Z = Δ (I + G Δ)⁻¹,  G = Sᵀ P₀ S,

where S selects these entries. As products of cosines are sums of cosines, P₀ between frames t and
t' is Q(t − t') + Q(t + t' + 1), where Q is the inverse Fourier transform of K_f.
"""

from __future__ import annotations

import math
from collections import Counter
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.linalg

from probmotion.models.mixture.spectrum import from_frequencies, to_frequencies

__all__ = ["Component", "Components", "Conditional", "Information", "rotation", "turned"]


class Component(NamedTuple):
    """Gaussian component in its canonical frame.

    ``mean`` (L, J, 3), metres; ``directions`` (B, P, P) of each band of frequencies; ``band`` (L,);
    ``variances`` (L, P).
    """

    mean: np.ndarray
    directions: np.ndarray
    band: np.ndarray
    variances: np.ndarray

    def draw(self, unit: np.ndarray) -> np.ndarray:
        """Return deviations from the mean, given standard normals: ``(n, L, P) → (n, L, J, 3)``."""
        scores = np.sqrt(self.variances) * unit
        V = self.directions[self.band]
        coefficients = (V @ scores[..., None])[..., 0]
        return from_frequencies(coefficients, axis=1).reshape(len(unit), *self.mean.shape)


class Components(NamedTuple):
    """Gaussians with a canonical heading, repeated at the azimuths ``yaws`` (A,).

    ``log_weights``, (C,), are those of a component at one azimuth.
    """

    gaussians: tuple[Component, ...]
    log_weights: np.ndarray
    yaws: np.ndarray

    def subset(self, chosen: np.ndarray) -> Components:
        """Return some components, with unchanged weights."""
        gaussians = tuple(self.gaussians[c] for c in chosen)
        return Components(gaussians, self.log_weights[chosen], self.yaws)


class Information(NamedTuple):
    """Information matrices of all entries: most common one and the exceptions.

    ``all`` (L, J, 3, 3), ``common`` (3, 3), ``frames`` and ``joints`` (H,) of the exceptions,
    ``excess`` (H, 3, 3): their Λ − Λ₀.
    """

    all: np.ndarray
    common: np.ndarray
    frames: np.ndarray
    joints: np.ndarray
    excess: np.ndarray

    @classmethod
    def of(cls, information: np.ndarray) -> Information:
        """Split information matrices (L, J, 3, 3)."""
        matrices = np.ascontiguousarray(information.reshape(-1, 9))
        keys = matrices.view("V72").ravel().tolist()  # bytes, which are fast to count
        common = matrices[keys.index(Counter(keys).most_common(1)[0][0])].reshape(3, 3)
        frames, joints = np.nonzero((information != common).any(axis=(2, 3)))
        return cls(information, common, frames, joints, information[frames, joints] - common)

    @property
    def isotropic(self) -> bool:
        """Whether all matrices are multiples of the identity."""
        diagonal = self.all[..., 0, 0]
        return bool((self.all == diagonal[..., None, None] * np.eye(3)).all())

    def rotated(self, rotation: np.ndarray) -> Information:
        """Return the information of Rᵀ x, given that of x."""
        parts = (rotation.T @ part @ rotation for part in (self.all, self.common, self.excess))
        everything, common, excess = parts
        return Information(everything, common, self.frames, self.joints, excess)


class Conditional:
    """Covariance P = (C⁻¹ + Λ)⁻¹ of one component given the information Λ, in canonical frame."""

    def __init__(self, component: Component, information: Information) -> None:
        self.information = information
        self._root, self._log_det = _common_root(component, information.common)
        H = len(information.frames)
        if H:
            # G Δ, block by block.
            blocks = self._between_exceptions() @ information.excess
            matrix = blocks.swapaxes(1, 2).reshape(3 * H, 3 * H)
            matrix[np.diag_indices(3 * H)] += 1.0
            self._factors = scipy.linalg.lu_factor(matrix, check_finite=False)
            self._log_det += float(np.log(np.abs(np.diag(self._factors[0]))).sum())

    @property
    def log_determinant(self) -> float:
        """Log determinant of I + C Λ."""
        return self._log_det

    def solve(self, shift: np.ndarray) -> np.ndarray:
        """Return P η: ``(n, L, J, 3) → (n, L, J, 3)``."""
        out = self._common(shift)
        if len(self.information.frames):
            seen = out[:, self.information.frames, self.information.joints]
            # Z v = Δ (I + G Δ)⁻¹ v.
            inner = scipy.linalg.lu_solve(
                self._factors, seen.reshape(len(out), -1).T, check_finite=False
            ).T.reshape(seen.shape)
            field = np.zeros_like(out)
            products = (self.information.excess @ inner[..., None])[..., 0]
            field[:, self.information.frames, self.information.joints] = products
            out -= self._common(field)
        return out

    def draw(self, prior: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """Return draws of N(0, P), by Matheron's rule.

        Parameters
        ----------
        prior, unit : ndarray, (n, L, J, 3)
            Draws of N(0, C), and independent standard normals.
        """
        information = self.information.all
        size, axes = np.linalg.eigh(information)
        root = axes * np.sqrt(np.maximum(size, 0.0))[..., None, :]
        noise = np.einsum("ljab,nljb->nlja", root, unit)
        return prior + self.solve(noise - np.einsum("ljab,nljb->nlja", information, prior))

    @cached_property
    def marginals(self) -> np.ndarray:
        """Covariance matrices of all entries, (L, J, 3, 3)."""
        L, P, _ = self._root.shape
        J, H = P // 3, len(self.information.frames)
        root = self._root.reshape(L, J, 3, P)
        transform = _lags(root @ root.swapaxes(2, 3))
        # Q(2t + 1) for t < L, with period 2 L.
        out = transform[0] + transform[2 * np.arange(L) + 1]
        if H:
            delta = np.zeros((H, 3, H, 3))
            delta[np.arange(H), :, np.arange(H)] = self.information.excess
            Z = scipy.linalg.lu_solve(
                self._factors, delta.reshape(3 * H, 3 * H), trans=1, check_finite=False
            )
            # Z is symmetric, T + Tᵀ with a triangular T, which halves the cost of the product.
            Z[np.diag_indices(3 * H)] *= 0.5
            cross = self._to_exceptions()
            product = scipy.linalg.blas.dtrmm(1.0, Z, cross, side=1, lower=1, trans_a=1)
            left, right = (part.reshape(L * J, 3, 3 * H) for part in (product, cross))
            half = left @ right.swapaxes(1, 2)
            out -= (half + half.swapaxes(1, 2)).reshape(out.shape)
        return out

    def _common(self, shift: np.ndarray) -> np.ndarray:
        """Return P₀ η."""
        n, L = shift.shape[:2]
        spectrum = to_frequencies(shift.reshape(n, L, -1), axis=1).swapaxes(0, 1)
        product = (spectrum @ self._root) @ self._root.swapaxes(1, 2)
        return from_frequencies(product.swapaxes(0, 1), axis=1).reshape(shift.shape)

    def _between_exceptions(self) -> np.ndarray:
        """Return G, (H, H, 3, 3)."""
        L, P, _ = self._root.shape
        t, joints = self.information.frames, self.information.joints
        used = np.unique(joints)
        j = np.searchsorted(used, joints)
        root = self._root.reshape(L, P // 3, 3, P)[:, used].reshape(L, -1, P)
        transform = _lags(root @ root.swapaxes(1, 2)).reshape(2 * L, len(used), 3, len(used), 3)
        blocks = np.ascontiguousarray(transform.swapaxes(2, 3)).reshape(-1, 9)
        pairs = len(used) * j[:, None] + j
        near, far = np.abs(t[:, None] - t), (t[:, None] + t + 1) % (2 * L)
        G = blocks.take(len(used) ** 2 * near + pairs, axis=0)
        G += blocks.take(len(used) ** 2 * far + pairs, axis=0)
        return G.reshape(len(t), len(t), 3, 3)

    def _to_exceptions(self) -> np.ndarray:
        """Return P₀ between all entries and the exceptions, (3 L J, 3 H), in Fortran order."""
        L, P, _ = self._root.shape
        frames, joints = self.information.frames, self.information.joints
        used = np.unique(joints)
        root = self._root.reshape(L, P // 3, 3, P)[:, used].reshape(L, -1, P)
        transform = _lags(root @ self._root.swapaxes(1, 2))
        transform = np.ascontiguousarray(transform.swapaxes(0, 1))  # (3 used, 2 L, P)
        earlier = np.roll(transform, L, axis=1)  # from τ = −L on
        out = np.empty((len(frames), 3, L, P))
        for row, t, j in zip(out, frames, np.searchsorted(used, joints), strict=True):
            own = slice(3 * j, 3 * j + 3)
            np.add(earlier[own, L - t : 2 * L - t], transform[own, t + 1 : t + 1 + L], out=row)
        return out.reshape(3 * len(frames), L * P).T


def turned(field: np.ndarray, azimuth: float) -> np.ndarray:
    """Return vectors rotated about the vertical by an azimuth: ``(…, 3) → (…, 3)``."""
    return field @ rotation(azimuth).T


def rotation(azimuth: float) -> np.ndarray:
    """Return the rotation matrix of an azimuth about the vertical, (3, 3)."""
    c, s = math.cos(azimuth), math.sin(azimuth)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _common_root(component: Component, information: np.ndarray) -> tuple[np.ndarray, float]:
    """Return W with K_f = W Wᵀ, (L, P, P), and log det(I + C Λ₀), for the same Λ₀ everywhere."""
    V, variances = component.directions[component.band], component.variances
    if (information == information[0, 0] * np.eye(3)).all():
        ratio = 1 + information[0, 0] * variances
        return V * np.sqrt(variances / ratio)[:, None, :], float(np.log(ratio).sum())
    # K = (I/λ + VᵀΛV)⁻¹ in the directions, as the square of a triangular root, since a difference
    # of covariances would lose digits where the noise is small.
    L, P, _ = V.shape
    scaled = V * np.sqrt(variances)[:, None, :]
    weighted = (information @ scaled.reshape(L, P // 3, 3, P)).reshape(L, P, P)
    matrix = scaled.swapaxes(1, 2) @ weighted
    matrix[:, np.arange(P), np.arange(P)] += 1.0
    lower = np.linalg.cholesky(matrix)
    half = np.linalg.solve(lower, scaled.swapaxes(1, 2))
    diagonal = np.diagonal(lower, axis1=1, axis2=2)
    return half.swapaxes(1, 2), 2 * float(np.log(diagonal).sum())


def _lags(kernel: np.ndarray) -> np.ndarray:
    """Return Q(τ) = Σ_f s_f² K_f cos(π f τ / L) / 2 for τ < 2 L, s_0² = 1/L, s_f² = 2/L."""
    return np.fft.irfft(np.concatenate([kernel, np.zeros_like(kernel[:1])]), axis=0)
