"""One thread, so that sums run in one order and the bits do not depend on the number of cores."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from threading import Lock, current_thread, main_thread
from typing import Any

__all__ = ["one_thread", "only_one_thread"]

_READ_WHEN_LOADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_ONLY_ONE: ContextVar[bool] = ContextVar("only_one_thread", default=False)


def only_one_thread() -> bool:
    """Return whether the caller is inside :func:`one_thread`: our own loops then use one, too."""
    return _ONLY_ONE.get()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let the block's linear algebra and torch use one thread; the caller's numbers come back.

    Several threads may be inside at once. What they share, the environment and the pools of
    linear algebra, is limited when the first comes in and comes back when the last goes out; what
    torch and OpenMP count for each thread comes back as that thread goes out.

    Libraries that are first loaded inside the block read theirs from the environment.
    """
    # SciPy brings a BLAS of its own, which can be limited only once it is loaded.
    import scipy.linalg  # noqa: F401

    # Libraries look whether an array is torch's or JAX's as soon as these have begun to load. On
    # an executor's threads another may be loading them: import_module waits for it.
    if current_thread() is not main_thread():
        for name in ("torch", "jax"):
            importlib.import_module(name)
    torch = importlib.import_module("torch") if "torch" in sys.modules else None
    with _SHARED.limited(torch), _own_numbers_limited(torch):
        token = _ONLY_ONE.set(True)
        try:
            yield
        finally:
            _ONLY_ONE.reset(token)


class _Shared:
    """What all threads share, and how many blocks are inside.

    ``torch_threads`` is torch's number when the first came in, 0 where torch was not loaded.
    """

    def __init__(self) -> None:
        self.torch_threads = 0
        self._inside = 0
        self._limits = ExitStack()
        self._lock = Lock()

    @contextmanager
    def limited(self, torch: Any) -> Iterator[None]:
        """Limit at the first entry, and give back at the last exit."""
        with self._lock:
            if not self._inside:
                self.torch_threads = torch.get_num_threads() if torch else 0
                with ExitStack() as limits:
                    limits.enter_context(_environment_of_one())
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
    """Limit the pools of linear algebra; return what gives them back, in whichever thread."""
    from threadpoolctl import OpenBLASController, ThreadpoolController

    # From 3.8 on, threadpoolctl lets only the thread that set a number set it again, and does
    # nothing, silently, in others; but the last to go out is not always the first who came in.
    let_go = getattr(OpenBLASController, "clear_controlling_thread", lambda force: None)
    let_go(force=True)
    limits = ThreadpoolController().select(user_api="blas").limit(limits=1)

    def give_back() -> None:
        let_go(force=True)
        limits.restore_original_limits()
        let_go(force=True)

    return give_back


@contextmanager
def _environment_of_one() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _READ_WHEN_LOADED}
    os.environ.update(dict.fromkeys(_READ_WHEN_LOADED, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _own_numbers_limited(torch: Any) -> Iterator[None]:
    """Limit what is counted for each thread: OpenMP's number, and torch's, which is made of it."""
    from threadpoolctl import ThreadpoolController

    own = torch.get_num_threads() if torch else 0
    # A thread that meets torch while another is inside is given the other's 1, which it would
    # keep for good and hand to threads after it.
    if own == 1 and not only_one_thread():
        own = _SHARED.torch_threads or own
    try:
        if torch:
            torch.set_num_threads(1)
        with ThreadpoolController().select(user_api="openmp").limit(limits=1):
            yield
    finally:
        if torch:
            torch.set_num_threads(own)
