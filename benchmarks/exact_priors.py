"""Speed and memory of the exact priors, as ``name: value`` lines.

``fit_seconds_per_hour`` is extrapolated from the training clips of the denoising study, including
the choice of the number of components; ``posterior_ms_per_frame`` is that of
:func:`~probmotion.models.mixture.denoising.denoise_joints` with a limb hidden a third of the time;
``denoiser_per_second`` counts 3D denoisers at a noise level in the middle of the schedule.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from probmotion.data.denoising_clips import denoising_clips, synthetic_denoising_clips
from probmotion.models.mixture.denoising import denoise_joints
from probmotion.models.mixture.spectral_mixture import SpectralMixtureMotion
from probmotion.motion.motion import Motion
from probmotion.problems.denoising import limb_occlusions
from probmotion.threads import one_thread

COMPONENTS, FRAMES, POINTS = 12, 30, 256
LONG = 6000  # frames


def main() -> None:
    """Print every measurement."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="Folder of the recordings; else synthetic.")
    data = parser.parse_args().data
    clips = synthetic_denoising_clips(n=300) if data is None else denoising_clips(data)
    training = clips["train"]
    hours = sum(motion.frames / motion.fps for motion in training) / 3600
    with one_thread():
        start = time.perf_counter()
        SpectralMixtureMotion.fit(training, progress=False)
        print(f"fit_seconds_per_hour: {(time.perf_counter() - start) / hours:.3g}", flush=True)
        walk = max(clips["test"], key=lambda motion: motion.frames)
        for frames in (60, LONG):
            joints = noisy(walk, frames)
            options = {"skeleton": walk.skeleton, "fps": walk.fps, "noise": 0.04, "draws": 0}

            def denoise(joints: np.ndarray = joints, options: dict = options) -> object:
                return denoise_joints(joints, **options, progress=False)

            seconds = fastest(denoise, 3 if frames == 60 else 1)
            print(f"posterior_ms_per_frame_{frames}: {1e3 * seconds / frames:.3g}", flush=True)
        print(f"denoiser_per_second: {denoiser_rate(training):.0f}", flush=True)
        print(f"em_lift_per_second: {lift_rate():.0f}", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"peak_gib: {peak / (2**30 if sys.platform == 'darwin' else 2**20):.2f}")


def noisy(motion: Motion, frames: int) -> np.ndarray:
    """Return noisy joints of a motion, played forwards and backwards, with hidden limbs."""
    both = np.concatenate([motion.positions, motion.positions[::-1]])
    positions = both[np.arange(frames) % len(both)]
    hidden = np.concatenate(
        [
            limb_occlusions(Motion(positions[start : start + 60], motion.skeleton, motion.fps))
            for start in range(0, frames, 60)
        ]
    )
    joints = positions + 0.04 * np.random.default_rng(0).standard_normal(positions.shape)
    joints[hidden] = np.nan
    return joints


def denoiser_rate(training: list[Motion]) -> float:
    """Return the number of 3D denoiser evaluations per second."""
    prior = SpectralMixtureMotion.fit(training, FRAMES, components=COMPONENTS, progress=False)
    rng = np.random.default_rng(0)
    clean = prior.sample(rng, POINTS) / prior.scale
    noisy_motions = np.sqrt(0.5) * clean + np.sqrt(0.5) * rng.standard_normal(clean.shape)
    return POINTS / fastest(lambda: prior.denoise_motion(noisy_motions, 0.5), 5)


def lift_rate() -> float:
    """Return the number of annotations of pairs that are lifted per second."""
    from annotation_figures import dances

    pairs = dances()
    prior, _ = pairs.fitted(pairs.annotated(500))
    annotations = pairs.asked(100).annotations
    return len(annotations) / fastest(lambda: prior.lift(annotations), 3)


def fastest(work: Callable[[], object], times: int) -> float:
    """Return the minimum duration of several runs, after one warm-up run."""
    work()
    durations = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        durations.append(time.perf_counter() - start)
    return min(durations)


if __name__ == "__main__":
    main()
