"""Worker processes for grid tasks; a crash of a process fails only its current task.

Processes are spawned without importing the caller's script or notebook. The classes and
functions of the script are sent by value, so that it needs no ``if __name__ == "__main__"``.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any

import cloudpickle

from probmotion.comparison.results.failures import TimeLimitExceeded, WorkerDied
from probmotion.comparison.run.grid_tasks import GridTask
from probmotion.threads import one_thread

__all__ = ["Done", "run_in_processes"]


Done = Callable[[Any, BaseException | None], None]
"""Callback after each task, with its error, or None if the task stored its result or failure."""

# Allows one process start at a time, because it replaces ``__main__`` for all threads.
_START_LOCK = threading.Lock()
_READY, _STARTED = b"ready", b"started"  # messages from a worker to its parent
# (factor, seconds): a task that does not stop by itself is killed after factor * limit + seconds.
_GRACE = 1.2, 1.0


class _Worker:
    """Worker process and its current task."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, child_end = context.Pipe()
        self.process = context.Process(target=_work, args=(child_end,), daemon=False)
        with _START_LOCK, _ignoring_ctrl_c(), _without_main():
            self.process.start()
        child_end.close()
        self.ready = False
        self.known: set[int] = set()
        self.task: GridTask | None = None
        self.until: float | None = None

    def send(self, task: GridTask) -> None:
        """Send a task; its problem is sent only once, so that its tasks share its caches."""
        key = id(task.source)  # unique while tasks refer to the problem
        problem = None if key in self.known else cloudpickle.dumps(task.source)
        # multiprocessing's pickler would share the memory of tensors and send classes by name.
        self.connection.send_bytes(cloudpickle.dumps((key, problem, replace(task, source=""))))
        self.known.add(key)
        self.task = task

    def message(self) -> bytes | None:
        """Return the next message of the process, or None if it has died."""
        try:
            return self.connection.recv_bytes()
        except (EOFError, OSError):
            self.process.join()
            return None

    def take_task(self) -> GridTask:
        """Remove and return the finished task."""
        task, self.task, self.until = self.task, None, None
        assert task is not None
        return task

    def kill(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


def run_in_processes(tasks: Sequence[GridTask], workers: int, done: Done) -> None:
    """Run each task in one of ``workers`` spawned processes and call ``done`` when it ends.

    Raises
    ------
    ValueError
        If this process is daemonic.
    RuntimeError
        If a process does not start.
    """
    if multiprocessing.current_process().daemon:
        raise ValueError(
            f"workers must be 0 in a daemonic process, which cannot start processes, got {workers}"
        )
    waiting = deque(tasks)
    pool: list[_Worker] = []
    try:
        # Libraries read the number of threads from the environment when they are loaded.
        with one_thread():
            while waiting or any(worker.task for worker in pool):
                missing = min(workers, len(waiting) + sum(w.task is not None for w in pool))
                pool += [_Worker() for _ in range(missing - len(pool))]
                _hand_out(pool, waiting, done)
                _listen(pool, done)
    finally:
        for worker in pool:
            worker.kill()


def _hand_out(pool: list[_Worker], waiting: deque[GridTask], done: Done) -> None:
    for worker in pool:
        while waiting and worker.ready and worker.task is None:
            task = waiting.popleft()
            try:
                worker.send(task)
            except OSError:
                # The worker died between two tasks; _listen removes it.
                waiting.appendleft(task)
                break
            except Exception as error:
                message = f"{task} cannot be sent to a worker process: {error}; make it picklable"
                done(task, TypeError(f"{message} or use workers=0"))


def _listen(pool: list[_Worker], done: Done) -> None:
    """Wait until a worker sends a message or exceeds its time limit, and handle the event."""
    active = [worker for worker in pool if worker.task is not None or not worker.ready]
    if not active:
        return
    limits = [worker.until for worker in active if worker.until is not None]
    timeout = max(0.0, min(limits) - time.monotonic()) if limits else None
    ready = wait([worker.connection for worker in active], timeout)
    for worker in active:
        if worker.connection in ready:
            _handle(pool, worker, done)
        elif worker.until is not None and time.monotonic() > worker.until:
            pool.remove(worker)
            worker.kill()
            task = worker.take_task()
            assert task.limit is not None
            done(task, TimeLimitExceeded(task.limit))


def _handle(pool: list[_Worker], worker: _Worker, done: Done) -> None:
    message = worker.message()
    if message == _READY:
        worker.ready = True
    elif message == _STARTED:
        if worker.task is not None and worker.task.limit is not None:
            factor, extra = _GRACE
            worker.until = time.monotonic() + factor * worker.task.limit + extra
    elif message is not None:
        done(worker.take_task(), pickle.loads(message))
    elif not worker.ready:
        raise RuntimeError("a worker process ended before it was ready; see its error above")
    else:
        pool.remove(worker)
        worker.connection.close()
        if worker.task is not None:
            killed = worker.process.exitcode == -getattr(signal, "SIGKILL", 9)
            done(worker.take_task(), WorkerDied(killed))


def _work(connection: Connection) -> None:
    """Run tasks until the parent closes the connection."""
    _begin_worker()
    problems: dict[int, Any] = {}
    connection.send_bytes(_READY)
    while True:
        error: BaseException | None = None
        try:
            sent = connection.recv_bytes()
        except EOFError:
            sys.stdout.flush()
            os._exit(0)
        try:
            key, packed, task = pickle.loads(sent)
            if packed is not None:
                problems[key] = packed
            if isinstance(packed := problems[key], bytes):
                problems[key] = pickle.loads(packed)
            task = replace(task, source=problems[key])
            with suppress(Exception):  # run() raises the error again
                task.prepare()
            connection.send_bytes(_STARTED)
            task.run()
        # Workers ignore Ctrl-C, so a KeyboardInterrupt was raised by the sampler.
        except (Exception, KeyboardInterrupt) as caught:
            error = caught
        connection.send_bytes(_pickled(error))


def _pickled(error: BaseException | None) -> bytes:
    try:
        packed = pickle.dumps(error)
        pickle.loads(packed)
    except Exception:
        return pickle.dumps(RuntimeError(f"{type(error).__name__}: {error}"))
    return packed


@contextmanager
def _ignoring_ctrl_c() -> Iterator[None]:
    """Let processes started in the block ignore Ctrl-C, even while they load."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Start the resource tracker first, because its start unblocks Ctrl-C.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main() -> Iterator[None]:
    """Prevent processes started in the block from running the caller's script."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _begin_worker() -> None:
    """Ignore Ctrl-C and exit when the parent exits."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def exit_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=exit_with_parent, daemon=True).start()
