"""Simulated 2D annotations of 3D motions, with known ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.local_frames import joint_roots, pair_frames, valid_frames
from probmotion.interaction.annotations.views import view_angles
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_not_negative, check_shape

__all__ = ["ELEVATIONS", "DrawnAnnotations", "draw_annotations", "world_axes"]

ELEVATIONS = (np.radians(-10.0), np.radians(40.0))
"""Range of random camera elevations, radians above the horizon."""


@dataclass(frozen=True, eq=False)
class DrawnAnnotations:
    """Simulated annotations and their ground truth.

    Attributes
    ----------
    annotations : Annotations
        Annotations of n frames.
    views : ndarray, (n, 2)
        True views (φ, θ) in the local frames, radians.
    world_views : ndarray, (n, 2)
        Azimuth and elevation of the cameras, radians.
    clips, frames : ndarray of int, (n,)
        Index of each annotation's motion, and of the frame within the motion.
    positions : ndarray, (n, J, 3)
        3D pose-pairs, metres.
    """

    annotations: Annotations
    views: np.ndarray
    world_views: np.ndarray
    clips: np.ndarray
    frames: np.ndarray
    positions: np.ndarray


def draw_annotations(
    motions: Sequence[Motion],
    n: int,
    seed: int,
    *,
    frames: Sequence[np.ndarray] | None = None,
    world_views: np.ndarray | None = None,
    known_views: bool = False,
    noise: float = 0.0,
    hidden: float = 0.0,
) -> DrawnAnnotations:
    """Simulate annotations of n distinct frames, drawn uniformly from all motions.

    Parameters
    ----------
    motions : sequence of Motion
        Clips of one skeleton and one frame rate.
    n : int
        Number of annotations, at most the number of frames.
    seed : int
        Seed of the frames, views, noise and occlusions.
    frames : sequence of ndarray, (L,) bool, optional
        Mask of the frames to draw from in each clip; all by default.
    world_views : ndarray, (n, 2), optional
        Azimuth (0: camera on the +Z side, π/2: +X side) and elevation of each camera, radians. By
        default, azimuths are uniform on the circle and elevations on :data:`ELEVATIONS`.
    known_views : bool
        Whether the annotations include their true views.
    noise : float
        Standard deviation of the Gaussian noise of all coordinates, also in the neighbours (the
        previous and the next frame), metres.
    hidden : float
        Fraction of each person's joints that are occluded, below 1. The joints are drawn for each
        annotation and are also occluded in its neighbours.
    """
    skeleton, fps = _common(motions)
    check_count("n", n)
    check_not_negative("noise", noise)
    frame_rng, view_rng, noise_rng, hidden_rng = (
        seeds.generator(seed, "annotations", name)
        for name in ("frames", "views", "noise", "hidden")
    )
    clips, numbers = _drawn_frames(motions, n, frames, frame_rng)
    if world_views is None:
        low, high = np.array([(-np.pi, np.pi), ELEVATIONS]).T
        world_views = low + view_rng.random((n, 2)) * (high - low)
    world_views = np.asarray(world_views, dtype=np.float64)
    check_shape("world_views", world_views, (n, 2))
    check_finite("world_views", world_views)

    axes = world_axes(world_views)
    poses = _with_neighbours(motions, clips, numbers)
    local = pair_frames(poses[:, 1], skeleton)
    valid = valid_frames(local)
    if not valid.all():
        first = int(np.argmin(valid))
        raise ValueError(
            "motions must have distinct roots and backbones not parallel to the line between them, "
            f"got a degenerate pair in frame {numbers[first]} of clip {clips[first]}"
        )
    views = view_angles(local, axes[:, 2])
    visible = _visible(n, skeleton, hidden, hidden_rng)
    projections = np.einsum("nai,ntji->ntja", axes[:, :2], poses)
    projections = projections + noise * noise_rng.standard_normal(projections.shape)
    projections = np.where(visible[:, np.newaxis, :, np.newaxis], projections, np.nan)
    annotations = Annotations(
        projections[:, 1],
        visible,
        skeleton,
        projections[:, [0, 2]],
        fps,
        views=views if known_views else None,
        sources=[motions[clip].name for clip in clips],
    )
    return DrawnAnnotations(annotations, views, world_views, clips, numbers, poses[:, 1])


def world_axes(world_views: np.ndarray) -> np.ndarray:
    """Return the camera axes right, up and towards the viewer as rows: ``(n, 2) → (n, 3, 3)``."""
    azimuth, elevation = np.asarray(world_views, dtype=np.float64).T
    sine, cosine, horizontal = np.sin(azimuth), np.cos(azimuth), np.cos(elevation)
    right = np.stack([cosine, 0 * cosine, -sine], axis=-1)
    towards = np.stack([horizontal * sine, np.sin(elevation), horizontal * cosine], axis=-1)
    return np.stack([right, np.cross(towards, right), towards], axis=1)


def _common(motions: Sequence[Motion]) -> tuple[Skeleton, float]:
    if len(motions) == 0:
        raise ValueError("motions must contain at least one clip, got none")
    skeleton, fps = motions[0].skeleton, motions[0].fps
    for number, motion in enumerate(motions):
        if motion.skeleton != skeleton or motion.fps != fps:
            raise ValueError(
                f"motions[{number}] must have the skeleton and frame rate of motions[0], got "
                f"{motion.skeleton.n_joints} joints and {motion.fps:g} frames per second: retarget "
                "or resample it"
            )
    return skeleton, fps


def _drawn_frames(
    motions: Sequence[Motion],
    n: int,
    frames: Sequence[np.ndarray] | None,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the clip and frame indices of n distinct frames."""
    if frames is None:
        frames = [np.ones(motion.frames, dtype=bool) for motion in motions]
    if len(frames) != len(motions):
        raise ValueError(f"frames must have {len(motions)} masks, one per clip, got {len(frames)}")
    for number, (motion, mask) in enumerate(zip(motions, frames, strict=True)):
        check_shape(f"frames[{number}]", mask, (motion.frames,))
        if mask.dtype != np.bool_:
            raise ValueError(f"frames[{number}] must be bool, got {mask.dtype}")
    clips = np.repeat(np.arange(len(frames)), [int(mask.sum()) for mask in frames])
    numbers = np.concatenate([np.flatnonzero(mask) for mask in frames])
    if n > len(clips):
        raise ValueError(f"n must be at most {len(clips)}, the number of frames, got {n}")
    chosen = rng.permutation(len(clips))[:n]
    return clips[chosen], numbers[chosen]


def _with_neighbours(
    motions: Sequence[Motion], clips: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Return positions before, at and after each frame, (n, 3, J, 3); NaN beyond the ends."""
    padded = [
        np.pad(motion.positions, ((1, 1), (0, 0), (0, 0)), constant_values=np.nan)
        for motion in motions
    ]
    return np.stack([padded[c][f : f + 3] for c, f in zip(clips, frames, strict=True)])


def _visible(n: int, skeleton: Skeleton, hidden: float, rng: np.random.Generator) -> np.ndarray:
    """Return a visibility mask (n, J) with a fixed number of occluded joints per person."""
    if not 0 <= hidden < 1:
        raise ValueError(f"hidden must be at least 0 and below 1, got {hidden!r}")
    visible = np.ones((n, skeleton.n_joints), dtype=bool)
    order = rng.random((n, skeleton.n_joints))
    for root in skeleton.roots:
        (joints,) = np.nonzero(np.equal(joint_roots(skeleton), root))
        count = min(round(hidden * len(joints)), len(joints) - 1)
        ranks = np.argsort(np.argsort(order[:, joints], axis=-1), axis=-1)
        visible[:, joints] = ranks >= count
    return visible
