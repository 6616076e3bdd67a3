"""`OutlierGibbs`: what draws reference motions given noisy 3D joints with outliers.

Student-t noise is Gaussian noise whose precision is itself random (Andrews and Mallows 1974): each
coordinate's is multiplied by λ ~ Gamma(ν/2, rate ν/2). Given all λ the posterior is exact, style
and azimuth are drawn anew every time, and given the motion the λ are independent,

    λ | X, y ~ Gamma((ν + 1)/2, rate (ν + (y − X)²/σ²)/2),

so that drawing the two in turn (Gibbs sampling) leaves the posterior as it is, is never rejected
and has nothing to adapt. NUTS on all positions sees no gap between azimuths and stays in the one
that it started in.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from probmotion import seeds
from probmotion.arrays import Array
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.likelihoods import Joints3D, LinearObservation
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.protocols import HasExactPosterior
from probmotion.posteriors.sampling import progress_bar
from probmotion.validation import check_count

__all__ = ["OutlierGibbs"]


@dataclass(frozen=True)
class OutlierGibbs:
    """Gibbs sampling of motions and precisions.

    Parameters
    ----------
    warmup : int
        Iterations before the first draw; they start at precisions drawn from their prior.
    thin : int
        Iterations per draw.
    """

    name: ClassVar[str] = "outlier-gibbs"
    requires: ClassVar[tuple[type, ...]] = (HasExactPosterior,)

    warmup: int = 50
    thin: int = 2

    def __post_init__(self) -> None:
        check_count("warmup", self.warmup)
        check_count("thin", self.thin)

    def draws_from(self, posterior: MotionPosterior) -> bool:
        """Whether the evidence is 3D joints with Student-t noise, and the prior exact."""
        likelihood = posterior.likelihood
        return (
            isinstance(posterior.prior, HasExactPosterior)
            and isinstance(likelihood, Joints3D)
            and likelihood.degrees_of_freedom is not None
        )

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
        """Return ``draws`` states of each of ``chains`` chains; see the sampler's protocol.

        Raises
        ------
        ValueError
            If the posterior is not :meth:`draws_from`'s, or ``initial`` is given.
        """
        if not self.draws_from(posterior):
            raise ValueError(
                f"posterior has {type(posterior.likelihood).__name__} evidence, expected Joints3D "
                "with Student-t noise and a prior with an exact posterior"
            )
        if initial is not None:
            raise ValueError(
                f"initial is {type(initial).__name__}, expected None: chains start at precisions "
                "drawn from their prior"
            )
        check_count("draws", draws)
        check_count("chains", chains)
        start = time.perf_counter()
        with progress_bar(chains * draws, self.name, progress) as bar:
            positions = np.stack(
                [
                    self._chain(posterior, draws, seeds.generator(seed, "chain", chain), bar)
                    for chain in range(chains)
                ]
            )
        return MotionDraws.of(
            posterior, self, positions, seed=seed, seconds=time.perf_counter() - start
        )

    def _chain(
        self, posterior: MotionPosterior, draws: int, rng: np.random.Generator, bar: Any
    ) -> np.ndarray:
        prior, evidence = posterior.prior, posterior.likelihood
        assert isinstance(prior, HasExactPosterior)
        assert isinstance(evidence, Joints3D)
        nu = evidence.degrees_of_freedom
        assert nu is not None
        precision = evidence.entries.precision[..., None]
        factors = rng.gamma(0.5 * nu, 2 / nu, evidence.joints.shape)
        found = np.empty((draws, *evidence.joints.shape))
        for step in range(self.warmup + draws * self.thin):
            given = _Weighted(evidence, precision * factors)
            motion = prior.exact_posterior(given).sample(rng, 1)[0]
            rate = 0.5 * (nu + precision * (evidence.joints - motion) ** 2)
            factors = rng.gamma(0.5 * (nu + 1), 1 / rate)
            draw, left = divmod(step - self.warmup + 1, self.thin)
            if left == 0 and draw > 0:
                found[draw - 1] = motion
                bar.update(1)
        return found


class _Weighted:
    """Joints seen with Gaussian noise of a precision of its own for each coordinate.

    Parameters
    ----------
    evidence : Joints3D
        Where they are.
    precision : ndarray, (L, J, 3)
        1 / variance.
    """

    def __init__(self, evidence: Joints3D, precision: np.ndarray) -> None:
        self.evidence = evidence
        self.precision = precision

    def linear(self) -> LinearObservation:
        """Return the evidence as three views of one number each: x, y and z."""
        return LinearObservation(
            axes=np.eye(3)[:, None],
            target=np.moveaxis(self.evidence.joints, -1, 0)[..., None],
            precision=np.moveaxis(self.precision, -1, 0),
        )

    def log_density(self, positions: Array) -> Array:
        """Return log p(y | X, λ): ``(…, L, J, 3) → (…)``."""
        residual = self.evidence.joints - positions
        seen = self.precision[self.precision > 0]
        norm = 0.5 * float(np.log(seen / (2 * np.pi)).sum())
        return norm - 0.5 * (self.precision * residual**2).sum(axis=(-3, -2, -1))

    def simulate(self, rng: np.random.Generator, positions: np.ndarray) -> _Weighted:
        """Return the likelihood of evidence drawn from p(y | X, λ); entries unseen stay."""
        seen = self.precision > 0
        noise = rng.standard_normal(seen.shape) / np.sqrt(np.where(seen, self.precision, 1.0))
        joints = np.where(seen, positions + noise, self.evidence.joints)
        return _Weighted(replace(self.evidence, joints=joints), self.precision)
