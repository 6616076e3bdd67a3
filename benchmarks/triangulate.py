"""How fast and how near to the minimiser: L = 180, J = 16, V = 5, perspective, one thread, NumPy.

Six steps of a sampler, each warm-started from the last motion, which is 20, 10, 5, 3, 2 and 1 cm
off as the noise falls; two linearisations each. Beside it an Adam loop in torch on the same input
(lr 0.01, the same start, until the loss no longer falls, at most 1000 iterations), as in the MAS
authors' code. ``milliseconds`` is the closed form's shortest call; ``speed_ratio_to_adam`` compares
all six steps, and the distances to the minimiser are root mean squares over them.

Adam does one of two things. From 5 cm and more it converges, nearer than two linearisations come,
in about a second. From less its momentum carries it past the minimum in a few iterations, where it
stops 6 to 10 mm short: ``speed_ratio_where_adam_stops_early`` is the ratio there.
"""

from __future__ import annotations

import os

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

import time
from collections.abc import Callable
from functools import partial

import numpy as np

from probmotion import Cameras, triangulate

L, J, V = 180, 16, 5


STARTS = (0.20, 0.10, 0.05, 0.03, 0.02, 0.01)


def problem(seed: int = 0) -> tuple[np.ndarray, Cameras, list[np.ndarray]]:
    """Return keypoints that disagree by 2 cm, their cameras, and a start per step."""
    rng = np.random.default_rng(seed)
    cameras = Cameras.ring(V, elevation=np.pi / 16, perspective=True)
    motion = 0.4 * rng.standard_normal((L, J, 3))
    keypoints = cameras.project(motion) + 0.02 * rng.standard_normal((V, L, J, 2))
    return keypoints, cameras, [motion + off * rng.standard_normal(motion.shape) for off in STARTS]


def adam(
    keypoints: np.ndarray, cameras: Cameras, initial: np.ndarray, most: int = 1000
) -> np.ndarray:
    """Return what Adam finds: it stops at the first iteration that does not lower the loss."""
    import torch

    torch.set_num_threads(1)
    wanted = torch.tensor(keypoints)
    motion = torch.tensor(initial, requires_grad=True)
    optimiser = torch.optim.Adam([motion], lr=0.01)
    best = float("inf")
    for _ in range(most):
        loss = ((cameras.project(motion) - wanted) ** 2).mean()
        if float(loss.detach()) >= best:
            break
        best = float(loss.detach())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return motion.detach().numpy()


def shortest(call: Callable[[], object], repeats: int) -> float:
    """Return the shortest of ``repeats`` calls, seconds: other work can only add to it."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def rms(differences: list[np.ndarray]) -> float:
    """Return the root mean square over all steps, metres."""
    return float(np.sqrt(np.mean(np.square(differences))))


def main() -> None:
    """Print the figures."""
    keypoints, cameras, starts = problem()
    # Many motions at once first, as a sampler has them: the memory that the system hands to the
    # process for that is used again by the smaller calls.
    triangulate(np.stack([keypoints] * 16), cameras)
    adam(keypoints, cameras, starts[-1])
    ours, theirs, our_errors, their_errors = [], [], [], []
    for start in starts:
        minimiser = triangulate(keypoints, cameras, initial=start, iterations=100)
        ours.append(shortest(partial(triangulate, keypoints, cameras, initial=start), 500))
        theirs.append(shortest(partial(adam, keypoints, cameras, start), 2))
        our_errors.append(triangulate(keypoints, cameras, initial=start) - minimiser)
        their_errors.append(adam(keypoints, cameras, start) - minimiser)
    print(f"milliseconds: {1e3 * min(ours):.3f}")
    print(f"speed_ratio_to_adam: {sum(theirs) / sum(ours):.0f}")
    print(f"speed_ratio_where_adam_stops_early: {sum(theirs[3:]) / sum(ours[3:]):.0f}")
    print(f"rms_to_minimiser: {rms(our_errors):.2g}")
    print(f"adam_rms_to_minimiser: {rms(their_errors):.2g}")


if __name__ == "__main__":
    main()
