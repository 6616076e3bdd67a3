"""Single-threaded blocks in several threads: limits inside, restored afterwards."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from probmotion.threads import one_thread, only_one_thread

NAMES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """Thread that enters and leaves blocks on request."""

    def __init__(self):
        self.thread = ThreadPoolExecutor(1)
        self.blocks = []

    def run(self, function):
        return self.thread.submit(function).result(timeout=60)

    def enter(self):
        self.blocks.append(one_thread())
        self.run(self.blocks[-1].__enter__)

    def leave(self):
        self.run(lambda: self.blocks.pop().__exit__(None, None, None))


def limits():
    """Return the thread limits that the calling thread sees."""
    torch_threads = torch.get_num_threads()  # first, since the first call sets OpenMP's count
    pools = {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}
    environment = {name: os.environ.get(name) for name in NAMES}
    return pools | environment | {"torch": torch_threads, "only_one": only_one_thread()}


def assert_one(limits):
    assert limits.pop("only_one")
    assert {int(number) for number in limits.values()} == {1}


@pytest.fixture(autouse=True)
def _two_threads(monkeypatch):
    """Provide two threads in every pool, regardless of the number of cores."""
    with one_thread():
        pass  # loads the libraries
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    torch_threads = torch.get_num_threads()
    with threadpool_limits(2):
        torch.set_num_threads(2)
        yield
        torch.set_num_threads(torch_threads)


@pytest.fixture
def workers():
    a, b = Worker(), Worker()
    yield a, b
    for worker in (a, b):
        while worker.blocks:
            worker.leave()
        worker.thread.shutdown()


@pytest.mark.parametrize("known", [True, False], ids=["torch-known", "torch-new"])
@pytest.mark.parametrize("first_out", [0, 1])
def test_overlapping_threads_restore_all_limits(workers, first_out, known):
    before = limits()
    before_each = [worker.run(limits) for worker in workers if known]
    for worker in workers:
        worker.enter()
    workers[first_out].leave()
    assert_one(workers[1 - first_out].run(limits))
    workers[1 - first_out].leave()
    assert limits() == before
    assert [worker.run(limits) for worker in workers if known] == before_each
    assert [worker.run(torch.get_num_threads) for worker in workers] == [2, 2]
    with ThreadPoolExecutor(1) as executor:
        assert executor.submit(torch.get_num_threads).result() == 2


def test_per_thread_limits_are_restored(workers):
    for worker, number in zip(workers, (2, 3), strict=True):
        worker.run(limits)  # torch drops a count set before the thread's first query
        worker.run(lambda number=number: torch.set_num_threads(number))
    for worker in workers:
        worker.enter()
    assert [worker.run(torch.get_num_threads) for worker in workers] == [1, 1]
    for worker in workers:
        worker.leave()
    assert [worker.run(torch.get_num_threads) for worker in workers] == [2, 3]


def test_nested_blocks_limit_until_the_outer_one_ends(workers):
    a, b = workers
    before = a.run(limits)
    a.enter()
    b.enter()
    a.enter()
    a.leave()
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    b.leave()
    assert_one(a.run(limits))
    a.leave()
    assert a.run(limits) == before


def test_libraries_are_fully_imported_on_executor_threads():
    """Array libraries check for ``jax.Array`` while another thread may still import JAX."""
    code = """
import sys
from concurrent.futures import ThreadPoolExecutor
from probmotion.threads import one_thread
def loaded():
    with one_thread():
        return hasattr(sys.modules.get("jax"), "Array"), hasattr(sys.modules.get("torch"), "Tensor")
print("jax" in sys.modules, *ThreadPoolExecutor(1).submit(loaded).result())
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "True", "True"]
