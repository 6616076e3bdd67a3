"""Draws that are written to a folder as they come, so that memory does not grow.

``draws.zarr`` has one array per variable over (chain, draw, …), and ``last.nc`` the last draw with
the sampler's state, and the attributes and statistics of the run. The sampler runs in blocks, each
continued from the one before. ``last.nc`` is replaced after each block and states the number of
complete draws. A killed run therefore continues after its last complete block, with the draws that
it would have made.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from probmotion.arrays import to_numpy
from probmotion.files import (
    LOCK,
    forget_killed,
    locked_folder,
    writable_folder,
    write_errors,
)
from probmotion.posteriors.draws import MotionDraws, check_same_run
from probmotion.posteriors.posterior import MotionPosterior
from probmotion.posteriors.sampling import Interrupted, Sampler, progress_bar
from probmotion.posteriors.stream_arrays import AXES, CHUNKS, damaged, stored_variable, write_block
from probmotion.validation import check_count

__all__ = ["open_draws", "stream_draws"]

_BLOCK_BYTES = 2**26  # of a block of draws
_DRAWS, _LAST = "draws.zarr", "last.nc"


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
    OSError
        If the folder cannot be written to; the complete draws remain.
    Interrupted
        On Ctrl-C, with the finished draws, which are stored.
    """
    from probmotion.extras import zarr

    check_count("draws", draws)
    check_count("chains", chains)
    folder = writable_folder(Path(path), "stream")
    forget_killed(folder)
    names = {file.name for file in folder.iterdir()}
    if names and not names & {LOCK, _LAST}:
        raise _not_a_run(path)
    with locked_folder("stream", folder), progress_bar(draws, sampler.name, progress) as bar:
        files = {file.name for file in folder.iterdir()}
        # A run that was killed in its first block leaves a lock and incomplete draws.
        if _LAST not in files and files - {LOCK, _DRAWS}:
            raise _not_a_run(path)
        for unfinished in (folder / _DRAWS).rglob("*.partial"):
            unfinished.unlink()
        last = _last_of(folder)
        if last is None and (folder / _DRAWS).exists():
            shutil.rmtree(folder / _DRAWS)
        done = _number(last)
        if last is not None:
            _check_same(sampler, posterior, last, chains, seed)
            _opened(folder, last, done)  # refuses damaged draws
            bar.update(min(done, draws))
        block = _block(posterior, chains)
        while done < draws:
            # Blocks begin at multiples of their length, also after an interruption.
            length = min(block - done % block, draws - done)
            options: dict[str, Any] = {
                "draws": length,
                "chains": chains,
                "seed": seed,
                "progress": False,
            }
            interrupted = False
            try:
                new = sampler.sample(posterior, initial=last, **options)
            except Interrupted as stop:
                new, interrupted = stop.draws, True
            except KeyboardInterrupt as stop:
                if last is None:
                    raise
                raise Interrupted(_opened(folder, last, done)) from stop
            # A missing chunk would be read as zeros, so chunks of zeros are written too.
            with write_errors(folder), zarr.config.set({"array.write_empty_chunks": True}):
                write_block(folder / _DRAWS, new, done, draws, block)
            last = _complete(folder, new, last, done)
            bar.update(_number(last) - done)
            done = _number(last)
            if interrupted:
                raise Interrupted(_opened(folder, last, done))
            if done < draws and not last.state:
                raise ValueError(
                    f"draws must be at most {done} per chain for {sampler.name}, whose runs cannot "
                    f"be continued, got {draws}"
                )
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


def _not_a_run(path: str | Path) -> ValueError:
    return ValueError(f"stream must be a new folder or one of a run, got {str(path)!r}")


def _last_of(folder: Path) -> MotionDraws | None:
    file = folder / _LAST
    if not file.exists():
        return None
    last = MotionDraws.load(file)
    numbers = last.dataset["draw"].values
    if numbers.shape != (1,) or numbers.dtype.kind not in "iu" or numbers[0] < 0:
        raise damaged(file, f"it must have the number of the last draw, got {numbers}")
    return last


def _number(last: MotionDraws | None) -> int:
    """Return the number of complete draws per chain."""
    return 0 if last is None else int(last.dataset["draw"].values[0]) + 1


def _block(posterior: MotionPosterior, chains: int) -> int:
    """Return the number of draws per block, which only depends on the size of a draw."""
    size = posterior.frames * posterior.skeleton.n_joints * 3 + posterior.dim
    return CHUNKS * max(1, _BLOCK_BYTES // (8 * CHUNKS * chains * size))


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
    check_same_run(sampler, last, chains, seed)
    if not last.state:
        raise ValueError(
            f"stream must be a new folder for {sampler.name}, whose runs cannot be continued"
        )
    if not last.independent:
        theta, stored = last.dataset["theta"].values[:, 0], last.dataset["log_density"].values[:, 0]
        # If densities are estimated, the state contains deterministic densities for comparison.
        known = last.state.get("fixed", stored)
        same = np.allclose(to_numpy(posterior.log_density(theta)), known, rtol=1e-6, atol=1e-6)
    else:
        # Independent draws leave no trace of the posterior but themselves.
        before = MotionDraws(last.dataset.assign(state_draws=last.dataset["state_draws"] - 1))
        options: dict[str, Any] = {"draws": 1, "chains": chains, "seed": seed, "progress": False}
        again = sampler.sample(posterior, initial=before, **options).positions
        same = np.allclose(again, last.positions, rtol=0, atol=1e-6)
    if not same:
        raise ValueError(
            "stream must have draws of the same posterior, got others; use another folder"
        )


def _complete(folder: Path, new: MotionDraws, last: MotionDraws | None, done: int) -> MotionDraws:
    """Write the number of complete draws, after a block; return the last draw."""
    number = done + new.dataset.sizes["draw"]
    kept = new.dataset.isel(draw=[-1]).assign_coords(draw=[number - 1])
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
    from probmotion.extras import zarr

    store = folder / _DRAWS
    try:
        group = zarr.open_group(store, mode="r", zarr_format=2)
    except Exception as error:  # of damaged files, of many types
        raise damaged(store, error) from error
    dataset = last.dataset.drop_dims("draw").assign_coords(draw=np.arange(draws))
    variables = {
        name: stored_variable(group, store / str(name), variable, draws)
        for name, variable in last.dataset.data_vars.items()
        if variable.dims[:2] == AXES
    }
    return MotionDraws(dataset.assign(variables))
