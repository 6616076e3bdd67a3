"""Single-threaded execution, so that results do not depend on the number of cores."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from threading import Lock, current_thread, main_thread
from typing import Any

from probmotion.extras import is_installed

__all__ = ["one_thread", "only_one_thread"]

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_ONLY_ONE: ContextVar[bool] = ContextVar("only_one_thread", default=False)


def only_one_thread() -> bool:
    """Return whether the caller is inside :func:`one_thread`."""
    return _ONLY_ONE.get()


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit linear algebra and torch to one thread inside the block.

    Several threads may enter concurrently. Process-wide limits (environment and BLAS pools) are set
    by the first thread to enter and restored by the last thread to exit; per-thread limits of torch
    and OpenMP are restored when each thread exits. Libraries first loaded inside the block read
    their limit from the environment.
    """
    # SciPy bundles a separate BLAS, which can be limited only after loading.
    import scipy.linalg  # noqa: F401

    # In a thread pool, another thread may be importing torch or JAX, and array libraries would use
    # the partially imported module. import_module waits until the import is complete.
    if current_thread() is not main_thread():
        for name in filter(is_installed, ("torch", "jax")):
            importlib.import_module(name)
    torch = importlib.import_module("torch") if "torch" in sys.modules else None
    with _SHARED.limited(torch), _per_thread_limits(torch):
        token = _ONLY_ONE.set(True)
        try:
            yield
        finally:
            _ONLY_ONE.reset(token)


class _Shared:
    """Process-wide limits and the number of threads inside :func:`one_thread`.

    ``torch_threads`` is torch's thread count at the first entry, 0 if torch was not loaded.
    """

    def __init__(self) -> None:
        self.torch_threads = 0
        self._inside = 0
        self._limits = ExitStack()
        self._lock = Lock()

    @contextmanager
    def limited(self, torch: Any) -> Iterator[None]:
        """Set the limits at the first entry and restore them at the last exit."""
        with self._lock:
            if not self._inside:
                self.torch_threads = torch.get_num_threads() if torch else 0
                with ExitStack() as limits:
                    limits.enter_context(_single_thread_environment())
                    limits.callback(_limit_linear_algebra())
                    self._limits = limits.pop_all()
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    self._limits.close()


_SHARED = _Shared()


def _limit_linear_algebra() -> Callable[[], None]:
    """Limit the BLAS pools; return a function that restores them from any thread."""
    from threadpoolctl import OpenBLASController, ThreadpoolController

    # Since version 3.8, threadpoolctl ignores calls from threads that did not set the limit, but
    # the last thread to exit may differ from the first thread to enter.
    release = getattr(OpenBLASController, "clear_controlling_thread", lambda force: None)
    release(force=True)
    limits = ThreadpoolController().select(user_api="blas").limit(limits=1)

    def restore() -> None:
        release(force=True)
        limits.restore_original_limits()
        release(force=True)

    return restore


@contextmanager
def _single_thread_environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _per_thread_limits(torch: Any) -> Iterator[None]:
    """Limit the current thread to one OpenMP thread and one torch thread inside the block."""
    from threadpoolctl import ThreadpoolController

    before = torch.get_num_threads() if torch else 0
    # A thread that loads torch while another thread is inside one_thread inherits a count of 1 and
    # would restore 1 on exit.
    if before == 1 and not only_one_thread():
        before = _SHARED.torch_threads or before
    try:
        if torch:
            torch.set_num_threads(1)
        with ThreadpoolController().select(user_api="openmp").limit(limits=1):
            yield
    finally:
        if torch:
            torch.set_num_threads(before)
