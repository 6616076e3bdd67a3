"""Split Gibbs sampler: prior and observations meet in an auxiliary motion.

The joint density p(x) N(z; x, ρ²) N(y; A z, σ_y² − ρ²) has the marginal p(x) N(y; A x, σ_y²), the
posterior, for any ρ < σ_y (Vono et al. 2019; the subtraction of ρ² makes it exact at finite ρ).
Gibbs sweeps alternate between z | x, a Gaussian per frame and joint, and x | z, the reverse
diffusion from noise level ρ, started at z (Wu et al. 2024, Xu and Chi 2024). Perspective cameras
and Student-t noise have Metropolis-Hastings steps of z, and precision factors of their entries
(:mod:`~probmotion.samplers.conditional.z_steps`).

Sweeps do not change the mode of a start. Guided diffusion chooses modes with wrong probabilities,
even with the exact 3D denoiser. Each draw therefore starts from one of several guided particles,
resampled by the weights of twisted diffusion (Wu et al. 2023) down to the levels that choose modes.

Sweeps move by about ρ, and need thousands to cross the unobserved depth. The marginal of z,
p_ρ(z) N(y; A z, σ_y² − ρ²), has the score (D(z, ρ) − z)/ρ² + Aᵀ (y − A z)/(σ_y² − ρ²) at the cost
of one estimate D, so underdamped Langevin dynamics of z under falling ρ come before the sweeps. For
observations that are not linear and Gaussian, these are linearised at each ρ, which is approximate;
the sweeps are not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import DenoiserCovariance2D, DenoiserCovariance3D
from probmotion.posteriors.sampling import UnsupportedPosterior, suited
from probmotion.samplers.conditional.base import (
    ConditionalSampler,
    DenoiserChoice,
    VarianceExploding,
)
from probmotion.samplers.conditional.coupling import Coupling, Quadratic, times
from probmotion.samplers.conditional.keypoints import Observations
from probmotion.samplers.conditional.twisted import TwistedDiffusion
from probmotion.samplers.conditional.z_steps import GaussianStep, MetropolisStep, ZStep
from probmotion.samplers.diffusion.ancestral import reverse_diffusion
from probmotion.samplers.diffusion.guidance import (
    LinearObservations,
    can_guide,
)
from probmotion.samplers.diffusion.integrators import SecondOrderSDE
from probmotion.samplers.diffusion.noise_levels import Karras
from probmotion.samplers.diffusion.states import MotionState
from probmotion.samplers.independent import Batches
from probmotion.seeds import NormalStreams
from probmotion.validation import check_count, check_positive

__all__ = ["SplitGibbs"]

_PRIOR = 80.0  # noise level at which a noisy motion says nothing of the clean one
_RINGS = 3  # of views of learnt denoisers
_START = Karras(smallest=0.2)  # levels of the start; modes are chosen above the last
_STEPS_PER_LEVEL = 4  # Langevin steps at one ρ
_ANNEALED_FROM = 0.2  # first ρ of the Langevin dynamics, normalised; above, they leave the mode
_ANNEALED_TO = 0.7  # last ρ, in σ_y
_STEP, _FRICTION = 0.7, 0.2  # of the Langevin dynamics, in units of the coupling's deviations
_END = 0.1  # last noise level of the reverse diffusion, in ρ
_LEAST_NOISE = 1e-6  # normalised; rounding of ᾱ changes the last noise level by a percent
_POWER = 5  # of its spacing (Karras et al. 2022, equation 5)


@dataclass(frozen=True)
class SplitGibbs(ConditionalSampler):
    """Split Gibbs sampler with a diffusion prior, started by weighted guided sampling.

    Observations are keypoints, joints, or others that are linear with Gaussian noise.

    Parameters
    ----------
    steps : int
        Number of Langevin steps under falling ρ.
    sweeps : int
        Number of Gibbs sweeps at the last ρ.
    inner_steps : int
        Number of estimates of each reverse diffusion.
    share : float
        Last ρ in units of the smallest σ_y, below 1. With several cameras, σ_y is that of a joint
        given all of them; with Student-t noise, that of the largest precision factor; with
        perspective cameras, that at half of the mean depth.
    start_steps : int
        Number of noise levels of the start.
    particles : int
        Number of particles of the start, of which one continues.
    denoiser : {"any", "3d", "2d"}
        Kind of denoiser; "any" is the 3D denoiser if the prior has one.
    n_views : int
        Number of views of learnt denoisers, evenly spaced in azimuth.
    elevation : float, optional
        Elevation of these views, radians; by default that of the prior's training. Exact denoisers
        hold for any view, and by default alternate between five sets of three orthogonal views.
    batch : int
        Maximum batch size; does not affect the draws.
    """

    name: ClassVar[str] = "split-gibbs"
    requires: ClassVar[tuple[Any, ...]] = (
        *ConditionalSampler.requires,
        DenoiserCovariance3D | DenoiserCovariance2D,
    )
    effort: ClassVar[tuple[str, ...]] = ("steps", "particles")

    steps: int = 400
    sweeps: int = 5
    inner_steps: int = 8
    share: float = 0.95
    start_steps: int = 24
    particles: int = 8
    denoiser: DenoiserChoice = "any"
    n_views: int = 5
    elevation: float | None = None
    batch: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, least in (("steps", 0), ("sweeps", 1), ("inner_steps", 3), ("start_steps", 2)):
            check_count(name, getattr(self, name), least=least)
        check_count("particles", self.particles, least=2)
        check_count("n_views", self.n_views, least=3)
        check_count("batch", self.batch)
        check_positive("share", self.share)
        if self.share >= 1:
            raise ValueError(
                f"share must be below 1, as ρ must end below the noise of the observations, got "
                f"{self.share}; use .95"
            )

    @staticmethod
    def draws_from(posterior: MotionPosterior) -> bool:
        """Return whether the posterior has keypoints, joints or linear Gaussian observations."""
        likelihood = posterior.likelihood
        if isinstance(likelihood, Keypoints2D | Joints3D):
            return True
        return likelihood is not None and can_guide(posterior)

    def _batches(self, posterior: MotionPosterior, seed: int, progress: bool) -> Batches:
        if not self.draws_from(posterior) and posterior.likelihood is not None:
            raise UnsupportedPosterior(
                self.name,
                "supports keypoints, joints and linear Gaussian likelihoods, got "
                f"{type(posterior.likelihood).__name__}",
                word="observations",
                others=suited(posterior),
            )
        pools = self._pools(posterior, self.n_views, self.elevation, rings=_RINGS)
        step, observations = self._step(posterior, pools[0])
        start = TwistedDiffusion(steps=self.start_steps, particles=self.particles, levels=_START)
        scale: float = posterior.prior.scale  # type: ignore[attr-defined]
        if step.noise < _LEAST_NOISE:
            raise ValueError(
                "noise of a joint given all observations must be at least "
                f"{_LEAST_NOISE * scale:.2g} m, because denoisers do not resolve less, got "
                f"{step.noise * scale:.2g} m; use a likelihood with more noise"
            )
        shape = (posterior.frames, posterior.skeleton.n_joints, 3)
        one_pool = len(pools) == 1  # estimates of different pools do not extrapolate

        def draw(streams: NormalStreams, tick: Callable[[], Any]) -> np.ndarray:
            particles = start.filtered(
                pools, observations, shape, streams, tick, second_order=one_pool
            )
            x = self._anneal(pools, step, particles.chosen(streams), streams, tick)
            return self._sweep(pools, step, x, streams, tick)

        ticks = self.start_steps - 1 + self.steps + self.sweeps
        counts = pools[0].denoiser.counts
        return Batches(draw, self.batch, ticks, scale, counts)

    def _step(
        self, posterior: MotionPosterior, clean: VarianceExploding
    ) -> tuple[ZStep, LinearObservations | Observations]:
        """Return the step of z, and the observations that guide the start."""
        if can_guide(posterior):
            linear = self._observations(posterior)
            return GaussianStep(Quadratic.of(linear)), linear
        likelihood, prior = posterior.likelihood, posterior.prior
        assert isinstance(likelihood, Keypoints2D | Joints3D)
        self._check_observed(likelihood.entries.precision)
        scale: float = prior.scale  # type: ignore[attr-defined]
        # At high noise, the estimate is the mean of the prior.
        blank = np.zeros((1, posterior.frames, posterior.skeleton.n_joints, 3))
        centre = clean(blank, _PRIOR).mean(axis=(0, 1, 2))
        observations = Observations(likelihood, scale, centre)
        return MetropolisStep(observations, centre), observations

    def _anneal(
        self,
        pools: list[VarianceExploding],
        step: ZStep,
        x: np.ndarray,
        streams: NormalStreams,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        """Return x after Langevin dynamics of z (BAOAB, Leimkuhler and Matthews 2013)."""
        if self.steps == 0:
            return x
        shape = x.shape[1:]
        last = _ANNEALED_TO * step.noise
        levels = -(-self.steps // _STEPS_PER_LEVEL)
        # Even in 1/ρ: the Langevin dynamics need most of their steps at small ρ.
        rhos = 1 / np.linspace(1 / max(_ANNEALED_FROM, last), 1 / last, levels)
        z = step.coupling(x, rhos[0], streams).draw(x, streams.normal(*shape))
        velocity = streams.normal(*shape)
        kept = math.exp(-_FRICTION * _STEP)
        for level, rho in enumerate(rhos):
            clean = pools[level % len(pools)]
            coupling = step.coupling(z, rho, streams)

            def kick(
                z: np.ndarray,
                clean: VarianceExploding = clean,
                coupling: Coupling = coupling,
                rho: float = rho,
            ) -> np.ndarray:
                return 0.5 * _STEP * times(coupling.root, coupling.score(z, clean(z, rho)))

            force = kick(z)
            for _ in range(min(_STEPS_PER_LEVEL, self.steps - level * _STEPS_PER_LEVEL)):
                velocity = velocity + force
                z = z + 0.5 * _STEP * times(coupling.root, velocity)
                velocity = kept * velocity + math.sqrt(1 - kept**2) * streams.normal(*shape)
                z = z + 0.5 * _STEP * times(coupling.root, velocity)
                force = kick(z)
                velocity = velocity + force
                tick()
        return self._reverse(pools[-1], z, rhos[-1], streams)

    def _sweep(
        self,
        pools: list[VarianceExploding],
        step: ZStep,
        x: np.ndarray,
        streams: NormalStreams,
        tick: Callable[[], Any],
    ) -> np.ndarray:
        """Return x after Gibbs sweeps at the last ρ."""
        rho = self.share * step.noise
        auxiliary = None
        for sweep in range(self.sweeps):
            auxiliary = step.draw(x, rho, streams, auxiliary)
            x = self._reverse(pools[sweep % len(pools)], auxiliary.z, rho, streams)
            tick()
        return x

    def _reverse(
        self, clean: VarianceExploding, z: np.ndarray, rho: float, streams: NormalStreams
    ) -> np.ndarray:
        """Return a draw of x | z by second-order reverse diffusion from σ = ρ."""
        schedule = Karras(_END * rho, rho, _POWER).schedule(self.inner_steps)
        state = MotionState([clean.denoiser], schedule, z.shape[1:])
        x = math.sqrt(schedule.alpha_bar[-1]) * z
        return reverse_diffusion(state, streams, x, lambda: None, SecondOrderSDE())
