"""Single-threaded blocks in several threads: limits inside, restored afterwards."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from probmotion.threads import one_thread, only_one_thread

NAMES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """Thread that enters and leaves blocks on request."""

    def __init__(self):
        self.thread = ThreadPoolExecutor(1)
        self.blocks: list[ExitStack] = []

    def do(self, what):
        return self.thread.submit(what).result(timeout=60)

    def enter(self):
        def go_in():
            self.blocks.append(ExitStack())
            self.blocks[-1].enter_context(one_thread())

        self.do(go_in)

    def leave(self):
        self.do(lambda: self.blocks.pop().close())

    def numbers(self):
        return self.do(numbers)


def numbers():
    """Return the thread limits that the calling thread sees."""
    torch_threads = torch.get_num_threads()  # first, since the first call sets OpenMP's count
    found = {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}
    environment = {name: os.environ.get(name) for name in NAMES}
    return found | environment | {"torch": torch_threads, "only_one": only_one_thread()}


def of_pools(numbers):
    return {number for name, number in numbers.items() if name not in (*NAMES, "only_one")}


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
@pytest.mark.parametrize("first_out", ["a", "b"])
def test_overlapping_threads_restore_all_limits(workers, first_out, known):
    a, b = workers
    before = numbers()
    before_each = (a.numbers(), b.numbers()) if known else None
    a.enter()
    b.enter()
    first, last = (a, b) if first_out == "a" else (b, a)
    first.leave()
    inside = last.numbers()
    assert of_pools(inside) == {1}
    assert {inside[name] for name in NAMES} == {"1"}
    assert inside["only_one"]
    last.leave()
    assert numbers() == before
    if known:
        assert (a.numbers(), b.numbers()) == before_each
    assert a.do(torch.get_num_threads) == b.do(torch.get_num_threads) == 2
    with ThreadPoolExecutor(1) as later:
        assert later.submit(torch.get_num_threads).result() == 2


def test_per_thread_limits_are_restored(workers):
    a, b = workers
    for worker, number in ((a, 2), (b, 3)):
        worker.numbers()  # torch drops a count set before the thread's first query
        worker.do(lambda number=number: torch.set_num_threads(number))
    a.enter()
    b.enter()
    assert a.do(torch.get_num_threads) == b.do(torch.get_num_threads) == 1
    a.leave()
    b.leave()
    assert (a.do(torch.get_num_threads), b.do(torch.get_num_threads)) == (2, 3)


def test_nested_blocks_limit_until_the_outer_one_ends(workers):
    a, b = workers
    before = a.numbers()
    a.enter()
    b.enter()
    a.enter()
    a.leave()
    b.leave()
    inside = a.numbers()
    assert of_pools(inside) == {1}
    assert inside["only_one"]
    a.leave()
    assert a.numbers() == before


def test_limits_are_restored_after_an_error(workers):
    a, _ = workers
    before = numbers()
    a.enter()
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    a.leave()
    assert numbers() == before


def test_libraries_are_fully_imported_on_executor_threads():
    """Array libraries check for ``jax.Array`` while another thread may still import JAX."""
    code = (
        "import sys\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from probmotion.threads import one_thread\n"
        "def loaded():\n"
        "    with one_thread():\n"
        "        return [hasattr(sys.modules.get(name), kind) for name, kind in kinds]\n"
        "kinds = [('jax', 'Array'), ('torch', 'Tensor')]\n"
        "print('jax' in sys.modules, *ThreadPoolExecutor(1).submit(loaded).result())\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["False", "True", "True"]
