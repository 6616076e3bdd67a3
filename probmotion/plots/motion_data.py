"""Encoding of motions for browser animations."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem
from probmotion.geometry.cameras import Cameras
from probmotion.interaction.geometry.coordinates import align_motions
from probmotion.motion.skeleton import Skeleton
from probmotion.plots.skeletons import face_heading, head_joints, joint_sides

__all__ = ["Shown", "choose_draws", "motion_numbers"]

# Common heading of bodies without observations or truth, radians.
_HEADING = np.pi / 2 - 0.35
_LARGEST = np.iinfo(np.int16).max
# Largest elevation of the view, radians, at which a body is not clipped.
_TILT = 0.3
# Name of each side's colour in the style sheet.
_SIDES = {"middle": "ink", "left": "left", "right": "right"}
# Diameter of a limb and radius of a head, relative to the sum of all bone lengths.
_LIMB, _HEAD_RADIUS = 0.019, 0.026
_MAX_OVERLAID = 4  # Maximum number of overlaid draws.


@dataclass(frozen=True, eq=False)
class Shown:
    """Motions of an animation: ``rows`` (n, L, J, 3) by label, metres, every ``step``-th frame.

    The first row determines the scale. If ``turned`` and the problem has no observations or truth,
    motions are rotated to a common heading and single poses are aligned with the first pose. If
    ``overlaid``, draws of a row are shown on top of each other, and colours of the first draw are
    standard deviations over all draws, or those of ``sds`` (L, J, 3) by label, metres; the first
    two rows determine the scale. The ``floor`` is at the lowest joint or at a height, metres.
    """

    problem: StoredProblem
    rows: Mapping[str, np.ndarray]
    step: int = 1
    turned: bool = True
    overlaid: bool = False
    sds: Mapping[str, np.ndarray] = field(default_factory=dict)
    floor: float | None = None

    @property
    def frames(self) -> int:
        """Number of frames of the animation."""
        return -(-int(next(iter(self.rows.values())).shape[1]) // self.step)


def choose_draws(motions: np.ndarray, n: int) -> np.ndarray:
    """Return n evenly spaced draws, because consecutive draws of a chain are correlated.

    They are a copy, which does not keep the other draws in memory.
    """
    return motions[:: max(1, len(motions) // n)][:n].copy()


def motion_numbers(shown: Shown) -> dict[str, Any]:
    """Return the JSON-serialisable input of animation.js.

    With observations or a truth, all bodies of a frame are translated equally, so that
    position errors remain visible. Otherwise each body is centred.
    """
    problem, step = shown.problem, shown.step
    skeleton = problem.skeleton
    rows = {label: motions[:, ::step] for label, motions in shown.rows.items()}
    truth = None if problem.truth is None else problem.truth[::step]
    path = None
    if problem.camera is not None or problem.joints is not None or truth is not None:
        first = next(iter(rows.values())) if truth is None else truth[None]
        path = first[:, :, list(skeleton.roots)].mean(axis=(0, 2)) * [1.0, 0.0, 1.0]
        rows = {label: motions - path[:, None] for label, motions in rows.items()}
        truth = None if truth is None else truth - path[:, None]
    else:
        rows = _centred(rows, shown)
    scaling = [*rows.values()][: 2 if shown.overlaid else 1]
    sides = joint_sides(skeleton)
    sds: list[np.ndarray | None] = [None] * len(rows)
    if shown.overlaid:
        sds = [
            _joint_sd(shown.sds[label][::step]) if label in shown.sds else _sd_of_draws(motions)
            for label, motions in rows.items()
        ]
        rows = {label: motions[:_MAX_OVERLAID] for label, motions in rows.items()}
    length = np.mean([_total_bone_length(motions, skeleton) for motions in scaling])
    data: dict[str, Any] = {
        "fps": problem.fps / step,
        "frames": shown.frames,
        "joints": skeleton.n_joints,
        "bones": [(*bone, _SIDES[sides[bone[0]]]) for bone in skeleton.bones],
        "head": head_joints(skeleton),
        "thickness": round(_LIMB * length, 4),
        "headRadius": round(_HEAD_RADIUS * length, 4),
        "overlaid": shown.overlaid,
        "sds": [None if sd is None else _base64(np.rint(sd).astype("<i2")) for sd in sds],
        "largestSd": _largest(sds),
        "columns": 1 if shown.overlaid else max(map(len, rows.values())),
        "azimuth": 0.6,
        "rows": [[_encoded(motion) for motion in motions] for motions in rows.values()],
        "truth": None if truth is None else _encoded(truth),
        "dots": None,
        "keypoints": None,
        "camera": None,
        **_extent(np.concatenate(scaling if truth is None else [*scaling, truth[None]])),
    }
    if shown.floor is not None:
        data["low"] = shown.floor
    if path is not None and problem.joints is not None:
        data["dots"] = _base64((problem.joints[::step] - path[:, None]).astype("<f4"))
    if path is not None and problem.camera is not None:
        data |= _camera(problem.camera, problem.keypoints, step)
        data["anchor"] = np.round(path[:, [0, 2]], 4).tolist()
    return data


def _sd_of_draws(motions: np.ndarray) -> np.ndarray | None:
    """Return the standard deviation of each joint's position, (L, J), millimetres."""
    return None if len(motions) < 2 else _joint_sd(motions.std(axis=0, ddof=1))


