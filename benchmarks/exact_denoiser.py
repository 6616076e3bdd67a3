"""Rate of exact 2D denoiser evaluations: 108 components, r = 10, L = 30, J = 17.

``evaluations_per_second`` uses the coordinates of ``GaussianMixtureMotion.reduced()``, which are
exact; ``full_size_evaluations_per_second`` uses full-dimensional motions. Float64, one thread.
One evaluation is one view of one motion at one noise level.
"""

from __future__ import annotations

import os

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

import time

import numpy as np

from probmotion import Cameras
from probmotion.data.synthetic.gaits import make_gaits
from probmotion.models import GaussianMixtureMotion


def evaluations_per_second(prior: GaussianMixtureMotion, n: int = 1024, repeats: int = 9) -> float:
    """Return the median rate over ``repeats`` calls with ``n`` motions in two tilted views."""
    cameras = Cameras.ring(2, elevation=0.26)
    rng = np.random.default_rng(0)
    shape = (n, cameras.n_views, prior.frames, prior.skeleton.n_joints, 2)
    x_t = rng.standard_normal(shape)
    prior.denoise(x_t, 0.5, cameras)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        prior.denoise(x_t, 0.5, cameras)
        seconds.append(time.perf_counter() - start)
    return n * cameras.n_views / float(np.median(seconds))


def main() -> None:
    """Print the measurements."""
    styles = {"walk": 0.5, "run": 0.3, "march": 0.2}
    clips = make_gaits(300, styles=styles)
    labels = [clip.name.rpartition("-")[0] for clip in clips]
    prior = GaussianMixtureMotion.fit(clips, frames=30, rank=10, styles=labels)
    reduced, _ = prior.reduced()
    print(f"components: {len(prior.weights) * prior.azimuths}")
    print(f"reduced_dimensions: {2 * reduced.skeleton.n_joints}")
    print(f"evaluations_per_second: {evaluations_per_second(reduced):.0f}")
    print(f"full_size_evaluations_per_second: {evaluations_per_second(prior):.0f}")


if __name__ == "__main__":
    main()
