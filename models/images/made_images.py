"""Made images of a category: bodies that fill a crop, cut off by borders, with errors of masks.

Made categories differ from another one in surface and coat; their images test what is learnt.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from probmotion.extras import torch
from probmotion.models.images.category import Category, folded, smooth_components, vertex_normals
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.validation import check_count

__all__ = [
    "MARGIN",
    "MadeImages",
    "in_front",
    "make_category",
    "make_clips",
    "make_images",
    "with_made_features",
]

MARGIN = 1.25
"""Width of a crop, of the larger side of the body's bounding box."""
_PASSES = 3  # of moving the body into the middle of the crop
_CUT = 0.25  # share of images whose border cuts the body
_MOST_CUT = 0.35  # of the bounding box
_JITTER = 0.03  # standard deviation of the middle and log size of the box, of its size
_EDGE = 0.2  # standard deviation of errors of the mask's outline, in units of blurred coverage
_BLUR = 0.01  # of the crop
_SMOOTH = 0.02  # their correlation length, of the crop
_PATCH = 0.1  # correlation length of backgrounds, of the crop
_PART, _FEATURE_NOISE = 0.2, 0.5  # length over which features vary, of the size, and their noise
_TANGENTS = (0.05, 0.35)  # of clips' crops
# Made categories: standard deviations of the logarithm of the distance from the bones, of
# displacements (of the size), of the coat's pattern, and the range of its mean.
_THICKNESS, _DISPLACEMENT, _PATTERN, _TINT = 0.35, 0.008, 0.15, 0.15


class MadeImages(NamedTuple):
    """θ (n, dim), masks (n, S, S) with NaN beyond the border, colours (n, S, S, 3).

    Features (n, S, S, F) are those of the vertices with the category's noise; None if it has none.
    """

    theta: np.ndarray
    mask: np.ndarray
    rgb: np.ndarray
    features: np.ndarray | None


def make_images(
    prior: SurfacePrior,
    rng: np.random.Generator,
    n: int,
    size: int,
    theta: np.ndarray | None = None,
) -> MadeImages:
    """Return ``n`` images of draws of a prior of one image, or of given θ moved into the crop.

    A quarter of them is cut off at one side. Backgrounds have smooth random colours, outlines of
    masks smooth random errors, and features smooth noise. Masks and colours do not depend on
    whether there are features.
    """
    theta = prior.initial(rng, n) if theta is None else np.array(theta)
    cut = np.where(rng.random(n) < _CUT, rng.uniform(0.05, _MOST_CUT, n), 0.0)
    side = rng.integers(4, size=n)
    jitter = _JITTER * rng.standard_normal((n, 3))
    with torch.no_grad():
        vertices = prior.vertices(torch.as_tensor(theta, dtype=torch.float32))[:, 0].numpy()
        vertices = vertices - prior.middle(theta)[:, None]
        for _ in range(_PASSES):
            low, high = _boxes(prior, vertices + prior.middle(theta)[:, None])
            extent = high - low
            for k in range(n):  # what is beyond the border is not in the box
                axis = side[k] % 2
                if side[k] < 2:
                    low[k, axis] += cut[k] * extent[k, axis]
                else:
                    high[k, axis] -= cut[k] * extent[k, axis]
            size_of_box = (high - low).max(axis=1)
            middle = 0.5 * (low + high) + jitter[:, :2] * size_of_box[:, None]
            half = 0.5 * MARGIN * size_of_box * np.exp(jitter[:, 2])
            theta = prior.moved(theta, -middle, half)
        rows = torch.as_tensor(theta, dtype=torch.float32)
        images = prior.render(rows, size, prior.category.features.shape[1] > 0)[:, 0].numpy()
        low, high = _boxes(prior, vertices + prior.middle(theta)[:, None])
    noise = rng.standard_normal((n, size, size))
    noise = ndimage.gaussian_filter(noise, (0, _SMOOTH * size, _SMOOTH * size))
    noise = np.clip(noise * _EDGE / noise.std(), -0.4, 0.4)  # no holes, no islands
    coverage = images[..., -1]
    blur = _BLUR * size
    outline = ndimage.gaussian_filter(coverage, (0, blur, blur)) + noise
    mask = np.clip(4.0 * (outline - 0.5) + 0.5, 0.0, 1.0)
    centres = 2 * (np.arange(size) + 0.5) / size - 1
    for k in np.flatnonzero(cut > 0).tolist():
        axis = side[k] % 2
        length = high[k, axis] - low[k, axis]
        outside = (
            centres < low[k, axis] + cut[k] * length
            if side[k] < 2
            else centres > high[k, axis] - cut[k] * length
        )
        mask[k][(slice(None), outside) if axis == 0 else outside] = np.nan
    beyond = np.isnan(mask)[..., None]
    of_features, of_background = rng.spawn(2)
    rgb = np.where(beyond, np.nan, in_front(images, of_background))
    features = None
    if images.shape[3] > 4:
        features = images[..., 3:-1] / np.maximum(coverage, 0.05)[..., None]
        features += _feature_errors(prior.category, of_features, n, size)
        features = np.where(beyond, np.nan, features).astype(np.float32)
    return MadeImages(theta, mask, rgb, features)


