"""Posterior draws of a body in one image or a clip of images."""

from __future__ import annotations

import numpy as np
from scipy.special import softmax

from probmotion import seeds
from probmotion.extras import torch
from probmotion.lifting.checks import Check
from probmotion.models.images.category import Category
from probmotion.models.images.encoder import EncoderNetwork, encoder_input, parameters_of
from probmotion.models.images.encoder_training import TANGENTS, encoder_of
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction.refinement import Mode, promising, refine
from probmotion.reconstruction.result import Reconstruction
from probmotion.validation import check_count

__all__ = ["checked", "encoded", "mixture_draws", "posterior_modes", "reconstruct"]

_STARTS, _KEPT = 6, 3  # draws from the encoder that are refined, and modes refined to the end
# Clips: number of random motions, correlation of half of them with the encoder's code, and number
# of modes that are refined to the end.
_MOTIONS, _CERTAIN, _KEPT_CLIPS = 400, 0.7, 2
_UNLIKELY = 0.02  # probability of a quarter turn below which its mean is not refined
_UNCOVERED, _UNUSUAL = 0.1, 2.0
"""Largest values of reconstructions that can be trusted.

They are of 1 − IoU relative to the outline (:func:`_uncovered`), and of the mean square of the
standardised coefficients of the shape. Chosen on made images of validation clips, on discs,
polygons and letters, and on masks of the other category.
"""


def reconstruct(
    observation: ImageObservation, category: Category, *, draws: int = 100, seed: int = 0
) -> Reconstruction:
    """Reconstruct a body of a category in 3D from one image, or from the images of a clip.

    The encoder's hypotheses of pose, shape and direction are refined to modes of the posterior;
    draws are those of a mixture of Gaussians at the modes, weighted by their evidence. The
    Gaussians are wider than the Laplace approximation, such that intervals hold in spite of the
    likelihood's many narrow modes. Images of a clip follow each other at the frame rate of the
    category's motions.

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
    """Return a reconstruction with the checks of its field of view, silhouette and shape."""
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
            _uncovered(result),
            _UNCOVERED,
            f"no body of the category {category.name} has this silhouette",
        ),
        Check(
            "shape",
            float((shape**2).sum() / max(len(shape), 1)),
            _UNUSUAL,
            f"the surface is unlike those of the category {category.name}",
        ),
    )


def _uncovered(result: Reconstruction) -> float:
    """Return 1 − IoU of silhouette and mask for an outline as short as that of a square.

    Silhouettes of thin bodies have a smaller IoU when outlines are equally far apart; 1 − IoU is
    therefore divided by the ratio of the mask's outline to that of a square of its area.
    """
    mask = result.observation.mask
    body = np.where(np.isfinite(mask), mask >= 0.5, np.nan)
    outline = sum(np.nansum(np.abs(np.diff(body, axis=axis))) for axis in (1, 2))
    square = 4 * np.sqrt(np.nansum(body) * len(body))  # of the mean area, in all T images
    return float((1 - result.mask_iou) * square / max(outline, 1.0))


def posterior_modes(
    network: EncoderNetwork, prior: SurfacePrior, observed: ImageObservation, seed: int = 0
) -> list[Mode]:
    """Return modes of p(θ | images) that are reached from the encoder's hypotheses, best first."""
    rng = seeds.generator(seed, "starts")
    if observed.images == 1:
        starts = encoded(network, prior, observed, rng, _STARTS)
        return refine(prior, observed, starts, keep=_KEPT)
    starts = _encoded_clip(network, prior, observed)
    # Single images leave left and right legs ambiguous, so that the encoder's means hardly move.
    tried = np.repeat(starts, -(-_MOTIONS // len(starts)), axis=0)
    z = rng.standard_normal((len(tried), prior.category.code.dim))
    kept = np.where(np.arange(len(tried)) % 2, 0.0, _CERTAIN)[:, None]
    code = prior.layout.code
    tried[:, code] = kept * tried[:, code] + np.sqrt(1 - kept**2) * z
    starts = np.concatenate([starts, promising(prior, observed, tried, _STARTS - 1)])
    return refine(prior, observed, starts, keep=_KEPT_CLIPS)


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
) -> np.ndarray:
    """Return the encoder's mean θ of each likely quarter turn, likeliest first, and ``n`` draws.

    The encoder sees the only image. The result is (m + n, dim).
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
    theta = parameters_of(torch.as_tensor(values), torch.as_tensor(quarters), view)
    return np.asarray(theta.numpy())


def mixture_draws(modes: list[Mode], rng: np.random.Generator, n: int) -> np.ndarray:
    """Return ``n`` draws (n, dim) of the mixture of Gaussians at the modes."""
    weights = softmax([mode.log_evidence for mode in modes])
    counts = rng.multinomial(n, weights)
    parts = [mode.draw(rng, int(k)) for mode, k in zip(modes, counts, strict=True)]
    return rng.permutation(np.concatenate(parts))
