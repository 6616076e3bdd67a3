"""Reading of keypoint tracks, in a format recognised by the file's content."""

from __future__ import annotations

from pathlib import Path

from probmotion.io.errors import MotionFileError, csv_rows, shortened
from probmotion.io.keypoints.deeplabcut import find_table, read_csv_table, read_hdf5_table
from probmotion.io.keypoints.detector_json import read_json
from probmotion.io.keypoints.hdf5 import open_hdf5, read_movement, read_sleap
from probmotion.io.keypoints.layouts import keypoint_file
from probmotion.io.keypoints.mediapipe import read_landmark_table
from probmotion.io.keypoints.tracks import KeypointFile
from probmotion.io.npz import read_keypoint_npz
from probmotion.motion.motion import KeypointTrack
from probmotion.motion.skeleton import Skeleton
from probmotion.validation import check_positive

__all__ = ["open_keypoints", "read_keypoints"]

_HDF5 = (".h5", ".hdf5", ".nc", ".slp")


def read_keypoints(
    path: str | Path,
    fps: float | None = None,
    skeleton: Skeleton | str | None = None,
    people: int | None = None,
    image_size: tuple[float, float] | None = None,
) -> list[KeypointTrack]:
    """Read the 2D keypoint tracks of a file, one per person and camera.

    Parameters
    ----------
    path : str or Path
        File or folder; see :func:`open_keypoints`.
    fps : float, optional
        Frames per second; required for files that do not contain it.
    skeleton, people, image_size
        As for :func:`open_keypoints`.

    Raises
    ------
    MotionFileError, FileNotFoundError
        As for :func:`open_keypoints`.
    ValueError
        As for :func:`open_keypoints`; also if ``fps`` is missing.
    """
    file = open_keypoints(path, fps, skeleton, people, image_size)
    if file.fps is None:
        raise ValueError(
            f"fps must be given for {path}, which contains no frame rate, got None; give the "
            "video's (fps=30, --fps 30)"
        )
    return file.tracks


def open_keypoints(
    path: str | Path,
    fps: float | None = None,
    skeleton: Skeleton | str | None = None,
    people: int | None = None,
    image_size: tuple[float, float] | None = None,
) -> KeypointFile:
    """Read a keypoint file and recognise its format by its content.

    Parameters
    ----------
    path : str or Path
        JSON of COCO, AlphaPose, OpenPose, MMPose, RTMPose or MediaPipe Pose; a folder of such
        files of OpenPose or MMPose, one per image; a DeepLabCut table (.csv, .h5); a table of
        MediaPipe landmarks (.csv); a SLEAP analysis file (.h5); a file of movement (.nc); or an
        ``.npz`` archive.
    fps : float, optional
        Frames per second; the file's by default.
    skeleton : Skeleton or str, optional
        Keypoints of a JSON file in the file's order, or the joints to select by name from a file
        with names (DeepLabCut, SLEAP, movement). By default, the layout is recognised by the
        file's names or its number of keypoints.
    people : int, optional
        Number of people to track in a JSON file without track ids; see
        :func:`~probmotion.io.keypoints.tracks.link_people`.
    image_size : (float, float), optional
        Width and height of the image in pixels; required for normalised landmarks of MediaPipe,
        unless the file contains it. Files in pixels do not need it.

    Returns
    -------
    file : KeypointFile
        Format, frame rate, tracks in pixels, and image size.

    Raises
    ------
    MotionFileError
        If the file contains no keypoint track or is damaged, or ``image_size`` is missing.
    FileNotFoundError
        If the file does not exist.
    ValueError
        If ``fps`` is not above 0, ``skeleton`` or ``people`` is not applicable, or ``image_size``
        is not that of the file.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"path must be an existing file, got {path}")
    if fps is not None:
        check_positive("fps", fps)
    if image_size is not None:
        for name, value in zip(("width", "height"), image_size, strict=True):
            check_positive(f"image_size ({name})", value)
    file = _opened(path, fps, skeleton, people, image_size)
    if image_size is not None and file.image_size not in (None, tuple(image_size)):
        raise ValueError(
            f"image_size must be that of {path}, {file.image_size}, got {tuple(image_size)}; "
            "leave it out"
        )
    return file


def _opened(
    path: Path,
    fps: float | None,
    skeleton: Skeleton | str | None,
    people: int | None,
    image_size: tuple[float, float] | None,
) -> KeypointFile:
    """Return the content of a keypoint file; see :func:`open_keypoints`."""
    wanted = Skeleton.preset(skeleton) if isinstance(skeleton, str) else skeleton
    suffix = "" if path.is_dir() else path.suffix.lower()
    archive, table = suffix == ".npz", suffix in (".csv", *_HDF5)
    for name, given, unused in (
        ("people", people, archive or table),
        ("skeleton", skeleton, archive),
    ):
        if given is not None and unused:
            raise ValueError(f"{name} must be None for {path.suffix} files, got {given!r}")
    if archive:
        tracks = read_keypoint_npz(path, fps)
        return KeypointFile("npz archive", tracks[0].fps, tracks)
    if suffix in _HDF5:
        return _open_keypoint_hdf5(path, fps, wanted)
    if suffix != ".csv":
        return read_json(path, fps, wanted, people, image_size)
    rows = csv_rows(path)
    if rows and rows[0][1][0].strip().lower() == "scorer":
        return read_csv_table(rows, path, fps, wanted)
    return keypoint_file(read_landmark_table(rows, path, image_size), path, fps, wanted)


def _open_keypoint_hdf5(path: Path, fps: float | None, skeleton: Skeleton | None) -> KeypointFile:
    with open_hdf5(path) as file:
        table = find_table(file)
        if table is not None:
            return read_hdf5_table(table, path, fps, skeleton)
        if "tracks" in file and "node_names" in file:
            return read_sleap(file, path, fps, skeleton)
        if "position" in file:
            return read_movement(file, path, fps, skeleton)
        seen = ", ".join(f"{name} {getattr(item, 'shape', '')}" for name, item in file.items())
    raise MotionFileError(
        f"{path}: expected a table of DeepLabCut, tracks and node_names of SLEAP's analysis format "
        f"(sleap-convert --format analysis), or position of movement, got {shortened(seen)}"
    )
