"""Variational inference with a dynamical VAE (Motion-DVAE).

A network maps the observations to a distribution over motions, either directly (regression) or
after optimisation for these observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from numbers import Real
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from probmotion import seeds
from probmotion.motion.motion import Motion
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import (
    HasInferenceNetwork,
    HasLogDensity,
    InferenceNetwork,
    MotionInference,
    Samplable,
)
from probmotion.posteriors.sampling import UnsupportedPosterior, progress_bar
from probmotion.samplers.independent import Batches, IndependentSampler
from probmotion.samplers.variational.simulated_pairs import observed_entries
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_not_negative, check_positive

__all__ = ["DVAEInference"]

Mode = Literal["regression", "optimization"]

# Maximum gradient norm. Out of distribution, initial losses reach thousands of nats, and unclipped
# gradients would dominate the moments of Adam.
_CLIP = 30.0


@dataclass(frozen=True)
class DVAEInference(IndependentSampler):
    """Variational inference with inference networks (Motion-DVAE, appendices B to E).

    A prior with an inference network is sampled directly if there are no observations. Otherwise
    the sampler uses ``network`` or the prior's network or, if there is none for the observations,
    trains one on simulated pairs (:mod:`~probmotion.samplers.variational.amortised`).
    Draws have θ and log densities if the motion fits into one window of an inference network.

    Parameters
    ----------
    network : InferenceNetwork, optional
        Inference network; the network of the prior by default.
    mode : {"regression", "optimization"}
        Use the network unchanged, or optimise it for the observations.
    iterations : int
        Number of optimisation steps; 50 to 200 as published.
    learning_rate : float
        Initial learning rate of Adam, with half-cosine decay to 0. The default was chosen on the
        validation clips of ``body-dvae``.
    degrees_of_freedom : float, optional
        Degrees of freedom λ of the assumed Student-t noise, ``inf`` for Gaussian; from the
        likelihood by default. Small values are robust to outliers.
    initial_entropy : bool
        Include the entropy and the prior of the first pose in the bound. The paper omits them
        (appendix C.2.2), which improves the fit but makes the first frames overconfident.
    latent_weight : float
        Weight of the motion prior in the optimisation; 0 for the ablation "no prior".
    overlap : int
        Number of frames shared by consecutive windows of a long motion, less than their length.
    training_steps, training_pairs : int
        Numbers of gradient steps and simulated pairs if a network is trained.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "dvae"
    requires: ClassVar[tuple[Any, ...]] = (Samplable,)
    effort: ClassVar[tuple[str, ...]] = ("training_steps", "iterations")
    least_effort: ClassVar[int] = 100

    network: InferenceNetwork | None = None
    mode: Mode = "regression"
    iterations: int = 100
    learning_rate: float = 2e-3
    degrees_of_freedom: float | None = None
    initial_entropy: bool = True
    latent_weight: float = 1.0
    overlap: int = 10
    training_steps: int = 4000
    training_pairs: int = 40_000
    batch: int = 256

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise ValueError(f"mode must be one of {', '.join(get_args(Mode))}, got {self.mode!r}")
        for name in ("iterations", "batch", "training_steps", "overlap"):
            check_count(name, getattr(self, name))
        check_count("training_pairs", self.training_pairs, least=100)
        check_positive("learning_rate", self.learning_rate)
        freedom = self.degrees_of_freedom
        if freedom is not None and not (isinstance(freedom, Real) and freedom > 0):
            raise ValueError(f"degrees_of_freedom must be a number above 0 or inf, got {freedom!r}")
        check_not_negative("latent_weight", self.latent_weight)
        if self.network is not None and not isinstance(self.network, InferenceNetwork):
            raise ValueError(f"network must be an InferenceNetwork, got {self.network!r}")

    @classmethod
    def paper(cls) -> DVAEInference:
        """Return the published settings: optimisation, robust noise, no initial entropy."""
        return cls(
            mode="optimization", iterations=50, degrees_of_freedom=4.0, initial_entropy=False
        )

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether a network supports the observations or can be trained for them."""
        network = getattr(posterior.prior, "inference_network", None)
        if posterior.likelihood is None or (network and network.reads(posterior.likelihood)):
            return True
        try:
            observed_entries(posterior.likelihood, posterior.frames)
        except UnsupportedPosterior:
            return False
        return True

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        counts = {"gradient": 0}
        thetas: list[np.ndarray] = []

        @cache
        def fitted() -> Callable[[NormalStreams], np.ndarray]:
            return self._draw_function(posterior, seed, counts, thetas, progress)

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            # Train and optimise in the first batch, so that the run time includes both.
            tick()
            with one_thread():
                return fitted()(streams)

        return Batches(draw, self.batch, counts=counts, thetas=thetas)

    def predict(
        self,
        posterior: MotionPosterior,
        *,
        seed: int = 0,
        average: bool = True,
        progress: bool = True,
    ) -> Motion:
        """Return the mean motion over draws of an inference network (appendix D, equation 11).

        Parameters
        ----------
        posterior, progress
            As in :meth:`sample`.
        seed : int
            Seed of the draws to average.
        average : bool
            Average the draws; otherwise decode the means (the ablation "NN output").

        Raises
        ------
        UnsupportedPosterior
            If there is no inference network for the observations.
        """
        network = self._network_of(posterior)
        if network is None or posterior.likelihood is None:
            raise UnsupportedPosterior(
                self.name,
                "predicts a motion only with an inference network that supports the observations; "
                "use the mean of draws instead",
                word="network",
            )
        inference = self._fitted(network, posterior, seed, {"gradient": 0}, progress)
        positions = inference.predict(seeds.generator(seed, "predict"), average=average)
        return Motion(positions, posterior.skeleton, posterior.fps, name="predicted")

    def _draw_function(
        self,
        posterior: MotionPosterior,
        seed: int,
        counts: dict[str, int],
        thetas: list[np.ndarray],
        progress: bool,
    ) -> Callable[[NormalStreams], np.ndarray]:
        """Return a function that draws motions, (B, L, J, 3), and appends θ to ``thetas``."""
        prior = posterior.prior
        if posterior.likelihood is None and isinstance(prior, HasInferenceNetwork):
            assert isinstance(prior, Samplable)
            # NormalStreams has the methods of a generator, with one stream per draw.
            return lambda streams: prior.sample(streams, len(streams.generators))  # type: ignore[arg-type]
        network = self._network_of(posterior)
        if network is None:
            from probmotion.samplers.variational.amortised import (
                AmortisedPosterior,
                AmortisedSettings,
            )

            settings = AmortisedSettings(steps=self.training_steps, pairs=self.training_pairs)
            counts["gradient"] += self.training_steps
            return AmortisedPosterior.fit(posterior, settings, seed, progress).draw
        inference = self._fitted(network, posterior, seed, counts, progress)

        def draw(streams: NormalStreams) -> np.ndarray:
            positions, theta = inference.draw(streams, len(streams.generators))
            if theta is not None and isinstance(prior, HasLogDensity):
                thetas.append(theta)
            return positions

        return draw

    def _network_of(self, posterior: MotionPosterior) -> InferenceNetwork | None:
        """Return the network for the observations, or None if one must be trained."""
        prior, likelihood = posterior.prior, posterior.likelihood
        if likelihood is None:
            return None
        if self.network is not None and not self.network.reads(likelihood):
            raise UnsupportedPosterior(
                self.name,
                f"requires a network that supports {type(likelihood).__name__}",
                word="observations",
            )
        network = self.network
        if network is None and isinstance(prior, HasInferenceNetwork):
            network = prior.inference_network
        return network if network is not None and network.reads(likelihood) else None

    def _fitted(
        self,
        network: InferenceNetwork,
        posterior: MotionPosterior,
        seed: int,
        counts: dict[str, int],
        progress: bool,
    ) -> MotionInference:
        """Return the inference for the observations, optimised in mode "optimization"."""
        inference = network.on(
            posterior.prior,
            posterior.likelihood,
            degrees_of_freedom=self.degrees_of_freedom,
            overlap=self.overlap,
        )
        if self.mode == "regression":
            return inference
        losses = self._optimised(inference, seed, counts, progress)
        # An increase of one nat per coordinate exceeds the noise of the loss.
        tolerance = 3 * posterior.frames * posterior.skeleton.n_joints
        if not all(map(math.isfinite, losses)) or losses[-1] > losses[0] + tolerance:
            raise ValueError(
                f"optimisation diverged with learning_rate {self.learning_rate:g} from loss "
                f"{losses[0]:g} to {losses[-1]:g}; use a smaller value"
            )
        return inference

    def _optimised(
        self, inference: MotionInference, seed: int, counts: dict[str, int], progress: bool
    ) -> list[float]:
        """Optimise and return all losses; the last loss uses the random numbers of the first."""
        from probmotion.extras import torch

        parameters = inference.parameters()
        adam = torch.optim.Adam(parameters, lr=self.learning_rate)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.iterations)
        losses: list[float] = []
        with progress_bar(self.iterations, f"{self.name} optimisation", progress) as bar:
            for iteration in [*range(self.iterations), 0]:
                loss = inference.loss(
                    seeds.generator(seed, "fit", iteration),
                    initial_entropy=self.initial_entropy,
                    latent_weight=self.latent_weight,
                )
                losses.append(float(loss.detach()))
                if len(losses) > self.iterations or not math.isfinite(losses[-1]):
                    break
                adam.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(parameters, _CLIP)
                adam.step()
                scheduler.step()
                counts["gradient"] += 1
                bar.update(1)
        return losses
