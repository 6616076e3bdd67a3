"""Running tasks, cells or pilots: here, in processes of our own, or on any executor."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import CancelledError, Executor, Future
from queue import SimpleQueue
from typing import Any

from probmotion.comparison.results.failures import CellNotKept
from probmotion.comparison.run.processes import Done, Task, run_in_processes
from probmotion.posteriors.sampling import progress_bar

__all__ = ["run_task", "run_tasks"]


def run_tasks(
    tasks: Sequence[Task],
    workers: int,
    executor: Executor | None,
    progress: bool,
    label: str = "cells",
) -> None:
    """Run every task; each keeps its own result, or its failure.

    Parameters
    ----------
    tasks : sequence of Task
        What to run.
    workers : int
        That many processes; 0: in this one, with a bar for the draws of each cell.
    executor : Executor, optional
        Run there instead.
    progress : bool
        Show bars.
    label : str
        What the bar counts.

    Raises
    ------
    KeyboardInterrupt
        At Ctrl-C, at once; finished tasks are kept.
    CellNotKept
        If a result cannot be written, as on a full disk; finished tasks are kept.
    """
    if not tasks:
        return
    with progress_bar(len(tasks), label, progress) as bar:

        def done(task: Any, error: BaseException | None) -> None:
            if isinstance(error, CellNotKept):
                raise error
            if error is None and not task.answered():
                error = FileNotFoundError(
                    f"{task} ended and its result is not in out, expected workers that see out"
                )
            if error is not None:
                task.fail(error)
            bar.update(1)

        if executor is not None:
            _run_on(executor, tasks, done)
        elif workers == 0:
            for task in tasks:
                run_task(task, progress)
                done(task, None)
        else:
            run_in_processes(tasks, workers, done)


def run_task(task: Task, progress: bool = False) -> None:
    """Run a task; what an executor is given."""
    task.run(progress)


def _run_on(executor: Executor, tasks: Sequence[Task], done: Done) -> None:
    running: dict[Future[None], Task] = {}
    # Of what an executor has cancelled when it was shut down, as_completed would never hear.
    ended: SimpleQueue[Future[None]] = SimpleQueue()
    try:
        for task in tasks:
            try:
                running[executor.submit(run_task, task)] = task
            except Exception as error:  # as of what cannot be sent
                done(task, error)
        for future in running:
            future.add_done_callback(ended.put)
        for _ in running:
            future = ended.get()
            cancelled = CancelledError("the executor cancelled it")
            done(running[future], cancelled if future.cancelled() else future.exception())
    except BaseException:
        for future in running:
            future.cancel()
        raise
