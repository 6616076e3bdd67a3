"""`DVAEInference`: variational inference with a dynamical VAE (Motion-DVAE).

A network reads the evidence and answers with a distribution over motions: at once, as it learnt
from other recordings (regression), or after it was fitted to this one (optimisation).
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
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import (
    HasInferenceNetwork,
    HasLogDensity,
    InferenceNetwork,
    MotionInference,
    Samplable,
)
from probmotion.posteriors.sampling import Interrupted, UnsupportedPosterior, progress_bar, require
from probmotion.samplers.independent import draw_independently, refuse_initial, with_coordinates
from probmotion.samplers.variational.amortised import AmortisedPosterior, AmortisedSettings
from probmotion.samplers.variational.simulated_pairs import observed_entries
from probmotion.seeds import NormalStreams
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_positive

__all__ = ["DVAEInference"]

Mode = Literal["regression", "optimization"]


# Greatest norm of the fit's gradient: what the network answers to something unlike all that it
# learnt from can be off by thousands of nats, and one such step must not spoil Adam's memory.
_CLIP = 30.0


@dataclass(frozen=True)
class DVAEInference:
    """Variational inference with networks that read the evidence (Motion-DVAE, B to E).

    A prior beside which such networks were trained brings them; without evidence, draws are its
    own. For any other prior that can be sampled, and for evidence they do not read, a network is
    trained here first, on motions of the prior with evidence simulated of each
    (:mod:`~probmotion.samplers.variational.amortised`), and not fitted: the settings of a fit have
    no say.

    A budget sets ``training_steps`` and ``iterations``
    (:mod:`probmotion.comparison.results.budgets`).

    Parameters
    ----------
    network : InferenceNetwork, optional
        Used in place of the prior's own.
    mode : {"regression", "optimization"}
        Draw from what the network answers, or fit it to this evidence first.
    iterations : int
        Of the fit; 50 to 200 as published.
    learning_rate : float
        Of Adam at the fit's beginning; it falls to 0 by half a cosine. Chosen, with that, on the
        clips that ``body-dvae`` was watched on.
    degrees_of_freedom : float, optional
        λ of the noise that is supposed, ``inf`` for Gaussian; by default the evidence's own. A
        small one is robust against outliers that the evidence does not know of.
    initial_entropy : bool
        Whether the bound has the entropy of the first pose and its prior. The paper leaves them
        out (C.2.2), which fits better and makes first frames over-confident.
    latent_weight : float
        Weight of the motion prior in the fit; 0 leaves it out (the ablation "no prior").
    overlap : int
        Frames that windows of a long motion share, from 1 to one less than a window has.
    training_steps, training_pairs : int
        Where a network has to be trained first: gradient steps, and simulated pairs of a motion
        and its evidence.
    batch : int
        Draws at a time; changes memory and speed, never the draws.

    Raises
    ------
    ValueError
        If a number is out of range, the mode is unknown or the network is none.
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
        if not (isinstance(weight := self.latent_weight, Real) and 0 <= weight < math.inf):
            raise ValueError(f"latent_weight must be a finite number of at least 0, got {weight!r}")
        if self.network is not None and not isinstance(self.network, InferenceNetwork):
            raise ValueError(f"network must be an InferenceNetwork, got {self.network!r}")

    @classmethod
    def paper(cls) -> DVAEInference:
        """Return the optimisation as published: robust noise, no entropy of the first pose."""
        return cls(
            mode="optimization", iterations=50, degrees_of_freedom=4.0, initial_entropy=False
        )

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the prior's network reads the evidence, or one can be shown it."""
        network = getattr(posterior.prior, "inference_network", None)
        if posterior.likelihood is None or (network and network.reads(posterior.likelihood)):
            return True
        try:
            observed_entries(posterior.likelihood, posterior.frames)
        except UnsupportedPosterior:
            return False
        return True

    def sample(
        self,
        posterior: MotionPosterior,
        *,
        draws: int = 1000,
        chains: int = 1,
        seed: int = 0,
        initial: MotionDraws | np.ndarray | None = None,
        progress: bool = True,
    ) -> MotionDraws:
        """Return ``chains`` × ``draws`` independent draws from the fitted distribution.

        Where the motion is one window of the network's, they have θ and a log density.

        Raises
        ------
        UnsupportedPosterior
            If the prior cannot be sampled, or no network can read the evidence.
        ValueError
            If the fit or the training diverges, or a window shows nothing.
        """
        require(self, posterior)
        refuse_initial(self, initial)
        counts = {"gradient": 0}
        thetas: list[np.ndarray] = []

        @cache
        def answer() -> Callable[[NormalStreams], np.ndarray]:
            return self._answer(posterior, seed, counts, thetas, progress)

        def draw_batch(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            # The first batch trains and fits, so that their seconds are the run's.
            tick()
            with one_thread():
                return answer()(streams)

        def finished(found: MotionDraws) -> MotionDraws:
            return with_coordinates(found, posterior, thetas) if thetas else found

        try:
            found = draw_independently(
                self,
                posterior,
                draw_batch,
                draws=draws,
                chains=chains,
                seed=seed,
                batch=self.batch,
                steps=1,
                scale=1.0,
                counts=counts,
                progress=progress,
            )
        except Interrupted as stop:
            raise Interrupted(finished(stop.draws)) from stop
        return finished(found)

    def predict(
        self,
        posterior: MotionPosterior,
        *,
        seed: int = 0,
        average: bool = True,
        progress: bool = True,
    ) -> Motion:
        """Return the motion predicted (D, equation 11): between joints observed and decoded.

        ``seed`` is of the draws that it is the mean of; without ``average`` the means are decoded
        instead, once (the ablation "NN output"). All of torch's threads work on it, and their
        number may show in the last digits; draws are made on one.

        Raises
        ------
        UnsupportedPosterior
            If no network was trained beside the prior, or it cannot read the evidence.
        """
        network = self._network_of(posterior)
        if network is None or posterior.likelihood is None:
            raise UnsupportedPosterior(
                self.name,
                "predicts one motion only where a network was trained beside the prior and reads "
                "the evidence; draw from the posterior and take the mean",
                word="network",
            )
        inference = self._fitted(network, posterior, seed, {"gradient": 0}, progress)
        found = inference.predict(seeds.generator(seed, "predict"), average=average)
        return Motion(found, posterior.skeleton, posterior.fps, name="predicted")

    def _answer(
        self,
        posterior: MotionPosterior,
        seed: int,
        counts: dict[str, int],
        thetas: list[np.ndarray],
        progress: bool,
    ) -> Callable[[NormalStreams], np.ndarray]:
        """Return what draws motions (B, L, J, 3), metres, and notes their θ where they have one."""
        prior = posterior.prior
        if posterior.likelihood is None and isinstance(prior, HasInferenceNetwork):
            assert isinstance(prior, Samplable)
            # Streams give each draw its own numbers, in the shapes a generator would.
            return lambda streams: prior.sample(streams, len(streams.generators))  # type: ignore[arg-type]
        network = self._network_of(posterior)
        if network is None:
            settings = AmortisedSettings(steps=self.training_steps, pairs=self.training_pairs)
            counts["gradient"] += self.training_steps
            return AmortisedPosterior.fit(posterior, settings, seed, progress).draw
        inference = self._fitted(network, posterior, seed, counts, progress)

        def drawn(streams: NormalStreams) -> np.ndarray:
            positions, theta = inference.draw(streams, len(streams.generators))
            if theta is not None and isinstance(prior, HasLogDensity):
                thetas.append(theta)
            return positions

        return drawn

    def _network_of(self, posterior: MotionPosterior) -> InferenceNetwork | None:
        """Return the network that reads the evidence, or None where one has to be trained."""
        prior, likelihood = posterior.prior, posterior.likelihood
        if likelihood is None:
            return None
        if self.network is not None and not self.network.reads(likelihood):
            raise UnsupportedPosterior(
                self.name,
                f"was given a network that does not read {type(likelihood).__name__}",
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
        """Return the inference of the evidence, fitted to it where that is the mode."""
        inference = network.on(
            posterior.prior,
            posterior.likelihood,
            degrees_of_freedom=self.degrees_of_freedom,
            overlap=self.overlap,
        )
        if self.mode == "regression":
            return inference
        losses = self._fit(inference, seed, counts, progress)
        # A nat for every number of the motion is more than chance.
        chance = 3 * posterior.frames * posterior.skeleton.n_joints
        if not all(map(math.isfinite, losses)) or losses[-1] > losses[0] + chance:
            raise ValueError(
                f"learning_rate is {self.learning_rate:g}, with which the fit diverged: its loss "
                f"went from {losses[0]:g} to {losses[-1]:g}; expected a smaller one"
            )
        return inference

    def _fit(
        self, inference: MotionInference, seed: int, counts: dict[str, int], progress: bool
    ) -> list[float]:
        """Fit, and return every iteration's loss and at last that with the first one's numbers."""
        import torch

        parameters = inference.parameters()
        adam = torch.optim.Adam(parameters, lr=self.learning_rate)
        rates = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.iterations)
        losses: list[float] = []
        with progress_bar(self.iterations, f"{self.name} fit", progress) as bar:
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
                rates.step()
                counts["gradient"] += 1
                bar.update(1)
        return losses
