"""Draws that are written to a folder as they come, so that memory does not grow.

``draws.zarr`` has one array per variable over (chain, draw, …), and ``last.nc`` the last draw with
the sampler's state, and the attributes and statistics of the run. The sampler runs in blocks, each
continued from the one before. ``last.nc`` is replaced after each block and states the number of
complete draws. A killed run therefore continues after its last complete block, with the draws that
it would have made.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from probmotion.files import forget_killed, writable_folder
from probmotion.posteriors.draws import MotionDraws
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, Sampler, progress_bar
from probmotion.validation import check_count

__all__ = ["open_draws", "stream_draws"]

_BLOCK_BYTES = 2**26  # of a block of draws
_DRAWS, _LAST, _LOCK = "draws.zarr", "last.nc", ".lock"
_AXES = ("chain", "draw")


def stream_draws(
    sampler: Sampler,
    posterior: MotionPosterior,
    path: str | Path,
    *,
    draws: int,
    chains: int = 1,
    seed: int = 0,
    progress: bool = True,
) -> MotionDraws:
    """Write draws to a folder and return them, to be read when they are used.

    An unfinished run in the folder is continued, a finished one is extended or returned. Statistics
    per chain are those of the last block; times and counts are those of all blocks.

    Parameters
    ----------
    sampler : Sampler
        Sampler whose runs can be continued.
    posterior : MotionPosterior
        Target.
    path : str or Path
        Folder of the run: a new or empty one, or that of the run to be continued.
    draws, chains, seed, progress
        As for :meth:`~probmotion.posteriors.Sampler.sample`.

    Raises
    ------
    ValueError
        If the folder has other files or another run, or another process writes to it.
    Interrupted
        On Ctrl-C, with the finished draws, which are stored.
    """
    check_count("draws", draws)
    check_count("chains", chains)
    folder = writable_folder(Path(path))
    files = {file.name for file in folder.iterdir()}
    # A run that was killed in its first block leaves a lock and incomplete draws.
    if _LAST not in files and files and (_LOCK not in files or files - {_LOCK, _DRAWS}):
        raise ValueError(f"stream must be a new folder or one of a run, got {str(path)!r}")
    with _locked(folder), progress_bar(draws, sampler.name, progress) as bar:
        forget_killed(folder)
        for unfinished in folder.glob(f"{_DRAWS}/*/*.partial"):
            unfinished.unlink()
        last = _last_of(folder)
        if last is None and (folder / _DRAWS).exists():
            shutil.rmtree(folder / _DRAWS)
        done = _number(last)
        if last is not None:
            _check_same(sampler, posterior, last, chains, seed)
            bar.update(min(done, draws))
        block = _block(posterior, chains)
        while done < draws:
            # Blocks begin at multiples of their length, also after an interruption.
            length = min(block - done % block, draws - done)
            options = {"draws": length, "chains": chains, "seed": seed, "progress": False}
            interrupted = False
            try:
                new = sampler.sample(posterior, initial=last, **options)
            except Interrupted as stop:
                new, interrupted = stop.draws, True
            last = _store(folder, new, last, done, draws, block)
            bar.update(_number(last) - done)
            done = _number(last)
            if interrupted:
                raise Interrupted(_opened(folder, last, done))
        assert last is not None
        return _opened(folder, last, draws)


def open_draws(path: str | Path) -> MotionDraws:
    """Return the complete draws of a folder, to be read when they are used.

    Raises
    ------
    FileNotFoundError
        If there are none.
    ValueError
        If a file is damaged.
    """
    last = _last_of(Path(path))
    if last is None:
        raise FileNotFoundError(f"path must be a folder with complete draws, got {str(path)!r}")
    return _opened(Path(path), last, _number(last))


def _last_of(folder: Path) -> MotionDraws | None:
    file = folder / _LAST
    return MotionDraws.load(file) if file.exists() else None


def _number(last: MotionDraws | None) -> int:
    """Return the number of complete draws per chain."""
    return 0 if last is None else int(last.dataset["draw"].values[-1]) + 1


def _block(posterior: MotionPosterior, chains: int) -> int:
    """Return the number of draws per block, which only depends on the size of a draw."""
    size = posterior.frames * posterior.skeleton.n_joints * 3 + posterior.dim
    return max(1, _BLOCK_BYTES // (8 * chains * size))


def _check_same(
    sampler: Sampler, posterior: MotionPosterior, last: MotionDraws, chains: int, seed: int
) -> None:
    """Raise ``ValueError`` unless the store has draws of this run."""
    expected = (chains, posterior.frames, posterior.skeleton.n_joints)
    got = tuple(last.positions.sizes[name] for name in ("chain", "frame", "joint"))
    if got != expected:
        raise ValueError(
            f"stream must have draws of {expected} chains, frames and joints, got {got}; use "
            "another folder"
        )
    if not last.independent or last.dataset.attrs["sampler"] != sampler.name:
        return  # the sampler compares its state and settings
    # Independent draws leave no trace of the posterior but themselves.
    before = MotionDraws(last.dataset.assign(state_draws=last.dataset["state_draws"] - 1))
    options = {"draws": 1, "chains": chains, "seed": seed, "progress": False}
    again = sampler.sample(posterior, initial=before, **options)
    if not np.allclose(again.positions.values, last.positions.values, rtol=0, atol=1e-6):
        raise ValueError(
            "stream must have draws of the same posterior, got others; use another folder"
        )


def _store(
    folder: Path, new: MotionDraws, last: MotionDraws | None, done: int, total: int, block: int
) -> MotionDraws:
    """Write a block and then the number of complete draws; return the last draw."""
    import zarr
    from numcodecs import CRC32C

    group = zarr.open_group(folder / _DRAWS, mode="a", zarr_format=2)
    rows = slice(done, done + new.dataset.sizes["draw"])
    for key, variable in new.dataset.data_vars.items():
        name = str(key)
        if variable.dims[:2] != _AXES:
            continue
        shape = (variable.shape[0], total, *variable.shape[2:])
        if name not in group:
            array = group.create_array(
                name,
                shape=shape,
                chunks=(shape[0], min(block, total), *shape[2:]),
                dtype=variable.dtype,
                compressors=CRC32C(),
                attributes={"_ARRAY_DIMENSIONS": list(variable.dims)},
            )
        array = group[name]
        assert isinstance(array, zarr.Array)
        if array.shape[1] < total:
            array.resize(shape)
        array[:, rows] = variable.values
    kept = new.dataset.isel(draw=[-1]).assign_coords(draw=[rows.stop - 1])
    attributes = dict(kept.attrs)
    if last is not None:
        for name, value in last.dataset.attrs.items():
            if name == "seconds" or str(name).startswith("evaluations_"):
                attributes[name] = attributes.get(name, 0) + value
    complete = MotionDraws(kept.assign_attrs(attributes))
    complete.save(folder / _LAST)
    return complete


def _opened(folder: Path, last: MotionDraws, draws: int) -> MotionDraws:
    """Return the first draws of a store, without reading them."""
    dataset = xr.open_zarr(folder / _DRAWS, consolidated=False, chunks=None, zarr_format=2)
    rest = last.dataset.drop_dims("draw")
    opened = dataset.isel(draw=slice(draws)).assign(rest.data_vars)
    coordinates = {name: last.dataset[name] for name in ("chain", "frame", "joint", "axis")}
    coordinates["draw"] = np.arange(draws)
    return MotionDraws(opened.assign_coords(coordinates).assign_attrs(last.dataset.attrs))


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    from filelock import FileLock, Timeout

    lock: Any = FileLock(folder / _LOCK, blocking=False)
    try:
        with lock:
            yield
    except Timeout as error:
        raise ValueError(
            f"stream must not be in use, got {str(folder)!r}, to which another process writes"
        ) from error
