"""Modes of the posterior of images by Gauss-Newton steps, and Gaussians around them.

Derivatives of images are finite differences: rendering a batch costs less than automatic
differentiation of every pixel, and differences see silhouettes beyond one pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from probmotion.extras import torch
from probmotion.models.images.encoder import quarter_of
from probmotion.models.images.image_likelihood import ImageLikelihood
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior

__all__ = ["Mode", "promising", "quarters_of", "refine"]

# Size of the images, pixels, softness of the likelihood, and largest number of steps. The first,
# softest likelihood chooses among candidates, and the points that go on.
_STAGES = ((32, 8.0, 6), (32, 4.0, 6), (64, 2.0, 6), (64, 1.0, 12))
_DIFFERENCE = 0.05  # of θ, whose prior has standard deviation 1, for a likelihood of softness 1
_LARGEST = 0.15  # difference of θ for softer likelihoods: it sees silhouettes farther away
_DAMPING = (0.03, 0.3, 3.0, 30.0)  # tried in every step, relative to the diagonal
_LONGEST = 4.0  # longest step of θ
_SMALLEST_GAIN = 0.1  # of log density; below, a stage ends
_FIXED = 100.0  # precision of what has no meaning
_SAME = 0.1  # squared distance of two modes per coordinate below which they are the same
_MIRRORED = 4  # points of the first stage whose mirror images in depth are starts, too
_ROWS = 48  # number of θ rendered at once
_BELIEVED = 0.02
"""Share of the information of an image in the spread of draws: their errors are larger than the
curvature at a mode says, because the likelihood is rugged. The share of T images is divided by T,
since the images of a clip have errors in common. Chosen on validation images and clips, such that
intervals of 90 % hold."""


class Mode(NamedTuple):
    """Maximum θ̂ (dim,) of a posterior, its log density, and the precision (dim, dim) of draws.

    The precision is that of the prior and of a share of the information of the images: draws are
    wider than the Laplace approximation.
    """

    theta: np.ndarray
    log_density: float
    precision: np.ndarray

    @property
    def log_evidence(self) -> float:
        """Log of the integral of a Gaussian of the mode's height and precision."""
        dim = len(self.theta)
        return float(
            self.log_density
            + 0.5 * dim * math.log(2 * math.pi)
            - 0.5 * np.linalg.slogdet(self.precision)[1]
        )

    def draw(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Return n draws of the Gaussian, (n, dim)."""
        lower = np.linalg.cholesky(self.precision)
        noise = rng.standard_normal((n, len(self.theta)))
        return self.theta + np.linalg.solve(lower.T, noise.T).T


def refine(
    prior: SurfacePrior, observed: ImageObservation, starts: np.ndarray, keep: int | None = None
) -> list[Mode]:
    """Return the modes that Gauss-Newton steps find from the starts (n, dim), best first.

    Likelihoods become sharper from stage to stage. With ``keep``, only so many points go on after
    the first stage: the best of each direction, then the second best of each. Before, the best
    points of one image are mirrored in depth and refined again, since a silhouette hardly shows
    whether a body faces towards the camera or away from it.
    """
    points = [torch.as_tensor(start, dtype=torch.float32) for start in starts]
    modes: list[Mode] = []
    for number, (size, softness, steps) in enumerate(_STAGES):
        size = min(size, observed.size)
        likelihood = ImageLikelihood.of(
            observed, size, torch.float32, prior.category.feature_noise, softness
        )
        reached = [_ascend(prior, likelihood, point, steps) for point in points]
        reached.sort(key=lambda point: -point[1])
        alone = prior.images == 1 and prior.category.body.symmetric
        if number == 0 and keep is not None and alone:
            best = [point.numpy() for point, _ in _diverse(prior, reached)[:_MIRRORED]]
            mirrored = torch.as_tensor(prior.mirrored(np.stack(best)), dtype=torch.float32)
            reached += [_ascend(prior, likelihood, point, steps) for point in mirrored]
            reached.sort(key=lambda point: -point[1])
        if number == 0 and keep is not None:
            reached = _diverse(prior, reached)[:keep]
        points = [point for point, _ in reached]
    start = prior.layout.view.start
    believed = _BELIEVED / observed.images
    for point, value in reached:
        # The length of the two coordinates of the direction does not matter: draws keep it, or
        # they would cross the origin and face the other way.
        pair = point[start : start + 2].double()
        turned = prior.facing(point.numpy(), prior.yaw(point.double().numpy()))
        value += 0.5 * float((pair**2).sum()) - 1.0
        point = torch.as_tensor(turned, dtype=torch.float32)
        images = _images(prior, point[None], likelihood)
        _, information = likelihood.curvature(
            images[0], _derivatives(prior, point, images[0], likelihood)
        )
        precision = believed * information.double().numpy() + np.eye(len(point))
        radial = np.zeros(len(point))
        radial[start : start + 2] = turned[start : start + 2] / math.sqrt(2)
        precision += _FIXED * np.outer(radial, radial)
        modes.append(Mode(point.double().numpy(), value, precision))
    modes.sort(key=lambda mode: -mode.log_density)
    return _distinct(modes)


def promising(
    prior: SurfacePrior, observed: ImageObservation, candidates: np.ndarray, n: int
) -> np.ndarray:
    """Return the ``n`` of the candidates (m, dim) with the highest density at the first stage."""
    size, softness, _ = _STAGES[0]
    noise = prior.category.feature_noise
    likelihood = ImageLikelihood.of(
        observed, min(size, observed.size), torch.float32, noise, softness
    )
    rows = torch.as_tensor(candidates, dtype=torch.float32).split(_ROWS)
    values = [_log_posterior(likelihood, part, _images(prior, part, likelihood)) for part in rows]
    best = torch.cat(values).argsort(descending=True)[:n]
    return np.asarray(candidates[best.numpy()])


def quarters_of(prior: SurfacePrior, theta: np.ndarray) -> np.ndarray:
    """Return the quarter turn of the direction in which each of n bodies (n, dim) faces."""
    return quarter_of(prior.yaw(theta))[0]


def _distinct(modes: list[Mode]) -> list[Mode]:
    """Return the modes without those that another start has reached, too."""
    found: list[Mode] = []
    for mode in modes:
        apart = [mode.theta - other.theta for other in found]
        distances = [d @ other.precision @ d for d, other in zip(apart, found, strict=True)]
        if all(distance > _SAME * len(mode.theta) for distance in distances):
            found.append(mode)
    return found


def _diverse(
    prior: SurfacePrior, reached: list[tuple[torch.Tensor, float]]
) -> list[tuple[torch.Tensor, float]]:
    """Return sorted points with the best of each direction first, then the second of each.

    Directions are quarter turns; of one image, those to the sides are divided into towards and
    away.
    """
    theta = np.stack([point.numpy() for point, _ in reached])
    directions = quarters_of(prior, theta)
    if prior.images == 1:
        directions = 2 * directions + (np.cos(prior.yaw(theta)) > 0)
    ranks = [int((directions[:k] == direction).sum()) for k, direction in enumerate(directions)]
    return [reached[k] for k in np.argsort(ranks, kind="stable")]


def _ascend(
    prior: SurfacePrior, likelihood: ImageLikelihood, theta: torch.Tensor, steps: int
) -> tuple[torch.Tensor, float]:
    images = _images(prior, theta[None], likelihood)
    value = float(_log_posterior(likelihood, theta[None], images)[0])
    damping = 1.0
    for _ in range(steps):
        derivatives = _derivatives(prior, theta, images[0], likelihood)
        slope, information = likelihood.curvature(images[0], derivatives)
        slope = slope - theta
        information = information + torch.eye(len(theta))
        tried = []
        for factor in _DAMPING:
            damped = information + factor * damping * torch.diag(information.diagonal())
            step = torch.linalg.solve(damped, slope)
            tried.append(theta + step * min(1.0, _LONGEST / float(step.norm())))
        candidates = torch.stack(tried)
        rendered = _images(prior, candidates, likelihood)
        values = _log_posterior(likelihood, candidates, rendered)
        best = int(values.argmax())
        gain = float(values[best]) - value
        if not gain > 0:
            if damping > 100:
                break
            damping *= 30
            continue
        theta, value, images = candidates[best], float(values[best]), rendered[best : best + 1]
        damping = min(max(damping * (0.3, 1.0, 3.0, 10.0)[best], 1e-3), 100.0)
        if gain < _SMALLEST_GAIN:
            break
    return theta, value


def _log_posterior(
    likelihood: ImageLikelihood, theta: torch.Tensor, images: torch.Tensor
) -> torch.Tensor:
    return likelihood.log_density(images) - 0.5 * (theta**2).sum(dim=1)


def _images(prior: SurfacePrior, theta: torch.Tensor, likelihood: ImageLikelihood) -> torch.Tensor:
    """Return the images that the likelihood compares, (n, T, S, S, C)."""
    features = likelihood.features.shape[-1] > 0
    with torch.no_grad():
        parts = [prior.render(rows, likelihood.size, features) for rows in theta.split(_ROWS)]
    return torch.cat(parts)


def _derivatives(
    prior: SurfacePrior, theta: torch.Tensor, images: torch.Tensor, likelihood: ImageLikelihood
) -> torch.Tensor:
    """Return the derivatives of the images in all coordinates, (dim, T, S, S, C)."""
    difference = min(_DIFFERENCE * likelihood.softness, _LARGEST)
    moved = theta + difference * torch.eye(len(theta))
    return (_images(prior, moved, likelihood) - images) / difference
