"""Accuracy of lifts of one and of several calibrated cameras, for ``accuracy.py cameras``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from lift_figures import PERSON, SEEN, about_hips

from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import film
from probmotion.geometry.cameras import Cameras
from probmotion.io.keypoints.calibration import Calibration, read_calibration
from probmotion.io.recordings import read_recording
from probmotion.lifting import Lift, lift
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton

AZIMUTHS = (0.3, 1.9, 3.4, 5.0)  # of the cameras of made videos, radians
FRAMES = 90  # of made videos


def camera_figures(folder: Path) -> Iterator[tuple[str, float]]:
    """Yield mean joint errors in the world (mm), and of a single camera those about the hips.

    ``made_…``: made videos of a walk and a march by two to four cameras, and the share of
    coordinates in 90 % intervals. ``balancing_…``: all sets of the cameras of Pose2Sim's recording,
    with the smallest and largest value of sets of the same size; the truth is the robust
    triangulation of all four views. ``uncalibrated``: with estimated pitch and assumed field of
    view, relative to the camera; the pitch's error is in degrees.
    """
    for style in ("walk", "march"):
        yield from made_figures(style)
    yield from balancing_figures(folder)


def made_figures(style: str) -> Iterator[tuple[str, float]]:
    """Yield errors and coverages of made videos of one gait."""
    clip = make_gait(style, 5, frames=FRAMES)
    truth = clip.retarget(PERSON).positions
    videos = [film(clip, view, azimuth=a, height=1.4) for view, a in enumerate(AZIMUTHS)]
    names = tuple(f"cam_{view}" for view in range(len(videos)))
    parts = (
        np.concatenate([getattr(video.camera, name) for video in videos])
        for name in ("rotation", "translation", "focal", "centre")
    )
    cameras = Cameras(*parts, orthographic=False)
    matrices = np.zeros((len(videos), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = cameras.focal
    matrices[:, :2, 2], matrices[:, 2, 2] = cameras.centre, 1.0
    sizes = tuple(video.size for video in videos)
    calibration = Calibration(names, cameras, matrices, np.zeros((len(videos), 5)), sizes)
    tracks = [replace(v.track, name=name) for v, name in zip(videos, names, strict=True)]
    for number in (2, 3, 4):
        result = lift(tracks[:number], camera=calibration, progress=False)
        yield f"made_{style}_{number}_cameras_mpjpe_mm", error_mm(result, truth)
        yield (
            f"made_{style}_{number}_cameras_coverage_90",
            coverage(result.draws[:, :, SEEN], truth[:, SEEN]),
        )


def balancing_figures(folder: Path) -> Iterator[tuple[str, float]]:
    """Yield errors and coverages of lifts of the balancing person, and the shares of marked ones.

    Intervals of a single camera are those of positions about the hips.
    """
    path = folder / "pose2sim_multiview" / "S00_P00_T01_BalancingTrial_multiview.npz"
    file = folder / "originals" / "Calib_qualisys.toml"
    calibration = read_calibration(file)
    truth = read_recording(path, fps=None).filtered
    skeleton = Skeleton.preset("body25b")
    with np.load(path) as archive:
        views = zip(archive["keypoints"], archive["confidence"], strict=True)
        tracks = [
            KeypointTrack(points, confidence, skeleton, 60.0, f"cam_0{number}")
            for number, (points, confidence) in enumerate(views, start=1)
        ]
    for number, track in enumerate(tracks):
        result = lift(track, image_size=calibration.sizes[number], progress=False)
        forward = calibration.cameras.rotation[number, 2]
        heading = np.arctan2(forward[0], -forward[2])
        cos, sin = np.cos(heading), np.sin(heading)
        turned = truth @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
        label = f"balancing_view_{number + 1}_uncalibrated"
        yield f"{label}_mpjpe_mm", error_about_hips_mm(result, turned)
        pitch = np.degrees(result.camera.pitch - np.arcsin(forward[1]))
        yield f"{label}_pitch_error_deg", abs(float(pitch))
        yield f"{label}_flagged", float(not result.trusted)
    for size in range(1, len(tracks) + 1):
        lifts = [
            lift(list(views), camera=file, progress=False) for views in combinations(tracks, size)
        ]
        label = f"balancing_{size}_cameras"
        if size == 1:
            errors = [error_about_hips_mm(result, truth) for result in lifts]
            inside = [coverage(about_hips(r.draws), about_hips(truth)) for r in lifts]
            for number, error in enumerate(errors, start=1):
                yield f"balancing_view_{number}_mpjpe_mm", error
        else:
            errors = [error_mm(result, truth) for result in lifts]
            inside = [coverage(r.draws[:, :, SEEN], truth[:, SEEN]) for r in lifts]
        for name, values in (("mpjpe_mm", errors), ("coverage_90", inside)):
            yield f"{label}_{name}_smallest", min(values)
            yield f"{label}_{name}_largest", max(values)
        yield f"{label}_flagged", float(np.mean([not result.trusted for result in lifts]))


def error_mm(result: Lift, truth: np.ndarray) -> float:
    """Return the mean error of the keypoints' positions, (L, J, 3), mm."""
    distance = np.linalg.norm(result.mean.positions - truth, axis=-1)[:, SEEN]
    return 1000 * float(np.nanmean(distance))


def error_about_hips_mm(result: Lift, truth: np.ndarray) -> float:
    """Return the mean error of positions relative to the middle of the hips, mm."""
    distance = np.linalg.norm(about_hips(result.mean.positions) - about_hips(truth), axis=-1)
    return 1000 * float(np.nanmean(distance))


def coverage(draws: np.ndarray, truth: np.ndarray) -> float:
    """Return the share of known coordinates (L, J, 3) in the 90 % intervals of draws."""
    low, high = np.quantile(draws, [0.05, 0.95], axis=0)
    return float(((low <= truth) & (truth <= high))[np.isfinite(truth)].mean())
