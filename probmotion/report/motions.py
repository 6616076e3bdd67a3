"""The motions of one problem as numbers for its page: few draws, at one place, in few bytes."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from probmotion.comparison.results.stored_problems import StoredProblem
from probmotion.interaction.geometry.coordinates import align_motions
from probmotion.plots.skeletons import _facing, _sides

__all__ = ["Shown", "choose_draws", "motion_numbers"]

_HEADING = np.pi / 2 - 0.35
"""Where bodies face that nothing says the heading of, radians."""
_LARGEST = np.iinfo(np.int16).max
_TILT = 0.3
"""How far a view may be raised, radians, before a body leaves the height of its place."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What the players of one problem show.

    Parameters
    ----------
    problem : StoredProblem
        The skeleton, truth and evidence.
    rows : mapping of str to ndarray, (n, L, J, 3)
        Motions by label, metres; the first row sets the scale.
    step : int
        Every so many frames are shown.
    """

    problem: StoredProblem
    rows: Mapping[str, np.ndarray]
    step: int = 1

    @property
    def frames(self) -> int:
        """Frames that are shown."""
        return -(-next(iter(self.rows.values())).shape[1] // self.step)


def choose_draws(motions: np.ndarray, n: int) -> np.ndarray:
    """Return n of many draws, far apart: neighbours in a chain look alike."""
    return motions[:: max(1, len(motions) // n)][:n]


def motion_numbers(shown: Shown) -> dict[str, Any]:
    """Return what players.js draws, as what JSON can hold.

    With evidence, all bodies of a frame are moved by the same way, so that the middle body stays in
    the middle and errors of place are seen. Without, each body stays in the middle and is turned to
    the same heading; single poses are turned to the first.
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
        rows = _unplaced(rows, shown)
    data: dict[str, Any] = {
        "fps": problem.fps / step,
        "frames": shown.frames,
        "joints": skeleton.n_joints,
        "bones": [(*bone, _SIDES[side]) for bone, side in _sided(problem)],
        "columns": max(map(len, rows.values())),
        "azimuth": 0.6,
        "rows": [[_coded(motion) for motion in motions] for motions in rows.values()],
        "truth": None if truth is None else _coded(truth),
        "dots": None,
        "keypoints": None,
        "camera": None,
    }
    data |= _extent(next(iter(rows.values())) if truth is None else np.concatenate(
        [next(iter(rows.values())), truth[None]]))  # fmt: skip
    if problem.joints is not None:
        assert path is not None
        data["dots"] = _text((problem.joints[::step] - path[:, None]).astype("<f4"))
    if problem.camera is not None:
        assert path is not None
        data |= _filmed(problem, step)
        data["anchor"] = np.round(path[:, [0, 2]], 4).tolist()
    return data


_SIDES = {"middle": "ink", "left": "left", "right": "right"}
"""The colour of a side, as page.css calls it."""


def _sided(problem: StoredProblem) -> list[tuple[tuple[int, int], str]]:
    sides = _sides(problem.skeleton)
    return [(bone, sides[bone[0]]) for bone in problem.skeleton.bones]


def _unplaced(rows: Mapping[str, np.ndarray], shown: Shown) -> dict[str, np.ndarray]:
    """Each body in the middle of its place; poses turned to the first, motions to one heading."""
    skeleton = shown.problem.skeleton
    roots = list(skeleton.roots)
    moved = {}
    first = next(iter(rows.values()))[0]
    for label, motions in rows.items():
        if motions.shape[1] == 1:
            motions = align_motions(motions, first)
        elif skeleton.mirrored_pairs:
            motions = _facing(motions, skeleton, _HEADING)
        middle = motions[:, :, roots].mean(axis=2, keepdims=True)
        moved[label] = motions - middle * [1.0, 0.0, 1.0]
    return moved


def _extent(first: np.ndarray) -> dict[str, float]:
    """What of the world a place shows, metres: the first row's."""
    reach = 1.05 * float(np.quantile(np.hypot(first[..., 0], first[..., 2]), 0.99)) + 1e-9
    low, high = float(first[..., 1].min()), float(first[..., 1].max())
    return {
        "low": round(low, 3),
        "middle": round((low + high) / 2, 3),
        "reach": round(reach, 3),
        "across": round(2.1 * reach, 3),
        "up": round(1.05 * (high - low) + 2 * reach * np.sin(_TILT), 3),
    }


def _filmed(problem: StoredProblem, step: int) -> dict[str, Any]:
    camera = problem.camera
    assert camera is not None
    assert camera.centre is not None
    seen = None if problem.keypoints is None else _text(problem.keypoints[::step].astype("<f4"))
    return {
        # Beside the camera, where what it does not show is seen.
        "azimuth": round(float(camera.azimuth[0]) + 1.0, 4),
        "keypoints": seen,
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


def _coded(motion: np.ndarray) -> dict[str, Any]:
    """Whole units of a motion, millimetres unless it leaves what 16 bits hold."""
    unit = max(1, int(np.ceil(1000 * np.abs(motion).max() / _LARGEST)))
    return {"unit": unit, "numbers": _text(np.rint(1000 * motion / unit).astype("<i2"))}


def _text(numbers: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(numbers).tobytes()).decode("ascii")
