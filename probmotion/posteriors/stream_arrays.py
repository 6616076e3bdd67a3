"""Zarr arrays of streamed draws: one per variable, over (chain, draw, …), in chunks of draws."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from probmotion.posteriors.draws import MotionDraws

__all__ = ["AXES", "CHUNKS", "check_stored", "write_block"]

AXES = ("chain", "draw")
"""First dimensions of variables with a value per draw."""

CHUNKS = 16
"""Number of chunks per block, so that short runs have small files."""


def write_block(folder: Path, new: MotionDraws, done: int, total: int, block: int) -> None:
    """Write a block, the draws from number ``done``, to arrays of ``total`` draws."""
    from probmotion.extras import numcodecs, zarr

    group = zarr.open_group(folder, mode="a", zarr_format=2)
    for key, variable in new.dataset.data_vars.items():
        name = str(key)
        if variable.dims[:2] != AXES:
            continue
        shape = (variable.shape[0], total, *variable.shape[2:])
        if name not in group:
            group.create_array(
                name,
                shape=shape,
                chunks=(shape[0], block // CHUNKS, *shape[2:]),
                dtype=variable.dtype,
                compressors=numcodecs.CRC32C(),
                attributes={"_ARRAY_DIMENSIONS": list(variable.dims)},
            )
        array = group[name]
        if array.shape[1] < total:
            array.resize(shape)
        _write_rows(folder / name, array, variable.values, done)


def _write_rows(folder: Path, array: Any, values: np.ndarray, first: int) -> None:
    """Write draws ``first``, … of a variable, (chains, draws, …), to its array.

    Zarr copies a chunk several times, which costs more than writing it; whole chunks are therefore
    written directly.
    """
    length, end = array.chunks[1], first + values.shape[1]
    begin = min(-(-first // length) * length, end)
    stop = max(end // length * length, begin)
    if not _is_plain(array, values):
        begin = stop = end
    for start in range(begin, stop, length):
        rows = slice(start - first, start - first + length)
        _write_chunk(_chunk(folder, start // length, array.ndim), values[:, rows])
    for rows in (slice(first, begin), slice(stop, end)):
        if rows.start < rows.stop:
            array[:, rows] = values[:, rows.start - first : rows.stop - first]


def _is_plain(array: Any, values: np.ndarray) -> bool:
    """Return whether a chunk is a file with the numbers of all chains and their CRC32C."""
    layout = array.metadata.to_dict()
    chunks = (len(values), array.chunks[1], *values.shape[2:])
    expected = {"chunks": chunks, "order": "C", "filters": None, "compressor": {"id": "crc32c"}}
    return array.dtype == values.dtype and all(layout[key] == expected[key] for key in expected)


def _write_chunk(path: Path, values: np.ndarray) -> None:
    """Write a chunk atomically."""
    from probmotion.extras import numcodecs

    partial = path.with_name(f"{path.name}.partial")
    checksum = 0
    with open(partial, "wb") as file:
        for chain in values:
            numbers = np.ascontiguousarray(chain).reshape(-1).view(np.uint8)
            file.write(numbers.data)
            checksum = numcodecs.CRC32C.checksum(numbers, checksum)
        file.write(checksum.to_bytes(4, "little"))
    os.replace(partial, path)


def _chunk(folder: Path, number: int, dims: int) -> Path:
    """Return the file of an array's chunk; a chunk has all chains."""
    return folder / f"0.{number}{'.0' * (dims - 2)}"


def check_stored(folder: Path, stored: xr.DataArray | None, last: xr.DataArray, draws: int) -> None:
    """Raise ``ValueError`` unless a variable has all its draws; those missing are read as zeros."""
    if (
        stored is None
        or stored.dims != last.dims
        or stored.isel(draw=slice(1)).shape != last.shape
        or stored.sizes["draw"] < draws
        or not stored.dtype.isnative
    ):
        raise ValueError(f"{folder} is damaged: it must have {draws} draws of {last.sizes}")
    for number in range(-(-draws // stored.encoding["chunks"][1])):
        chunk = _chunk(folder, number, stored.ndim)
        if not chunk.exists():
            raise ValueError(f"{folder} is damaged: the draws in {chunk.name} are missing")
