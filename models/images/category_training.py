"""Learning of a category's mean surface, colours and features from images of its bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from probmotion.extras import torch
from probmotion.models.images.category import Category, folded, smooth_components, vertex_normals
from probmotion.models.images.image_likelihood import ImageLikelihood
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.posing import shaded
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.posteriors.sampling import progress_bar
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["feature_channels", "learn_surface"]

# Numbers of smooth components; of the rest pose's size, their lengths and standard deviations.
# Movements along the normals change thickness, those along the axes proportions.
_NORMAL, _NORMAL_LENGTH, _NORMAL_SPREAD = 60, 0.12, 0.02
_AXIS, _AXIS_LENGTH, _AXIS_SPREAD = 20, 0.25, 0.01
_MIDPLANE = 0.04  # distance from the plane of symmetry at which vertices move sideways freely
_COLOURS, _COLOUR_LENGTH, _COLOUR_SPREAD = 40, 0.15, 0.2
_FEATURES, _FEATURE_LENGTH = 40, 0.15
_SIZE = 64  # pixels of the images; larger ones are averaged
_BATCH = 25  # largest number of images per gradient step of what is shared
# Initial learning rates of what is shared and of θ; they fall linearly to 0.
_SHARED_RATE, _RATE = 0.05, 0.05


def learn_surface(
    category: Category,
    images: Sequence[ImageObservation],
    theta: np.ndarray,
    *,
    steps: int = 400,
    progress: bool = False,
) -> Category:
    """Return the category with the mean surface, colours and features of the bodies in images.

    Maximises the posterior density of a displacement of the mean surface and a change of the mean
    colours, smooth Gaussian functions that all images share, together with each image's θ. Both
    are symmetric if the surface is. The means of the shape and colour codes of θ over the images
    become part of the new means. The distribution of poses and the deviations of shapes and colours
    remain.

    Features and their noise are then a linear regression on images of functions of the surface, a
    constant and smooth Gaussian ones, symmetric if the surface is. They do not change the surface:
    those of a wrong surface would preserve its errors. If the images have no features, those of
    the category remain.

    Parameters
    ----------
    category : Category
        Current category.
    images : sequence of ImageObservation
        N observations of one image each, all of them with features or none.
    theta : ndarray, (N, dim)
        Parameters under the current category, as of :class:`SurfacePrior`. Poses and motion codes
        are starting values; the other coordinates, in which an image compensates for errors of
        the category, start at 0.
    steps : int
        Gradient steps, of up to 25 images each. 400 take half a minute on a free core.
    progress : bool
        Whether to show a progress bar.

    Raises
    ------
    ValueError
        If there are no images, an observation has several, only some have features, no feature in a
        body is known, or shapes disagree.
    """
    check_count("steps", steps)
    if not images or any(image.images != 1 for image in images):
        counts = sorted({image.images for image in images}) or "no observations"
        raise ValueError(f"images must be observations of one image each, got {counts}")
    layout = SurfacePrior(category, np.ones(1)).layout
    check_shape("theta", theta, (len(images), layout.view.stop))
    check_finite("theta", theta)
    start = np.array(theta)
    start[:, layout.lengths.start : layout.light.stop] = 0.0
    size = min(_SIZE, *(image.size for image in images))
    channels = feature_channels(images)
    plain = [replace(image, features=None) for image in images]
    likelihoods = [ImageLikelihood.of(image, size, torch.float32, np.zeros(0)) for image in plain]
    shared = _Shared(category)
    # Batches contain images of many clips, whose images follow one another.
    count = -(-len(images) // _BATCH)
    batches = [np.arange(k, len(images), count) for k in range(count)]
    tangents = np.concatenate([image.tangent for image in images])
    priors = [_ImagesPrior(shared.widened, tangents[rows]) for rows in batches]
    own = [torch.tensor(start[rows], dtype=torch.float32, requires_grad=True) for rows in batches]
    common = torch.zeros(sum(shared.counts), requires_grad=True)
    groups = [{"params": [common], "lr": _SHARED_RATE}, {"params": own, "lr": _RATE}]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.95))
    falling = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1 - step / steps)
    with progress_bar(steps, "surface", progress) as bar:
        for step in range(steps):
            batch = step % count
            optimiser.zero_grad(set_to_none=True)  # Adam leaves other images as they are
            rendered = priors[batch].render(shared.joined(own[batch], common), size)
            loss = 0.5 * (common**2).sum() / count + 0.5 * (own[batch] ** 2).sum()
            for row, image in zip(batches[batch], rendered[:, None], strict=True):
                loss = loss - likelihoods[row].log_density(image)[0]
            loss.backward()
            optimiser.step()
            falling.step()
            bar.update(1)
    learnt = shared.learnt(torch.cat(own).detach(), common.detach())
    if not channels:
        return learnt
    reached = [shared.joined(part, common).detach() for part in own]
    features, noise = _regressed(shared.widened, images, batches, reached, size)
    return replace(learnt, features=features, feature_noise=noise)


def feature_channels(images: Sequence[ImageObservation]) -> int:
    """Return the number of image features, 0 without.

    Raises ``ValueError`` if it is not the same for all images.
    """
    counts = {0 if image.features is None else image.features.shape[-1] for image in images}
    if len(counts) > 1:
        raise ValueError(
            "images must all have the same number of features, or all have none, got "
            f"{' and '.join(map(str, sorted(counts)))} channels"
        )
    return counts.pop()


def _regressed(
    category: Category,
    images: Sequence[ImageObservation],
    batches: Sequence[np.ndarray],
    theta: Sequence[torch.Tensor],
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the features (V, F) that explain those of images at θ of each batch, and their noise.

    Images of features are linear in those of the vertices. Coefficients of the smooth functions
    have a Gaussian prior; the ridge penalty assumes equal variances of coefficients and noise.
    """
    vertices = category.surface.vertices
    length = _FEATURE_LENGTH * float(np.ptp(vertices, axis=0).max())
    smooth = smooth_components(folded(vertices), length, _FEATURES)
    functions = np.concatenate([np.ones((1, len(vertices))), smooth]).T
    regressors = replace(category, features=functions, feature_noise=np.ones(len(smooth) + 1))
    k, channels, known = functions.shape[1], feature_channels(images), 0
    products = np.zeros((k + channels, k + channels))
    for rows, own in zip(batches, theta, strict=True):
        prior = _ImagesPrior(regressors, np.concatenate([images[row].tangent for row in rows]))
        with torch.no_grad():
            rendered = prior.render(own, size, features=True)[..., 3:-1]
        for row, image in zip(rows, rendered, strict=True):
            observed = ImageLikelihood.of(images[row], size, torch.float32, np.ones(channels))
            values = torch.cat([image, observed.features], dim=-1)
            values = values[observed.described.all(dim=-1)].double()
            products += (values.T @ values).numpy()
            known += len(values)
    if not known:
        raise ValueError("images must have features inside their masks, got only unknown ones")
    penalty = np.diag([1e-6, *np.ones(k - 1)]) / observed.weight  # the constant is free
    weights = np.linalg.solve(products[:k, :k] + penalty, products[:k, k:])
    errors = np.concatenate([-weights, np.eye(channels)])
    noise = np.sqrt(np.einsum("kf,kl,lf->f", errors, products, errors).clip(min=0) / known)
    # A channel of zeros is uninformative, whatever its noise.
    return functions @ weights, np.where(noise > 0, noise, 1.0)


