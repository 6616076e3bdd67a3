"""One thread, so that sums run in one order and the bits do not depend on the number of cores."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

__all__ = ["one_thread", "only_one_thread"]

_READ_WHEN_LOADED = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_ONLY_ONE: ContextVar[bool] = ContextVar("only_one_thread", default=False)


def only_one_thread() -> bool:
    """Return whether the caller is inside :func:`one_thread`: our own loops then use one, too."""
    return _ONLY_ONE.get()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let the block's linear algebra and torch use one thread; the caller's numbers come back.

    Libraries that are first loaded inside the block read theirs from the environment.
    """
    # SciPy brings a BLAS of its own, which can be limited only once it is loaded.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    before = {name: os.environ.get(name) for name in _READ_WHEN_LOADED}
    torch = sys.modules.get("torch")
    torch_threads = torch.get_num_threads() if torch else 0
    os.environ.update(dict.fromkeys(_READ_WHEN_LOADED, "1"))
    token = _ONLY_ONE.set(True)
    try:
        if torch:
            torch.set_num_threads(1)
        with threadpool_limits(1):
            yield
    finally:
        _ONLY_ONE.reset(token)
        if torch:
            torch.set_num_threads(torch_threads)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
