"""A fingerprint tells two questions apart and knows one question again."""

from __future__ import annotations

import copy
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cached_property, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits
from toy_samplers import Holder, Plain, PriorDraws, generation, monocular

from probmotion.comparison.fingerprint import fingerprint
from probmotion.threads import one_thread


class Slotted:
    __slots__ = ("value",)


class Network(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(2, 2)


DIFFERENT = [
    None,
    True,
    1,
    1.0,
    "1",
    b"1",
    [1],
    (1,),
    [[1], []],
    [[], [1]],
    {"a": 1},
    {"a": 2},
    {1, 2},
    {"north", "east", "south", "west"},
    np.array([1.0]),
    np.array([[1.0]]),
    np.array([1.0], dtype=np.float32),
    torch.tensor([1.0]),
    np.float64(1.0),
    Holder(1),
    Holder(2),
    Holder(Holder(1)),
    Plain(1),
    Plain(2),
    Plain,
    len,
    partial(int, "1"),
    partial(int, "2"),
    Path("a"),
    Path("b"),
]


def test_different_things_have_different_fingerprints():
    assert len({fingerprint(value) for value in DIFFERENT}) == len(DIFFERENT)


@pytest.mark.parametrize("value", DIFFERENT, ids=range(len(DIFFERENT)))
def test_a_copy_has_the_same_fingerprint(value):
    assert fingerprint(copy.deepcopy(value)) == fingerprint(value)


def test_a_worker_finds_the_same_fingerprints():
    """They travel as cells do, to a process with another seed of Python's hashes."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(fingerprint, DIFFERENT))
    assert found == [fingerprint(value) for value in DIFFERENT]


def test_caches_and_order_do_not_count():
    holder = Holder(1)
    before = fingerprint(holder)
    holder.cache["filled"] = 1
    assert fingerprint(holder) == before
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    problem = monocular()
    fresh = fingerprint(problem)
    problem.reference(0, 3)
    assert fingerprint(problem) == fresh == fingerprint(monocular())


def test_problems_and_samplers_are_told_apart_by_all_that_matters():
    problem = monocular()
    louder = replace(problem.posterior.likelihood, noise=0.06)
    moved = replace(problem, truth=problem.truth + 1e-9)
    other = replace(problem, posterior=replace(problem.posterior, likelihood=louder))
    found = {fingerprint(each) for each in (problem, moved, other, generation())}
    assert len(found) == 4
    assert fingerprint(PriorDraws()) != fingerprint(PriorDraws(spread=1.1))


def test_a_network_is_its_weights():
    torch.manual_seed(0)
    one, two = Network(), Network()
    assert fingerprint(one) != fingerprint(two)
    two.load_state_dict(one.state_dict())
    assert fingerprint(one) == fingerprint(two)


class Computes:
    def __init__(self, value):
        self.value = value

    @cached_property
    def half(self):
        return self.value / 2


def test_what_an_object_computed_from_the_rest_does_not_count():
    fresh, used = Computes(3.0), Computes(3.0)
    assert used.half == 1.5
    assert fingerprint(used) == fingerprint(fresh) != fingerprint(Computes(4.0))


def test_an_object_that_holds_itself_ends():
    knot = Plain(1)
    knot.value = [knot]
    assert fingerprint(knot) != fingerprint(Plain([1]))


@pytest.mark.parametrize(
    "value", [Slotted(), np.random.default_rng(0), object()], ids=["slots", "generator", "object"]
)
def test_what_cannot_be_told_apart_is_refused(value):
    with pytest.raises(ValueError, match="which cannot be told from another"):
        fingerprint([value])


def threads():
    """Threads of every library that is loaded, by its file."""
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info()}


def test_one_thread_is_one_thread_and_then_what_it_was(monkeypatch):
    with one_thread():
        pass  # Loads what it needs, which another test may not have done yet.
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with threadpool_limits(2):
        before, torch_before = threads(), torch.get_num_threads()
        with one_thread():
            assert set(threads().values()) == {1}
            assert torch.get_num_threads() == 1
            assert os.environ["OMP_NUM_THREADS"] == os.environ["OPENBLAS_NUM_THREADS"] == "1"
        assert threads() == before
        assert torch.get_num_threads() == torch_before
    assert os.environ["OMP_NUM_THREADS"] == "3"
    assert "OPENBLAS_NUM_THREADS" not in os.environ
