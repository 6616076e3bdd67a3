"""Accuracy of lifts of made videos of held-out clips, for ``accuracy.py lift``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from single_pose_baseline import single_poses
from unsupervised_baseline import trained_lifter, unsupervised

from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.synthetic.gaits import make_gait
from probmotion.data.videos import Video, film, quadruped_as_person
from probmotion.io.files import load
from probmotion.lifting import Lift, lift
from probmotion.lifting.keypoints import ANKLES, HIPS, PERSON
from probmotion.motion.inverse_kinematics import rigid_motion
from probmotion.motion.motion import Motion

SEEN = [j for j, name in enumerate(PERSON.joint_names) if name not in ("pelvis", "neck")]
JOG, STEPS = "deepmimic_human/humanoid3d_jog.npz", 2  # a loop that is in no split; repetitions
GAITS = ("cmu_02_02", "humanoid3d_long_walk3", "humanoid3d_jog")
FRAMES, VIEWS = 150, 8  # of each clip
HEIGHTS = (1.0, 2.2)  # of the cameras, metres
GOOD = 100.0  # largest mean error of lifts that should not be flagged, mm
MADE = 100  # videos of each kind that must be flagged
COMPARED = 3  # frames of each video that the baseline lifts
FOVS = (43.0, 52.0, 68.0, 81.0)  # 10, 30, 70 and 90 % points of those that lifts assume, degrees
SLOW, LOW, NEAR = 0.2, 0.05, 0.02  # of feet that stand, m/s and metres; metres from their level
ANKLE = 0.075  # height of standing ankles, metres


def lift_figures(folder: Path, lifter_folder: Path | None = None) -> Iterator[tuple[str, float]]:
    """Yield the figures of all videos."""
    yield from usual_views(folder, lifter_folder)
    yield from other_views(folder)
    yield from wrong_videos(folder)


def usual_views(folder: Path, lifter_folder: Path | None = None) -> Iterator[tuple[str, float]]:
    """Yield figures of videos with the field of view that lifts assume.

    They are medians over videos; coverages are means. ``walk`` is walking and running.
    ``lift_over_single_pose`` is the ratio of the median errors of the lift and of single poses
    lifted by joint limits (:mod:`single_pose_baseline`), in the same frames.
    ``lift_over_unsupervised`` is that to the unsupervised lifter in ``lifter_folder``
    (:mod:`unsupervised_baseline`), in all frames, with estimated or known distance and pitch.
    """
    lifter = None if lifter_folder is None else trained_lifter(folder, lifter_folder)
    rows: dict[str, list[tuple[float, float, float]]] = {"walk": [], "other": []}
    compared: dict[str, list[list[float]]] = {"walk": [], "other": []}
    baseline: dict[str, list[list[float]]] = {"walk": [], "other": []}
    flagged, ankles = [], []
    for number, clip in enumerate(held_out(folder)):
        for view, height in product(range(VIEWS), HEIGHTS):
            video = film(clip, number, azimuth=view * 2 * np.pi / VIEWS, height=height)
            result = lifted(video)
            kind = "walk" if clip.name.startswith(GAITS) else "other"
            if kind == "walk":
                ankles.append(feet(result, video))
            rows[kind].append(errors(result, video))
            if rows[kind][-1][0] <= GOOD:
                flagged.append(not result.trusted)
            compared[kind].append(beside_single_poses(result, video, height))
            if lifter is not None:
                truth = about_hips(video.motion.positions)
                distances = np.linalg.norm(unsupervised(video, lifter) - truth, axis=-1)
                baseline[kind].append((1000 * distances.mean(axis=(1, 2))).tolist())
    walk, every = (np.array(rows["walk"]), np.array(rows["walk"] + rows["other"]))
    yield "lift_walk_mpjpe_mm", float(np.median(walk[:, 0]))
    yield "lift_all_mpjpe_mm", float(np.median(every[:, 0]))
    yield "lift_walk_coverage_90", float(walk[:, 1].mean())
    yield "lift_all_coverage_90", float(every[:, 1].mean())
    yield "lift_root_error", float(np.median(every[:, 2]))
    yield "lift_flagged_good", float(np.mean(flagged))
    near, own, speed = map(np.concatenate, zip(*ankles, strict=True))
    yield "lift_walk_feet_within_2_cm", float(near.mean())
    yield "lift_walk_standing_feet_within_2_cm_of_floor", float(own.mean())
    yield "lift_walk_standing_feet_mm_per_s", 1000 * float(np.median(speed))
    for name, values in (("walk", compared["walk"]), ("all", compared["walk"] + compared["other"])):
        lifts, single, directed = np.nanmedian(values, axis=0)
        yield f"lift_{name}_single_pose_mpjpe_mm", single
        start = "lift" if name == "all" else f"lift_{name}"
        yield f"{start}_over_single_pose", lifts / single
        yield f"{start}_over_single_pose_known_direction", lifts / directed
    if lifter is not None:
        for name, lifts, values in (
            ("walk", walk, baseline["walk"]),
            ("all", every, baseline["walk"] + baseline["other"]),
        ):
            blind, told = np.median(values, axis=0)
            yield f"lift_{name}_unsupervised_mpjpe_mm", blind
            start = "lift" if name == "all" else f"lift_{name}"
            yield f"{start}_over_unsupervised", np.median(lifts[:, 0]) / blind
            yield f"{start}_over_unsupervised_known_distance", np.median(lifts[:, 0]) / told


def wrong_videos(folder: Path) -> Iterator[tuple[str, float]]:
    """Yield the shares of wrong videos that are marked."""
    bad = bad_videos(folder)
    marks = {kind: [not lifted(video).trusted for video in videos] for kind, videos in bad.items()}
    for kind, values in marks.items():
        yield f"lift_flagged_{kind}", float(np.mean(values))
    yield "lift_flagged_bad", float(np.mean(list(marks.values())))


def held_out(folder: Path) -> list[Motion]:
    """Return excerpts of test clips and of the action that the prior has not seen."""
    clips = denoising_clips(folder)["test"]
    clips += [load(path) for path in sorted((folder / "cmu_actions").glob("soccer*.npz"))]
    moving = [clip.retarget(PERSON).resample(30.0) for clip in clips]
    long = [clip.window(0, min(FRAMES, clip.frames)) for clip in moving if clip.frames >= 60]
    return [*long, repeated(load(folder / JOG).retarget(PERSON))]


def repeated(loop: Motion) -> Motion:
    """Return repetitions of a motion whose last posture is about its first."""
    moved = (loop.positions[-1, 0] - loop.positions[0, 0]) * [1.0, 0.0, 1.0]
    gap = loop.positions[-1] - loop.positions[0] - moved
    cycle = (loop.positions - np.linspace(0, 1, loop.frames)[:, None, None] * gap)[:-1]
    return replace(loop, positions=np.concatenate([cycle + n * moved for n in range(STEPS)]))


def lifted(video: Video, fov: float | None = None) -> Lift:
    """Return the lift of a video."""
    return lift(video.track, image_size=video.size, fov=fov, progress=False)


def other_views(folder: Path) -> Iterator[tuple[str, float]]:
    """Yield figures of videos with other fields of view, given or not.

    ``lift_distance_coverage_90`` is the share of videos in which the draws' 90 % interval contains
    the mean distance.
    """
    rows: dict[str, list[tuple[float, float, float]]] = {"": [], "_known_fov": []}
    inside = []
    for number, clip in enumerate(held_out(folder)):
        for view, fov in enumerate(FOVS):
            azimuth = (2 * view + number) % VIEWS * 2 * np.pi / VIEWS
            height = HEIGHTS[(view + number) % 2]
            video = film(clip, number, azimuth=azimuth, height=height, fov=fov)
            result = lifted(video)
            rows[""].append(errors(result, video))
            rows["_known_fov"].append(errors(lifted(video, fov), video))
            distances = np.linalg.norm(result.draws[:, :, 0, [0, 2]], axis=-1).mean(axis=1)
            true = np.linalg.norm(video.motion.positions[:, 0, [0, 2]], axis=-1).mean()
            low, high = np.quantile(distances, [0.05, 0.95])
            inside.append(low <= true <= high)
    for name, values in rows.items():
        mpjpe, coverage, root = np.array(values).T
        yield f"lift_other_fov_mpjpe_mm{name}", float(np.median(mpjpe))
        yield f"lift_other_fov_coverage_90{name}", float(coverage.mean())
        yield f"lift_other_fov_root_error{name}", float(np.median(root))
    yield "lift_distance_coverage_90", float(np.mean(inside))


def feet(result: Lift, video: Video) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return heights and speeds of ankles in all frames in which they stand.

    - Where a true ankle stands: whether that of the exported motion is within 2 cm of the median of
      these heights.
    - Where a lifted ankle stands: whether that of the exported motion is within 2 cm of the height
      at which ankles stand on the floor y = 0.
    - Where a true ankle stands: the speed of the lifted one, metres per second.
    """
    fps = video.motion.fps
    true, mean, rigid = (
        motion.positions[:, ANKLES]
        for motion in (video.motion, result.mean, rigid_motion(result.on_floor))
    )
    stands = standing(true, fps)
    heights, own = rigid[stands][:, 1], rigid[standing(mean, fps)][:, 1]
    level = np.median(heights) if len(heights) else 0.0
    near, on_floor = (np.abs(x - at) < NEAR for x, at in ((heights, level), (own, ANKLE)))
    return near, on_floor, speeds(mean, fps)[stands]


