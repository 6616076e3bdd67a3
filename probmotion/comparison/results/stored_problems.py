"""Truth, observations and reference draws of a problem, stored for the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.files import check_format, read_arrays, written_whole
from probmotion.geometry.cameras import Cameras
from probmotion.motion.skeleton import Skeleton
from probmotion.posteriors.likelihoods import Joints3D, Keypoints2D
from probmotion.posteriors.problem import Problem
from probmotion.validation import check_count

__all__ = ["StoredProblem", "read_stored", "store_problem"]

_FILE = "problem.npz"
_ARRAYS = ("truth", "reference", "held_out", "keypoints", "joints")
_CAMERA = ("rotation", "translation", "focal", "centre", "orthographic")


@dataclass(frozen=True, eq=False)
class StoredProblem:
    """Data of a problem for the figures and the report.

    Parameters
    ----------
    skeleton : Skeleton
        Skeleton of the motions.
    fps : float
        Frames per second.
    has_observations : bool
        Whether the posterior has observations of any kind.
    truth : ndarray, (L, J, 3), optional
        True motion, metres.
    reference : ndarray, (n, L, J, 3), optional
        Reference draws, metres.
    held_out : ndarray, (n, L, J, 3), optional
        Held-out real motions, metres.
    camera : Cameras, optional
        First camera, as a batch of one.
    keypoints : ndarray, (L, J, 2), optional
        Keypoints of that camera in image units; NaN where occluded.
    joints : ndarray, (L, J, 3), optional
        Noisy 3D joints, metres; NaN where occluded.
    """

    skeleton: Skeleton
    fps: float
    has_observations: bool = False
    truth: np.ndarray | None = None
    reference: np.ndarray | None = None
    held_out: np.ndarray | None = None
    camera: Cameras | None = None
    keypoints: np.ndarray | None = None
    joints: np.ndarray | None = None

    @classmethod
    def of(cls, problem: Problem, draws: int = 8, seed: int = 0) -> StoredProblem:
        """Return the stored form of a problem with at most ``draws`` reference draws."""
        check_count("draws", draws)
        posterior, likelihood = problem.posterior, problem.posterior.likelihood
        camera = keypoints = joints = held_out = None
        if isinstance(likelihood, Keypoints2D):
            camera = likelihood.cameras.view(0)
            visible = likelihood.entries.visible[0]
            keypoints = np.where(visible[..., None], likelihood.keypoints[0], np.nan)
        elif isinstance(likelihood, Joints3D):
            joints = np.where(likelihood.entries.visible[..., None], likelihood.joints, np.nan)
        if problem.held_out is not None:
            held_out = problem.held_out[:: max(1, len(problem.held_out) // draws)][:draws]
        return cls(
            skeleton=posterior.skeleton,
            fps=float(posterior.fps),
            has_observations=likelihood is not None,
            truth=problem.truth,
            reference=problem.reference(seed, draws) if problem.has_reference else None,
            held_out=held_out,
            camera=camera,
            keypoints=keypoints,
            joints=joints,
        )


def store_problem(problem: Problem, folder: str | Path, draws: int = 8, seed: int = 0) -> None:
    """Write the stored form of a problem into ``folder``, creating it if necessary.

    ``seed`` selects the reference draws.

    Raises
    ------
    OSError
        If the folder cannot be written to.
    """
    stored = StoredProblem.of(problem, draws, seed)
    arrays: dict[str, np.ndarray] = {
        "format": np.array(1),
        "joint_names": np.array(stored.skeleton.joint_names),
        "parents": np.array(stored.skeleton.parents),
        "fps": np.array(stored.fps),
        "has_observations": np.array(stored.has_observations),
    }
    for name in _ARRAYS:
        if (array := getattr(stored, name)) is not None:
            arrays[name] = np.asarray(array, dtype=np.float32)
    if stored.camera is not None:
        arrays |= {f"camera_{name}": np.asarray(getattr(stored.camera, name)) for name in _CAMERA}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with written_whole(folder / _FILE) as unfinished, open(unfinished, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_stored(folder: str | Path) -> StoredProblem | None:
    """Read the stored problem in ``folder``; return None if there is none.

    Raises
    ------
    ValueError
        If the file is damaged.
    """
    path = Path(folder) / _FILE
    if not path.exists():
        return None
    try:
        arrays = read_arrays(path)
        check_format(arrays)
        camera = None
        if "camera_rotation" in arrays:
            numbers: dict[str, Any] = {name: arrays[f"camera_{name}"] for name in _CAMERA}
            camera = Cameras(**numbers | {"orthographic": bool(numbers["orthographic"])})
        skeleton = Skeleton(arrays["joint_names"].tolist(), arrays["parents"].tolist())
        return StoredProblem(
            skeleton,
            float(arrays["fps"]),
            bool(arrays["has_observations"]),
            camera=camera,
            **{name: arrays[name].astype(np.float64) for name in _ARRAYS if name in arrays},
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged: {str(error)[:200]}") from error
