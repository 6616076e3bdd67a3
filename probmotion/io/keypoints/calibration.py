"""Reader of Pose2Sim's calibrated cameras (TOML), and its folders of keypoints."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.geometry.cameras import Cameras
from probmotion.geometry.rotations import vector_to_matrix
from probmotion.io.conventions import Z_UP_TO_Y_UP
from probmotion.io.errors import MotionFileError, errors_in, read_bytes, shortened
from probmotion.io.keypoints.tracks import natural
from probmotion.io.recordings import undistorted
from probmotion.validation import check_finite, check_shape

__all__ = ["Calibration", "read_calibration", "view_folders"]

_LAST_ROW = np.array([0.0, 0.0, 1.0])  # of intrinsics
_FOVS = (1.0, 160.0)  # smallest and largest of an image's longer side, degrees
_STAGES = ("pose-associated", "pose-sync", "pose")  # folders of Pose2Sim, the last stage first


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated cameras with lens distortion.

    The world has y up: (x, z, -y) of the file's axes.

    Parameters
    ----------
    names : tuple of str
        Names of the V cameras.
    cameras : Cameras
        Pinhole cameras without distortion.
    matrices : ndarray, (V, 3, 3)
        Intrinsics.
    distortion : ndarray, (V, 5)
        Coefficients k₁, k₂, p₁, p₂, k₃ of the lenses.
    sizes : tuple of (int, int)
        Width and height of the images, pixels.
    """

    names: tuple[str, ...]
    cameras: Cameras
    matrices: np.ndarray
    distortion: np.ndarray
    sizes: tuple[tuple[int, int], ...]

    def undistorted(self, view: int, keypoints: np.ndarray) -> np.ndarray:
        """Return pixels of the pinhole camera: ``(L, J, 2) → (L, J, 2)``."""
        one, camera = [view], self.cameras.view(view)
        return undistorted(keypoints[None], self.matrices[one], self.distortion[one], camera)[0]

    def matched(self, names: Sequence[str]) -> list[int]:
        """Return the index of each recording's camera, by the names of files or folders.

        A name matches if it contains the camera's, the longest of several, or else is contained in
        it. Punctuation and ``json`` are ignored, numbers are compared as a whole: ``trial_cam10``
        does not match ``cam1``. Recordings none of whose names matches are in the order of the
        cameras, if there are as many.

        Raises
        ------
        ValueError
            If some names only match, one matches several cameras, two match one camera, or none
            matches and there are more or fewer recordings than cameras.
        """
        cameras = [_plain(name) for name in self.names]
        found = [_fits(_plain(name), cameras) for name in names]
        matched = [fits[0] for fits in found if len(fits) == 1]
        if len(set(matched)) == len(names):
            return matched
        if not any(found) and len(names) == len(self.names):
            return list(range(len(names)))
        given = [
            self.names[fits[0]] if len(fits) == 1 else "several cameras" if fits else "no camera"
            for fits in found
        ]
        got = ", ".join(
            f"{name or 'no name'} ({what})" for name, what in zip(names, given, strict=True)
        )
        raise ValueError(
            f"keypoints must be named after the calibrated cameras {', '.join(self.names)}, or all "
            f"have other names and be as many in their order, got {got}"
        )


def read_calibration(path: str | Path) -> Calibration:
    """Read the cameras of a TOML file of Pose2Sim.

    Every table with a ``matrix`` is a camera; ``rotation`` (a rotation vector) and ``translation``
    (metres) are from the world, with z up, to the camera.

    Raises
    ------
    MotionFileError
        If the file is no TOML, contains no camera, or a camera is invalid or a fisheye.
    """
    path = Path(path)
    try:
        content = tomllib.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise MotionFileError(f"{path}: expected TOML ({str(error)[:80]})") from error
    tables = {key: value for key, value in content.items() if _is_camera(value)}
    if not tables:
        raise MotionFileError(
            f"{path}: expected cameras (tables with matrix, rotation and translation), got "
            f"{shortened(list(content))}"
        )
    names = tuple(str(table.get("name", key)) for key, table in tables.items())
    if len(set(names)) < len(names):
        raise MotionFileError(f"{path}: expected different names of cameras, got {list(names)}")
    parts = [_camera(table, f"{path}, {key}") for key, table in tables.items()]
    matrices, distortion, rotations, translations, sizes = zip(*parts, strict=True)
    K, R = np.stack(matrices), np.stack(rotations) @ Z_UP_TO_Y_UP.T
    focal = K[:, [0, 1], [0, 1]].mean(axis=1)
    with errors_in(path):
        cameras = Cameras(R, np.stack(translations), focal, K[:, :2, 2], orthographic=False)
    return Calibration(names, cameras, K, np.stack(distortion), sizes)


