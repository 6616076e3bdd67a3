"""Accuracy of denoised joints with exact and learnt priors.

For ``accuracy.py exact-priors`` and ``accuracy.py learnt``.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.joint_filters import kalman_smooth
from probmotion.models.mixture.denoising import DenoisedJoints, denoise_joints
from probmotion.motion.motion import Motion
from probmotion.posteriors.likelihoods import Joints3D
from probmotion.problems.denoising import limb_occlusions
from probmotion.problems.joint_correction import correct_joints

NOISE = 0.04  # of the denoised joints, metres
NOISE_DRAWS = 5  # of each window
WINDOW = 60  # frames

Figures = Iterator[tuple[str, float]]


def denoising_figures(folder: Path) -> Figures:
    """Yield mean errors of the spectral prior over those of a Kalman smoother, and coverage.

    Windows of 60 frames of the test clips of the denoising study, noise 4 cm, five draws of the
    noise; occluded: a limb is hidden for a third of the time.
    """
    errors: dict[str, list[list[float]]] = {"noise": [], "occluded": [], "hidden": []}
    names: list[str] = []
    inside = []
    windows = enumerate(denoising_windows(folder))
    for (number, window), repeat in itertools.product(windows, range(NOISE_DRAWS)):
        occlusion = limb_occlusions(window)
        names.append(window.name)
        for name, hidden in (("noise", np.zeros_like(occlusion)), ("occluded", occlusion)):
            found, smooth = denoised(window, number + 100 * repeat, hidden, draws=0)
            pair = [
                np.linalg.norm(mean - window.positions, axis=-1) for mean in (found.mean, smooth)
            ]
            errors[name].append([error.mean() for error in pair])
            if hidden.any():
                errors["hidden"].append([error[hidden].mean() for error in pair])
            covered = np.abs(found.mean - window.positions) < 1.645 * found.sd
            inside.append(covered.mean())
    for name, pairs in errors.items():
        own, kalman = np.mean(pairs, axis=0)
        yield f"denoise_over_kalman_{name}", own / kalman
    both = np.array([errors["noise"], errors["occluded"]])
    clips = [both[:, np.array(names) == name].mean(axis=1) for name in dict.fromkeys(names)]
    yield "denoise_over_kalman_worst_clip", max((clip[:, 0] / clip[:, 1]).max() for clip in clips)
    yield "denoise_coverage_90", float(np.mean(inside))
    yield "denoise_coverage_90_lowest", float(np.min(inside))


def learnt_figures(folder: Path) -> Figures:
    """Yield errors of means corrected by networks over those of the spectral prior alone.

    Same windows as above, one draw of the noise. ``dvae_regression``: the network
    `joint-corrector` alone; ``dvae``: followed by 50 iterations of the Motion-DVAE, whose gain is
    the difference. Both are also compared with a Kalman smoother. Acceleration ratios are to the
    truth, of draws (median over draws) and of means.
    """
    kinds, methods = ("noise", "all", "occluded"), ("dvae", "dvae_regression")
    errors: dict[str, list[list[float]]] = {kind: [] for kind in kinds}
    rows: dict[str, list[float]] = {}
    for number, window in enumerate(denoising_windows(folder)):
        truth, occlusion = window.positions, limb_occlusions(window)
        for name, hidden in (("noise", np.zeros_like(occlusion)), ("all", occlusion)):
            found, smooth = denoised(window, number, hidden, draws=200)
            distances = []
            for method, iterations in zip(methods, (50, 0), strict=True):
                start = time.perf_counter()
                result = correct_joints(
                    found, fps=window.fps, iterations=iterations, progress=False
                )
                seconds = time.perf_counter() - start
                low, high = np.quantile(result.draws, [0.05, 0.95], axis=0)
                covered = (low <= truth) & (truth <= high)
                ratios = [_acceleration(draw) / _acceleration(truth) for draw in result.draws]
                row = {
                    "seconds_per_frame": seconds / window.frames,
                    "coverage_90": covered.mean(),
                    "acceleration_ratio": np.median(ratios),
                    "acceleration_ratio_of_means": _acceleration(result.mean)
                    / _acceleration(truth),
                }
                if hidden.any():
                    row["coverage_90_occluded_joints"] = covered[hidden].mean()
                for figure, value in row.items():
                    rows.setdefault(f"{method}_{figure}", []).append(float(value))
                distances.append(np.linalg.norm(result.mean - truth, axis=-1))
            distances += [np.linalg.norm(mean - truth, axis=-1) for mean in (found.mean, smooth)]
            errors[name].append([each.mean() for each in distances])
            if hidden.any():
                errors["occluded"].append([each[hidden].mean() for each in distances])
    for number, method in enumerate(methods):
        for name, values in errors.items():
            columns = np.transpose(values)
            own, spectral = columns[number], columns[2]
            ratio = own.mean() / spectral.mean()
            yield f"{method}_over_spectral_{name}", ratio
            error = (own - ratio * spectral).std(ddof=1) / np.sqrt(len(own)) / spectral.mean()
            yield f"{method}_over_spectral_{name}_standard_error", error
            if number == 0:
                gain = (columns[1] - own) / spectral.mean()
                yield f"dvae_gain_{name}", gain.mean()
                yield f"dvae_gain_{name}_standard_error", gain.std(ddof=1) / np.sqrt(len(gain))
        both = np.mean([*errors["noise"], *errors["all"]], axis=0)
        yield f"{method}_over_kalman", both[number] / both[3]
    for figure, values in rows.items():
        yield figure, float(np.mean(values))


def denoised(
    window: Motion, seed: int, hidden: np.ndarray, draws: int
) -> tuple[DenoisedJoints, np.ndarray]:
    """Return the posterior under the spectral prior and the Kalman smoother's mean, (L, J, 3)."""
    seen = Joints3D.observe(window, NOISE, seed, hidden=hidden)
    confidence = seen.entries.confidence
    smooth, _ = kalman_smooth(seen.joints, confidence, noise=NOISE, fps=window.fps)
    found = denoise_joints(
        seen.joints, confidence, skeleton=window.skeleton, fps=window.fps, noise=NOISE,
        draws=draws, progress=False,
    )  # fmt: skip
    return found, smooth


def _acceleration(positions: np.ndarray) -> float:
    """Return the mean size of second differences."""
    return float(np.linalg.norm(np.diff(positions, n=2, axis=0), axis=-1).mean())


def denoising_windows(folder: Path) -> list[Motion]:
    """Return the first and last 60 frames of each test clip, once if they overlap by half."""
    windows = []
    for clip in denoising_clips(folder)["test"]:
        frames = min(WINDOW, clip.frames)
        last = clip.frames - frames
        starts = np.linspace(0, last, min(2, last // (frames // 2) + 1)).astype(int)
        windows += [clip.window(int(start), frames) for start in starts]
    return windows
