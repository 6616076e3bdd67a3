"""Denoising of recordings of any length with a spectral prior, window by window."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from probmotion import seeds
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.models.mixture.spectral_posterior import SpectralPosterior, condition, draw
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.sampling import progress_bar
from probmotion.validation import check_count, check_positive, check_shape

__all__ = ["DenoisedJoints", "denoise_joints"]

_SHIPPED = {"person14": "cmu-motion", "coco17": "cmu-motion-coco17"}
_SECONDS = 2.0  # length of a window
_OVERLAP = 2  # frames of a window's draw on which the next window is conditioned
_JOIN_NOISE = 1e-3  # standard deviation of these frames, metres
_NOISES = np.geomspace(0.0025, 0.16, 7)  # candidates for unknown noise, metres
_SWEEPS = 5  # of expectation maximisation for Student-t noise
_NEGLIGIBLE = 1e-6  # probability of components that a draw's continuation leaves out
_KEPT = 0.999  # total probability of the components of a window
_SCREENED = 25.0  # nats below the most likely component, at which others are left out
_OUTLIER_WEIGHT = 0.5  # below it an observation has a precision of its own


@dataclass(frozen=True, eq=False)
class DenoisedJoints:
    """Posterior of a recording.

    Parameters
    ----------
    mean, sd : ndarray, (L, J, 3)
        Posterior mean and standard deviation of every coordinate, metres.
    draws : ndarray, (n, L, J, 3)
        Posterior draws, metres.
    noise : float
        Standard deviation (Student-t: scale) of the observations, metres.
    """

    mean: np.ndarray
    sd: np.ndarray
    draws: np.ndarray
    noise: float


def denoise_joints(
    joints: np.ndarray,
    confidence: np.ndarray | None = None,
    *,
    skeleton: Skeleton,
    fps: float,
    noise: float | None = None,
    degrees_of_freedom: float | None = None,
    draws: int = 20,
    seed: int = 0,
    progress: bool = True,
    prior: SpectralMixtureMotion | None = None,
) -> DenoisedJoints:
    """Return the posterior of a recording of noisy joints with gaps.

    The recording is cut into windows of two seconds that overlap by half; the posterior of each is
    exact under the most probable components (together 99.9 %). Means and variances are
    averaged between windows with weights that fall linearly to 0 at a window's ends. Each draw
    continues from the draw of the previous window.

    Parameters
    ----------
    joints : ndarray, (L, J, 3)
        Positions, metres, +Y up; NaN where missing.
    confidence : ndarray, (L, J), optional
        Multiplier of the precision, 0 where missing; by default 1 where ``joints`` are finite.
    skeleton : Skeleton
        Skeleton of the joints, that of the prior.
    fps : float
        Frames per second.
    noise : float, optional
        Standard deviation of a coordinate (Student-t: scale), metres; by default the candidate of
        the largest marginal likelihood, between 2.5 mm and 16 cm.
    degrees_of_freedom : float, optional
        Degrees of freedom of Student-t noise, by expectation maximisation of its scale mixture;
        Gaussian by default.
    draws : int
        Number of posterior draws.
    seed : int
        Seed of the draws.
    progress : bool
        Show a progress bar.
    prior : SpectralMixtureMotion, optional
        By default ``cmu-motion`` for ``person14`` and ``cmu-motion-coco17`` for ``coco17``.

    Raises
    ------
    ValueError
        If shapes are inconsistent, nothing is observed, or no prior has this skeleton.
    """
    joints = np.asarray(joints, dtype=np.float64)
    check_shape("joints", joints, ("L", skeleton.n_joints, 3))
    check_positive("fps", fps)
    check_count("draws", draws, least=0)
    finite = np.isfinite(joints).all(axis=-1)
    weight = finite.astype(float) if confidence is None else np.where(finite, confidence, 0.0)
    if not weight.any():
        raise ValueError("joints must contain an observed joint, got none")
    length = min(len(joints), max(round(_SECONDS * fps), 2))
    if prior is None:
        local = _shipped(skeleton, length, fps)
    elif prior.skeleton == skeleton:
        local = prior.resampled(length, fps)
    else:
        raise ValueError(
            f"skeleton must be the prior's, {prior.skeleton.n_joints} joints, got one of "
            f"{skeleton.n_joints}; retarget the recording to it"
        )
    starts = _starts(len(joints), length)
    recording = _Recording(np.where(weight[..., None] > 0, joints, 0.0), weight, local, length)
    if noise is None:
        noise = _estimated_noise(recording, starts)
    check_positive("noise", noise)
    with progress_bar(len(starts), "denoise", progress) as bar:
        return _stitched(recording, starts, noise, degrees_of_freedom, draws, seed, bar)


@dataclass(frozen=True, eq=False)
class _Recording:
    """Observations of a recording, and the prior of its windows."""

    joints: np.ndarray
    weight: np.ndarray
    prior: SpectralMixtureMotion
    length: int

    def origin(self, start: int) -> np.ndarray:
        """Return the mean ground position of a window's observations, (3,)."""
        rows = slice(start, start + self.length)
        seen = self.weight[rows] > 0
        if not seen.any():
            # An empty window starts from the nearest observation.
            frames = np.flatnonzero((self.weight > 0).any(axis=1))
            row = frames[np.abs(frames - start - self.length // 2).argmin()]
            return self.joints[row][self.weight[row] > 0].mean(axis=0) * [1.0, 0.0, 1.0]
        return self.joints[rows][seen].mean(axis=0) * [1.0, 0.0, 1.0]

    def likelihood(self, start: int, noise: float) -> Joints3D:
        """Return the observations of a window about its origin."""
        rows = slice(start, start + self.length)
        return Joints3D(self.joints[rows] - self.origin(start), noise, self.weight[rows])

    def posterior(
        self, start: int, noise: float, degrees_of_freedom: float | None
    ) -> SpectralPosterior:
        """Return the posterior of a window, about its origin."""
        likelihood = self.likelihood(start, noise)
        posterior = self._posterior(likelihood)
        if degrees_of_freedom is not None:
            posterior = self._without_outliers(likelihood, posterior, degrees_of_freedom)
        return posterior

    def _posterior(self, likelihood: Joints3D) -> SpectralPosterior:
        """Return the posterior under the most probable components."""
        chosen = self._probable(likelihood)
        posterior = self._given(likelihood, chosen)
        probability = posterior.component_probabilities.sum(axis=1)
        order = np.argsort(-probability, kind="stable")
        before = np.cumsum(probability[order]) - probability[order]
        # Covariances with gaps are costly: keep the fewest components of this total probability.
        kept = np.sort(chosen[order[before < _KEPT]])
        return posterior if len(kept) == len(chosen) else self._given(likelihood, kept)

    def _given(self, likelihood: Joints3D, chosen: np.ndarray) -> SpectralPosterior:
        """Return the posterior under some of the prior's components."""
        prior = self.prior
        components = prior.components.subset(chosen)
        return SpectralPosterior(components, prior.log_prior, prior.mean(), likelihood)

    def _probable(self, likelihood: Joints3D) -> np.ndarray:
        """Return the components that may matter, given observations with their gaps filled.

        Gaps and outliers are filled with the posterior mean of the first component. Without gaps,
        frequencies are independent, and the evidence of all components takes less time than one
        with gaps.
        """
        confidence = likelihood.entries.confidence
        seen = confidence > _OUTLIER_WEIGHT * confidence.max()
        joints = likelihood.joints
        if not seen.all():
            first = self._given(likelihood, np.array([len(self.prior.scales) // 2]))
            joints = np.where(seen[..., None], joints, first.mean())
        evidence = self.prior.log_evidence(joints, likelihood.noise).max(axis=1)
        return np.flatnonzero(evidence > evidence.max() - _SCREENED)

    def _without_outliers(
        self, likelihood: Joints3D, posterior: SpectralPosterior, freedom: float
    ) -> SpectralPosterior:
        """Return the posterior under expected precisions of Student-t noise, by EM.

        A joint's noise is a scale mixture of Gaussians, with E[w] = (ν + 3) / (ν + r²/σ²). Weights
        of ordinary observations are replaced by their mean, which keeps frequencies independent;
        those of outliers are their own.
        """
        weight = likelihood.entries.confidence
        for _ in range(_SWEEPS):
            spread = np.trace(posterior.covariances(), axis1=-2, axis2=-1)
            square = ((likelihood.joints - posterior.mean()) ** 2).sum(axis=-1) + spread
            expected = (freedom + 3) / (freedom + weight * square / likelihood.noise**2)
            ordinary = (weight > 0) & (expected >= _OUTLIER_WEIGHT)
            if ordinary.any():
                expected[ordinary] = expected[ordinary].mean()
            new = replace(likelihood, confidence=weight * expected)
            posterior = self._posterior(new)
        return posterior


@lru_cache(maxsize=4)
def _shipped(skeleton: Skeleton, frames: int, fps: float) -> SpectralMixtureMotion:
    """Return the shipped prior of a skeleton for windows; cached per process."""
    for preset, name in _SHIPPED.items():
        if skeleton == Skeleton.preset(preset):
            return SpectralMixtureMotion.load(name).resampled(frames, fps)
    raise ValueError(
        f"skeleton must be {' or '.join(_SHIPPED)}, got one of {skeleton.n_joints} joints; "
        "retarget the recording, or give a prior fitted to clips of this skeleton"
    )


def _starts(frames: int, length: int) -> list[int]:
    """Return the first frames of windows that overlap by half or more."""
    count = max(1, -(-2 * (frames - length) // length) + 1)
    return np.linspace(0, frames - length, count).round().astype(int).tolist()


def _estimated_noise(recording: _Recording, starts: list[int]) -> float:
    """Return the candidate of the largest marginal likelihood in at most five windows."""
    chosen = starts[:: max(1, len(starts) // 5)][:5]
    evidence = [
        sum(
            recording.posterior(start, noise, None).log_marginal_likelihood
            for start in chosen
            if (recording.weight[start : start + recording.length] > 0).any()
        )
        for noise in _NOISES
    ]
    return float(_NOISES[int(np.argmax(evidence))])


def _stitched(
    recording: _Recording,
    starts: list[int],
    noise: float,
    degrees_of_freedom: float | None,
    draws: int,
    seed: int,
    bar: object,
) -> DenoisedJoints:
    """Denoise all windows and join them."""
    L, length = len(recording.joints), recording.length
    mean, square = np.zeros(recording.joints.shape), np.zeros(recording.joints.shape)
    total = np.zeros((L, 1, 1))
    chains = np.zeros((draws, *recording.joints.shape))
    ramp = np.minimum(np.arange(length) + 1, length - np.arange(length)).astype(float)
    for number, start in enumerate(starts):
        rows = slice(start, start + length)
        origin = recording.origin(start)
        posterior = recording.posterior(start, noise, degrees_of_freedom)
        weight = ramp[:, None, None]
        centre = posterior.mean() + origin
        variance = np.diagonal(posterior.covariances(), axis1=-2, axis2=-1)
        mean[rows] += weight * centre
        square[rows] += weight * (variance + centre**2)
        total[rows] += weight
        if draws:
            rng = seeds.generator(seed, f"denoise {start}")
            # Keep earlier frames up to the middle of the overlap with the previous window.
            kept = 0 if number == 0 else (starts[number - 1] + length - start) // 2
            chains[:, rows] = _continued(posterior, chains[:, rows] - origin, kept, rng) + origin
        bar.update()  # type: ignore[attr-defined]
    mean /= total
    sd = np.sqrt(np.maximum(square / total - mean**2, 0.0))
    return DenoisedJoints(mean, sd, chains, noise)


def _continued(
    posterior: SpectralPosterior, chains: np.ndarray, kept: int, rng: np.random.Generator
) -> np.ndarray:
    """Return draws of a window (n, L, J, 3) that continue its first ``kept`` frames.

    The window's posterior is conditioned on the last two of these frames, observed to within a
    millimetre. Components that are negligible without them are left out.
    """
    if kept == 0:
        return posterior.sample(rng, len(chains))
    probable = np.flatnonzero(posterior.component_probabilities.max(axis=1) > _NEGLIGIBLE)
    components = posterior.components.subset(probable)
    joined = slice(max(kept - _OVERLAP, 0), kept)
    information = posterior.information.copy()
    information[joined] += np.eye(3) / _JOIN_NOISE**2
    shift = np.repeat(posterior.shift[None], len(chains), axis=0)
    shift[:, joined] += chains[:, joined] / _JOIN_NOISE**2
    log_joint, _ = condition(components, information, shift)
    out = draw(components, information, shift, log_joint, rng)
    out[:, :kept] = chains[:, :kept]
    return out