def standing(ankles: np.ndarray, fps: float) -> np.ndarray:
    """Return where ankles (L, 2, 3) are slow and close to their lowest height, (L, 2)."""
    height = ankles[..., 1] - np.quantile(ankles[..., 1], 0.05)
    return (speeds(ankles, fps) < SLOW) & (height < LOW)


def speeds(positions: np.ndarray, fps: float) -> np.ndarray:
    """Return speeds of positions (L, J, 3), metres per second, (L, J)."""
    return np.linalg.norm(np.gradient(positions, 1 / fps, axis=0), axis=-1)


def errors(result: Lift, video: Video) -> tuple[float, float, float]:
    """Return mean joint error (mm), coverage of 90 % intervals, and relative error of the path.

    Joints are the twelve keypoints relative to the middle of the hips.
    """
    truth = video.motion.positions
    distance = np.linalg.norm(about_hips(result.mean.positions) - about_hips(truth), axis=-1)
    low, high = np.quantile(about_hips(result.draws), [0.05, 0.95], axis=0)
    inside = (about_hips(truth) >= low) & (about_hips(truth) <= high)
    path, true_path = (x[:, 0, [0, 2]] for x in (result.mean.positions, truth))
    off = np.linalg.norm(path - true_path, axis=-1).mean()
    return 1000 * distance.mean(), inside.mean(), off / np.linalg.norm(true_path, axis=-1).mean()


