"""Posterior draws of a body in one image or a clip of images."""

from __future__ import annotations

import numpy as np
from scipy.special import softmax

from probmotion import seeds
from probmotion.extras import torch
from probmotion.lifting.checks import Check
from probmotion.models.images.category import Category
from probmotion.models.images.encoder import EncoderNetwork, encoder_input
from probmotion.models.images.encoder_training import TANGENTS, encoder_of
from probmotion.models.images.observation import ImageObservation
from probmotion.models.images.surface_prior import SurfacePrior
from probmotion.reconstruction.refinement import Mode, refine
from probmotion.reconstruction.result import Reconstruction
from probmotion.validation import check_count

__all__ = ["encoded", "mixture_draws", "posterior_modes", "reconstruct"]

_STARTS, _KEPT = 6, 3  # draws from the encoder that are refined, and modes refined to the end
_UNLIKELY = 0.02  # probability of a quarter turn below which its mean is not refined
_UNCOVERED = 0.25
"""Largest 1 − IoU of silhouette and mask of reconstructions that can be trusted."""


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
        Masks, and colours if given.
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
        If there are more images than frames of the category's motions.
    """
    check_count("draws", draws, 2)
    prior = SurfacePrior(category, observation.tangent, rotation=observation.rotation)
    modes = posterior_modes(encoder_of(category), prior, observation, seed)
    chosen = mixture_draws(modes, seeds.generator(seed, "draws"), draws)
    result = Reconstruction(observation, prior, modes[0].theta, chosen, ())
    return result.with_checks(
        Check(
            "field of view",
            float(observation.tangent.max()),
            TANGENTS[1],
            "the body fills more of the field of view than those that the encoder was trained on",
        ),
        Check(
            "silhouette",
            1 - result.mask_iou,
            _UNCOVERED,
            f"no body of the category {category.name} has this silhouette",
        ),
    )


def posterior_modes(
    network: EncoderNetwork, prior: SurfacePrior, observed: ImageObservation, seed: int = 0
) -> list[Mode]:
    """Return modes of p(θ | images) that are reached from the encoder's hypotheses, best first."""
    starts = encoded(network, prior, observed, seeds.generator(seed, "starts"), _STARTS)
    return refine(prior, observed, starts, keep=_KEPT)


def encoded(
    network: EncoderNetwork,
    prior: SurfacePrior,
    observed: ImageObservation,
    rng: np.random.Generator,
    n: int,
) -> np.ndarray:
    """Return the encoder's mean θ of each likely quarter turn, likeliest first, and ``n`` draws.

    The encoder sees the first image. The result is (m + n, dim).
    """
    rgb = None if observed.rgb is None else observed.rgb[:1]
    with torch.no_grad():
        estimates = network(encoder_input(observed.mask[:1], rgb))
    weights = estimates.log_weights[0].double().exp().numpy()
    means, spreads = (part[0].double().numpy() for part in (estimates.means, estimates.log_spreads))
    order = np.argsort(-weights)
    likely = order[weights[order] > _UNLIKELY]
    drawn = rng.choice(len(weights), size=n, p=weights / weights.sum())
    noise = np.exp(spreads[drawn]) * rng.standard_normal((n, means.shape[-1]))
    values = np.concatenate([means[likely], means[drawn] + noise])
    quarters = np.concatenate([likely, drawn])
    start = prior.layout.view.start
    theta = np.zeros((len(values), prior.dim))
    theta[:, :start] = values[:, 1 : start + 1]
    theta[:, start + 2 : start + 7] = values[:, start + 1 :]
    return prior.facing(theta, quarters * np.pi / 2 + values[:, 0])


def mixture_draws(modes: list[Mode], rng: np.random.Generator, n: int) -> np.ndarray:
    """Return ``n`` draws (n, dim) of the mixture of Gaussians at the modes."""
    weights = softmax([mode.log_evidence for mode in modes])
    counts = rng.multinomial(n, weights)
    parts = [mode.draw(rng, int(k)) for mode, k in zip(modes, counts, strict=True)]
    return rng.permutation(np.concatenate(parts))
