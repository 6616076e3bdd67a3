"""Readers of keypoint tracks in HDF5: SLEAP analysis files and netCDF files of movement.

SLEAP's datasets are ``tracks``, (tracks, 2, nodes, frames) or in the order of its attribute
``dims``; ``node_names``; and, optionally, ``track_names``, ``point_scores`` and ``edge_inds``.
Movement's variables are ``position`` over the dimensions time, space, keypoints and individuals in
any order, and optionally ``confidence``; the attribute ``fps`` is the frame rate, if known.

Keypoints without a score, such as those labelled by hand, have confidence 1.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.io.errors import LARGEST, MotionFileError, shortened
from probmotion.io.keypoints.tracks import KeypointFile, dense_tracks, named_skeleton
from probmotion.motion.skeleton import Skeleton

__all__ = ["dataset", "numbers_of", "open_hdf5", "read_movement", "read_sleap", "strings_of"]

_MOST_BYTES = 2_000_000_000  # of a dataset; larger sizes indicate a damaged file
_MOST_COMPRESSED = 1100  # largest factor by which gzip compresses
_SLEAP_ORDERS = (("track", "xy", "node", "frame"), ("frame", "node", "xy", "track"))
_MOVEMENT_ORDER = ("individual", "time", "keypoint", "space")


@contextmanager
def open_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file for reading; errors in damaged parts become :class:`MotionFileError`."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            yield file
    except MotionFileError:
        raise
    except Exception as error:  # damaged files raise many types, including MemoryError
        raise MotionFileError(
            f"{path}: expected a readable HDF5 file ({str(error)[:80]})"
        ) from error


def read_sleap(
    file: Any, path: Path, fps: float | None, skeleton: Skeleton | None = None
) -> KeypointFile:
    """Read the keypoint track of every animal in an open SLEAP analysis file.

    ``skeleton`` selects nodes by name; by default, the skeleton is that of ``edge_inds``.

    Raises
    ------
    MotionFileError
        If the file is damaged or lacks a joint of ``skeleton``.
    """
    nodes = strings_of(file, "node_names", path)
    tracks = numbers_of(file, "tracks", 4, path)
    order = _sleap_order(file, tracks.shape, len(nodes), path)
    points = tracks.transpose([order.index(axis) for axis in ("track", "frame", "node", "xy")])
    scores = np.full((*points.shape[:3], 1), np.nan)
    if "point_scores" in file:
        given = numbers_of(file, "point_scores", 3, path)
        kept = [axis for axis in order if axis != "xy"]
        given = given.transpose([kept.index(axis) for axis in ("track", "frame", "node")])
        if given.shape != points.shape[:3]:
            raise MotionFileError(
                f"{path}: expected point_scores of {points.shape[:3]} tracks, frames and nodes, "
                f"got {given.shape}"
            )
        scores = given[..., np.newaxis]
    names = strings_of(file, "track_names", path) if "track_names" in file else []
    if len(names) != len(points):
        names = [f"{index}" if len(points) > 1 else "" for index in range(len(points))]
    joints = _tree(nodes, file, path)
    values = np.concatenate([points, scores], axis=-1)
    return KeypointFile(
        "SLEAP analysis", fps, dense_tracks(values, names, joints, skeleton, fps, path)
    )


def read_movement(
    file: Any, path: Path, fps: float | None, skeleton: Skeleton | None = None
) -> KeypointFile:
    """Read the keypoint track of every individual in an open netCDF file of movement.

    ``skeleton`` selects keypoints by name; by default, all are roots. ``fps`` overrides the file's.

    Raises
    ------
    MotionFileError
        If the file is damaged, has other dimensions or lacks a joint of ``skeleton``.
    """
    points = _ordered(file, "position", _MOVEMENT_ORDER, path)
    if points.shape[3] != 2:
        raise MotionFileError(f"{path}: expected positions x and y, got {points.shape[3]} axes")
    scores = np.full((*points.shape[:3], 1), np.nan)
    if "confidence" in file:
        scores = _ordered(file, "confidence", _MOVEMENT_ORDER[:3], path)[..., np.newaxis]
    people, names = (_coordinate(file, axis, path) for axis in ("individual", "keypoint"))
    for axis, given, count in (
        ("individuals", people, points.shape[0]),
        ("keypoints", names, points.shape[2]),
    ):
        if len(given) != count:
            raise MotionFileError(f"{path}: expected {count} {axis}, got {shortened(given)}")
    if scores.shape[:3] != points.shape[:3]:
        raise MotionFileError(
            f"{path}: expected confidence of shape {points.shape[:3]}, got {scores.shape[:3]}"
        )
    if fps is None and "fps" in file.attrs:
        fps = float(np.ravel(file.attrs["fps"])[0])
        if not 0 < fps <= LARGEST:
            raise MotionFileError(f"{path}: fps must be a number above 0, got {fps:g}")
    joints = _joints(names, [], path)
    values = np.concatenate([points, scores], axis=-1)
    return KeypointFile("movement", fps, dense_tracks(values, people, joints, skeleton, fps, path))


def dataset(file: Any, key: str, path: Path) -> Any:
    """Return a dataset of plausible size."""
    import h5py

    item = file.get(key)
    if not isinstance(item, h5py.Dataset):
        raise MotionFileError(
            f"{path}: expected the dataset {key}, got {', '.join(list(file)[:12])}"
        )
    most = min(_MOST_BYTES, _MOST_COMPRESSED * path.stat().st_size)
    # Numbers are converted to eight bytes.
    if item.shape is None or item.size * max(item.dtype.itemsize, 8) > most:
        raise MotionFileError(
            f"{path}: {key} must have at most {most} bytes, got shape {item.shape}"
        )
    return item


def numbers_of(file: Any, key: str, ndim: int, path: Path) -> np.ndarray:
    """Return a dataset with ``ndim`` axes as float64; NaN is accepted, values over 1e9 are not."""
    item = dataset(file, key, path)
    if item.dtype.kind not in "fiu" or item.ndim != ndim:
        raise MotionFileError(
            f"{path}: {key} must contain numbers with {ndim} axes, got {shortened(item.dtype)} of "
            f"shape {item.shape}"
        )
    values = np.asarray(item[()], dtype=np.float64)
    if (np.abs(values) > LARGEST).any():
        raise MotionFileError(f"{path}: {key} must be between -1e9 and 1e9")
    return values


def strings_of(file: Any, key: str, path: Path) -> list[str]:
    """Return a dataset of strings; empty ones, which may have any type, are an empty list."""
    item = dataset(file, key, path)
    if item.ndim != 1 or (item.size and item.dtype.kind not in "SO"):
        raise MotionFileError(
            f"{path}: {key} must be a list of strings, got {shortened(item.dtype)} of shape "
            f"{item.shape}"
        )
    return [str(text) for text in item.asstr(errors="replace")[()]] if item.size else []


def _sleap_order(
    file: Any, shape: Sequence[int], n_nodes: int, path: Path
) -> tuple[str, ...] | list[str]:
    """Return the order of the axes of ``tracks``."""
    declared = file["tracks"].attrs.get("dims")
    orders: Sequence[Sequence[str]] = _SLEAP_ORDERS
    if declared is not None:
        orders = [json.loads(declared)]
    for order in orders:
        if sorted(order) == sorted(_SLEAP_ORDERS[0]):
            sizes = dict(zip(order, shape, strict=True))
            if sizes["xy"] == 2 and sizes["node"] == n_nodes:
                return list(order)
    raise MotionFileError(
        f"{path}: tracks must have shape (tracks, 2, {n_nodes} nodes, frames), got {tuple(shape)}"
    )


def _tree(nodes: list[str], file: Any, path: Path) -> Skeleton:
    """Return the skeleton of a SLEAP file."""
    edges = np.empty((0, 2))
    if "edge_inds" in file and dataset(file, "edge_inds", path).size:
        edges = numbers_of(file, "edge_inds", 2, path)
        edges = edges.T if edges.shape[1] != 2 else edges  # all arrays may be transposed
    if edges.shape[1] != 2:
        raise MotionFileError(f"{path}: edge_inds must be pairs of nodes, got {edges.shape}")
    return _joints(nodes, edges.tolist(), path)


def _joints(names: list[str], edges: Sequence[Sequence[float]], path: Path) -> Skeleton:
    try:
        return named_skeleton(names, edges)
    except ValueError as error:
        raise MotionFileError(f"{path}: {str(error)[:200]}") from error


def _ordered(file: Any, key: str, order: Sequence[str], path: Path) -> np.ndarray:
    """Return a variable of a netCDF file with its dimensions in ``order``."""
    values = numbers_of(file, key, len(order), path)
    names = [""] * len(order)
    # Scales list the variables that use them. In damaged files, the HDF5 library may not return
    # from reading the list of scales of a variable, which has a variable length.
    for name in file:
        for used, axis in file[name].attrs.get("REFERENCE_LIST", ()):
            if file[used] == file[key] and 0 <= axis < len(names):
                names[axis] = name.removesuffix("s")  # earlier versions write "keypoints"
    if sorted(names) != sorted(order):
        raise MotionFileError(
            f"{path}: {key} must have the dimensions {', '.join(order)}, got {', '.join(names)}"
        )
    return values.transpose([names.index(name) for name in order])


def _coordinate(file: Any, name: str, path: Path) -> list[str]:
    return strings_of(file, name if name in file else f"{name}s", path)
