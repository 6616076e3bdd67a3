"""Correction of denoised joints by a Motion-DVAE."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from probmotion.models.mixture.denoising import DenoisedJoints
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.problems.denoising import body_of, body_prior
from probmotion.samplers.variational.dvae import DVAEInference
from probmotion.threads import one_thread
from probmotion.validation import check_positive

if TYPE_CHECKING:
    from probmotion.models.dvae.motion_dvae import MotionDVAE

__all__ = ["correct_joints"]

_LEAST = 1e-4  # standard deviation of an observation, metres
_NOISE = 0.02  # metres, of a joint of confidence 1; only its product with confidences matters


def correct_joints(
    found: DenoisedJoints,
    *,
    fps: float,
    prior: MotionDVAE | None = None,
    iterations: int = 50,
    seed: int = 0,
    progress: bool = True,
) -> DenoisedJoints:
    """Return denoised joints whose mean is corrected by a Motion-DVAE.

    The network's observations are the means of the posterior under the spectral prior, with its
    standard deviations as noise: their posterior under the network's prior is that under the
    product of both priors, if joints were independent given the recording. The network's mean has
    constant bone lengths. Deviations from the mean remain those under the spectral prior, since the
    network's are overconfident. Where the network fails, which shows in corrections beyond the
    standard deviations, the mean remains too, with a warning.

    Parameters
    ----------
    found : DenoisedJoints
        Result of :func:`~probmotion.models.mixture.denoising.denoise_joints`, with the joints of
        the prior and the floor at y = 0.
    fps : float
        Frames per second of the recording. At another rate than the prior's, the correction is
        interpolated.
    prior : MotionDVAE, optional
        Prior with an inference network, ``body-dvae`` by default.
    iterations : int
        Number of optimisation steps for this recording; 0 for the network unchanged.
    seed : int
        Seed of the optimisation.
    progress : bool
        Show a progress bar.

    Raises
    ------
    ValueError
        If the number of joints is not the prior's, the recording has a single frame, a number is
        out of range, or the optimisation diverges.
    """
    check_positive("fps", fps)
    prior = body_prior() if prior is None else prior
    if found.mean.shape[1] != prior.skeleton.n_joints:
        raise ValueError(
            f"found must have the {prior.skeleton.n_joints} joints of the prior, got "
            f"{found.mean.shape[1]}"
        )
    frames = np.arange(len(found.mean))
    times = np.arange(0.0, frames[-1] + 1e-9, fps / prior.fps)
    if len(times) < 2:
        raise ValueError(
            f"the recording must last at least {2 / prior.fps:.2g} s, got {len(frames) / fps:.2g} s"
        )
    mean = _interpolated(times, frames, found.mean)
    noise = np.sqrt(_interpolated(times, frames, found.sd**2).mean(axis=-1))
    noise = np.maximum(noise, _LEAST)
    evidence = Joints3D(mean, _NOISE, (_NOISE / noise) ** 2)
    adapted = prior.of(frames=len(times), body=body_of(evidence, prior))
    if iterations:
        sampler = DVAEInference(mode="optimization", iterations=iterations)
    else:
        sampler = DVAEInference()
    with one_thread():
        corrected = sampler.predict(
            MotionPosterior(adapted, evidence), seed=seed, average=False, progress=progress
        )
    correction = corrected.positions - mean
    weight = _plausible(correction / noise[..., None], round(prior.fps))
    if (lost := float((1 - weight).sum()) / prior.fps) > 0:
        warnings.warn(
            f"the network does not explain {lost:.1f} of {len(weight) / prior.fps:.1f} s, where "
            "the mean is not corrected (is the floor at y = 0?)",
            stacklevel=2,
        )
    correction = _interpolated(frames, times, weight[:, None, None] * correction)
    return replace(found, mean=found.mean + correction, draws=found.draws + correction)


def _plausible(correction: np.ndarray, second: int) -> np.ndarray:
    """Return the weight of relative corrections (L, J, 3) at every time, (L,).

    Given more knowledge, the mean of a distribution moves by at most its standard deviation in the
    root mean square (law of total variance). The weight is 0 where corrections are larger within
    about a second, since the network fails there, and rises to 1 within a second.
    """
    width = second | 1  # odd: centred
    size = np.sqrt(uniform_filter1d((correction**2).mean(axis=(1, 2)), width, mode="nearest"))
    # Both filters have one width, so that the weight is 0 wherever a correction is too large.
    kept = minimum_filter1d((size <= 1).astype(float), width, mode="nearest")
    weight: np.ndarray = uniform_filter1d(kept, width, mode="nearest")
    return np.clip(weight, 0.0, 1.0)


def _interpolated(times: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (n, …) at other times, linear between the known ones."""
    flat = values.reshape(len(known), -1).T
    columns = [np.interp(times, known, column) for column in flat]
    return np.stack(columns, axis=-1).reshape(len(times), *values.shape[1:])
