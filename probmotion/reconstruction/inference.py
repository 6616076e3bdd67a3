"""Posterior draws of a body in one image or a clip of images."""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.special import softmax

from probmotion import seeds
from probmotion.extras import skimage, torch  # noqa: F401  Its extra has all other libraries, too.
from probmotion.lifting.checks import Check
from probmotion.models.images.category import Category
from probmotion.models.images.encoder import EncoderNetwork, encoder_input, parameters_of
from probmotion.models.images.encoder_training import TANGENTS, encoder_of
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction.refinement import Mode, promising, quarters_of, refine
from probmotion.reconstruction.result import Reconstruction
from probmotion.threads import one_thread
from probmotion.validation import check_count

__all__ = [
    "DRAWN",
    "checked",
    "encoded",
    "mixture_draws",
    "modes_of",
    "posterior_modes",
    "reconstruct",
]

DRAWN = 1000
"""Number of draws from the encoder of an image, of which the best are refined."""

_STARTS, _KEPT = 12, 6  # draws that are refined, and modes that are refined to the end
# Clips: number of random motions, correlation of half of them with the encoder's code, the best of
# them that are refined, and modes that are refined to the end.
_MOTIONS, _CERTAIN, _STARTS_CLIPS, _KEPT_CLIPS = 400, 0.7, 5, 2
_CONFIDENCE = 0.35
"""Power of the evidence in the weights of modes. It is below 1, since the evidence exaggerates
differences between modes. Chosen on validation images of both categories by the continuous ranked
probability score of joints."""
_UNLIKELY = 0.02  # probability of a quarter turn below which it is not refined
_OUTLINE_ERROR, _UNUSUAL, _UNCOVERED = 0.1, 2.0, 0.08
"""Largest values of reconstructions that can be trusted.

They are of 1 − IoU relative to the outline (:func:`_outline_error`), of the mean square of the
standardised coefficients of the shape, and of the uncovered disc (:func:`_uncovered_radius`).
Chosen on made images of validation clips, alone and with a second body beside the first, on discs,
polygons and letters, and on masks of the other category.
"""


@one_thread()
def reconstruct(
    observation: ImageObservation, category: Category, *, draws: int = 100, seed: int = 0
) -> Reconstruction:
    """Reconstruct a body of a category in 3D from one image, or from the images of a clip.

    The encoder's hypotheses of pose, shape and direction are refined to modes of the posterior;
    draws are those of a mixture of Gaussians at the modes, weighted by a power of their evidence.
    The power is below 1 and the Gaussians are wider than the Laplace approximation, such that
    intervals hold in spite of the likelihood's many narrow modes. Images of a clip follow each
    other at the frame rate of the category's motions. Linear algebra of the process uses one thread
    meanwhile: rounding could lead to other modes.

    Parameters
    ----------
    observation : ImageObservation
        Masks, and colours and features if given.
    category : Category
        Kind of body, with its encoder beside its file.
    draws : int
        Number of posterior draws, at least 2.
    seed : int
        Seed of the starts and draws.

    Raises
    ------
    FileNotFoundError
        If the category has no encoder.
    ValueError
        If there are more images than frames of the category's motions, or features that the
        category does not have.
    """
    check_count("draws", draws, 2)
    category.check_features(observation.features)
    prior = SurfacePrior(category, observation.tangent, rotation=observation.rotation)
    modes = posterior_modes(encoder_of(category), prior, observation, seed)
    chosen = mixture_draws(modes, seeds.generator(seed, "draws"), draws)
    return checked(Reconstruction(observation, prior, modes[0].theta, chosen, ()))


def checked(result: Reconstruction) -> Reconstruction:
    """Return a reconstruction with its checks of field of view, silhouette, shape and mask."""
    category, shape = result.prior.category, result.theta[result.prior.layout.shape]
    return result.with_checks(
        Check(
            "field of view",
            float(result.observation.tangent.max()),
            TANGENTS[1],
            "the body fills more of the field of view than those that the encoder was trained on",
        ),
        Check(
            "silhouette",
            _outline_error(result),
            _OUTLINE_ERROR,
            f"no body of the category {category.name} has this silhouette",
        ),
        Check(
            "shape",
            float((shape**2).sum() / max(len(shape), 1)),
            _UNUSUAL,
            f"the surface is unlike those of the category {category.name}",
        ),
        Check(
            "uncovered part",
            _uncovered_radius(result),
            _UNCOVERED,
            "the body leaves a part of the mask uncovered, which may be another animal or object",
        ),
    )


def _outline_error(result: Reconstruction) -> float:
    """Return 1 − IoU of silhouette and mask for an outline as short as that of a square.

    Silhouettes of thin bodies have a smaller IoU when outlines are equally far apart; 1 − IoU is
    therefore divided by the ratio of the mask's outline to that of a square of its area.
    """
    mask = result.observation.mask
    body = np.where(np.isfinite(mask), mask >= 0.5, np.nan)
    outline = sum(np.nansum(np.abs(np.diff(body, axis=axis))) for axis in (1, 2))
    square = 4 * np.sqrt(np.nansum(body) * len(body))  # of the mean area, in all T images
    return float((1 - result.mask_iou) * square / max(outline, 1.0))


