"""Zarr arrays of streamed draws: one per variable, over (chain, draw, …), in chunks of draws."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray
from xarray.core import indexing

from probmotion.posteriors.draws import MotionDraws

__all__ = ["AXES", "CHUNKS", "damaged", "stored_variable", "write_block"]

AXES = ("chain", "draw")
"""First dimensions of variables with a value per draw."""

CHUNKS = 16
"""Number of chunks per block, so that short runs have small files."""

_CHECKSUM_BYTES = 4
_LAYOUT = {
    "order": "C",
    "filters": None,
    "compressor": {"id": "crc32c"},
    "dimension_separator": ".",
}


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
    return (
        array.dtype == values.dtype
        and array.chunks == chunks
        and all(layout[key] == expected for key, expected in _LAYOUT.items())
    )


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


def stored_variable(group: Any, folder: Path, last: xr.DataArray, draws: int) -> xr.Variable:
    """Return the first draws of a variable, to be read when they are used.

    ``group`` is the Zarr group that has the array in ``folder``, ``last`` the last draw.

    Raises
    ------
    ValueError
        If not all draws are stored; those missing would be read as zeros.
    """
    try:
        array = group[folder.name]
        layout = array.metadata.to_dict()
        length = array.chunks[1]
    except Exception as error:  # of damaged files, of many types
        raise damaged(folder, error) from error
    shape = (last.shape[0], array.shape[1], *last.shape[2:])
    chunks = (shape[0], length, *shape[2:])
    # In netCDF, integers have other sizes.
    integers = array.dtype.kind in "iu" and last.dtype.kind in "iu"
    if (
        array.shape != shape
        or array.chunks != chunks
        or length < 1
        or array.shape[1] < draws
        or not array.dtype.isnative
        or not (integers or array.dtype.kind == last.dtype.kind)
        or any(layout[key] != expected for key, expected in _LAYOUT.items())
    ):
        raise damaged(folder, f"it must have {draws} draws of {dict(last.sizes)}")
    size = math.prod(chunks) * array.dtype.itemsize + _CHECKSUM_BYTES
    for number in range(-(-draws // length)):
        chunk = _chunk(folder, number, last.ndim)
        if not chunk.is_file():
            raise damaged(folder, f"the draws in {chunk.name} are missing")
        if chunk.stat().st_size != size:
            raise damaged(chunk, f"it must have {size} bytes, got {chunk.stat().st_size}")
    lazy = indexing.LazilyIndexedArray(_StoredArray(folder, array))
    return xr.Variable(last.dims, indexing.MemoryCachedArray(lazy))[:, :draws]


def damaged(path: Path, reason: object) -> ValueError:
    """Return the error of a damaged file or folder of a stream."""
    return ValueError(
        f"{path} is damaged: {str(reason)[:200]}; restore it or stream to another folder"
    )


class _StoredArray(BackendArray):
    """Zarr array whose damaged chunks raise ``ValueError`` when they are read."""

    def __init__(self, folder: Path, array: Any) -> None:
        self.folder, self.zarr = folder, array
        self.shape, self.dtype = array.shape, array.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        outer = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, outer, self._read)

    def _read(self, key: tuple[Any, ...]) -> Any:
        try:
            return self.zarr.oindex[key]
        except Exception as error:  # of damaged chunks, of many types
            raise damaged(self.folder, error) from error