class _Shared:
    """What all images share, as further shapes and colours of a category with equal codes."""

    def __init__(self, category: Category) -> None:
        vertices = category.surface.vertices
        size = float(np.ptp(vertices, axis=0).max())
        points = folded(vertices)
        along = smooth_components(points, _NORMAL_LENGTH * size, _NORMAL)[:, :, None]
        normal = _NORMAL_SPREAD * size * along * vertex_normals(category.surface)
        axes = _AXIS_SPREAD * size * _each(smooth_components(points, _AXIS_LENGTH * size, _AXIS))
        if points is not vertices:
            # Sideways movements of a symmetric body are odd functions.
            axes[:, :, 0] *= np.tanh(vertices[:, 0] / (_MIDPLANE * size))
        colours = _COLOUR_SPREAD * _each(smooth_components(points, _COLOUR_LENGTH * size, _COLOURS))
        self.category = category
        self.counts = len(normal) + len(axes), len(colours)
        self.widened = replace(
            category,
            shapes=np.concatenate([category.shapes, normal, axes]),
            albedos=np.concatenate([category.albedos, colours]),
        )

    def joined(self, own: torch.Tensor, common: torch.Tensor) -> torch.Tensor:
        """Return θ of the widened category from those of images (N, dim) and what they share."""
        layout = SurfacePrior(self.category, np.ones(1)).layout
        shape, albedo = common.expand(len(own), -1).split(self.counts, dim=1)
        before, colours = own[:, : layout.shape.stop], own[:, layout.albedo]
        return torch.cat([before, shape, colours, albedo, own[:, layout.albedo.stop :]], dim=1)

    def learnt(self, own: torch.Tensor, common: torch.Tensor) -> Category:
        """Return the category with the means over the images."""
        layout = SurfacePrior(self.widened, np.ones(1)).layout
        mean = self.joined(own, common).double().mean(dim=0).numpy()
        surface, albedo = self.category.surface, self.category.albedo
        shift = np.tensordot(mean[layout.shape], self.widened.shapes, axes=1)
        tint = np.tensordot(mean[layout.albedo], self.widened.albedos, axes=1)
        return replace(
            self.category,
            surface=replace(surface, vertices=surface.vertices + shift),
            albedo=np.clip(albedo + tint, 0.0, 1.0),
        )


def _each(functions: np.ndarray) -> np.ndarray:
    """Return functions (n, V) of one coordinate or colour each, (3n, V, 3)."""
    parts = functions[:, None, :, None] * np.eye(3)[:, None]
    return parts.reshape(-1, *parts.shape[2:])


class _ImagesPrior(SurfacePrior):
    """Prior of bodies in one image each, all of different cameras with tangents (N,)."""

    def __init__(self, category: Category, tangents: np.ndarray) -> None:
        super().__init__(category, tangents[:1])
        self.tangent = tangents[:, None]

    def render(self, theta: torch.Tensor, size: int, features: bool = False) -> torch.Tensor:
        p = self.parameters(theta)
        vertices = self._posed(p)[:, 0]
        triangles = self.category.surface.triangles
        colours = shaded(vertices, triangles, p.albedo, p.light, p.ambient)
        colours = self._with_features(colours) if features else colours
        # One camera sees the same images if bodies are stretched across its axis.
        tangent = float(self.tangent.mean())
        stretch = torch.ones(len(vertices), 1, 3, dtype=theta.dtype)
        stretch[..., :2] = torch.as_tensor(tangent / self.tangent, dtype=theta.dtype)[..., None]
        images = self.renderer.render(vertices * stretch, triangles, colours, tangent, size)
        return images[:, None]