def _uncovered_radius(result: Reconstruction) -> float:
    """Return the radius of the largest disc of the mask that the silhouette leaves uncovered.

    It is relative to the square root of the mask's area, and the mean of all images.
    """
    inside = result.observation.mask >= 0.5
    uncovered = np.pad(inside & ~result.silhouette, ((0, 0), (1, 1), (1, 1)))
    radii = [ndimage.distance_transform_edt(image).max() for image in uncovered]
    return float((radii / np.sqrt(inside.sum(axis=(1, 2)))).mean())


@one_thread()
def posterior_modes(
    network: EncoderNetwork, prior: SurfacePrior, observed: ImageObservation, seed: int = 0
) -> list[Mode]:
    """Return modes of p(θ | images) that are reached from the encoder's hypotheses, best first.

    They are found with one thread: the density is rugged, so that rounding can change them.
    """
    rng = seeds.generator(seed, "starts")
    if observed.images == 1:
        return modes_of(prior, observed, *encoded(network, prior, observed, rng, DRAWN))
    starts = _encoded_clip(network, prior, observed)
    # Single images leave left and right legs ambiguous, so that the encoder's means hardly move.
    tried = np.repeat(starts, -(-_MOTIONS // len(starts)), axis=0)
    z = rng.standard_normal((len(tried), prior.category.code.dim))
    kept = np.where(np.arange(len(tried)) % 2, 0.0, _CERTAIN)[:, None]
    code = prior.layout.code
    tried[:, code] = kept * tried[:, code] + np.sqrt(1 - kept**2) * z
    starts = np.concatenate([starts, promising(prior, observed, tried, _STARTS_CLIPS)])
    return refine(prior, observed, starts, keep=_KEPT_CLIPS)


def modes_of(
    prior: SurfacePrior, observed: ImageObservation, likely: np.ndarray, drawn: np.ndarray
) -> list[Mode]:
    """Return the modes reached from likely θ (m, dim) and from the best of draws (n, dim).

    Refinement ends in the nearest of many modes: starts that are chosen by their density lie
    closer to the best ones. Each quarter turn of the likely θ has as many.
    """
    quarters, chosen = quarters_of(prior, drawn), np.unique(quarters_of(prior, likely))
    best = [
        promising(prior, observed, drawn[quarters == quarter], _STARTS // len(chosen))
        for quarter in chosen
    ]
    return refine(prior, observed, np.concatenate([likely, *best]), keep=_KEPT)


def _encoded_clip(
    network: EncoderNetwork, prior: SurfacePrior, observed: ImageObservation
) -> np.ndarray:
    """Return θ (m, dim) from the encoder's means for all images, for each likely quarter turn."""
    with torch.no_grad():
        estimates = network(encoder_input(observed.mask, observed.rgb))
    weights = softmax(estimates.log_weights.double().mean(dim=0).numpy())
    view, found = prior.layout.view.start, []
    for quarter in np.argsort(-weights):
        if weights[quarter] > _UNLIKELY:
            turned = torch.full((observed.images,), int(quarter))
            means = estimates.means[:, quarter].double()
            found.append(prior.followed(parameters_of(means, turned, view).numpy()))
    return np.stack(found)


def encoded(
    network: EncoderNetwork,
    prior: SurfacePrior,
    observed: ImageObservation,
    rng: np.random.Generator,
    n: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the encoder's mean θ of each likely quarter turn (m, dim), and n draws (n, dim).

    The encoder sees the only image. The likeliest quarter turn is first.
    """
    with torch.no_grad():
        estimates = network(encoder_input(observed.mask, observed.rgb))
    weights = estimates.log_weights[0].double().exp().numpy()
    means, spreads = (part[0].double().numpy() for part in (estimates.means, estimates.log_spreads))
    order = np.argsort(-weights)
    likely = order[weights[order] > _UNLIKELY]
    drawn = rng.choice(len(weights), size=n, p=weights / weights.sum())
    noise = np.exp(spreads[drawn]) * rng.standard_normal((n, means.shape[-1]))
    values = np.concatenate([means[likely], means[drawn] + noise])
    quarters = np.concatenate([likely, drawn])
    view = prior.layout.view.start
    theta = parameters_of(torch.as_tensor(values), torch.as_tensor(quarters), view).numpy()
    return theta[: len(likely)], theta[len(likely) :]


def mixture_draws(modes: list[Mode], rng: np.random.Generator, n: int) -> np.ndarray:
    """Return ``n`` draws (n, dim) of the mixture of Gaussians at the modes."""
    weights = softmax([_CONFIDENCE * mode.log_evidence for mode in modes])
    counts = rng.multinomial(n, weights)
    parts = [mode.draw(rng, int(k)) for mode, k in zip(modes, counts, strict=True)]
    return rng.permutation(np.concatenate(parts))
