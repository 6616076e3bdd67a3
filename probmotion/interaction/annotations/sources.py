"""Annotations drawn from 3D motions: the pictures that a study with known truth is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from probmotion import seeds
from probmotion.interaction.annotations.annotations import Annotations
from probmotion.interaction.annotations.local_frames import frames_are_sound, pair_frames, trees
from probmotion.interaction.annotations.views import view_angles
from probmotion.motion.motion import Motion
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_count, check_finite, check_shape

__all__ = ["ELEVATIONS", "DrawnAnnotations", "draw_annotations", "world_axes"]

ELEVATIONS = (np.radians(-10.0), np.radians(40.0))
"""Least and greatest elevation of a random camera, radians above the horizon."""


@dataclass(frozen=True, eq=False)
class DrawnAnnotations:
    """Annotations, and the truth behind them.

    Attributes
    ----------
    annotations : Annotations
        The pictures of n frames.
    views : ndarray, (n, 2)
        Their true views (φ, θ) in the pairs' own frames, radians.
    world_views : ndarray, (n, 2)
        Azimuth and elevation of the cameras, radians.
    clips, frames : ndarray, (n,), int
        Which motion, and which of its frames.
    positions : ndarray, (n, J, 3)
        The pose-pairs, metres.
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
    """Return pictures of n different frames, drawn at random from all frames of all motions.

    Parameters
    ----------
    motions : sequence of Motion
        Clips of one skeleton and one frame rate.
    n : int
        Number of annotations, at most the number of frames.
    seed : int
        Of the frames, the views, the noise and the hidden joints.
    frames : sequence of ndarray, (L,) bool, optional
        Which frames of each clip may be drawn; all by default. Their neighbours need not be.
    world_views : ndarray, (n, 2), optional
        Azimuth (0 looks at the scene from +Z, a quarter turn from +X) and elevation of each
        camera, radians. By default the azimuth is uniform on the circle and the elevation
        uniform between -10 and 40 degrees (:data:`ELEVATIONS`).
    known_views : bool
        Whether the annotations carry their true views.
    noise : float
        Standard deviation of independent noise on every coordinate, neighbours too, metres.
    hidden : float
        Share of the joints of each character, below 1, that are hidden, drawn anew for each
        annotation; in its neighbours the same joints are hidden.

    Raises
    ------
    ValueError
        If there are too few frames, clips differ in skeleton or rate, or the frame of a drawn
        pair is degenerate (which clip and frame).
    """
    skeleton, fps = _common(motions)
    check_count("n", n)
    rng = {
        name: seeds.generator(seed, "annotations", name)
        for name in ("frames", "views", "noise", "hidden")
    }
    clips, numbers = _drawn_frames(motions, n, frames, rng["frames"])
    if world_views is None:
        share = rng["views"].random((n, 2))
        low = np.array([-np.pi, ELEVATIONS[0]])
        world_views = low + share * (np.array([np.pi, ELEVATIONS[1]]) - low)
    world_views = np.asarray(world_views, dtype=np.float64)
    check_shape("world_views", world_views, (n, 2))
    check_finite("world_views", world_views)

    axes = world_axes(world_views)
    poses = _with_neighbours(motions, clips, numbers)
    local = pair_frames(poses[:, 1], skeleton)
    sound = frames_are_sound(local)
    if not sound.all():
        first = int(np.argmin(sound))
        raise ValueError(
            f"motions has a degenerate pair in frame {numbers[first]} of clip {clips[first]}, "
            "expected roots apart and backbones not along them"
        )
    views = view_angles(local, axes[:, 2])
    visible = _visible(n, skeleton, hidden, rng["hidden"])
    pictures = _pictures(poses, axes, noise, rng["noise"])
    pictures = np.where(visible[:, np.newaxis, :, np.newaxis], pictures, np.nan)
    annotations = Annotations(
        pictures[:, 1],
        visible,
        skeleton,
        pictures[:, [0, 2]],
        fps,
        views=views if known_views else None,
        sources=[motions[clip].name for clip in clips],
    )
    return DrawnAnnotations(annotations, views, world_views, clips, numbers, poses[:, 1])