def in_front(images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return rendered images (n, S, S, C) in front of smooth random colours, (n, S, S, 3)."""
    n, size = images.shape[:2]
    noise = rng.standard_normal((n, size, size, 3))
    noise = ndimage.gaussian_filter(noise, (0, _PATCH * size, _PATCH * size, 0), mode="wrap")
    colours = np.clip(rng.uniform(0, 1, (n, 1, 1, 3)) + 0.2 * noise / noise.std(), 0.0, 1.0)
    coverage = images[..., -1:]
    body = images[..., :3] / np.maximum(coverage, 1.0)  # blending at corners can exceed 1 slightly
    blended: np.ndarray = np.clip(body + (1 - coverage.clip(0.0, 1.0)) * colours, 0.0, 1.0)
    return blended


def make_category(category: Category, rng: np.random.Generator) -> Category:
    """Return a category with another mean surface and coat, for example with a deeper chest.

    Vertices keep their order. They are 1 to 3 % of the size away from those of ``category``.
    """
    vertices = category.surface.vertices
    size, points = float(np.ptp(vertices, axis=0).max()), folded(vertices)

    def smooth(n: int, length: float) -> np.ndarray:
        components = smooth_components(points, length * size, 200)
        drawn: np.ndarray = rng.standard_normal((n, len(components))) @ components
        return drawn.T

    growth = np.expm1(_THICKNESS * smooth(1, 0.15)) * _bone_distances(category)[:, None]
    displacement = _DISPLACEMENT * size * smooth(3, 0.3)
    if points is not vertices:
        displacement[:, 0] *= np.tanh(vertices[:, 0] / (0.05 * size))
    moved = vertices + growth * vertex_normals(category.surface) + displacement
    coat = category.albedo + _PATTERN * smooth(3, 0.2) + rng.uniform(-_TINT, _TINT, 3)
    surface = replace(category.surface, vertices=moved)
    return replace(category, surface=surface, albedo=np.clip(coat, 0.05, 0.95))


def with_made_features(category: Category, n: int = 8) -> Category:
    """Return a category with ``n`` features that tell parts of the body apart.

    Features are smooth functions of the rest pose, uncorrelated over the vertices with mean 0 and
    variance 1. Like those of networks, they do not tell left from right if the body is symmetric.
    Their noise has a standard deviation of .5.
    """
    check_count("n", n)
    vertices = category.surface.vertices
    length = _PART * float(np.ptp(vertices, axis=0).max())
    functions = smooth_components(folded(vertices), length, n)
    unit, factors = np.linalg.qr((functions - functions.mean(axis=1, keepdims=True)).T)
    features = np.sqrt(len(vertices)) * np.sign(np.diag(factors)) * unit
    return replace(category, features=features, feature_noise=np.full(n, _FEATURE_NOISE))


def make_clips(
    category: Category, rng: np.random.Generator, n: int, frames: int, size: int
) -> tuple[list[ImageObservation], np.ndarray]:
    """Return images of ``n`` bodies in ``frames`` poses each, and their θ (n · frames, dim).

    Images of a body, which follow one another, share its bones, shape, colours and light.
    """
    images, parameters = [], []
    for _ in range(n):
        tangent = np.array([np.exp(rng.uniform(*np.log(_TANGENTS)))])
        prior = SurfacePrior(category, tangent)
        theta = prior.initial(rng, frames)
        own = slice(prior.layout.lengths.start, prior.layout.light.stop)
        theta[:, own] = theta[0, own]
        made = make_images(prior, rng, frames, size, theta)
        for k in range(frames):
            features = None if made.features is None else made.features[k : k + 1]
            seen = (made.mask[k : k + 1], made.rgb[k : k + 1], features)
            images.append(ImageObservation(*seen, tangent, np.eye(3)[None]))
        parameters.append(made.theta)
    return images, np.concatenate(parameters)


def _feature_errors(category: Category, rng: np.random.Generator, n: int, size: int) -> np.ndarray:
    """Return noise of features (n, size, size, F), with the correlation length of the mask's."""
    noise = rng.standard_normal((n, size, size, len(category.feature_noise)))
    noise = ndimage.gaussian_filter(noise, (0, _SMOOTH * size, _SMOOTH * size, 0))
    scaled: np.ndarray = noise * category.feature_noise / noise.std()
    return scaled


def _bone_distances(category: Category) -> np.ndarray:
    """Return the distance of each vertex from the nearest bone, (V,)."""
    ends = category.body.rest_positions
    starts = ends[np.maximum(category.body.skeleton.parents, 0)]
    bones = ends - starts
    offsets = category.surface.vertices[:, None] - starts
    along = (offsets * bones).sum(axis=-1) / np.maximum((bones**2).sum(axis=-1), 1e-12)
    nearest = offsets - np.clip(along, 0, 1)[..., None] * bones
    distances: np.ndarray = np.linalg.norm(nearest, axis=-1).min(axis=1)
    return distances


def _boxes(prior: SurfacePrior, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounding boxes of projected vertices (n, V, 3): lowest and highest x and y."""
    points = vertices[..., :2] / (vertices[..., 2:] * prior.tangent[0])
    return points.min(axis=1), points.max(axis=1)
