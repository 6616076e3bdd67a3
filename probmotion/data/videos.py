"""Keypoints of made videos: clips filmed by a still pinhole camera, with errors of detectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from probmotion import seeds
from probmotion.geometry.cameras import Cameras
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.motion.motion import KeypointTrack, Motion
from probmotion.motion.skeleton import Skeleton

__all__ = ["Video", "film", "quadruped_as_person"]

_SIZE = 1000  # width and height, pixels
_NOISE = 4.0  # standard deviation, pixels
_OUTLIERS, _FAR = 0.05, 60.0  # their share, and their standard deviation, pixels
_MISSING = 0.1  # share of missing keypoints
_SWAPS, _LONGEST_SWAP = 0.02, 3  # share of frames at which sides are exchanged, and frames
_MARGIN = 0.9  # of the image that the path may fill
_REACH = 1.1  # half of the height that the image shows at least, metres


class Video(NamedTuple):
    """Keypoints of a video and the truth.

    ``track`` contains COCO's keypoints without the face; ``motion`` the true motion on ``person14``
    in the axes right, up and backwards, with the camera at 0; ``size`` width and height;
    ``camera`` is the camera in the world of the clip.
    """

    track: KeypointTrack
    motion: Motion
    size: tuple[int, int]
    camera: Cameras


def film(
    clip: Motion, seed: int, *, azimuth: float, height: float = 1.0, fov: float = 60.0
) -> Video:
    """Film a clip from so far that its whole path is visible.

    Keypoints have Gaussian noise of 4 pixels; 5 % are outliers, 10 % missing, and in some frames
    left and right are exchanged.

    Parameters
    ----------
    clip : Motion
        Motion of a person.
    seed : int
        Seed of the errors.
    azimuth : float
        Rotation of the clip about the vertical, radians.
    height : float
        Height of the camera, metres. It looks at a point 1 m above the floor.
    fov : float
        Field of view, degrees.
    """
    rng = seeds.generator(seed, "film")
    person = clip.retarget(Skeleton.preset("person14"))
    turn = vector_to_matrix(np.array([0.0, azimuth, 0.0]))
    world = person.positions @ turn.T
    ground = world[..., [0, 2]].reshape(-1, 2)
    middle = (ground.max(axis=0) + ground.min(axis=0)) / 2
    reach = np.abs(ground - middle).max(axis=0)
    focal = _SIZE / (2 * np.tan(np.radians(fov) / 2))
    half = _MARGIN * _SIZE / (2 * focal)
    distance = max(reach[0], _REACH) / half + reach[1]
    place = np.array([middle[0], height, middle[1] + distance])
    positions = world - place
    pitch = np.arctan2(1.0 - height, distance)
    forward = np.array([0.0, np.sin(pitch), -np.cos(pitch)])
    up = np.array([0.0, np.cos(pitch), np.sin(pitch)])
    depth = positions @ forward
    pixels = np.stack([positions[..., 0] / depth, -(positions @ up) / depth], axis=-1)
    pixels = focal * pixels + _SIZE / 2
    pixels += _NOISE * rng.standard_normal(pixels.shape)
    far = rng.random(pixels.shape[:2]) < _OUTLIERS
    pixels[far] += _FAR * rng.standard_normal((int(far.sum()), 2))
    seen = rng.random(pixels.shape[:2]) > _MISSING
    seen &= ((pixels >= 0) & (pixels < _SIZE)).all(axis=-1)
    order = list(person.skeleton.mirrored_order)
    for frame in np.flatnonzero(rng.random(len(pixels)) < _SWAPS).tolist():
        rows = slice(frame, frame + int(rng.integers(1, _LONGEST_SWAP + 1)))
        pixels[rows], seen[rows] = pixels[rows][:, order], seen[rows][:, order]
    coco = Skeleton.preset("coco17")
    keypoints = np.full((len(pixels), coco.n_joints, 2), np.nan)
    confidence = np.zeros(keypoints.shape[:2])
    for joint, name in enumerate(coco.joint_names):
        if name in person.skeleton.joint_names:
            origin = person.skeleton.joint_names.index(name)
            keypoints[:, joint] = np.where(seen[:, origin, None], pixels[:, origin], np.nan)
            confidence[:, joint] = seen[:, origin]
    track = KeypointTrack(keypoints, confidence, coco, clip.fps, clip.name)
    truth = Motion(positions, person.skeleton, clip.fps, name=clip.name)
    axes = np.stack([[1.0, 0.0, 0.0], -up, forward])[None]
    centre = np.full((1, 2), _SIZE / 2)
    camera = Cameras(axes @ turn, -axes @ place, np.array([focal]), centre, orthographic=False)
    return Video(track, truth, (_SIZE, _SIZE), camera)


def quadruped_as_person(gait: Motion) -> Motion:
    """Return a made quadruped on ``person14``: its fore legs are called arms."""
    person = Skeleton.preset("person14")
    names = gait.skeleton.joint_names
    own = {"pelvis": "tail", "wrist": "front_paw", "ankle": "back_paw"}
    joints = []
    for name in person.joint_names:
        side, _, part = name.rpartition("_")
        part = own.get(part, part)
        joints.append(names.index(f"{side}_{part}" if side else part))
    return Motion(gait.positions[:, joints], person, gait.fps, name=gait.name)
