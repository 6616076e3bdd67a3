"""Learn the shipped regression of depths, ``pose-depth``, from made videos, and write its card.

``python notebooks/ship_pose_depth.py --data ../shared/data --out runs/pose-depth``
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from ship_cmu_motion import mirrored, recordings

from probmotion import seeds
from probmotion.data.videos import Video, film
from probmotion.geometry.cameras import Cameras
from probmotion.lifting.camera import LevelCamera
from probmotion.lifting.keypoints import averaged, body_path, from_hips, person_keypoints
from probmotion.lifting.linear_system import PROPORTIONS
from probmotion.models.training.checkpoints import load_checkpoint
from probmotion.models.training.settings import TrainingSettings
from probmotion.models.training.trainer import train
from probmotion.models.unseen_depth.pose_depth import (
    KEYPOINTS,
    RATE,
    PoseDepth,
    relative_keypoints,
)
from probmotion.models.unseen_depth.pose_depth_training import (
    DepthExamples,
    PoseDepthTrainee,
    regression,
)
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton

WEIGHTS = Path(__file__).parents[1] / "models" / "weights"
FPS = 30.0
VIEWS = 72  # videos of each part of a clip
SPEEDS = 0.25  # largest logarithm of the factor of a video's speed
LENGTH, SHORTEST = 150, 30  # frames of a video
FOV, FOCALS = 60.0, 0.3  # median field of view, degrees; spread of the focal lengths' logarithm
HEIGHTS = ((0.3, 1.5), (1.5, 4.0))  # of cameras, metres; either with probability 1/2
TRAINING = TrainingSettings(
    steps=16_000, batch=512, learning_rate=1e-3, halve_at=(6000, 9000, 11_000, 13_000, 14_500)
)

CARD = """# pose-depth

Regression of the depths of a person's joints along the ray to the body, and of the ray's pitch, on the keypoints of nine
frames at 15 per second, for `probmotion lift` with one camera ({parameters:.1f} million weights).

- **Data**: made videos (`probmotion.data.videos.film`) of the clips from which `cmu-motion` was
  fitted, {minutes:.1f} minutes, and of their mirror images: {videos} videos of up to 6.4 seconds, from
  all sides, with cameras from 0.3 to 4 m high that look at the middle of the path, with fields of view of 39° to 87°
  in 90 % of the videos, with bones 3 % longer or shorter (standard deviation), and with a detector's noise, outliers, gaps and exchanged sides. Videos have
  speeds of 0.78 to 1.28 times those of the clips, and each arm is that of another clip in half of them. In three
  of ten inputs, joints are occluded for some time. Validation and test clips of the denoising study are held out, and the action soccer
  as a whole.
- **Provenance**: as `cmu-motion.md`.
- **Not for**: bodies that are not people's, rolled cameras, and postures unlike the clips', such
  as lying and getting up, without wide intervals.
- **Calibration**: 90 % intervals of lifts, which use these depths, contain 93 % of the coordinates in walking
  and running, 91 % in all held-out clips, and at least 89 % in four single, calibrated views of one real recording
  (docs/how-to/lift.md).

| | clips | depth: mean absolute error, mm | pitch in a video: mean absolute error |
|---|---|---|---|
{rows}

Twelve joints of arms and legs, relative to the middle of the hips; two videos of each held-out
clip with a field of view of 60° and cameras at heights of 1 and 2.2 m; ±: standard error over clips. Commands (training on one thread of a shared CPU; no
GPU was used):

    python notebooks/ship_pose_depth.py --data ../shared/data --out runs/pose-depth
"""


def main() -> None:
    """Train, write and evaluate the regression."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="Folder of the recordings.")
    parser.add_argument("--out", type=Path, required=True, help="Folder of the training run.")
    arguments = parser.parse_args()
    person = Skeleton.preset("person14")
    clips = recordings(arguments.data, partial(Motion.retarget, skeleton=person))
    fitted = clips["train"] + clips["actions"]
    training = examples(fitted, vary=True)
    result = trained(training, clips["validation"], arguments.out)
    rows = []
    for part, name in (
        ("validation", "validation"),
        ("test", "test"),
        ("soccer", "soccer (action kept out)"),
    ):
        cells = []
        for values, form in zip(errors(result, clips[part]), ("{:.0f}", "{:.1f}°"), strict=True):
            error = values.std(ddof=1) / np.sqrt(len(values))
            cells.append(f"{form.format(values.mean())} ± {form.format(error)}")
        rows.append(f"| {name} | {len(clips[part])} | {' | '.join(cells)} |")
    minutes = sum(clip.frames / clip.fps for clip in fitted) / 60
    replace(result, card={"command": "ship_pose_depth", "minutes": round(minutes, 1)}).save(
        WEIGHTS / "pose-depth.npz"
    )
    text = CARD.format(
        parameters=sum(matrix.size for matrix, _ in result.layers) / 1e6,
        minutes=minutes,
        videos=len(training.inputs),
        rows="\n".join(rows),
    )
    (WEIGHTS / "pose-depth.md").write_text(text, encoding="utf-8")


def trained(training: DepthExamples, validation: Sequence[Motion], out: Path) -> PoseDepth:
    """Return the regression learnt from examples; the run in ``out`` is resumed."""
    trainee = PoseDepthTrainee(training, examples(validation, views=2))
    model = train(trainee, TRAINING, out).model
    return regression(load_checkpoint(model, PoseDepthTrainee.kind).tensors, {})