def _joint_sd(sd: np.ndarray) -> np.ndarray:
    """Return the standard deviation of positions, (L, J), mm, from coordinates' (L, J, 3), m."""
    return np.asarray(1000 * np.sqrt((sd**2).sum(axis=-1)))


def _largest(sds: Sequence[np.ndarray | None]) -> float:
    """Return the end of the colour scale, a multiple of 20 mm: 1.5 times the sd of the first row.

    Overconfident rows then have the colours of small values, underconfident ones of large values.
    """
    first = next((sd for sd in sds if sd is not None), np.zeros(1))
    return 20.0 * max(1.0, float(np.ceil(1.5 * np.quantile(first, 0.95) / 20)))


def _total_bone_length(motions: np.ndarray, skeleton: Skeleton) -> float:
    """Return the mean over frames of the sum of bone lengths of one body, metres."""
    child, parent = np.array(skeleton.bones).T
    lengths = np.linalg.norm(motions[:, :, child] - motions[:, :, parent], axis=-1)
    return float(lengths.sum(axis=-1).mean()) / len(skeleton.roots)


def _centred(rows: Mapping[str, np.ndarray], shown: Shown) -> dict[str, np.ndarray]:
    """Return horizontally centred bodies, rotated to a common heading if requested."""
    skeleton = shown.problem.skeleton
    moved = {}
    first = next(iter(rows.values()))[0]
    for label, motions in rows.items():
        if shown.turned and motions.shape[1] == 1:
            motions = align_motions(motions, first)
        elif shown.turned and skeleton.mirrored_pairs:
            motions = face_heading(motions, skeleton, _HEADING)
        middle = motions[:, :, list(skeleton.roots)].mean(axis=2, keepdims=True)
        moved[label] = motions - middle * [1.0, 0.0, 1.0]
    return moved


def _extent(motions: np.ndarray) -> dict[str, float]:
    """Return the visible range of coordinates, metres."""
    reach = 1.05 * float(np.quantile(np.hypot(motions[..., 0], motions[..., 2]), 0.99)) + 1e-9
    low, high = float(motions[..., 1].min()), float(motions[..., 1].max())
    return {
        "low": round(low, 3),
        "middle": round((low + high) / 2, 3),
        "reach": round(reach, 3),
        "across": round(2.1 * reach, 3),
        "up": round(1.05 * (high - low) + 2 * reach * np.sin(_TILT), 3),
    }


def _camera(camera: Cameras, keypoints: np.ndarray | None, step: int) -> dict[str, Any]:
    assert camera.centre is not None
    return {
        # View from beside the camera, where depth is visible.
        "azimuth": round(float(camera.azimuth[0]) + 1.0, 4),
        "keypoints": None if keypoints is None else _base64(keypoints[::step].astype("<f4")),
        "camera": {
            "rotation": np.round(camera.rotation[0], 9).tolist(),
            "translation": camera.translation[0].tolist(),
            "focal": float(camera.focal[0]),
            "centre": camera.centre[0].tolist(),
            "perspective": not camera.orthographic,
            "azimuth": float(camera.azimuth[0]),
            "elevation": float(camera.elevation[0]),
        },
    }


def _encoded(motion: np.ndarray) -> dict[str, Any]:
    """Return a motion as 16-bit multiples of a unit: 1 mm, or more if values would overflow."""
    unit = max(1, int(np.ceil(1000 * np.abs(motion).max() / _LARGEST)))
    return {"unit": unit, "numbers": _base64(np.rint(1000 * motion / unit).astype("<i2"))}


def _base64(numbers: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")
