"""Correction of denoised joints by networks."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import dct, idct
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from probmotion.models.dvae.noisy_windows import Stitching
from probmotion.models.mixture.denoising import DenoisedJoints
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.problems.denoising import body_of, body_prior
from probmotion.samplers.variational.dvae import DVAEInference
from probmotion.threads import one_thread
from probmotion.validation import check_count, check_positive

if TYPE_CHECKING:
    from probmotion.models.dvae.joint_corrector import JointCorrector
    from probmotion.models.dvae.motion_dvae import MotionDVAE

__all__ = ["correct_joints", "shipped_corrector"]

_LEAST = 1e-4  # standard deviation of a joint, metres
_NOISE = 0.02  # metres, of a joint of confidence 1; only its product with confidences matters
_NOTHING = 1e-14  # variance of a coefficient, square metres


def shipped_corrector() -> JointCorrector:
    """Load the shipped corrector of posteriors under ``cmu-motion``."""
    from probmotion.models.dvae.joint_corrector import JointCorrector

    return JointCorrector.load("joint-corrector")


def correct_joints(
    found: DenoisedJoints,
    *,
    fps: float,
    iterations: int = 50,
    corrector: JointCorrector | None = None,
    prior: MotionDVAE | None = None,
    seed: int = 0,
    progress: bool = True,
) -> DenoisedJoints:
    """Return denoised joints whose mean is corrected by networks.

    The first network was trained on posteriors under spectral priors that had not seen the clip, to
    predict what remained of the error. Then a Motion-DVAE is optimised for the recording, with the
    corrected means as observations and the standard deviations as noise; its bones have constant
    lengths. As the Motion-DVAE adds little where joints are observed, its correction is reduced by
    the ratio of standard deviation and noise, where that is below 1.

    Draws are moved with the mean. Their rapid deviations from it, above 1 Hz, are scaled to the
    size that the first network predicts; slow ones and standard deviations remain those under the
    spectral prior. Where a network fails, which shows in corrections beyond the standard
    deviations, its correction is not taken, with a warning.

    Parameters
    ----------
    found : DenoisedJoints
        Result of :func:`~probmotion.models.mixture.denoising.denoise_joints`, with the joints of
        the corrector and the floor at y = 0.
    fps : float
        Frames per second of the recording. At another rate than the networks', corrections are
        interpolated.
    iterations : int
        Number of optimisation steps of the Motion-DVAE, about .1 to .2 s per frame for 50; 0
        leaves it out.
    corrector : JointCorrector, optional
        First network, by default ``joint-corrector``.
    prior : MotionDVAE, optional
        Prior with an inference network, by default ``body-dvae``.
    seed : int
        Seed of the optimisation.
    progress : bool
        Show a progress bar of the optimisation.

    Raises
    ------
    ValueError
        If the number of joints is not the networks', the recording has a single frame, a number is
        out of range, or the optimisation diverges.
    """
    check_positive("fps", fps)
    check_count("iterations", iterations, least=0)
    corrector = shipped_corrector() if corrector is None else corrector
    L, J, _ = found.mean.shape
    if corrector.skeleton.n_joints != J:
        raise ValueError(
            f"found must have the {corrector.skeleton.n_joints} joints of the corrector, got {J}"
        )
    if L < 2:
        raise ValueError(f"the recording must have at least 2 frames, got {L}")
    sd = np.maximum(np.sqrt((found.sd**2).mean(axis=-1)), _LEAST)
    correction, deviations = _amortised(found, sd, fps, corrector)
    mean = found.mean + _plausible(correction, sd, fps)
    if iterations:
        prior = body_prior() if prior is None else prior
        correction = _optimised(mean, sd, fps, prior, iterations, seed, progress) - mean
        share = np.minimum(1.0, sd / found.noise)[..., None]
        mean = mean + share * _plausible(correction, sd, fps)
    return replace(found, mean=mean, draws=mean + deviations)


def _amortised(
    found: DenoisedJoints, sd: np.ndarray, fps: float, corrector: JointCorrector
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corrector's correction (L, J, 3) and the draws' deviations from the mean."""
    frames, rate = corrector.settings.frames, fps / corrector.fps
    window = max(round(frames * rate), 2)
    stitching = Stitching(len(sd), window, window // 2)
    own, known = np.arange(stitching.length), np.arange(frames) * rate
    means = np.stack([_interpolated(known, own, part) for part in stitching.cut(found.mean)])
    sds = np.stack([_interpolated(known, own, part) for part in stitching.cut(sd)])
    with one_thread():
        corrections, energies = corrector.correct(means, sds)
    corrections = np.stack([_interpolated(own, known, part) for part in corrections])
    deviations = found.draws - found.mean
    if len(deviations):
        cut = np.stack([stitching.cut(deviation) for deviation in deviations], axis=1)
        # Frequencies in units of the network's windows, half a cycle per window.
        frequency = np.arange(stitching.length) * frames * rate / stitching.length
        band = np.searchsorted(corrector.band_edges, frequency, side="right") - 1
        # A coefficient's variance is proportional to the frame rate.
        pairs = zip(cut, rate * energies, strict=True)
        scaled = [_scaled(part, band, energy) for part, energy in pairs]
        deviations = stitching.mean(np.stack(scaled, axis=1))
    return stitching.mean(corrections), deviations


def _optimised(
    mean: np.ndarray,
    sd: np.ndarray,
    fps: float,
    prior: MotionDVAE,
    iterations: int,
    seed: int,
    progress: bool,
) -> np.ndarray:
    """Return the mean of a Motion-DVAE that is optimised for joints with noise ``sd``, (L, J, 3).

    Its posterior is that under the product of both priors, if joints were independent given the
    recording.
    """
    frames = np.arange(len(mean))
    times = np.arange(0.0, frames[-1] + 1e-9, fps / prior.fps)
    if len(times) < 2:
        raise ValueError(
            f"the recording must last at least {2 / prior.fps:.2g} s, got {len(mean) / fps:.2g} s"
        )
    confidence = (_NOISE / np.sqrt(_interpolated(times, frames, sd**2))) ** 2
    evidence = Joints3D(_interpolated(times, frames, mean), _NOISE, confidence)
    adapted = prior.of(frames=len(times), body=body_of(evidence, prior))
    sampler = DVAEInference(mode="optimization", iterations=iterations)
    with one_thread():
        found = sampler.predict(
            MotionPosterior(adapted, evidence), seed=seed, average=False, progress=progress
        )
    # Interpolate the correction rather than the motion, whose rapid parts would be lost.
    return mean + _interpolated(frames, times, found.positions - evidence.joints)


def _scaled(deviations: np.ndarray, band: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """Return deviations (n, L, J, 3) whose DCT coefficients have the given variance in each band.

    ``band`` (L,) is the band of each frequency, negative for those that are not scaled; ``energy``
    (bands, J) is the variance.
    """
    spectrum = dct(deviations, axis=1, norm="ortho")
    for number, variance in enumerate(energy):
        rows = band == number
        if rows.any():
            power = (spectrum[:, rows] ** 2).mean(axis=(0, 1, 3))
            spectrum[:, rows] *= np.sqrt(variance / np.maximum(power, _NOTHING))[:, None]
    scaled: np.ndarray = idct(spectrum, axis=1, norm="ortho")
    return scaled


def _plausible(correction: np.ndarray, sd: np.ndarray, fps: float) -> np.ndarray:
    """Return the correction (L, J, 3) where it is plausible, with a warning if it is not."""
    weight = _weight(correction / sd[..., None], round(fps))
    if (lost := float((1 - weight).sum()) / fps) > 0:
        warnings.warn(
            f"the network does not explain {lost:.1f} of {len(sd) / fps:.1f} s, where the mean is "
            "not corrected (is the floor at y = 0?)",
            stacklevel=3,
        )
    return weight[:, None, None] * correction


def _weight(correction: np.ndarray, second: int) -> np.ndarray:
    """Return the weight of relative corrections (L, J, 3) at every time, (L,).

    Given more knowledge, the mean of a distribution moves by at most its standard deviation in the
    root mean square (law of total variance). The weight is 0 where corrections are larger within
    about a second, since the network fails there, and rises to 1 within a second.
    """
    width = max(second, 1) | 1  # odd: centred
    square = uniform_filter1d((correction**2).mean(axis=(1, 2)), width, mode="nearest")
    # Both filters have one width, so that the weight is 0 wherever a correction is too large.
    kept = minimum_filter1d((square <= 1).astype(float), width, mode="nearest")
    weight: np.ndarray = uniform_filter1d(kept, width, mode="nearest")
    return np.clip(weight, 0.0, 1.0)


def _interpolated(times: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (n, …) at other times, linear between the known ones."""
    flat = values.reshape(len(known), -1).T
    columns = [np.interp(times, known, column) for column in flat]
    return np.stack(columns, axis=-1).reshape(len(times), *values.shape[1:])
