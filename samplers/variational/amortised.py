"""A posterior learnt from its own simulations, for priors that nobody has a network of.

One network learns p(X | y) for every y that the prior and likelihood can make, from simulated
pairs; given the real evidence it draws by one forward pass. Its bias is what the network has not
learnt, which a problem with exact draws measures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from torch import nn

from probmotion import seeds
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

# Pairs that the coordinates and the remainder are learnt from.
_FIRST = 12_000
# Share of the pairs that the decoder's covariance is measured on, which weights never see.
_HELD_OUT = 0.1
_WARMUP = 100
# KL(r ‖ p) counts this much at the first step and fully from this share of the steps on.
_FIRST_WEIGHT, _ANNEALED = 0.05, 0.3


@dataclass(frozen=True)
class AmortisedSettings:
    """Size of the network, and how long it learns.

    Parameters
    ----------
    steps : int
        Gradient steps.
    batch : int
        Pairs per step.
    pairs : int
        Simulated pairs, made once.
    coordinates : int
        Most principal coordinates of motions, and of evidence; the rest is Gaussian noise.
    latent : int
        Length of z.
    components : int
        Gaussians that p(z | y) mixes.
    experts : int
        Linear maps that the decoder mixes.
    hidden : int
        Width of the networks.
    learning_rate : float
        The largest of Adam, which falls along a cosine to 0.

    Raises
    ------
    ValueError
        If a number is out of range.
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
        """Return the learning rate of a step, from 1."""
        fall = 0.5 * (1 + math.cos(math.pi * step / self.steps))
        return self.learning_rate * fall * min(1.0, step / _WARMUP)

    def weight(self, step: int) -> float:
        """Return how much KL(r ‖ p) counts at a step: little at first, lest z is never used."""
        done = min(1.0, step / (_ANNEALED * self.steps))
        return _FIRST_WEIGHT + (1 - _FIRST_WEIGHT) * done


@dataclass(frozen=True, eq=False)
class AmortisedPosterior:
    """p(X | y) as a network has learnt it, at the evidence y of one posterior.

    Parameters
    ----------
    network : ConditionalVAE
        In double precision, so that a draw's rounding does not depend on its batch.
    motions : MotionCoordinates
        What the network's x are coordinates of.
    root : ndarray, (C, C)
        Of the decoder's covariance S.
    observed : ndarray, (L, M)
        The evidence.
    evidence : PrincipalCoordinates
        Of evidence.
    """

    network: ConditionalVAE
    motions: MotionCoordinates
    root: np.ndarray
    observed: np.ndarray
    evidence: PrincipalCoordinates

    @classmethod
    def fit(
        cls, posterior: MotionPosterior, settings: AmortisedSettings, seed: int, progress: bool
    ) -> AmortisedPosterior:
        """Return what a network learns from simulated pairs.

        Parameters
        ----------
        posterior : MotionPosterior
            Its prior can be sampled and its likelihood simulated.
        settings : AmortisedSettings
            Size and length.
        seed : int
            Of pairs, first weights and batches; the same on any number of cores.
        progress : bool
            Show a bar.

        Raises
        ------
        UnsupportedPosterior
            If the prior cannot be sampled, or the evidence is neither keypoints nor joints.
        ValueError
            If training diverges.
        """
        observed = observed_entries(posterior.likelihood, posterior.frames)
        with one_thread():
            motions, evidence, x, y = _coordinates(posterior, settings, seed)
            held = max(1, int(_HELD_OUT * len(x)))
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(seeds.integer(seed, "network"))
                network = ConditionalVAE(
                    x.shape[1],
                    y.shape[1],
                    settings.latent,
                    settings.components,
                    settings.experts,
                    settings.hidden,
                )
            _train(network, x[held:], y[held:], settings, seed, progress)
            root = _decoder_root(network.double(), x[:held].double(), y[:held].double(), seed)
        return cls(network, motions, root, observed, evidence)

    def draw(self, streams: NormalStreams) -> np.ndarray:
        """Return one motion per stream, (B, L, J, 3), metres."""
        B, (L, _) = len(streams.generators), self.observed.shape
        C = len(self.root)
        chosen, z_noise = streams.uniform(), streams.normal(self.network.latent)
        x_noise, left_noise = streams.normal(C), streams.normal(L, self.motions.root.shape[1])
        with one_thread(), torch.no_grad():
            y = self.evidence.coordinates(self.observed[None]).repeat(B, axis=0)
            given = torch.from_numpy(y)
            mixture = self.network.prior(given[:1])
            log_weight, means, log_scales = (part[0].numpy() for part in mixture)
            # The last sum may round to less than 1.
            steps = np.cumsum(np.exp(log_weight))[:-1]
            k = np.searchsorted(steps, chosen, side="right")
            z = torch.from_numpy(means[k] + np.exp(log_scales[k]) * z_noise)
            x = self.network.decode(z, given).numpy() + x_noise @ self.root.T
            flat = self.motions.motions(x, y, self.observed, left_noise)
        return flat.reshape(B, L, -1, 3)


