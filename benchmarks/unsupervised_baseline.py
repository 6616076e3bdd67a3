"""Baseline of lifts: an unsupervised lifter of single poses (ElePose), for ``lift_figures.py``.

The lifter (:mod:`probmotion.models.evaluation.lifter`) is learnt from the keypoints of made videos
of the clips from which the lift's prior was fitted. It gets what the lift gets, with the distance
estimated from the apparent size of the bones; or it is told, as the baseline of joint limits, the
distance in every frame and the camera's pitch. Exchanged sides are repaired as for the lift; gaps
are interpolated and outliers removed by a median filter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter
from single_pose_baseline import CENTRE, FOCAL, PERSON

from probmotion import seeds
from probmotion.data.denoising_clips import denoising_clips
from probmotion.data.videos import Video, film
from probmotion.geometry.cameras import Cameras
from probmotion.io.files import load
from probmotion.lifting.keypoints import LIMBS, body_path, person_keypoints
from probmotion.models.evaluation.lifter import LifterSettings, PoseLifter
from probmotion.models.evaluation.lifter_training import LifterTrainee
from probmotion.models.evaluation.pose_flow import FlowSettings, PoseFlow
from probmotion.models.evaluation.pose_flow_training import PoseFlowTrainee
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

HELD_OUT_ACTION = "soccer"
VIEWS = 6  # videos of each training clip
FRAMES = 150  # longest part of a clip in one video
MEDIAN = 5  # frames
STEADY = 61  # frames over which the distance is about the same
HIPS = [PERSON.index(f"{side}_hip") for side in ("left", "right")]
NAMES = [PERSON.joint_names[joint] for joint in LIMBS]
# The limbs hang on the middle of the hips, as detectors have neither pelvis nor neck.
SKELETON = Skeleton(
    ["hips", *NAMES],
    [-1]
    + [
        1 + NAMES.index(PERSON.joint_names[PERSON.parents[joint]])
        if PERSON.parents[joint] in LIMBS
        else 0
        for joint in LIMBS
    ],
)


def trained_lifter(folder: Path, out: Path) -> PoseLifter:
    """Return the lifter in ``out``, which is trained there on the clips in ``folder`` if absent."""
    clips = denoising_clips(folder)
    actions = sorted((folder / "cmu_actions").glob("*.npz"))
    clips["train"] += [
        load(path).retarget(PERSON).resample(30.0)
        for path in actions
        if not path.stem.startswith(HELD_OUT_ACTION)
    ]
    training, validation = (_videos(clips[part]) for part in ("train", "validation"))
    distance = float(np.median([_depth(video).mean() for video in training]))
    tracks = [[_track(video) for video in part] for part in (training, validation)]
    run = TrainingSettings(steps=4000, batch=256, learning_rate=1e-3)
    flow = PoseFlowTrainee(*tracks, FlowSettings.small())
    flow_model = train(flow, run, out / "flow").model
    size = LifterSettings(distance=distance)
    trainee = LifterTrainee(*tracks, PoseFlow.load(flow_model), size)
    return PoseLifter.load(train(trainee, run, out / "lifter").model)


def unsupervised(video: Video, lifter: PoseLifter) -> tuple[np.ndarray, np.ndarray]:
    """Return the limbs of a video relative to the hips, (L, 12, 3), metres, in the truth's axes.

    The first array has the estimated distance and pitch, the second the true ones.
    """
    size = body_path(person_keypoints(video.track)).size
    estimated, told = (
        _metres(video, depth)[None]
        for depth in (FOCAL / median_filter(size, STEADY, mode="nearest"), _depth(video))
    )
    in_camera = lifter.lift(told)[0] @ _axes(lifter.elevations(told)).T
    lifted = lifter.lift(estimated)[0], in_camera @ _axes(video.camera.elevation)
    first, second = (
        positions[:, 1:]
        - positions[:, [1 + LIMBS.index(joint) for joint in HIPS]].mean(axis=1, keepdims=True)
        for positions in lifted
    )
    return first, second


def _videos(clips: list[Motion]) -> list[Video]:
    """Return videos of parts of clips from random directions, from the heights of the figures."""
    videos = []
    for number, clip in enumerate(clips):
        rng = seeds.generator(0, "unsupervised baseline", number)
        for view in range(VIEWS):
            length = min(FRAMES, clip.frames)
            part = clip.window(int(rng.integers(clip.frames - length + 1)), length)
            azimuth, height = rng.uniform(0, 2 * np.pi), (1.0, 2.2)[view % 2]
            videos.append(film(part, 1000 * number + view, azimuth=azimuth, height=height))
    return videos


def _track(video: Video) -> KeypointTrack:
    """Return the keypoints of a video in metres about the hips."""
    points = _metres(video, _depth(video))
    name, fps = video.track.name, video.track.fps
    return KeypointTrack(points, np.ones(points.shape[:2]), SKELETON, fps, name)


def _metres(video: Video, depth: np.ndarray) -> np.ndarray:
    """Return the keypoints, metres at the hips' depth (L,), y down: (L, 13, 2)."""
    points, weight, _ = person_keypoints(video.track)
    times = np.arange(len(points))
    filled = np.empty((len(points), len(LIMBS), 2))
    for column, joint in enumerate(LIMBS):
        rows = np.flatnonzero(weight[:, joint] > 0)
        for axis in range(2):
            filled[:, column, axis] = np.interp(times, rows, points[rows, joint, axis])
    filled = median_filter(filled, (MEDIAN, 1, 1), mode="nearest")
    metres = (filled - CENTRE) / FOCAL * depth[:, None, None]
    hips = metres[:, [LIMBS.index(joint) for joint in HIPS]].mean(axis=1, keepdims=True)
    return np.concatenate([hips, metres], axis=1)


def _depth(video: Video) -> np.ndarray:
    """Return the true depth of the hips along the optical axis, (L,), metres."""
    middle = video.motion.positions[:, HIPS].mean(axis=1)
    depth: np.ndarray = middle @ _axes(video.camera.elevation)[2]
    return depth


def _axes(elevation: np.ndarray) -> np.ndarray:
    """Return the right, down and forward of a camera of elevation (1,), radians, (3, 3)."""
    axes: np.ndarray = Cameras.around(np.zeros(1), elevation).rotation[0]
    return axes
