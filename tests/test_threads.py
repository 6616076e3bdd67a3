"""Several threads inside `one_thread` at once: each computes on one, and nothing of it stays."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from probmotion.threads import one_thread, only_one_thread

NAMES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Person:
    """A thread of its own that goes in and out when it is told to."""

    def __init__(self) -> None:
        self.thread = ThreadPoolExecutor(1)
        self.blocks: list[ExitStack] = []

    def do(self, what: Callable[[], Any]) -> Any:
        return self.thread.submit(what).result(timeout=60)

    def enter(self) -> None:
        def go_in() -> None:
            self.blocks.append(ExitStack())
            self.blocks[-1].enter_context(one_thread())

        self.do(go_in)

    def leave(self) -> None:
        self.do(lambda: self.blocks.pop().close())

    def numbers(self) -> dict[str, Any]:
        return self.do(numbers)


def numbers() -> dict[str, Any]:
    """What the calling thread would compute on."""
    torch_threads = torch.get_num_threads()  # First: torch sets OpenMP's at the first look.
    found = {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}
    environment = {name: os.environ.get(name) for name in NAMES}
    return found | environment | {"torch": torch_threads, "told": only_one_thread()}


def of_pools(numbers: dict[str, Any]) -> set[int]:
    return {number for name, number in numbers.items() if name not in (*NAMES, "told")}


@pytest.fixture(autouse=True)
def _two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let there be two threads in every pool, whatever the number of cores."""
    with one_thread():
        pass  # Loads what it needs.
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    torch_threads = torch.get_num_threads()
    with threadpool_limits(2):
        torch.set_num_threads(2)
        yield
        torch.set_num_threads(torch_threads)


@pytest.fixture
def people() -> Iterator[tuple[Person, Person]]:
    a, b = Person(), Person()
    yield a, b
    for person in (a, b):
        while person.blocks:
            person.leave()
        person.thread.shutdown()


@pytest.mark.parametrize("known", [True, False], ids=["torch-known", "torch-new"])
@pytest.mark.parametrize("first_out", ["a", "b"])
def test_threads_that_overlap_leave_nothing_behind(people, first_out, known):
    a, b = people
    before = numbers()
    if known:
        before_a, before_b = a.numbers(), b.numbers()
    else:
        before_a = before_b = None
    a.enter()
    b.enter()
    first, last = (a, b) if first_out == "a" else (b, a)
    first.leave()
    inside = last.numbers()
    assert of_pools(inside) == {1}
    assert {inside[name] for name in NAMES} == {"1"}
    assert inside["told"]
    last.leave()
    assert numbers() == before
    if known:
        assert (a.numbers(), b.numbers()) == (before_a, before_b)
    assert a.do(torch.get_num_threads) == b.do(torch.get_num_threads) == 2
    # Nor does a thread that comes after them.
    with ThreadPoolExecutor(1) as later:
        assert later.submit(torch.get_num_threads).result() == 2


def test_each_thread_s_own_number_comes_back(people):
    a, b = people
    for person, number in ((a, 2), (b, 3)):
        person.numbers()  # Torch forgets a number that is set before the thread's first look.
        person.do(lambda number=number: torch.set_num_threads(number))
    a.enter()
    b.enter()
    assert a.do(torch.get_num_threads) == b.do(torch.get_num_threads) == 1
    a.leave()
    b.leave()
    assert (a.do(torch.get_num_threads), b.do(torch.get_num_threads)) == (2, 3)


def test_a_block_within_a_block_limits_until_the_outer_ends(people):
    a, b = people
    before = a.numbers()
    a.enter()
    b.enter()
    a.enter()
    a.leave()
    b.leave()
    inside = a.numbers()
    assert of_pools(inside) == {1}
    assert inside["told"]
    a.leave()
    assert a.numbers() == before


def test_an_error_inside_gives_all_back(people):
    a, _ = people
    before = numbers()
    a.enter()
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    a.leave()
    assert numbers() == before


def test_many_threads_that_come_and_go_leave_nothing_behind():
    before = numbers()

    def visit(_: int) -> set[int]:
        with one_thread():
            return of_pools(numbers())

    with ThreadPoolExecutor(8) as crowd:
        assert all(found == {1} for found in crowd.map(visit, range(60)))
    assert numbers() == before


def test_on_an_executor_s_threads_libraries_are_whole():
    """While one thread loads JAX, another may ask whether an array is JAX's."""
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