def _coordinates(
    posterior: MotionPosterior, settings: AmortisedSettings, seed: int
) -> tuple[MotionCoordinates, PrincipalCoordinates, torch.Tensor, torch.Tensor]:
    """Return what coordinates of motions and evidence are, and all pairs' x and y."""
    first: list[SimulatedPairs] = []
    chunks = simulate_pairs(posterior, seed, settings.pairs)
    for pairs in chunks:
        first.append(pairs)
        if sum(len(some.positions) for some in first) >= _FIRST:
            break
    known = SimulatedPairs(
        np.concatenate([some.positions for some in first]),
        np.concatenate([some.observed for some in first]),
    )
    evidence = PrincipalCoordinates.of(known.observed, settings.coordinates)
    motions = MotionCoordinates.learn(
        known, evidence.coordinates(known.observed), settings.coordinates
    )
    x, y = [], []
    for pairs in chain([known], chunks):
        y.append(evidence.coordinates(pairs.observed))
        x.append(motions.coordinates(pairs.positions, y[-1]))
    wanted, given = (torch.from_numpy(np.concatenate(part)).float() for part in (x, y))
    return motions, evidence, wanted, given


def _train(
    network: ConditionalVAE,
    x: torch.Tensor,
    y: torch.Tensor,
    settings: AmortisedSettings,
    seed: int,
    progress: bool,
) -> None:
    """Change the network's weights, step by step.

    Raises
    ------
    ValueError
        If a loss is not finite.
    """
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    rng = seeds.torch_generator(seed, "training")
    with progress_bar(settings.steps, "simulated pairs", progress) as bar:
        for step in range(1, settings.steps + 1):
            for group in optimiser.param_groups:
                group["lr"] = settings.rate(step)
            chosen = torch.randint(len(x), (settings.batch,), generator=rng)
            noise = torch.randn(settings.batch, settings.latent, generator=rng)
            loss = network.loss(x[chosen], y[chosen], noise, settings.weight(step))
            if not math.isfinite(loss.item()):
                raise ValueError(
                    f"learning_rate is {settings.learning_rate:g}, with which training on "
                    f"simulated pairs diverged at step {step}; expected a smaller one"
                )
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimiser.step()
            bar.update(1)


def _decoder_root(
    network: ConditionalVAE, x: torch.Tensor, y: torch.Tensor, seed: int
) -> np.ndarray:
    """Return the root of the best S for pairs that no weight has seen, (C, C).

    Given μ, E log N(x; μ, S) is largest at the covariance of the misfits; on pairs that were
    learnt from it would be too small.
    """
    rng = seeds.torch_generator(seed, "misfits")
    noise = torch.randn(len(x), network.latent, generator=rng, dtype=x.dtype)
    misfits = network.misfits(x, y, noise).numpy()
    variance, axes = np.linalg.eigh(misfits.T @ misfits / len(misfits))
    return axes * np.sqrt(np.maximum(variance, 0.0))
