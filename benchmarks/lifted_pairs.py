"""Errors of pairs of people lifted from one still camera (``probmotion pairs``).

Prints a line per video: the mean error of joints about the pair's middle (mm) of the video's own
frames and smoothed, in the camera's axes and after alignment of the heading; the share of
coordinates in 90 % intervals, of all and in depth; and the mean difference of joints' steps from
one frame to the next to the true ones (mm). Then the means over videos, and the mean differences of
smoothed and single frames with two standard errors over videos. A pinhole camera films each dance
from two azimuths at a distance of 6 m; keypoints have noise of 4 pixels (17 mm), 5 % outliers and
10 % gaps.

Smoothing was chosen on the training clips (``--clips training``) with exact scales, noise of 5
pixels, and neither outliers nor gaps; figures are those of the held-out clips.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import numpy as np

from probmotion import seeds
from probmotion.data.downloads import salsa_pairs
from probmotion.data.pair_sets import choose_seed, dance_frames, ground_truth, hold_out
from probmotion.data.synthetic.dances import synthetic_dances
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.lifting.pairs import LiftedPairs, lift_pairs
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

AZIMUTHS = (0.0, 1.0)
DISTANCE, HEIGHT = 6.0, 1.4  # of the camera, metres
FOCAL, NOISE = 1400.0, 4.0  # pixels
OUTLIERS, FAR, MISSING = 0.05, 60.0, 0.1


def film(motion: Motion, azimuth: float, seed: int = 0) -> tuple[list[KeypointTrack], np.ndarray]:
    """Return keypoints of both people, and the true positions (L, J, 3) in the camera's axes."""
    rng = seeds.generator(seed, "film")
    positions = motion.positions - motion.positions.mean(axis=(0, 1)) * [1.0, 0.0, 1.0]
    positions = positions @ vector_to_matrix(np.array([0.0, -azimuth, 0.0])).T
    seen = positions - [0.0, HEIGHT, DISTANCE]
    pixels = FOCAL * seen[..., :2] / seen[..., 2:] * [-1.0, 1.0] + [960.0, 540.0]
    pixels += NOISE * rng.standard_normal(pixels.shape)
    far = rng.random(pixels.shape[:2]) < OUTLIERS
    pixels[far] += FAR * rng.standard_normal((int(far.sum()), 2))
    confidence = (rng.random(pixels.shape[:2]) >= MISSING).astype(float)
    person = Skeleton.preset("person17")
    tracks = [
        KeypointTrack(points, known, person, motion.fps, name=motion.name)
        for points, known in zip(
            np.split(pixels, 2, axis=1), np.split(confidence, 2, axis=1), strict=True
        )
    ]
    return tracks, positions


def centred(positions: np.ndarray) -> np.ndarray:
    """Return positions (L, J, 3) about the middle of the pair."""
    result: np.ndarray = positions - positions.mean(axis=1, keepdims=True)
    return result


def turned(positions: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return centred positions with the heading that fits the truth in each frame."""
    product = np.einsum("lja,ljb->lab", positions, truth)
    angle = np.arctan2(product[:, 2, 0] - product[:, 0, 2], product[:, 0, 0] + product[:, 2, 2])
    turn = vector_to_matrix(np.stack([0 * angle, angle, 0 * angle], axis=-1))
    return np.einsum("lab,ljb->lja", turn, positions)


def figures(positions: np.ndarray, sd: np.ndarray, truth: np.ndarray) -> list[float]:
    """Return errors (mm), shares in 90 % intervals, and the error of steps (mm)."""
    moved = positions - truth
    positions, truth = centred(positions), centred(truth)
    inside = np.abs(positions - truth) < 1.645 * sd
    return [
        1000 * float(np.linalg.norm(positions - truth, axis=-1).mean()),
        1000 * float(np.linalg.norm(turned(positions, truth) - truth, axis=-1).mean()),
        float(inside.mean()),
        float(inside[..., 2].mean()),
        1000 * float(np.linalg.norm(np.diff(moved, axis=0), axis=-1).mean()),
    ]


def frame_by_frame(result: LiftedPairs) -> tuple[np.ndarray, np.ndarray]:
    """Return the lifts of the video's frames on their own."""
    lifts = result.prior.lift(result.keypoints)
    return lifts.positions, lifts.sd


def videos(which: str, data: Path) -> tuple[list[Motion], Motion]:
    """Return dances and a pair to start from, of another dance."""
    if which == "made":
        dances = synthetic_dances(6, frames=600, seed=5)
        return dances, synthetic_dances(1, seed=11)[0]
    training, held_out = hold_out(salsa_pairs(data))
    poses = ground_truth(training)[0]
    pose = poses[choose_seed(poses)][None]
    clips = training if which == "training" else held_out
    spans = [np.flatnonzero(dance_frames(clip))[[0, -1]] for clip in clips]
    dances = [c.window(int(a), int(b - a + 1)) for c, (a, b) in zip(clips, spans, strict=True)]
    return dances, Motion(pose, clips[0].skeleton, clips[0].fps)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--clips", choices=["made", "held-out", "training"], default="made")
    data = Path(__file__).parents[2] / "shared" / "data"
    parser.add_argument("--data", type=Path, default=data, help="Folder of the salsa clips.")
    options = parser.parse_args()
    dances, start = videos(options.clips, options.data)
    rows = []
    print("video, azimuth: of frames and smoothed, each error, turned, inside, depth, steps")
    for number, dance in enumerate(dances):
        for azimuth in AZIMUTHS:
            tracks, truth = film(dance, azimuth, number)
            begun = time.perf_counter()
            try:
                result = lift_pairs(tracks, start, progress=False)
            except ValueError as error:
                print(f"{dance.name} {azimuth}: {error}")
                continue
            seconds = time.perf_counter() - begun
            row = figures(*frame_by_frame(result), truth)
            row += figures(result.mean.positions, result.sd, truth)
            rows.append([*row, float(result.other_order > 0.1), seconds])
            print(f"{dance.name} {azimuth}:", *(f"{value:.3g}" for value in rows[-1]), flush=True)
    names = ("error_mm", "turned_mm", "inside", "inside_depth", "step_mm")
    labels = [f"{kind}_{name}" for kind in ("frame", "smoothed") for name in names]
    for label, value in zip(
        [*labels, "other_order", "seconds"], np.mean(rows, axis=0), strict=True
    ):
        print(f"{label}: {value:.3g}")
    single, smoothed = np.split(np.array(rows)[:, : 2 * len(names)], 2, axis=1)
    differences = smoothed - single
    errors = 2 * differences.std(axis=0, ddof=1) / math.sqrt(len(rows))
    for name, value, error in zip(names, differences.mean(axis=0), errors, strict=True):
        print(f"smoothed - frame, {name}: {value:.2g} ± {error:.2g}")


if __name__ == "__main__":
    main()