def examples(clips: Sequence[Motion], views: int = VIEWS, *, vary: bool = False) -> DepthExamples:
    """Return examples from videos of all clips and their mirror images, varied or as recorded."""
    inputs, targets = [], []
    every = [*clips, *map(mirrored, clips)]
    others = [clip for clip in every if clip.frames >= SHORTEST]
    for number, clip in enumerate(every):
        rng = seeds.generator(0, "pose depth", number)
        for start in range(0, max(1, clip.frames - SHORTEST + 1), LENGTH):
            part = clip.window(start, min(LENGTH, clip.frames - start))
            if part.frames < SHORTEST:
                continue
            for _ in range(views):
                height = rng.uniform(*HEIGHTS[int(rng.integers(2))])
                slope = np.tan(np.radians(FOV) / 2) * np.exp(FOCALS * rng.standard_normal())
                seen = varied(part, others, rng) if vary else part
                video = film(
                    reproportioned(seen, rng),
                    int(rng.integers(2**31)),
                    azimuth=rng.uniform(0, 2 * np.pi),
                    height=height,
                    fov=np.degrees(2 * np.arctan(slope)),
                )
                arguments, target = example(video)
                inputs.append(relative_keypoints(*arguments))
                targets.append(target)
    return DepthExamples(inputs, targets)


def example(video: Video) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the arguments of ``relative_keypoints`` and the targets of a video."""
    step = round(FPS / RATE)
    keypoints = averaged(person_keypoints(video.track), step)
    joints = list(KEYPOINTS)
    visible = keypoints.weight[:, joints] > 0
    path = body_path(keypoints)
    frames = len(visible)
    positions = video.motion.positions[: frames * step]
    mean = from_hips(positions.reshape(frames, step, -1, 3).mean(axis=1))[:, joints]
    rays = rays_to(path.middle, video.camera)
    depth = np.einsum("fji,fi->fj", mean, rays)
    pitch = np.arcsin(rays[:, 1])
    targets = np.concatenate([depth, pitch[:, None]], axis=1)
    return (keypoints.points[:, joints], visible, *path), targets


def rays_to(pixels: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return the unit vectors from a level camera to pixels, in the axes of ``Video.motion``."""
    pitch = -camera.elevation[0]
    level = LevelCamera(float(camera.focal[0]), tuple(camera.centre[0]), pitch)
    rays = level.points(level.normalised(pixels), np.ones(len(pixels)))
    unit: np.ndarray = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def varied(clip: Motion, others: Sequence[Motion], rng: np.random.Generator) -> Motion:
    """Return a clip at another speed, in which each arm has probability 1/2 to be another clip's.

    This adds combinations of postures that are in no clip. It is as long as the shorter clip.
    """
    clip = replace(clip, fps=clip.fps * np.exp(rng.uniform(-SPEEDS, SPEEDS))).resample(FPS)
    other = others[int(rng.integers(len(others)))]
    frames = min(clip.frames, other.frames)
    other = other.window(int(rng.integers(other.frames - frames + 1)), frames)
    clip = clip.window(0, frames)
    positions = clip.positions.copy()
    turn = chest(clip) @ chest(other).swapaxes(1, 2)
    names = clip.skeleton.joint_names
    for side in ("left", "right"):
        if rng.random() < 0.5:
            continue
        limb = [names.index(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist")]
        for parent, joint in pairwise(limb):
            old, new = (x.positions[:, joint] - x.positions[:, parent] for x in (clip, other))
            length, given = (np.linalg.norm(x, axis=1, keepdims=True) for x in (old, new))
            bone = (turn @ (new * length / given)[..., None])[..., 0]
            positions[:, joint] = positions[:, parent] + bone
    return replace(clip, positions=positions)


def chest(clip: Motion) -> np.ndarray:
    """Return the axes of the chest in every frame, to the left, up and forward: (L, 3, 3)."""
    names = clip.skeleton.joint_names
    left, right, neck, pelvis = (
        clip.positions[:, names.index(name)]
        for name in ("left_shoulder", "right_shoulder", "neck", "pelvis")
    )
    across = left - right
    forward = np.cross(across, neck - pelvis)
    axes = np.stack([across, np.cross(forward, across), forward], axis=-1)
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def reproportioned(clip: Motion, rng: np.random.Generator) -> Motion:
    """Return a clip with random lengths of bones, the same on both sides."""
    skeleton = clip.skeleton
    factors = np.exp(PROPORTIONS * rng.standard_normal(skeleton.n_joints))
    factors = factors[np.minimum(np.arange(skeleton.n_joints), skeleton.mirrored_order)]
    positions = clip.positions.copy()
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            bone = clip.positions[:, joint] - clip.positions[:, parent]
            positions[:, joint] = positions[:, parent] + factors[joint] * bone
    return replace(clip, positions=positions)


def errors(network: PoseDepth, clips: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray]:
    """Return each clip's mean absolute errors of depths (mm) and of the rays' pitch (degrees).

    The error of the pitch is that of a weighted mean over each video.
    """
    depths, pitches = [], []
    for number, clip in enumerate(clip for clip in clips if clip.frames >= SHORTEST):
        for view, height in enumerate((1.0, 2.2)):
            azimuth = (number + 3 * view) % 8 * np.pi / 4
            part = clip.window(0, min(LENGTH, clip.frames))
            video = film(part, number, azimuth=azimuth, height=height)
            arguments, target = example(video)
            estimate = network.estimate(*arguments, RATE)
            depths.append(1000 * np.abs(estimate.depth - target[:, :-1]).mean())
            error = estimate.pitch - target[:, -1]
            error = np.average(error, weights=estimate.pitch_spread**-2)
            pitches.append(np.degrees(abs(error)))
    by_clip = [np.reshape(values, (-1, 2)).mean(axis=1) for values in (depths, pitches)]
    return by_clip[0], by_clip[1]


if __name__ == "__main__":
    main()
