"""Gaussian prior over 3D poses, or pairs of poses, learnt from 2D annotations alone.

A pose in a canonical frame is X ~ Σ_k w_k N(μ_k, Σ_k), with a full covariance over all joints. Its
annotation is y = s P(v) X + ε with an unknown view v, an unknown position and, optionally, an
unknown scale s. EM integrates over the depth exactly and over views on a grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from probmotion.arrays import logsumexp
from probmotion.files import check_format, read_arrays, written_whole
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.sources import ELEVATIONS, world_axes
from probmotion.models.unseen_depth.em import Poses, expectation, maximisation
from probmotion.models.unseen_depth.keypoints import (
    AnnotationLifts,
    as_keypoints,
    centred_images,
    visibility_groups,
)
from probmotion.models.unseen_depth.view_cells import (
    ViewCells,
    check_view_directions,
    elevation_levels,
    likely_scales,
)
from probmotion.posteriors.sampling import progress_bar
from probmotion.seeds import RandomNumbers, generator
from probmotion.validation import check_count, check_finite, check_positive, check_shape

__all__ = ["AnnotationPrior", "check_size"]

_SPREAD = 0.1  # initial standard deviation of each coordinate, metres
_PERSPECTIVE_ROUNDS = 3  # linearisations of a perspective projection in a lift
_SPLIT_ITERATIONS = 20  # of k-means
_SIZES = (1 / 3, 3.0)  # plausible ratios of the sizes of annotations and initial pose


@dataclass(frozen=True, eq=False)
class AnnotationPrior:
    """Mixture of K Gaussians over the pose of J joints, of one or several people.

    The frame is canonical: vertical axis y, the heading as in the initial pose, the mean of the
    joints at the origin. Learn a prior with :meth:`fit`.

    Parameters
    ----------
    weights : ndarray, (K,)
        Probabilities w_k, summing to 1.
    means : ndarray, (K, J, 3)
        Means μ_k, metres.
    covariances : ndarray, (K, 3J, 3J)
        Positive definite covariances Σ_k of flattened poses, m².
    noise : float
        Standard deviation σ of an annotation's coordinates, at the scale of the people, metres.
    views : ndarray, (V, 2)
        Grid of azimuths and elevations, equally probable, radians.
    """

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    noise: float
    views: np.ndarray

    def __post_init__(self) -> None:
        check_shape("weights", self.weights, ("K",))
        check_shape("means", self.means, (len(self.weights), "J", 3))
        size = 3 * self.means.shape[1]
        check_shape("covariances", self.covariances, (len(self.weights), size, size))
        check_shape("views", self.views, ("V", 2))
        for name in ("weights", "means", "covariances", "views"):
            check_finite(name, getattr(self, name))
        check_positive("noise", self.noise)

    @classmethod
    def fit(
        cls,
        annotations: Annotations | np.ndarray,
        start: np.ndarray,
        *,
        components: int = 1,
        noise: float = 0.03,
        elevations: tuple[float, float] = ELEVATIONS,
        azimuths: int = 36,
        unknown_scale: bool = False,
        focal: float | None = None,
        iterations: int = 12,
        seed: int = 0,
        progress: bool = False,
    ) -> AnnotationPrior:
        """Learn the prior from 2D annotations in unknown views by EM.

        Parameters
        ----------
        annotations : Annotations or ndarray, (n, J, 2)
            Keypoints, x right, y up, NaN where a joint is missing; in metres at the scale of the
            people, in any unit with ``unknown_scale`` or ``focal``. The image's y axis shows the
            vertical; positions are ignored.
        start : ndarray, (J, 3)
            Initial mean: any plausible pose, metres, y up. It resolves the ambiguities of
            orthographic images, a common rotation about the vertical and a reflection in depth.
        components : int
            Number K of Gaussians.
        noise : float
            Standard deviation σ of the keypoints at the scale of the people, metres.
        elevations : tuple of float
            Range of the cameras' elevations above the horizon, radians.
        azimuths : int
            Number of azimuths in the grid of views. Rotations between them are left to Σ.
        unknown_scale : bool
            Whether each annotation has an unknown scale (weak perspective), log-normal with sd .1
            around the ratio of the vertical extents of the mean pose and the annotation. The first
            half of the iterations fixes the scale at this ratio.
        focal : float, optional
            Focal length of perspective cameras, in the unit of the keypoints, which are then
            relative to the principal point. Distances are unknown, and the projection is linearised
            at the posterior mean. Orthographic by default.
        iterations : int
            Number of EM iterations, and of further ones if K > 1.
        seed : int
            Seed of the components' initialisation.
        progress : bool
            Whether to show a progress bar.

        Raises
        ------
        ValueError
            If annotations and initial pose disagree in joints or size, annotations are fewer than
            components, a joint is never visible, or all annotations have one view direction.
        """
        check_shape("start", np.asarray(start), ("J", 3))
        check_finite("start", start)
        keypoints = as_keypoints(annotations, len(start))
        check_count("components", components)
        check_count("iterations", iterations)
        check_count("azimuths", azimuths, 4)
        check_positive("noise", noise)
        if len(keypoints) < components:
            raise ValueError(
                f"annotations must be at least as many as components ({components}), got "
                f"{len(keypoints)}"
            )
        unseen = np.isnan(keypoints[..., 0]).all(axis=0)
        if unseen.any():
            raise ValueError(
                "annotations must show every joint at least once, got none of joint "
                f"{int(np.argmax(unseen))}: leave it out of annotations and start"
            )
        start = np.asarray(start, dtype=np.float64)
        start = start - start.mean(axis=0)
        scaled = unknown_scale or focal is not None
        if not scaled:
            check_size(keypoints, start, "use unknown_scale=True")
        views = _view_grid(azimuths, elevations)
        initial = np.eye(start.size) * _SPREAD**2
        poses = Poses(np.ones(1), start[None], initial[None])
        em = _Fit(keypoints, start, noise, views, scaled, focal)
        total = iterations * (1 if components == 1 else 2)
        with progress_bar(total, "EM", progress) as bar:
            for iteration in range(iterations):
                poses = em.step(poses, fixed_scale=scaled and iteration < iterations // 2)
                bar.update()
            if components > 1:
                lifted = cls(*poses, noise, views).lift(keypoints, unknown_scale=scaled)
                poses = _split(poses, lifted, components, generator(seed, "components"))
                for _ in range(iterations):
                    poses = em.step(poses)
                    bar.update()
        factors = _predictive_factors(poses, len(keypoints))
        covariances = poses.covariances * factors[:, None, None]
        return cls(poses.weights, poses.means, covariances, noise, views)

    @property
    def n_joints(self) -> int:
        """Number of joints J."""
        return self.means.shape[1]

    def lift(
        self,
        annotations: Annotations | np.ndarray,
        *,
        unknown_scale: bool = False,
        focal: float | None = None,
    ) -> AnnotationLifts:
        """Return the exact posterior means and deviations of the poses of annotations.

        Parameters are those of :meth:`fit`. Missing joints are completed in the image and in 3D.
        """
        keypoints = as_keypoints(annotations, self.n_joints)
        if focal is None:
            return self._lift(keypoints, unknown_scale)
        check_positive("focal", focal)
        lifts = self._lift(keypoints, True)
        for _ in range(_PERSPECTIVE_ROUNDS):
            ratios = _depth_ratios(lifts.positions[..., 2], lifts.scales, focal)
            lifts = self._lift(keypoints * ratios[..., None], True)
        return lifts

    def sample_lifts(
        self,
        annotations: Annotations | np.ndarray,
        rng: RandomNumbers,
        n_draws: int,
        *,
        unknown_scale: bool = False,
    ) -> np.ndarray:
        """Draw poses from the posterior of each annotation, in camera axes: (n_draws, n, J, 3).

        Parameters are those of :meth:`fit`; axes are those of :class:`AnnotationLifts`.
        """
        check_count("n_draws", n_draws)
        keypoints = as_keypoints(annotations, self.n_joints)
        images, centres = centred_images(keypoints)
        n, J = len(images), self.n_joints
        draws, scales = np.empty((n_draws, n, 3 * J)), np.empty((n_draws, n))
        for rows, visible in visibility_groups(images):
            evidence = self.cells.evidence(images[rows], visible, unknown_scale)
            bounds = np.cumsum(evidence.weights(), axis=1)
            bounds /= bounds[:, -1:]
            chosen = (rng.random((n_draws, len(rows)))[..., None] >= bounds).sum(axis=-1)
            drawn = np.stack([(chosen == c).any(axis=0) for c in range(bounds.shape[1])], axis=1)
            for part in self.cells.posteriors(images[rows], visible, evidence, drawn):
                root = _square_root(self.cells.covariance(part, visible))
                which, at = np.nonzero(chosen[:, part.rows] == part.cell)
                values = part.mean[at] + rng.standard_normal((len(at), 3 * J)) @ root.T
                index = part.rows[at]
                scale = evidence.scale[index, part.cell]
                if part.stretch.shape[1]:
                    normal = rng.standard_normal((len(at),))
                    values += normal[:, None] * part.stretch[at]
                    scale = scale + normal * np.sqrt(evidence.scale_variance[index, part.cell])
                draws[which, rows[index]], scales[which, rows[index]] = values, scale
        return _in_place(draws.reshape(n_draws, n, 3, J), centres * scales[..., None])

    def log_evidence(
        self, annotations: Annotations | np.ndarray, *, unknown_scale: bool = False
    ) -> np.ndarray:
        """Return the log density of each annotation, (n,), for comparisons of priors.

        Its position has a flat prior.
        """
        images, _ = centred_images(as_keypoints(annotations, self.n_joints))
        result = np.empty(len(images))
        for rows, visible in visibility_groups(images):
            evidence = self.cells.evidence(images[rows], visible, unknown_scale)
            result[rows] = logsumexp(evidence.log_density, axis=-1)
        return result

    def log_density(self, poses: np.ndarray) -> np.ndarray:
        """Return the log density of poses in the canonical frame, ``(…, J, 3) → (…)``."""
        poses = np.asarray(poses, dtype=np.float64)
        check_shape("poses", poses, ("…", self.n_joints, 3))
        flat = poses.reshape(-1, 1, poses.shape[-2] * 3) - self.means.reshape(len(self.weights), -1)
        logs = np.empty(flat.shape[:2])
        for k, factor in enumerate(np.linalg.cholesky(self.covariances)):
            white = np.linalg.solve(factor, flat[:, k].T)
            logdet = np.log(factor.diagonal()).sum()
            constant = len(factor) * math.log(2 * math.pi) / 2
            logs[:, k] = np.log(self.weights[k]) - (white**2).sum(axis=0) / 2 - logdet - constant
        return logsumexp(logs, axis=-1).reshape(poses.shape[:-2])

    def sample(self, rng: RandomNumbers, n: int) -> np.ndarray:
        """Draw n poses in the canonical frame, (n, J, 3), metres."""
        check_count("n", n)
        bounds = np.cumsum(self.weights)
        component = (rng.random((n,))[:, None] >= bounds / bounds[-1]).sum(axis=1)
        normal = rng.standard_normal((n, 3 * self.n_joints))
        factors = np.linalg.cholesky(self.covariances)
        offsets = np.einsum("nij,nj->ni", factors[component], normal)
        return self.means[component] + offsets.reshape(n, -1, 3)

    def save(self, path: str | Path) -> None:
        """Write the prior to an ``.npz`` archive, atomically."""
        with written_whole(Path(path)) as unfinished, open(unfinished, "wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                format=np.array(1),
                weights=self.weights,
                means=self.means,
                covariances=self.covariances,
                noise=np.array(self.noise),
                views=self.views,
            )

    @classmethod
    def load(cls, path: str | Path) -> AnnotationPrior:
        """Read an archive written by :meth:`save`."""
        try:
            arrays = read_arrays(path)
            check_format(arrays)
            noise = float(arrays.pop("noise"))
            return cls(noise=noise, **arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path} must be an archive written by AnnotationPrior.save, got an unreadable "
                f"file ({str(error)[:120]})"
            ) from error

    @cached_property
    def cells(self) -> ViewCells:
        """Gaussians in camera axes, one for each component and view."""
        return ViewCells(self.weights, self.means, self.covariances, self.views, self.noise)

    def _lift(self, keypoints: np.ndarray, unknown_scale: bool) -> AnnotationLifts:
        """Return the posterior given orthographic or weak-perspective keypoints (n, J, 2)."""
        images, centres = centred_images(keypoints)
        n, J = len(images), self.n_joints
        means, squares = np.zeros((n, 3 * J)), np.zeros((n, 3 * J))
        views, scales = np.empty((n, 2)), np.empty(n)
        for rows, visible in visibility_groups(images):
            evidence = self.cells.evidence(images[rows], visible, unknown_scale)
            weights = evidence.weights()
            views[rows] = self.cells.views[weights.argmax(axis=1)]
            scales[rows] = (weights * evidence.scale).sum(axis=1)
            for part in self.cells.posteriors(images[rows], visible, evidence, weights):
                at, weight = rows[part.rows], part.weights[:, None]
                means[at] += weight * part.mean
                variances = self.cells.variances(part, visible)
                squares[at] += weight * (part.mean**2 + variances)
        sd = np.sqrt(np.maximum(squares - means**2, 0.0))
        positions = _in_place(means.reshape(n, 3, J), centres * scales[:, None])
        return AnnotationLifts(positions, np.swapaxes(sd.reshape(n, 3, J), 1, 2), views, scales)


class _Fit:
    """EM on one set of annotations."""

    def __init__(
        self,
        keypoints: np.ndarray,
        start: np.ndarray,
        noise: float,
        views: np.ndarray,
        unknown_scale: bool,
        focal: float | None,
    ) -> None:
        if focal is not None:
            check_positive("focal", focal)
        self.keypoints, self.start, self.noise, self.views = keypoints, start, noise, views
        self.unknown_scale, self.focal = unknown_scale, focal
        self.ratios = np.ones(keypoints.shape[:2])

    def step(self, poses: Poses, fixed_scale: bool = False) -> Poses:
        """Return the mixture after an E and an M step."""
        cells = ViewCells(*poses, self.views, self.noise)
        keypoints = self.keypoints * self.ratios[..., None]
        if fixed_scale:
            keypoints = keypoints * self._likely_scales(keypoints)[:, None, None]
        moments = expectation(cells, keypoints, self.unknown_scale and not fixed_scale)
        if len(np.unique(self.views[:, 0])) > 1:
            check_view_directions("annotations", moments.azimuth_concentration)
        if self.focal is not None and not fixed_scale:
            self.ratios = _depth_ratios(moments.depths, moments.scales, self.focal)
        poses = maximisation(moments, _SPREAD)
        if not self.unknown_scale:
            return poses
        # Only the product of pose and scale is visible: poses keep the size of the initial one.
        sizes = (poses.means**2).sum(axis=(1, 2)) + np.trace(poses.covariances, axis1=1, axis2=2)
        factor = np.linalg.norm(self.start) / np.sqrt(poses.weights @ sizes)
        return Poses(poses.weights, poses.means * factor, poses.covariances * factor**2)

    def _likely_scales(self, keypoints: np.ndarray) -> np.ndarray:
        images, _ = centred_images(keypoints)
        scales = np.empty(len(images))
        for rows, visible in visibility_groups(images):
            scales[rows] = likely_scales(self.start, images[rows], visible)
        return scales


def _split(
    poses: Poses, lifts: AnnotationLifts, components: int, rng: np.random.Generator
) -> Poses:
    """Return components around k-means clusters of the lifted poses in the canonical frame."""
    canonical = np.einsum("nai,nja->nji", world_axes(lifts.views), lifts.positions)
    canonical -= canonical.mean(axis=1, keepdims=True)
    flat = canonical.reshape(len(canonical), -1)
    centres = flat[rng.choice(len(flat), components, replace=False)]
    for _ in range(_SPLIT_ITERATIONS):
        distances = (flat**2).sum(axis=1)[:, None] - 2 * flat @ centres.T + (centres**2).sum(axis=1)
        nearest = distances.argmin(axis=1)
        members = (nearest == np.arange(components)[:, None]).astype(float)
        counts = members.sum(axis=1)
        known = counts > 0
        centres[known] = (members @ flat)[known] / counts[known, None]
    weights = (counts + 1) / (counts + 1).sum()
    means = centres.reshape(components, *poses.means.shape[1:])
    return Poses(weights, means, np.repeat(poses.covariances, components, axis=0))


def _predictive_factors(poses: Poses, n: int) -> np.ndarray:
    """Return the ratios (K,) of the variances of new poses to the fitted ones.

    In a regression on p coordinates, the squared errors of new cases exceed those of the n cases of
    the fit by (n + p)/(n − p); here at most threefold.
    """
    K, J = poses.means.shape[:2]
    p = 2 * J
    # Components borrow strength from their mean covariance, see maximisation.
    counts = np.maximum(n * poses.weights + (3 * J if K > 1 else 0), 2 * p)
    return np.asarray((counts + p) / (counts - p))


def _view_grid(azimuths: int, elevations: tuple[float, float]) -> np.ndarray:
    """Return views (V, 2)."""
    levels = elevation_levels(elevations)
    circle = 2 * np.pi * np.arange(azimuths) / azimuths
    return np.stack(np.meshgrid(circle, levels, indexing="ij"), axis=-1).reshape(-1, 2)


def _depth_ratios(depths: np.ndarray, scales: np.ndarray, focal: float) -> np.ndarray:
    """Return the ratios of the joints' distances to the mean distance of the pose, (n, J).

    A pinhole at distance D = u f sees x / (D − z) = y / f, so u y (1 − z/D) is orthographic.
    """
    return np.maximum(1 - depths / (focal * scales)[:, None], 0.1)


def _in_place(poses: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return poses (…, n, 3, J) as (…, n, J, 3), moved to the image centres (…, n, 2)."""
    positions = np.swapaxes(poses, -1, -2).copy()
    positions[..., :2] += centres[..., None, :]
    return positions


def _square_root(covariance: np.ndarray) -> np.ndarray:
    """Return a factor of a covariance that may be singular: the mean depth is fixed."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def check_size(keypoints: np.ndarray, start: np.ndarray, remedy: str) -> None:
    """Raise ``ValueError`` if annotations and initial pose differ in scale."""
    size = np.median(np.nanstd(keypoints[..., 1], axis=1))
    ratio = float(size / max(start[:, 1].std(), 1e-9))
    if not _SIZES[0] <= ratio <= _SIZES[1]:
        raise ValueError(
            f"annotations must be in metres at the scale of the people, got a ratio of heights of "
            f"{ratio:.3g}: {remedy}"
        )
