"""Amortised inference with a conditional VAE trained on simulated pairs.

A network learns p(X | y) from pairs simulated from the prior and the likelihood. Sampling from
the posterior requires one forward pass of the network.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain

import numpy as np

from probmotion import seeds
from probmotion.extras import nn, torch
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import progress_bar
from probmotion.samplers.variational.amortised_network import ConditionalVAE
from probmotion.samplers.variational.simulated_pairs import (
    MotionCoordinates,
    PrincipalCoordinates,
    SimulatedPairs,
    observed_entries,
    simulate_pairs,
)
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_positive

__all__ = ["AmortisedPosterior", "AmortisedSettings"]

# Number of pairs used to compute the principal coordinates.
_BASIS_PAIRS = 12_000
# Fraction of pairs held out to estimate the covariance of the decoder.
_HELD_OUT = 0.1
_WARMUP = 100  # Number of steps in which the learning rate increases linearly.
# Initial weight of the KL divergence, and the fraction of steps in which it increases to 1.
_INITIAL_KL_WEIGHT, _ANNEALED_FRACTION = 0.05, 0.3


@dataclass(frozen=True)
class AmortisedSettings:
    """Network sizes and training settings of amortised inference.

    Parameters
    ----------
    steps : int
        Number of gradient steps.
    batch : int
        Number of pairs per step.
    pairs : int
        Number of simulated pairs.
    coordinates : int
        Maximum number of principal coordinates of motions and of observations, each.
    latent, components, experts, hidden : int
        Sizes of the network (:class:`ConditionalVAE`).
    learning_rate : float
        Maximum learning rate of AdamW, with linear warm-up and cosine decay to 0.
    """

    steps: int = 4000
    batch: int = 128
    pairs: int = 40_000
    coordinates: int = 96
    latent: int = 16
    components: int = 128
    experts: int = 32
    hidden: int = 256
    learning_rate: float = 3e-3

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "coordinates", "latent", "components", "experts", "hidden"):
            check_count(name, getattr(self, name))
        check_count("pairs", self.pairs, least=100)
        check_positive("learning_rate", self.learning_rate)

    def rate(self, step: int) -> float:
        """Return the learning rate of a step, counted from 1."""
        decay = 0.5 * (1 + math.cos(math.pi * step / self.steps))
        return self.learning_rate * decay * min(1.0, step / _WARMUP)

    def weight(self, step: int) -> float:
        """Return the weight of the KL divergence; small at first to avoid posterior collapse."""
        progress = min(1.0, step / (_ANNEALED_FRACTION * self.steps))
        return _INITIAL_KL_WEIGHT + (1 - _INITIAL_KL_WEIGHT) * progress


@dataclass(frozen=True, eq=False)
class AmortisedPosterior:
    """Amortised approximation of p(X | y) at the observations y of one posterior.

    ``network`` is in double precision, so that draws do not depend on the batch size. ``root`` is a
    square root of the decoder's covariance S, (C, C), and ``observed`` the observations, (L, M).
    """

    network: ConditionalVAE
    motions: MotionCoordinates
    root: np.ndarray
    observed: np.ndarray
    observations: PrincipalCoordinates

    @classmethod
    def fit(
        cls, posterior: MotionPosterior, settings: AmortisedSettings, seed: int, progress: bool
    ) -> AmortisedPosterior:
        """Train a network on simulated pairs; the result does not depend on the number of cores.

        Raises :class:`UnsupportedPosterior` if the observations are neither keypoints nor joints,
        and ``ValueError`` if training diverges.
        """
        observed = observed_entries(posterior.likelihood, posterior.frames)
        with one_thread():
            motions, observations, x, y = _coordinates(posterior, settings, seed)
            n = max(1, int(_HELD_OUT * len(x)))
            sizes = (settings.latent, settings.components, settings.experts, settings.hidden)
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seeds.integer(seed, "network"))
                network = ConditionalVAE(x.shape[1], y.shape[1], *sizes)
            _train(network, x[n:], y[n:], settings, seed, progress)
            root = _decoder_root(network.double(), x[:n].double(), y[:n].double(), seed)
        return cls(network, motions, root, observed, observations)

    def draw(self, streams: NormalStreams) -> np.ndarray:
        """Return one motion per stream, (B, L, J, 3), metres."""
        B, (L, _) = len(streams.generators), self.observed.shape
        C = len(self.root)
        uniform, z_noise = streams.uniform(), streams.normal(self.network.latent)
        x_noise, remainder_noise = streams.normal(C), streams.normal(L, self.motions.root.shape[1])
        with one_thread(), torch.no_grad():
            y = self.observations.coordinates(self.observed[None]).repeat(B, axis=0)
            condition = torch.from_numpy(y)
            mixture = self.network.prior(condition[:1])
            log_weight, means, log_scales = (part[0].numpy() for part in mixture)
            # Omit the last cumulative weight, which may round to less than 1.
            cumulative = np.cumsum(np.exp(log_weight))[:-1]
            k = np.searchsorted(cumulative, uniform, side="right")
            z = torch.from_numpy(means[k] + np.exp(log_scales[k]) * z_noise)
            x = self.network.decode(z, condition).numpy() + x_noise @ self.root.T
            flat = self.motions.motions(x, y, self.observed, remainder_noise)
        return flat.reshape(B, L, -1, 3)


def _coordinates(
    posterior: MotionPosterior, settings: AmortisedSettings, seed: int
) -> tuple[MotionCoordinates, PrincipalCoordinates, torch.Tensor, torch.Tensor]:
    """Return the coordinate systems of motions and observations, and x and y of all pairs."""
    chunks = simulate_pairs(posterior, seed, settings.pairs)
    first_chunks: list[SimulatedPairs] = []
    while sum(len(pairs.positions) for pairs in first_chunks) < min(_BASIS_PAIRS, settings.pairs):
        first_chunks.append(next(chunks))
    first = SimulatedPairs(
        np.concatenate([pairs.positions for pairs in first_chunks]),
        np.concatenate([pairs.observed for pairs in first_chunks]),
    )
    limit = settings.coordinates
    observations = PrincipalCoordinates.of(first.observed, limit)
    motions = MotionCoordinates.learn(first, observations.coordinates(first.observed), limit)
    x, y = [], []
    for pairs in chain([first], chunks):
        y.append(observations.coordinates(pairs.observed))
        x.append(motions.coordinates(pairs.positions, y[-1]))
    all_x, all_y = (torch.from_numpy(np.concatenate(part)).float() for part in (x, y))
    return motions, observations, all_x, all_y


def _train(
    network: ConditionalVAE,
    x: torch.Tensor,
    y: torch.Tensor,
    settings: AmortisedSettings,
    seed: int,
    progress: bool,
) -> None:
    """Train the network; raise ``ValueError`` if the loss is not finite."""
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    rng = seeds.torch_generator(seed, "training")
    with progress_bar(settings.steps, "simulated pairs", progress) as bar:
        for step in range(1, settings.steps + 1):
            for group in optimiser.param_groups:
                group["lr"] = settings.rate(step)
            rows = torch.randint(len(x), (settings.batch,), generator=rng)
            noise = torch.randn(settings.batch, settings.latent, generator=rng)
            loss = network.loss(x[rows], y[rows], noise, settings.weight(step))
            if not math.isfinite(loss.item()):
                raise ValueError(
                    f"training on simulated pairs diverged at step {step} with learning_rate "
                    f"{settings.learning_rate:g}; use a smaller value"
                )
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimiser.step()
            bar.update(1)


def _decoder_root(
    network: ConditionalVAE, x: torch.Tensor, y: torch.Tensor, seed: int
) -> np.ndarray:
    """Return a square root of S, the residual covariance of held-out pairs, (C, C)."""
    rng = seeds.torch_generator(seed, "misfits")
    noise = torch.randn(len(x), network.latent, generator=rng, dtype=x.dtype)
    misfits = network.misfits(x, y, noise).numpy()
    variance, axes = np.linalg.eigh(misfits.T @ misfits / len(misfits))
    return axes * np.sqrt(np.maximum(variance, 0.0))