def beside_single_poses(result: Lift, video: Video, height: float) -> list[float]:
    """Return the mean errors (mm) of the lift and of single poses without and with direction."""
    frames = ((np.arange(COMPARED) + 0.5) / COMPARED * video.motion.frames).astype(int)
    truth = about_hips(video.motion.positions[frames])
    motions = [result.mean.positions[frames], *single_poses(video, height, frames)]
    errors = [np.linalg.norm(about_hips(motion) - truth, axis=-1) for motion in motions]
    return [1000 * float(np.nanmean(error)) for error in errors]


def about_hips(positions: np.ndarray) -> np.ndarray:
    """Return the keypoints' positions relative to the middle of the hips."""
    return (positions - positions[..., HIPS, :].mean(axis=-2, keepdims=True))[..., SEEN, :]


def bad_videos(folder: Path) -> dict[str, list[Video]]:
    """Return videos that no person filmed by a still camera explains."""
    clips = [clip for clip in held_out(folder) if clip.frames >= 90]
    kinds: dict[str, list[Video]] = {
        kind: [] for kind in ("random", "animal", "mirrored", "moving_camera")
    }
    for number in range(MADE):
        rng = np.random.default_rng(number)
        clip = clips[number % len(clips)].window(0, 90)
        video = film(clip, number, azimuth=rng.uniform(0, 2 * np.pi), height=1.0)
        points, size = video.track.keypoints, video.size[0]
        kinds["random"].append(with_points(video, rng.uniform(0.2, 0.8, points.shape) * size))
        flipped = points.copy()
        flipped[..., 0] = size - flipped[..., 0]
        kinds["mirrored"].append(with_points(video, flipped))
        times = np.arange(len(points)) / clip.fps
        pan = rng.uniform(60, 150) * np.sin(2 * np.pi * rng.uniform(0.3, 1) * times + number)
        shifted = points + np.stack([pan, 0.5 * pan], axis=-1)[:, None]
        kinds["moving_camera"].append(with_points(video, np.clip(shifted, 0, size - 1)))
        # The fore legs of quadrupeds have the names of arms.
        gait = make_gait(("quadruped-walk", "quadruped-trot")[number % 2], number, frames=90)
        gait = quadruped_as_person(gait)
        kinds["animal"].append(film(gait, number, azimuth=number, height=0.8))
    return kinds


def with_points(video: Video, points: np.ndarray) -> Video:
    """Return the video with other keypoints where it has some."""
    kept = np.where(video.track.confidence[..., None] > 0, points, np.nan)
    return video._replace(track=replace(video.track, keypoints=kept))
