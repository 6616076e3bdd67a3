"""Fixtures used by several test folders: array libraries and real motions."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

# Set no time limit per example, since the machine may be busy.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


def pytest_configure(config: pytest.Config) -> None:
    """Hide GPUs from tests of the CPU, whose results are exact there.

    Also enable Ctrl-C when the shell runs the tests in the background and ignores SIGINT. Child
    processes inherit both settings, and some tests interrupt theirs.
    """
    if "gpu" not in config.option.markexpr:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Limit torch to one thread in every test and its fixtures, and skip tests that need CUDA.

    Numba's first parallel kernel sets the number of OpenMP threads, and thereby torch's, regardless
    of OMP_NUM_THREADS; on small tensors, synchronisation makes torch ten times slower.
    """
    torch = sys.modules.get("torch")
    if torch is not None:
        torch.set_num_threads(1)
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            pytest.skip("needs CUDA; run make gpu on a machine with it")


@pytest.fixture
def few_objects() -> Iterator[None]:
    """Let the garbage collector look at new objects only; earlier tests leave millions."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@dataclass(frozen=True)
class Library:
    """Array library at one precision."""

    name: str
    dtype: str

    @property
    def tolerance(self) -> float:
        return 1e-10 if self.dtype == "float64" else 1e-4

    def array(self, values: Any) -> Any:
        values = np.asarray(values, dtype=self.dtype)
        if self.name == "torch":
            import torch

            return torch.tensor(values)
        if self.name == "jax":
            import jax.numpy as jnp

            return jnp.asarray(values)
        if self.name == "strict":
            import array_api_strict

            return array_api_strict.asarray(values)
        return values

    def compiled(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the function under ``jax.jit`` for JAX, unchanged otherwise."""
        if self.name == "jax":
            import jax

            return jax.jit(function)
        return function

    def gradient(self, function: Callable[[Any], Any], at: np.ndarray) -> np.ndarray:
        """Return the gradient of a scalar function by torch or JAX."""
        if self.name == "torch":
            point = self.array(at).requires_grad_()
            function(point).backward()
            return point.grad.numpy()
        import jax

        return np.asarray(jax.jit(jax.grad(function))(self.array(at)))

    def assert_close(self, got: Any, wanted: Any, tolerance: float | None = None) -> None:
        assert str(got.dtype).endswith(self.dtype)
        np.testing.assert_allclose(
            np.asarray(got), wanted, rtol=0, atol=self.tolerance if tolerance is None else tolerance
        )


@pytest.fixture(
    params=[(n, d) for n in ("numpy", "torch", "jax", "strict") for d in ("float64", "float32")],
    ids="-".join,
)
def library(request: pytest.FixtureRequest) -> Iterator[Library]:
    """Provide NumPy, torch, JAX and array-api-strict in double and single precision."""
    name, dtype = request.param
    if name == "jax":
        import jax

        with jax.enable_x64(dtype == "float64"):
            yield Library(name, dtype)
    else:
        yield Library(name, dtype)


@pytest.fixture(params=["torch", "jax"])
def differentiable(request: pytest.FixtureRequest) -> Iterator[Library]:
    """Provide libraries with automatic differentiation in double precision."""
    import jax

    with jax.enable_x64(True):
        yield Library(request.param, "float64")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real motions beside the repository; tests are skipped if it is missing."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the folder ../shared/data with real motions is not beside the repository")
    return folder
