"""Running cells: here, in processes of our own, or on any executor."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker

from probmotion.comparison.cells import Cell, run_cell
from probmotion.sampling import progress_bar
from probmotion.threads import one_thread

__all__ = ["run_cells"]


def run_cells(
    cells: Sequence[Cell], workers: int, executor: Executor | None, progress: bool
) -> None:
    """Run every cell; each keeps its own result, or its failure.

    Parameters
    ----------
    cells : sequence of Cell
        What to run.
    workers : int
        1: in this process, with a bar for the draws of each cell; more: that many processes.
    executor : Executor, optional
        Run there instead.
    progress : bool
        Show bars.

    Raises
    ------
    KeyboardInterrupt
        At Ctrl-C, at once; finished cells are kept.
    """
    if not cells:
        return
    with progress_bar(len(cells), "cells", progress) as bar:

        def done(cell: Cell, error: BaseException | None) -> None:
            if error is not None:
                cell.fail(error)
            bar.update(1)

        if executor is not None:
            _run_on(executor, cells, done)
        elif workers == 1:
            for cell in cells:
                run_cell(cell, progress)
                done(cell, None)
        else:
            _run_in_processes(cells, workers, done)


Done = Callable[[Cell, BaseException | None], None]


def _run_on(executor: Executor, cells: Sequence[Cell], done: Done) -> None:
    running = {executor.submit(run_cell, cell): cell for cell in cells}
    try:
        for future in as_completed(running):
            done(running[future], future.exception())
    except BaseException:
        for future in running:
            future.cancel()
        raise


def _run_in_processes(cells: Sequence[Cell], workers: int, done: Done) -> None:
    waiting = list(reversed(cells))
    while waiting:
        ours_not = set(multiprocessing.active_children())
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_begin_worker)
        try:
            # What a worker loads before its first cell must find one thread in the environment.
            with one_thread():
                _feed(pool, waiting, workers, done)
            pool.shutdown()
        except BrokenProcessPool:
            pool.shutdown()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - ours_not:
                worker.terminate()
            raise


def _feed(pool: ProcessPoolExecutor, waiting: list[Cell], workers: int, done: Done) -> None:
    """Keep as many cells in the pool as it has workers, so that a dead worker fails no others."""
    running: dict[Future, Cell] = {}
    broken: BaseException | None = None
    while running or (waiting and broken is None):
        while waiting and len(running) < workers and broken is None:
            cell = waiting.pop()
            with _born_deaf():
                running[pool.submit(run_cell, cell)] = cell
        finished, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in finished:
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                broken = error
                error = RuntimeError(
                    "a worker process died while this cell ran, perhaps for want of memory; "
                    "expected it to finish"
                )
            done(running.pop(future), error)
    if broken is not None:
        raise broken


@contextmanager
def _born_deaf() -> Iterator[None]:
    """Processes that begin in the block do not hear Ctrl-C, not even while they load."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # It unblocks Ctrl-C when it starts, so it is started first.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
