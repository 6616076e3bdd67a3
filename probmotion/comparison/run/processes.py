"""Processes of our own that run tasks: what one of them dies of fails no other's task.

They are spawned, and do not import the script or notebook that asks for them: what is defined
there travels by value, so a script needs no ``if __name__ == "__main__"``.
"""

from __future__ import annotations

import io
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
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any, Protocol

import cloudpickle

from probmotion.comparison.results.failures import TimeIsUp, WorkerDied
from probmotion.posteriors.problem import Problem
from probmotion.threads import one_thread

__all__ = ["Done", "Task", "run_in_processes"]


class Task(Protocol):
    """What a worker is given, pickled; it keeps its own result."""

    @property
    def limit(self) -> float | None:
        """Seconds that :meth:`run` may take."""

    def prepare(self) -> None:
        """Load what the task needs, which the limit does not count."""

    def run(self, progress: bool) -> None:
        """Run and keep the result or the failure."""

    def fail(self, error: BaseException) -> None:
        """Keep an error as the result."""

    def answered(self) -> bool:
        """Whether the result, or the failure, is there."""


Done = Callable[[Any, BaseException | None], None]
"""Told of every task that ended, with the error that it could not keep itself."""

# What a process is born with is set for all threads of this one.
_ONE_STARTS = threading.Lock()
_READY, _BEGUN = b"ready", b"begun"
# A task ends itself at its limit, but for compiled code that does not return: then it is killed.
_GRACE = 1.2, 1.0


class _Worker:
    """One process, and the task that it has."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs,), daemon=False)
        with _ONE_STARTS, _born_deaf(), _without_main():
            self.process.start()
        theirs.close()
        self.ready = False
        self.known: set[int] = set()
        self.task: Task | None = None
        self.until: float | None = None

    def give(self, task: Task) -> None:
        """Hand over a task; raises what keeps it from travelling.

        A problem travels once: what is compiled or kept of it serves all of its tasks.
        """
        # multiprocessing's own pickler would share the memory of torch's tensors, and know classes
        # of a notebook by name alone.
        packed = io.BytesIO()
        pickler = _TaskPickler(packed, known=self.known)
        pickler.dump(task)
        self.connection.send_bytes(pickle.dumps((pickler.new, packed.getvalue())))
        self.known |= pickler.new.keys()
        self.task = task

    def heard(self) -> bytes | None:
        """Return what the process says, or None if it is dead."""
        try:
            return self.connection.recv_bytes()
        except (EOFError, OSError):
            self.process.join()
            return None

    def begin_clock(self) -> None:
        """Start to count the task's time."""
        assert self.task is not None
        if self.task.limit is not None:
            factor, more = _GRACE
            self.until = time.monotonic() + factor * self.task.limit + more

    def rest(self) -> Task:
        """Return the task, which is over."""
        task, self.task, self.until = self.task, None, None
        assert task is not None
        return task

    def kill(self) -> None:
        """End the process whatever it does."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class _TaskPickler(cloudpickle.Pickler):
    """Leaves problems out; those that the other side does not know yet are in ``new``, packed."""

    def __init__(self, file: io.BytesIO, known: set[int]) -> None:
        super().__init__(file)
        self.known = known
        self.new: dict[int, bytes] = {}

    def persistent_id(self, value: Any) -> int | None:
        """Return the number of a problem; the tasks keep it alive, and so the number its own."""
        if not isinstance(value, Problem):
            return None
        if id(value) not in self.known:
            self.new[id(value)] = cloudpickle.dumps(value)
        return id(value)


class _TaskUnpickler(pickle.Unpickler):
    """Puts problems in, each unpacked for the first task that is of it."""

    def __init__(self, packed: bytes, problems: dict[int, bytes | Problem]) -> None:
        super().__init__(io.BytesIO(packed))
        self.problems = problems

    def persistent_load(self, number: Any) -> Problem:
        """Return the problem of a number."""
        held = self.problems[number]
        if isinstance(held, bytes):
            held = self.problems[number] = pickle.loads(held)
        return held


def run_in_processes(tasks: Sequence[Task], workers: int, done: Done) -> None:
    """Run every task in one of ``workers`` spawned processes.

    Raises
    ------
    ValueError
        If this process may have no children.
    RuntimeError
        If processes do not start.
    """
    if multiprocessing.current_process().daemon:
        raise ValueError(
            f"workers is {workers} in a daemonic process, which may have no children, expected 0"
        )
    waiting = deque(tasks)
    crew: list[_Worker] = []
    try:
        # What a worker loads before its first task must find one thread in the environment.
        with one_thread():
            while waiting or any(worker.task for worker in crew):
                missing = min(workers, len(waiting) + sum(w.task is not None for w in crew))
                crew += [_Worker() for _ in range(missing - len(crew))]
                _hand_out(crew, waiting, done)
                _listen(crew, done)
    finally:
        for worker in crew:
            worker.kill()


def _hand_out(crew: list[_Worker], waiting: deque[Task], done: Done) -> None:
    for worker in crew:
        while waiting and worker.ready and worker.task is None:
            task = waiting.popleft()
            try:
                worker.give(task)
            except OSError:
                # It died between two tasks, which the next look at it finds.
                waiting.appendleft(task)
                break
            except Exception as error:
                done(
                    task,
                    TypeError(
                        f"{task} cannot be sent to a process, {error}; expected what can be "
                        "pickled, or workers=0"
                    ),
                )


def _listen(crew: list[_Worker], done: Done) -> None:
    """Wait until a worker says something, or is to be killed, and act upon it."""
    heard = [worker for worker in crew if worker.task is not None or not worker.ready]
    if not heard:
        return
    limits = [worker.until for worker in heard if worker.until is not None]
    timeout = max(0.0, min(limits) - time.monotonic()) if limits else None
    said = wait([worker.connection for worker in heard], timeout)
    for worker in heard:
        if worker.connection in said:
            _act(crew, worker, done)
        elif worker.until is not None and time.monotonic() > worker.until:
            crew.remove(worker)
            worker.kill()
            task = worker.rest()
            assert task.limit is not None
            done(task, TimeIsUp(task.limit))


def _act(crew: list[_Worker], worker: _Worker, done: Done) -> None:
    said = worker.heard()
    if said == _READY:
        worker.ready = True
    elif said == _BEGUN:
        worker.begin_clock()
    elif said is not None:
        done(worker.rest(), pickle.loads(said))
    elif not worker.ready:
        raise RuntimeError("a worker process ended before it had begun, and says why above")
    else:
        crew.remove(worker)
        worker.connection.close()
        if worker.task is not None:
            killed = worker.process.exitcode == -getattr(signal, "SIGKILL", 9)
            done(worker.rest(), WorkerDied(killed))


def _work(connection: Connection) -> None:
    """Run what comes, until nothing does."""
    _begin_worker()
    problems: dict[int, bytes | Problem] = {}
    connection.send_bytes(_READY)
    while True:
        error: BaseException | None = None
        try:
            sent = connection.recv_bytes()
        except EOFError:
            sys.stdout.flush()
            os._exit(0)
        try:
            new, packed = pickle.loads(sent)
            problems |= new
            task = _TaskUnpickler(packed, problems).load()
            with suppress(Exception):  # which running it meets again
                task.prepare()
            connection.send_bytes(_BEGUN)
            task.run(False)
        # Ctrl-C is not heard here: what says so is the sampler.
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


@contextmanager
def _without_main() -> Iterator[None]:
    """Processes that begin in the block do not run the caller's script."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _begin_worker() -> None:
    """Leave Ctrl-C to the parent, and end when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