def view_folders(path: Path) -> list[Path]:
    """Return the folders of keypoints of all cameras in a folder of Pose2Sim, or else the path.

    A trial contains ``pose-associated``, ``pose-sync`` or ``pose``, with a folder of every camera.
    """
    if not path.is_dir():
        return [path]
    stage = next((path / name for name in _STAGES if (path / name).is_dir()), path)
    folders = [folder for folder in stage.iterdir() if any(folder.glob("*.json"))]
    return sorted(folders, key=lambda folder: natural(folder.name)) or [path]


def _plain(name: str) -> str:
    """Return the letters and digits of a name without ``json``, with a space between numbers."""
    spaced = re.sub(r"[^a-z0-9]+", " ", name.lower().replace("json", ""))
    return re.sub(r"(?<!\d) | (?!\d)", "", spaced)


def _fits(name: str, cameras: Sequence[str]) -> list[int]:
    """Return the cameras that a plain name contains, the longest, or else that contain it."""
    contained = [v for v, camera in enumerate(cameras) if _contains(name, camera)]
    if not contained:
        return [v for v, camera in enumerate(cameras) if _contains(camera, name)]
    longest = max(len(cameras[v]) for v in contained)
    return [v for v in contained if len(cameras[v]) == longest]


def _contains(name: str, part: str) -> bool:
    """Return whether a plain name contains another one that splits none of its numbers."""
    edge = r"(?:(?<!\d)|(?!\d))"
    return bool(part) and re.search(f"{edge}{part}{edge}", name) is not None


def _is_camera(table: Any) -> bool:
    return isinstance(table, dict) and "matrix" in table


def _camera(
    table: dict[str, Any], where: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]:
    """Return intrinsics, distortion, rotation, translation and image size of a table."""
    if table.get("fisheye"):
        raise MotionFileError(f"{where}: cameras must not be fisheye, which are not supported")
    matrix = _array(table, "matrix", (3, 3), where)
    odd = matrix[0, 1] or matrix[1, 0] or (matrix[2] != _LAST_ROW).any()
    if odd or not min(matrix[0, 0], matrix[1, 1]) > 0:
        raise MotionFileError(
            f"{where}: matrix must have focal lengths and principal point only, got "
            f"{shortened(matrix.tolist())}"
        )
    vector = _array(table, "rotation", (3,), where)
    translation = _array(table, "translation", (3,), where)
    width, height = _array(table, "size", (2,), where)
    given = table.get("distortions", [])
    count = len(given) if isinstance(given, list) else 0
    distortion = np.zeros(5)
    if given != []:
        if count not in (4, 5):
            raise MotionFileError(f"{where}: distortions must be 4 or 5, got {shortened(given)}")
        distortion[:count] = _array(table, "distortions", (count,), where)
    if not (width >= 1 and height >= 1):
        raise MotionFileError(f"{where}: size must be pixels, got {width:g} × {height:g}")
    size = (round(width), round(height))
    for focal in (matrix[0, 0], matrix[1, 1]):
        fov = np.degrees(2 * np.arctan(max(size) / (2 * focal)))
        if not _FOVS[0] <= fov <= _FOVS[1]:
            raise MotionFileError(
                f"{where}: matrix must have focal lengths in pixels, got {focal:g}, a field of "
                f"view of {fov:.3g}° for {size[0]} × {size[1]}"
            )
    return matrix, distortion, np.asarray(vector_to_matrix(vector)), translation, size


def _array(table: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    with errors_in(where):
        try:
            values = np.array(table.get(key), dtype=float)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{key} must be numbers, got {shortened(table.get(key))}") from None
        check_shape(key, values, shape)
        check_finite(key, values)
    return values
