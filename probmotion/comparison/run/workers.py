"""Execution of tasks in this process, in worker processes or on an executor."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import CancelledError, Executor, Future
from queue import SimpleQueue
from typing import Any

from probmotion.comparison.results.failures import ResultNotWritten
from probmotion.comparison.run.grid_tasks import GridTask
from probmotion.comparison.run.processes import Done, run_in_processes
from probmotion.comparison.run.progress import reported

__all__ = ["run_tasks"]


def run_tasks(
    tasks: Sequence[GridTask], workers: int, executor: Executor | None, progress: bool, label: str
) -> None:
    """Run tasks; each stores its own result or failure, and ``progress`` reports it.

    Tasks run on the executor if given, otherwise in ``workers`` processes, or in this process if
    ``workers`` is 0.

    Raises
    ------
    KeyboardInterrupt
        If the user presses Ctrl-C.
    ResultNotWritten
        If a result cannot be written, for example on a full disk.
    """
    if not tasks:
        return
    with reported(tasks, label, progress) as report:

        def done(task: Any, error: BaseException | None) -> None:
            if isinstance(error, ResultNotWritten):
                raise error
            if error is None and not task.has_result():
                error = FileNotFoundError(
                    f"{task} ended without a result in out; workers must have access to out"
                )
            if error is not None:
                task.fail(error)
            report(task)

        if executor is not None:
            _run_on(executor, tasks, done)
        elif workers == 0:
            for task in tasks:
                task.run()
                done(task, None)
        else:
            run_in_processes(tasks, workers, done)


def _run_task(task: GridTask) -> None:
    task.run()


def _run_on(executor: Executor, tasks: Sequence[GridTask], done: Done) -> None:
    running: dict[Future[None], GridTask] = {}
    # as_completed() misses futures that are cancelled when the executor shuts down.
    ended: SimpleQueue[Future[None]] = SimpleQueue()
    try:
        for task in tasks:
            try:
                running[executor.submit(_run_task, task)] = task
            except Exception as error:  # for example, the task cannot be pickled
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