def world_axes(world_views: np.ndarray) -> np.ndarray:
    """Return image axes right, up and towards the viewer, as rows: ``(n, 2) → (n, 3, 3)``."""
    azimuth, elevation = np.asarray(world_views, dtype=np.float64).T
    sin_a, cos_a, sin_e, cos_e = (
        np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    )  # fmt: skip
    right = np.stack([cos_a, 0 * cos_a, -sin_a], axis=-1)
    towards = np.stack([cos_e * sin_a, sin_e, cos_e * cos_a], axis=-1)
    return np.stack([right, np.cross(towards, right), towards], axis=1)


def _common(motions: Sequence[Motion]) -> tuple[Skeleton, float]:
    if len(motions) == 0:
        raise ValueError("motions must contain at least one clip, got none")
    skeleton, fps = motions[0].skeleton, motions[0].fps
    for number, motion in enumerate(motions):
        if motion.skeleton != skeleton:
            raise ValueError(
                f"motions[{number}] has other joints than the first, expected the same"
            )
        if motion.fps != fps:
            raise ValueError(
                f"motions[{number}] has {motion.fps:g} frames per second and the first {fps:g}, "
                "expected the same: resample it"
            )
    return skeleton, fps


def _drawn_frames(
    motions: Sequence[Motion],
    n: int,
    frames: Sequence[np.ndarray] | None,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Return clip and frame number of n frames, each at most once."""
    if frames is None:
        frames = [np.ones(motion.frames, dtype=bool) for motion in motions]
    if len(frames) != len(motions):
        raise ValueError(f"frames has {len(frames)} entries, expected {len(motions)}, one per clip")
    for number, (motion, chosen) in enumerate(zip(motions, frames, strict=True)):
        check_shape(f"frames[{number}]", chosen, (motion.frames,))
        if chosen.dtype != np.bool_:
            raise ValueError(f"frames[{number}] is of {chosen.dtype}, expected bool")
    clips = np.repeat(np.arange(len(frames)), [int(chosen.sum()) for chosen in frames])
    numbers = np.concatenate([np.flatnonzero(chosen) for chosen in frames])
    if n > len(clips):
        raise ValueError(f"n must be at most the {len(clips)} frames to draw from, got {n}")
    drawn = rng.permutation(len(clips))[:n]
    return clips[drawn], numbers[drawn]


def _pictures(
    poses: np.ndarray, axes: np.ndarray, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """Return what cameras see of poses, with noise: ``(n, 3, J, 3) → (n, 3, J, 2)``."""
    if not (np.isfinite(noise) and noise >= 0):
        raise ValueError(f"noise must be a finite number of at least 0, got {noise!r}")
    pictures = np.einsum("nai,ntji->ntja", axes[:, :2], poses)
    return pictures + noise * rng.standard_normal(pictures.shape)


def _with_neighbours(
    motions: Sequence[Motion], clips: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Return positions before, at and after each frame, NaN beyond the ends: ``(n, 3, J, 3)``."""
    first = motions[0].positions
    poses = np.full((len(clips), 3, *first.shape[1:]), np.nan)
    for number, motion in enumerate(motions):
        (rows,) = np.nonzero(clips == number)
        for slot, offset in enumerate((-1, 0, 1)):
            at = frames[rows] + offset
            inside = (at >= 0) & (at < motion.frames)
            poses[rows[inside], slot] = motion.positions[at[inside]]
    return poses


def _visible(n: int, skeleton: Skeleton, hidden: float, rng: np.random.Generator) -> np.ndarray:
    """Return which joints are seen, the same number hidden of each character: ``(n, J)``."""
    if not 0 <= hidden < 1:
        raise ValueError(f"hidden must be a share from 0 to below 1, got {hidden!r}")
    visible = np.ones((n, skeleton.n_joints), dtype=bool)
    order = rng.random((n, skeleton.n_joints))
    for root in skeleton.roots:
        (joints,) = np.nonzero(np.equal(trees(skeleton), root))
        count = min(round(hidden * len(joints)), len(joints) - 1)
        ranks = np.argsort(np.argsort(order[:, joints], axis=-1), axis=-1)
        visible[:, joints] = ranks >= count
    return visible
