"""Gibbs sampler for 3D joints with Student-t noise.

Student-t noise of scale σ is Gaussian noise with random precision factors λ ~ Gamma(ν/2, rate ν/2)
per coordinate (Andrews and Mallows 1974). Given λ, the posterior of motion, style and azimuth has a
closed form; given the motion X and the observed joints y, the factors are independent,

    λ | X, y ~ Gamma((ν + 1)/2, rate (ν + (y − X)²/σ²)/2).

Gibbs sampling alternates between these two draws, without rejections or tuning. NUTS on
positions does not move between azimuths.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.likelihoods import Joints3D, LinearObservation
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasExactPosterior
from probmotion.posteriors.sampling import progress_bar
from probmotion.validation import check_count

__all__ = ["OutlierGibbs"]


@dataclass(frozen=True)
class OutlierGibbs:
    """Gibbs sampler of motions and precision factors.

    Parameters
    ----------
    warmup : int
        Iterations before the first draw; precision factors are initialised from their prior.
    thin : int
        Iterations per draw; states in between are discarded.
    """

    name: ClassVar[str] = "outlier-gibbs"
    requires: ClassVar[tuple[type, ...]] = (HasExactPosterior,)

    warmup: int = 50
    thin: int = 2

    def __post_init__(self) -> None:
        check_count("warmup", self.warmup)
        check_count("thin", self.thin)

    def draws_from(self, posterior: MotionPosterior) -> bool:
        """Return whether the prior is exact and observed 3D joints have Student-t noise."""
        likelihood = posterior.likelihood
        noisy = isinstance(likelihood, Joints3D) and likelihood.degrees_of_freedom is not None
        return noisy and isinstance(posterior.prior, HasExactPosterior)

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
        """Return ``draws`` states from each of ``chains`` chains; see the sampler protocol."""
        if not self.draws_from(posterior):
            raise ValueError(
                "posterior must have an exact prior and Joints3D with Student-t noise, got "
                f"{type(posterior.likelihood).__name__}"
            )
        if initial is not None:
            raise ValueError(f"initial must be None, got {type(initial).__name__}")
        check_count("draws", draws)
        check_count("chains", chains)
        start = time.perf_counter()
        rngs = [seeds.generator(seed, "chain", chain) for chain in range(chains)]
        with progress_bar(chains * draws, self.name, progress) as bar:
            positions = np.stack([self._chain(posterior, draws, rng, bar) for rng in rngs])
        seconds = time.perf_counter() - start
        return MotionDraws.of(posterior, self, positions, seed=seed, seconds=seconds)

    def _chain(
        self, posterior: MotionPosterior, draws: int, rng: np.random.Generator, bar: Any
    ) -> np.ndarray:
        prior, likelihood = posterior.prior, posterior.likelihood
        assert isinstance(prior, HasExactPosterior)
        assert isinstance(likelihood, Joints3D)
        nu = likelihood.degrees_of_freedom
        assert nu is not None
        precision = likelihood.entries.precision[..., None]
        factors = rng.gamma(0.5 * nu, 2 / nu, likelihood.joints.shape)
        states = np.empty((draws, *likelihood.joints.shape))
        for step in range(self.warmup + draws * self.thin):
            given: Any = _Weighted(likelihood.joints, precision * factors)
            motion = prior.exact_posterior(given).sample(rng, 1)[0]
            rate = 0.5 * (nu + precision * (likelihood.joints - motion) ** 2)
            factors = rng.gamma(0.5 * (nu + 1), 1 / rate)
            draw, remainder = divmod(step - self.warmup + 1, self.thin)
            if remainder == 0 and draw > 0:
                states[draw - 1] = motion
                bar.update(1)
        return states


@dataclass(frozen=True, eq=False)
class _Weighted:
    """Linear Gaussian likelihood of joints (L, J, 3) with a precision per coordinate."""

    joints: np.ndarray
    precision: np.ndarray

    def linear(self) -> LinearObservation:
        """Return the joints as three views of one coordinate each."""
        return LinearObservation(
            axes=np.eye(3)[:, None],
            target=np.moveaxis(self.joints, -1, 0)[..., None],
            precision=np.moveaxis(self.precision, -1, 0),
        )
